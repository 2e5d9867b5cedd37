"""Truth whose body is mounted otherwise than stated: the constant turn and shift are found, and nothing else is."""

from __future__ import annotations

import ast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams
from rille.stages.evaluation.accuracy import TruthSource, accuracy_stage
from rille.stages.evaluation.reading.clock import TruePositions
from rille.stages.evaluation.reading.hand_eye import hand_eye
from rille.stages.geometry import rigid
from rille.stages.geometry.geometry import RigidTransform

OFF = np.column_stack([Rotation.from_rotvec([0.02, -0.06, 0.03]).as_matrix(), [0.04, -0.02, 0.03]])
"""What the mounting does not say: 4 degrees and 54 mm."""


def flight(seed: int, turn: float = 0.15, frames: int = 30) -> Floats:
    """T_world_left (frame, 3, 4) of 10 m, turned by some ``turn`` radians from frame to frame."""
    rng = np.random.default_rng(seed)
    angles = np.cumsum(rng.normal(0.0, turn, (frames, 3)), axis=0)
    R = Rotation.from_rotvec(angles).as_matrix()
    return np.concatenate([R, np.cumsum(R @ [0.02, 0.03, 0.3], axis=0)[:, :, None]], axis=2)


def estimated(true: Floats, seed: int) -> Floats:
    """With errors of a millimetre and .05 degrees a frame, which add up."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.001, (len(true), 3)), axis=0)).as_matrix() @ true[:, :, :3]
    off = np.cumsum(rng.normal(0.0, 0.001, (len(true), 3)), axis=0)
    return np.concatenate([R, (true[:, :, 3] + off)[:, :, None]], axis=2)


@pytest.mark.parametrize("seed", range(4))
def test_a_constant_turn_and_shift_are_found(seed: int) -> None:
    true = flight(seed)
    found = hand_eye(estimated(true, seed), rigid.compose(true, rigid.inverse(OFF)))
    assert found is not None
    assert float(rigid.angle(rigid.compose(rigid.inverse(OFF), found))) < 0.006
    np.testing.assert_allclose(found[:, 3], OFF[:, 3], atol=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_the_estimate_are_no_turn_of_the_truth(seed: int) -> None:
    true = flight(seed)
    assert hand_eye(estimated(true, seed), true) is None
    assert hand_eye(true, true) is None


def test_a_small_turn_of_a_straight_drive_is_not_told_from_the_camera() -> None:
    true = flight(1, turn=0.0)
    small = np.column_stack([Rotation.from_rotvec([0.0, 0.005, 0.0]).as_matrix(), np.zeros(3)])
    assert hand_eye(estimated(true, 1), rigid.compose(true, small)) is None


def test_it_is_judged_by_the_steps_that_the_relative_error_has() -> None:
    true = flight(3)
    given, estimate = rigid.compose(true, rigid.inverse(OFF)), estimated(true, 3)
    given[10:12] = np.nan
    p, q = rigid.steps(estimate, given)
    assert len(p) == len(q) == 9 + 17
    assert hand_eye(estimate, given) is not None
    # Truth of every second frame: a motion over two frames is no step.
    given[1::2] = np.nan
    assert hand_eye(estimate, given) is None


def test_figures_without_it_stand_beside_those_as_given() -> None:
    true = flight(7)
    poses = estimated(true, 7)
    frames = list(range(len(true)))
    covariance = np.tile(1e-5 * np.eye(6), (len(true), 1, 1))
    arrays = {"poses": poses, "covariance": covariance, "piece": np.zeros(len(poses), np.int16)}
    trajectory = Bundle(arrays, {"frames": frames, "main": 0})
    mount = RigidTransform(Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix(), np.array([0.1, 0.0, 0.0]))
    given = rigid.compose(true, rigid.inverse(OFF)).reshape(-1, 12).tolist()
    facts = accuracy_stage(NoParams(), trajectory, frames=frames, truth=given, source=TruthSource(mount)).meta
    value = {name: figure["value"] for name, figure in facts["metrics"].items()}
    assert value["hand_eye_turn"] == pytest.approx(4.0, abs=0.3)
    assert value["hand_eye_shift"] == pytest.approx(0.054, abs=0.01)
    assert value["ate_rmse"] > 1.5 * value["hand_eye_ate_rmse"]
    assert value["hand_eye_nees"] < 0.1 * value["nees"]
    [line] = facts["warnings"]
    assert line.startswith("the truth's body is turned by 3.85 degrees and shifted by 0.05")
    stated = np.array(ast.literal_eval(line.split("truth.T_body_left = ")[1]))
    np.testing.assert_allclose(stated, rigid.compose(mount.matrix34, OFF), atol=0.02)


def judged(estimate: Floats, true: Floats, record: Floats, offset: float, apart: float = 0.05) -> list[str]:
    """Warnings on an estimate by poses, and by the positions (n, 3) of their record every 0.05 s, which is late."""
    frames = list(range(len(true)))
    covariance, piece = np.tile(1e-5 * np.eye(6), (len(true), 1, 1)), np.zeros(len(true), np.int16)
    trajectory = Bundle({"poses": estimate, "covariance": covariance, "piece": piece}, {"frames": frames, "main": 0})
    positions = TruePositions(record, apart * np.arange(len(record)) + offset, 0.2 + 1e-9)
    source = TruthSource(record=positions, moments=[0.2 * frame for frame in frames])
    given = {"frames": frames, "truth": true.reshape(-1, 12).tolist(), "source": source}
    return accuracy_stage(NoParams(), trajectory, **given).meta.get("warnings", [])


def test_one_frame_with_pose_and_timed_truth_has_no_errors_to_explain() -> None:
    poses = circle()
    alone = np.where(np.arange(len(poses))[:, None, None] == 4, poses, np.nan)
    assert judged(alone, poses, poses[:, :, 3], 0.0) == []


@pytest.mark.parametrize("late", [0.0, 0.3, -0.25])
@pytest.mark.parametrize("arm", [0.0, 0.4])
def test_true_poses_of_a_late_clock_are_told_from_those_of_another_body(late: float, arm: float) -> None:
    # Once around a bend, every 0.05 s, seen ahead of the camera by an arm or not; four rows a frame.
    angles = 0.5 * np.sin(np.linspace(0.0, 9.0, 240))
    R = Rotation.from_euler("z", angles[:, None]).as_matrix()
    places = np.cumsum(R @ [0.06, 0.0, 0.0], axis=0) * (1.0 + 0.3 * np.sin(np.linspace(0.0, 5.0, 240)))[:, None]
    record = np.concatenate([R, (places + R @ [arm, 0.0, 0.0])[:, :, None]], axis=2)
    shifted = 20 - round(late / 0.05)
    poses = np.concatenate([R, places[:, :, None]], axis=2)[20:220:4]
    lines = judged(estimated(poses, 3), record[shifted : shifted + 200 : 4], record[:, :, 3], late - 1.0)
    if late and not arm:
        [line] = lines
        assert f"with {-late:.1f}" in line or f"with {-late:.2f}" in line, line
        assert "truth.time_offset" in line
    elif late == 0.0:
        assert not any("time_offset" in line for line in lines)


def circle() -> Floats:
    """Poses (14, 3, 4) on a circle of 30 m, whose plane the way leaves slowly."""
    R = Rotation.from_euler("z", 0.2 * np.arange(14)[:, None]).as_matrix()
    return np.concatenate([R, (R @ [0.0, -30.0, 0.0])[:, :, None] + 0.01 * np.arange(14)[:, None, None]], axis=2)


@pytest.mark.parametrize("seed", range(5))
def test_straight_lines_between_the_rows_of_the_truth_are_no_late_clock(seed: int) -> None:
    estimate = circle()
    estimate[:, :, 3] += 0.02 * np.random.default_rng(seed).normal(size=(14, 3))
    estimate[-1, :, 3] += 0.06  # of which a clock that is late by a frame knows nothing
    assert judged(estimate, circle(), circle()[:, :, 3], 0.0, 0.2) == []


def test_a_body_elsewhere_on_a_circle_is_named_as_that_and_not_as_three_mistakes_together() -> None:
    body = np.column_stack([[[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], [6.0, 1.0, -4.0]])
    given = rigid.compose(circle(), rigid.inverse(body))
    [line] = judged(circle(), given, given[:, :, 3], 0.0, 0.2)
    assert line.startswith("the truth's body is turned by 1")
