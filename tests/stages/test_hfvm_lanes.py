"""Vector code against NumPy, and its x86 forms against the portable one."""

from itertools import product

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
def test_a_run_finds_the_first_of_the_least_costs(width):
    run = lanes.make_run(width)

    @njit
    def call(word, right, start, count, u, v, line, mu):
        return run(word, right, start, count, u, v, line[0], line[1], line[2], mu, np.int64(5))

    right = words(40, 1)
    right[12] = right[10]
    line = np.array([0.1, 1.0, -2.0], np.float32)
    for mu in (0.0, 8.0):
        for start, count in product(range(0, 32, 3), (1, 3, 8)):
            word = words(1, 100 + start)[0] if start % 2 else right[start + min(2, count - 1)]
            cost = sad(np.full(count, word), right[start : start + count])
            if mu:
                u = 4.0 + np.arange(count)
                cost = cost + (mu * np.abs(line[0] * u + line[1] * -3.0 + line[2])).astype(int)
            key = call(word, right, start, count, np.int64(4), np.int64(-3), line, mu)
            assert key >> lanes.ORDER == cost.min()
            assert (key & ((1 << lanes.ORDER) - 1)) - 5 == cost.argmin()


def test_nothing_is_read_behind_the_count():
    run = lanes.make_run(lanes.widest())

    @njit
    def call(word, right):
        z = np.float32(0.0)
        return run(word, right, np.int64(2), np.int64(1), np.int64(0), np.int64(0), z, z, z, 0.0, np.int64(0))

    assert call(np.uint64(7), np.array([0, 0, 7], np.uint64)) == 0


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


def test_all_widths_decide_alike_among_neighbours():
    right = words(20 * 30, 5)
    keys = []
    for width in WIDTHS:
        around = lanes.make_around(width)

        @njit
        def call(word, right, x, y, p, data, line, mu):
            return around(  # noqa: B023 (called before the next turn)
                word, right, np.int64(20), np.int64(30), x, y, p[0], data, p[1], p[2], p[3], p[4], np.int64(5),
                line[0], line[1], line[2], mu,
            )  # fmt: skip

        rng = np.random.default_rng(6)
        found = []
        for k in range(200):
            x, y = int(rng.integers(0, 30)), int(rng.integers(0, 20))
            u, v = rng.integers(-4, 5, (2, 5)).astype(np.int32)
            line = rng.normal(size=3).astype(np.float32)
            found.append(call(words(1, 7)[0], right, x, y, (v << 16) | (u & 0xFFFF), 1 << 25, line, 8.0 * (k % 2)))
        keys.append(found)
    assert all(k == keys[0] for k in keys)


def test_cubic_interpolation_equals_the_plain_form():
    @njit
    def call(image, x, y):
        i, j = int(x), int(y)
        t, s = x - np.float32(i), y - np.float32(j)
        return lanes.cubic(image.ravel(), j * image.shape[1] + i, image.shape[1], t, s)

    image = np.random.default_rng(8).uniform(0, 255, (9, 10)).astype(np.float32)
    for x, y in np.random.default_rng(9).uniform(2, 6, (50, 2)).astype(np.float32):
        np.testing.assert_allclose(call(image, x, y), sample_cubic(image, x, y), rtol=1e-4, atol=1e-3)
