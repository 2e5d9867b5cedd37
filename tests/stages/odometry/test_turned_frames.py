"""Rotation found in the images alone, in the stage against the flow itself."""

import numpy as np
import pytest
from test_motion import held, judge, run, taken

from rille.stages.geometry.geometry import rotation_exp
from rille.stages.odometry.displacements import Motion


def found_flow(out):
    return Motion.of(out)


@pytest.mark.parametrize("degrees", [30.0, -21.0])
def test_a_roll_is_found_and_undone(degrees):
    rotation = rotation_exp([0.0, 0.0, np.radians(degrees)])
    flow = held(rotation)
    out = run(*taken(flow))
    assert out.meta["turn_found_deg"] == pytest.approx(degrees, abs=2.0)
    share, wrong = judge(found_flow(out), flow)
    assert share > 0.85
    assert wrong < 0.03


def test_unrotated_and_blank_frames_stay_as_they_are_to_the_bit():
    a, b = taken(held(rotation_exp([0.0, 0.0, 0.05])))
    for pair in ((a, b), (np.full_like(a, 80), np.full_like(b, 80)), (a, np.full_like(b, 80))):
        never, ever = run(*pair, turn_below=0.0), run(*pair)
        assert ever.meta["turn_found_deg"] == 0.0
        for name, array in never.arrays.items():
            np.testing.assert_array_equal(array, ever[name])
