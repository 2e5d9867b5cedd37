"""Joint refinement: derivatives against differences, what it gains, that it never loses, and the stage's wiring."""

import math
from dataclasses import replace

import numpy as np
import pytest
from raising import raises

from rille.pipeline.engine.store.output_digest import output_digest
from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.odometry.resection import common_tilt as tilt_stage
from rille.stages.odometry.resection.bundle_adjustment import (
    RefineParams,
    SegmentState,
    SegmentTracks,
    _step,
    adjust,
    cost_of,
    normal,
    posterior,
    scatter,
    tilt_of,
)
from rille.stages.odometry.resection.common_tilt import common_tilt
from rille.stages.odometry.resection.landmarks import landmarks_from_disparity
from rille.stages.odometry.resection.refine import (
    SegmentOut,
    SegmentStart,
    _adjusted,
    _tilt_pattern,
    claims,
    parts,
    refine_stage,
    views_of,
)
from rille.stages.odometry.resection.resect import ResectParams

CAMERA = Camera(500.0, 500.0, 299.5, 199.5, 600, 400)
RIG = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0])))
PARAMS = RefineParams()


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
    views = SegmentTracks(
        X - (error + bias)[:, None] * per_pixel,
        per_pixel,
        np.full(n, noise),
        pixels,
        np.ones((frames - 1, n), bool),
        CAMERA,
        500.0 * np.prod(CAMERA.rays(key)[:, :2], axis=1),
    )
    start = [P @ RigidTransform(rotation_exp(1e-4 * rng.standard_normal(3)), 3e-3 * rng.standard_normal(3)) for P in T]
    return (
        views,
        SegmentState(np.array([P.rotation for P in start]), np.array([P.translation for P in start]), np.zeros(n)),
        T,
    )


def error_of(state, T):
    return float(
        np.sqrt(
            np.mean(
                [np.sum((-R.T @ t - P.inverse().translation) ** 2) for R, t, P in zip(state.R, state.t, T, strict=True)]
            )
        )
    )


def test_gradient_is_that_of_the_cost():
    views, state, _ = scene(1, n=20)
    state = replace(state, depth=np.linspace(-0.3, 0.3, 20))
    _, _, _, pose, depth = normal(views, state, 0.0, 0.2)
    base = np.zeros((3, 6))

    def cost(step, depths=0.0, bias=0.0):
        return cost_of(views, state.moved(step, depths * np.ones(20)), bias, 0.2)

    numeric = []
    for k in range(18):
        e = base.copy()
        e.flat[k] = 1e-6
        numeric.append((cost(e) - cost(-e)) / 2e-6)
    numeric.append((cost(base, bias=1e-6) - cost(base, bias=-1e-6)) / 2e-6)
    np.testing.assert_allclose(pose, numeric, rtol=1e-3, atol=0.5)
    assert depth.sum() == pytest.approx((cost(base, 1e-6) - cost(base, -1e-6)) / 2e-6, rel=1e-4)


def test_without_noise_the_truth_is_found():
    views, start, T = scene(2, noise=1e-6)
    views = replace(views, sigma=np.full(150, 0.2))
    (state,), bias, before, after = adjust([(views, start)], PARAMS)
    assert error_of(state, T) < 1e-6
    assert abs(bias) < 1e-4
    assert after < 1e-6 * before


def test_shared_depths_lower_the_error():
    gains = []
    for seed in range(8):
        views, start, T = scene(10 + seed)
        (state,), _, before, after = adjust([(views, start)], PARAMS)
        assert after <= before
        gains.append([error_of(state, T), error_of(start, T)])
    found, given = np.sqrt(np.mean(np.square(gains), axis=0))
    assert found < 0.5 * given


def test_a_bias_of_all_disparities_is_found_by_many_segments():
    parts = [scene(30 + k, bias=0.3) for k in range(5)]
    _, bias, _, _ = adjust([(v, s) for v, s, _ in parts], RefineParams(bias_sigma=1.0))
    assert bias == pytest.approx(0.3, abs=0.1)


