"""Rows of plants look alike: matches on them may be off by a period, which is named as the cause."""

from __future__ import annotations

import numpy as np
import pytest
from rig_scenes import knocked, matches, street_depth, street_rig

from rille.pipeline.runs.input_checks import judge_repetition
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
    repeated = orientation_stage.run(OrientationParams(), args, ports).meta["repeated"]
    assert judge_repetition(repeated).level == ("WARN" if rows else "OK")


def test_matches_of_what_repeats_repair_no_rig() -> None:
    rig = street_rig()
    pairs = [matches(knocked(rig, pitch_deg=-0.24, roll_deg=0.3), street_depth, pair=k) for k in range(3)]
    assert orient_rig(rig, pairs, RigParams(), repeated=0.4)["changed"]
    found = orient_rig(rig, pairs, RigParams(), repeated=0.6)
    assert found["rig"] == rig.to_dict()
    assert not found["changed"]
    assert found["warnings"][0] == found["repeats"]
    assert found["warnings"][1].endswith("not repaired, for what they show repeats")
