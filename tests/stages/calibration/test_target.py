"""Calibration from a board: exact on exact corners, errors as they are claimed, and bad views seen."""

import cv2
import numpy as np
import pytest
from raising import raises

from rille.stages.calibration.target import MODELS, Adjustment, BoardView, calibrate_rig, refuse_one_place
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import RigidTransform, rotation_exp

SIZE = (640, 480)
SIZES = (SIZE, SIZE)
ROWS, COLUMNS = np.indices((6, 9))
BOARD = 0.03 * np.stack([COLUMNS, ROWS, np.zeros(ROWS.shape)], axis=-1).reshape(-1, 3)
LENSES = {
    "radtan": (
        (500.0, 502.0, 321.0, 238.0, -0.3, 0.12, 1e-3, -5e-4, 0.02),
        (505.0, 506.0, 316.0, 243.0, -0.28) + (0,) * 4,
    ),
    "radtan4": ((500.0, 502.0, 321.0, 238.0, -0.3, 0.12, 1e-3, -5e-4), (505.0, 506.0, 316.0, 243.0, -0.28) + (0,) * 3),
    "fisheye": ((300.0, 301.0, 321.0, 238.0, 0.05, -0.01, 0.002, 0.0), (302.0, 303.0, 316.0, 243.0, 0.04, 0, 0, 0)),
}
RIG = RigidTransform(rotation_exp([0.004, -0.02, 0.01]), np.array([-0.12, 0.001, 0.002]))


def scene(model: str, count: int = 10, noise: float = 0.0, rig: RigidTransform = RIG) -> list[BoardView]:
    rng = np.random.default_rng(7)
    views = []
    for k in range(count):
        tilt = rng.uniform(-0.6, 0.6, 3)
        away = np.array([rng.uniform(-0.15, 0.05), rng.uniform(-0.12, -0.03), rng.uniform(0.35, 0.6)])
        pose = np.concatenate([tilt, away])
        task = Adjustment(BOARD, (), SIZES, model)
        T = rig @ RigidTransform(rotation_exp(tilt), away)
        other = np.concatenate([cv2.Rodrigues(T.rotation)[0].ravel(), T.translation])
        zero = np.zeros((len(BOARD), 2))
        left, right = (
            task._project(np.array(lens), where, zero)[0].reshape(-1, 2)
            for lens, where in zip(LENSES[model], (pose, other), strict=True)
        )
        views.append(BoardView(f"v{k}", *(p + noise * rng.standard_normal(p.shape) for p in (left, right))))
    return views


@pytest.mark.parametrize("model", sorted(LENSES))
def test_exact_corners_give_the_rig_back(model):
    found = calibrate_rig(BOARD, scene(model), SIZES, model)
    assert found.rms < 1e-4  # corners enter OpenCV's start as float32, but not the adjustment
    for lens, true in zip((found.left, found.right), LENSES[model], strict=True):
        got = [lens.camera.fx, lens.camera.fy, lens.camera.cx, lens.camera.cy]
        np.testing.assert_allclose(got, true[:4], atol=1e-2)
        np.testing.assert_allclose(lens.coefficients, true[4:], atol=1e-3)
    np.testing.assert_allclose(found.T_right_left.matrix34, RIG.matrix34, atol=1e-5)
    assert max(r.epipolar for r in found.residuals) < 1e-3


