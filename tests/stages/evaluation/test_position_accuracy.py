"""Truth of positions alone: offset and turn of synthetic drives are found, and what cannot be found is said."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation.position_accuracy import position_accuracy, position_accuracy_stage
from rille.stages.evaluation.reading.clock import TruePositions, find_offset
from rille.stages.geometry.rigid import fit_rigid

RATE = 10.0
MOMENTS = np.arange(80) / RATE


def drive(t: np.ndarray) -> np.ndarray:
    """Places (n, 3), m, at times t, s, of a street with bends, a hill and a speed that changes."""
    s = 5.0 * t + 3.0 * np.sin(0.9 * t)
    heading = 0.4 * np.sin(0.1 * s)
    step = np.diff(s, prepend=s[0])
    return np.stack(
        [np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading)), 0.3 * np.sin(0.2 * s)], axis=1
    )


def elsewhere(points: np.ndarray, turn: float) -> np.ndarray:
    """The same in a frame turned about the vertical and shifted far away."""
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [4.5e5, 5.4e6, 120.0]


FINE = np.arange(-20.0, 30.0, 0.01)
PATH = drive(FINE)


def at(moments: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(moments, FINE, axis) for axis in PATH.T], axis=1)


def cameras(places: np.ndarray, rotations: np.ndarray | None = None) -> np.ndarray:
    """Poses (frame, 3, 4), by default of cameras that do not turn."""
    R = np.tile(np.eye(3), (len(places), 1, 1)) if rotations is None else rotations
    return np.concatenate([R, places[:, :, None]], axis=2)


def truth(width: int, offset: float, turn: float = 2.0, start: float = -2.0, end: float = 10.0) -> TruePositions:
    """Recorded 20 times a second by a clock that is ``offset`` s behind."""
    moments = np.arange(start, end, 0.05)
    return TruePositions(elsewhere(at(moments), turn)[:, :width], moments - offset, 0.2)


@pytest.mark.parametrize("width", [2, 3])
@pytest.mark.parametrize("offset", [0.7, -1.33, 1.4e9])
def test_offset_and_turn_are_found(width, offset):
    moved, metrics, warnings, _ = position_accuracy(cameras(at(MOMENTS)), truth(width, offset), MOMENTS)
    assert metrics["time_offset"]["value"] == pytest.approx(offset, abs=2e-3)
    assert metrics["position_rmse"]["value"] < 0.01  # chords of rows .05 s apart
    assert metrics["frames_judged"]["value"] == len(MOMENTS)
    assert np.abs(moved - at(MOMENTS)[:, :width]).max() < 0.03
    assert warnings == []


def test_noise_widens_the_range_of_the_offset_and_is_the_error():
    rng = np.random.default_rng(3)
    noisy = at(MOMENTS) + rng.normal(scale=0.2, size=(len(MOMENTS), 3))
    _, metrics, _, _ = position_accuracy(cameras(noisy), truth(2, 0.7), MOMENTS)
    # two axes of .2 m; the fit takes 4 of 160 degrees of freedom
    assert metrics["position_rmse"]["value"] == pytest.approx(0.2 * np.sqrt(2), rel=0.15)
    assert metrics["time_offset"]["value"] == pytest.approx(0.7, abs=0.1)
    assert 0.01 < metrics["time_offset_range"]["value"] < 0.5


def test_an_offset_of_less_than_half_a_frame_is_found():
    _, metrics, _, _ = position_accuracy(cameras(at(MOMENTS)), truth(2, 0.03), MOMENTS)
    assert metrics["time_offset"]["value"] == pytest.approx(0.03, abs=0.01)


def test_an_error_of_scale_stays_an_error():
    _, metrics, _, _ = position_accuracy(cameras(1.05 * at(MOMENTS)), truth(2, 0.7), MOMENTS)
    assert metrics["position_rmse"]["value"] > 0.3
    assert metrics["position_drift"]["value"] == pytest.approx(5.0, rel=0.2)


def test_a_straight_line_at_constant_speed_determines_no_offset():
    line = np.stack([8.0 * MOMENTS, 0 * MOMENTS, 0 * MOMENTS], axis=1)
    moments = np.arange(-5.0, 15.0, 0.1)
    known = TruePositions(np.stack([8.0 * moments, 0 * moments], axis=1), moments, 0.2)
    noisy = line + np.random.default_rng(0).normal(scale=0.01, size=line.shape)
    _, metrics, warnings, _ = position_accuracy(cameras(noisy), known, MOMENTS)
    assert metrics["time_offset"]["value"] == 0.0
    (warning,) = warnings
    assert "not determined" in warning
    assert "not determined" in metrics["time_offset"]["how"]
    _, metrics, _, _ = position_accuracy(cameras(at(MOMENTS)), truth(2, 0.7), MOMENTS)
    assert "not determined" not in metrics["time_offset"]["how"]


def test_rows_are_frames_where_there_are_no_times():
    places = elsewhere(at(MOMENTS), 1.0)[:, :2]
    estimate = at(MOMENTS)
    estimate[5] = np.nan
    moved, metrics, _, _ = position_accuracy(cameras(estimate), TruePositions(places))
    assert metrics["frames_judged"]["value"] == len(MOMENTS) - 1
    assert metrics["position_max"]["value"] < 1e-6
    assert "time_offset" not in metrics
    assert moved[5] == pytest.approx(at(MOMENTS)[5, :2], abs=1e-6)


def test_mirrored_axes_are_said():
    places = elsewhere(at(MOMENTS), 1.0)[:, [1, 0]]
    _, _, warnings, _ = position_accuracy(cameras(at(MOMENTS)), TruePositions(places))
    (warning,) = warnings
    assert "mirrored" in warning


def test_axes_of_a_camera_are_said():
    right, ahead, up = elsewhere(at(MOMENTS), 1.0).T
    _, _, warnings, _ = position_accuracy(cameras(at(MOMENTS)), TruePositions(np.stack([right, -up, ahead], axis=1)))
    (warning,) = warnings
    assert 'y = "z"' in warning
    assert position_accuracy(cameras(at(MOMENTS)), TruePositions(np.stack([right, ahead, up], axis=1)))[2] == []


def test_height_is_shifted_and_never_tilted():
    places = at(MOMENTS)
    tilted = places.copy()
    tilted[:, 2] += 0.1 * places[:, 0]
    assert fit_rigid(places, tilted).error > 0.5
    assert fit_rigid(places, places + np.array([0, 0, 7.0])).error < 1e-9


def test_first_and_last_moments_may_miss_the_rows_by_a_rounding():
    known = TruePositions(np.array([[0.0, 0.0], [1.0, 2.0]]), np.array([5.0, 5.2]), 0.2)
    found = known.at(np.array([5.0 - 5e-7, 5.2 + 5e-7, 5.0 - 5e-6, 5.2 + 5e-6]))
    np.testing.assert_allclose(found[:2], known.positions)
    assert np.isnan(found[2:]).all()


def test_gaps_and_few_frames():
    known = truth(2, 0.0)
    rows = (known.times < 2.0) | (known.times > 3.0)
    gap = TruePositions(known.positions[rows], known.times[rows], 0.2)
    there = gap.at(MOMENTS)
    assert np.isnan(there[(MOMENTS > 2.0) & (MOMENTS < 3.0)]).all()
    few = np.full((len(MOMENTS), 3), np.nan)
    few[:3] = at(MOMENTS)[:3]
    assert find_offset(MOMENTS, few, known) is None
    _, metrics, _, _ = position_accuracy(cameras(few), known, MOMENTS)
    assert metrics["position_rmse"]["value"] is None
    assert metrics["frames_judged"]["value"] == 3


def test_stage():
    poses = cameras(at(MOMENTS))
    known = truth(2, 0.7)
    frames = list(range(len(MOMENTS)))
    rows = {"positions": known.positions.tolist(), "times": known.times.tolist(), "max_gap": 0.2, "lever_arm": None}
    args = {"truth": rows, "moments": MOMENTS.tolist(), "frames": frames}
    out = position_accuracy_stage.run(
        NoParams(),
        args,
        {
            "trajectory": Bundle(
                {"poses": poses, "piece": np.zeros(len(poses), np.int16)},
                {"frames": frames, "verticals": ["attitude"], "main": 0},
            )
        },
    )
    check_outputs(position_accuracy_stage, out)
    assert np.isnan(out["position_truth"][:, 2]).all()
    assert "positions only" in out.meta["metrics"]["position_rmse"]["how"]


@pytest.mark.parametrize("apart", [21.0, 60.0])
def test_images_that_are_farther_apart_than_any_offset_that_is_searched(apart: float) -> None:
    moments = apart * np.arange(12)
    places = np.stack([0.01 * moments, np.sin(moments), np.zeros(12)], axis=1)
    _, metrics, _, _ = position_accuracy(cameras(places), TruePositions(places[:, :2], moments, 2.0 * apart), moments)
    assert metrics["position_rmse"]["value"] == pytest.approx(0.0, abs=1e-9)


def test_a_row_itself_is_known_whatever_gap_lies_before_it():
    times = np.array([0.0, 3.0, 3.1, 6.0])
    rows = TruePositions(np.stack([times, times], axis=1), times, 0.5)
    there = rows.at(np.array([0.0, 1.0, 3.0, 3.05, 5.0, 6.0]))[:, 0]
    np.testing.assert_allclose(there, [0.0, np.nan, 3.0, 3.05, np.nan, 6.0])


def test_the_true_way_leads_on_where_poses_were_lost_and_straight_where_truth_is():
    angle = np.linspace(0.0, np.pi, 101)
    half_circle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    lost = half_circle.copy()
    lost[5:-5] = np.nan
    length = position_accuracy(cameras(lost), TruePositions(half_circle))[1]["path_length"]
    assert length["value"] == pytest.approx(np.pi, rel=1e-3)
    length = position_accuracy(cameras(half_circle), TruePositions(lost))[1]["path_length"]
    assert length["value"] < 2.4


def test_truth_with_heights_is_fitted_in_space_where_the_vertical_was_not_measured():
    """The world is that of a camera which looks down by 20 degrees."""
    tilted = at(MOMENTS) @ Rotation.from_euler("x", 20, degrees=True).as_matrix().T
    _, level, _, _ = position_accuracy(cameras(tilted), truth(3, 0.7), MOMENTS)
    _, metrics, warnings, _ = position_accuracy(cameras(tilted), truth(3, 0.7), MOMENTS, upright=False)
    assert level["position_rmse"]["value"] > 0.5
    assert metrics["position_rmse"]["value"] < 0.01
    assert "in space" in metrics["position_rmse"]["how"]
    assert warnings == []


def test_positions_in_millimetres_are_said():
    _, _, warnings, _ = position_accuracy(cameras(at(MOMENTS)), TruePositions(1e3 * at(MOMENTS)))
    assert ["truth.unit = 0.001" in line for line in warnings] == [True]


LEVER = np.array([0.1, -0.12, 0.08])


def mounted(swing: float) -> tuple[np.ndarray, np.ndarray]:
    """R_world_left (frame, 3, 3) of a camera that swings by ``swing`` rad about all axes, and its antenna's places."""
    turns = swing * np.stack([np.sin(k * MOMENTS + k) for k in (1, 2, 3)], axis=1)
    R = Rotation.from_rotvec(turns).as_matrix() @ [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]
    return R, at(MOMENTS) + R @ LEVER


