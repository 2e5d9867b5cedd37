"""The bed as a drive finds it: where it starts the ground is plane, and no step leads out of there."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rille.datasets.mockup.params import SceneParams
from rille.datasets.mockup.render import radiance
from rille.datasets.mockup.scene import PAD_EDGE_M, build_scene, height_field
from rille.stages.geometry.geometry import Camera, RigidTransform

PAD = (0.0, 0.3, 0.15)


@pytest.mark.parametrize("slope_deg", [0.0, 8.0, -8.0])
def test_the_pad_is_cut_along_the_ground(slope_deg: float) -> None:
    p = SceneParams(bed_width=0.8, bed_length=0.8, cell=0.004, rocks=0.0, craters=0.0, slope_deg=slope_deg)
    scene = build_scene(p)
    height, lattice = build_scene(p, pad=PAD)["height"], scene.meta["lattice"]
    x = lattice["x0"] + p.cell * np.arange(height.shape[1])
    y = lattice["y0"] - p.cell * np.arange(height.shape[0])
    far = np.hypot(x[None, :] - PAD[0], y[:, None] - PAD[1])
    rise = math.tan(math.radians(slope_deg))
    above = height - rise * y[:, None]
    assert np.ptp(above[far <= PAD[2]]) < 1e-6
    # beside it lies the relief alone: a level pad on 8 degrees would end in a wall of 21 mm, more where it is larger
    ring = above[(far > PAD[2]) & (far <= PAD[2] + PAD_EDGE_M)]
    assert np.ptp(ring) < 5.0 * p.relief
    outside = far > PAD[2] + PAD_EDGE_M
    assert np.array_equal(height[outside], np.asarray(scene["height"])[outside])


@pytest.mark.parametrize("patch", [(5.0, 5.0, 0.1), (0.0013, 0.3, 0.0005)])
def test_a_patch_without_ground_changes_nothing(patch: tuple[float, float, float]) -> None:
    """One beside the bed, and one smaller than a cell: there is no height to lay it at."""
    p = SceneParams(bed_width=0.4, bed_length=0.4, cell=0.004)
    np.testing.assert_array_equal(build_scene(p, blank=patch)["height"], build_scene(p)["height"])


@pytest.mark.parametrize("slope_deg", [-15.0, 0.0, 20.0])
def test_grain_covers_a_slope_and_lacks_in_the_patch_where_it_is_stated(slope_deg: float) -> None:
    """The grain is draped over what rises from the bed; the slope itself shifts it nowhere."""
    p = SceneParams(bed_width=0.4, bed_length=1.2, cell=0.004, relief=0.0, rocks=0.0, craters=0.0, slope_deg=slope_deg)
    scene = build_scene(p, blank=(0.0, 0.8, 0.1))
    # straight down from so far above that a pixel sees 4 mm of the bed, whatever its height
    down = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.6, 40.0]))
    light = radiance(scene, height_field(scene), Camera(1e4, 1e4, 49.5, 149.5, 100, 300), down, 1)[0][:, 0, :, 0]
    y = 0.6 - 0.004 * (np.arange(300) - 149.5)
    contrast = np.abs(np.diff(light[:, 40:60], axis=0)).mean(axis=1) / np.nanmean(light)
    inside = np.abs(y[1:] - 0.8) < 0.075
    covered = (y[1:] > 0.02) & (y[1:] < 1.18) & (np.abs(y[1:] - 0.8) > 0.11)
    assert contrast[inside].max() < 0.01
    assert contrast[covered].min() > 0.02
