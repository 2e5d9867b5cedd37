"""Trajectory accuracy: evo as the oracle, claims against sampling, and cases by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.metrics import PoseRelation, StatisticsType
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation.accuracy import accuracy_stage, trajectory_accuracy
from rille.stages.evaluation.claims import nees
from rille.stages.geometry.geometry import rotation_exp
from rille.stages.geometry.rigid import by_frame


def walk(seed: int, n: int, step: float = 1.0, turn: float = 0.02) -> np.ndarray:
    """A drive with gentle turns, optical axes (z forward)."""
    rng = np.random.default_rng(seed)
    pose, poses = np.eye(4), []
    for _ in range(n):
        poses.append(pose[:3].copy())
        motion = np.eye(4)
        motion[:3, :3] = rotation_exp(rng.normal(scale=turn, size=3))
        motion[:3, 3] = [*rng.normal(scale=0.02 * step, size=2), step]
        pose = pose @ motion
    return np.array(poses)


def disturbed(poses: np.ndarray, seed: int, shift: float = 0.02, turn: float = 0.003) -> np.ndarray:
    """Another frame of reference, and an error that accumulates."""
    rng = np.random.default_rng(seed)
    drift = np.eye(4)
    drift[:3, :3] = rotation_exp([0.3, -0.2, 0.5])
    drift[:3, 3] = [3.0, -2.0, 0.7]
    out = []
    for pose in poses:
        error = np.eye(4)
        error[:3, :3], error[:3, 3] = rotation_exp(rng.normal(scale=turn, size=3)), rng.normal(scale=shift, size=3)
        drift = drift @ error
        full = np.vstack([pose, [0, 0, 0, 1]])
        out.append((drift @ full)[:3])
    return np.array(out)


def evo_path(poses: np.ndarray) -> PosePath3D:
    return PosePath3D(poses_se3=[np.vstack([p, [0, 0, 0, 1]]) for p in poses])


def evo_value(metric: object, reference: PosePath3D, estimate: PosePath3D, kind: StatisticsType) -> float:
    metric.process_data((reference, estimate))  # type: ignore[attr-defined]
    return float(metric.get_statistic(kind))  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_ate_and_rpe_equal_evo(seed: int) -> None:
    true = walk(seed, 60)
    estimate = disturbed(true, seed)
    _, ours = trajectory_accuracy(estimate, true)
    reference, aligned, first = evo_path(true), evo_path(estimate), evo_path(estimate)
    aligned.align(reference)
    first.align_origin(reference)
    ape = evo_metrics.APE(PoseRelation.translation_part)
    shift, turn = (
        evo_metrics.RPE(kind, delta=1, delta_unit=evo_metrics.Unit.frames)
        for kind in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
    )
    rmse = StatisticsType.rmse
    expected = {
        "ate_rmse": evo_value(ape, reference, aligned, rmse),
        "rpe_translation_rmse": evo_value(shift, reference, evo_path(estimate), rmse),
        "rpe_rotation_rmse": evo_value(turn, reference, evo_path(estimate), rmse),
        "path_length": reference.path_length,
    }
    assert {name: ours[name]["value"] for name in expected} == pytest.approx(expected, rel=1e-9, abs=1e-9)
    end = np.linalg.norm(first.positions_xyz[-1] - reference.positions_xyz[-1])
    assert ours["final_error"]["value"] == pytest.approx(end, abs=1e-9)
    assert ours["drift"]["value"] == pytest.approx(100 * end / reference.path_length, abs=1e-9)


def test_two_frames_by_hand() -> None:
    """One step of 3 m along y in truth, of (0, 3.3, 0.4) m in the estimate: error 0.5 m, drift 16.7 %."""
    true = np.stack([np.eye(3, 4), np.eye(3, 4)])
    true[1, :, 3] = [0.0, 3.0, 0.0]
    estimate = true.copy()
    estimate[1, :, 3] = [0.0, 3.3, 0.4]
    _, ours = trajectory_accuracy(estimate, true)
    value = {name: m["value"] for name, m in ours.items()}
    assert value["final_error"] == pytest.approx(0.5)
    assert value["drift"] == pytest.approx(100 / 6)
    assert value["rpe_translation_rmse"] == pytest.approx(0.5)
    # the best alignment turns one line onto the other: half the difference in length at each end
    assert value["ate_rmse"] == pytest.approx((math.hypot(3.3, 0.4) - 3.0) / 2)


def test_truth_in_another_frame_of_reference_changes_nothing() -> None:
    true = walk(7, 30)
    estimate = disturbed(true, 8)
    turn = Rotation.from_rotvec([0.4, 1.0, -2.0]).as_matrix()
    moved = turn @ true
    moved[:, :, 3] += [10.0, -20.0, 5.0]
    a, b = trajectory_accuracy(estimate, true), trajectory_accuracy(estimate, moved)
    np.testing.assert_allclose(a[0]["position_truth"], b[0]["position_truth"], atol=1e-12)
    for name in a[1]:
        assert a[1][name]["value"] == pytest.approx(b[1][name]["value"], abs=1e-9)


def test_missing_frames_are_counted_and_bridged() -> None:
    true = walk(1, 20)
    estimate = true.copy()
    estimate[[0, 7, 19]] = np.nan
    _, ours = trajectory_accuracy(estimate, true)
    assert ours["frames_missing"]["value"] == 3
    assert ours["path_length"]["value"] == pytest.approx(
        np.linalg.norm(np.diff(true[1:19, :, 3], axis=0), axis=1).sum()
    )
    assert ours["drift"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert "15 pairs" in ours["rpe_translation_rmse"]["how"]


def test_a_camera_at_rest_has_no_drift_figure() -> None:
    true = np.tile(np.eye(3, 4), (4, 1, 1))
    _, ours = trajectory_accuracy(true, true)
    assert ours["drift"]["value"] is None
    assert "did not move" in ours["drift"]["how"]


def test_the_stage_matches_frames_by_number() -> None:
    true = walk(3, 6)
    known = {"truth": true.reshape(6, 12).tolist(), "frames": [4, 5, 6, 7, 8, 9]}
    one = {"piece": np.zeros(4, np.int16)}
    trajectory = Bundle({"poses": true[[0, 1, 2, 4]]} | one, {"frames": [4, 5, 6, 8], "main": 0})
    out = accuracy_stage.run(NoParams(), known, {"trajectory": trajectory})
    check_outputs(accuracy_stage, out)
    assert out.meta["metrics"]["frames_missing"]["value"] == 2
    assert out.meta["metrics"]["ate_rmse"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(by_frame(true, [0, 1, 2, 3, 4, 5], [5, 6])[1]).all()


def test_gaps_in_truth_are_counted_left_out_and_bridged() -> None:
    """What is left must be what evo says of the frames that have both."""
    true = walk(5, 40)
    estimate = disturbed(true, 5)
    gappy = true.copy()
    gappy[[0, 10, 11, 12, 39]] = np.nan
    estimate[20] = np.nan
    arrays, ours = trajectory_accuracy(estimate, gappy)
    value = {name: m["value"] for name, m in ours.items()}
    assert (value["frames"], value["frames_missing"], value["frames_without_truth"], value["frames_judged"]) == (
        40,
        1,
        5,
        34,
    )
    rows = [k for k in range(1, 39) if k not in (10, 11, 12, 20)]
    reference, aligned = evo_path(true[rows]), evo_path(estimate[rows])
    aligned.align(reference)
    ape = evo_metrics.APE(PoseRelation.translation_part)
    assert value["ate_rmse"] == pytest.approx(evo_value(ape, reference, aligned, StatisticsType.rmse), rel=1e-9)
    # frame 20 has truth: only frames 10-12 are bridged by a straight line
    steps = np.linalg.norm(np.diff(np.delete(true[1:39, :, 3], [9, 10, 11], axis=0), axis=0), axis=1)
    assert value["path_length"] == pytest.approx(steps.sum())
    assert "31 pairs" in ours["rpe_translation_rmse"]["how"]
    assert np.isnan(arrays["position_truth"][[0, 10, 39]]).all()
    assert np.isfinite(arrays["position"][[0, 10, 39]]).all()


def test_truth_with_gaps_and_a_trajectory_without_poses_as_artifacts() -> None:
    true = walk(3, 4)
    poses = [None if k == 2 else p.reshape(12).tolist() for k, p in enumerate(true)]
    lost = {"poses": np.full((4, 3, 4), np.nan), "piece": np.full(4, -1, np.int16)}
    nothing = Bundle(lost, {"frames": [4, 5, 6, 7], "main": 0})
    out = accuracy_stage.run(NoParams(), {"truth": poses, "frames": [4, 5, 6, 7]}, {"trajectory": nothing})
    check_outputs(accuracy_stage, out)
    value = {name: m["value"] for name, m in out.meta["metrics"].items()}
    counts = {"frames": 4, "frames_missing": 4, "frames_without_truth": 1, "frames_judged": 0}
    assert value == counts | {"drift": None}


def test_one_frame_with_pose_and_truth_has_no_errors() -> None:
    true = walk(1, 9)
    one = np.full_like(true, np.nan)
    one[4] = true[4]
    _, ours = trajectory_accuracy(disturbed(true, 1), one)
    assert ours["frames_judged"]["value"] == 1
    assert [name for name in ours if not name.startswith("frames")] == ["drift"]
    assert "fewer than two frames" in ours["drift"]["how"]


def test_the_length_is_that_of_the_frames_with_truth() -> None:
    true = walk(1, 9)
    half = true.copy()
    half[5:] = np.nan
    length = trajectory_accuracy(true, half)[1]["path_length"]
    assert length["value"] == pytest.approx(np.linalg.norm(np.diff(true[:5, :, 3], axis=0), axis=1).sum())


def straight(n: int = 41) -> np.ndarray:
    poses = np.tile(np.eye(3, 4), (n, 1, 1))
    poses[:, 2, 3] = np.arange(n) * 0.5
    return poses


def test_a_scale_of_a_percent_is_a_percent() -> None:
    true, rest = straight(), np.tile(np.eye(3, 4), (10, 1, 1))
    figure = trajectory_accuracy(true * [1.0, 1.0, 1.0, 1.01], true)[1]["scale_error"]
    assert figure["value"] == pytest.approx(1.0)
    assert trajectory_accuracy(rest, rest)[1]["scale_error"]["value"] is None
    rng, noisy = np.random.default_rng(1), true.copy()
    noisy[:, :, 3] += np.cumsum(rng.normal(scale=0.01, size=(41, 3)), axis=0)
    how = trajectory_accuracy(noisy, true)[1]["scale_error"]["how"]
    assert float(how.partition("+- ")[2].split(";")[0]) == pytest.approx(100 * 0.01 / (0.5 * 40**0.5), rel=0.15)


def test_right_claims_give_one_and_halved_deviations_four() -> None:
    rng = np.random.default_rng(2)
    n = 3000
    base = rng.normal(size=(6, 6))
    claimed = 1e-4 * (base @ base.T + np.eye(6))
    errors = rng.multivariate_normal(np.zeros(6), claimed, n)
    estimate, true = np.tile(np.eye(3, 4), (n, 1, 1)), np.tile(np.eye(3, 4), (n, 1, 1))
    estimate[:, :, :3] = true[:, :, :3] = rotation_exp([0.3, -1.0, 2.0])  # errors are of the world's axes
    true[1:, :, 3] = errors[1:, :3]
    true[1:, :, :3] = [rotation_exp(e) @ true[0, :, :3] for e in errors[1:, 3:]]
    covariance = np.tile(claimed, (n, 1, 1))
    covariance[0] = 0.0
    value = nees(estimate, true, covariance)["nees"]
    assert value == pytest.approx(1.0, abs=5 * (2 / 6 / n) ** 0.5)
    assert nees(estimate, true, covariance / 4)["nees"] == pytest.approx(4 * value)
    # Rotations claimed ten times too exactly: that is said of them alone.
    small = np.diag([1.0] * 3 + [0.1] * 3)
    figures = trajectory_accuracy(estimate, true, small @ covariance @ small)[1]
    assert figures["nees_position"]["value"] == pytest.approx(1.0, rel=0.1)
    assert figures["nees_rotation"]["value"] == pytest.approx(100.0, rel=0.1)


def test_errors_that_the_truth_states_are_not_held_against_the_claims() -> None:
    """An exact estimate against a truth with errors: the first pose's turn moves whatever lies far from it."""
    rng, true, values = np.random.default_rng(3), straight(20), []
    shift, turn = 0.02, 0.002
    for _ in range(300):
        errors = rng.normal(size=(20, 6)) * np.repeat([shift, turn], 3)
        measured = true.copy()
        measured[:, :, :3] = rotation_exp(errors[:, 3:]) @ true[:, :, :3]
        measured[:, :, 3] += errors[:, :3]
        figures = trajectory_accuracy(true, measured, np.tile(1e-12 * np.eye(6), (20, 1, 1)), shift, turn)[1]
        values.append([figures[name]["value"] for name in ("nees", "nees_position", "nees_rotation")])
        assert "0.02 m and 0.114592 degrees" in figures["nees"]["how"]
    np.testing.assert_allclose(np.mean(values, axis=0), 1.0, atol=0.1)


def test_covariances_reach_the_figures() -> None:
    true = walk(5, 12)
    _, figures = trajectory_accuracy(true, true, np.tile(1e-6 * np.eye(6), (12, 1, 1)))
    assert figures["nees"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert "nees" not in trajectory_accuracy(true, true)[1]


def test_why_claims_are_not_judged_is_said() -> None:
    poses, claimed = straight(5), np.tile(np.eye(6), (5, 1, 1))
    late, singular = poses.copy(), claimed.copy()
    late[0] = np.nan
    singular[3, 5, 5] = 0.0
    assert "the first posed frame" in nees(poses, late, claimed)["nees"]
    assert "the first posed frame" in nees(poses[:1], poses[:1], claimed[:1])["nees"]
    figure = trajectory_accuracy(poses, late, claimed, 0.1, 0.01)[1]["nees"]
    assert figure["value"] is None
    assert "the first posed frame" in figure["how"]
    assert "singular" in nees(poses, poses, singular)["nees"]
