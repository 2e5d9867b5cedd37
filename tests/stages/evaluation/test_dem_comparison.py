"""Comparison of elevation models: resampling, figures and alignment with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from rille.stages.evaluation import dem_comparison
from rille.stages.evaluation.dem_comparison import (
    Alignment,
    align,
    binned,
    cell_means,
    common,
    errors,
    figures,
)
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.terrain.relief.grid import Grid


def grid(values: np.ndarray, cell: float = 1.0, x0: float = 0.0, y0: float = 0.0, turn: float = 0.0) -> Grid:
    c, s = np.cos(turn), np.sin(turn)
    return Grid(np.asarray(values, float), np.array([[c * cell, s * cell, x0], [s * cell, -c * cell, y0]]))


def hills(xy: np.ndarray) -> np.ndarray:
    x, y = xy[..., 0], xy[..., 1]
    return 0.8 * np.sin(x / 5.0) * np.cos(y / 7.0) + 0.3 * np.sin(0.31 * x + 0.17 * y) + 0.02 * x


def terrain(shape: tuple[int, int] = (80, 100), **where: float) -> Grid:
    empty = grid(np.zeros(shape), **where)
    return Grid(hills(empty.centres()), empty.matrix)


def test_figures_by_hand() -> None:
    f = figures(np.array([1.0, -1.0, 3.0, np.nan, 1.0]))
    assert f["rmse"] == pytest.approx(np.sqrt(12 / 4))
    assert f["bias"] == pytest.approx(1.0)
    assert f["median"] == 1.0
    assert f["nmad"] == pytest.approx(1.4826 * 1.0)
    assert f["p95"] == pytest.approx(np.percentile([1, 1, 1, 3], 95))
    assert f["cells"] == 4
    assert figures(np.array([np.nan])) == {"cells": 0.0}


def test_bilinear_needs_the_cells_that_count_and_no_others() -> None:
    z = np.arange(12.0).reshape(3, 4)
    z[1, 2] = np.nan
    g = grid(z, cell=2.0, x0=10.0, y0=20.0)
    at = np.array([[10.0, 20.0], [11.0, 19.0], [13.0, 18.0], [12.0, 18.0], [16.0, 16.0], [17.0, 16.0]])
    found = g.at(at)
    np.testing.assert_allclose(found[[0, 1, 3, 4]], [0.0, 2.5, 5.0, 11.0])
    assert np.isnan(found[[2, 5]]).all()  # beside an unknown cell, and outside


def test_the_finer_model_is_averaged_where_it_knows_half_a_cell() -> None:
    fine = np.arange(16.0).reshape(4, 4)
    fine[:2, 2:] = np.nan
    fine[0, 2] = 50.0  # a quarter known
    fine[2, 0] = fine[2, 1] = np.nan  # half known
    g = grid(fine, cell=1.0, x0=0.5, y0=-0.5)
    target = grid(np.zeros((2, 2)), cell=2.0, x0=1.0, y0=-1.0)
    means = cell_means(g, target)
    np.testing.assert_allclose(
        means[[0, 1, 1], [0, 0, 1]], [(0 + 1 + 4 + 5) / 4, (12 + 13) / 2, (10 + 11 + 14 + 15) / 4]
    )
    assert np.isnan(means[0, 1])
    a, b, how = common(g, target)
    np.testing.assert_array_equal(a.values, means)
    assert b is target
    assert how.startswith("A averaged")
    assert common(target, g)[2].startswith("B averaged")


@pytest.mark.parametrize("ratio", [2, 3, 4])
def test_a_plane_on_lattices_of_multiples_of_their_cells_is_the_same_plane(ratio: int) -> None:
    def plane(cell: float, n: int) -> Grid:
        empty = grid(np.zeros((n, n)), cell=cell)
        x, y = np.moveaxis(empty.centres(), -1, 0)
        return Grid(0.3 * x + 0.2 * y, empty.matrix)

    fine, coarse = plane(0.01, 20 * ratio + 1), plane(0.01 * ratio, 21)
    fine.values[:5] = np.nan  # the first row of target cells knows too little, the second more than half
    error = errors(*common(fine, coarse)[:2])
    inner = error[3:-1, 1:-1]  # outermost cells are covered on one side alone
    assert np.isfinite(inner).all()
    assert np.abs(inner).max() < 1e-12


def test_equal_cells_are_not_resampled_and_turned_ones_are_interpolated() -> None:
    whole = terrain()
    part = Grid(whole.values[10:40, 20:60], whole.matrix + np.array([[0, 0, 20.0], [0, 0, -10.0]]))
    a, b, how = common(part, whole)
    assert "nothing resampled" in how
    assert np.nanmax(np.abs(errors(a, b))) == 0.0
    assert np.isfinite(errors(a, b)).sum() == part.values.size
    turned = terrain((60, 60), turn=0.4, x0=30.0, y0=-10.0)
    a, b, how = common(turned, whole)
    assert "bilinearly" in how
    # bilinear: an eighth of the second derivatives of both axes, each at most 0.8/25 + 0.8/49 + 0.3 * 0.1
    assert np.nanmax(np.abs(errors(a, b))) < 2 * (0.8 / 25 + 0.8 / 49 + 0.3 * 0.31**2) / 8
    # Turned about a cell that they have in common.
    assert "bilinearly" in common(terrain(turn=0.5), whole)[2]
    with raises("RIL-323"):
        common(grid(np.ones((3, 3))), grid(np.ones((3, 3)), x0=100.0))


def moved(T: RigidTransform, shape: tuple[int, int] = (80, 100)) -> Grid:
    """What a model is called whose every surface point p was at T p: solved for at the cell centres."""
    g = terrain(shape)
    xy = g.centres()
    z = hills(xy)
    for _ in range(60):  # the point above (x, y) whose image lies on the hills
        image = T.apply(np.concatenate([xy, z[..., None]], axis=-1))
        z = z - (image[..., 2] - hills(image[..., :2]))
    return Grid(z, g.matrix)


@pytest.mark.parametrize("kind", ["shift", "tilt", "rigid"])
def test_a_known_motion_is_found(kind: str) -> None:
    shift, turn = {
        "shift": ([0.6, -0.4, 0.25], [0.0, 0.0, 0.0]),
        "tilt": ([0.0, 0.0, 0.25], [0.004, -0.003, 0.0]),
        "rigid": ([0.6, -0.4, 0.25], [0.004, -0.003, 0.01]),
    }[kind]
    b, middle = terrain(), terrain().centres().mean(axis=(0, 1))
    centre = np.array([*middle, 0.0])
    R = rotation_exp(turn)
    T = RigidTransform(R, centre + shift - R @ centre)
    a = moved(T)
    rng = np.random.default_rng(5)
    a.values[rng.random(a.values.shape) < 0.02] += 30.0  # gross errors must not matter
    found = align(a, b, kind)  # type: ignore[arg-type]
    points = np.concatenate([a.centres(), hills(a.centres())[..., None]], axis=-1)
    # bilinear B against the smooth hills is off by 15 mm at most, and mostly by less: the mean motion by a tenth of it
    off = np.linalg.norm(found.pose.apply(points) - T.apply(points), axis=-1)
    assert off.max() < 0.02
    assert found.sigma[3:].any() == (kind != "shift")
    after = errors(a, b, found.pose)
    assert figures(after)["nmad"] < 0.01 < 0.1 < abs(figures(a.values - b.values)["median"])


def shift(found: Alignment) -> np.ndarray:
    """By which a model that lies 0.1 m too high is moved otherwise, at the centre."""
    return found.centre - found.pose.inverse().apply(found.centre) + [0.0, 0.0, 0.1]


@pytest.mark.parametrize("kind", ["shift", "tilt", "rigid"])
@pytest.mark.parametrize("noise", [0.02, 0.2])
def test_noise_keeps_no_alignment_from_being_found(kind: str, noise: float) -> None:
    for seed in range(8):
        b = terrain()
        a = Grid(b.values + 0.1 + noise * np.random.default_rng(seed).standard_normal(b.values.shape), b.matrix)
        found = align(a, b, kind)  # type: ignore[arg-type]
        assert (np.abs(shift(found)) <= 5.0 * found.sigma[:3]).all()


def test_the_stated_deviations_are_those_of_least_squares() -> None:
    flat = grid(np.zeros((60, 70)))
    noisy = Grid(0.05 * np.random.default_rng(2).standard_normal((60, 70)), flat.matrix)
    found = align(noisy, flat, "tilt")
    x, y = np.moveaxis(flat.centres(), -1, 0)
    spread = [x.size, ((y - y.mean()) ** 2).sum(), ((x - x.mean()) ** 2).sum()]
    np.testing.assert_allclose(found.sigma[2:5], 0.05 / np.sqrt(spread), rtol=0.1)


def test_of_a_large_model_points_all_over_it_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dem_comparison, "MAX_POINTS", 1000)
    whole = terrain()
    found = align(Grid(whole.values + 0.1, whole.matrix), whole, "rigid")
    assert 500 < found.points < 2000
    assert found.centre[:2] == pytest.approx(whole.centres().mean(axis=(0, 1)), abs=3.0)
    assert shift(found) == pytest.approx(0.0, abs=1e-6)


def test_a_motion_that_the_terrain_does_not_show_is_refused() -> None:
    rng = np.random.default_rng(0)
    flat = grid(np.zeros((50, 60)))
    noisy = Grid(flat.values + 0.1, flat.matrix)
    for kind in ("shift", "rigid"):
        with raises("RIL-326"):
            align(noisy, flat, kind)  # type: ignore[arg-type]
    assert shift(align(noisy, flat, "tilt")) == pytest.approx(0.0, abs=1e-9)
    few = Grid(np.where(rng.random((50, 60)) < 0.002, 1.0, np.nan), flat.matrix)
    with raises("RIL-325"):
        align(few, flat, "tilt")


def test_what_lies_higher_errs_upwards_moved_or_not() -> None:
    b = terrain()
    a = Grid(b.values + 0.5, b.matrix)
    for found in (errors(a, b), errors(a, b, RigidTransform.identity())):
        np.testing.assert_allclose(found[np.isfinite(found)], 0.5)


def test_bins_leave_out_what_is_empty() -> None:
    found = binned(np.array([1.0, 3.0, -2.0, np.nan]), np.array([0.5, 0.6, 9.0, 0.1]), np.array([0.0, 1.0, 5.0, 10.0]))
    assert [(f["from"], f["to"], f["cells"]) for f in found] == [(0.0, 1.0, 2), (5.0, 10.0, 1)]
    assert found[0]["bias"] == 2.0


@pytest.mark.parametrize("kind", ["shift", "rigid"])
def test_noise_in_the_slopes_does_not_keep_a_fit_from_its_end(kind: str) -> None:
    def kerbs(x: float, y: float, seed: int) -> Grid:
        empty = grid(np.zeros((300, 100)), cell=0.1, x0=-5.0)
        across, along = np.moveaxis(np.add(empty.centres(), (x, y)), -1, 0)
        wall = 0.3 / (1.0 + np.exp((3.5 + 0.3 * np.sin(0.4 * along) - np.abs(across)) / 0.15))
        bumps = 0.02 * np.sin(1.3 * across) + 0.01 * np.sin(0.7 * along)
        return Grid(wall + bumps + np.random.default_rng(seed).normal(0.0, 0.005, wall.shape), empty.matrix)

    # Each step is shortened by the share of the slopes' noise: more than thirty of them would be needed.
    found = align(kerbs(0.0, 0.0, 1), kerbs(0.1, 0.5, 2), kind)  # type: ignore[arg-type]
    assert found.rounds < 20
    np.testing.assert_allclose(found.pose.translation, [-0.1, -0.5, 0.0], atol=3e-3)
