"""Intrinsics that the tracks contradict: found where the camera turns, with and without a lens, and never on a line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens
from rille.stages.odometry.resection.bundle_adjustment import RefineParams, SegmentState, SegmentTracks, adjust
from rille.stages.odometry.resection.intrinsics import (
    NAMES,
    SegmentCameras,
    changed,
    common_error,
    contradiction,
    contribution,
)
from rille.stages.odometry.resection.landmarks import triangulated

CAMERA = Camera(450.0, 450.0, 375.5, 239.5, 752, 480)
BENT = Lens(CAMERA, "radtan", (-0.28, 0.07, 0.0, 0.0))
PARAMS = RefineParams()
LEVEL = RigidTransform(rotation_exp(np.array([1.2, 0.1, -0.1])), np.array([0.3, 0.2, 1.0]))


def contributions(given: Camera, lens: Lens, turn: float) -> list[list[tuple[float, float]]]:
    """Of eight segments: a camera of 450 px turns by some ``turn`` radians, and is taken for the given one."""
    T_right_left = RigidTransform(np.eye(3), np.array([-0.12, 0.0, 0.0]))
    rig, wrong = Rig(given, given, T_right_left), replace(lens, camera=given)
    out = []
    for seed in range(8):
        rng = np.random.default_rng(seed)

        def measured(points, rng=rng):
            pixels = wrong.undistort(lens.distort(CAMERA.project(points), CAMERA), given)
            return pixels + 0.1 * rng.standard_normal(pixels.shape)

        X = CAMERA.rays(rng.uniform([60, 40], [690, 440], (80, 2))) * rng.uniform(2.0, 8.0, (80, 1))
        moves = [
            RigidTransform(rotation_exp(turn * rng.standard_normal(3) * k), 0.1 * rng.standard_normal(3))
            for k in (1, 2)
        ]
        at = triangulated(measured(X), measured(T_right_left.apply(X)), rig, LEVEL, np.full(80, 0.2))
        pixels = np.array([measured(move.apply(X)) for move in moves])
        views = SegmentTracks(at.position, at.per_pixel, at.sigma, pixels, np.ones((2, 80), bool), given)
        start = [move @ LEVEL.inverse() for move in moves]
        state = SegmentState(
            np.array([T.rotation for T in start]), np.array([T.translation for T in start]), np.zeros(80)
        )
        state = adjust(views, state, PARAMS).state
        lenses = {} if lens.ideal else {"left": wrong, "right": wrong}
        out.append(contribution(views, state, SegmentCameras(rig, lenses, LEVEL), PARAMS))
    return out


def errors(given: Camera, lens: Lens, turn: float = 0.03) -> list[tuple[float, float]]:
    parts = np.array(contributions(given, lens, turn))
    return [common_error(parts[:, k]) for k in range(len(NAMES))]


@pytest.mark.parametrize(("by", "lens"), [(0.1, Lens(CAMERA)), (0.03, BENT)], ids=["pinhole", "lens"])
@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_number_is_named_where_the_camera_turns(name, by, lens):
    found = errors(changed(CAMERA, name, by), lens)
    assert name in contradiction(found, CAMERA.fx)
    assert 0.7 < -found[NAMES.index(name)][0] / by < 1.4


@pytest.mark.parametrize("lens", [Lens(CAMERA), BENT], ids=["pinhole", "lens"])
def test_right_numbers_are_believed(lens):
    assert contradiction(errors(CAMERA, lens), CAMERA.fx) == ""


def test_a_straight_drive_does_not_tell_a_focal_length():
    assert contradiction(errors(changed(CAMERA, NAMES[0], 0.1), Lens(CAMERA), 0.001), CAMERA.fx) == ""


def test_the_common_error_is_the_mean_and_a_segment_far_off_counts_as_one_at_two_deviations():
    same = np.array([[1e4, 10.0]] * 12)
    error, sigma = common_error(same)
    assert error == pytest.approx(0.001)
    assert sigma == pytest.approx((12e4) ** -0.5)
    # Huber's mean: eleven at 0 and one far off balance where 11 t = 2 deviations.
    same[:, 1] = [0.0] * 11 + [20.0 * 1e4**0.5]
    assert common_error(same)[0] == pytest.approx(2.0 * 1e4**-0.5 / 11, rel=1e-3)
    assert common_error(same[:2]) == (0.0, float("inf"))


def test_segments_that_scatter_by_more_than_they_claim_widen_the_error():
    value = 0.003 * np.random.default_rng(1).standard_normal(400)
    error, sigma = common_error(np.column_stack([np.full(400, 1e6), 1e6 * value]))  # claimed: 0.001
    assert sigma == pytest.approx(0.003 / 20.0, rel=0.15)
    assert abs(error) < 4.0 * sigma
