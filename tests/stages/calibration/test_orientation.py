"""Thinning of dense matches, and the orientation of one pair from its disparity."""

from __future__ import annotations

import json

import numpy as np
import pytest
from raising import raises
from rig_scenes import knocked, matches, street_depth, street_rig
from terrain_scenes import box, disparity, nearest, pitched, plane, smooth_noise, toed_in_rig

from rille.stages.calibration import orientation
from rille.stages.calibration.orientation import OrientationParams, orient, thin
from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Rig, RigidTransform


def test_thin_takes_the_best_match_of_each_cell():
    usable = np.ones((4, 6), bool)
    usable[:, 4:] = False
    usable[3, 4] = True
    quality = np.full((4, 6), 0.5)
    quality[1, 0], quality[0, 3], quality[0, 0] = 0.1, 0.2, np.nan
    column, row = np.full((4, 6), -7.0, np.float32), np.full((4, 6), 0.25, np.float32)
    left, right = thin(column, row, usable, quality, 6)  # cells of 2 x 2
    # ties go to the first in reading order
    assert left.tolist() == [[0, 1], [3, 0], [0, 2], [2, 2], [4, 3]]
    np.testing.assert_allclose(right - left, [[-7.0, 0.25]] * 5)


def test_thin_of_nothing():
    nothing = np.zeros((20, 20))
    left, right = thin(nothing, nothing, np.zeros((20, 20), bool), nothing, 100)
    assert left.shape == right.shape == (0, 2)


def test_too_few_matches_say_so():
    m = matches(street_rig(), street_depth, samples=30)
    weight, facts = orient(street_rig(), m)
    assert "fewer" in facts["words"]
    assert len(weight) == len(m.left)


def test_figures_of_a_knock():
    m = matches(knocked(street_rig(), pitch_deg=-0.24, roll_deg=0.3), street_depth, outliers=0.1)
    _, facts = orient(street_rig(), m)
    assert facts["roll_deg"] == pytest.approx(0.3, abs=0.01)
    # what lies above the image's middle is sampled less: the offset is that of the matches
    assert facts["row_offset"] == pytest.approx(3.0, abs=0.4)
    assert facts["residual_after_px"] < 0.3 < 1.0 < facts["residual_before_px"]


def scene(true: Rig):
    """Dense disparity of a floor and a box, with correlated noise of a tenth of a pixel, as a matcher gives it."""
    world = nearest(plane(0.0, 0.0, -0.5), box((-0.4, 1.0, -0.5), (0.3, 1.4, -0.2)))
    u, v, seen = disparity(true, pitched(25.0), world)
    rng = np.random.default_rng(4)
    u, v = (d + smooth_noise(d.shape, 0.1, rng) for d in (u, v))
    return Bundle(
        {
            "column_disparity": u.astype(np.float32),
            "row_disparity": v.astype(np.float32),
            "validity": np.where(seen, Validity.MATCHED, Validity.BACKMATCH_FAILED).astype(np.uint8),
            "backmatch_error": rng.random(u.shape).astype(np.float32),
        },
        {},
    )


def run(rig: Rig, found: Bundle, **params):
    image = Bundle({"image": np.random.default_rng(1).normal(128, 40, found["validity"].shape)}, {})
    ports = {"disparity": found, "left": image, "right": image}
    return orientation.orientation_stage.run(OrientationParams(**params), {"pair": 7, "rig": rig.to_dict()}, ports)


def test_stage_on_a_dense_disparity():
    rig = toed_in_rig()
    out = run(rig, scene(knocked(rig, pitch_deg=0.4, roll_deg=-0.5)))
    check_outputs(orientation.orientation_stage, out)
    json.dumps(out.meta, allow_nan=False)
    assert out.meta["roll_deg"] == pytest.approx(-0.5, abs=0.03)
    assert (out["weight"] > 0).mean() > 0.9
    assert out.meta["residual_after_px"] < 0.2 < out.meta["residual_before_px"]
    assert out.meta["pair"] == 7
    again = run(rig, scene(knocked(rig, pitch_deg=0.4, roll_deg=-0.5)))
    assert all(again[name].tobytes() == out[name].tobytes() for name in out.arrays)
    assert again.meta == out.meta


def test_matches_that_nothing_matched_back_have_no_say():
    rig = toed_in_rig()
    given, other = scene(knocked(rig, pitch_deg=0.4)), scene(knocked(rig, pitch_deg=0.4))
    part = np.s_[: given["validity"].shape[0] // 2]
    other["backmatch_error"][part] = np.nan
    other["row_disparity"][part] += 40
    whole, half = run(rig, given), run(rig, other)
    assert half.meta["residual_after_px"] == pytest.approx(whole.meta["residual_after_px"], rel=0.2)
    assert half["left"][:, 1].min() >= part.stop


def test_nothing_matched_is_no_failure():
    rig = toed_in_rig()
    found = scene(rig)
    none = Bundle({**found.arrays, "validity": np.zeros_like(found["validity"])}, {})
    out = run(rig, none)
    check_outputs(orientation.orientation_stage, out)
    assert out.meta["matches"] == 0


def test_wrong_inputs_are_named():
    rig = toed_in_rig()
    with raises("RIL-377"):
        run(Rig(rig.left, rig.right, RigidTransform.identity()), scene(rig))
    with raises("RIL-376"):
        run(street_rig(), scene(rig))
