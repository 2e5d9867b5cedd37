"""Scale of the right image against the left one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rille.stages.geometry import scale
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp

CAMERA = Camera(500.0, 480.0, 319.5, 239.5, 640, 480)


def rig(fx: float, fy: float) -> Rig:
    shift = RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    return Rig(CAMERA, replace(CAMERA, fx=fx * CAMERA.fx, fy=fy * CAMERA.fy), shift)


@pytest.mark.parametrize("found", [1.0, 1.2, 1 / 1.2, 1.19])
def test_a_fifth_is_no_other_scale(found: float) -> None:
    assert scale.effective(found) == 1.0


@pytest.mark.parametrize("found", [1.21, 0.8, 3.0])
def test_more_is_counted_as_it_is(found: float) -> None:
    assert scale.effective(found) == found


def test_of_a_rig_each_axis_counts_by_itself() -> None:
    assert scale.of_rig(rig(1.1, 0.9)).tolist() == [1.0, 1.0]
    np.testing.assert_allclose(scale.of_rig(rig(2.0, 1.1)), [2.0, 1.0])
    assert scale.coarser_focal(rig(0.9, 0.5)) == CAMERA.fx
    assert scale.coarser_focal(rig(0.5, 0.5)) == 0.5 * CAMERA.fx
    assert scale.coarser_focal(rig(4.0, 4.0)) == CAMERA.fx


@pytest.mark.parametrize("roll_deg", [0.0, 3.0, 90.0, 180.0])
def test_axes_are_those_of_far_points(roll_deg: float) -> None:
    wide = rig(2.0, 1.0)
    turned = RigidTransform(rotation_exp([0.0, 0.0, np.radians(roll_deg)]), wide.T_right_left.translation)
    rays = CAMERA.rays(np.array([[319.5, 239.5], [320.5, 239.5], [319.5, 240.5]]))
    middle, column, row = wide.right.project(rays @ turned.rotation.T)
    found = scale.axes(Rig(wide.left, wide.right, turned))
    np.testing.assert_allclose(found, np.column_stack([column - middle, row - middle]), atol=0.1)


def test_images_without_calibration_are_judged_by_their_sides() -> None:
    assert not scale.other_size((480, 640), (400, 640))
    assert scale.other_size((480, 640), (360, 640))