@pytest.mark.parametrize("f", [150.0, 228.0])
def test_wide_fisheyes_need_no_start(f):
    """Boards in all parts of the images, corners up to 85 degrees off the axis: OpenCV's own start gives up on them."""
    rng, size = np.random.default_rng(3), (960, 600)
    lens = np.array([f, f, size[0] / 2 + 7, size[1] / 2 - 5, 0.02, -0.005, 0.002, -0.0005])
    task = Adjustment(BOARD, (), (size, size), "fisheye")
    views: list[BoardView] = []
    while len(views) < 8:
        # Facing the camera from a direction within the image, turned by up to 40 degrees.
        off = rng.uniform(-0.5, 0.5, 2) * size / f
        ray = np.array([*(off * np.sinc(np.hypot(*off) / np.pi)), np.cos(np.hypot(*off))])
        x = np.cross([0, 1, 0], ray) / np.linalg.norm(np.cross([0, 1, 0], ray))
        facing = RigidTransform(np.column_stack([x, np.cross(ray, x), ray]), rng.uniform(0.25, 0.7) * ray)
        T = facing @ RigidTransform(rotation_exp(rng.uniform(-0.7, 0.7, 3)), np.zeros(3))
        T = T @ RigidTransform(np.eye(3), -BOARD.mean(axis=0))
        seen = [(pose.rotation @ BOARD.T).T + pose.translation for pose in (T, RIG @ T)]
        if min((p[:, 2] / np.linalg.norm(p, axis=1)).min() for p in seen) < np.cos(np.radians(85)):
            continue
        corners = [
            task._project(lens, np.r_[cv2.Rodrigues(pose.rotation)[0].ravel(), pose.translation], np.zeros((54, 2)))[0]
            for pose in (T, RIG @ T)
        ]
        left, right = (c.reshape(-1, 2) + 0.1 * rng.standard_normal((54, 2)) for c in corners)
        if min(left.min(), right.min()) > 0 and (np.maximum(left.max(0), right.max(0)) < size).all():
            views.append(BoardView(str(len(views)), left, right))
    found = calibrate_rig(BOARD, views, (size, size), "fisheye")
    assert all(r.used for r in found.residuals)
    assert found.rms < 0.16  # of 0.1 px along columns and rows
    assert found.left.camera.fx == pytest.approx(f, rel=0.005)
    np.testing.assert_allclose(found.T_right_left.translation, RIG.translation, atol=1e-3)


def test_cameras_of_two_sizes_each_keep_their_own():
    found = calibrate_rig(BOARD, scene("radtan4"), ((640, 480), (1280, 720)), "radtan4")
    assert [(lens.camera.width, lens.camera.height) for lens in (found.left, found.right)] == [(640, 480), (1280, 720)]
    # The right camera's start is another, from the centre of the larger image; its optimum is the same.
    assert found.right.camera.cx == pytest.approx(316.0, abs=1e-2)


def test_threads_do_not_change_a_bit():
    """A rig that differs in its last digits would have all that depends on it computed anew."""
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(4)
        views = tuple(scene("radtan", 30, noise=0.2))
        starts = {Adjustment(BOARD, views, SIZES, "radtan").start().tobytes() for _ in range(6)}
        assert cv2.getNumThreads() == 4
    finally:
        cv2.setNumThreads(threads)
    assert len(starts) == 1


@pytest.mark.parametrize("model", [*sorted(LENSES), "rational"])
def test_jacobian_against_central_differences(model):
    lenses = LENSES.get(model) or tuple((*lens, 0.02, 0.01, 0.003) for lens in LENSES["radtan"])
    views = tuple(BoardView("v", v.left, v.right) for v in scene("radtan4", 2))
    task = Adjustment(BOARD, views, SIZES, model)
    rng = np.random.default_rng(1)
    poses = [np.concatenate([rng.uniform(-0.3, 0.3, 3), [-0.1, -0.05, 0.5]]) for _ in views]
    between = np.concatenate([[0.01, -0.02, 0.03], [-0.12, 0.0, 0.01]])
    x = np.concatenate([*(np.array(lens) for lens in lenses), between, *poses])
    _, jacobian = task.evaluate(x)
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = 1e-6 * max(1.0, abs(x[k]))
        slope = (task.evaluate(x + step)[0] - task.evaluate(x - step)[0]) / (2 * step[k])
        np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-5 * max(1.0, np.abs(slope).max()))


