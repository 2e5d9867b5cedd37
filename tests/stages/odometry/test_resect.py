"""Resection: Eq. 4, 5, 7, 8; Jacobian; exact, noisy and contaminated data; covariance; degenerate cases by name."""

from dataclasses import replace

import numpy as np
import pytest
from pointing_angles import angles_from_rotation, rotation_from_angles
from raising import raises
from scipy.optimize import least_squares
from scipy.stats import chi2

from rille.stages.core.declare import Bundle
from rille.stages.core.errors import DegenerateError
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import (
    Camera,
    Rig,
    RigidTransform,
    rotation_exp,
)
from rille.stages.geometry.projection import perturbed
from rille.stages.numeric.least_squares import levenberg_marquardt
from rille.stages.odometry.resection.landmarks import Landmarks
from rille.stages.odometry.resection.pnp import Observations, Pose, PoseAdjustment, back_projection
from rille.stages.odometry.resection.resect import (
    MIN_JUMP_PX,
    ResectInputs,
    SegmentPoints,
    jump_of,
    of_pair_behind,
    resect_segment,
)
from rille.stages.odometry.resection.robust_pose import ResectParams, resect

CAMERA = Camera(600.0, 610.0, 300.0, 250.0, 600, 500)
PARAMS = ResectParams()


def scene(rng, n=60, near=4.0, far=12.0):
    """Landmarks in the field of view of a pose near the identity (camera frame = local frame)."""
    pixels = rng.uniform([20, 20], [580, 480], (n, 2))
    return CAMERA.rays(pixels) * rng.uniform(near, far, (n, 1))


def true_pose(rng):
    return RigidTransform(rotation_exp(rng.normal(0, 0.05, 3)), rng.normal(0, 0.3, 3))


def seen(T_local_left, landmarks):
    return CAMERA.project(T_local_left.inverse().apply(landmarks))


def exact(landmarks):
    """Landmarks without errors, which their disparities do not move."""
    return Landmarks(landmarks, np.zeros_like(landmarks), *np.zeros((2, len(landmarks))))


def solve(landmarks, pixels, *, per_pixel=None, sigma=0.0, params=PARAMS, seed=0):
    """Resect from the identity; landmarks are exact unless told how they move with their disparity."""
    per_pixel = np.zeros_like(landmarks) if per_pixel is None else per_pixel
    known = replace(exact(landmarks), per_pixel=per_pixel, sigma=np.broadcast_to(sigma, len(landmarks)).astype(float))
    return resect(known, pixels, CAMERA, [RigidTransform.identity()], params.model_copy(update={"seed": seed}), 7)


def observed(landmarks, per_pixel, sigma, pixels, pixel_sigma=0.2, inverse_parallax=0.0):
    """Observations by the camera of these tests."""
    known = Landmarks(landmarks, per_pixel, sigma, np.full(len(sigma), inverse_parallax))
    return Observations(known, pixels, CAMERA, pixel_sigma)


def segment_poses(points, landmarks, key, frames):
    """Points of a segment, whose landmarks are exact, and its poses."""
    known = replace(exact(landmarks), lost={"too far": 3})
    given = SegmentPoints(points, known, CAMERA, key)
    return given, resect_segment(given, frames, PARAMS)


def test_projection_is_eq_4_with_t_the_translation_and_the_position_minus_rt_t():
    omega, phi, kappa = 0.1, -0.2, 0.3
    R, t = rotation_from_angles(omega, phi, kappa), np.array([0.1, -0.2, 0.5])
    T = CAMERA.matrix @ np.column_stack([R, t])  # Eq. 4
    X = np.array([[0.3, 0.4, 6.0], [-1.0, 0.5, 5.0]])
    h = np.column_stack([X, np.ones(2)]) @ T.T
    by_eq_7_and_8 = h[:, :2] / h[:, 2:]
    obs = observed(X, np.zeros((2, 3)), np.zeros(2), np.zeros((2, 2)), 1.0)
    by_us = back_projection(obs, Pose(R, t)).error
    np.testing.assert_allclose(by_us, by_eq_7_and_8, rtol=1e-12)
    rng = np.random.default_rng(0)
    landmarks = scene(rng)
    h = np.column_stack([landmarks, np.ones(len(landmarks))]) @ T.T
    found = solve(landmarks, h[:, :2] / h[:, 2:])
    np.testing.assert_allclose(found.T_local_left.translation, -R.T @ t, atol=1e-9)
    np.testing.assert_allclose(angles_from_rotation(found.T_local_left.rotation.T), (omega, phi, kappa), atol=1e-9)


