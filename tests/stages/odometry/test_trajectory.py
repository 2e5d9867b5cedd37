"""The scan over segments against composing by hand, with tilted local frames; covariance against sampling."""

import math
from itertools import pairwise

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.odometry.doubtful_motion import doubtful_motion
from rille.stages.odometry.resection.trajectory import ChainLink, _lost, chain, trajectory_stage

NONE = np.zeros((9, 6, 2))

"""Nothing is shared."""


def link(poses, covariance, shared, calibration=None):
    return ChainLink(poses, covariance, shared, NONE[: len(poses), :, :0] if calibration is None else calibration)


def chained(segments, levels):
    """The segments, each of which begins with the last frame of the one before."""
    ends = np.cumsum([0, *(len(one.poses) - 1 for one in segments)])
    rows = [list(range(a, b + 1)) for a, b in pairwise(ends)]
    return chain(segments, levels, rows, int(ends[-1]) + 1)


def pose(rng, scale=1.0):
    return RigidTransform(rotation_exp(rng.normal(0, 0.4, 3)), scale * rng.normal(0, 1, 3))


def level(rng):
    """T_local_left: a rotation only, another tilt for every pair."""
    return RigidTransform(rotation_exp(rng.normal([-1.9, 0, 0], 0.3)), np.zeros(3))


def test_scan_equals_composition_by_hand_whatever_the_tilt_of_the_local_frames():
    rng = np.random.default_rng(5)
    truth = [pose(rng, 3.0) for _ in range(8)]  # T_any_left of eight frames
    cuts = [(0, 3), (3, 6), (6, 7)]  # an open last segment
    levels = [level(rng) for _ in cuts]
    segments = []
    for (a, b), T_local_key in zip(cuts, levels, strict=True):
        local = [T_local_key @ truth[a].inverse() @ truth[i] for i in range(a, b + 1)]
        poses = np.array([T.matrix34 for T in local])
        segments.append(link(poses, np.zeros((b - a + 1, 6, 6)), NONE[: b - a + 1]))
    found = chained(segments, levels)
    poses, covariance, segment = found.poses, found.covariance, found.segment
    assert not found.piece.any()
    expected = [levels[0] @ truth[0].inverse() @ T for T in truth]
    np.testing.assert_allclose(poses, [T.matrix34 for T in expected], atol=1e-12)
    assert segment.tolist() == [0, 0, 0, 0, 1, 1, 1, 2]
    assert not covariance.any()
    np.testing.assert_array_equal(poses[0], levels[0].matrix34)


def test_one_pair_alone_stands_at_its_own_level():
    T = level(np.random.default_rng(8))
    inputs = {"segments": [], "levels": [Bundle({}, {"T_local_left": T.to_list(), "source": "attitude"})]}
    found = trajectory_stage.run(NoParams(), {"frames": [4]}, inputs)
    np.testing.assert_array_equal(found["poses"], [T.matrix34])
    assert found["covariance"].shape == (1, 6, 6)
    assert found["segment"].tolist() == found["piece"].tolist() == [0]


def test_covariance_is_that_of_sampled_trajectories():
    rng = np.random.default_rng(7)
    levels = [level(rng) for _ in range(3)]
    local = [np.array([T.matrix34, (T @ pose(rng, 0.5)).matrix34]) for T in levels]
    spread = np.diag([2e-3, 1e-3, 3e-3, 1e-3, 2e-3, 5e-4]) ** 2
    covs = [np.array([np.zeros((6, 6)), spread])] * 3
    found = chained([link(p, c, NONE[:2]) for p, c in zip(local, covs, strict=True)], levels)
    mean, covariance = found.poses, found.covariance
    samples = []
    for _ in range(1500):
        noisy = []
        for poses in local:
            d = np.sqrt(np.diag(spread)) * rng.standard_normal(6)
            T = RigidTransform(rotation_exp(d[3:]) @ poses[1][:, :3], poses[1][:, 3] + d[:3])
            noisy.append(link(np.array([poses[0], T.matrix34]), covs[0], NONE[:2]))
        end = chained(noisy, levels).poses[-1]
        turn = end[:, :3] @ mean[-1][:, :3].T
        w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        samples.append(np.concatenate([end[:, 3] - mean[-1][:, 3], w]))
    measured = np.cov(np.array(samples).T)
    scale = np.sqrt(np.outer(np.diag(covariance[-1]), np.diag(covariance[-1])))
    # The standard error of a correlation from 1500 samples is 0.026, of a variance 0.037.
    np.testing.assert_allclose(measured / scale, covariance[-1] / scale, atol=0.13)


