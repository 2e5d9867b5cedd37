"""Vector code against NumPy, and its x86 forms against the portable one."""

import numpy as np
import pytest
from numba import njit
from scipy import ndimage

from rille.stages.geometry.spline import coefficients
from rille.stages.hfvm.level import edge_simd, rowwise, simd, strip_simd

WIDTHS = sorted({0, simd.widest()})


def words(n, seed):
    return np.random.default_rng(seed).integers(0, 256, (n, 8)).astype(np.uint8).view(np.uint64)[:, 0]


def sad(a, b):
    return np.abs(a[:, None].view(np.uint8).astype(int) - b[:, None].view(np.uint8).astype(int)).sum(axis=1)


@pytest.mark.parametrize("width", WIDTHS)
def test_sums_over_windows(width):
    sums = simd.make_sums(width)

    @njit
    def call(left, right, at_left, at_right, count, four, last):
        sums((left, right), (at_left, at_right), (np.int64(13), np.int64(15)), count, (four, last), np.int64(1))

    left, right = words(117, 2).reshape(9, 13), words(165, 3).reshape(11, 15)
    for count in (1, 4):
        four, last = np.zeros((2, 5), np.uint64)
        call(left.ravel(), right.ravel(), 4 * 13 + 5, 5 * 15 + 6, count, four, last)
        for k in range(count):
            here = left[2:7, 3 + k : 8 + k].ravel()
            moves = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
            expected = [sad(here, right[3 + j : 8 + j, 4 + k + i : 9 + k + i].ravel()).sum() for j, i in moves]
            assert [*four[1 + k : 2 + k].view(np.uint16), last[1 + k]] == expected


@pytest.mark.parametrize("width", WIDTHS)
def test_the_cost_of_a_window_of_like_pixels(width):
    window_cost = edge_simd.make_window_cost(width, 7, 16, 600)

    @njit
    def call(left, right, grey, at_left, at_right):
        return window_cost((left, right), grey, (at_left, at_right), (np.int64(13), np.int64(15)))

    left, right = words(117, 2), words(105, 3)
    grey = np.random.default_rng(4).integers(0, 40, 117).astype(np.int16)
    # The right window ends with the image.
    at = [(np.arange(7)[:, None] * cols + np.arange(first, first + 7)).ravel() for cols, first in ((13, 18), (15, 8))]
    weights = np.maximum(16 - abs(grey[at[0]].astype(int) - grey[at[0][24]]), 0)
    expected = (weights * np.minimum(sad(left[at[0]], right[at[1]]), 600)).sum()
    assert call(left, right, grey, 18, 8) == expected


def test_all_widths_search_alike():
    left, right = words(12 * 21, 5), words(20 * 30, 6)
    rng = np.random.default_rng(7)
    terms = tuple(np.float32(t) for t in rng.normal(size=8))
    line = terms[:3]
    todo = np.array([1, 3, 5, 7, 11, 13, 19, 19], np.int32)
    start = ((rng.integers(-2, 3, 12 * 21) << 16) | (rng.integers(-4, 5, 12 * 21) & 0xFFFF)).astype(np.int32)
    found = []
    for width in WIDTHS:
        four, settle, dense = (
            strip_simd.make_four(width),
            simd.make_settle(width),
            simd.make_settle(width, dense=True),
        )

        @njit
        def call(packed, data, new, cost, best, least):
            for k in range(6):
                strip = np.int64(-2), np.int64(8 - k), np.int64(k - 2), np.int64(-1), np.int64(k % 2)
                at = np.int64(4 * 21 + 2 * k), np.int64(5 * 30 + 2 * k)
                sizes = np.int64(21), np.int64(30)
                out = best[4 * k :], least[4 * k :]
                four((left, right), line, at, sizes, strip, out)  # noqa: B023 (called before the next turn)
            maps, level, place = (left, right, packed, data), (20, 30, 21, 3, 40, 2, 5), (0, 4 * 21, 3 * 21, 5 * 21, 4)
            settle(maps, terms, todo, place, level, (new, cost))  # noqa: B023
            dense(maps, terms, todo, place, level, (new[8:], cost[8:]))  # noqa: B023

        results = [np.zeros(16, np.int32), np.zeros(16, np.int32), np.zeros(24, np.int32), np.full(24, 9999, np.int32)]
        call(start, np.full(12 * 21, 900, np.int32), *results)
        found.append(results)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(a, b)
    assert len(np.unique(found[0][2])) > 5
    assert (found[0][3] < 9999).all()


def test_a_spline_is_scipys_between_pixels():
    @njit
    def call(found, x, y):
        i, j = int(x), int(y)
        t, s = x - np.float32(i), y - np.float32(j)
        return rowwise.spline_value(found.ravel(), j * found.shape[1] + i, found.shape[1], t, s)

    image = np.random.default_rng(8).uniform(0, 255, (9, 10)).astype(np.float32)
    for x, y in np.random.default_rng(9).uniform(2, 6, (50, 2)).astype(np.float32):
        expected = ndimage.map_coordinates(image, [[y], [x]], np.float64, order=3, mode="mirror")
        np.testing.assert_allclose(call(coefficients(image), x, y), expected[0], atol=5e-3)