@pytest.mark.parametrize("offset", [0.0, 0.7])
def test_a_lever_arm_is_fitted_where_turns_show_it_and_said(offset):
    R, antenna = mounted(0.6)
    rows = TruePositions(elsewhere(antenna, 1.0), MOMENTS - offset, 0.2)
    without = position_accuracy(cameras(at(MOMENTS)), rows, MOMENTS)[1]
    moved, metrics, warnings, _ = position_accuracy(cameras(at(MOMENTS), R), rows, MOMENTS)
    assert without["position_rmse"]["value"] > 0.05
    assert metrics["position_rmse"]["value"] < 0.003
    assert moved == pytest.approx(at(MOMENTS), abs=0.01)  # the camera's places, not the antenna's
    (line,) = warnings
    assert "lever arm fitted" in line
    stated = np.array(json.loads(line[line.index("[") : line.index("]") + 1]))
    assert stated == pytest.approx(LEVER, abs=0.004)


def test_an_arm_ahead_is_told_from_a_clock():
    """Which both shift a drive along its way; found one after the other they share the error out."""
    moments = np.arange(60) / RATE
    heading, speed = 0.8 * np.sin(1.5 * moments), 5.0 + 2.5 * np.sin(2.0 * moments)
    turns = Rotation.from_euler("z", heading[:, None]).as_matrix()
    places = np.cumsum(speed[:, None] / RATE * turns[:, :, 1], axis=0)
    ahead = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    antenna = places + 0.4 * turns[:, :, 1]
    known = TruePositions(elsewhere(antenna, 1.0), moments)
    found = position_accuracy(cameras(places, turns @ ahead), known, moments)
    assert found.metrics["position_rmse"]["value"] < 0.02
    assert found.metrics["time_offset"]["value"] == pytest.approx(0.0, abs=0.01)


