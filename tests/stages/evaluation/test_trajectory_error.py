"""Errors by length with evo as the oracle, their causes put in by hand, and claims against sampling."""

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.metrics import PoseRelation, StatisticsType
from test_accuracy import disturbed, evo_path, evo_value, walk

from rille.stages.evaluation.accuracy import trajectory_accuracy
from rille.stages.evaluation.accuracy_parts import square
from rille.stages.evaluation.trajectory_error import _between, against_claims, by_cause, by_shares
from rille.stages.geometry.geometry import rotation_exp, rotation_log


@pytest.mark.parametrize("step", [2, 5, 20])
def test_relative_errors_over_several_frames_equal_evo(step):
    true = walk(4, 60)
    estimate = disturbed(true, 4)
    _, ours = trajectory_accuracy(estimate, true)
    for kind, name in ((PoseRelation.translation_part, "translation"), (PoseRelation.rotation_angle_deg, "rotation")):
        metric = evo_metrics.RPE(kind, delta=step, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        expected = evo_value(metric, evo_path(true), evo_path(estimate), StatisticsType.rmse)
        assert ours[f"rpe_{step}_{name}_rmse"]["value"] == pytest.approx(expected, rel=1e-9, abs=1e-9)


def straight(n=41):
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 2, 3] = np.arange(n) * 0.5
    return poses


def test_a_scale_of_a_percent_is_a_percent_of_every_section_and_of_nothing_else():
    true, estimate = straight(), straight()
    estimate[:, 2, 3] *= 1.01
    shares, causes = by_shares(estimate, true), by_cause(estimate, true)
    assert shares["sections_translation"]["value"] == pytest.approx(1.0)
    assert shares["sections_rotation"]["value"] == pytest.approx(0.0)
    assert causes["scale_error"]["value"] == pytest.approx(1.0)
    assert "chance" not in causes["scale_error"]["how"]
    for name in ("direction_error", "rotation_bias", "scatter"):
        assert causes[name]["value"] == pytest.approx(0.0, abs=1e-9)


def test_a_turned_mount_and_a_steady_turn_are_told_apart():
    true = straight()
    tilt = np.eye(4)
    tilt[:3, :3] = rotation_exp([0.0, np.radians(2.0), 0.0])
    mounted = by_cause(np.linalg.inv(tilt) @ true @ tilt, true)
    assert mounted["direction_error"]["value"] == pytest.approx(2.0)
    assert mounted["rotation_bias"]["value"] == pytest.approx(0.0, abs=1e-9)
    step, pose, poses = np.eye(4), np.eye(4), []
    step[:3, :3], step[2, 3] = rotation_exp([0.0, np.radians(0.1), 0.0]), 0.5
    for _ in range(41):
        poses.append(pose)
        pose = pose @ step
    turning = by_cause(np.array(poses), true)
    assert turning["rotation_bias"]["value"] == pytest.approx(0.2)  # a tenth of a degree every half metre
    assert turning["direction_error"]["value"] == pytest.approx(0.0, abs=1e-6)
    assert turning["scale_error"]["value"] == pytest.approx(0.0, abs=1e-9)


def test_noise_is_scatter_and_its_scale_is_not_told_from_chance():
    rng = np.random.default_rng(1)
    true, estimate = straight(), straight()
    estimate[1:, :3, 3] += np.cumsum(rng.normal(0, 0.01, (40, 3)), axis=0)
    causes = by_cause(estimate, true)
    assert causes["scatter"]["value"] == pytest.approx(0.01 * 3**0.5, rel=0.25)
    assert "chance" in causes["scale_error"]["how"]


def test_rest_and_gaps_are_said():
    rest = np.tile(np.eye(4), (10, 1, 1))
    assert by_shares(rest, rest)["sections_translation"]["value"] is None
    assert "not move" in by_cause(rest, rest)["scale_error"]["how"]
    full, gap = straight(), straight()
    gap[20] = np.nan
    # Of 41 frames: sections of 4, 8, ... 32 steps, of which those from before frame 20 to beyond it are left out.
    how = [by_shares(full, true)["sections_translation"]["how"] for true in (full, gap)]
    assert "of 184 sections" in how[0]
    assert "of 80 sections" in how[1]
    gap[1:-1] = np.nan
    assert "throughout" in by_shares(full, gap)["sections_translation"]["how"]


def test_right_claims_give_one_and_halved_deviations_four():
    rng = np.random.default_rng(2)
    n = 3000
    base = rng.normal(size=(6, 6))
    claimed = 1e-4 * (base @ base.T + np.eye(6))
    errors = rng.multivariate_normal(np.zeros(6), claimed, n)
    estimate, true = np.tile(np.eye(4), (n, 1, 1)), np.tile(np.eye(4), (n, 1, 1))
    true[1:, :3, 3] = errors[1:, :3]
    true[1:, :3, :3] = [rotation_exp(e) for e in errors[1:, 3:]]
    covariance = np.tile(claimed, (n, 1, 1))
    covariance[0] = 0.0
    found = against_claims(estimate, true, covariance)["nees"]["value"]
    assert found == pytest.approx(1.0, abs=5 * (2 / 6 / n) ** 0.5)
    assert against_claims(estimate, true, covariance / 4)["nees"]["value"] == pytest.approx(4 * found)
    assert against_claims(estimate, true, np.zeros((n, 6, 6)))["nees"]["value"] is None


def test_rotation_vectors_invert_the_exponential():
    vectors = np.random.default_rng(3).normal(0, 0.8, (50, 3))
    vectors[0] = 0.0
    np.testing.assert_allclose(rotation_log(np.array([rotation_exp(v) for v in vectors])), vectors, atol=1e-9)


def test_covariances_reach_the_figures():
    true = walk(5, 12)
    _, figures = trajectory_accuracy(true, true, np.tile(1e-6 * np.eye(6), (12, 1, 1)))
    assert figures["nees"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert "nees" not in trajectory_accuracy(true, true)[1]
    assert square(true).shape == (12, 4, 4)


def test_the_direction_is_told_beyond_a_right_angle_and_not_of_motions_that_cancel():
    true = straight()
    for degrees in (89.0, 91.0, 150.0, 180.0):
        turned = np.eye(4)
        turned[:3, :3] = rotation_exp([0.0, np.radians(degrees), 0.0])
        found = by_cause(turned @ true @ np.linalg.inv(turned), true)
        assert found["direction_error"]["value"] == pytest.approx(degrees)
    there_and_back = straight()
    there_and_back[:, 2, 3] = 0.5 * (np.arange(41) % 2)
    found = by_cause(there_and_back, there_and_back)["direction_error"]
    assert found["value"] is None
    assert "cancel" in found["how"]


def test_why_claims_are_not_judged_is_said():
    poses, claimed = straight(5), np.tile(np.eye(6), (5, 1, 1))
    late, singular = poses.copy(), claimed.copy()
    late[0] = np.nan
    singular[3, 5, 5] = 0.0
    assert "the first posed frame" in against_claims(poses, late, claimed)["nees"]["how"]
    assert "singular" in against_claims(poses, poses, singular)["nees"]["how"]
    assert "behind the first" in against_claims(poses[:1], poses[:1], claimed[:1])["nees"]["how"]


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.5])
def test_the_least_rotation_between_two_directions(angle: float) -> None:
    axis, a = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([1.0, 2.0, 0.0])  # at right angles
    turn = rotation_exp(angle * axis)
    np.testing.assert_allclose(_between(a, 3.0 * turn @ a), turn, atol=1e-12)