@pytest.mark.parametrize("inverse_parallax", [0.0, 2.0])
def test_jacobian_against_central_differences(inverse_parallax):
    rng = np.random.default_rng(1)
    landmarks = scene(rng, 5)
    per_pixel = 0.1 * landmarks * rng.uniform(0.5, 2.0, (5, 1))
    sigma = np.array([0.0, 0.1, 0.2, 0.3, 0.5])
    T = true_pose(rng).inverse()
    pixels = rng.uniform(0, 500, (5, 2))
    obs = observed(landmarks, per_pixel, sigma, pixels, 0.3, inverse_parallax)
    errors = back_projection(obs, Pose(T.rotation, T.translation, 0.05))

    def plain(step):
        """Errors in pixels after a step of pose and bias."""
        R, t = perturbed(T.rotation[None], T.translation[None], step[None, :6])
        bias = 0.05 + step[6]
        return CAMERA.project((landmarks + bias / (1.0 - inverse_parallax * bias) * per_pixel) @ R[0].T + t[0]) - pixels

    numeric = np.array([(plain(e) - plain(-e)) / 2e-6 for e in 1e-6 * np.eye(7)])
    along = numeric[6] * sigma[:, None]
    for i in range(5):
        values, vectors = np.linalg.eigh(0.3**2 * np.eye(2) + np.outer(along[i], along[i]))
        root = vectors / np.sqrt(values) @ vectors.T  # held fixed within a step, as in reweighted least squares
        np.testing.assert_allclose(errors.jacobian[i], root @ numeric[:, i].T, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(errors.error[i], root @ plain(np.zeros(7))[i], rtol=1e-6)
        assert errors.stretch[i] == pytest.approx(np.sqrt(values[1]) / 0.3, rel=1e-6)
    np.testing.assert_allclose(errors.norm, np.linalg.norm(errors.error, axis=1))
    np.testing.assert_allclose(errors.pixels, np.linalg.norm(plain(np.zeros(7)), axis=1))


def test_a_landmark_just_before_the_camera_has_a_finite_error():
    """Of 2000 landmarks that far hypotheses put there; one NaN among the scores would win over all other poses."""
    rng = np.random.default_rng(8)
    landmarks = np.column_stack([rng.uniform([-30, -2], [30, 2], (2000, 2)), 10.0 ** rng.uniform(-6, -4, 2000)])
    per_pixel = landmarks + np.array([0.0, 0.0, 30.0])
    obs = observed(landmarks, per_pixel, np.full(2000, 0.2), rng.uniform([0, 0], [600, 500], (2000, 2)))
    assert np.isfinite(back_projection(obs, Pose.of(RigidTransform.identity())).norm).all()


def test_exact_data_give_the_exact_pose():
    rng = np.random.default_rng(2)
    for _ in range(5):
        T, landmarks = true_pose(rng), scene(rng)
        found = solve(landmarks, seen(T, landmarks))
        np.testing.assert_allclose(found.T_local_left.matrix34, T.matrix34, atol=1e-9)
        assert found.inlier.all()
        assert found.residual.max() < 1e-6


@pytest.mark.parametrize("column", [-900.0, 1600.0])
def test_images_cut_beside_the_axis_are_posed(column):
    rng = np.random.default_rng(2)
    T, landmarks, moved = true_pose(rng), scene(rng), [column - CAMERA.cx, 0.0]
    known = exact(landmarks)
    given = seen(T, landmarks) + moved, replace(CAMERA, cx=column), [RigidTransform.identity()]
    found = resect(known, *given, PARAMS, 7)
    np.testing.assert_allclose(found.T_local_left.matrix34, T.matrix34, atol=1e-9)


def test_large_motion_needs_no_good_start():
    rng = np.random.default_rng(3)
    T = RigidTransform(rotation_exp(np.array([0.1, 0.5, -0.2])), np.array([1.0, -0.5, 1.5]))
    landmarks = T.apply(scene(rng))
    pixels = seen(T, landmarks)
    pixels[:18] = rng.uniform([0, 0], [600, 500], (18, 2))
    found = solve(landmarks, pixels)
    np.testing.assert_allclose(found.T_local_left.matrix34, T.matrix34, atol=1e-8)


def test_thirty_percent_outliers_are_removed_and_no_more():
    rng = np.random.default_rng(4)
    T, landmarks = true_pose(rng), scene(rng, 200)
    pixels = seen(T, landmarks) + 0.2 * rng.standard_normal((200, 2))
    wrong = rng.permutation(200)[:60]
    pixels[wrong] += rng.choice([-1, 1], (60, 2)) * rng.uniform(3, 40, (60, 2))
    found = solve(landmarks, pixels)
    good = np.ones(200, bool)
    good[wrong] = False
    np.testing.assert_array_equal(found.inlier, good)  # threshold: 5 sigma
    error = found.T_local_left.translation - T.translation
    assert error @ np.linalg.solve(found.total[:3, :3], error) < chi2.ppf(0.999, 3)


def test_landmarks_just_over_the_threshold_go_one_by_one():
    rng = np.random.default_rng(16)
    T, landmarks = true_pose(rng), scene(rng, 80)
    pixels = seen(T, landmarks) + 0.05 * rng.standard_normal((80, 2))
    pixels[:16] += [1.4, 0.0]  # within reach of the robust start, and pulling all one way
    found = solve(landmarks, pixels)
    assert not found.inlier[:16].any()
    assert found.inlier[16:].all()
    assert found.residual[found.inlier].max() <= PARAMS.threshold


def test_same_minimum_as_scipy():
    rng = np.random.default_rng(5)
    T, landmarks = true_pose(rng), scene(rng, 40)
    pixels = seen(T, landmarks) + 0.2 * rng.standard_normal((40, 2))
    # Threshold and Huber bound far away: plain least squares of Eq. 6 in both.
    found = solve(landmarks, pixels, params=ResectParams(pixel_sigma=5.0, threshold=50.0))

    def errors(x):
        T_cam_local = RigidTransform(rotation_from_angles(*x[:3]), x[3:])
        return (CAMERA.project(T_cam_local.apply(landmarks)) - pixels).ravel()

    best = least_squares(errors, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    expected = RigidTransform(rotation_from_angles(*best.x[:3]), best.x[3:]).inverse()
    np.testing.assert_allclose(found.T_local_left.matrix34, expected.matrix34, atol=1e-7)
    factor = 2 * best.cost / (2 * 40 - 6)
    J = best.jac
    # The angles and (v, w) parametrise the same pose: the position's covariance is the same.
    numeric = np.zeros((3, 6))
    for k in range(6):
        h = np.zeros(6)
        h[k] = 1e-6
        ends = [
            RigidTransform(rotation_from_angles(*(best.x + s * h)[:3]), (best.x + s * h)[3:]).inverse().translation
            for s in (1, -1)
        ]
        numeric[:, k] = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(
        found.covariance[:3, :3], numeric @ np.linalg.inv(J.T @ J) @ numeric.T * factor, rtol=1e-3, atol=1e-12
    )


def stereo(landmarks, f_times_baseline):
    """How landmarks move with their disparity: Z^2 / (f B) along the ray, per pixel."""
    return landmarks * landmarks[:, 2:] / f_times_baseline


def normalised_square(T, found):
    turn = T.rotation @ found.T_local_left.rotation.T
    w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    x = np.concatenate([T.translation - found.T_local_left.translation, w])
    return float(x @ np.linalg.solve(found.total, x))


@pytest.mark.parametrize("bias_sigma", [0.0, 0.3])
def test_covariance_is_calibrated(bias_sigma):
    """Normalised squared error of 200 noisy resections: chi-square of 6 degrees of freedom each."""
    rng = np.random.default_rng(6)
    trials, total = 200, 0.0
    params = ResectParams(pixel_sigma=0.3, threshold=2.0, bias_sigma=bias_sigma)
    for trial in range(trials):
        T, landmarks = true_pose(rng), scene(rng, 50)
        per_pixel = stereo(landmarks, 400.0)  # depths good to 1 % a pixel: first-order theory holds
        pixels = seen(T, landmarks) + 0.3 * rng.standard_normal((50, 2))
        wrong = landmarks + per_pixel * (0.2 * rng.standard_normal((50, 1)) + bias_sigma * rng.standard_normal())
        total += normalised_square(T, solve(wrong, pixels, per_pixel=per_pixel, sigma=0.2, params=params, seed=trial))
    # Huber's weights cost 2 %, and a variance factor below 1 (it has 94 degrees of freedom: 1 +- 0.15) is not believed:
    # -6 %.
    low, high = chi2.ppf([0.001, 0.999], 6 * trials)
    assert low < total / 0.96 < high


def test_an_error_that_all_disparities_share_is_found():
    rng = np.random.default_rng(14)
    T = RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0]))
    landmarks = scene(rng, 150, near=5.0, far=30.0)
    per_pixel = stereo(landmarks, 300.0)
    pixels = seen(T, landmarks) + 0.05 * rng.standard_normal((150, 2))
    wrong = landmarks + 0.2 * per_pixel  # all disparities 0.2 pixel short
    held = solve(wrong, pixels, per_pixel=per_pixel, sigma=0.05, params=ResectParams(bias_sigma=0.0))
    free = solve(wrong, pixels, per_pixel=per_pixel, sigma=0.05, params=ResectParams(bias_sigma=0.3))
    assert free.bias == pytest.approx(-0.2, abs=0.03)
    assert held.bias == pytest.approx(0.0, abs=1e-4)
    error = [np.linalg.norm(f.T_local_left.translation - T.translation) for f in (free, held)]
    assert error[0] < 0.3 * error[1]


