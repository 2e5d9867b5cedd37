"""The reason for an empty elevation model, one case each."""

from __future__ import annotations

import numpy as np
from terrain_scenes import pitched, toed_in_rig

from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.locus.coverage import explain

RIG, T_LOCAL_LEFT = toed_in_rig(), pitched(35.0)
AHEAD = Lattice.snap((-0.2, 0.2, 0.6, 1.0), 0.01)
GOOD = np.ones((240, 320), bool)


def reason(rig: Rig = RIG, where: Lattice = AHEAD, usable: np.ndarray = GOOD) -> str:
    return str(explain(rig, T_LOCAL_LEFT, where, (-0.6, -0.4), usable))


def test_cameras_that_look_away_are_told_with_what_each_sees() -> None:
    for where in ((30.0, 30.4, 0.6, 1.0), (-0.2, 0.2, -5.0, -4.0)):  # beside them, and behind
        beside = reason(where=Lattice.snap(where, 0.01))
        assert "sees 0 %, the right one 0 %" in beside
        assert "locus.extent" in beside
    turned = Rig(RIG.left, RIG.right, RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.array([0.1, 0.0, 0.0])))
    told = reason(turned)
    assert "the right one 0 %" in told
    assert "the left one sees 0 %" not in told
    assert "T_right_left" in told


def test_no_valid_disparity_and_none_on_the_surface_are_two_things() -> None:
    assert "76800" in reason(usable=~GOOD)
    told = reason()
    assert "76800 valid disparities" in told
    assert f"none of {AHEAD.rows * AHEAD.cols} cells" in told
    assert "locus.max_sigma" in told