def broken_run(lost_rows, frames=8, cuts=((0, 3), (3, 6), (6, 7)), moved=False):
    """True poses of eight frames in three segments of which some frames are lost; and what the stage makes of them."""
    rng = np.random.default_rng(9)
    truth = [pose(rng, 3.0) for _ in range(frames)]
    levels = [level(rng) for _ in cuts]
    segments = []
    for (a, b), T_local_key in zip(cuts, levels, strict=True):
        local = np.array([(T_local_key @ truth[a].inverse() @ truth[i]).matrix34 for i in range(a, b + 1)])
        facts = [{"frame": i, "inliers": 9} for i in range(a, b + 1)]
        for i in range(a + 1, b + 1):
            if i in lost_rows:
                local[i - a], facts[i - a] = np.nan, {"frame": i, "inliers": 0, "lost": "too few landmarks"}
        arrays = {"poses": local, "covariance": np.zeros((b - a + 1, 6, 6)), "shared": NONE[: b - a + 1]}
        segments.append(Bundle(arrays, {"per_frame": facts}))
    inputs = {
        "segments": segments,
        "levels": [Bundle({}, {"T_local_left": T.to_list(), "source": "pitch"}) for T in levels],
    }
    steps = {"steps": [[0.2, 0.3]] * (frames - 1)} if moved else {}
    out = trajectory_stage.run(NoParams(), {"frames": list(range(frames))} | steps, inputs)
    check_outputs(trajectory_stage, out)
    return truth, levels, out


def test_a_break_says_how_far_the_view_moves_there():
    _, _, out = broken_run({3}, moved=True)
    assert "(too few landmarks; the view moves by 11 degrees from frame 2, 30% of it is" in out.meta["warnings"][-1]


def test_frames_lost_one_after_the_other_for_one_cause_are_one_line():
    _, _, out = broken_run({4, 5}, moved=True)
    assert list(out.meta["causes"]) == ["4", "5"]
    assert "from frame 4, 30% of it" in out.meta["causes"]["5"]
    assert out.meta["warnings"][0] == "frames 4-5 lost: too few landmarks; bridged from 3 to 6"


def test_frames_lost_for_one_cause_with_other_figures_are_one_line_with_those_of_the_first():
    frames, piece = range(10, 16), np.array([0, -1, -1, -1, -1, 0], np.int16)
    causes = {11: "only 3 of 40 agree", 12: "only 4.5 of 7 agree", 13: "blurred", 14: "only 4.5 of 7 agree"}
    assert [line.partition("; ")[0] for line in _lost(frames, piece, causes)] == [
        "frames 11-12 lost, the first: only 3 of 40 agree",
        "frame 13 lost: blurred",
        "frame 14 lost: only 4.5 of 7 agree",
    ]


def test_a_frame_lost_within_a_segment_is_bridged():
    truth, levels, out = broken_run({4})
    assert out["piece"].tolist() == [0, 0, 0, 0, -1, 0, 0, 0]
    assert out.meta["causes"] == {"4": "too few landmarks"}
    assert out.meta["warnings"] == ["frame 4 lost: too few landmarks; bridged from 3 to 5"]
    T = levels[0] @ truth[0].inverse()
    there = [k for k in range(8) if k != 4]
    np.testing.assert_allclose(out["poses"][there], [(T @ truth[k]).matrix34 for k in there], atol=1e-12)
    assert np.isnan(out["poses"][4]).all()


def test_a_lost_key_frame_breaks_the_trajectory_into_named_pieces():
    truth, levels, out = broken_run({3})
    assert out["piece"].tolist() == [0, 0, 0, 1, 1, 1, 1, 1]
    assert out.meta["pieces"] == [[0, 1, 2], [3, 4, 5, 6, 7]]
    assert out.meta["main"] == 1
    assert [fact for fact in ("0-2", "3-7") if fact not in out.meta["warnings"][-1]] == []
    T = levels[1] @ truth[3].inverse()
    np.testing.assert_allclose(out["poses"][3:], [(T @ truth[k]).matrix34 for k in range(3, 8)], atol=1e-12)
    assert not out["covariance"][3].any()