def test_without_motion_the_bias_stays_at_its_prior():
    rng = np.random.default_rng(15)
    landmarks = scene(rng, 100)
    pixels = seen(RigidTransform.identity(), landmarks) + 0.2 * rng.standard_normal((100, 2))
    found = solve(landmarks, pixels, per_pixel=stereo(landmarks, 100.0), sigma=0.2)
    assert abs(found.bias) < 0.05
    assert np.linalg.norm(found.T_local_left.translation) < 4 * np.sqrt(np.trace(found.total[:3, :3]))


def test_uncertain_landmarks_count_less():
    rng = np.random.default_rng(7)
    T, landmarks = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.0])), scene(rng, 100)
    sigma = np.where(np.arange(100) < 50, 5.0, 0.1)
    per_pixel = 0.01 * landmarks
    noisy = landmarks + per_pixel * (sigma * rng.standard_normal(100))[:, None]
    pixels = seen(T, landmarks)
    weighted = solve(noisy, pixels, per_pixel=per_pixel, sigma=sigma)
    plain = solve(noisy, pixels, params=ResectParams(threshold=100.0))
    assert np.linalg.norm(weighted.T_local_left.translation - T.translation) < 0.3 * np.linalg.norm(
        plain.T_local_left.translation - T.translation
    )


