"""The comparison of ways to grid: meshes and measures by hand, and every method on a plane with exact disparity."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.locus.kernel import SOLVED_PX

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from gridding import measures, methods, scenes
from gridding.mesh import rasterise, without_jumps


def test_triangles_are_sampled_at_cell_centres_and_the_highest_wins() -> None:
    lattice = Lattice.at(0, 3, 1.0, 4, 4)  # x 0..3, y 3..0
    x, y = np.meshgrid([-0.5, 2.5], [2.5, 0.5])
    points = np.stack([x, y, 1.0 + x + 2.0 * y], axis=-1)
    found = rasterise(points, np.ones((1, 1), bool), lattice)
    inside = np.zeros((4, 4), bool)
    inside[1:3, :3] = True  # y = 2, 1 and x = 0, 1, 2
    np.testing.assert_array_equal(np.isfinite(found), inside)
    expected = 1.0 + lattice.xy()[..., 0] + 2.0 * lattice.xy()[..., 1]
    np.testing.assert_allclose(found[inside], expected[inside])
    both = np.concatenate([points, points + np.array([0.0, 0.0, 5.0])], axis=0)
    twice = rasterise(both, np.array([[True], [False], [True]]), lattice)
    np.testing.assert_allclose(twice[inside], expected[inside] + 5.0)


def test_no_quadrangle_across_a_jump_or_an_unusable_pixel() -> None:
    u = np.zeros((3, 4))
    u[:, 3] = 5.0
    usable = np.ones((3, 4), bool)
    usable[0, 0] = False
    expected = np.array([[False, True, False], [True, True, False]])
    np.testing.assert_array_equal(without_jumps(u, np.zeros_like(u), usable, 3.0), expected)


def test_a_pixel_behind_another_is_hidden() -> None:
    u = np.array([[-1.0, -1.0, -1.0, -1.0, -3.0, -1.0]])
    # column 4 lands on 1, where column 2 lands too, from farther away; column 0 lands outside
    np.testing.assert_array_equal(scenes._hidden(u), [[True, False, True, False, False, False]])


def scene() -> scenes.Scene:
    """A tilted plane 2 m away, parallel cameras, exact disparities; cells twice a pixel."""
    camera = Camera(100.0, 100.0, 31.5, 23.5, 64, 48)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0])))
    rays = camera.rays(scenes.pixels_of((48, 64)))
    depth = 2.0 / (1.0 - 0.2 * rays[..., 0])  # Z = 2 + 0.2 X
    u = (-100.0 * 0.2 / depth).astype(np.float32)
    T = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 3.0]))
    lattice = Lattice.snap((-0.3, 0.4, -0.3, 0.3), 0.04)
    truth = (1.0 - 0.2 * lattice.xy()[..., 0]).astype(np.float32)
    all_ = np.ones(u.shape, bool)
    grey = np.full(u.shape, 9, np.uint8)
    true = scenes.Disparities(u, np.zeros_like(u), all_)
    judged = np.ones(lattice.shape, bool)
    return scenes.Scene("plane", grey, grey, rig, T, lattice, (0.0, 2.0), 1.0, truth, judged, true, (all_, all_))


@pytest.mark.parametrize("name", ["locus", "mesh", "median_in_cell"])
def test_every_method_gives_the_plane(name: str) -> None:
    s = scene()
    found = measures.judge(s, getattr(methods, name)(s, np.inf, True))
    assert found.completeness == 1.0
    # a median of points off the cell's centre: by half a cell at most, on a slope of 0.2; the others interpolate, and
    # Locus stops at SOLVED_PX of disparity, of which one pixel makes Z^2 / (f B) at Z = 2.1 m or less
    assert found.p95 < (0.2 * 0.02 if name == "median_in_cell" else SOLVED_PX * 2.1**2 / (100.0 * 0.2) + 1e-6)


def test_figures_and_the_least_error_at_a_completeness() -> None:
    s = scene()
    z = s.truth.copy()
    z[0, 0], z[0, 1] = np.nan, z[0, 1] + 1.0
    doubt = np.zeros_like(z)
    doubt[0, 1] = 5.0
    model = methods.Model(z, doubt)
    size = z.size
    assert measures.judge(s, model).completeness == pytest.approx(1 - 1 / size)
    assert measures.judge(s, model).rmse == pytest.approx(np.sqrt(1 / (size - 1)), rel=1e-6)
    assert measures.judge(s, model, most=1.0).rmse == 0.0
    curve = [measures.judge(s, model), measures.judge(s, model, most=1.0)]
    assert measures.least(curve, "rmse", 1 - 2 / size) == 0.0
    assert measures.least(curve, "rmse", 1 - 1 / size) == curve[0].rmse
    assert measures.least(curve, "rmse", 1.0) is None
