"""Trajectory accuracy: evo as the oracle, KITTI's development kit written out, and cases by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.metrics import PoseRelation, StatisticsType
from evo.core.trajectory import PosePath3D
from raising import raises
from scipy.spatial.transform import Rotation

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation import truth
from rille.stages.evaluation.accuracy import accuracy_stage, by_frame, trajectory_accuracy
from rille.stages.geometry.geometry import rotation_exp


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
    rmse, largest, median = StatisticsType.rmse, StatisticsType.max, StatisticsType.median
    expected = {
        "ate_rmse": evo_value(ape, reference, aligned, rmse),
        "ate_first_frame_rmse": evo_value(ape, reference, first, rmse),
        "ate_first_frame_max": evo_value(ape, reference, first, largest),
        "rpe_translation_rmse": evo_value(shift, reference, evo_path(estimate), rmse),
        "rpe_translation_median": evo_value(shift, reference, evo_path(estimate), median),
        "rpe_translation_max": evo_value(shift, reference, evo_path(estimate), largest),
        "rpe_rotation_rmse": evo_value(turn, reference, evo_path(estimate), rmse),
        "path_length": reference.path_length,
    }
    assert {name: ours[name]["value"] for name in expected} == pytest.approx(expected, rel=1e-9, abs=1e-9)
    end = np.linalg.norm(first.positions_xyz[-1] - reference.positions_xyz[-1])
    assert ours["final_error"]["value"] == pytest.approx(end, abs=1e-9)
    assert ours["drift"]["value"] == pytest.approx(100 * end / reference.path_length, abs=1e-9)


def devkit(true: list[np.ndarray], estimate: list[np.ndarray]) -> tuple[float, float]:
    """KITTI's ``evaluate_odometry.cpp``, line by line: mean translation (1) and rotation (rad/m) error."""
    dist = [0.0]
    for a, b in itertools.pairwise(true):
        dist.append(dist[-1] + float(np.linalg.norm(b[:3, 3] - a[:3, 3])))
    shifts, turns = [], []
    for first in range(0, len(true), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((i for i in range(first, len(dist)) if dist[i] > dist[first] + length), -1)
            if last == -1:
                continue
            delta_true = np.linalg.inv(true[first]) @ true[last]
            delta = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta) @ delta_true
            turns.append(math.acos(max(min(0.5 * (np.trace(error[:3, :3]) - 1), 1.0), -1.0)) / length)
            shifts.append(np.linalg.norm(error[:3, 3]) / length)
    return float(np.mean(shifts)), float(np.mean(turns))


def test_kitti_equals_the_development_kit() -> None:
    true = walk(4, 260)
    estimate = disturbed(true, 4)
    _, ours = trajectory_accuracy(estimate, true)
    shift, turn = devkit(*([np.vstack([p, [0, 0, 0, 1]]) for p in poses] for poses in (true, estimate)))
    assert ours["kitti_translation"]["value"] == pytest.approx(100 * shift, rel=1e-9)
    # acos near 1 loses half the digits: 1e-16 / angle, of angles near 0.05
    assert ours["kitti_rotation"]["value"] == pytest.approx(math.degrees(100 * turn), rel=1e-9)


def test_kitti_is_not_applicable_to_a_short_path() -> None:
    true = walk(0, 50)
    _, ours = trajectory_accuracy(true, true)
    assert ours["kitti_translation"]["value"] is None
    assert "not applicable" in ours["kitti_translation"]["how"]
    assert "49.0 m" in ours["kitti_translation"]["how"]
    straight = np.tile(np.eye(3, 4), (102, 1, 1))
    straight[:, 2, 3] = np.arange(102)
    # the development kit takes the first frame beyond 100 m, not the one at it
    assert trajectory_accuracy(straight[:101], straight[:101])[1]["kitti_translation"]["value"] is None
    assert trajectory_accuracy(straight, straight)[1]["kitti_translation"]["value"] == 0.0