def test_same_seed_same_bits():
    rng = np.random.default_rng(8)
    T, landmarks = true_pose(rng), scene(rng)
    pixels = seen(T, landmarks) + 0.3 * rng.standard_normal((60, 2))
    a, b = solve(landmarks, pixels), solve(landmarks, pixels)
    assert a.T_local_left.to_list() == b.T_local_left.to_list()
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_too_few_landmarks_are_named_with_frame_and_remedy():
    rng = np.random.default_rng(9)
    landmarks = scene(rng, 5)
    with raises("RIL-421", "frame 7", "track.points"):
        solve(landmarks, seen(RigidTransform.identity(), landmarks))


def test_no_common_pose_is_named():
    rng = np.random.default_rng(10)
    landmarks = scene(rng, 12)
    with raises("RIL-421", "frame 7"):
        solve(landmarks, rng.uniform([0, 0], [600, 500], (12, 2)))


def test_collinear_landmarks_are_named():
    landmarks = np.linspace([-2.0, -1.0, 5.0], [2.0, 1.5, 9.0], 30)
    with raises("RIL-422", "frame 7"):
        solve(landmarks, seen(RigidTransform.identity(), landmarks))


def test_landmarks_too_far_for_a_position_are_named():
    rng = np.random.default_rng(11)
    landmarks = CAMERA.rays(rng.uniform([298, 248], [302, 252], (40, 2))) * rng.uniform(1000, 1002, (40, 1))
    pixels = seen(RigidTransform.identity(), landmarks) + 0.2 * rng.standard_normal((40, 2))
    with raises("RIL-420", "frame 7"):
        solve(landmarks, pixels)


def test_a_landmark_behind_the_camera_is_no_inlier():
    rng = np.random.default_rng(12)
    landmarks = scene(rng, 40)
    pixels = seen(RigidTransform.identity(), landmarks)
    landmarks[0] = -landmarks[0]
    found = solve(landmarks, pixels)
    assert not found.inlier[0]
    assert found.inlier[1:].all()
    assert np.isnan(found.residual[0])


