"""Rows of plants look alike: matches on them may be off by a period, which is named as the cause."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rig_scenes import knocked, matches, street_depth, street_rig

from rille.pipeline.runs.checks.matches import judge_repetition
from rille.stages.calibration.doubt import repeated
from rille.stages.calibration.orientation import OrientationParams, orientation_stage
from rille.stages.calibration.rig import RigParams, orient_rig
from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform


@pytest.mark.parametrize("rows", [True, False])
def test_matches_on_a_pattern_that_repeats_are_doubted(rows: bool) -> None:
    rng = np.random.default_rng(0)
    # Between the rows of plants hardly anything tells one from the next.
    look = 128 + 60 * np.sin(2 * np.pi * np.arange(240) / 24) if rows else np.zeros(240)
    scene = np.clip(look + rng.normal(0 if rows else 128, 4 if rows else 40, (160, 240)), 0, 255).astype(np.float32)
    images = Bundle({"image": scene}, {}), Bundle({"image": np.roll(scene, -10, axis=1)}, {})
    maps = {"column_disparity": np.full(scene.shape, -10, "f4"), "row_disparity": np.zeros(scene.shape, "f4")}
    maps |= {"validity": np.full(scene.shape, Validity.MATCHED, "u1"), "backmatch_error": np.zeros(scene.shape, "f4")}
    camera = Camera(200.0, 200.0, 119.5, 79.5, 240, 160)
    args = {"rig": Rig(camera, camera, RigidTransform(np.eye(3), [-0.2, 0.0, 0.0])).to_dict(), "pair": 0}
    ports = {"disparity": Bundle(maps, {}), "left": images[0], "right": images[1]}
    share = orientation_stage.run(OrientationParams(), args, ports).meta["repeated"]
    assert judge_repetition(share).level == ("WARN" if rows else "OK")


@pytest.mark.parametrize("rows", [True, False])
@pytest.mark.parametrize(("scale", "turn_deg"), [(1.0, 0.0), (1.7, 20.0), (0.6, -15.0), (1.7, 0.0), (1.0, 20.0)])
def test_a_right_image_that_is_turned_and_scaled_repeats_no_more(scale: float, turn_deg: float, rows: bool) -> None:
    rng = np.random.default_rng(1)
    scene = cv2.GaussianBlur(rng.normal(0, 1, (240, 320)), (0, 0), 4.0)
    scene = 128 + 40 * scene / scene.std() * (0.02 if rows else 1) + 50 * rows * np.sin(np.arange(320) * 2 * np.pi / 24)
    to_right = cv2.getRotationMatrix2D((160, 120), turn_deg, scale)
    right = cv2.warpAffine(scene, to_right, (320, 240)) + rng.normal(0, 2, scene.shape)
    y, x = (k.ravel().astype(float) for k in np.mgrid[10:230:6, 10:310:6])
    places = np.stack([x, y], 1), np.stack([x, y, np.ones(x.size)], 1) @ to_right.T
    # Epipolar lines: rows of the left image, where they lie in the right one.
    whole = np.vstack([to_right, [0.0, 0.0, 1.0]])
    f = np.linalg.inv(whole).T @ np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    share = repeated(scene.astype(np.float32), right.astype(np.float32), places, f)
    assert share > 0.8 if rows else share < 0.1


def test_edges_along_the_lines_do_not_repeat() -> None:
    """Stairs: a patch on an edge along its epipolar line looks alike all along, and yet not as of a period."""
    rng = np.random.default_rng(2)
    steps = np.repeat(rng.uniform(20, 230, 12), 20)[:, None]
    scene = (steps + cv2.GaussianBlur(rng.normal(0, 12, (240, 320)), (0, 0), 2.0)).astype(np.float32)
    y, x = (k.ravel().astype(float) for k in np.mgrid[10:230:6, 30:310:6])
    f = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    places = np.stack([x, y], 1), np.stack([x - 10, y], 1)
    assert repeated(scene, np.roll(scene, -10, axis=1), places, f) < 0.1


def test_matches_of_what_repeats_repair_no_rig() -> None:
    rig = street_rig()
    pairs = [matches(knocked(rig, pitch_deg=-0.24, roll_deg=0.3), street_depth, pair=k) for k in range(3)]
    assert orient_rig(rig, pairs, RigParams(), repeated=0.4)["changed"]
    found = orient_rig(rig, pairs, RigParams(), repeated=0.6)
    assert found["rig"] == rig.to_dict()
    assert not found["changed"]
    assert found["warnings"][0] == found["repeats"]
    assert found["warnings"][1].endswith("not repaired, for what they show repeats")