def test_a_stated_lever_arm_is_used_and_none_is_fitted_without_turns_or_to_what_is_no_lever_arm():
    R, antenna = mounted(0.6)
    rows = TruePositions(elsewhere(antenna, 1.0), lever_arm=LEVER)
    _, metrics, warnings, _ = position_accuracy(cameras(at(MOMENTS), R), rows)
    assert metrics["position_rmse"]["value"] < 1e-6
    assert warnings == []
    # An antenna on a camera that hardly turns is displaced, which the fit takes; a scale error is not an arm.
    for swing, scale in ((0.02, 1.0), (0.6, 1.05)):
        R, antenna = mounted(swing)
        places = TruePositions(elsewhere(antenna if scale == 1.0 else scale * at(MOMENTS), 1.0))
        _, metrics, warnings, _ = position_accuracy(cameras(at(MOMENTS), R), places)
        assert warnings == []
        assert metrics["position_rmse"]["value"] > 1e-3


def test_the_part_of_a_lever_arm_along_the_axis_of_all_turns_is_not_told():
    R = Rotation.from_euler("z", np.sin(MOMENTS)[:, None]).as_matrix() @ [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]
    _, metrics, (line,), _ = position_accuracy(cameras(at(MOMENTS), R), TruePositions(at(MOMENTS) + R @ LEVER))
    assert metrics["position_rmse"]["value"] < 1e-6
    assert "[0.1, 0, 0.08]" in line
    assert "along the axis of its turns" in line


