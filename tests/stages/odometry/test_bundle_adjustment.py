"""Joint adjustment: derivatives against differences, what it gains, that it never loses, and a segment's poses."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rille.pipeline.engine.store.arrays import output_digest
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.projection import perturbed
from rille.stages.odometry.resection.bundle_adjustment import (
    PosedTracks,
    SegmentAdjustment,
    SegmentState,
    SegmentTracks,
    adjust,
    pose_errors,
)
from rille.stages.odometry.resection.calibration_errors import SegmentCameras
from rille.stages.odometry.resection.landmarks import Landmarks, SegmentPoints
from rille.stages.odometry.resection.pnp import pose_covariance
from rille.stages.odometry.resection.resect import SegmentPoses, adjust_segment
from rille.stages.odometry.resection.robust_pose import ResectParams

CAMERA = Camera(500.0, 500.0, 299.5, 199.5, 600, 400)
RIG = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0])))
PARAMS = ResectParams()


def scene(seed, n=150, frames=4, bias=0.0, noise=0.2):
    """A segment with noisy depths and tracks, the true state, and a start as resection would give it."""
    rng = np.random.default_rng(seed)
    key = rng.uniform([20, 20], [580, 380], (n, 2))
    depth = rng.uniform(2.0, 6.0, n)
    X = CAMERA.rays(key) * depth[:, None]
    per_pixel = (depth**2 / (500.0 * 0.2))[:, None] * CAMERA.rays(key)
    error = noise * rng.standard_normal(n)
    T = [
        RigidTransform(rotation_exp(0.01 * k * np.array([1, -2, 1])), np.array([0.02, 0.01, -0.1]) * k)
        for k in range(1, frames)
    ]
    pixels = np.array([CAMERA.project(P.apply(X)) for P in T]) + noise * rng.standard_normal((frames - 1, n, 2))
    known = Landmarks(X - (error + bias)[:, None] * per_pixel, per_pixel, np.full(n, noise), np.zeros(n))
    views = SegmentTracks(known, pixels, np.ones((frames - 1, n), bool), CAMERA)
    start = [P @ RigidTransform(rotation_exp(1e-4 * rng.standard_normal(3)), 3e-3 * rng.standard_normal(3)) for P in T]
    return (
        views,
        SegmentState(np.array([P.rotation for P in start]), np.array([P.translation for P in start]), np.zeros(n)),
        T,
    )


def said_to_be(views, sigma):
    """The same tracks, disparities being said to have this standard deviation."""
    return replace(views, landmarks=replace(views.landmarks, sigma=np.full(len(views.landmarks.sigma), sigma)))


def above_flat_ground(seed, n=400, disparity=6.0, noise=0.2):
    """A segment of a camera that looks straight down from afar, as a drone's does; every point has one true depth."""
    rng = np.random.default_rng(seed)
    key = rng.uniform([20, 120], [580, 380], (n, 2))
    depth, rays = 500.0 * 0.2 / disparity, CAMERA.rays(key)
    measured = disparity + noise * rng.standard_normal(n)
    T = [RigidTransform(np.eye(3), np.array([0.0, 0.04 * depth, 0.0]) * k) for k in range(1, 5)]
    pixels = np.array([CAMERA.project(P.apply(rays * depth)) for P in T]) + noise * rng.standard_normal((4, n, 2))
    Z = (500.0 * 0.2 / measured)[:, None]
    known = Landmarks(rays * Z, rays * Z / measured[:, None], np.full(n, noise), 1.0 / measured)
    R, t = np.array([P.rotation for P in T]), np.array([P.translation for P in T])
    return SegmentTracks(known, pixels, np.ones((4, n), bool), CAMERA), SegmentState(R, t, np.zeros(n))


def error_of(state, T):
    return float(
        np.sqrt(
            np.mean(
                [np.sum((-R.T @ t - P.inverse().translation) ** 2) for R, t, P in zip(state.R, state.t, T, strict=True)]
            )
        )
    )


def moved(state, step, depth=0.0, bias=0.0):
    """The state after steps of poses (frame, 6), depths and bias."""
    R, t = perturbed(state.R, state.t, step)
    return SegmentState(R, t, state.disparity + depth, state.bias + bias)


@pytest.mark.parametrize("seed", range(3))
def test_a_scene_of_one_depth_keeps_its_scale(seed):
    tracks, true = above_flat_ground(seed)
    found = adjust(tracks, true, PARAMS).state
    # The mean of 400 disparities is known to 0.2 % of them.
    assert np.linalg.norm(found.t[-1]) == pytest.approx(np.linalg.norm(true.t[-1]), rel=0.01)
    assert abs(found.bias) < 0.1 * PARAMS.bias_sigma