def test_two_frames_by_hand() -> None:
    """One step of 3 m along y in truth, of (0, 3.3, 0.4) m in the estimate: error 0.5 m, drift 16.7 %."""
    true = np.stack([np.eye(3, 4), np.eye(3, 4)])
    true[1, :, 3] = [0.0, 3.0, 0.0]
    estimate = true.copy()
    estimate[1, :, 3] = [0.0, 3.3, 0.4]
    arrays, ours = trajectory_accuracy(estimate, true)
    value = {name: m["value"] for name, m in ours.items()}
    assert value["final_error"] == pytest.approx(0.5)
    assert value["drift"] == pytest.approx(100 / 6)
    assert value["rpe_translation_rmse"] == pytest.approx(0.5)
    assert value["displacement_x_rmse"] == 0.0
    assert value["displacement_y_rmse"] == pytest.approx(0.3)
    assert value["displacement_z_rmse"] == pytest.approx(0.4)
    # the best alignment turns one line onto the other: half the difference in length at each end
    assert value["ate_rmse"] == pytest.approx((math.hypot(3.3, 0.4) - 3.0) / 2)
    np.testing.assert_allclose(arrays["displacement_truth"], [[0.0, 3.0, 0.0]], atol=1e-12)


def test_truth_in_another_frame_of_reference_changes_nothing() -> None:
    true = walk(7, 30)
    estimate = disturbed(true, 8)
    turn = Rotation.from_rotvec([0.4, 1.0, -2.0]).as_matrix()
    moved = turn @ true
    moved[:, :, 3] += [10.0, -20.0, 5.0]
    a, b = trajectory_accuracy(estimate, true), trajectory_accuracy(estimate, moved)
    np.testing.assert_allclose(a[0]["displacement_truth"], b[0]["displacement_truth"], atol=1e-12)
    for name in a[1]:
        assert a[1][name]["value"] == pytest.approx(b[1][name]["value"], abs=1e-9)