def test_landmarks_are_freed_of_the_bias():
    starts, out = [], []
    for k in range(5):
        views, state, _ = scene(30 + k, bias=0.3)
        starts.append(SegmentStart(views, state, [1, 2, 3], np.arange(150)))
        sizes = (4, 3, 4), (4, 6, 6), (4, 6, 7), (150, 3)
        out.append(SegmentOut(*(np.zeros(size) for size in sizes), np.zeros((150, 4), np.uint8)))
    _adjusted(starts, out, RefineParams(bias_sigma=1.0))
    off = []
    for one, found in zip(starts, out, strict=True):
        along = one.views.along
        truth = along * np.sqrt(100.0 / along[:, 2:])  # along[2] is Z^2 / (f B)
        off.append(((found.landmarks - truth) * along).sum(1) / (along**2).sum(1))
    assert abs(np.mean(off)) < 0.1  # pixels; as given, -0.3


def test_the_cost_never_rises_and_an_optimum_stays():
    views, start, _ = scene(3)
    (state,), *_ = adjust([(views, start)], PARAMS)
    (again,), _, before, after = adjust([(views, state)], RefineParams(iterations=1))
    assert after <= before
    np.testing.assert_allclose(again.t, state.t, atol=1e-4)


def test_the_cost_that_is_told_is_that_of_the_result():
    parts = [scene(30 + k, bias=0.3)[:2] for k in range(2)]
    states, bias, before, after = adjust(parts, RefineParams(bias_sigma=1.0, iterations=1))
    assert abs(bias) > 0.01
    assert before == sum(cost_of(views, start, 0.0, 0.2) for views, start in parts)
    again = sum(cost_of(views, state, bias, 0.2) for (views, _), state in zip(parts, states, strict=True))
    assert after == pytest.approx(0.5 * bias**2 + again, rel=1e-12)


def test_a_step_solves_the_damped_equations_of_all_unknowns():
    """Poses and depths of two segments and their one bias in one matrix, whose diagonal is damped (Marquardt)."""
    given, damping, prior, bias, n, m = [scene(50 + k, n=20)[:2] for k in range(2)], 0.3, 100.0, 0.05, 20, 18
    parts = [normal(views, state, bias, 0.2) for views, state in given]
    size = 2 * (m + n) + 1
    whole, gradient = np.zeros((size, size)), np.zeros(size)
    whole[-1, -1], gradient[-1] = prior, prior * bias
    for k, (A, B, d, ga, gd) in enumerate(parts):
        poses = [*range(k * (m + n), k * (m + n) + m), size - 1]
        depths = range(k * (m + n) + m, (k + 1) * (m + n))
        whole[np.ix_(poses, poses)] += A
        whole[np.ix_(poses, depths)], whole[np.ix_(depths, poses)] = B, B.T
        whole[np.ix_(depths, depths)] = np.diag(d)
        gradient[poses] += ga
        gradient[depths] = gd
    right = np.linalg.solve(whole + damping * np.diag(np.diag(whole)), -gradient)
    common, steps = _step(parts, prior, bias, damping)
    found = np.concatenate([*(np.append(pose.ravel(), depth) for pose, depth in steps), [common]])
    np.testing.assert_allclose(found, right, rtol=1e-6, atol=1e-9)


def whitened(views, state, X, bias):
    """Errors of tracks, of depths and of the bias over their standard deviations; ``X`` (n, 3) landmarks, m."""
    tracks = [(CAMERA.project(X @ R.T + t) - p) / 0.2 for R, t, p in zip(state.R, state.t, views.pixels, strict=True)]
    return np.concatenate([*(t.ravel() for t in tracks), state.depth / views.sigma, [bias / 0.1]])