def test_segment_keeps_the_key_pose_and_poses_each_frame():
    rng = np.random.default_rng(13)
    key = RigidTransform(rotation_exp(np.array([-1.8, 0.1, 0.0])), np.zeros(3))
    steps = [
        RigidTransform(rotation_exp(np.array([0, 0.02 * i, 0])), np.array([0.02 * i, 0, 0.3 * i])) for i in range(4)
    ]
    truth = [key @ s for s in steps]
    landmarks = key.apply(scene(rng, 80))
    points = np.stack([seen(T, landmarks) for T in truth], 1).astype(np.float32)
    points[:30, 2] = np.nan  # lost
    position = landmarks.copy()
    position[75:] = np.nan  # without coordinates
    _, found = segment_poses(points, position, key, [4, 5, 6, 7])
    np.testing.assert_array_equal(found.poses[0], key.matrix34)
    np.testing.assert_allclose(found.poses, [T.matrix34 for T in truth], atol=1e-5)  # float32 pixels: 3e-5 px
    assert not found.covariance[0].any()
    assert found.inlier.sum(0).tolist() == [75, 75, 45, 75]
    assert [f["landmarks"] for f in found.facts] == [75, 75, 45, 75]


def test_a_frame_that_cannot_be_posed_is_lost_and_the_next_one_is_posed():
    rng = np.random.default_rng(17)
    steps = [RigidTransform(rotation_exp([0, 0.02 * i, 0]), np.array([0.02 * i, 0, 0.3 * i])) for i in range(4)]
    landmarks = scene(rng, 80)
    points = np.stack([seen(T, landmarks) for T in steps], 1).astype(np.float32)
    points[:, 1] = np.nan  # nothing found
    points[:, 2] = rng.uniform([0, 0], [600, 500], (80, 2))  # nothing but chance
    _, found = segment_poses(points, landmarks, steps[0], [4, 5, 6, 7])
    assert np.isnan(found.poses[1:3]).all()
    assert np.isnan(found.covariance[1:3]).all()
    assert "0 have coordinates" in found.facts[1]["lost"]
    assert "3 too far" in found.facts[1]["lost"]
    assert "agree with one pose" in found.facts[2]["lost"]
    assert not found.inlier[:, 1:3].any()
    assert "lost" not in found.facts[3]
    np.testing.assert_allclose(found.poses[3], steps[3].matrix34, atol=1e-5)


@pytest.mark.parametrize("larger", [0.02, -0.05, 0.3])
def test_a_frame_with_another_focal_length_is_lost_and_says_so(larger):
    rng = np.random.default_rng(23)
    steps = [RigidTransform(rotation_exp([0, 0.02 * i, 0]), np.array([0.02 * i, 0, 0.3 * i])) for i in range(4)]
    landmarks = scene(rng, 120, near=4.0, far=30.0)
    points = np.stack([seen(T, landmarks) for T in steps], 1)
    points += rng.normal(0.0, 0.2, points.shape)
    points[:, 2] += larger * (points[:, 2] - [CAMERA.cx, CAMERA.cy])
    _, found = segment_poses(points.astype(np.float32), landmarks, steps[0], [4, 5, 6, 7])
    assert [k for k, fact in enumerate(found.facts) if "lost" in fact] == [2]
    words = found.facts[2]["lost"]
    assert words.startswith("the focal length changed by some ")
    assert float(words.split()[6]) == pytest.approx(100.0 * larger, abs=0.3)
    np.testing.assert_allclose(found.poses[3], steps[3].matrix34, atol=0.02)


def test_solver_stands_still_on_singular_data():
    """One landmark seen many times: the damping keeps the step finite."""
    one = np.tile([[0.0, 0.0, 5.0]], (8, 1))
    obs = observed(one, 0.1 * one, np.zeros(8), np.full((8, 2), 300.0), 1.0)
    problem = PoseAdjustment(obs, np.ones(8, bool), 0.1)
    t = levenberg_marquardt(problem, Pose.of(RigidTransform.identity()), 20).state.t
    assert np.isfinite(t).all()
    assert np.abs(t).max() < 5.0


