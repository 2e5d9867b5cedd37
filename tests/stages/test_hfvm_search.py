"""One-level solvers against slow NumPy, candidate by candidate."""

import numpy as np
import pytest

from stages.hfvm import epipolar, paper, propagation, search, subpixel

ROWS, COLS = 11, 13


def words(shape, seed):
    # Few grey levels, so that ties occur and their order is tested.
    return np.random.default_rng(seed).integers(0, 4, (*shape, 8)).astype(np.uint8).view(np.uint64)[..., 0]


def sad(a, b):
    return int(np.abs(np.array([a]).view(np.uint8).astype(int) - np.array([b]).view(np.uint8).astype(int)).sum())


def some_lines(seed):
    f = np.array([[1e-4, 0.02, 0.1], [0.01, 1e-3, 1.0], [0.03, -1.0, 0.4]])
    return epipolar.lines(f + np.random.default_rng(seed).normal(0, 1e-3, (3, 3)), (ROWS, COLS))


def off_line(lines, y, x, u, v, mu):
    return int(mu * abs(lines[y, x, 0] * u + lines[y, x, 1] * v + lines[y, x, 2])) if mu else 0


@pytest.mark.parametrize("mu", [0.0, 3.0])
def test_descend_never_loses_to_any_single_centre(mu):
    left, right = words((ROWS, COLS), 1), words((9, 15), 2)
    rng = np.random.default_rng(3)
    up_u, up_v = rng.integers(-2, 3, (2, 6, 7)).astype(np.int16)
    lines = some_lines(4)
    u, v = np.zeros((2, ROWS, COLS), np.int16)
    packed, data = np.zeros((2, ROWS, COLS), np.int32)
    propagation.descend(left, right, up_u, up_v, 1, 1, lines, mu, packed, data)
    propagation.unpack(packed, u, v)

    def cost(y, x, du, dv):
        if not (0 <= x + du < 15 and 0 <= y + dv < 9):
            return None
        return sad(left[y, x], right[y + dv, x + du]) + off_line(lines, y, x, du, dv, mu)

    for y in range(ROWS):
        for x in range(COLS):
            areas = []
            for j in range(y // 2 - 1, y // 2 + 2):
                for i in range(x // 2 - 1, x // 2 + 2):
                    if 0 <= j < 6 and 0 <= i < 7:
                        cu, cv = 2 * int(up_u[j, i]), 2 * int(up_v[j, i])
                        if mu:
                            a, b, c = lines[2 * j, 2 * i]
                            e = np.float32(np.clip(a * cu + b * cv + c, -1, 1))
                            cu, cv = cu - int(np.rint(e * a)), cv - int(np.rint(e * b))
                        areas.append((cu, cv))
            tried = [cost(y, x, cu + du, cv + dv) for cu, cv in areas for du in (-1, 0, 1) for dv in (-1, 0, 1)]
            tried = [t for t in tried if t is not None]
            if tried:
                assert cost(y, x, int(u[y, x]), int(v[y, x])) <= min(tried)
                assert cost(y, x, int(u[y, x]), int(v[y, x])) == data[y, x]
            near = np.array(areas)
            # Nothing outside the rectangle around all centres is ever taken.
            assert near[:, 0].min() - 1 <= u[y, x] <= near[:, 0].max() + 1
            assert near[:, 1].min() - 1 <= v[y, x] <= near[:, 1].max() + 1


def slow_checkerboard(left, right, u, v, lines, mu, smoothness, rounds):
    u, v = u.copy(), v.copy()
    for turn in range(2 * rounds):
        for y in range(ROWS):
            for x in range((y + turn) % 2, COLS, 2):
                around = [(y - 1, x), (y, x - 1), (y, x + 1), (y + 1, x)]
                near = [(int(u[p]), int(v[p])) for p in around if 0 <= p[0] < ROWS and 0 <= p[1] < COLS]
                a, b = int(u[y, x]), int(v[y, x])
                best = None
                for du, dv in [(a, b), (a - 1, b), (a + 1, b), (a, b - 1), (a, b + 1), *near]:
                    if not (0 <= x + du < right.shape[1] and 0 <= y + dv < right.shape[0]):
                        continue
                    cost = sad(left[y, x], right[y + dv, x + du]) + off_line(lines, y, x, du, dv, mu)
                    cost += smoothness * sum(min(abs(p - du) + abs(q - dv), 2) for p, q in near)
                    if best is None or cost < best[0]:
                        best = (cost, du, dv)
                if best:
                    u[y, x], v[y, x] = best[1:]
    return u, v


@pytest.mark.parametrize("mu", [0.0, 3.0])
def test_propagation_equals_slow_numpy_over_several_rounds(mu):
    left, right = words((ROWS, COLS), 5), words((ROWS, COLS + 2), 6)
    u, v = np.random.default_rng(7).integers(-3, 4, (2, ROWS, COLS)).astype(np.int16)
    lines = some_lines(8)
    expected = slow_checkerboard(left, right, u, v, lines, mu, 2, 3)
    packed, data = np.empty((2, ROWS, COLS), np.int32)
    propagation.pack_map(u, v, packed)
    propagation.costs(left, right, lines, mu, packed, data)
    propagation.checkerboard(left, right, packed, data, np.empty((ROWS, COLS), np.uint8), lines, mu, 2, 3)
    found = np.empty((2, ROWS, COLS), np.int16)
    propagation.unpack(packed, *found)
    np.testing.assert_array_equal(found, expected)
    assert (found[0] != u).any()
    again = np.empty_like(data)
    propagation.costs(left, right, lines, mu, packed, again)
    np.testing.assert_array_equal(data, again)


def test_exhaustive_search_finds_a_two_dimensional_shift_and_prefers_the_short_one():
    big = words((20, 24), 9)
    left, right = big[4:16, 6:18], big[2:14, 3:15]
    u, v = np.full((2, 12, 12), 99, np.int16)
    search.exhaustive(left, right, 6, 6, 1, u, v)
    assert (u[:9, :8] == 3).all()
    assert (v[:9, :8] == 2).all()
    flat = np.zeros((5, 5), np.uint64)
    u, v = np.full((2, 5, 5), 99, np.int16)
    search.exhaustive(flat, flat, 3, 3, 1, u, v)
    assert (u == 0).all()
    assert (v == 0).all()


def test_summed_distances_against_numpy():
    left, right = words((12, 14), 10), words((12, 14), 11)
    u, v = np.random.default_rng(12).integers(-1, 2, (2, 12, 14)).astype(np.int16)
    fine_u, fine_v, d = np.empty((3, 12, 14), np.float32)
    wanted = np.ones((12, 14), np.uint8)
    wanted[5, 5] = 0
    subpixel.summed(left, right, u, v, wanted, 2, fine_u, fine_v, d)

    def total(y, x, du, dv):
        return sum(sad(left[y + j, x + i], right[y + j + dv, x + i + du]) for j in range(-2, 3) for i in range(-2, 3))

    for y in range(4, 8):
        for x in range(4, 10):
            a, b = int(u[y, x]), int(v[y, x])
            if (y, x) == (5, 5):
                assert (fine_u[y, x], fine_v[y, x], d[y, x]) == (a, b, -1)
                continue
            at = total(y, x, a, b)
            assert d[y, x] == np.float32(at) / np.float32(25)
            for got, whole, lo, hi in (
                (fine_u[y, x], a, total(y, x, a - 1, b), total(y, x, a + 1, b)),
                (fine_v[y, x], b, total(y, x, a, b - 1), total(y, x, a, b + 1)),
            ):
                steep = max(lo, hi) - at
                expected = whole + (np.clip((lo - hi) / steep / 2, -0.5, 0.5) if steep > 0 else 0.0)
                assert got == pytest.approx(expected, abs=1e-6)


def test_linear_interpolation_is_exact_for_two_equal_slopes():
    for true in (-0.5, -0.3, 0.0, 0.25, 0.5):
        d = [abs(x - true) * 40 + 7 for x in (-1, 0, 1)]
        assert subpixel.linear(*d) == pytest.approx(true, abs=1e-6)
    assert subpixel.linear(5, 5, 5) == 0


def test_papers_search_is_equation_1_to_3():
    rng = np.random.default_rng(13)
    planes = rng.uniform(-50, 50, (2, 8, 10, 12)).astype(np.float32)
    weights = (2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 10.0, 4.0)
    a, b = (paper.weighted(p, weights) for p in planes)
    centre_u, centre_v = rng.integers(-2, 3, (2, 10, 12)).astype(np.int16)
    u, v = np.empty((2, 10, 12), np.int16)
    d, offset = np.empty((10, 12), np.float32), np.empty((10, 12, 2), np.float32)
    paper.search(a, b, centre_u, centre_v, 2, 1, u, v, d, offset)
    w = np.array(weights)
    for y in range(10):
        for x in range(12):
            found = {}
            for dv in range(centre_v[y, x] - 1, centre_v[y, x] + 2):
                for du in range(centre_u[y, x] - 2, centre_u[y, x] + 3):
                    if 0 <= y + dv < 10 and 0 <= x + du < 12:
                        f = (planes[0, :, y, x] - planes[1, :, y + dv, x + du]) * w
                        found[du, dv] = np.sqrt((f**2).sum() / (w**2).sum())
            if not found:
                assert d[y, x] == -1
                continue
            assert d[y, x] == pytest.approx(min(found.values()), rel=1e-5)
            assert found[u[y, x], v[y, x]] == pytest.approx(min(found.values()), rel=1e-5)