def test_claimed_errors_are_those_that_noise_makes():
    """Errors over claimed sigmas have a mean square of one.

    Of 22 correlated unknowns at least five vary on their own, so that 60 trials make 300 degrees of freedom: four
    standard deviations of the mean square are 4 sqrt(2 / 300) = 0.33.
    """
    exact = scene("radtan4", 6)
    true = Adjustment(BOARD, tuple(exact), SIZES, "radtan4")
    x = true.solve(true.start())
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        pairs = [(p + 0.1 * rng.standard_normal(p.shape) for p in (v.left, v.right)) for v in exact]
        noisy = Adjustment(BOARD, tuple(BoardView(f"v{k}", *p) for k, p in enumerate(pairs)), SIZES, "radtan4")
        found = noisy.solve(x)
        rms, sigma = noisy.errors(found)
        pulls = (found - x)[: noisy.shared] / [sigma[name] for name in noisy.names()]
        length = np.linalg.norm(found[noisy.shared - 3 : noisy.shared]) - np.linalg.norm(RIG.translation)
        squares.append([*pulls**2, (length / sigma["baseline"]) ** 2])
        assert rms == pytest.approx(0.1 * np.sqrt(2), rel=0.1)  # both coordinates; a tenth is four sigmas of 1300
    assert np.mean(squares) == pytest.approx(1, abs=0.33)
    assert np.mean(squares, axis=0)[-1] == pytest.approx(1, abs=4 * np.sqrt(2 / 60))


def test_agrees_with_opencv_on_one_rig():
    views = scene("radtan", 8, noise=0.1)
    found = calibrate_rig(BOARD, views, SIZES, "radtan")
    boards = [BOARD.astype(np.float32)] * len(views)
    sides = [[getattr(v, side).astype(np.float32) for v in views] for side in ("left", "right")]
    alone = [cv2.calibrateCamera(boards, points, SIZE, None, None) for points in sides]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    guess = cv2.CALIB_USE_INTRINSIC_GUESS
    _, k1, _, k2, _, R, T, *_ = cv2.stereoCalibrate(
        boards, *sides, *alone[0][1:3], *alone[1][1:3], SIZE, flags=guess, criteria=criteria
    )
    # both minimise the same sum; what is left is where they stop, far below a sigma of 0.3 px and 30 um
    np.testing.assert_allclose(found.left.camera.matrix, k1, atol=0.05)
    np.testing.assert_allclose(found.right.camera.matrix, k2, atol=0.05)
    np.testing.assert_allclose(found.T_right_left.translation, T.ravel(), atol=1e-5)
    np.testing.assert_allclose(found.T_right_left.rotation, R, atol=1e-4)


def spoiled(views: list[BoardView], k: int) -> list[BoardView]:
    """View ``k`` with a right image of another moment: the board stands elsewhere."""
    bad = BoardView(views[k].name, views[k].left, views[k].right + np.array([12.0, -7.0]))
    return [*views[:k], bad, *views[k + 1 :]]


def test_a_bad_view_is_named_and_left_out_and_does_no_harm():
    views = scene("radtan4", 10, noise=0.1)
    good, bad = calibrate_rig(BOARD, views, SIZES, "radtan4"), calibrate_rig(BOARD, spoiled(views, 4), SIZES, "radtan4")
    assert [r.name for r in bad.residuals if not r.used] == ["v4"]
    assert bad.residuals[4].worst > 2
    assert all(r.used for r in good.residuals)
    assert bad.left.camera.fx == pytest.approx(good.left.camera.fx, abs=3 * good.sigma["left fx"])
    np.testing.assert_allclose(bad.T_right_left.matrix34, good.T_right_left.matrix34, atol=3e-4)


@pytest.mark.parametrize(("usual", "worse"), [(0.03, 0.25), (0.2, 0.5)])
def test_a_view_is_good_below_half_a_pixel_or_four_times_the_others(usual, worse):
    views = scene("radtan4", 10, noise=usual)
    views[4] = scene("radtan4", 10, noise=worse)[4]
    found = calibrate_rig(BOARD, views, SIZES, "radtan4")
    assert all(r.used for r in found.residuals)
    assert found.residuals[4].worst > min(0.5, 4 * np.median([r.worst for r in found.residuals]))