def test_what_a_segment_tells_of_the_tilt_is_what_remains_of_all_unknowns():
    """Poses, depths and the bias eliminated from the whole matrix, derivatives by differences."""
    views, state, _ = scene(6, n=25, frames=3)
    (state,), bias, *_ = adjust([(views, state)], PARAMS)
    n, m = 25, 2

    def residuals(x):
        """Whitened errors of tracks, of depths and of the bias; the last unknown tilts the landmarks alone."""
        moved, b = state.moved(x[:12].reshape(m, 6), x[12 : 12 + n]), bias + x[-2]
        X = views.position + (moved.depth + b + x[-1] * views.tilt)[:, None] * views.along
        return whitened(views, moved, X, b)

    here = residuals(np.zeros(12 + n + 2))
    steps = 1e-6 * np.eye(12 + n + 2)
    J = np.array([(residuals(e) - residuals(-e)) / 2e-6 for e in steps]).T
    size = np.linalg.norm(here[: 2 * m * n].reshape(-1, 2), axis=1)
    weight = np.concatenate([np.repeat(np.minimum(1, 2.5 / size), 2), np.ones(n + 1)])
    N, g = J.T @ (weight[:, None] * J), J.T @ (weight * here)
    others = np.linalg.solve(N[:-1, :-1], np.column_stack([N[:-1, -1], g[:-1]]))
    information, pull = tilt_of(views, state, bias, PARAMS)
    assert information == pytest.approx(N[-1, -1] - N[-1, :-1] @ others[:, 0], rel=1e-3)
    assert pull == pytest.approx(-(g[-1] - N[-1, :-1] @ others[:, 1]), rel=1e-3, abs=1e-3 * np.sqrt(information))


def test_the_covariance_is_the_inverse_of_the_whole_normal_matrix():
    """Depths and bias as unknowns among the others, none eliminated, derivatives by differences: the same blocks."""
    views, state, _ = scene(4, n=25, frames=3)
    (state,), bias, *_ = adjust([(views, state)], PARAMS)
    n, m = 25, 2

    def residuals(x):
        """Whitened errors of tracks, of depths and of the bias."""
        moved, b = state.moved(x[:12].reshape(m, 6), x[12 : 12 + n]), bias + x[-1]
        X = views.position + (moved.depth + b)[:, None] * views.along
        return whitened(views, moved, X, b)

    steps = 1e-6 * np.eye(12 + n + 1)
    J = np.array([(residuals(e) - residuals(-e)) / 2e-6 for e in steps]).T
    size = np.linalg.norm(residuals(np.zeros(12 + n + 1))[: 2 * m * n].reshape(-1, 2), axis=1)
    weight = np.concatenate([np.repeat(np.minimum(1, 2.5 / size), 2), np.ones(n + 1)])
    dense = np.linalg.inv(J.T @ (weight[:, None] * J))[:12, :12]
    ((noise, by_bias),) = posterior([normal(views, state, bias, 0.2)], [1.0], PARAMS)
    np.testing.assert_allclose(noise + np.outer(by_bias, by_bias), dense, rtol=1e-4, atol=1e-6 * np.abs(dense).max())
    # Of a window over the whole sequence all of the bias' error is shared; the sum is the same.
    ((own, shared),) = posterior([normal(views, state, bias, 0.2)], [1.0], PARAMS.model_copy(update={"window": 0}))
    np.testing.assert_allclose(own + np.outer(shared, shared), noise + np.outer(by_bias, by_bias), rtol=1e-9)
    assert (np.abs(shared) > np.abs(by_bias)).all()


@pytest.mark.parametrize("window", [1, 0])
def test_claimed_covariances_are_those_of_the_errors(window):
    """Squared errors over the claimed ones of many segments, noise as it is stated."""
    params = RefineParams(window=window)
    ratios = []
    for seed in range(60):
        rng = np.random.default_rng([seed, 1])
        views, start, T = scene(200 + seed, n=120, bias=0.1 * rng.standard_normal())
        (state,), bias, *_ = adjust([(views, start)], params)
        ((covariance, _),) = claims([(views, state)], bias, params)
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
        views = replace(views, sigma=np.full(150, 0.2))
        (state,), bias, *_ = adjust([(views, start)], PARAMS)
        assert scatter(views, state, bias, 0.2) == pytest.approx((noise / 0.2) ** 2, rel=0.25)


