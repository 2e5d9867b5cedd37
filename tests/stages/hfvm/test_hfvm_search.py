"""One-level solvers against slow NumPy, candidate by candidate."""

import numpy as np
import pytest

from rille.stages.hfvm import epipolar, paper
from rille.stages.hfvm.native import reference
from rille.stages.hfvm.native.problem import Field, LevelPair, Map, Smoothing, pack_map, unpacked
from rille.stages.hfvm.native.reference import FAR

ROWS, COLS = 11, 13


def words(shape, seed):
    # Few grey levels, so that ties occur and their order is tested.
    return np.random.default_rng(seed).integers(0, 4, (*shape, 8)).astype(np.uint8).view(np.uint64)[..., 0]


def sad(a, b):
    return int(np.abs(np.array([a]).view(np.uint8).astype(int) - np.array([b]).view(np.uint8).astype(int)).sum())


X0, Y0 = 6, 4
"""Where the window lies in the left image."""


def some_band(seed):
    f = np.array([[1e-4, 0.02, 0.1], [0.01, 1e-3, 1.0], [0.03, -1.0, 0.4]])
    return f + np.random.default_rng(seed).normal(0, 1e-3, (3, 3))


def line(f, y, x, length):
    """Line of a pixel, as the kernels add it up."""
    return np.array(epipolar.line(epipolar.row_terms(f, float(y)), np.float32(x), np.float32(length)), np.float32)


def off_line(f, y, x, u, v, mu):
    a, b, c = line(f, y, x, mu)
    return min(int(abs(a * np.float32(u) + b * np.float32(v) + c)), int(reference.FARTHEST_OFF))


