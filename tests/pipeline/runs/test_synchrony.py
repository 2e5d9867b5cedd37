"""Pairs that are not of one moment are found by their rows, on streets that are shifted by one image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rille.datasets.registry import open_sequence
from rille.pipeline.runs import synchrony
from rille.pipeline.runs.input_checks import judge_synchrony
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform


@pytest.mark.data
@pytest.mark.parametrize("late", [0, 1, -1])
def test_a_shift_of_the_right_images_is_found(data_dir, late):
    street = data_dir / "kitti06_51"
    rig = open_sequence(str(street)).rig
    left, right = (sorted((street / folder).iterdir()) for folder in ("image_l", "image_r"))
    spreads = {shift: [] for shift in synchrony.SHIFTS}
    for k in (10, 30):
        ours = synchrony.features(cv2.imread(str(left[k]), cv2.IMREAD_GRAYSCALE))
        for shift, values in spreads.items():
            theirs = synchrony.features(cv2.imread(str(right[k + late + shift]), cv2.IMREAD_GRAYSCALE))
            values.append(synchrony.row_spread(rig, ours, theirs))
    found = synchrony.best_shift(spreads)
    verdict = judge_synchrony(spreads)
    if late == 0:
        assert found is None
        assert verdict.level == "OK"
    else:
        assert found is not None
        assert found[0] == -late
        assert verdict.level == "FAIL"
        assert f"right i{-late:+d}" in verdict.text


def test_what_departs_too_far_is_told_by_the_right_images_own_height():
    left, right = (Camera(100.0 * s, 100.0 * s, 50.0 * s, 50.0 * s, 100 * s, 100 * s) for s in (1, 4))
    rig = Rig(left, right, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    rng = np.random.default_rng(0)
    points, features = rng.uniform(10, 90, (200, 2)), np.eye(200, dtype=np.float32)
    # A twentieth of the right image's height is a fifth of the left one's.
    theirs = 4 * points + np.column_stack([np.full(200, -8.0), 20 + rng.normal(0, 1, 200)])
    assert synchrony.row_spread(rig, (points, features), (theirs, features)) == pytest.approx(1.0, abs=0.2)


def test_at_rest_and_without_matches_nothing_is_said():
    at_rest = {shift: [1.4, 1.5, None] for shift in synchrony.SHIFTS}
    assert synchrony.best_shift(at_rest) is None
    blank = {shift: [None, None] for shift in synchrony.SHIFTS}
    assert synchrony.best_shift(blank) is None
    assert judge_synchrony(blank) is None


def test_a_rig_that_is_off_is_no_shift():
    """Rows that fit badly at every shift speak of the rig, not of time."""
    assert synchrony.best_shift({0: [6.0, 5.0], -1: [7.0, 6.0], 1: [5.5, 6.5], -2: [9.0, 9.0], 2: [8.0, 9.0]}) is None
