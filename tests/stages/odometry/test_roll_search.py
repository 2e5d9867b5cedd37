"""Rotation found in the images alone: fitted to known flows, and in the stage against the flow itself."""

import numpy as np
import pytest
from test_motion import CAMERA, held, judge, run, taken

from rille.stages.geometry.geometry import rotation_exp
from rille.stages.odometry import roll_search
from rille.stages.odometry.derotation import Derotation
from rille.stages.odometry.motion import Motion

SHAPE = (280, 400)


def flow_of(homography, level=3):
    y, x = np.indices((SHAPE[0] >> level, SHAPE[1] >> level), dtype=np.float64)
    x, y = ((i + 0.5) * 2**level - 0.5 for i in (x, y))
    p = np.einsum("ij,jrc->irc", homography, np.stack([x, y, np.ones_like(x)]))
    return (p[0] / p[2] - x).astype(np.float32), (p[1] / p[2] - y).astype(np.float32)


@pytest.mark.parametrize("degrees", [-170.0, -31.0, 0.0, 12.5, 90.0])
def test_rotation_and_scale_of_a_known_flow_with_a_fifth_of_outliers(degrees):
    u, v = flow_of(roll_search.similarity(degrees, 1.15, SHAPE))
    rng = np.random.default_rng(3)
    wrong = rng.random(u.shape) < 0.2
    u[wrong] += rng.uniform(-80, 80, wrong.sum())
    v[wrong] += rng.uniform(-80, 80, wrong.sum())
    found, scale = roll_search.fit(u, v, np.ones(u.shape, bool), 3)
    assert abs((found - degrees + 180) % 360 - 180) < 2.0
    assert scale == pytest.approx(1.15, rel=0.03)


def test_a_similarity_holds_the_centre_and_says_what_remains_after_another():
    h = roll_search.similarity(25.0, 1.2, SHAPE)
    np.testing.assert_allclose(h @ [199.5, 139.5, 1.0], [199.5, 139.5, 1.0])
    rest, scale = roll_search.relative((30.0, 1.2), h, SHAPE)
    assert rest == pytest.approx(5.0)
    assert scale == pytest.approx(1.0)


def test_too_few_matches_say_nothing():
    u, v = flow_of(np.eye(3))
    few = np.zeros(u.shape, bool)
    few[0, :20] = True
    assert roll_search.fit(u, v, few, 3) is None


def found_flow(out):
    return Motion(out.meta["level"], out["column_disparity"], out["row_disparity"], out["validity"])


@pytest.mark.parametrize("degrees", [30.0, -21.0])
def test_a_roll_that_nobody_told_of_is_found_and_undone(degrees):
    rotation = rotation_exp([0.0, 0.0, np.radians(degrees)])
    flow = held(rotation)
    out = run(*taken(flow))
    assert out.meta["turn_found_deg"] == pytest.approx(degrees, abs=2.0)
    share, wrong = judge(found_flow(out), flow)
    assert share > 0.85
    assert wrong < 0.03


def test_a_wrong_attitude_is_put_right():
    rotation = rotation_exp([0.0, 0.0, np.radians(30.0)])
    flow = held(rotation)
    told = rotation_exp([0.0, 0.0, np.radians(-10.0)])
    out = run(*taken(flow), args={"rotation": told.tolist(), "camera": CAMERA.to_dict()})
    assert out.meta["turn_found_deg"] == pytest.approx(40.0, abs=2.0)
    assert judge(found_flow(out), flow)[0] > 0.85
    assert Derotation.of(told, CAMERA).reach > 8


def test_unrotated_and_blank_frames_stay_as_they_are_to_the_bit():
    a, b = taken(held(rotation_exp([0.0, 0.0, 0.05])))
    for pair in ((a, b), (np.full_like(a, 80), np.full_like(b, 80)), (a, np.full_like(b, 80))):
        never, ever = run(*pair, turn_below=0.0), run(*pair)
        assert ever.meta["turn_found_deg"] == 0.0
        for name, array in never.arrays.items():
            np.testing.assert_array_equal(array, ever[name])