@pytest.mark.parametrize("width", [2, 3])
@pytest.mark.parametrize("rows", [slice(30, None), slice(30, 31)], ids=["from there on", "one"])
def test_a_jump_is_named_with_its_row(width, rows):
    places = elsewhere(at(MOMENTS), 1.0)[:, :width]
    places[rows, 0] += 6.0
    noisy = at(MOMENTS) + 0.01 * np.random.default_rng(0).standard_normal((80, 3))
    [line] = position_accuracy(cameras(noisy), TruePositions(places)).warnings
    assert line.startswith("true positions jump by ")
    assert "after 30 of 80 of them" in line


@pytest.mark.parametrize("turned", [False, True])
def test_degrees_are_named_and_are_no_lever_arm(turned):
    # Seen from a point within, the turning camera stays where it is, but for degrees of less than a metre.
    R = Rotation.from_euler("z", 0.1 * np.arange(80)[:, None]).as_matrix()
    poses = cameras(R @ [2.0, 0.0, 0.0], R) if turned else cameras(at(MOMENTS))
    degrees = [11.0, 48.0, 500.0] + poses[:, :, 3] / [75000.0, 111000.0, 1.0]
    [line] = position_accuracy(poses, TruePositions(degrees)).warnings
    assert "as degrees of latitude and longitude" in line


@pytest.mark.parametrize("seed", range(3))
def test_positions_of_another_drive_are_said_not_to_fit(seed):
    other = np.cumsum(np.random.default_rng(seed).standard_normal((80, 3)), axis=0)
    [line] = position_accuracy(cameras(at(MOMENTS)), TruePositions(5.0 * other)).warnings
    assert "do not fit the trajectory" in line
    noise = 0.5 * np.random.default_rng(seed).standard_normal((80, 3))
    assert position_accuracy(cameras(at(MOMENTS)), TruePositions(at(MOMENTS) + noise)).warnings == []