def tilted(seed, tilt, frames=4):
    """Tracks whose landmarks lie where disparities put them that are tilted by so many radians, adjusted once."""
    views, start, T = scene(seed, n=120, frames=frames, noise=0.05)
    views = replace(views, sigma=np.full(120, 0.2)).without_tilt(-tilt)
    (state,), bias, _, _ = adjust([(views, start)], PARAMS)
    return views, state, bias, T


SIGMA = np.radians(PARAMS.tilt_sigma_deg)


def told(adjusted):
    """Information and pull (segment, 2) of the tilt by adjusted segments."""
    return np.array([tilt_of(*one, PARAMS) for one in adjusted])


def test_a_tilt_of_all_disparities_is_found_by_many_segments_and_undone():
    parts = [tilted(60 + k, 0.004) for k in range(12)]
    tilt, sigma = common_tilt(told(part[:3] for part in parts), SIGMA)
    assert tilt == pytest.approx(0.004, abs=4 * sigma)
    assert sigma < 0.001
    errors = []
    for views, state, _, T in parts:
        (again,), *_ = adjust([(views.without_tilt(tilt), state)], PARAMS)
        errors.append([error_of(state, T), error_of(again, T)])
    before, after = np.sqrt(np.mean(np.square(errors), axis=0))
    assert after < 0.8 * before


def test_a_tilt_that_is_not_there_is_not_believed():
    parts = told(tilted(90 + k, 0.0)[:3] for k in range(12))
    tilt, sigma = common_tilt(parts, SIGMA)
    assert abs(tilt) < PARAMS.tilt_significance * sigma
    # Two segments say nothing of their scatter.
    assert common_tilt(parts[:2], SIGMA) == (0.0, float("inf"))


def test_the_common_tilt_is_the_mean_with_its_prior_and_a_segment_far_off_counts_as_one_at_two_deviations():
    information, prior = 4e6, 3e6
    same = np.tile([information, information * 0.001], (12, 1))
    tilt, sigma = common_tilt(same, prior**-0.5)
    assert tilt == pytest.approx(0.001 * 12 * information / (12 * information + prior))
    assert sigma == pytest.approx((12 * information + prior) ** -0.5)
    # Huber's mean: eleven at 0 and one far off balance where 11 t = 2 deviations.
    same[:, 1] = [0.0] * 11 + [20.0 * information**0.5]
    assert common_tilt(same, 1e6)[0] == pytest.approx(2.0 * information**-0.5 / 11, rel=1e-3)


def test_segments_that_scatter_by_more_than_they_claim_widen_the_tilt():
    rng = np.random.default_rng(1)
    value = 0.003 * rng.standard_normal(400)
    tilt, sigma = common_tilt(np.column_stack([np.full(400, 1e6), 1e6 * value]), 1e6)  # claimed: 0.001
    assert sigma == pytest.approx(0.003 / 20.0, rel=0.15)
    assert abs(tilt) < 4.0 * sigma


def test_the_stage_undoes_a_tilt_and_says_so():
    def stage(tilt):
        """Ten segments of three frames ahead of a wall; each right image as a camera turned by ``tilt`` has it."""
        one = bundles()
        rows, cols = np.mgrid[0:400, 0:600]
        x, y = (cols - 299.5) / 500.0, (rows - 199.5) / 500.0
        for k, depth in enumerate((4.0, 3.8)):
            bent = -500.0 * 0.2 / depth + tilt * 500.0 * (x - 0.2 / depth) * y
            one["disparities"][k] = Bundle({**one["disparities"][k].arrays, "column_disparity": np.float32(bent)}, {})
        rng, many = np.random.default_rng(8), []
        for _ in range(10):
            points = np.asarray(one["tracks"][0]["points"]) + 0.1 * rng.standard_normal((80, 3, 2))
            many.append(one | {"tracks": [Bundle({"points": points.astype(np.float32)}, {"frames": [0, 1, 2]})]})
        args = {"pairs": [0, 2], "resect": ResectParams().model_dump(mode="json")}
        found = [refine_stage.run(RefineParams(), args, given) for given in many]
        how = {"sigma_deg": PARAMS.tilt_sigma_deg, "significance": PARAMS.tilt_significance}
        common = tilt_stage.common_tilt_stage.run(NoParams(), how, {"segments": found, "rig": one["rigs"][0]})
        if common.meta["undone"]:
            found = [refine_stage.run(RefineParams(), args, given | {"tilt": common}) for given in many]
        return common.meta, found

    plain, bent = stage(0.0), stage(0.006)
    assert not plain[0]["undone"]
    assert "warnings" not in plain[0]
    assert bent[0]["undone"]
    assert abs(bent[0]["tilt_rad"]) == pytest.approx(0.006, rel=0.2)
    assert "principal point" in bent[0]["warnings"][0]
    straight = np.arange(3) * 0.1
    off = [max(np.abs(out["poses"][:, 2, 3] - straight).max() for out in found) for _, found in (plain, bent)]
    assert off[1] < 3 * off[0] + 0.002


