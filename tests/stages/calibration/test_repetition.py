"""Rows of plants look alike: matches on them may be off by a period, which is named as the cause."""

from __future__ import annotations

import numpy as np
import pytest

from rille.pipeline.runs.input_checks import judge_repetition
from rille.stages.calibration.repetition import repetition_stage
from rille.stages.core.declare import Bundle, NoParams


@pytest.mark.parametrize("rows", [True, False])
def test_matches_on_a_pattern_that_repeats_are_doubted(rows: bool) -> None:
    rng = np.random.default_rng(0)
    # Between the rows of plants hardly anything tells one from the next.
    look = 128 + 60 * np.sin(2 * np.pi * np.arange(240) / 24) if rows else np.zeros(240)
    scene = np.clip(look + rng.normal(0 if rows else 128, 4 if rows else 40, (160, 240)), 0, 255).astype(np.float32)
    y, x = (one.ravel() for one in np.mgrid[20:140:6, 90:220:6])
    left = np.stack([x, y], 1).astype(np.float32)
    images = Bundle({"image": scene}, {}), Bundle({"image": np.roll(scene, -10, axis=1)}, {})
    matches = Bundle({"left": left, "right": left - np.float32([10, 0])}, {})
    ports = {"left": [images[0]], "right": [images[1]], "orientations": [matches]}
    facts = repetition_stage.run(NoParams(), {}, ports).meta
    assert ("contradiction" in facts) == bool(facts.get("warnings")) == rows
    assert judge_repetition(facts["repeated"]).level == ("WARN" if rows else "OK")


@pytest.mark.parametrize("count", [0, 1, 7, 8, 30])
def test_pairs_of_few_matches_repeat_nothing(count: int) -> None:
    # All on one line, which determines no epipolar geometry.
    left = np.stack([np.arange(count), np.full(count, 15)], 1).astype(np.float32)
    image = Bundle({"image": np.zeros((30, 30), np.float32)}, {})
    ports = {"left": [image], "right": [image], "orientations": [Bundle({"left": left, "right": left}, {})]}
    assert repetition_stage.run(NoParams(), {}, ports).meta == {"repeated": 0.0}
