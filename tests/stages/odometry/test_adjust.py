"""The pose graph against a dense solver, closed forms and sampling; loops that are true, false, or join pieces."""

import numpy as np
import pytest
import scipy

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.geometry.geometry import RigidTransform, rotation_exp, rotation_log
from rille.stages.odometry.pose_graph import Factors, GraphState, PoseGraph, adjust, root_of
from rille.stages.odometry.resection.adjust import adjust_stage
from rille.stages.odometry.resection.loop import closure
from rille.stages.odometry.resection.trajectory import trajectory_stage

STEP = np.diag([2e-3, 1e-3, 3e-3, 1e-3, 2e-3, 5e-4]) ** 2
"""Covariance of one frame in its segment, m and rad."""
SHARED = np.array([[0.0, 0.0, 4e-3, 0.0, 2e-4, 0.0]]).T
"""Pose error of one frame by the source that all segments share."""
LOOP = np.diag([2e-3] * 3 + [1e-3] * 3) ** 2


def ring(frames=12, radius=5.0):
    """Poses T_world_left of a camera that looks ahead along a circle and comes back to where it began."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, frames):
        R = rotation_exp([0, 0, angle]) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        poses.append(RigidTransform(R, radius * np.array([np.cos(angle) - 1, np.sin(angle), 0])))
    return poses


def noisy(T, covariance, rng, shared=0.0):
    d = rng.multivariate_normal(np.zeros(6), covariance) + shared
    return RigidTransform(rotation_exp(d[3:]) @ T.rotation, T.translation + d[:3])


def run_of(truth, rng, excess=1.0, lost=(), every=3):
    """Segments of ``every`` frames of a true trajectory, in error as their covariances say (``excess`` times that)."""
    common, segments, levels = SHARED[:, 0] * rng.standard_normal(), [], []
    for a in range(0, len(truth) - 1, every):
        frames = list(range(a, min(a + every, len(truth) - 1) + 1))
        level = RigidTransform(truth[a].rotation, np.zeros(3))
        facts = [{"frame": f, "inliers": 9} for f in frames]
        poses, cov = [level.matrix34], [np.zeros((6, 6))]
        for k, f in enumerate(frames[1:], start=1):
            moved = noisy(level @ truth[a].inverse() @ truth[f], excess**2 * STEP, rng, excess * common)
            poses.append(np.full((3, 4), np.nan) if f in lost else moved.matrix34)
            cov.append(STEP + SHARED @ SHARED.T)
            if f in lost:
                facts[k]["lost"] = "dark"
        shared = np.array([0 * SHARED] + [SHARED] * (len(frames) - 1))
        segments.append(
            Bundle({"poses": np.array(poses), "covariance": np.array(cov), "shared": shared}, {"per_frame": facts})
        )
        levels.append(Bundle({}, {"T_local_left": level.to_list(), "source": "attitude"}))
    inputs = {"segments": segments, "levels": levels}
    return segments, trajectory_stage.run(NoParams(), {"frames": list(range(len(truth)))}, inputs)


def motion(a, b, T, covariance=LOOP):
    pose = [float(v) for v in T.matrix34.reshape(-1)]
    return {"from": a, "to": b, "pose": pose, "covariance": covariance.reshape(-1).tolist(), "source": "stated"}


def seen(truth, a, b, rng):
    return motion(a, b, noisy(truth[a].inverse() @ truth[b], LOOP, rng))


def adjusted(segments, trajectory, *factors, **more):
    loops = [Bundle({}, {"factors": list(factors)})]
    out = adjust_stage.run(NoParams(), {}, {"trajectory": trajectory, "segments": segments, "loops": loops, **more})
    check_outputs(adjust_stage, out)
    return out


def errors(out, truth):
    """Errors (frame, 6) of poses against truth in the frame of the first camera."""
    first = RigidTransform.from_matrix(out["poses"][0]) @ truth[0].inverse()
    rows = []
    for T, true in zip(out["poses"], truth, strict=True):
        there = first @ true
        rows.append([*(T[:, 3] - there.translation), *rotation_log(T[:, :3] @ there.rotation.T)])
    return np.array(rows)


def test_without_factors_everything_stays_to_the_bit():
    segments, before = run_of(ring(), np.random.default_rng(1))
    out = adjusted(segments, before)
    for name in before.arrays:
        np.testing.assert_array_equal(out[name], before[name])


def test_covariances_of_a_chain_are_those_of_the_trajectory():
    """A factor that says nothing leaves a chain with what segments share; its covariances come by another way."""
    truth = ring()
    segments, before = run_of(truth, np.random.default_rng(2))
    out = adjusted(segments, before, motion(0, 11, truth[0].inverse() @ truth[11], 1e12 * LOOP))
    np.testing.assert_allclose(out["poses"], before["poses"], atol=1e-9)
    scale = np.sqrt(np.einsum("fii,fjj->fij", before["covariance"], before["covariance"]))[1:]
    np.testing.assert_allclose(out["covariance"][1:] / scale, before["covariance"][1:] / scale, atol=1e-6)


def test_a_dense_solver_finds_the_same_poses_and_covariances():
    rng, truth = np.random.default_rng(3), ring(6)
    ends = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (1, 4)]
    shared, levers, measured = rng.normal(0, 1e-3, (7, 6, 2)), rng.normal(0, 1, (7, 3)), []
    for (a, b), lever in zip(ends, levers, strict=True):
        T = truth[a].inverse() @ truth[b]
        measured.append(noisy(RigidTransform(T.rotation, T.apply(lever)), LOOP, rng))
    factors = Factors(
        np.array(ends), np.array([T.matrix34 for T in measured]), np.tile(root_of(LOOP), (7, 1, 1)), shared,
        levers, np.full(7, np.inf),
    )  # fmt: skip
    graph = PoseGraph(factors, 6, np.ones(7), common=2)
    start = GraphState.of(np.array([T.matrix34 for T in truth]), 2)

    def unpacked(x):
        R = [truth[0].rotation, *(rotation_exp(x[k : k + 3]) for k in range(3, 30, 6))]
        C = [truth[0].translation, *(x[k : k + 3] for k in range(0, 30, 6))]
        return R, C

    def residuals(x):
        (R, C), out = unpacked(x), [x[30:]]
        for (a, b), T, s, lever in zip(ends, measured, shared, factors.lever, strict=True):
            position = R[a].T @ (C[b] + R[b] @ lever - C[a]) - T.translation
            rotation = rotation_log(R[a].T @ R[b] @ T.rotation.T)
            out.append(np.linalg.inv(np.linalg.cholesky(LOOP)) @ (np.concatenate([position, rotation]) - s @ x[30:]))
        return np.concatenate(out)

    x = np.concatenate([*(np.concatenate([T.translation, rotation_log(T.rotation)]) for T in truth[1:]), np.zeros(2)])
    dense = scipy.optimize.least_squares(residuals, x, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    done = adjust(graph, start)
    R, C = unpacked(dense.x)
    np.testing.assert_allclose(done.state.C, C, atol=1e-7)
    np.testing.assert_allclose(done.state.R, R, atol=1e-7)
    np.testing.assert_allclose(done.state.sources, dense.x[30:], atol=1e-5)
    inverse = np.linalg.inv(dense.jac.T @ dense.jac)
    for node in range(1, 6):
        block = slice(6 * node - 6, 6 * node - 3)
        position = done.graph.covariance(done.state)[node][:3, :3]
        np.testing.assert_allclose(position, inverse[block, block], rtol=2e-2, atol=1e-9)


def test_an_error_is_spread_over_a_loop_as_the_covariances_say():
    """Four steps of 1 m ahead with sigmas 1, 1, 2, 2 mm, whose sum is measured exactly as 10 mm less."""
    steps = [RigidTransform(np.eye(3), np.array([0.0, 0, 1])).matrix34] * 4
    whole = RigidTransform(np.eye(3), np.array([0.0, 0, 3.99])).matrix34
    sigma = np.array([1e-3, 1e-3, 2e-3, 2e-3, 1e-6])
    roots = np.eye(6) / sigma[:, None, None]
    factors = Factors(
        np.array([[0, 1], [1, 2], [2, 3], [3, 4], [0, 4]]), np.array([*steps, whole]), roots,
        np.zeros((5, 6, 0)), np.zeros((5, 3)), np.full(5, np.inf),
    )  # fmt: skip
    start = np.array([RigidTransform(np.eye(3), np.array([0.0, 0, k])).matrix34 for k in range(5)])
    done = adjust(PoseGraph(factors, 5, np.ones(5)), GraphState.of(start, 0))
    np.testing.assert_allclose(np.diff(done.state.C[:, 2]) - 1, [-0.001, -0.001, -0.004, -0.004], atol=1e-7)


def test_stated_covariances_hold_with_a_loop_and_are_smaller():
    truth, nees, shrunk = ring(), [], []
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        segments, before = run_of(truth, rng)
        out = adjusted(segments, before, seen(truth, 0, 11, rng))
        e, cov = errors(out, truth)[1:], out["covariance"][1:]
        nees.append(np.mean(np.einsum("fi,fij,fj->f", e, np.linalg.inv(cov), e)) / 6)
        shrunk.append(np.linalg.norm(errors(out, truth)[11, :3]) / np.linalg.norm(errors(before, truth)[11, :3]))
        assert out.meta["excess"] == 1.0
    # Means of 20 runs whose frames share their errors.
    assert 0.8 < np.mean(nees) < 1.25
    assert np.median(shrunk) < 0.3


def test_a_false_loop_is_left_out_and_named():
    truth, rng = ring(), np.random.default_rng(5)
    segments, before = run_of(truth, rng)
    true = [seen(truth, 0, 11, rng), seen(truth, 1, 10, rng)]
    wrong = motion(2, 8, truth[2].inverse() @ truth[9])
    alone, both = adjusted(segments, before, *true), adjusted(segments, before, *true, wrong)
    np.testing.assert_allclose(both["poses"], alone["poses"], atol=1e-9)
    assert [line for line in both.meta["warnings"] if "from frame 2 to frame 8" in line]
    assert not alone.meta["warnings"]
    # By itself, too, it cannot bend the chain.
    single = adjusted(segments, before, wrong)
    np.testing.assert_allclose(single["poses"], before["poses"], atol=1e-9)


def test_a_chain_whose_errors_exceed_its_covariances_takes_them_times_a_factor():
    truth, found, nees = ring(), [], []
    for seed in range(10):
        rng = np.random.default_rng(200 + seed)
        segments, before = run_of(truth, rng, excess=10.0)
        loops = [seen(truth, a, b, rng) for a, b in ((0, 11), (1, 10), (2, 9), (3, 8), (0, 6), (5, 11))]
        out = adjusted(segments, before, *loops)
        assert not [line for line in out.meta["warnings"] if "left out" in line]
        e = errors(out, truth)[1:]
        found.append(out.meta["excess"])
        assert "contradiction" not in out.meta  # no other sensor says so
        nees.append(np.mean(np.einsum("fi,fij,fj->f", e, np.linalg.inv(out["covariance"][1:]), e)) / 6)
    assert set(found) == {10.0}
    assert 0.5 < np.mean(nees) < 2.0


def test_factors_join_pieces_into_the_frame_of_the_first():
    truth, rng = ring(), np.random.default_rng(6)
    segments, before = run_of(truth, rng, lost={6})
    assert "broken before frame 6 (dark)" in before.meta["warnings"][0]
    before.meta["odd_verticals"].append("the ground bends")
    assert before.meta["pieces"] == [list(range(6)), list(range(6, 12))]
    out = adjusted(segments, before, seen(truth, 0, 11, rng), seen(truth, 1, 10, rng))
    assert out.meta["pieces"] == [list(range(12))]
    assert out.meta["verticals"] == ["attitude"]
    assert out.meta["warnings"] == ["the ground bends"]
    e = errors(out, truth)[1:]
    assert np.linalg.norm(e[:, :3], axis=1).max() < 0.05
    nees = np.einsum("fi,fij,fj->f", e, np.linalg.inv(out["covariance"][1:]), e) / 6
    assert nees.max() < 4.0
    np.testing.assert_array_equal(out["poses"][0], before["poses"][0])


def test_a_link_that_no_other_agrees_with_joins_no_pieces():
    """Within a piece the chain contradicts a wrong place; between two pieces nothing would."""
    truth, rng = ring(), np.random.default_rng(6)
    segments, before = run_of(truth, rng, lost={6})
    wrong = seen(truth, 1, 10, rng)
    wrong["pose"][3] += 40.0
    for links in ([seen(truth, 0, 11, rng)], [seen(truth, 0, 11, rng), wrong]):
        out = adjusted(segments, before, *links)
        assert out.meta["pieces"] == before.meta["pieces"]
        assert len([line for line in out.meta["warnings"] if "alone link" in line]) == len(links)
        # Between the frames of two pieces there is no distance.
        assert closure(links[0], before, out).left_m is None


def test_a_piece_that_nothing_joins_stays_as_it_is():
    truth, rng = ring(16), np.random.default_rng(7)
    segments, before = run_of(truth, rng, lost={6, 12})
    assert len(before.meta["pieces"]) == 3
    out = adjusted(segments, before, seen(truth, 1, 14, rng), seen(truth, 2, 13, rng))
    assert out.meta["pieces"] == [[0, 1, 2, 3, 4, 5, 12, 13, 14, 15], list(range(6, 12))]
    assert out.meta["main"] == 0
    for name in ("poses", "covariance"):
        np.testing.assert_array_equal(out[name][6:12], before[name][6:12])


@pytest.mark.parametrize("frames", [12, 36])
def test_an_error_of_the_calibration_stays_in_the_covariance_however_many_frames_and_loops_there_are(frames):
    """Of the scale, 1 %: all motions that are measured share it, those between places that are seen again, too."""
    truth, rng = ring(frames), np.random.default_rng(9)
    segments, _ = run_of(truth, rng)
    scaled = []
    for one in segments:
        way = one["poses"][:, :, 3] - one["poses"][0, :, 3]
        by = np.concatenate([way, np.zeros_like(way)], axis=1)[:, :, None]
        scaled.append(Bundle(dict(one.arrays) | {"by_intrinsics": by}, one.meta))
    scale = {"intrinsics": Bundle({}, {"covariance": [[1e-4]], "errors": {"toe-in": [0.0, 0.01]}})}
    levels = [Bundle({}, {"T_local_left": one["poses"][0].ravel().tolist(), "source": "attitude"}) for one in scaled]
    inputs = {"segments": scaled, "levels": levels, **scale}
    before = trajectory_stage.run(NoParams(), {"frames": list(range(frames))}, inputs)
    loops = [seen(truth, k, frames - 1 - k, rng) for k in range(frames // 6)]
    out = adjusted(scaled, before, *loops, **scale)
    shares = [
        np.trace((one["covariance"] - one["own_covariance"])[frames // 2, :3, :3]) ** 0.5 for one in (before, out)
    ]
    # Half a round of 5 m lies 10 m away.
    assert shares == pytest.approx([0.1, 0.1], rel=0.15)


def test_links_that_contradict_leave_other_pieces_joined():
    truth, rng = ring(16), np.random.default_rng(6)
    segments, before = run_of(truth, rng, lost={6, 12})
    assert len(before.meta["pieces"]) == 3
    links = [seen(truth, a, b, rng) for a, b in ((1, 10), (2, 9), (8, 14), (9, 13))]
    links[-1]["pose"][3] += 0.15
    out = adjusted(segments, before, *links)
    assert out.meta["pieces"] == [list(range(12)), [12, 13, 14, 15]]
    assert [line for line in out.meta["warnings"] if "not joined" in line]
    np.testing.assert_array_equal(out["poses"][12:], before["poses"][12:])
    here = slice(0, 12)
    assert np.nanmax(np.linalg.norm(errors({"poses": out["poses"][here]}, truth[here])[:, :3], axis=1)) < 0.05


def test_links_that_contradict_each_other_join_no_pieces():
    truth, rng = ring(), np.random.default_rng(6)
    segments, before = run_of(truth, rng, lost={6})
    one, other = seen(truth, 0, 11, rng), seen(truth, 1, 10, rng)
    other["pose"][3] += 0.25
    out = adjusted(segments, before, one, other)
    posed = np.isfinite(out["poses"]).all((1, 2))
    sigma = np.sqrt(np.einsum("fii->fi", out["covariance"][posed]))
    assert sigma.max() < 1.0