def test_a_camera_that_has_turned_about_is_posed():
    """From the last pose all landmarks lie behind the image."""
    rng = np.random.default_rng(14)
    truth = RigidTransform(rotation_exp([0.0, 2.9, 0.0]), np.array([0.2, -0.1, 0.3]))
    landmarks = truth.apply(scene(rng, 80))
    pixels = seen(truth, landmarks)
    pixels[:16] += rng.uniform(-60, 60, (16, 2))
    found = solve(landmarks, pixels)
    np.testing.assert_allclose(found.T_local_left.matrix34, truth.matrix34, atol=1e-6)
    assert not found.inlier[:16].any()


def test_a_wrong_prediction_does_no_harm():
    rng = np.random.default_rng(15)
    truth = true_pose(rng)
    landmarks = scene(rng)
    pixels = seen(truth, landmarks) + rng.normal(0, 0.2, (60, 2))
    known = exact(landmarks)
    astray = RigidTransform(rotation_exp([0.0, 1.5, 0.0]), np.array([3.0, 2.0, -4.0]))
    plain, misled = (
        resect(known, pixels, CAMERA, [RigidTransform.identity(), *others], PARAMS, 0) for others in ((), (astray,))
    )
    np.testing.assert_allclose(misled.T_local_left.matrix34, plain.T_local_left.matrix34, atol=1e-9)
    np.testing.assert_array_equal(misled.inlier, plain.inlier)


def test_errors_smaller_than_stated_leave_what_residuals_do_not_show_to_the_shared_part():
    rng = np.random.default_rng(21)
    params = ResectParams(pixel_sigma=0.4, threshold=2.0, bias_sigma=0.0)
    T, landmarks = true_pose(rng), scene(rng, 400)
    pixels = seen(T, landmarks) + 0.2 * rng.standard_normal((400, 2))
    found = solve(landmarks, pixels, params=params)
    own, shared = found.covariance, found.shared @ found.shared.T
    # a quarter of the stated variance is seen; the rest, three times as much, is not
    np.testing.assert_allclose(np.diag(shared), 3 * np.diag(own), rtol=0.3)
    assert normalised_square(T, found) < chi2.ppf(0.999, 6)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("right", "n"), [(0, 17), (0, 23), (0, 60), (20, 40)])
def test_a_pose_by_chance_is_refused_and_a_right_one_is_not(right, n, seed):
    rng = np.random.default_rng([seed, right, n])
    landmarks, pose = scene(rng, n), true_pose(rng)
    pixels = seen(pose, landmarks) + rng.normal(0, 0.2, (n, 2))
    pixels[right:] = seen(RigidTransform.identity(), landmarks[right:]) + rng.uniform(-4, 4, (n - right, 2))
    params = ResectParams(max_position_ratio=10.0)
    if right:
        found = solve(landmarks, pixels, params=params, seed=seed)
        np.testing.assert_allclose(found.T_local_left.translation, pose.translation, atol=0.1)
        return
    with pytest.raises(DegenerateError) as caught:
        solve(landmarks, pixels, params=params, seed=seed)
    assert caught.value.code in ("RIL-720", "RIL-421")  # as many as by chance, or fewer than a pose needs


def test_a_landmark_that_the_camera_has_nearly_reached_agrees_with_nothing():
    """Its error along the old ray is of any size in the new image: it would agree thousands of pixels off."""
    rng = np.random.default_rng(4)
    landmarks, pose = scene(rng), RigidTransform(np.eye(3), np.array([0.0, 0.0, 3.5]))
    landmarks[0] = [0.3, 0.2, 3.502]  # 2 mm before the camera's plane
    pixels = seen(pose, landmarks)
    pixels[0] = seen(pose, 1.02 * landmarks[:1])[0]  # as its disparity's error of a sigma has it
    found = solve(landmarks, pixels, per_pixel=0.1 * landmarks, sigma=0.2)
    assert not found.inlier[0]
    assert found.residual[found.inlier].max() < 1e-3
    np.testing.assert_allclose(found.T_local_left.translation, pose.translation, atol=1e-6)


def carried(carried_near, carried_far, moved):
    """Segment of two frames: so many landmarks carried along (near, or as far as the others), the others passed."""
    rng = np.random.default_rng(29)
    step = RigidTransform(rotation_exp([0, 0.01, 0]), np.array([0.0, 0, 0.6]))
    landmarks = np.concatenate([scene(rng, carried_near, 1.0, 2.0), scene(rng, carried_far + moved)])
    points = np.stack([seen(T, landmarks) for T in (RigidTransform.identity(), step)], 1).astype(np.float32)
    points[: carried_near + carried_far, 1] = points[: carried_near + carried_far, 0]
    return segment_poses(points, landmarks, RigidTransform.identity(), [4, 5])[1], step