def test_cameras_turned_upside_down_are_no_solution():
    """Negative focal lengths, and all poses turned by half a turn about the axis: not one projection changes."""
    task = Adjustment(BOARD, tuple(scene("radtan4", 4)), SIZES, "radtan4")
    x = task.solve(task.start())
    turn = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    for first in (0, task.lens):
        x[[first, first + 1, first + 6, first + 7]] *= -1.0
    for k in range(len(task.views)):
        x[task.pose(k)] = moved(turn, x[task.pose(k)])
    x[2 * task.lens : task.shared] = moved(turn, x[2 * task.lens : task.shared], turn)
    assert np.abs(task.evaluate(x)[0]).max() < 1e-3
    with raises("RIL-312"):
        task.solve(x)


def moved(turn: RigidTransform, pose: np.ndarray, before: RigidTransform | None = None) -> np.ndarray:
    """Rotation vector and translation of ``turn @ pose @ before``."""
    T = turn @ RigidTransform(rotation_exp(pose[:3]), pose[3:]) @ (before or RigidTransform.identity())
    return np.concatenate([cv2.Rodrigues(T.rotation)[0].ravel(), T.translation])


def test_a_bad_view_stays_where_that_is_asked_for():
    views = spoiled(scene("radtan4", 10, noise=0.1), 4)
    kept = calibrate_rig(BOARD, views, SIZES, "radtan4", keep_bad=True)
    assert all(r.used for r in kept.residuals)
    assert kept.rms > 1


def test_what_cannot_be_calibrated_says_so():
    views = scene("radtan4", 6)
    with raises("RIL-309"):
        calibrate_rig(BOARD, views[:2], SIZES, "radtan4")
    noise = scene("radtan4", 6, noise=0.1)
    twice = [BoardView(v.name, v.left, v.left + 0.01 * (w.left - v.left)) for v, w in zip(views, noise, strict=True)]
    with raises("RIL-313", "one place"):
        refuse_one_place(calibrate_rig(BOARD, twice, (SIZES[0], SIZES[0]), "radtan4"))


def test_cameras_stand_in_any_order():
    views = scene("radtan4", 6)
    usual, exchanged = (
        calibrate_rig(BOARD, one, SIZES, "radtan4")
        for one in (views, [BoardView(v.name, v.right, v.left) for v in views])
    )
    refuse_one_place(exchanged)
    np.testing.assert_allclose(exchanged.T_right_left.inverse().matrix34, usual.T_right_left.matrix34, atol=1e-3)


def test_a_right_camera_upside_down_stands_where_it_stands():
    views, (width, height) = scene("radtan4", 6), SIZES[1]
    turned = [BoardView(v.name, v.left, [width - 1, height - 1] - v.right) for v in views]
    upright, upside_down = (calibrate_rig(BOARD, one, SIZES, "radtan4").T_right_left for one in (views, turned))
    np.testing.assert_allclose(upside_down.inverse().translation, upright.inverse().translation, atol=1e-3)


def test_one_view_repeated_is_refused_or_its_vagueness_told():
    one = scene("radtan4", 1, noise=0.1)[0]
    again = [BoardView(f"v{k}", one.left, one.right) for k in range(5)]
    found = calibrate_rig(BOARD, scene("radtan4", 10, noise=0.1), SIZES, "radtan4")
    try:
        vague = calibrate_rig(BOARD, again, SIZES, "radtan4")
    except DegenerateError:
        return
    assert vague.sigma["left fx"] > 5 * found.sigma["left fx"]


def test_names_stand_for_all_shared_unknowns():
    for model in MODELS:
        task = Adjustment(BOARD, (), SIZES, model)
        assert len(task.names()) == task.shared == len(set(task.names()))