def test_a_frame_that_is_a_piece_alone_is_lost():
    _, _, out = broken_run({1, 2, 3, 7})
    assert out["piece"].tolist() == [-1, -1, -1, 0, 0, 0, 0, -1]
    assert out.meta["pieces"] == [[3, 4, 5, 6]]
    assert out.meta["causes"] == dict.fromkeys("127", "too few landmarks")
    where = ["frame 0 lost: no frame beside it could be posed with it", "frames 1-2 lost: too few", "frame 7 lost: too"]
    assert [line[: len(place)] for line, place in zip(out.meta["warnings"], where, strict=False)] == where
    assert all("; no pose" in line for line in out.meta["warnings"][:3])
    _, _, nothing = broken_run({1, 2, 3, 4, 5, 6, 7})
    assert nothing["piece"].tolist() == [0] + [-1] * 7


def test_what_segments_share_adds_up_and_what_they_do_not_adds_squared():
    """Four equal segments straight ahead, one frame each: one kind of error along the way, 2 mm shared, 3 mm not."""
    step = np.hstack([np.eye(3), [[0.0], [0.0], [1.0]]])
    start = np.hstack([np.eye(3), np.zeros((3, 1))])
    shared = np.zeros((2, 6, 1))
    shared[1, 2, 0] = 2e-3
    own = np.zeros((2, 6, 6))
    own[1, 2, 2] = 3e-3**2
    one = link(np.array([start, step]), own + shared @ np.swapaxes(shared, 1, 2), shared)
    found = chained([one] * 4, [RigidTransform.identity()] * 4)
    np.testing.assert_allclose(found.covariance[:, 2, 2], [k * 3e-3**2 + (k * 2e-3) ** 2 for k in range(5)], atol=1e-15)
    # Of the calibration 5 mm more, which a run that knows it exactly does not have.
    calibrated = chained([one._replace(calibration=2.5 * shared)] * 4, [RigidTransform.identity()] * 4)
    np.testing.assert_array_equal(calibrated.own_covariance, found.covariance)
    more = calibrated.covariance - calibrated.own_covariance
    np.testing.assert_allclose(more[:, 2, 2], [(k * 5e-3) ** 2 for k in range(5)], atol=1e-15)


def test_poses_and_their_covariances_are_chained():
    truth, levels, _ = broken_run(set())
    segments, claimed = [], np.diag([1e-6] * 3 + [1e-8] * 3)
    for (a, b), T_local_key in zip(((0, 3), (3, 6), (6, 7)), levels, strict=True):
        local = np.array([(T_local_key @ truth[a].inverse() @ truth[i]).matrix34 for i in range(a, b + 1)])
        n = b - a + 1
        arrays = {"poses": local, "covariance": np.tile(claimed, (n, 1, 1)), "shared": NONE[:n]}
        segments.append(Bundle(arrays, {"per_frame": [{"frame": i, "inliers": 9} for i in range(a, b + 1)]}))
    inputs = {
        "segments": segments,
        "levels": [Bundle({}, {"T_local_left": T.to_list(), "source": "pitch"}) for T in levels],
    }
    out = trajectory_stage.run(NoParams(), {"frames": list(range(8))}, inputs)
    # Of a frame of the first segment it is what was claimed, in the world: both parts are the same about all axes.
    np.testing.assert_allclose(out["covariance"][1], claimed, atol=1e-18)
    assert np.trace(out["covariance"][7][:3, :3]) > 2 * np.trace(claimed[:3, :3])
    expected = [(levels[0] @ truth[0].inverse() @ T).matrix34 for T in truth]
    np.testing.assert_allclose(out["poses"], expected, atol=1e-12)


def resected(frames, poses):
    count = len(frames)
    arrays = {"poses": np.array([T.matrix34 for T in poses]), "covariance": np.zeros((count, 6, 6))}
    facts = [{"frame": f, "inliers": 9} for f in frames]
    return Bundle(arrays | {"shared": np.zeros((count, 6, 2))}, {"per_frame": facts})


