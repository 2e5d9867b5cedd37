"""Vector code against NumPy, and its x86 forms against the portable one."""

import numpy as np
import pytest
from numba import njit

from stages.hfvm import lanes
from stages.hfvm.resample import sample_cubic

WIDTHS = sorted({0, lanes.widest()})


def words(n, seed):
    return np.random.default_rng(seed).integers(0, 256, (n, 8)).astype(np.uint8).view(np.uint64)[:, 0]


def sad(a, b):
    return np.abs(a[:, None].view(np.uint8).astype(int) - b[:, None].view(np.uint8).astype(int)).sum(axis=1)


@pytest.mark.parametrize("width", WIDTHS)
def test_sums_over_windows(width):
    sums = lanes.make_sums(width)

    @njit
    def call(left, right, at_left, at_right):
        return sums(left, right, at_left, at_right, np.int64(11), np.int64(13))

    left, right = words(99, 2).reshape(9, 11), words(143, 3).reshape(11, 13)
    found = call(left.ravel(), right.ravel(), 4 * 11 + 5, 5 * 13 + 6)
    here = left[2:7, 3:8].ravel()
    moves = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
    expected = [sad(here, right[3 + j : 8 + j, 4 + i : 9 + i].ravel()).sum() for j, i in moves]
    assert list(found) == expected


def test_all_widths_search_alike():
    left, right = words(12 * 21, 5), words(20 * 30, 6)
    rng = np.random.default_rng(7)
    centres = ((rng.integers(-2, 3, 8 * 13) << 16) | (rng.integers(-4, 5, 8 * 13) & 0xFFFF)).astype(np.int32)
    lines = rng.normal(size=3 * 12 * 21).astype(np.float32)
    todo = np.array([1, 3, 5, 7, 11, 13, 19, 19], np.int32)
    found = []
    for width in WIDTHS:
        seek, settle = lanes.make_seek(width), lanes.make_settle(width)

        @njit
        def call(centres, packed, data, new, cost):
            shape = (20, 30, 21, 12 * 21, 3)
            mu = np.float32(8.0)
            for y in range(12):
                for x in range(0, 21, 8):
                    parents = ((y >> 1) + 1) * 13
                    seek(  # noqa: B023 (called before the next turn)
                        left, right, centres, lines, x, y, y * 21, parents, parents + 13, shape, (1, 1, 5), mu, packed,
                        data,
                    )  # fmt: skip
            settle(  # noqa: B023
                left, right, packed, data, lines, todo, 0, 4 * 21, 3 * 21, 5 * 21, 4, shape, 5, mu, new, cost
            )

        results = [np.zeros(n, np.int32) for n in (12 * 21, 12 * 21, 8, 8)]
        call(centres, *results)
        found.append(results)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(a, b)
    assert len(np.unique(found[0][0])) > 10


def test_cubic_interpolation_equals_the_plain_form():
    @njit
    def call(image, x, y):
        i, j = int(x), int(y)
        t, s = x - np.float32(i), y - np.float32(j)
        return lanes.cubic(image.ravel(), j * image.shape[1] + i, image.shape[1], t, s)

    image = np.random.default_rng(8).uniform(0, 255, (9, 10)).astype(np.float32)
    for x, y in np.random.default_rng(9).uniform(2, 6, (50, 2)).astype(np.float32):
        np.testing.assert_allclose(call(image, x, y), sample_cubic(image, x, y)[0], rtol=1e-4, atol=1e-3)
