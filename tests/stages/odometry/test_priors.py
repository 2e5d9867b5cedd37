"""Other sensors beside a simulated chain: right ones join pieces and tell their clocks, wrong ones are noticed."""

from itertools import pairwise

import numpy as np
import pytest
import test_adjust
from test_adjust import errors, run_of

from rille.stages.core.declare import NoParams
from rille.stages.geometry.geometry import RigidTransform, rotation_exp, rotation_log
from rille.stages.geometry.pose_arrays import NO_VERTICAL
from rille.stages.odometry.resection.adjust import adjust_stage
from rille.stages.odometry.resection.sensors import OwnTrajectory, RelativePrior, departure, resampled

TIMES = 0.1 * np.arange(31)
BASE = {"times": TIMES.tolist(), "timed": True, "georeference": {"origin": [-1e6, 0.0, 0.0], "azimuth": 0.0}}
AXES = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TURNED = rotation_exp([0.0, np.deg2rad(10.0), 0.0])


def winding(turn=0.6, change=0.5):
    """Poses T_world_left of a drive, about 1 m a frame; ``turn`` rad to either side, ``change`` of the speed."""
    poses, place = [], np.zeros(3)
    for t in TIMES:
        heading = turn * np.sin(2.5 * t)
        R = rotation_exp([0, 0, heading]) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        poses.append(RigidTransform(R, place))
        place = place + (1 + change * np.sin(2.1 * t)) * np.array([-np.sin(heading), np.cos(heading), 0.02])
    return poses


def late_by(truth, late):
    poses = resampled(np.array([T.matrix34 for T in truth]), TIMES, -late)
    return [RigidTransform.from_matrix(T) if np.isfinite(T).all() else None for T in poses]


def odometry(truth, rng, late=0.0, mount=None, scale=1.0):
    M, now, last, poses = np.eye(3) if mount is None else mount, RigidTransform.identity(), None, []
    drift, turn = 1 + 0.02 * rng.standard_normal(), 0.005 * rng.standard_normal(3)
    for T in late_by(truth, late):
        if T is not None and last is not None:
            step = last.inverse() @ T
            way = np.linalg.norm(step.translation)
            turned = rotation_exp(way * (turn + 0.005 * rng.standard_normal(3)))
            moved = drift * step.translation + 0.02 * way * rng.standard_normal(3)
            now = now @ RigidTransform(step.rotation @ turned, scale * moved)
        last = T
        poses.append(T and RigidTransform(M.T @ now.rotation @ M, M.T @ now.translation).to_list())
    return {**BASE, "odometry": {"poses": poses, "drift": 0.02, "turn": 0.005}}


def gnss(truth, rng, sigma=0.3, late=0.0, jump=0.0, lever=(0.0, 0.0, 0.0)):
    antenna = np.array([T.translation + T.rotation @ lever for T in truth])
    points = np.stack([np.interp(TIMES - late, TIMES, axis) for axis in antenna.T], axis=1)
    points += sigma * rng.standard_normal(points.shape)
    points[12:18, 0] += jump
    points = points @ rotation_exp([0, 0, 1.0]).T + [4.5e5, 5.4e6, 300.0]
    given = {"positions": points.tolist(), "times": TIMES.tolist(), "sigma": [sigma] * 3, "lever": [0.0] * 3}
    return {**BASE, "positions": given}


def adjusted(segments, trajectory, priors):
    return adjust_stage.run(NoParams(), {"priors": priors}, {"trajectory": trajectory, "segments": segments})


def nees(out, truth):
    e = errors(out, truth)
    rows = np.flatnonzero(np.isfinite(e).all(1))[1:]
    return np.mean([e[k] @ np.linalg.solve(out["covariance"][k], e[k]) for k in rows]) / 6


