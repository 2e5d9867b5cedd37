"""Errors of the intrinsics: found where the camera turns, with and without a lens; else part of the covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens
from rille.stages.odometry.resection import calibration_errors
from rille.stages.odometry.resection.bundle_adjustment import (
    SegmentAdjustment,
    SegmentState,
    SegmentTracks,
    adjust,
    pose_errors,
)
from rille.stages.odometry.resection.calibration_errors import (
    CORRECTED,
    NUMBERS,
    SegmentCameras,
    calibrated_anew,
    composed,
    contribution,
    corrected,
    toed_in,
    with_errors,
)
from rille.stages.odometry.resection.intrinsics import (
    IntrinsicsParams,
    common_errors,
    creeping_focus,
    intrinsics_stage,
    px_per_yaw,
)
from rille.stages.odometry.resection.landmarks import SegmentPoints, triangulated
from rille.stages.odometry.resection.resect import resect_segment
from rille.stages.odometry.resection.robust_pose import ResectParams

CAMERA = Camera(450.0, 450.0, 375.5, 239.5, 752, 480)
BENT = Lens(CAMERA, "radtan", (-0.28, 0.07, 0.0, 0.0))
PARAMS = ResectParams()
SIGMA = IntrinsicsParams().sigma
NAMES = NUMBERS
LEVEL = RigidTransform(rotation_exp(np.array([1.2, 0.1, -0.1])), np.array([0.3, 0.2, 1.0]))
T_RIGHT_LEFT = RigidTransform(np.eye(3), np.array([-0.12, 0.0, 0.0]))
POINTS = 80


def segment(
    seed: int,
    given: Camera,
    lens: Lens,
    turn: float,
    yaw: float = 0.0,
    base: RigidTransform = T_RIGHT_LEFT,
    ahead: float = 0.0,
) -> tuple[SegmentTracks, SegmentState, SegmentCameras]:
    """A camera of 450 px that turns by some ``turn`` radians, and is taken for the given one; true poses.

    The given rig's right camera is turned by ``yaw``, rad; between frames the camera moves ``ahead``, m, and aside.
    """
    rng = np.random.default_rng(seed)
    rig = calibrated_anew(Rig(given, given, base), [0.0, 0.0, 0.0, yaw])
    wrong = replace(lens, camera=given)

    def measured(points):
        pixels = wrong.undistort(lens.distort(CAMERA.project(points), CAMERA), given)
        return pixels + 0.1 * rng.standard_normal(pixels.shape)

    X = CAMERA.rays(rng.uniform([60, 40], [690, 440], (POINTS, 2))) * rng.uniform(2.0, 8.0, (POINTS, 1))
    moves = [
        RigidTransform(
            rotation_exp(turn * rng.standard_normal(3) * k), 0.1 * rng.standard_normal(3) - [0, 0, ahead * k]
        )
        for k in (1, 2)
    ]
    landmarks = triangulated(measured(X), measured(base.apply(X)), rig, LEVEL, np.full(POINTS, 0.2))
    pixels = np.array([measured(move.apply(X)) for move in moves])
    tracks = SegmentTracks(landmarks, pixels, np.ones((2, POINTS), bool), given)
    true = [move @ LEVEL.inverse() for move in moves]
    state = SegmentState(
        np.array([T.rotation for T in true]), np.array([T.translation for T in true]), np.zeros(POINTS)
    )
    lenses = {} if lens.ideal else {"left": wrong, "right": wrong}
    return tracks, state, SegmentCameras(rig, lenses, LEVEL)


def read_row_by_row(seed: int, time: float) -> tuple[SegmentTracks, SegmentState, SegmentCameras]:
    """A segment of a straight drive; the last row is read ``time``, in intervals between frames, after the first."""
    rng, velocity = np.random.default_rng(seed), np.array([0.02, -0.05, -0.25])
    X = CAMERA.rays(rng.uniform([60, 40], [690, 440], (POINTS, 2))) * rng.uniform(2.0, 8.0, (POINTS, 1))

    def seen(frame: int, base: RigidTransform):
        pixels = np.zeros((POINTS, 2))
        for _ in range(9):
            at = X + velocity * (frame + time * pixels[:, 1:] / CAMERA.height)
            pixels = CAMERA.project(base.apply(at))
        return pixels + 0.1 * rng.standard_normal(pixels.shape)

    rig, still = Rig(CAMERA, CAMERA, T_RIGHT_LEFT), RigidTransform.identity()
    landmarks = triangulated(seen(0, still), seen(0, T_RIGHT_LEFT), rig, LEVEL, np.full(POINTS, 0.2))
    pixels = np.array([seen(k, still) for k in (1, 2)])
    true = [RigidTransform(np.eye(3), velocity * k) @ LEVEL.inverse() for k in (1, 2)]
    state = SegmentState(
        np.array([T.rotation for T in true]), np.array([T.translation for T in true]), np.zeros(POINTS)
    )
    return SegmentTracks(landmarks, pixels, np.ones((2, POINTS), bool), CAMERA), state, SegmentCameras(rig, {}, LEVEL)


def facts_of(
    given: Camera,
    lens: Lens,
    turn: float = 0.05,
    yaw: float = 0.0,
    base: RigidTransform = T_RIGHT_LEFT,
    segments: int = 8,
    changed: bool = False,
    **known,
):
    """Facts that segments lead to, of a camera that is given, and of a rig that is off by a yaw; it may have been
    ``changed`` before."""
    return facts_from([segment(seed, given, lens, turn, yaw, base) for seed in range(segments)], turn, changed, **known)


def facts_from(segments, turn: float = 0.0, changed: bool = False, shown: float = 0.0, **known):
    """The same of given segments that turn by some radians; ``shown``: distances by later pairs, px of disparity."""
    parts = []
    for tracks, state, cameras in segments:
        end = adjust(tracks, state, PARAMS).state
        part = contribution(SegmentAdjustment(tracks, PARAMS), end, cameras)
        said = {"per_frame": [], "intrinsics": part._asdict() | {"turn_deg": 57.3 * turn}, "distance_px": shown}
        parts.append(Bundle({}, said))
    rig = Bundle({}, {"rig": cameras.rig.to_dict(), "changed": changed})
    known = {"given": cameras.rig.to_dict(), **known}
    return intrinsics_stage.run(IntrinsicsParams(), known, {"segments": parts, "rig": rig}).meta


def corrections(given: Camera, lens: Lens, turn: float = 0.1):
    """The camera that the run computes with, corrected and asked again as the flow does, and the last facts."""
    used, before = given, [0.0] * (CORRECTED + 1)
    for _ in range(4):
        facts = facts_of(used, lens, turn, before=before)
        if not any(facts["correction"]):
            break
        before = facts["corrected"]
        used = corrected(given, before)
    return used, facts


@pytest.mark.parametrize(("by", "lens"), [(0.1, Lens(CAMERA)), (0.03, BENT)], ids=["pinhole", "lens"])
@pytest.mark.parametrize("number", range(CORRECTED))
def test_a_wrong_number_is_corrected_where_the_camera_turns(number, by, lens):
    used, facts = corrections(corrected(CAMERA, by * np.eye(CORRECTED)[number]), lens)
    assert NAMES[number] in facts["contradiction"]
    assert facts["warnings"]
    off = np.array([used.fx - CAMERA.fx, used.cx - CAMERA.cx, used.cy - CAMERA.cy]) / CAMERA.fx
    assert np.abs(off).max() < 0.006


@pytest.mark.parametrize("lens", [Lens(CAMERA), BENT], ids=["pinhole", "lens"])
@pytest.mark.parametrize("roll", [0.0, 1.5, 2.9])
def test_right_numbers_are_believed(lens, roll):
    turned = rotation_exp([0.0, 0.0, roll])
    facts = facts_of(CAMERA, lens, 0.1, base=RigidTransform(turned, turned @ T_RIGHT_LEFT.translation))
    assert "contradiction" not in facts
    assert facts["correction"] == [0.0] * (CORRECTED + 1)
    errors, sigma = np.array(list(facts["errors"].values())).T
    assert (np.abs(errors) < 4.0 * sigma).all()
    assert NAMES[0] not in facts["held"]
    # A principal point that is off in both images alike leaves disparities as they are, however the right one lies.
    assert sigma[NAMES.index("toe-in")] < 0.05 * SIGMA[NAMES.index("toe-in")]


def test_a_straight_drive_rests_on_the_given_numbers_and_their_prior():
    facts = facts_of(corrected(CAMERA, [0.1, 0.0, 0.0]), Lens(CAMERA), turn=0.0)
    assert "contradiction" not in facts
    assert facts["held"] == list(NAMES[:-1])
    assert np.array(facts["covariance"])[:-1, :-1] == pytest.approx(np.diag(SIGMA[:-1] ** 2))


@pytest.mark.parametrize("centre", [(-0.12, 0.0, 0.0), (0.01, -0.12, 0.0)], ids=["side by side", "one above the other"])
@pytest.mark.parametrize("angle", [0.004, -0.003])
def test_poses_are_corrected_for_a_toe_in_that_a_straight_drive_shows(angle, centre):
    segments, poses, true = [], [], []
    for seed in range(6):
        tracks, state, cameras = segment(seed, CAMERA, Lens(CAMERA), 0.0, 0.0, RigidTransform(np.eye(3), centre), 0.5)
        rig, key = cameras.rig, LEVEL.inverse().apply(tracks.landmarks.position)
        left, right = rig.left.project(key), rig.right.project(rig.T_right_left.apply(key))
        off = toed_in(rig, angle)
        landmarks = triangulated(left, right, off, LEVEL, tracks.landmarks.sigma)
        segments.append((replace(tracks, landmarks=landmarks), state, cameras._replace(rig=off)))
        end = adjust(segments[-1][0], state, PARAMS).state
        poses.append(-np.einsum("fji,fj->fi", end.R, end.t))
        true.append(-np.einsum("fji,fj->fi", state.R, state.t))
    facts = facts_from(segments)
    found, sigma = facts["errors"]["toe-in"]
    assert found == pytest.approx(-angle, abs=4.0 * sigma)
    assert abs(angle) > 8.0 * sigma
    assert not any(facts["correction"])
    parts = [contribution(SegmentAdjustment(tracks, PARAMS), state, cameras) for tracks, state, cameras in segments]
    by = found * np.array([part.by_error[:, :3, -1] for part in parts])
    before, after = (np.linalg.norm((np.array(poses) + part - true).mean((0, 1))) for part in (0.0, by))
    assert after < 0.3 * before


@pytest.mark.parametrize("yaw", [0.003, -0.006])
@pytest.mark.parametrize(
    ("centre", "roll", "name"),
    [
        ((-0.12, 0.0, 0.0), 0.0, "yaw"),
        ((0.01, -0.12, 0.0), 0.0, "pitch"),
        ((-0.12, 0.0, 0.0), -1.5, "pitch"),
        ((-0.08, 0.09, 0.0), 0.0, "yaw"),
        ((-0.12, 0.0, 0.0), -0.6, "yaw"),
    ],
)
def test_a_wrong_yaw_is_corrected_on_a_straight_drive(yaw, centre, roll, name):
    """Of cameras one above the other, or one on its side, it is the pitch that moves all disparities."""
    turned = rotation_exp([0.0, 0.0, roll])
    off, before, base = yaw, 0.0, RigidTransform(turned, turned @ np.array(centre))
    for _ in range(4):
        facts = facts_of(CAMERA, Lens(CAMERA), turn=0.0, yaw=off, base=base, before=[0.0, 0.0, 0.0, before])
        assert facts["correction"][:CORRECTED] == [0.0] * CORRECTED
        off, before = off + facts["correction"][-1], before + facts["correction"][-1]
        if not facts["correction"][-1]:
            break
    assert abs(off) * CAMERA.fx < 0.15
    assert "contradiction" not in facts  # all that rests on it is computed anew
    assert f"{np.degrees(before):+.3f}" in facts["warnings"][0]
    assert f"degrees ({name})" in facts["warnings"][0]
    assert facts["warnings"][0].endswith("; corrected")


def test_a_yaw_is_kept_where_the_rig_is_fixed():
    facts = facts_of(CAMERA, Lens(CAMERA), turn=0.0, yaw=0.003, fixed=True)
    assert not any(facts["correction"])
    assert "kept because rig.mode = fixed" in facts["contradiction"]


@pytest.mark.parametrize("time", [0.9, 0.5, -0.6, 0.0, 2.5])
def test_rows_of_unlike_times_are_named_and_no_rig_is_repaired(time):
    """No row is read later than the next image."""
    facts = facts_from([read_row_by_row(seed, time) for seed in range(5)])
    assert time > 1.0 or not any(facts["correction"])
    assert ("rolling shutter" in facts.get("contradiction", "")) == (0.0 < abs(time) < 1.0)
    assert time > 1.0 or [line for line in facts["warnings"] if "rolling shutter" not in line] == []
    if 0.0 < abs(time) < 1.0:
        assert float(facts["contradiction"].split("ask for ")[1].split()[0]) == pytest.approx(time, rel=0.3)


@pytest.mark.parametrize(("step", "segments"), [(0.001, 5), (-0.0003, 8), (0.0, 5), (0.003, 3)])
def test_a_rig_that_bends_along_the_way_is_named(step, segments):
    parts = [segment(k, CAMERA, Lens(CAMERA), 0.0, step * (k - segments // 2)) for k in range(segments)]
    doubt = facts_from(parts).get("contradiction", "")
    assert ("the rig bends" in doubt) == (step != 0.0 and segments > 3)
    if doubt:
        change = float(doubt.split("turns by ")[1].split()[0])
        assert change == pytest.approx(np.degrees(-step * (segments - 1)), rel=0.2)


@pytest.mark.parametrize(("share", "scatter", "creeps"), [(1.0, 0.2, 1), (0.1, 0.1, 0), (-1.0, 0.2, 0), (1.0, 5.0, 0)])
def test_a_focus_that_creeps_is_told_from_a_wrong_yaw(share, scatter, creeps):
    """Later pairs show landmarks at other distances by the ``share`` of the yaw that is corrected."""
    parts = [segment(seed, CAMERA, Lens(CAMERA), 0.0) for seed in range(6)]
    rig, turn = parts[0][2].rig, 0.005
    expected = -turn * px_per_yaw(rig) * share
    shown = [Bundle({}, {"distance_px": expected + scatter * k}) for k in (-2, -1, 0, 1, 2)]
    assert bool(creeping_focus(shown, turn, rig)) == creeps
    assert not creeping_focus(shown, 0.0, rig)
    facts = facts_from(parts, shown=expected, changed=True, before=[0.0, 0.0, 0.0, turn])
    assert ("the focus of both cameras creeps" in facts.get("contradiction", "")) == (share == 1.0)


def test_a_yaw_below_half_a_pixel_passes():
    facts = facts_of(CAMERA, Lens(CAMERA), turn=0.0, yaw=0.2 / CAMERA.fx)
    assert facts["correction"] == [0.0] * (CORRECTED + 1)
    assert facts["yaw"][0] == pytest.approx(-0.2 / CAMERA.fx, abs=4.0 * facts["yaw"][1])


@pytest.mark.parametrize("segments", [1, 2])
def test_two_segments_that_agree_tell_a_yaw(segments):
    facts = facts_of(CAMERA, Lens(CAMERA), turn=0.0, yaw=0.006, segments=segments)
    assert facts["correction"][-1] == pytest.approx(-0.006 * (segments > 1), abs=0.001)


@pytest.mark.parametrize(("yaw", "repaired"), [(0.012, 0.0), (-0.012, 0.0), (-0.012, 0.05)])
@pytest.mark.parametrize("refused", [4, 1])
@pytest.mark.parametrize("centre", [(-0.12, 0.0, 0.0), (0.01, -0.12, 0.0)], ids=["side by side", "one above the other"])
def test_a_yaw_with_which_no_frame_has_a_pose_is_corrected(yaw, repaired, refused, centre):
    """Where most segments agree on it: one alone may have changed its focal length. Of the given rig, which the images
    may have ``repaired`` by too much."""
    base, parts = RigidTransform(np.eye(3), np.array(centre)), []
    for seed in range(refused):
        tracks, _, cameras = segment(seed, CAMERA, Lens(CAMERA), 0.0, yaw, base, 0.5)
        key = CAMERA.project(LEVEL.inverse().apply(tracks.landmarks.position))
        points = SegmentPoints(np.stack([key, *tracks.pixels], 1), tracks.landmarks, CAMERA, LEVEL)
        parts.append({"per_frame": resect_segment(points, [0, 1, 2], PARAMS).facts, "intrinsics": {}})
    parts += [{"per_frame": [], "intrinsics": {}}] * (4 - refused)
    used = Bundle({}, {"rig": cameras.rig.to_dict(), "changed": bool(repaired)})
    given = {"given": calibrated_anew(cameras.rig, [0.0, 0.0, 0.0, -repaired]).to_dict()}
    segments = [Bundle({}, one) for one in parts]
    facts = intrinsics_stage.run(IntrinsicsParams(), given, {"segments": segments, "rig": used}).meta
    assert facts["correction"][-1] == pytest.approx((repaired - yaw) * (refused > 1), rel=0.1)


@pytest.mark.parametrize("changed", [False, True])
def test_of_a_rig_that_was_repaired_no_yaw_is_known_before(changed):
    """The right camera was knocked: a yaw below half a pixel, which passes with a calibration, is corrected."""
    facts = facts_of(CAMERA, Lens(CAMERA), turn=0.0, yaw=0.3 / CAMERA.fx, changed=changed)
    assert facts["correction"][-1] * CAMERA.fx == pytest.approx(-0.3 * changed, abs=0.1)
    assert ("inverse_depth_std" in facts) == changed


def test_a_yaw_that_is_left_in_a_repaired_rig_is_in_its_sigma():
    """Of some rigs that are off by less than is corrected, the error of inverse depth over its stated sigma."""
    ratios = []
    for yaw in (-0.09, -0.05, 0.05, 0.09):
        facts = facts_of(CAMERA, Lens(CAMERA), turn=0.0, yaw=yaw / CAMERA.fx, changed=True)
        left = yaw / CAMERA.fx + facts["correction"][-1]
        ratios.append(left / abs(T_RIGHT_LEFT.translation[0]) / facts["inverse_depth_std"])
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_covariances_contain_the_errors_of_the_calibration():
    """Monte Carlo: numbers drawn from a prior; NEES of straight segments and of some that turn."""
    sigma, rng = 0.015, np.random.default_rng(3)
    for turn in (0.0, 0.05):
        with_prior, without = [], []
        for seed in range(24):
            given = corrected(CAMERA, sigma * rng.standard_normal(CORRECTED))
            tracks, true, cameras = segment(100 + seed, given, Lens(CAMERA), turn)
            state = adjust(tracks, true, PARAMS).state
            problem = SegmentAdjustment(tracks, PARAMS)
            part, own = contribution(problem, state, cameras), pose_errors(problem, state)
            for f in range(2):
                T, Q = (RigidTransform(s.R[f], s.t[f]).inverse() for s in (state, true))
                turned = Q.rotation @ T.rotation.T
                error = np.append(Q.translation - T.translation, [turned[2, 1], turned[0, 2], turned[1, 0]])
                by_camera = sigma * part.by_error[f][:, :CORRECTED]
                shared = own.covariance[f] + by_camera @ by_camera.T
                with_prior.append(error @ np.linalg.solve(shared, error) / 6.0)
                without.append(error @ np.linalg.solve(own.covariance[f], error) / 6.0)
        assert 0.5 < np.mean(with_prior) < 1.5
        assert np.mean(without) > 2.0


def test_a_toe_in_moves_poses_as_the_change_with_it_says():
    tracks, true, cameras = segment(5, CAMERA, Lens(CAMERA), 0.05)
    problem, number = SegmentAdjustment(tracks, PARAMS), NAMES.index("toe-in")
    part = contribution(problem, adjust(tracks, true, PARAMS).state, cameras)
    by = 2e-4
    other = with_errors(tracks, cameras, by * np.eye(len(NAMES) + 1)[number])
    before, after = adjust(tracks, true, PARAMS).state, adjust(other, true, PARAMS).state
    for f in range(2):
        T, moved = (RigidTransform(s.R[f], s.t[f]).inverse() for s in (before, after))
        expected = by * part.by_error[f][:3, number]
        assert np.abs(moved.translation - T.translation - expected).max() < 0.2 * np.abs(expected).max()


def test_segments_that_scatter_by_more_than_they_claim_widen_the_error():
    k = len(NAMES)
    value = 0.003 * np.random.default_rng(1).standard_normal((400, k))
    information = np.tile(1e6 * np.eye(k), (400, 1, 1))  # claimed: 0.001
    common = common_errors(information, 1e6 * value, np.ones(k))
    assert np.sqrt(np.diag(common.covariance)) == pytest.approx(np.full(k, 0.003 / 20.0), rel=0.15)
    assert (np.abs(common.errors) < 4.0 * 0.003 / 20.0).all()


def test_two_corrections_one_after_the_other_are_one():
    first, second = np.array([0.1, 0.02, -0.03, 0.01]), np.array([-0.05, 0.01, 0.02, -0.004])
    camera = Camera(450.0, 430.0, 375.5, 239.5, 752, 480)
    twice, once = corrected(corrected(camera, first), second), corrected(camera, composed(first, second))
    np.testing.assert_allclose(twice.matrix, once.matrix, rtol=1e-12)


def test_a_camera_at_rest_tells_no_time_between_its_rows():
    tracks, state, cameras = read_row_by_row(1, 0.0)
    here = CAMERA.project(LEVEL.inverse().apply(tracks.landmarks.position))
    at = LEVEL.inverse()
    state = state._replace(R=np.array([at.rotation] * 2), t=np.array([at.translation] * 2))
    part = contribution(SegmentAdjustment(replace(tracks, pixels=np.array([here, here])), PARAMS), state, cameras)
    assert part.read_out == pytest.approx((0.0, 0.0), abs=1.0)  # standard deviation of an interval at least


def test_the_time_between_the_rows_is_found_beside_poses_bias_and_errors_of_a_usual_calibration():
    rng, bias, prior = np.random.default_rng(5), 0.3, 1e11
    at = 6  # the bias, behind the poses; then the errors, and the time
    truth = np.concatenate([rng.normal(size=at + 1), np.zeros(len(calibration_errors.NUMBERS)), [0.7]])
    design = 1e4 * rng.normal(size=(80, len(truth)))

    def found(design):
        matrix, right = design.T @ design, design.T @ design @ truth
        matrix[at, at] += prior
        right[at] -= prior * bias  # which draws the bias to zero
        return calibration_errors._of_read_out(matrix, right, prior, bias)

    information, pull = found(design)
    assert pull / information == pytest.approx(0.7, abs=1e-4)
    # The focal length, known to half a per cent, does the same to the images as the time.
    design[:, at + 1] = design[:, -1]
    information, pull = found(design)
    assert information == pytest.approx(0.005**-2.0, rel=1e-3)
    assert pull / information == pytest.approx(0.7, abs=1e-3)
