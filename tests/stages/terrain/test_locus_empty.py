"""The reason for an empty elevation model, one case each."""

from __future__ import annotations

import numpy as np
from terrain_scenes import pitched, toed_in_rig

from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.surface import plane
from rille.stages.terrain.locus.empty import explain

RIG, T_LOCAL_LEFT = toed_in_rig(), pitched(35.0)
AHEAD = Lattice.snap((-0.2, 0.2, 0.6, 1.0), 0.01)
GOOD = np.ones((240, 320), bool)


def reason(rig: Rig = RIG, where: Lattice = AHEAD, usable: np.ndarray = GOOD) -> str:
    return str(explain(rig, T_LOCAL_LEFT, plane(where), (-0.6, -0.4), usable))


def test_a_surface_behind_the_camera_is_told_with_its_place_along_the_axis() -> None:
    told = reason(where=Lattice.snap((-0.2, 0.2, -5.0, -4.0), 0.01))
    assert "behind the left camera" in told
    # the camera looks down by 35 degrees: depth = y cos 35 - z sin 35, at the last cell's centre and the lowest z
    nearest = -4.0 * np.cos(np.radians(35)) + 0.6 * np.sin(np.radians(35))
    assert f"to {nearest:.3g} m" in told
    assert "locus.extent" in told


def test_cameras_that_look_away_are_told_with_what_each_sees() -> None:
    beside = reason(where=Lattice.snap((30.0, 30.4, 0.6, 1.0), 0.01))
    assert "look away" in beside
    assert "sees 0 %, the right one 0 %" in beside
    turned = Rig(RIG.left, RIG.right, RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.array([0.1, 0.0, 0.0])))
    told = reason(turned)
    assert "the right one 0 %" in told
    assert "the left one sees 0 %" not in told
    assert "T_right_left" in told


def test_no_valid_disparity_and_contradicting_ones_are_two_things() -> None:
    assert "76800" in reason(usable=~GOOD)
    told = reason()
    assert "76800 valid disparities" in told
    assert "locus.max_residual" in told


def test_a_handful_of_cells_is_too_coarse() -> None:
    coarse = Lattice.snap((-0.2, 0.2, 0.6, 1.0), 0.1)
    told = reason(where=coarse)
    assert f"there are {coarse.rows * coarse.cols} only ({coarse.rows} x {coarse.cols})" in told
    assert coarse.rows * coarse.cols < 40
    assert "locus.cell_size" in told
    assert "none of 76800" in reason(where=coarse, usable=~GOOD)