def test_noise_of_ways_looks_like_no_error_of_their_scale():
    truth, rows = np.array([T.matrix34 for T in winding()]), np.arange(31)
    own = OwnTrajectory(truth, np.zeros(31, np.int16), TIMES, rows)
    scales = []
    for seed in range(40):
        noise = 0.1 * np.random.default_rng(seed).standard_normal((31, 3))
        sensed = truth.copy()
        sensed[:, :, 3] += np.cumsum(
            noise * np.linalg.norm(np.diff(truth[:, :, 3], axis=0, prepend=0), axis=1)[:, None], 0
        )
        prior = RelativePrior(sensed, None, drift=0.1, turn=0.005)
        said = prior.factors(own, 0.0)
        shared, off = said.root @ said.shared, np.zeros((30, 6))
        off[:, :3] = np.einsum("kji,kj->ki", truth[:-1, :, :3], np.diff(truth[:, :, 3] - sensed[:, :, 3], axis=0))
        A = np.vstack([shared.reshape(180, -1), np.eye(shared.shape[2])])
        b = np.concatenate([(said.root @ off[:, :, None]).ravel(), np.zeros(shared.shape[2])])
        scales.append(np.linalg.lstsq(A, b)[0][[error.name for error in prior.shared_errors].index("scale")])
    assert abs(np.mean(scales)) < 3.0 * np.std(scales) / np.sqrt(40)


@pytest.mark.parametrize(("degrees", "used"), [(2.0, True), (6.0, False)])
def test_a_mount_that_is_a_little_off_does_not_turn_the_trajectory(degrees, used):
    truth, rng = winding(), np.random.default_rng(4)
    segments, before = run_of(truth, rng)
    mount = rotation_exp([0.0, np.deg2rad(degrees), 0.0])
    out = adjusted(segments, before, odometry(truth, rng, mount=mount))
    assert out.meta["priors"]["odometry"]["used"] == used
    assert used or "its mount about y is off by" in out.meta["priors"]["odometry"]["why"]
    assert np.linalg.norm(errors(out, truth)[:, :3], axis=1).max() < 0.4


@pytest.mark.parametrize("sensor", [odometry, gnss])
def test_a_sensor_joins_pieces_within_its_errors(sensor):
    truth, rng = winding(), np.random.default_rng(1)
    segments, before = run_of(truth, rng, lost=set(range(12, 19)))
    assert len(before.meta["pieces"]) == 2
    out = adjusted(segments, before, sensor(truth, rng))
    assert [(piece[0], piece[-1]) for piece in out.meta["pieces"]] == [(0, 30)]
    assert not [line for line in out.meta["warnings"] if line.startswith("[")]
    assert np.nanmax(np.linalg.norm(errors(out, truth)[:, :3], axis=1)) < 1.5
    assert 0.2 < nees(out, truth) < 3.0


def wheels(body, mount, rng):
    """Odometry on a plane of a body whose poses are true, as it would count its wheels."""
    now, poses = RigidTransform.identity(), [mount.to_list()]
    drift, turn = 1 + 0.02 * rng.standard_normal(), 0.005 * rng.standard_normal()
    for a, b in pairwise(body):
        step = a.inverse() @ b
        way = np.linalg.norm(step.translation)
        heading = rotation_log(step.rotation)[2] + way * (turn + 0.005 * rng.standard_normal())
        moved = (drift * step.translation + 0.02 * way * rng.standard_normal(3)) * [1.0, 1.0, 0.0]
        now = now @ RigidTransform(rotation_exp([0.0, 0.0, heading]), moved)
        poses.append((now @ mount).to_list())
    stated = {"drift": 0.02, "turn": 0.005, "up": mount.rotation[2].tolist()}
    return {**BASE, "odometry": {"poses": poses, **stated, "origin": mount.inverse().translation.tolist()}}


