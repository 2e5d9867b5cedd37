"""Coefficients of lenses that are read in another order, or as those of another model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rille.stages.calibration.lens_reading import better_reading
from rille.stages.calibration.relative_orientation import PointPairs
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens

CAMERA = Camera(450.0, 450.0, 370.0, 240.0, 752, 480)
RIG = Rig(CAMERA, CAMERA, RigidTransform(rotation_exp([0.003, 0.01, -0.004]), [-0.11, 0.001, 0.002]))
RADTAN, FISHEYE = (-0.28, 0.07, 0.0002, 0.00002), (0.004, -0.002, 0.002, 0.0005)
FIVE = (-0.35, 0.18, 0.0005, -0.0003, -0.06)


def pairs(true: Lens, given: Lens, rig: Rig = RIG) -> list[PointPairs]:
    """Matches of images that one lens took, undistorted by another; with noise, and a tenth of them mismatched."""
    rng = np.random.default_rng(5)
    points = CAMERA.rays(rng.uniform((20, 20), (730, 460), (900, 2))) * rng.uniform(1.0, 4.0, (900, 1))
    ideal = RIG.left.project(points), rig.right.project(rig.T_right_left.apply(points))
    left, right = (given.undistort(true.distort(p, CAMERA) + rng.normal(0, 0.1, p.shape), CAMERA) for p in ideal)
    right[::10] += rng.uniform(-30, 30, right[::10].shape)
    seen = np.isfinite(left).all(1) & np.isfinite(right).all(1)
    return [PointPairs(0, left[seen], right[seen])]


@pytest.mark.parametrize(
    ("true", "given", "name"),
    [
        (("radtan", RADTAN), ("radtan", RADTAN), ""),
        (("fisheye", FISHEYE), ("fisheye", FISHEYE), ""),
        (("radtan", RADTAN), ("fisheye", RADTAN), "model radtan"),
        (("fisheye", FISHEYE), ("radtan", FISHEYE), "model fisheye"),
        (("radtan", FIVE), ("radtan", (-0.35, 0.18, -0.06, 0.0005, -0.0003)), "give k1 k2 p1 p2 k3"),
        (("radtan", RADTAN), ("radtan", (0.0002, 0.00002, -0.28, 0.07)), "give k1 k2 p1 p2"),
        (("radtan", FIVE), ("radtan", (0.0005, -0.0003, -0.35, 0.18, -0.06)), "give k1 k2 p1 p2"),
        (("radtan", RADTAN), ("radtan", tuple(-c for c in RADTAN)), "the other sign"),
        (("none", ()), ("radtan", RADTAN), "free of distortion"),
        (("radtan", (-0.2, 0.02, 0.0, 0.0)), ("radtan", RADTAN), ""),
    ],
)
def test_another_reading_is_named_where_it_fits_better(true: tuple, given: tuple, name: str) -> None:
    stated = Lens(CAMERA, *given)
    said = better_reading(RIG, RIG, {"left": stated, "right": stated}, pairs(Lens(CAMERA, *true), stated))
    assert bool(said) == bool(name)
    assert name in said


def test_a_turned_camera_is_no_other_reading() -> None:
    lens = Lens(CAMERA, "radtan", RADTAN)
    knocked = Rig(
        CAMERA, CAMERA, RigidTransform(rotation_exp([0.01, 0.0, 0.01]) @ RIG.T_right_left.rotation, [-0.11, 0, 0])
    )
    assert not better_reading(knocked, knocked, {"left": lens, "right": lens}, pairs(lens, lens))


@pytest.mark.parametrize("lens", [Lens(CAMERA, "radtan", RADTAN), Lens(CAMERA)], ids=["distorted", "ideal"])
def test_a_rotation_between_the_cameras_that_is_transposed_is_named(lens: Lens) -> None:
    turned = Rig(CAMERA, CAMERA, RigidTransform(rotation_exp([0.01, -0.02, 0.015]), RIG.T_right_left.translation))
    transposed = Rig(CAMERA, CAMERA, RigidTransform(turned.T_right_left.rotation.T, turned.T_right_left.translation))
    matches = pairs(lens, lens, turned)
    said = better_reading(transposed, transposed, {"left": lens, "right": lens}, matches)
    assert said.startswith("R between the cameras seems misread")
    assert said.endswith("if it is transposed")
    assert not better_reading(turned, turned, {"left": lens, "right": lens}, matches)


@pytest.mark.parametrize("lens", [Lens(CAMERA, "radtan", RADTAN), Lens(CAMERA)], ids=["distorted", "ideal"])
@pytest.mark.parametrize(("ratio", "off"), [(1.05, 0.0), (1.05, 3.0), (1.002, 0.5)])
def test_a_focal_length_of_one_camera_that_is_off_is_named(lens: Lens, ratio: float, off: float) -> None:
    """One that is off by what calibrations are is not misread, though rows are half a pixel off."""
    longer = replace(CAMERA, fx=ratio * CAMERA.fx, fy=ratio * CAMERA.fy)
    matches = pairs(lens, lens)
    rig, lenses = replace(RIG, right=longer), {"left": lens, "right": replace(lens, camera=longer)}
    # The images were undistorted by what is given.
    raw = lens.distort(matches[0].right, CAMERA)
    # A camera that is turned besides: rows are off alike.
    matches = [replace(matches[0], right=lenses["right"].undistort(raw, longer) + np.array([0.0, off]))]
    said = better_reading(rig, rig, lenses, matches)
    if ratio < 1.01:
        assert not said
        return
    assert said.startswith("a focal length seems misread")
    assert "the right camera's is 0.95" in said
    assert "the left one's 1.05" in said


def test_a_baseline_that_points_ahead_is_no_focal_length() -> None:
    """Over flat ground it moves rows as a focal length does; the rig is repaired then."""
    rng, lenses = np.random.default_rng(5), {"left": Lens(CAMERA), "right": Lens(CAMERA)}
    ahead = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), [-0.11, 0.0, 0.02]))
    rays = CAMERA.rays(rng.uniform((20, 300), (730, 470), (900, 2)))
    ground = rays / rays[:, 1:2]
    left, right = CAMERA.project(ground), CAMERA.project(ground + ahead.T_right_left.translation)
    matches = [PointPairs(0, left, right + rng.normal(0, 0.05, right.shape))]
    given = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), [-0.112, 0.0, 0.0]))
    assert not better_reading(given, ahead, lenses, matches)


def test_cameras_whose_figures_are_exchanged_are_named() -> None:
    left, right = Lens(CAMERA), Lens(replace(CAMERA, cx=381.0, cy=247.0))
    at = pairs(left, left)[0]
    matches = [replace(at, right=at.right + np.array([11.0, 7.0]))]
    given, wrong = (Rig(a.camera, b.camera, RIG.T_right_left) for a, b in ((left, right), (right, left)))
    said = better_reading(wrong, wrong, {"left": right, "right": left}, matches)
    assert "figures of the two cameras seem misread" in said
    assert not better_reading(given, given, {"left": left, "right": right}, matches)


@pytest.mark.parametrize("coefficients", [(), (-0.28, 0.07, 0.0002, 0.00002)])
@pytest.mark.parametrize("t", [(-0.11, 0.001, 0.002), (0.001, -0.11, 0.002)])
def test_rectified_images_with_the_calibration_of_raw_ones_are_named(coefficients: tuple, t: tuple) -> None:
    lens = Lens(CAMERA, "radtan", coefficients) if coefficients else Lens(CAMERA)
    parallel = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.where(np.abs(t) > 0.1, t, 0.0)))
    given = Rig(CAMERA, CAMERA, RigidTransform(rotation_exp([0.01, -0.02, 0.015]), t))
    said = better_reading(given, given, {"left": lens, "right": lens}, pairs(Lens(CAMERA), lens, parallel))
    assert "rectified already" in said
