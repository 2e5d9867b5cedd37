"""Interest points: the operator by hand, spread, masks."""

import numpy as np
import pytest

from rille.stages.odometry.moravec import clear_of_mask, interest_operator, interest_points


def test_flat_and_edge_give_nothing_and_a_corner_does():
    flat = np.full((21, 21), 90.0, np.float32)
    edge = flat.copy()
    edge[:, 10:] = 100.0
    corner = flat.copy()
    corner[10:, 10:] = 100.0
    assert interest_operator(flat).max() == 0.0
    assert interest_operator(edge).max() == 0.0  # shifts along the edge change nothing
    assert interest_operator(corner)[10, 10] > 0.0


def test_operator_of_one_bright_pixel_by_hand():
    image = np.zeros((15, 15), np.float32)
    image[7, 7] = 3.0
    # A shift by one pixel changes two pixels by 3 each in both senses: (9 + 9 + 9 + 9) / 2 inside the window.
    response = interest_operator(image)
    assert response[7, 7] == pytest.approx(18.0)
    # Three columns off, the window still holds a difference along the row but none along the column.
    assert response[7, 10] == pytest.approx(0.0)


def test_diagonal_edge_gives_nothing():
    y, x = np.mgrid[:25, :25]
    image = np.where(x > y, 100.0, 50.0).astype(np.float32)
    assert interest_operator(image).max() == 0.0


def test_points_are_spread_even_where_one_corner_is_much_stronger():
    rng = np.random.default_rng(1)
    image = (100 + 10 * rng.standard_normal((120, 160))).astype(np.float32)
    image[:40, :40] = 100 + 80 * rng.standard_normal((40, 40))
    points = interest_points(image, np.ones(image.shape, np.uint8), 48, noise=1.5)
    assert len(points) == 48
    quarters = {(bool(x > 80), bool(y > 60)): 0 for x, y in points}
    for x, y in points:
        quarters[bool(x > 80), bool(y > 60)] += 1
    assert min(quarters.values()) >= 8  # 12 each if spread perfectly; by strength alone nearly all are in one


def test_the_strongest_of_a_bucket_is_taken():
    image = np.full((60, 60), 100.0, np.float32)
    for row, col, step in ((12, 12, 20.0), (22, 22, 40.0), (12, 45, 20.0)):
        image[row, col] += step
    points = interest_points(image, np.ones(image.shape, np.uint8), 4, noise=0.5)  # buckets of 30 x 30
    # A single pixel gives a plateau of windows that hold it; the third is the second of its bucket.
    assert np.abs(points - [[22, 22], [45, 12], [12, 12]]).max() <= 2


def test_noise_alone_gives_no_points():
    rng = np.random.default_rng(2)
    image = (100 + 1.5 * rng.standard_normal((200, 200))).astype(np.float32)
    assert len(interest_points(image, np.ones(image.shape, np.uint8), 100, noise=1.5)) == 0


def test_mask_and_border_are_respected():
    rng = np.random.default_rng(3)
    image = (100 + 30 * rng.standard_normal((100, 100))).astype(np.float32)
    valid = np.ones(image.shape, np.uint8)
    valid[:, 50:] = 0
    points = interest_points(image, valid, 60, noise=1.5)
    assert len(points) > 20
    assert points.min() >= 8
    assert points[:, 0].max() < 50 - 8
    assert points[:, 1].max() < 100 - 8


def test_only_empty_buckets_are_filled():
    rng = np.random.default_rng(4)
    image = (100 + 30 * rng.standard_normal((100, 100))).astype(np.float32)
    valid = np.ones(image.shape, np.uint8)
    y, x = np.mgrid[5:50:10, 5:100:10]
    held = np.stack([x.ravel(), y.ravel()], -1).astype(np.float64)  # every bucket (10 x 10) of the upper half
    new = interest_points(image, valid, 100, noise=1.5, occupied=held)
    assert len(new) > 20
    assert (new[:, 1] >= 50).all()
    assert len(np.unique(new // 10, axis=0)) == len(new)  # one a bucket


def test_empty_image_and_tiny_image():
    assert len(interest_points(np.zeros((40, 40), np.float32), np.zeros((40, 40), np.uint8), 9, noise=1)) == 0
    assert interest_operator(np.ones((5, 5), np.float32)).max() == 0.0


def test_clear_of_mask():
    valid = np.ones((30, 40), np.uint8)
    valid[10, 20] = 0
    at = np.array([[20.0, 13.4], [20.0, 13.6], [5.0, 5.0], [1.9, 15.0], [36.6, 15.0], [np.nan, 3.0]])
    assert clear_of_mask(valid, at, 3).tolist() == [False, True, True, False, False, False]


def test_points_are_the_peaks_that_a_plain_search_finds():
    """Of a plateau the first pixel in reading order; quantised noise has many."""
    image = np.random.default_rng(2).integers(0, 4, (40, 50)).astype(np.float32) * 40.0
    response = interest_operator(image)
    response[:3], response[-3:], response[:, :3], response[:, -3:] = 0, 0, 0, 0
    peaks = set()
    for y in range(8, 32):
        for x in range(8, 42):
            around = response[y - 2 : y + 3, x - 2 : x + 3].copy()
            before = np.arange(25).reshape(5, 5) < 12
            if response[y, x] >= around.max() and not (around[before] == response[y, x]).any() and response[y, x] > 150:
                peaks.add((x, y))
    found = interest_points(image, np.ones(image.shape, np.uint8), 10000, noise=1.0)
    assert {(int(x), int(y)) for x, y in found} == peaks