STANDING = Rig(
    replace(CAMERA, fy=300.0), replace(CAMERA, fy=300.0), RigidTransform(np.eye(3), np.array([0.0, -0.2, 0.0]))
)


@pytest.mark.parametrize(("rig", "axis", "along"), [(RIG, [1.0, 0.0, 0.0], 0), (STANDING, [0.0, 1.0, 0.0], 1)])
def test_the_pattern_of_a_tilt_is_what_a_turned_camera_and_a_moved_row_or_column_make(rig, axis, along):
    X = np.random.default_rng(3).uniform([-2.0, -1.0, 3.0], [2.0, 1.0, 6.0], (50, 3))
    theta = 1e-5
    turned = rig.right.project(rig.T_right_left.apply(X) @ rotation_exp(theta * np.array(axis)).T)
    straight = rig.right.project(rig.T_right_left.apply(X))
    pattern = _tilt_pattern(X, RigidTransform.identity(), rig)
    np.testing.assert_allclose(np.abs(turned - straight)[:, along] / theta, np.abs(pattern), rtol=1e-3, atol=1e-2)
    # The whole of it is one sign: a tilt of either sign fits.
    sign = np.sign((turned - straight)[:, along] * pattern)
    assert np.all(sign[np.abs(pattern) > 1.0] == sign[np.abs(pattern) > 1.0][0])


def test_a_tilt_is_told_by_the_angle_and_the_axis_of_its_rig():
    words = [tilt_stage._words(0.01, 0.001, rig) for rig in (RIG, STANDING)]
    assert "0.57 +- 0.06 degrees of pitch stand for a principal point that is 5.0 rows off" in words[0]
    assert "0.57 +- 0.06 degrees of yaw stand for a principal point that is 5.0 columns off" in words[1]


def bundles(tracks_of_last=True):
    """A segment of three frames ahead of a textured wall, as the stages hand it over."""
    rng = np.random.default_rng(5)
    disparity = np.full((400, 600), -500.0 * 0.2 / 4.0, np.float32)
    pair = Bundle(
        {"column_disparity": disparity, "row_disparity": 0 * disparity, "validity": np.ones((400, 600), np.uint8)}, {}
    )
    later = Bundle({**pair.arrays, "column_disparity": np.full((400, 600), -500.0 * 0.2 / 3.8, np.float32)}, {})
    key = rng.uniform([60, 60], [540, 340], (80, 2))
    X = CAMERA.rays(key) * 4.0
    points = np.stack([CAMERA.project(X - [0.0, 0.0, 0.1 * j]) for j in range(3)], 1).astype(np.float32)
    poses = np.array([np.hstack([np.eye(3), [[0.0], [0.0], [0.1 * j + 0.002 * (j > 0)]]]) for j in range(3)])
    track = Bundle({"points": points}, {"frames": [0, 1, 2]})
    claimed = {"covariance": np.zeros((3, 6, 6)), "shared": np.zeros((3, 6, 7))}
    agreed = {"inlier": np.ones((80, 3), np.uint8), "landmarks": np.where(np.arange(80)[:, None] < 79, X, np.nan)}
    resection = Bundle({"poses": poses} | agreed | claimed, {})
    level = Bundle({}, {"T_local_left": RigidTransform.identity().to_list()})
    rig = Bundle({}, {"rig": RIG.to_dict()})
    return {
        "tracks": [track],
        "resections": [resection],
        "levels": [level],
        "disparities": [pair, later],
        "rigs": [rig] * 2,
    }