@pytest.mark.parametrize("bumps", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("lost", [(), range(12, 19)])
def test_wheels_on_rough_ground_are_believed_and_join_pieces(bumps, lost):
    rng, place, body = np.random.default_rng(1), np.zeros(3), []
    looks_ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ rotation_exp([-0.2, 0.0, 0.0])
    mount = RigidTransform(looks_ahead, np.array([0.3, 0.05, 1.2]))
    for t in TIMES:
        R = rotation_exp([0.0, 0.0, 0.6 * np.sin(2.5 * t)]) @ rotation_exp([*bumps * rng.standard_normal(2), 0.0])
        body.append(RigidTransform(R, place))
        place = place + (1 + 0.5 * np.sin(2.1 * t)) * R[:, 0]
    truth = [T @ mount for T in body]
    segments, before = run_of(truth, rng, lost=set(lost))
    out = adjusted(segments, before, wheels(body, mount, rng))
    assert out.meta["priors"]["odometry"]["used"]
    assert out.meta["priors"]["odometry"]["left_out"] <= 1
    assert [(piece[0], piece[-1]) for piece in out.meta["pieces"]] == [(0, 30)]
    assert 0.1 < nees(out, truth) < 3.0


def exact(truth, rng, late):
    return gnss(truth, rng, sigma=0.05, late=late)


@pytest.mark.parametrize("sensor", [odometry, gnss, exact])
def test_a_clock_that_is_late_is_found_and_stated(sensor):
    truth, rng = winding(), np.random.default_rng(2)
    segments, before = run_of(truth, rng)
    out = adjusted(segments, before, sensor(truth, rng, late=0.2))
    (fact,) = (f for name, f in out.meta["priors"].items() if name != "place")
    assert fact["late_s"] == pytest.approx(0.2, abs=max(0.02, 3 * fact["late_sigma_s"]))
    assert [line for line in out.meta["warnings"] if "time_offset" in line]
    assert np.linalg.norm(errors(out, truth)[:, :3], axis=1).max() < 0.4


@pytest.mark.parametrize("seed", range(3, 7))
def test_a_clock_that_no_motion_shows_is_said_not_to_be_determined_and_is_taken_as_right(seed):
    truth, rng = winding(turn=0.0, change=0.0), np.random.default_rng(seed)
    segments, before = run_of(truth, rng)
    out = adjusted(segments, before, gnss(truth, rng))
    assert not out.meta["priors"]["positions"]["clock_determined"]
    assert [line for line in out.meta["warnings"] if "not determined" in line]
    # At 10 m/s a clock that nothing determines would lead the place astray by metres.
    off = np.subtract(out.meta["priors"]["place"]["origin"], [4.5e5, 5.4e6, 300.0])
    assert np.linalg.norm(off[:2]) < 0.3
    stated = {"georeference": {"origin": [4.5e5, 5.4e6, 300.0], "azimuth": -1.0}}
    late = adjusted(segments, before, gnss(truth, np.random.default_rng(seed), late=0.3) | stated)
    assert not [line for line in late.meta["warnings"] if "stated place" in line]


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("stated", [None, {"origin": [4.5e5 + 9.0, 5.4e6, 300.0], "azimuth": -1.0}])
def test_a_place_is_said_to_be_that_of_the_frame_that_a_run_begins_at(first, stated):
    truth, rng = winding(), np.random.default_rng(8)
    segments, before = run_of(truth, rng)
    for segment in segments:
        for facts in segment.meta["per_frame"]:
            facts["frame"] += first
    before.meta["frames"] = [first + frame for frame in before.meta["frames"]]
    out = adjusted(segments, before, gnss(truth, rng) | {"georeference": stated})
    (line,) = (line for line in out.meta["warnings"] if "world.origin" in line)
    assert ("contradict" in line) == (stated is not None)
    assert ("world.origin of runs that begin at frame 3 is [" in line) == (first > 0)


def rotations(truth, M):
    R = [(M.T @ T.rotation @ M).tolist() for T in truth]
    return {**BASE, "attitude": {"rotations": R, "sigma": 0.003}}


def mirrored(truth, rng):
    given = gnss(truth, rng)
    given["positions"]["positions"] = [[y, x, z] for x, y, z in given["positions"]["positions"]]
    return given


def tilted(truth, rng):
    """Up of a sensor that is rolled by 10 degrees."""
    roll = rotation_exp([0.0, 0.0, np.deg2rad(10.0)])
    return {**BASE, "up": {"directions": [(roll @ T.rotation.T[:, 2]).tolist() for T in truth], "sigma": 0.005}}


def shifted(truth, rng, axis, by, sigma):
    """Positions of which the second half is off."""
    given = gnss(truth, rng, sigma=sigma)
    for place in given["positions"]["positions"][15:]:
        place[axis] += by
    return given


def slipping(truth, rng):
    """Wheels that slip on the second half."""
    given = odometry(truth, rng)
    poses = [RigidTransform.from_matrix(np.reshape(pose, (3, 4))) for pose in given["odometry"]["poses"]]
    slow = poses[:16]
    for before, after in pairwise(poses[15:]):
        step = before.inverse() @ after
        slow.append(slow[-1] @ RigidTransform(step.rotation, 0.8 * step.translation))
    given["odometry"]["poses"] = [pose.to_list() for pose in slow]
    return given


WRONG = {
    "half aside": (lambda truth, rng: shifted(truth, rng, 0, 1.0, 0.1), ("measurements contradict the others",)),
    "half too high": (lambda truth, rng: shifted(truth, rng, 2, 2.0, 0.1), ("measurements contradict the others",)),
    "slip": (slipping, ("measurements contradict the others",)),
    "vertical": (tilted, ("[attitude] or [imu]", "elevations are levelled by it", "T_body_left")),
    "turned": (lambda truth, rng: odometry(truth, rng, mount=TURNED), ("turned by 9", "T_body_left")),
    "axes": (lambda truth, rng: odometry(truth, rng, mount=AXES), ("T_body_left",)),
    "unit": (lambda truth, rng: odometry(truth, rng, scale=1.3), ("multiplied by 0.7", "unit")),
    "scale": (lambda truth, rng: odometry(truth, rng, scale=1.1), ("its scale is off by 9.5 %, 5 ")),
    "attitude turned": (
        lambda truth, rng: rotations(truth, rotation_exp([0.2, 0, 0])),
        ("turned by 1",),
    ),
    "mirrored": (mirrored, ("axes are exchanged", "columns")),
    "lever arm": (
        lambda truth, rng: gnss(truth, rng, sigma=0.05, lever=(2.0, 0.0, 0.0)),
        ("lever_arm",),
    ),
}


def test_later_poses_lie_ahead():
    poses = np.tile(np.eye(3, 4), (31, 1, 1))
    poses[:, 0, 3] = 2 * TIMES
    np.testing.assert_allclose(resampled(poses, TIMES, 0.25)[:28, 0, 3], 2 * TIMES[:28] + 0.5)
    assert np.isnan(resampled(poses, TIMES, 0.25)[28:]).all()


def test_positions_without_heights_leave_the_heights_to_the_camera():
    truth, rng = winding(), np.random.default_rng(9)
    steep = [RigidTransform(T.rotation, T.translation + 0.01 * k**2 * np.eye(3)[2]) for k, T in enumerate(truth)]
    segments, before = run_of(steep, rng)
    given = gnss(steep, rng, sigma=0.1)
    given["positions"]["positions"] = [place[:2] for place in given["positions"]["positions"]]
    out = adjusted(segments, before, given)
    assert out.meta["priors"]["positions"]["left_out"] < 4
    assert np.abs(errors(out, steep)[:, 2]).max() < 0.3


@pytest.mark.parametrize(("stated", "contradicts"), [(0.1, False), (0.001, True)])
def test_a_turn_that_is_stated_leads_ways_aside(stated, contradicts):
    heading = 0.1 * np.arange(64)
    turned = np.array([[[np.cos(a), -np.sin(a), 0, 0], [np.sin(a), np.cos(a), 0, 0], [0, 0, 1, 0]] for a in heading])
    turned[1:, :, 3] = np.cumsum(turned[:-1, :, 1], axis=0)
    straight = np.tile(np.eye(3, 4), (64, 1, 1))
    straight[:, 1, 3] = np.arange(64)
    own = OwnTrajectory(straight, np.zeros(64, np.int16), np.arange(64.0), np.arange(64))
    assert bool(RelativePrior(turned, None, 0.02, stated).contradiction(own)) == contradicts


def test_degrees_of_latitude_are_named():
    own = np.random.default_rng(1).normal(size=(9, 3))
    assert "degrees are no metres" in departure(own, own / 1.11e5, 0.1, "ways")[1]
    # Nor is anything said to explain what it leaves nearly as it was.
    assert "leaves" not in departure(own, np.roll(own, 1, axis=0), 0.1, "ways")[1]
    assert "leaves" not in departure(own, -own + 0.4 * np.roll(own, 1, axis=0), 0.1, "ways")[1]


def test_a_turn_a_scale_or_both_are_named():
    own = np.random.default_rng(1).normal(size=(9, 3))
    turned = own @ rotation_exp([0.0, 0.3, 0.0])  # 17.2 degrees
    words = "is turned by 16.", "have to be multiplied by"
    for said, told in ((turned, words[:1]), (2.0 * own, words[1:]), (2.0 * turned, words)):
        off, how = departure(own, said, 0.1, "ways")
        assert off > 0.1
        assert [word in how for word in words] == [word in told for word in words]
        assert ("multiplied by 0.5," in how) == (words[1] in told)


def test_too_few_positions_contradict_nothing():
    truth, rng = winding(), np.random.default_rng(4)
    segments, before = run_of(truth, rng)
    few = gnss(truth, rng)
    few["positions"].update({key: few["positions"][key][:2] for key in ("positions", "times")})
    (line,) = (line for line in adjusted(segments, before, few).meta["warnings"] if line.startswith("["))
    assert "is not used: no piece" in line
    assert "contradicts" not in line
    assert "give more" in line
    assert "raise sigma" not in line


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_sensor_is_named_and_not_believed(case):
    make, facts = WRONG[case]
    truth, rng = winding(), np.random.default_rng(4)
    segments, before = run_of(truth, rng)
    out = adjusted(segments, before, make(truth, rng))
    (line,) = (line for line in out.meta["warnings"] if line.startswith("["))
    assert [fact for fact in ("not used", *facts) if fact not in line] == []
    np.testing.assert_allclose(out["poses"], before["poses"], atol=1e-9)


def test_a_vertical_that_drifts_does_not_strain_the_chain(monkeypatch):
    """The errors of the camera that would explain it are many times those that are stated."""
    monkeypatch.setattr(test_adjust, "STEP", 0.01 * test_adjust.STEP)
    monkeypatch.setattr(test_adjust, "SHARED", np.array([[0.0, 0.0, 4e-3, 1e-3, 0.0, 0.0]]).T)
    truth, rng = winding(turn=0.1), np.random.default_rng(4)
    segments, before = run_of(truth, rng)
    drift = np.deg2rad(0.1) * np.arange(31)
    up = [(rotation_exp([a, 0.0, 0.0]) @ T.rotation.T[:, 2]).tolist() for a, T in zip(drift, truth, strict=True)]
    out = adjusted(segments, before, {**BASE, "up": {"directions": up, "sigma": 0.004}})
    assert not out.meta["priors"]["up"]["used"]
    np.testing.assert_allclose(out["poses"], before["poses"], atol=1e-9)


def test_positions_that_are_off_for_a_while_are_left_out():
    truth, rng = winding(), np.random.default_rng(5)
    segments, before = run_of(truth, rng)
    out = adjusted(segments, before, gnss(truth, rng, sigma=0.1, jump=2.0))
    assert out.meta["priors"]["positions"]["left_out"] == 6
    assert np.linalg.norm(errors(out, truth)[:, :3], axis=1).max() < 0.3


@pytest.mark.parametrize("jump", [3.0, 300.0])
def test_odometry_that_jumps_once_goes_on_behind_it(jump):
    truth, rng = winding(), np.random.default_rng(5)
    segments, before = run_of(truth, rng)
    given = odometry(truth, rng)
    for pose in given["odometry"]["poses"][15:]:
        pose[3] += jump
    out = adjusted(segments, before, given)
    assert out.meta["priors"]["odometry"]["used"]
    assert out.meta["priors"]["odometry"]["left_out"] in (1, 2)
    assert np.linalg.norm(errors(out, truth)[:, :3], axis=1).max() < 0.5


def test_positions_that_jump_and_stay_there_are_refused_as_that():
    truth, rng = winding(), np.random.default_rng(5)
    segments, before = run_of(truth, rng)
    given = gnss(truth, rng, sigma=0.02)
    for place in given["positions"]["positions"][15:]:
        place[1] += 8.0
    (line,) = (line for line in adjusted(segments, before, given).meta["warnings"] if line.startswith("["))
    assert "not used" in line
    x, y, _ = given["positions"]["positions"][14]
    assert f"they jump by 7.8 m after ({x:.2f}, {y:.2f})" in line


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_positions_that_lengthen_the_cameras_ways_are_said_to(scale):
    truth, rng = winding(), np.random.default_rng(5)
    segments, before = run_of(truth, rng)
    longer = [RigidTransform(T.rotation, scale * T.translation) for T in truth]
    meta = adjusted(segments, before, gnss(longer, rng, sigma=0.05)).meta
    said = [line for line in meta["warnings"] if "by [positions] its ways are 1.02" in line and "baseline" in line]
    # The run is not complete: one of the two is wrong.
    assert said == [meta[key] for key in ("contradiction",) if key in meta]
    assert len(said) == (scale != 1.0)


def test_positions_say_where_the_world_lies():
    truth, rng = winding(), np.random.default_rng(6)
    segments, before = run_of(truth, rng)
    out = adjusted(segments, before, {**gnss(truth, rng, sigma=0.02), "georeference": None})
    place = out.meta["priors"]["place"]
    assert [line for line in out.meta["warnings"] if "world.origin" in line and "world.azimuth_deg" in line]
    np.testing.assert_allclose(place["origin"], [4.5e5, 5.4e6, 300.0], atol=0.1)
    # Nor is the first camera the origin of a world on a wall's plane.
    up = np.array([0.0, 0.0, 20.0])
    before.arrays["poses"] = before["poses"] + np.pad(up[:, None], ((0, 0), (3, 0)))
    high = adjusted(segments, before, {**gnss(truth, rng, sigma=0.02), "georeference": None})
    np.testing.assert_allclose(high.meta["priors"]["place"]["origin"], place["origin"], atol=0.1)
    assert place["azimuth_deg"] == pytest.approx(360 - np.rad2deg(1.0), abs=1.0)


def test_positions_without_heights_say_nothing_of_the_height_of_the_world():
    truth, rng = winding(), np.random.default_rng(6)
    segments, before = run_of(truth, rng)
    given = gnss(truth, rng, sigma=0.02)
    flat = {**given["positions"], "positions": [row[:2] for row in given["positions"]["positions"]]}
    (line,) = (
        line
        for line in adjusted(segments, before, {**given, "positions": flat, "georeference": None}).meta["warnings"]
        if "world.origin" in line
    )
    assert ", HEIGHT (not measured)]" in line


@pytest.mark.parametrize("heights", [True, False])
@pytest.mark.parametrize(("east", "turn", "named"), [(0.0, 0.0, 0), (1.0, 0.0, 1), (0.0, 1.5, 1), (5e4, 30.0, 0)])
def test_positions_contradict_a_stated_place(east, turn, named, heights):
    truth, rng = winding(), np.random.default_rng(6)
    segments, before = run_of(truth, rng)
    place = {"origin": [4.5e5 + east, 5.4e6, 300.0], "azimuth": np.deg2rad(turn) - 1.0}
    given = gnss(truth, rng, sigma=0.02)
    if not heights:
        given["positions"] |= {"positions": [row[:2] for row in given["positions"]["positions"]]}
    lines = adjusted(segments, before, {**given, "georeference": place}).meta["warnings"]
    assert len([line for line in lines if "contradict the stated place" in line]) == named


@pytest.mark.parametrize("lean", [0.0, 1.0])
def test_positions_show_that_the_world_leans(lean):
    truth, rng = winding(), np.random.default_rng(7)
    segments, before = run_of(truth, rng)
    turn = RigidTransform(rotation_exp([np.deg2rad(lean), 0.0, 0.0]), np.zeros(3))
    out = adjusted(segments, before, gnss([turn @ T for T in truth], rng, sigma=0.02))
    said = [line for line in out.meta["warnings"] if "the world leans by" in line]
    assert len(said) == bool(lean)
    if said:
        up = [float(word) for word in said[0].split("[")[-1].split("]")[0].split(",")]
        np.testing.assert_allclose(up, (turn @ truth[0]).rotation[2], atol=0.005)


def test_positions_that_jump_up_are_no_slope():
    truth, rng = winding(), np.random.default_rng(5)
    segments, before = run_of(truth, rng)
    out = adjusted(segments, before, shifted(truth, rng, 2, 3.0, 0.3))
    assert out.meta["priors"]["positions"]["left_out"] > 1
    assert not [line for line in out.meta["warnings"] if "the world leans by" in line]


def test_positions_are_not_compared_where_nothing_tells_of_the_vertical():
    truth, rng = winding(), np.random.default_rng(8)
    segments, before = run_of(truth, rng)
    turn = RigidTransform(rotation_exp([np.pi / 2, 0.0, 0.0]), np.zeros(3))
    given = gnss([turn @ T for T in truth], rng, sigma=0.02)
    before.meta["verticals"] = [NO_VERTICAL]
    said = [line for line in adjusted(segments, before, given).meta["warnings"] if "[positions]" in line]
    assert len(said) == 1
    assert "world.up" in said[0]


def test_how_the_frame_of_positions_is_turned_changes_nothing():
    """Nor where their moments lie between those of the images."""
    truth, rng = winding(), np.random.default_rng(9)
    segments, before = run_of(truth, rng)
    points, between, found = np.array([T.translation for T in truth]), TIMES[:-1] + 0.045, []
    points = np.stack([np.interp(between, TIMES, axis) for axis in points.T], axis=1)
    for angle in (0.0, 0.5 * np.pi):
        given = {"positions": (points @ rotation_exp([0, 0, angle])).tolist(), "times": between.tolist()}
        given |= {"sigma": [0.05] * 3, "lever": [0.0] * 3}
        found.append(adjusted(segments, before, {**BASE, "positions": given}))
        assert not [line for line in found[-1].meta["warnings"] if line.startswith("[")]
    np.testing.assert_allclose(found[0]["poses"], found[1]["poses"], atol=1e-6)


def test_the_vertical_holds_a_chain_upright():
    truth, rng = winding(), np.random.default_rng(7)
    segments, before = run_of(truth, rng)
    up = [(T.rotation.T @ rotation_exp(0.002 * rng.standard_normal(3))[2]).tolist() for T in truth]
    out = adjusted(segments, before, {**BASE, "up": {"directions": up, "sigma": 0.002}})
    tilt = [np.linalg.norm(errors(one, truth)[:, 3:5], axis=1).max() for one in (before, out)]
    assert tilt[1] < 0.7 * tilt[0]


@pytest.mark.parametrize(
    "link", [lambda truth, rng: {}, lambda truth, rng: odometry(truth, rng, scale=1.06)], ids=["attitude", "refused"]
)
def test_an_attitude_joins_no_pieces(link):
    """Nor does it hold together what odometry had joined, which then turns out to contradict the camera."""
    truth, rng = winding(), np.random.default_rng(5)
    segments, before = run_of(truth, rng, lost=set(range(12, 19)))
    attitude = {"rotations": [T.rotation.tolist() for T in truth], "sigma": 0.003}
    out = adjusted(segments, before, {**BASE, **link(truth, rng), "attitude": attitude})
    assert out.meta["pieces"] == before.meta["pieces"]
    posed = np.isfinite(out["poses"]).all((1, 2))
    assert np.isfinite(out["covariance"][posed]).all()
    # A degree and a half; without another sensor positions keep their errors.
    assert np.nanmax(np.linalg.norm(errors(out, truth)[:12, 3:], axis=1)) < 0.025


def test_positions_of_one_moment_lay_no_piece():
    truth, rng = winding(), np.random.default_rng(6)
    segments, before = run_of(truth, rng)
    near = gnss(truth, rng)
    near["positions"] |= {"times": [1.99, 2.0, 2.01], "positions": [near["positions"]["positions"][20]] * 3}
    (line,) = (line for line in adjusted(segments, before, near).meta["warnings"] if line.startswith("["))
    assert "is not used: no piece" in line


def test_wheels_at_rest_agree_with_a_camera_at_rest():
    rng = np.random.default_rng(7)
    ahead = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    truth = [RigidTransform(ahead, 2e-4 * rng.standard_normal(3)) for _ in TIMES]
    segments, before = run_of(truth, rng)
    still = {**BASE, "odometry": {"poses": [np.eye(3, 4).tolist()] * len(TIMES), "drift": 0.02, "turn": 0.005}}
    assert not [line for line in adjusted(segments, before, still).meta["warnings"] if "contradicts" in line]


def test_a_later_piece_does_not_say_where_the_world_lies():
    truth, rng = winding(), np.random.default_rng(8)
    segments, before = run_of(truth, rng, lost=set(range(12, 19)))
    given, wheels = gnss(truth, rng), odometry(truth, rng)["odometry"]
    given["positions"] |= {key: given["positions"][key][:12] for key in ("positions", "times")}
    # Dead reckoning that begins behind the gap joins nothing, and says nothing of the first piece.
    wheels["poses"] = [None] * 19 + wheels["poses"][19:]
    alone = adjusted(segments, before, given).meta
    both = adjusted(segments, before, {**given, "odometry": wheels}).meta
    assert both["pieces"] == before.meta["pieces"]
    assert both["priors"]["place"] == alone["priors"]["place"]