def test_terms_of_a_row_make_its_lines():
    f = some_band(1)
    planes = np.moveaxis(epipolar.lines(f, (ROWS, COLS)), 2, 0)
    for y, x in np.ndindex(ROWS, COLS):
        np.testing.assert_allclose(line(f, y, x, 1.0), planes[:, y, x], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(line(f, y, x, 3.0), 3 * planes[:, y, x], rtol=1e-5, atol=1e-5)
    assert not line(np.zeros((3, 3)), 2, 3, 0.0).any()


def test_rows_are_settled_onto_their_lines():
    f, u = some_band(2), np.random.default_rng(3).uniform(-5, 5, (ROWS, COLS)).astype(np.float32)
    v, wanted = np.full((ROWS, COLS), 7.0, np.float32), np.zeros((ROWS, COLS), np.uint8)
    wanted[::2] = 1
    v = epipolar.settled(epipolar.moved(f, (X0, Y0), (X0, Y0)), u, v, wanted)
    assert (v[1::2] == 7.0).all()
    for y, x in np.ndindex(ROWS, COLS):
        if wanted[y, x]:
            p, q = np.array([x + X0, y + Y0, 1.0]), np.array([x + X0 + u[y, x], y + Y0 + v[y, x], 1.0])
            assert abs(q @ f @ p) < 1e-4
    down = np.full((ROWS, COLS), 7.0, np.float32)
    down = epipolar.settled(np.array([[0.0, 0, -1], [0, 0, 0], [1, 0, 0.0]]), u, down, wanted)
    assert (down == 7.0).all()  # lines along the columns do not say how far


def centre(up_u, up_v, f, j, i, mu):
    """Doubled displacement of a coarse pixel, the border repeated, moved to its line by a pixel at most."""
    j, i = min(max(j, 0), 5), min(max(i, 0), 6)
    u, v = 2 * int(up_u[j, i]), 2 * int(up_v[j, i])
    if mu >= reference.SHARP:
        a, b, c = line(f, 2 * j + 0.5, 2 * i + 0.5, 1.0)
        e = np.float32(np.clip(a * np.float32(u) + b * np.float32(v) + c, -1, 1))
        u, v = u - int(np.rint(e * a)), v - int(np.rint(e * b))
    return u, v


def candidates(centres, reach_x, reach_y, mu):
    """Displacements that a pixel tries, in the order in which equal ones win."""
    (u, v), sharp = centres[0], mu >= reference.SHARP
    if not sharp or reach_x > 3:
        for m, (cu, cv) in enumerate(dict.fromkeys(centres)):
            for dv in range(-reach_y, reach_y + 1) if not sharp or m == 0 else [0]:
                wide = reach_x if not sharp or dv == 0 else 0
                for first in range(-wide, wide + 1, 8):
                    piece = list(range(first, min(first + 8, wide + 1)))
                    yield from ((cu + du, cv + dv) for du in sorted(piece, key=lambda du: (du != 0, du)))
        return
    low = high = u
    apart = []
    for cu, cv in centres[1:]:
        if cv == v and max(high - cu, cu - low) <= min(2 * reach_x + 1, 7 - 2 * reach_x):
            low, high = min(low, cu), max(high, cu)
        else:
            apart.append((cu, cv))
    yield u, v
    yield from ((du, v) for du in range(low - reach_x, high + reach_x + 1))
    yield from ((u, v + dv) for dv in range(-reach_y, reach_y + 1))
    for cu, cv in apart:
        yield cu, cv
        yield from ((cu + du, cv) for du in range(-reach_x, reach_x + 1))


@pytest.mark.parametrize("mu", [0.0, 2.0, 3.0])
@pytest.mark.parametrize(("reach_x", "reach_y"), [(1, 1), (2, 1), (1, 0), (5, 1)])
def test_descend_finds_the_first_of_the_best_around_its_centres(mu, reach_x, reach_y):
    left, right = words((ROWS, COLS), 1), words((12, 24), 2)
    up_u, up_v = np.random.default_rng(3).integers(-2, 3, (2, 6, 7)).astype(np.int16)
    # Equal parents side by side, and inside: their children are searched in one piece, four at once.
    up_u[2:], up_v[2:] = up_u[2:] // 2 + 1, 0
    f = some_band(4)
    out = Field(*np.zeros((2, ROWS, COLS), np.int32))
    reference.search(LevelPair(left, right, f, mu), (up_u, up_v), (reach_x, reach_y), out)
    found_u, found_v = unpacked(out.shift)
    for y, x in np.ndindex(ROWS, COLS):
        j, i = y // 2, x // 2
        near = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
        centres = [centre(up_u, up_v, f, j + dj, i + di, mu) for dj, di in near]
        best = (*centres[0], FAR)
        for u, v in candidates(centres, reach_x, reach_y, mu):
            if 0 <= x + u < 24 and 0 <= y + v < 12:
                cost = sad(left[y, x], right[y + v, x + u]) + off_line(f, 2 * j + 0.5, 2 * i + 0.5, u, v, mu)
                best = (u, v, cost) if cost < best[2] else best
        assert (found_u[y, x], found_v[y, x], out.cost[y, x]) == best


def slow_checkerboard(left, right, u, v, f, mu, smoothness, rounds, beside):
    u, v = u.copy(), v.copy()

    def at(y, x):
        return min(y, 2 * (ROWS - 1) - y) if y >= ROWS else abs(y), min(x, 2 * (COLS - 1) - x) if x >= COLS else abs(x)

    for turn in range(2 * rounds):
        for y in range(ROWS):
            for x in range((y + turn) % 2, COLS, 2):
                around = [(y - 1, x), (y, x - 1), (y, x + 1), (y + 1, x)]
                near = [(int(u[at(*p)]), int(v[at(*p)])) for p in around]
                a, b = int(u[y, x]), int(v[y, x])
                best = None
                own = [
                    (a, b),
                    *([(a - 1, b), (a + 1, b)] if beside else []),
                    *([(a, b - 1), (a, b + 1)] if beside > 1 else []),
                ]
                others = [p for p in near if p[1] != b or abs(p[0] - a) > 1]
                for du, dv in [*own, *others]:
                    if not (0 <= x + du < right.shape[1] and 0 <= y + dv < right.shape[0]):
                        continue
                    cost = sad(left[y, x], right[y + dv, x + du]) + off_line(f, y, x, du, dv, mu)
                    cost += smoothness * sum(min(abs(p - du) + abs(q - dv), 2) for p, q in near)
                    if best is None or cost < best[0]:
                        best = (cost, du, dv)
                if best:
                    u[y, x], v[y, x] = best[1:]
    return u, v


@pytest.mark.parametrize(("mu", "beside"), [(0.0, 2), (3.0, 0), (3.0, 1), (3.0, 2)])
def test_propagation_equals_slow_numpy_over_several_rounds(mu, beside, monkeypatch):
    # Wide enough that some pixels are read as whole vectors and others are not.
    monkeypatch.setitem(globals(), "COLS", 37)
    left, right = words((ROWS, COLS), 5), words((ROWS, COLS + 2), 6)
    u, v = np.random.default_rng(7).integers(-3, 4, (2, ROWS, COLS)).astype(np.int16)
    f = some_band(8)
    for rounds in (1, 3):
        expected = slow_checkerboard(left, right, u, v, f, mu, 2, rounds, beside)
        field = Field(pack_map(u, v), costs(left, right, u, v, f, mu))
        reference.propagate(LevelPair(left, right, f, mu), field, Smoothing(2, rounds, beside))
        found = unpacked(field.shift)
        np.testing.assert_array_equal(found, expected)
        assert (found[0] != u).any()
        np.testing.assert_array_equal(field.cost, costs(left, right, *found, f, mu))


def costs(left, right, u, v, f, mu):
    """Cost of every pixel's displacement without smoothness."""
    found = np.full((ROWS, COLS), FAR, np.int32)
    for y, x in np.ndindex(ROWS, COLS):
        i, j = x + int(u[y, x]), y + int(v[y, x])
        if 0 <= i < right.shape[1] and 0 <= j < right.shape[0]:
            found[y, x] = sad(left[y, x], right[j, i]) + off_line(f, y, x, int(u[y, x]), int(v[y, x]), mu)
    return found


def test_exhaustive_search_finds_a_two_dimensional_shift_and_prefers_the_short_one():
    big = words((20, 24), 9)
    left, right = big[4:16, 6:18], big[2:14, 3:15]
    none, out = np.zeros((3, 3)), Field(*np.zeros((2, 12, 12), np.int32))
    reference.exhaustive(LevelPair(left, right, none, 0.0), (6, 6), out)
    u, v = unpacked(out.shift)
    assert (u[:9, :8] == 3).all()
    assert (v[:9, :8] == 2).all()
    for y, x in np.ndindex(12, 12):
        assert out.cost[y, x] == sad(left[y, x], right[y + v[y, x], x + u[y, x]])
    flat = np.zeros((5, 5), np.uint64)
    out = Field(*np.full((2, 5, 5), 99, np.int32))
    reference.exhaustive(LevelPair(flat, flat, none, 0.0), (3, 3), out)
    assert (out.shift == 0).all()


def test_summed_distances_against_numpy():
    left, right = words((12, 14), 10), words((12, 14), 11)
    u, v = np.random.default_rng(12).integers(-1, 2, (2, 12, 14)).astype(np.int16)
    # Equal displacements side by side are summed together.
    u[5:7], v[5:7] = 1, 0
    wanted = np.ones((12, 14), np.uint8)
    wanted[5, 5] = 0
    fine_u, fine_v, d = reference.sums(LevelPair(left, right, np.zeros((3, 3)), 0.0), u, v, wanted)

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
        assert reference.linear(*d) == pytest.approx(true, abs=1e-6)
    assert reference.linear(5, 5, 5) == 0


def test_papers_search_is_equation_1_to_3():
    rng = np.random.default_rng(13)
    planes = rng.uniform(-50, 50, (2, 8, 10, 12)).astype(np.float32)
    weights = (2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 10.0, 4.0)
    a, b = (paper.weighted(p, weights) for p in planes)
    centre_u, centre_v = rng.integers(-2, 3, (2, 10, 12)).astype(np.int16)
    u, v, d, _ = paper.search(a, b, Map(centre_u, centre_v), (2, 1))
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