@pytest.mark.parametrize("window", [0, 1])
def test_the_stage_gives_the_poses_of_the_last_segment_or_of_all(window):
    one = bundles()
    inputs = {port: given * (1 if port in ("disparities", "rigs") else 2) for port, given in one.items()}
    args = {"pairs": [0, 2], "resect": ResectParams().model_dump(mode="json")}
    out = refine_stage.run(RefineParams(window=window), args, inputs)
    check_outputs(refine_stage, out)
    count = 2 if window == 0 else 1
    assert out.meta["frames"] == [3] * count
    np.testing.assert_allclose(out["poses"][:, :, 3], [[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]] * count, atol=2e-4)
    for k, (landmarks, inlier) in enumerate(parts(out)):
        for j in (1, 2):
            at = RigidTransform.from_matrix(out["poses"][3 * k + j]).inverse().apply(landmarks)
            off = CAMERA.project(at)[inlier[:, j] != 0] - one["tracks"][0]["points"][inlier[:, j] != 0, j]
            said = out.meta["per_frame"][2 * k + j - 1]
            assert said["frame"] == j
            assert said["inliers"] == len(off) > 70
            assert said["rms_px"] == pytest.approx(np.sqrt((off**2).sum(1).mean()))
            assert said["rms_px"] < 0.01
    assert not out["covariance"][::3].any()
    assert (np.linalg.eigvalsh(np.delete(out["covariance"], slice(0, None, 3), 0))[:, 0] > 0).all()
    with raises("RIL-416"):
        refine_stage.run(
            RefineParams(), args | {"resect": ResectParams(landmarks="dem").model_dump(mode="json")}, inputs
        )


def test_a_frame_that_keeps_no_landmark_keeps_its_pose_and_ends_nothing():
    """All landmarks of frame 1 are behind its camera: no image, no error of it, and no part in the adjustment."""
    given = bundles()
    back = RigidTransform(rotation_exp([0.0, math.pi, 0.0]), [0.0, 0.0, 0.1]).matrix34
    given["resections"][0].arrays["poses"][1] = back
    args = {"pairs": [0, 2], "resect": ResectParams().model_dump(mode="json")}
    out = refine_stage.run(PARAMS, args, given)
    output_digest({}, out.meta)  # can be committed
    np.testing.assert_array_equal(out["poses"][1], back)
    assert np.isfinite(out["covariance"]).all()
    assert not out["inlier"][:, 1].any()
    rows = [(row["frame"], row["inliers"] > 12, row["rms_px"] < 0.01) for row in out.meta["per_frame"]]
    assert rows == [(2, True, True)]
    assert out["poses"][2, 2, 3] == pytest.approx(0.2, abs=3e-4)


def test_a_lost_frame_stays_lost():
    inputs = bundles()
    for name in ("poses", "covariance", "shared"):
        inputs["resections"][0].arrays[name][1] = np.nan
    args = {"pairs": [0, 2], "resect": ResectParams().model_dump(mode="json")}
    out = refine_stage.run(PARAMS, args, inputs)
    for name in ("poses", "covariance", "shared"):
        assert np.isnan(out[name][1]).all()
        assert np.isfinite(out[name][[0, 2]]).all()
    assert out["poses"][2, 2, 3] == pytest.approx(0.2, abs=3e-4)
    track, resection = inputs["tracks"][0], inputs["resections"][0]
    known = landmarks_from_disparity(
        np.asarray(track["points"])[:, 0].astype(float),
        tuple(inputs["disparities"][0].arrays.values()),
        RIG,
        RigidTransform.identity(),
        np.full(80, 0.2),
        max_depth_ratio=0.2,
    )
    frames = views_of(track, resection, known, RIG).frames
    assert frames == [2]
    resection.arrays["poses"][2] = np.nan
    assert views_of(track, resection, known, RIG) is None