def test_missing_frames_are_counted_and_bridged() -> None:
    true = walk(1, 20)
    estimate = true.copy()
    estimate[[0, 7, 19]] = np.nan
    arrays, ours = trajectory_accuracy(estimate, true)
    assert ours["frames_missing"]["value"] == 3
    assert ours["path_length"]["value"] == pytest.approx(
        np.linalg.norm(np.diff(true[1:19, :, 3], axis=0), axis=1).sum()
    )
    assert ours["drift"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert "15 pairs" in ours["rpe_translation_rmse"]["how"]
    assert np.isnan(arrays["displacement"][[0, 6, 7, 18]]).all()
    with raises("RIL-301"):
        trajectory_accuracy(np.full_like(true, np.nan), true)
    with raises("RIL-300"):
        trajectory_accuracy(true[1:], true)


def test_a_camera_at_rest_has_no_drift_figure() -> None:
    true = np.tile(np.eye(3, 4), (4, 1, 1))
    _, ours = trajectory_accuracy(true, true)
    assert ours["drift"]["value"] is None
    assert "did not move" in ours["drift"]["how"]


def test_the_stage_matches_frames_by_number() -> None:
    true = walk(3, 6)
    source = truth.truth_stage.run(
        NoParams(), {"poses": true.reshape(6, 12).tolist(), "frames": [4, 5, 6, 7, 8, 9]}, {}
    )
    check_outputs(truth.truth_stage, source)
    trajectory = Bundle({"poses": true[[0, 1, 2, 4]]}, {"frames": [4, 5, 6, 8]})
    out = accuracy_stage.run(NoParams(), {}, {"trajectory": trajectory, "truth": source})
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
    reference, aligned, first = evo_path(true[rows]), evo_path(estimate[rows]), evo_path(estimate[rows])
    aligned.align(reference)
    first.align_origin(reference)
    ape = evo_metrics.APE(PoseRelation.translation_part)
    rmse = StatisticsType.rmse
    assert value["ate_rmse"] == pytest.approx(evo_value(ape, reference, aligned, rmse), rel=1e-9)
    assert value["ate_first_frame_rmse"] == pytest.approx(evo_value(ape, reference, first, rmse), rel=1e-9)
    # frame 20 has truth: only frames 10-12 are bridged by a straight line
    steps = np.linalg.norm(np.diff(np.delete(true[1:39, :, 3], [9, 10, 11], axis=0), axis=0), axis=1)
    assert value["path_length"] == pytest.approx(steps.sum())
    assert "1 gap" in ours["path_length"]["how"]
    assert "1 gap" in ours["drift"]["how"]
    assert "31 pairs" in ours["rpe_translation_rmse"]["how"]
    assert np.isnan(arrays["position_truth"][[0, 10, 39]]).all()
    assert np.isfinite(arrays["position"][[0, 10, 39]]).all()
    with raises("RIL-302"):
        trajectory_accuracy(estimate, np.full_like(true, np.nan))


def test_kitti_sections_do_not_cross_a_gap_of_the_truth() -> None:
    """Sections start at frames 0, 10, 20 ... and 100 m end 101 frames on; a gap at frame 105 leaves 110 and later."""
    straight = np.tile(np.eye(3, 4), (240, 1, 1))
    straight[:, 2, 3] = np.arange(240)
    gappy = straight.copy()
    gappy[105] = np.nan
    full, some = (trajectory_accuracy(straight, t)[1]["kitti_translation"] for t in (straight, gappy))
    # 100 m from 0 ... 130, 200 m from 0 ... 30; with the gap 100 m from 0 and from 110, 120, 130
    assert "18 sections" in full["how"]
    assert "4 sections" in some["how"]
    assert some["value"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("lost", [1, 50, 100])
def test_a_kitti_section_has_truth_from_its_first_to_its_last_frame(lost: int) -> None:
    straight = np.tile(np.eye(3, 4), (102, 1, 1))
    straight[:, 2, 3] = np.arange(102.0)  # the only section ends at frame 101
    gappy = straight.copy()
    gappy[lost] = np.nan
    full, none = (trajectory_accuracy(straight, t)[1]["kitti_translation"]["value"] for t in (straight, gappy))
    assert (full, none) == (0.0, None)


def test_truth_with_gaps_and_a_trajectory_without_poses_as_artifacts() -> None:
    true = walk(3, 4)
    poses = [None if k == 2 else p.reshape(12).tolist() for k, p in enumerate(true)]
    source = truth.truth_stage.run(NoParams(), {"poses": poses, "frames": [4, 5, 6, 7]}, {})
    check_outputs(truth.truth_stage, source)
    assert source.meta["without_truth"] == [6]
    assert np.isnan(source["poses"][2]).all()
    nothing = Bundle({"poses": np.full((4, 3, 4), np.nan)}, {"frames": [4, 5, 6, 7]})
    out = accuracy_stage.run(NoParams(), {}, {"trajectory": nothing, "truth": source})
    check_outputs(accuracy_stage, out)
    value = {name: m["value"] for name, m in out.meta["metrics"].items()}
    assert value == {"frames": 4, "frames_missing": 4, "frames_without_truth": 1, "frames_judged": 0}


def test_shares_of_the_path_count_what_lies_between_poses_that_were_lost() -> None:
    """Out, lost on a way to the side and back, and on: an error of a metre is small against the 40 m of the detour."""
    line = np.concatenate([np.arange(11.0), np.full(40, 10.0), np.arange(10.0, 21.0)])
    aside = np.concatenate([np.zeros(11), np.arange(1.0, 21.0), np.arange(19.0, -1.0, -1.0), np.zeros(11)])
    true = np.tile(np.eye(3, 4), (len(line), 1, 1))
    true[:, 0, 3], true[:, 2, 3] = aside, line
    estimate = true.copy()
    estimate[11:51] = np.nan
    estimate[51:, 0, 3] += 1.0
    found = trajectory_accuracy(estimate, true)[1]
    assert found["path_length"]["value"] == pytest.approx(60.0)
    assert found["sections_translation"]["value"] < 100.0 / 40.0


def test_one_frame_with_pose_and_truth_has_no_errors_instead_of_none_at_all() -> None:
    true = walk(1, 9)
    one = np.full_like(true, np.nan)
    one[4] = true[4]
    _, ours = trajectory_accuracy(disturbed(true, 1), one)
    assert ours["frames_judged"]["value"] == 1
    judged = {name: m for name, m in ours.items() if not name.startswith("frames")}
    assert {"ate_rmse", "final_error", "path_length", "drift"} < judged.keys()
    assert all(m["value"] is None and "one frame alone" in m["how"] for m in judged.values())


def test_the_length_is_that_of_the_frames_with_truth() -> None:
    true = walk(1, 9)
    half = true.copy()
    half[5:] = np.nan
    length = trajectory_accuracy(true, half)[1]["path_length"]
    assert length["value"] == pytest.approx(np.linalg.norm(np.diff(true[:5, :, 3], axis=0), axis=1).sum())
    assert "to the last frame with pose and truth" in length["how"]
