"""Pairs that are not of one moment are found by their rows, on streets whose right images are of other moments."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rille.datasets.registry import open_sequence
from rille.pipeline.runs.checks.matches import judge_synchrony
from rille.stages.calibration import synchrony
from rille.stages.calibration.synchrony import best_partners
from rille.stages.core.declare import Bundle, NoParams
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.imaging.features import extract
from rille.stages.numeric.robust import mad_sigma


@pytest.mark.data
@pytest.mark.parametrize(
    ("rights", "partners", "words"),
    [
        ([9, 10, 11, 12, 13], [], ""),
        ([8, 9, 10, 11, 12], [[10, 11], [11, 12], [12, 13]], "left i with right i+1"),
        ([9, 12, 11, 10, 13], [[10, 12], [12, 10]], "left 10 with right 12, left 12 with right 10"),
    ],
)
def test_the_right_image_of_each_pair_is_found(data_dir, rights, partners, words):
    street = data_dir / "kitti06_51"

    def features(folder, frames):
        files = sorted((street / folder).iterdir())
        read = [cv2.imread(str(files[k]), cv2.IMREAD_REDUCED_GRAYSCALE_2) for k in frames]
        taken = [Bundle({"image": image, "valid": np.ones(image.shape, np.uint8)}, {}) for image in read]
        return [extract(one["image"], one["valid"]) for one in taken]

    rig = open_sequence(str(street)).rig
    half = [
        Camera(c.fx / 2, c.fy / 2, c.cx / 2 - 0.25, c.cy / 2 - 0.25, c.width // 2, c.height // 2)
        for c in (rig.left, rig.right)
    ]
    args = {"pairs": [10, 11, 12], "frames": [9, 10, 11, 12, 13], "rig": Rig(*half, rig.T_right_left).to_dict()}
    ports = {"left": features("image_l", [10, 11, 12]), "right": features("image_r", rights)}
    facts = synchrony.synchrony_stage.run(NoParams(), args, ports).meta
    assert facts["partners"] == partners
    assert words in facts.get("contradiction", "")
    assert judge_synchrony(facts).level == ("FAIL" if partners else "OK")


def test_what_departs_too_far_is_told_by_the_right_images_own_height():
    left, right = (Camera(100.0 * s, 100.0 * s, 50.0 * s, 50.0 * s, 100 * s, 100 * s) for s in (1, 4))
    rig = Rig(left, right, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    rng = np.random.default_rng(0)
    points, descriptors = rng.uniform(10, 90, (200, 2)), np.kron(np.eye(200), np.full(4, 255)).astype(np.uint8)
    # A twentieth of the right image's height is a fifth of the left one's.
    theirs = 4 * points + np.column_stack([np.full(200, -8.0), 20 + rng.normal(0, 1, 200)])
    sides = (Bundle({"points": one + 0.5, "descriptors": descriptors}, {}) for one in (points, theirs))
    apart = synchrony.row_offsets(rig, *sides)
    assert len(apart) == 200
    assert np.std(apart) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("to_right", [(-0.1, 0.0, 0.0), (0.0, -0.1, 0.0), (-0.07, -0.072, 0.0)])
def test_rows_that_a_focal_length_stretches_are_of_no_other_time(to_right):
    camera = Camera(100.0, 100.0, 50.0, 50.0, 100, 100)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), np.array(to_right)))
    rng = np.random.default_rng(0)
    points, descriptors = rng.uniform(10, 90, (200, 2)), np.kron(np.eye(200), np.full(4, 255)).astype(np.uint8)
    theirs = 50 + 1.05 * (points - 50) + rng.normal(0, 0.1, (200, 2))
    theirs[:30] += rng.uniform(-9, 9, (30, 2))
    sides = (Bundle({"points": one + 0.5, "descriptors": descriptors}, {}) for one in (points, theirs))
    assert mad_sigma(synchrony.row_offsets(rig, *sides)) < 0.25


def offsets(spread, count=200):
    return spread * np.random.default_rng(3).standard_normal(count)


def test_at_rest_and_without_matches_nothing_is_said():
    at_rest = {pair: {frame: offsets(0.3) for frame in range(5)} for pair in (1, 3)}
    assert best_partners(at_rest)["partners"] == []
    blank = best_partners({1: {0: None, 1: None}})
    assert "contradiction" not in blank
    assert judge_synchrony(blank) is None


def test_a_rig_that_is_off_is_of_no_other_time():
    """Rows that fit badly whatever the image speak of the rig, not of time."""
    assert best_partners({2: {k: offsets(s) for k, s in enumerate([9.0, 7.0, 6.0, 5.5, 8.0])}})["partners"] == []


def test_few_matches_that_hardly_move_are_no_partner():
    """Far away in time only the horizon matches, which fits all rows."""
    found = best_partners({0: {0: offsets(3.0), 1: offsets(0.3), 8: offsets(0.1, 45)}})
    assert found["partners"] == [[0, 1]]


@pytest.mark.parametrize(
    ("shift", "anew"),
    [(-1, "1 to the numbers of the right images from 4 on"), (2, "2 to the numbers of the left images from 5 on")],
)
def test_behind_an_image_that_one_camera_lost_the_numbers_that_fit_are_told(shift, anew):
    """The first pair behind it has no partner."""
    late = {pair: {pair + k: offsets(0.3 if k == shift else 5.0) for k in (-1, 0, 2)} for pair in range(5, 9)}
    fine = {pair: {pair + k: offsets(5.0 if k else 0.3) for k in (-1, 0, 2)} for pair in range(4)}
    found = best_partners(fine | late)
    assert [pair for pair, _ in found["partners"]] == [5, 6, 7, 8]
    assert found["contradiction"].endswith(f"add {anew}")
    # of two pairs alone one does not know
    assert "add" not in best_partners(fine | {pair: late[pair] for pair in (5, 6)})["contradiction"]