def test_the_vertical_of_a_later_pair_is_carried_back_where_the_first_has_none():
    rng = np.random.default_rng(11)
    true = [pose(rng) for _ in range(5)]  # T_true_left; true z is up
    unlevelled = RigidTransform(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
    up = true[2].rotation.T[:, 2]
    along = np.array([0.0, 0.0, 1.0]) - up * up[2]
    along /= np.linalg.norm(along)
    level_2 = RigidTransform(np.array([np.cross(along, up), along, up]), np.zeros(3))
    levels = [Bundle({}, {"T_local_left": T.to_list(), "source": s}) for T, s in ((unlevelled, "none"), (level_2, "x"))]
    segments = [
        resected(part, [T @ true[part[0]].inverse() @ true[i] for i in part])
        for part, T in (([0, 1, 2], unlevelled), ([2, 3, 4], level_2))
    ]
    frames = {"frames": [0, 1, 2, 3, 4]}
    found = trajectory_stage.run(NoParams(), frames, {"segments": segments, "levels": levels})
    assert found.meta["verticals"] == ["x"]
    assert not found.meta["warnings"]
    for got, T in zip(np.asarray(found["poses"]), true, strict=True):
        np.testing.assert_allclose(got[2, :3], T.rotation[2], atol=1e-9)  # z is up
        np.testing.assert_allclose(got[2, 3], T.translation[2] - true[0].translation[2], atol=1e-9)
    axis = np.asarray(found["poses"])[0, :, 2]
    assert abs(axis[0]) < 1e-9 < axis[1]  # y is the first camera's axis, levelled

    levels[1].meta["source"] = "none"
    blind = trajectory_stage.run(NoParams(), frames, {"segments": segments, "levels": levels})
    assert blind.meta["verticals"] == ["none"]
    assert "frames 0-4" in blind.meta["warnings"][0]
    np.testing.assert_array_equal(np.asarray(blind["poses"])[0], unlevelled.matrix34)


@pytest.mark.parametrize(
    ("tilt", "source", "told"), [(8.0, "ground plane", 1), (3.0, "ground plane", 0), (8.0, "pitch", 0)]
)
def test_ground_of_another_pair_that_contradicts_the_vertical_is_told(tilt, source, told):
    """Of matches that are bad a plane may be ground that is tilted by many degrees."""
    T = RigidTransform.identity()
    turned = RigidTransform(rotation_exp([math.radians(tilt), 0, 0]), np.zeros(3))
    segments = [resected([4, 5], [T, T]), resected([5, 6], [turned, turned])]
    levels = [Bundle({}, {"T_local_left": one.to_list(), "source": source}) for one in (T, turned)]
    inputs = {"segments": segments, "levels": levels}
    found = trajectory_stage.run(NoParams(), {"frames": [4, 5, 6]}, inputs)
    assert len(found.meta["warnings"]) == told
    assert all(
        "ground of 1 of 2 pairs, first pair 5, the vertical is off by up to 8" in w for w in found.meta["warnings"]
    )


def test_one_pair_behind_a_lost_frame_has_the_pose():
    T = level(np.random.default_rng(8))
    inputs = {"segments": [], "levels": [Bundle({}, {"T_local_left": T.to_list(), "source": "attitude"})]}
    given = {"frames": [4, 5], "lost": [{"frame": 4, "cause": "black left image"}]}
    found = trajectory_stage.run(NoParams(), given, inputs)
    assert np.isfinite(found["poses"]).all((1, 2)).tolist() == [False, True]
    assert found.meta["causes"] == {"4": "black left image"}


@pytest.mark.parametrize(("step", "turn", "told"), [(0.0, 0.0, 1), (0.01, 0.0, 0), (0.0, 0.01, 0)])
def test_a_camera_that_stands_still_is_told_and_not_one_that_turns_on_the_spot(step, turn, told) -> None:
    """Who recorded it knows whether it stood, or whether a projector's dots moved with it."""
    poses = np.tile(np.eye(3, 4), (5, 1, 1))
    poses[1:4, :, 3] = np.random.default_rng(0).normal(scale=1e-4, size=(3, 3))
    for k, pose in enumerate(poses):
        pose[:, :3], pose[2, 3] = rotation_exp([0.0, k * turn, 0.0]), pose[2, 3] + k * step
    lines = doubtful_motion(poses, np.tile(1e-8 * np.eye(6), (5, 1, 1)))
    assert len(lines) == told
    assert all("stands still" in line and "5 frames" in line for line in lines)


@pytest.mark.parametrize(
    ("places", "told"),
    [
        ([1, 0, 3, 2, 5, 4, 7, 6, 9, 8], 1),  # each two in turns
        ([0, 5, 1, 6, 2, 7, 3, 8, 4, 9], 1),  # two halves mixed
        (range(10), 0),
        ([0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0], 0),
        ([0, 0.001, 0, 0.001, 0, 0.001, 0, 1, 2, 3], 0),  # stood for a while
    ],
)
def test_images_out_of_order_are_asked_for(places, told) -> None:
    n = len(list(places))
    poses = np.tile(np.eye(3, 4), (n, 1, 1))
    poses[:, 2, 3] = list(places)
    poses[:, 0, 3] = 0.01 * np.arange(n) ** 2
    lines = doubtful_motion(poses, np.zeros((n, 6, 6)))
    assert len(lines) == told
    assert all("in the order" in line for line in lines)