@pytest.mark.parametrize(
    ("near", "far", "moved", "words"),
    [(60, 0, 40, "own body"), (0, 70, 30, "the camera stood"), (30, 0, 70, "own body"), (86, 0, 14, "own body")],
)
def test_of_two_motions_that_many_landmarks_show_none_is_taken(near, far, moved, words):
    """A bonnet in view, or a camera that stands before a lorry: the images are alike."""
    found, _ = carried(near, far, moved)
    assert np.isnan(found.poses[1]).all()
    assert "two motions" in found.facts[1]["lost"]
    line = found.facts[1]["contradiction"]
    assert f"{near + far} of 100 landmarks ({near + far}%) do not move in the image" in line
    assert f"{moved} ({moved}%) moved by 0.6 m" in line
    assert words in line


@pytest.mark.parametrize(("stand", "posed"), [(20, False), (40, True)])
def test_of_a_crowd_no_few_that_agree_make_a_pose(stand, posed):
    rng = np.random.default_rng(37)
    step = RigidTransform(rotation_exp([0, 0.01, 0]), np.array([0.0, 0, 0.6]))
    landmarks = scene(rng, 100)
    points = np.stack([seen(T, landmarks) for T in (RigidTransform.identity(), step)], 1).astype(np.float32)
    points[stand:, 1] += rng.uniform(-30, 30, (100 - stand, 2))
    found = segment_poses(points, landmarks, RigidTransform.identity(), [4, 5])[1]
    if posed:
        np.testing.assert_allclose(found.poses[1], step.matrix34, atol=1e-4)
        return
    assert np.isnan(found.poses[1]).all()
    assert found.facts[1]["lost"].startswith("only 20 of 100 landmarks agree with one pose")


@pytest.mark.parametrize(("near", "far", "moved"), [(0, 12, 88), (15, 0, 85), (0, 86, 14)])
def test_a_vehicle_ahead_and_few_that_pass_leave_the_motion_as_it_is(near, far, moved):
    found, step = carried(near, far, moved)
    assert "contradiction" not in found.facts[1]
    expected = step if moved > far else RigidTransform.identity()
    np.testing.assert_allclose(found.poses[1], expected.matrix34, atol=1e-4)


@pytest.mark.parametrize(
    ("column", "row", "told"), [(3.0, 0.0, True), (-2.0, 0.0, True), (0.0, 1.5, True), (0.5, 0.2, False)]
)
@pytest.mark.parametrize("torn", [0.0, 0.3, 0.7])
@pytest.mark.parametrize(("finer", "before"), [(1.0, 0.0), (2.0, 0.0), (1.0, 2.5)])
def test_a_rig_that_is_knocked_between_two_pairs_is_told(column, row, told, finer, before, torn):
    """The later pair measures disparities that all depart alike from those of the landmarks, more than the earlier one,
    whose camera may have been turned ``before``; or a share of them departs farther: one of its images is ``torn``."""
    rng = np.random.default_rng(31)
    step = RigidTransform(rotation_exp([0, 0.01, 0]), np.array([0.0, 0, 0.4]))
    right = Camera(*(finer * value for value in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)), 1200, 1000)
    rig = Rig(CAMERA, right, RigidTransform(np.eye(3), np.array([-0.3, 0.0, 0.0])))
    landmarks = scene(rng, 80)
    landmarks[:, 2] = 8.0  # a wall: one disparity at the key, and another one behind the step
    points = np.stack([seen(T, landmarks) for T in (RigidTransform.identity(), step)], 1).astype(np.float32)
    given, found = segment_poses(points, landmarks, RigidTransform.identity(), [4, 7])
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]

    def wall(T: RigidTransform, column: float, row: float) -> Bundle:
        rays = CAMERA.rays(np.stack([u.ravel(), v.ravel()], 1).astype(float)) @ T.rotation.T
        depth = ((8.0 - T.translation[2]) / rays[:, 2]).reshape(u.shape)
        still = u - 0.3 * CAMERA.fx / depth
        aside = 1.0 + ((still - CAMERA.cx) / CAMERA.fx) ** 2  # a turn moves these pixels farther
        disparity = {
            "column_disparity": finer * (still + column * aside) - u,
            "row_disparity": finer * (v + row) - v,
            "validity": np.full(u.shape, Validity.MATCHED, np.uint8),
        }
        return Bundle(disparity, {})

    same = Bundle({}, {"rig": rig.to_dict()})
    pairs = wall(RigidTransform.identity(), before, 0.0), wall(step, before + column, row)
    rows = np.sort(given.tracks[:, 1, 1])
    below = v > rows[-1 - round(torn * (len(rows) - 1))] + 0.5
    pairs[1]["column_disparity"][below] += 20.0 * finer
    inputs = ResectInputs(Bundle({}, {}), Bundle({}, {}), same, *pairs, same)
    facts = of_pair_behind(given.tracks, found, inputs)
    if torn:
        assert facts == {"torn": pytest.approx(min(torn, 1 - torn), abs=0.07)}
        found.inlier[12:, -1] = 0  # a wide turn, which leaves few landmarks
        assert "torn" not in of_pair_behind(given.tracks, found, inputs)
        return
    assert ("jump" in facts) == told
    if told:
        np.testing.assert_allclose(facts["jump"], [column, row], atol=0.05)
        assert facts["knocked"].startswith("the rig moved at pair 7")
        assert f"{(column or row):+.1f} px in the" in facts["knocked"]
    found.poses[-1] = np.nan  # the pair at the end has no pose: nothing is told
    assert of_pair_behind(given.tracks, found, inputs) == {}