def test_gradient_is_that_of_the_cost():
    views, state, _ = scene(1, n=20)
    problem, state = SegmentAdjustment(views, PARAMS), state._replace(disparity=np.linspace(-0.3, 0.3, 20))
    normal, none = problem.normal(state), np.zeros((3, 6))

    def slope(step, **more):
        less = {name: -value for name, value in more.items()}
        return (
            problem.normal(moved(state, step, **more)).cost - problem.normal(moved(state, -step, **less)).cost
        ) / 2e-6

    numeric = [slope(e.reshape(3, 6)) for e in 1e-6 * np.eye(18)] + [slope(none, bias=1e-6)]
    np.testing.assert_allclose(normal.pose_gradient, numeric, rtol=1e-3, atol=0.5)
    assert normal.depth_gradient.sum() == pytest.approx(slope(none, depth=1e-6), rel=1e-4)


def test_without_noise_the_truth_is_found():
    views, start, T = scene(2, noise=1e-6)
    found = adjust(said_to_be(views, 0.2), start, PARAMS)
    assert error_of(found.state, T) < 1e-6
    assert abs(found.state.bias) < 1e-4
    assert found.after < 1e-6 * found.before


def test_shared_depths_lower_the_error():
    gains = []
    for seed in range(8):
        views, start, T = scene(10 + seed)
        found = adjust(views, start, PARAMS)
        assert found.after <= found.before
        gains.append([error_of(found.state, T), error_of(start, T)])
    found, given = np.sqrt(np.mean(np.square(gains), axis=0))
    assert found < 0.5 * given


def test_a_bias_of_all_disparities_is_found():
    found = [adjust(*scene(30 + k, bias=0.3)[:2], ResectParams(bias_sigma=1.0)).state.bias for k in range(5)]
    assert np.mean(found) == pytest.approx(0.3, abs=0.1)


def test_an_optimum_stays_and_its_cost_is_that_of_the_result():
    views, start, _ = scene(3)
    found = adjust(views, start, PARAMS)
    again = adjust(views, found.state, PARAMS)
    assert again.after <= again.before == SegmentAdjustment(views, PARAMS).normal(found.state).cost
    np.testing.assert_allclose(again.state.t, found.state.t, atol=1e-4)


def test_a_step_solves_the_damped_equations_of_all_unknowns():
    """Poses, bias and depths in one matrix, whose diagonal is damped (Marquardt)."""
    views, state, _ = scene(50, n=20)
    problem, damping = SegmentAdjustment(views, PARAMS), 0.3
    normal = problem.normal(state)
    whole = np.block([[normal.poses, normal.between], [normal.between.T, np.diag(normal.depths)]])
    gradient = np.concatenate([normal.pose_gradient, normal.depth_gradient])
    step = np.linalg.solve(whole + damping * np.diag(np.diag(whole)), -gradient)
    right, ahead = moved(state, step[:18].reshape(3, 6), step[19:], step[18]), problem.ahead(state, normal, damping)
    for name in SegmentState._fields:
        np.testing.assert_allclose(getattr(ahead, name), getattr(right, name), rtol=1e-6, atol=1e-9)


def test_the_covariance_is_the_inverse_of_the_whole_normal_matrix():
    """Depths and bias as unknowns among the others, none eliminated, derivatives by differences: the same blocks."""
    views, state, _ = scene(4, n=25, frames=3)
    state = adjust(views, state, PARAMS).state
    n, m = 25, 2

    def residuals(x):
        """Whitened errors of tracks, of depths and of the bias."""
        at = moved(state, x[:12].reshape(m, 6), x[12 : 12 + n], x[-1])
        X = views.landmarks.position + (at.disparity + at.bias)[:, None] * views.landmarks.per_pixel
        tracks = [(CAMERA.project(X @ R.T + t) - p) / 0.2 for R, t, p in zip(at.R, at.t, views.pixels, strict=True)]
        return np.concatenate([*(t.ravel() for t in tracks), at.disparity / views.landmarks.sigma, [at.bias / 0.1]])

    steps = 1e-6 * np.eye(12 + n + 1)
    J = np.array([(residuals(e) - residuals(-e)) / 2e-6 for e in steps]).T
    size = np.linalg.norm(residuals(np.zeros(12 + n + 1))[: 2 * m * n].reshape(-1, 2), axis=1)
    weight = np.concatenate([np.repeat(np.minimum(1, 2.5 / size), 2), np.ones(n + 1)])
    dense = np.linalg.inv(J.T @ (weight[:, None] * J))[:12, :12]
    matrix, _ = SegmentAdjustment(views, PARAMS).normal(state).without_depths()
    matrix[-1, -1] -= 100.0
    found = pose_covariance(matrix, 100.0)
    whole = found.noise + np.outer(found.by_bias, found.by_bias)
    np.testing.assert_allclose(whole, dense, rtol=1e-4, atol=1e-6 * np.abs(dense).max())


def test_claimed_covariances_are_those_of_the_errors():
    """Squared errors over the claimed ones of many segments, noise as it is stated."""
    ratios = []
    for seed in range(60):
        rng = np.random.default_rng([seed, 1])
        views, start, T = scene(200 + seed, n=120, bias=0.1 * rng.standard_normal())
        state = adjust(views, start, PARAMS).state
        covariance = pose_errors(SegmentAdjustment(views, PARAMS), state).covariance
        for R, t, true, claimed in zip(state.R, state.t, T, covariance, strict=True):
            found, right = RigidTransform(R, t).inverse(), true.inverse()
            turn = right.rotation @ found.rotation.T
            w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            error = np.concatenate([right.translation - found.translation, w])
            ratios.append(error @ np.linalg.solve(claimed, error) / 6)
    # Frames of a segment share landmarks, so some 60 independent sums of six squares: deviation of the mean 0.08.
    assert 0.75 < np.mean(ratios) < 1.3


