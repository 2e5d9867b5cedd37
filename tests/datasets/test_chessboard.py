"""Boards in rendered and real images."""

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.images.chessboard import (
    alternates,
    board_points,
    eight_bit,
    find_corners,
    find_size,
    parse_corners,
    same_order,
    steady,
)


def render(corners=(9, 6), side=24.0, turn=0.1, shift=(50.0, 30.0), size=(230, 300), tilt=0.0004):
    """A board seen in perspective, by area sampling; image and true corners (n, 2), row by row."""
    columns, rows = corners
    c, s = np.cos(turn), np.sin(turn)
    h = np.array([[side * c, -side * s, shift[0]], [side * s, side * c, shift[1]], [tilt * side, 0.0, 1.0]])
    fine = 8  # finer changes no corner by more than 0.001 px RMS
    y, x = (np.indices((size[0] * fine, size[1] * fine)) + 0.5) / fine - 0.5
    p = np.linalg.inv(h) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    u, v = p[:2] / p[2]
    inside = (u > -1) & (u < columns) & (v > -1) & (v < rows)
    dark = (np.floor(u) + np.floor(v)) % 2 == 0
    grey = np.where(inside & dark, 40.0, 210.0).reshape(size[0], fine, size[1], fine).mean((1, 3))
    r, q = np.indices((rows, columns))
    ends = h @ np.stack([q.ravel(), r.ravel(), np.ones(q.size)])
    return cv2.GaussianBlur(grey, (0, 0), 0.7).round().astype(np.uint8), (ends[:2] / ends[2]).T


SMALL = {"side": 20.0, "shift": (40.0, 30.0), "size": (150, 190)}


def nearest(found, true):
    return np.linalg.norm(found[:, None] - true[None], axis=-1).min(1)


@pytest.mark.parametrize("corners", [(9, 6), (7, 7), (6, 4)])
def test_corners_of_a_rendered_board_are_exact(corners):
    image, true = render(corners)
    found = find_corners(image, corners)
    assert found.shape == true.shape
    # OpenCV's refinement samples by bilinear interpolation, which costs some hundredths; detection alone errs by 0.13
    assert np.sqrt((nearest(found, true) ** 2).mean()) < 0.06
    assert nearest(true, found).max() < 0.1


def test_size_is_what_most_images_show():
    images = [render((5, 4), turn=t, **SMALL)[0] for t in (0.0, 0.1, 0.2)] + [np.full((150, 190), 128, np.uint8)]
    assert find_size(images) == (5, 4)


def test_no_board_is_an_answer():
    flat = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
    assert find_corners(flat, (9, 6)) is None
    with raises("RIL-153"):
        find_size([flat, flat])


def test_a_grid_whose_squares_do_not_alternate_is_no_board():
    image, true = render((5, 4), **SMALL)
    assert alternates(image, true, (5, 4))
    assert alternates(255 - image, true, (5, 4))
    rows, columns = np.indices(image.shape)
    for clutter in (np.full(image.shape, 90), 40 + columns, 40 + rows // 2, np.where(columns // 20 % 2, 40, 210)):
        assert not alternates(clutter.astype(np.uint8), true, (5, 4))


def test_wrong_size_is_not_found():
    assert find_corners(render((5, 4), **SMALL)[0], (6, 4)) is None


@pytest.mark.parametrize("corners", [(9, 6), (5, 5)])
def test_right_corners_come_in_the_left_ones_order(corners):
    columns, rows = corners
    left = render(corners)[1]
    true = left * [1.02, 0.99] + [-30.0, 4.0]
    grid = true.reshape(rows, columns, 2)
    orders = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if rows == columns:
        orders += [g.transpose(1, 0, 2) for g in orders]
    for order in orders:
        np.testing.assert_array_equal(same_order(left, order.reshape(-1, 2), corners), true)


def test_board_points_row_by_row():
    points = board_points((3, 4), 0.1)
    assert points.shape == (12, 3)
    np.testing.assert_allclose(points[[0, 1, 3]], [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])


@pytest.mark.parametrize(
    ("square", "hint"), [(25.0, "0.025"), (2.5, "0.025"), (30, "0.03"), (-1, "metres"), (0, "metres")]
)
def test_lengths_that_are_not_metres(square, hint):
    with raises("RIL-152") as caught:
        board_points((9, 6), square)
    assert hint in str(caught.value)


def test_corners_as_text():
    assert parse_corners("9x6") == (9, 6)
    for bad in ("9", "9x", "x6", "2x6", "9by6", "9x-6", "9x6²", "9x²"):
        with raises("RIL-151"):
            parse_corners(bad)


def test_sixteen_bits_become_eight():
    image, true = render((5, 4), **SMALL)
    deep = image.astype(np.uint16) * 40 + 3000
    shown = eight_bit(deep)
    assert shown.dtype == np.uint8
    assert nearest(find_corners(shown, (5, 4)), true).max() < 0.1
    np.testing.assert_array_equal(eight_bit(image), image)


@pytest.mark.data
@pytest.mark.parametrize(("folder", "size"), [("chessboard_opencv", (9, 6)), ("chessboard_bumblebee2", (6, 4))])
def test_size_of_real_boards(data_dir, folder, size):
    files = sorted((data_dir / folder).glob("left[0-9]*.jpg"))[:8]
    assert find_size(cv2.imread(str(f), 0) for f in files) == size


@pytest.mark.parametrize(("moved", "expected"), [(0.1, True), (0.6, False)])
def test_corners_of_a_board_lie_in_steady_steps(moved: float, expected: bool) -> None:
    grid = np.stack(np.meshgrid(30.0 * np.arange(5), 30.0 * np.arange(4)), axis=-1)
    homography = np.array([[1.0, 0.1, 20.0], [-0.1, 0.9, 30.0], [1e-3, 5e-4, 1.0]])
    ahead = grid @ homography[:, :2].T + homography[:, 2]
    seen = ahead[..., :2] / ahead[..., 2:]
    seen[1, 2] += moved * 15.0
    assert steady(seen.reshape(-1, 2), (5, 4)) is expected