def test_disparities_that_depart_as_they_grow_are_those_of_a_rig_that_was_wrong_from_the_start():
    rng = np.random.default_rng(5)
    grows = rng.uniform(0.0, 0.3, 100)
    departs = np.stack([-7.4 * grows, np.zeros(100)], 1) + rng.normal(0.0, 0.2, (100, 2))
    departs[:10] += 15.0  # mistracked
    assert np.linalg.norm(np.median(departs, axis=0)) > MIN_JUMP_PX
    for aside, jumped in ((0.0, 0.0), (3.0, 2.0), (-3.0, -3.0)):  # by the median, and as they began
        jump, grown = jump_of(departs + np.array([aside, 0.0]), grows)
        np.testing.assert_allclose(jump, [jumped, 0.0], atol=0.3)
        np.testing.assert_allclose(grown, [-7.4, 0.0], atol=0.8)


def with_a_lorry(beside, before, farthest=60):
    """Segment of three frames: landmarks of a scene 10 m ahead to the ``farthest``, ``beside`` many, and ``before``
    many of a board 8 m ahead that drives along, over the middle 40 % of the image."""
    rng = np.random.default_rng(31)
    steps = [RigidTransform(rotation_exp([0, 0.004 * k, 0]), np.array([0.0, 0, 0.6 * k])) for k in range(3)]
    pixels = rng.uniform((40, 40), (CAMERA.width - 40, CAMERA.height - 40), (6 * beside, 2))
    middle = np.abs(pixels[:, 0] - CAMERA.cx) < 0.2 * CAMERA.width
    far = CAMERA.rays(pixels[~middle][:beside]) * rng.uniform(10, farthest, (beside, 1))
    board = CAMERA.rays(pixels[middle][:before]) * 8.0
    points = np.stack(
        [seen(T, np.concatenate([far, board + np.array([0, 0, 0.5 * k])])) for k, T in enumerate(steps)], 1
    ).astype(np.float32)
    return segment_poses(points, np.concatenate([far, board]), RigidTransform.identity(), [4, 5, 6])[1], steps


@pytest.mark.parametrize(("beside", "before"), [(70, 30), (45, 55)])
def test_the_scene_beside_and_behind_a_vehicle_tells_the_motion_even_where_it_shows_less(beside, before):
    found, steps = with_a_lorry(beside, before)
    for k in (1, 2):
        np.testing.assert_allclose(found.poses[k], steps[k].matrix34, atol=2e-3)
        # Those beside the point that the camera drives towards hardly move either way.
        assert 0.9 * before <= found.facts[k]["moving"] <= before
        assert "contradiction" not in found.facts[k]
    assert found.inlier[beside:, 1:].mean() < 0.1


def test_a_scene_that_ends_where_the_vehicle_is_does_not_tell_the_motion():
    found, _ = with_a_lorry(70, 30, farthest=11)
    assert "two motions" in found.facts[1]["lost"]
    assert "mask what moves by itself" in found.facts[1]["contradiction"]  # nothing stands
