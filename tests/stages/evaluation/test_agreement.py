"""Two trajectories: known disturbances come out as they went in, and only what stands out is flagged."""

from __future__ import annotations

import math

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation.agreement import agreement_stage, at_rest, compare, flag
from rille.stages.geometry.geometry import rotation_exp
from rille.stages.geometry.rigid import compose

RNG = np.random.default_rng


def drive(n: int, seed: int = 0) -> np.ndarray:
    """A winding drive of a metre a frame."""
    rng, pose, poses = RNG(seed), np.eye(4), []
    for _ in range(n):
        poses.append(pose[:3].copy())
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = rotation_exp(rng.normal(scale=0.05, size=3)), [0.0, 0.0, 1.0]
        pose = pose @ motion
    return np.array(poses)


def noisy(poses: np.ndarray, seed: int, shift: float = 0.01, turn: float = 0.001) -> np.ndarray:
    rng, out = RNG(seed), poses.copy()
    for pose in out:
        pose[:, :3] = pose[:, :3] @ rotation_exp(rng.normal(scale=turn, size=3))
        pose[:, 3] += rng.normal(scale=shift, size=3)
    return out


def moved(poses: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    return compose(np.column_stack([rotation, translation]), poses)


def run(
    ours: np.ndarray,
    theirs: np.ndarray,
    piece: np.ndarray | None = None,
    lines: np.ndarray | None = None,
    covariance: np.ndarray | None = None,
) -> Bundle:
    piece = np.where(np.isfinite(theirs[:, 0, 0]), 0, -1) if piece is None else piece
    frames = list(range(10, 10 + len(ours)))
    pieces = [[f for f, p in zip(frames, piece, strict=True) if p == k] for k in range(int(piece.max()) + 1)]
    arrays = {"poses": theirs, "piece": piece.astype(np.int16)}
    arrays["line_distance"] = np.full(len(ours), 0.2) if lines is None else lines
    own = np.zeros((len(ours), 6, 6)) if covariance is None else covariance
    trajectory = {"poses": ours, "own_covariance": own, "piece": np.zeros(len(ours), np.int16)}
    given = {"trajectory": Bundle(trajectory, {"frames": frames})}
    out = agreement_stage.run(
        NoParams(), {}, given | {"crosscheck": Bundle(arrays, {"frames": frames, "pieces": pieces})}
    )
    check_outputs(agreement_stage, out)
    return out


def test_another_frame_of_reference_is_no_disagreement() -> None:
    ours = drive(20)
    out = run(ours, moved(ours, rotation_exp([0.4, -1.0, 2.0]), np.array([5.0, -3.0, 9.0])))
    assert out.meta["metrics"]["rmse"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert out.meta["metrics"]["scale_ratio"]["value"] == pytest.approx(1.0, abs=1e-12)
    assert out.meta["flagged"] == []
    assert np.isnan(out["step_distance"][0])
    np.testing.assert_allclose(out["poses"], ours, atol=1e-9)


def test_one_jump_is_flagged_at_its_frame_and_measured() -> None:
    """From frame 25 on (number 35) everything is 0.5 m aside: one step is wrong by 0.5 m, the others by noise."""
    ours = drive(50)
    theirs = noisy(ours, 1)
    theirs[25:, 0, 3] += 0.5
    out = run(ours, theirs)
    why = {f["frame"]: f["why"] for f in out.meta["flagged"]}
    assert "motion since the frame before" in why[35]
    # noise of 0.01 m an axis at either end: 0.5 m within 4 sigma of sqrt(2) * 0.01 m
    assert out["step_distance"][25] == pytest.approx(0.5, abs=0.06)
    assert [f for f, reasons in why.items() if "motion since the frame before" in reasons] == [35]


def test_one_turned_frame_is_flagged_by_rotation_alone() -> None:
    ours = drive(40)
    theirs = noisy(ours, 2)
    theirs[12, :, :3] = theirs[12, :, :3] @ rotation_exp([0.0, 0.05, 0.0])
    out = run(ours, theirs)
    why = {f["frame"]: f["why"] for f in out.meta["flagged"]}
    assert "rotation" in why[22]
    assert "position" not in why[22]
    assert set(why) <= {22, 23}
    assert math.degrees(out["angle"][12]) == pytest.approx(math.degrees(0.05), abs=0.3)


def test_a_frame_whose_images_do_not_fit_the_rig_is_flagged_although_its_pose_is_right() -> None:
    ours = drive(20)
    lines = np.where(np.arange(20) == 7, 5.0, 0.3)
    out = run(ours, ours, lines=lines)
    assert out.meta["flagged"] == [{"frame": 17, "why": ["left and right image do not fit the rig"]}]
    # Of a rig that is wrong all over, all are far off: that is no reason for a single frame.
    assert run(ours, ours, lines=6.0 + 0.1 * RNG(0).normal(size=20)).meta["flagged"] == []


def test_noise_alone_is_not_flagged() -> None:
    ours = drive(60)
    assert [len(run(ours, noisy(ours, seed)).meta["flagged"]) for seed in range(5)] == [0] * 5


@pytest.mark.parametrize("seed", [1, 2])
def test_what_the_stated_errors_explain_is_not_flagged(seed: int) -> None:
    """Chains whose errors are as stated: of few frames that agree well by chance the next one would stand out."""
    n, step = 6, 1e-4
    ours, walk = drive(n), np.cumsum(RNG(seed).normal(scale=step, size=(n, 3)), axis=0)
    theirs = ours.copy()
    theirs[:, :, 3] += walk
    theirs[-1, :, 3] += 4.0 * step
    grown = np.arange(n)[:, None, None] * np.diag([step**2] * 3 + [1e-12] * 3)
    assert run(ours, theirs, covariance=grown).meta["flagged"] == []
    theirs[3, :, 3] += 60.0 * step
    assert 13 in [frame["frame"] for frame in run(ours, theirs, covariance=grown).meta["flagged"]]


def test_the_limit_by_hand() -> None:
    """Median 2, deviations 1 1 0 1 8, MAD 1: limit 2 + 5 * 1.4826; angles of microradians are beneath notice."""
    values = np.array([1.0, 1.0, 2.0, 3.0, 10.0])
    arrays = {
        "distance": values,
        "angle": 1e-6 * values,
        "step_distance": np.full(5, 3.0),
        "step_angle": values * np.nan,
        "line_distance": 0.1 * values,
    }
    flags, limits = flag(arrays, {"step_distance": 1.5})
    assert limits["distance"] == pytest.approx(9.413)
    assert limits["angle"] == pytest.approx(math.radians(0.05))
    assert limits["step_distance"] == 7.5  # five of those stated
    assert limits["step_angle"] is None
    assert flags.tolist() == [0, 0, 0, 0, 1]


def test_a_scale_shows_as_a_ratio() -> None:
    """Theirs 2 % short: ours is 1.02 times theirs (to second order in the noise, n = 80 positions)."""
    ours = drive(80)
    theirs = noisy(ours, 3)
    theirs[:, :, 3] /= 1.02
    out = run(ours, theirs)
    assert out.meta["metrics"]["scale_ratio"]["value"] == pytest.approx(1.02, abs=1e-3)
    assert out.meta["metrics"]["rmse_scaled"]["value"] < 0.03 < out.meta["metrics"]["rmse"]["value"]


def test_rmse_is_near_evo_s_ate_and_never_below_it() -> None:
    """evo aligns positions alone, which is the least RMS; orientations at a tenth of the spread cost little."""
    ours, theirs = drive(60), noisy(drive(60), 4, shift=0.05, turn=0.002)
    reference, other = (PosePath3D(poses_se3=[np.vstack([p, [0, 0, 0, 1]]) for p in poses]) for poses in (ours, theirs))
    other.align(reference)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((reference, other))
    least = ape.get_statistic(evo_metrics.StatisticsType.rmse)
    found = run(ours, theirs).meta["metrics"]["rmse"]["value"]
    assert least <= found <= 1.02 * least


def test_missing_frames_are_named_and_steps_over_them_left_out() -> None:
    ours = drive(12)
    theirs = ours.copy()
    theirs[5] = ours[8] = np.nan
    ours[8] = np.nan
    theirs[8] = drive(12)[8]
    out = run(ours, theirs)
    assert out.meta["compared"] == 10
    assert np.flatnonzero(np.isnan(out["step_distance"])).tolist() == [0, 5, 6, 8, 9]
    # theirs is drawn wherever they have a pose
    assert np.isfinite(out["poses"][8]).all()


def test_each_piece_is_laid_on_ours_by_itself_and_a_lone_frame_not_at_all() -> None:
    ours = drive(13)
    theirs = ours.copy()
    theirs[5:12] = moved(ours[5:12], rotation_exp([1.0, 0.0, 0.3]), np.array([1.0, 2.0, 3.0]))
    piece = np.array([0] * 5 + [1] * 7 + [2])
    out = run(ours, theirs, piece)
    assert out.meta["metrics"]["rmse"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert out.meta["compared"] == 12
    assert out.meta["pieces"] == 3
    assert np.isnan(out["step_distance"][5])


@pytest.mark.parametrize(("step", "rests"), [(0.099, False), (0.101, True)])
def test_a_camera_rests_within_ten_times_what_its_steps_differ_by(step: float, rests: bool) -> None:
    poses = np.tile(np.eye(3, 4), (40, 1, 1))
    poses[:, 0, 3] = np.where(np.arange(40) % 2, 1.0, -1.0)  # a metre from their mean
    assert at_rest(poses, np.full(39, step)) == rests


def test_a_camera_at_rest_has_no_scale() -> None:
    ours = np.tile(np.eye(3, 4), (6, 1, 1))
    out = run(ours, moved(ours, rotation_exp([0.1, 0.2, 0.3]), np.ones(3)))
    assert out.meta["metrics"]["scale_ratio"]["value"] is None
    assert out.meta["metrics"]["share"]["value"] is None
    np.testing.assert_allclose(out["angle"], 0.0, atol=1e-9)


def test_nothing_to_compare_is_a_fact() -> None:
    ours = drive(4)
    out = run(ours, np.full((4, 3, 4), np.nan))
    assert out.meta["compared"] == 0
    assert out.meta["metrics"]["rmse"]["value"] is None
    assert out.meta["limits"]["distance"] is None
    arrays, scale, _ = compare(ours, ours, np.full(4, -1))
    assert np.isnan(arrays["distance"]).all()
    assert scale is None


def test_a_resting_camera_is_aligned_by_its_orientations() -> None:
    rest = np.tile(np.eye(4)[:3], (20, 1, 1))
    ours = noisy(rest, 1, shift=2e-4, turn=1e-4)
    theirs = moved(noisy(rest, 2, shift=2e-4, turn=1e-4), rotation_exp([0.4, -1.0, 2.0]), np.zeros(3))
    out = run(ours, theirs)
    # the mean of 20 noisy orientations on either side: a few 1e-4 rad in all, not the chance of the noise's shape
    assert out.meta["metrics"]["rmse_rotation"]["value"] < math.degrees(5e-4)
    assert out.meta["metrics"]["scale_ratio"]["value"] is None


def test_of_a_camera_at_rest_no_share_of_the_way_is_stated() -> None:
    rest = np.tile(np.eye(4)[:3], (6, 1, 1))
    out = run(noisy(rest, 1, shift=1e-7, turn=1e-4), noisy(rest, 2, shift=1e-4, turn=1e-4))
    assert out.meta["metrics"]["share"]["value"] is None
    assert "at rest" in out.meta["metrics"]["share"]["how"]


@pytest.mark.parametrize("swapped", [False, True])
def test_a_camera_of_which_one_trajectory_drives_and_the_other_rests_is_not_at_rest(swapped: bool) -> None:
    both = noisy(np.tile(np.eye(4)[:3], (10, 1, 1)), 1, shift=1e-3), drive(10)
    share = run(*both[:: -1 if swapped else 1]).meta["metrics"]["share"]["value"]
    assert share > (25.0 if swapped else 1000.0)  # per cent of our length, which is of noise where we rest


def test_from_one_of_our_pieces_to_the_next_there_is_no_way() -> None:
    true = drive(20)
    ours = true.copy()
    ours[10:] = moved(true[10:], true[10, :, :3].T, -true[10, :, :3].T @ true[10, :, 3])  # begins at its own origin
    frames = list(range(20))
    own = {"piece": np.repeat([0, 1], 10).astype(np.int16), "own_covariance": np.zeros((20, 6, 6))}
    given = Bundle({"poses": ours} | own, {"frames": frames})
    arrays = {"poses": true, "piece": np.zeros(20, np.int16), "line_distance": np.zeros(20)}
    other = Bundle(arrays, {"frames": frames, "pieces": [frames]})
    metrics = agreement_stage.run(NoParams(), {}, {"trajectory": given, "crosscheck": other}).meta["metrics"]
    assert metrics["rmse"]["value"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["length"]["value"] == pytest.approx(18.0)