def test_errors_larger_than_stated_widen_the_covariance():
    for noise in (0.1, 0.2, 0.3):
        views, start, _ = scene(5, noise=noise)
        views = said_to_be(views, 0.2)
        state = adjust(views, start, PARAMS).state
        assert SegmentAdjustment(views, PARAMS).scatter(state) == pytest.approx((noise / 0.2) ** 2, rel=0.25)


def posed_segment():
    """A segment of three frames ahead of a textured wall, posed one by one with errors of 2 mm."""
    rng = np.random.default_rng(5)
    key = rng.uniform([60, 60], [540, 340], (80, 2))
    X = CAMERA.rays(key) * 4.0
    tracks = np.stack([CAMERA.project(X - [0.0, 0.0, 0.1 * j]) for j in range(3)], 1).astype(np.float32)
    # Along the ray by Z^2 / (f B) a pixel.
    position, per_pixel = np.where(np.arange(80)[:, None] < 79, X, np.nan), CAMERA.rays(key) * 4.0**2 / (500.0 * 0.2)
    known = Landmarks(position, per_pixel, np.full(80, 0.2), np.zeros(80))
    points = SegmentPoints(tracks, known, CAMERA, RigidTransform.identity())
    segment = SegmentPoses.unposed(points)
    segment.poses[:] = [np.hstack([np.eye(3), [[0.0], [0.0], [0.1 * j + 0.002 * (j > 0)]]]) for j in range(3)]
    segment.covariance[:], segment.shared[:] = 0.0, 0.0
    segment.inlier[:79] = 1
    segment.facts.extend({"frame": j, "inliers": 79, "rms_px": 1.0} for j in range(3))
    return points, segment


CAMERAS = SegmentCameras(RIG, {}, RigidTransform.identity())


def test_a_segment_is_adjusted():
    points, segment = posed_segment()
    said = adjust_segment(points, segment, CAMERAS, PARAMS)
    output_digest({}, said)  # can be committed
    np.testing.assert_allclose(segment.poses[:, :, 3], [[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], atol=2e-4)
    for j in (1, 2):
        agrees = segment.inlier[:, j] != 0
        at = RigidTransform.from_matrix(segment.poses[j]).inverse().apply(segment.landmarks)
        off = (CAMERA.project(at) - points.tracks[:, j])[agrees]
        assert segment.facts[j]["inliers"] == len(off) > 70
        assert segment.facts[j]["rms_px"] == pytest.approx(np.sqrt((off**2).sum(1).mean()))
        assert segment.facts[j]["rms_px"] < 0.01
    assert not segment.covariance[0].any()
    assert (np.linalg.eigvalsh(segment.covariance[1:])[:, 0] > 0).all()
    assert segment.by_intrinsics[1:].any(axis=(1, 2)).all()


def test_a_frame_that_keeps_no_landmark_keeps_its_pose_and_ends_nothing():
    """All landmarks of frame 1 are behind its camera: no image, no error of it, and no part in the adjustment."""
    points, segment = posed_segment()
    back = RigidTransform(rotation_exp([0.0, math.pi, 0.0]), [0.0, 0.0, 0.1]).matrix34
    segment.poses[1] = back
    assert adjust_segment(points, segment, CAMERAS, PARAMS)
    np.testing.assert_array_equal(segment.poses[1], back)
    assert np.isfinite(segment.covariance).all()
    assert not segment.inlier[:, 1].any()
    assert segment.facts[1] == {"frame": 1, "inliers": 79, "rms_px": 1.0}
    assert segment.facts[2]["inliers"] > 12
    assert segment.facts[2]["rms_px"] < 0.01
    assert segment.poses[2, 2, 3] == pytest.approx(0.2, abs=3e-4)


def test_a_lost_frame_stays_lost():
    points, segment = posed_segment()
    given = (segment.poses, segment.covariance, segment.shared)
    for array in given:
        array[1] = np.nan
    segment.inlier[:, 1] = 0
    adjust_segment(points, segment, CAMERAS, PARAMS)
    for array in given:
        assert np.isnan(array[1]).all()
        assert np.isfinite(array[[0, 2]]).all()
    assert segment.poses[2, 2, 3] == pytest.approx(0.2, abs=3e-4)
    assert PosedTracks.of(points, segment.poses, segment.inlier).frames.tolist() == [2]
    segment.poses[2], segment.inlier[:, 2] = np.nan, 0
    before = segment.poses.copy()
    assert PosedTracks.of(points, segment.poses, segment.inlier) is None
    assert adjust_segment(points, segment, CAMERAS, PARAMS) == {}  # of a segment without a pose nothing is adjusted
    np.testing.assert_array_equal(segment.poses, before)
