"""Parts of the Locus kernel against plain NumPy."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq

from rille.stages.geometry.geometry import rotation_exp
from rille.stages.terrain.locus.kernel import (
    MARGIN_STEPS,
    SOLVED_PX,
    Bracket,
    Cells,
    Dem,
    Line,
    Observed,
    PairCameras,
    PairLines,
    mismatch,
    root,
    search,
    steps_of,
    visible,
)

WIDTH, HEIGHT = 40, 30
LEFT = np.array([[50.0, 0.0, 20.0, 3.0], [0.0, 50.0, 15.0, -2.0], [0.0, 0.0, 1.0, 1.0]])
RIGHT = np.array([[50.0, 0.0, 20.0, -4.0], [0.0, 50.0, 15.0, -1.0], [0.0, 0.0, 1.0, 1.02]])
EPIPOLE = np.array([-7.0, 1.0, 0.02])
SIZES = np.array([WIDTH, HEIGHT, WIDTH, HEIGHT], float)


DIRECTION = tuple(EPIPOLE)
PLAIN = np.ones((HEIGHT, WIDTH), np.float32)


def observed(disparity: np.ndarray, max_jump: float = 1.0) -> Observed:
    return Observed(disparity.astype(np.float32), PLAIN, PLAIN, max_jump, np.eye(2))


def cells(n: int = 20, spread: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Feet and normals (n, 3)."""
    rng = np.random.default_rng(1)
    return rng.uniform(-spread, spread, (n, 3)), rng.normal(size=(n, 3)) * 0.2 + [0.0, 0.0, 1.0]


def lines(foot: np.ndarray, normal: np.ndarray) -> PairLines:
    return PairLines(*(Line(*(p[:, :3] @ foot + p[:, 3]), *(p[:, :3] @ normal)) for p in (LEFT, RIGHT)))


def pixel(projection: np.ndarray, point: np.ndarray) -> np.ndarray:
    h = projection[:, :3] @ point + projection[:, 3]
    return h[:2] / h[2]


def expected(point: np.ndarray, disparity: np.ndarray) -> float:
    p, q = pixel(LEFT, point), pixel(RIGHT, point)
    if not (0 <= p[0] < WIDTH - 1 and 0 <= p[1] < HEIGHT - 1):
        return np.nan
    (c, r), (fx, fy) = p.astype(int), p % 1
    d = (1 - fy) * ((1 - fx) * disparity[r, c] + fx * disparity[r, c + 1])
    d = d + fy * ((1 - fx) * disparity[r + 1, c] + fx * disparity[r + 1, c + 1])
    g, e = p + d - q, q * EPIPOLE[2] - EPIPOLE[:2]
    e /= np.linalg.norm(e)
    return float(g @ e)


def test_the_mismatch_is_that_of_the_projections() -> None:
    rng, there = np.random.default_rng(2), 0
    disparity = rng.normal(size=(HEIGHT, WIDTH, 2)).astype(np.float32)
    disparity[10:12, 5:9] = np.nan
    for foot, normal in zip(*cells(), strict=True):
        for z in np.linspace(-0.3, 0.3, 16):
            found = mismatch(lines(foot, normal), z, DIRECTION, disparity)
            s = expected(foot + z * normal, disparity)
            assert found.s / np.sqrt(found.power) == pytest.approx(s, abs=1e-6, nan_ok=True)
            there += np.isfinite(s)
    assert 0.1 < there / (16 * 20) < 0.98


def at_pixel(x: float, y: float, slope: float = 0.0) -> PairLines:
    """Lines of a cell whose point at elevation z lies at x + slope z, y in both images."""
    return PairLines(*(Line(x + k, y, 1.0, slope, 0.0, 0.0) for k in (0.0, 0.5)))


def test_on_the_last_row_and_column_no_pixel_is_read_beyond_the_image() -> None:
    disparity = np.ones((HEIGHT, WIDTH, 2), np.float32)
    places = [(WIDTH - 1, 5), (5, HEIGHT - 1), (WIDTH - 1.01, HEIGHT - 1.01), (0, 0), (-0.01, 5)]
    found = [np.isfinite(mismatch(at_pixel(float(x), float(y)), 0.0, DIRECTION, disparity).s) for x, y in places]
    assert found == [False, False, True, True, False]


@pytest.mark.parametrize("ends", [(0.0, 3.0, 0.5, -0.05), (0.0, 3.0, 1.0, -0.06)])
def test_a_root_beside_a_kink_is_found(ends: tuple[float, float, float, float]) -> None:
    """s falls from 3 to -0.05 px before column 11 and by 0.01 px behind it: a plain chord would creep to the kink."""
    disparity = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    disparity[:, 10:13, 0] = 7.05, -0.05, -1.07
    pair = PairLines(Line(10.5, 10.0, 1.0, 1.0, 0.0, 0.0), Line(11.0, 10.0, 1.0, 0.0, 0.0, 0.0))
    found, _ = root(pair, Bracket(*ends), (-1.0, 0.0, 0.0), disparity)
    assert found == pytest.approx(0.5 - 0.05 / 6.1, abs=SOLVED_PX / 6.1)


def test_lines_end_where_an_image_does_and_steps_are_a_pixel_at_most() -> None:
    short = 0
    for k, (foot, normal) in enumerate(zip(*cells(30, 0.6), strict=True)):
        low, high = 0.05, 0.1 if k % 2 else 3.0
        pair = lines(foot, normal)
        bottom, top = visible(pair, SIZES, (-0.4, 2.0))
        z = np.linspace(-0.4, 2.0, 4001)
        ends = [[pixel(p, foot + v * normal) for v in z] for p in (LEFT, RIGHT)]
        inside = np.all([(p >= 0) & (p <= [WIDTH - 1, HEIGHT - 1]) for p in np.array(ends)], axis=(0, 2))
        if not inside.any():
            assert top - bottom < 1e-3
            continue
        assert bottom == pytest.approx(z[inside][0], abs=1e-3)
        assert top == pytest.approx(z[inside][-1], abs=1e-3)
        short += top < 2.0 or bottom > -0.4
        steps = steps_of(pair, (bottom, top), (low, high))
        assert steps.most * steps.dz == pytest.approx(top - bottom)
        for p in (LEFT, RIGHT):
            line = np.array([pixel(p, foot + v * normal) for v in np.linspace(bottom, top, steps.most + 1)])
            assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 1.0 + 1e-9
        start, last = (bottom + step * steps.dz for step in (steps.first, steps.last))
        assert min(high + MARGIN_STEPS * steps.dz, top) - 1e-9 <= start <= top + 1e-9
        assert last <= low - MARGIN_STEPS * steps.dz
    assert short > 15


def changes(s: np.ndarray, start: int, last: int) -> list[int]:
    """Steps k with a change from free (k + 1) to behind (k), in the order in which the module says they are tried."""
    found = []
    if s[start] < 0.0:
        above = next((k for k in range(start, len(s) - 1) if not s[k + 1] < 0.0), None)
        found += [above] if above is not None and s[above + 1] >= 0.0 else []
    for k in range(start - 1, -1, -1):
        if s[k + 1] >= 0.0 and s[k] < 0.0:
            found.append(k)
        if k <= last and not s[k] >= 0.0:
            break
    return found


def jump(point: np.ndarray, disparity: np.ndarray) -> float:
    """Range of the four disparities around a point's projection, pixels."""
    c, r = pixel(LEFT, point).astype(int)
    return float(np.hypot(*np.ptp(disparity[r : r + 2, c : c + 2], axis=(0, 1))))


def stands(
    at: Callable[[float], float], jump_at: Callable[[float], float], below: float, dz: float, limit: float
) -> tuple[float, str]:
    """The root of the step above ``below``, and whether it stands: "yes", "no", or "unclear", too near to a gap or a
    limit for another calculation to tell."""
    inner = np.array([at(z) for z in np.linspace(below, below + dz, 30)])
    if not np.isfinite(inner).all() or (np.diff(np.sign(inner)) != 0).sum() != 1:
        return np.nan, "unclear"
    root = brentq(at, below, below + dz)
    apart, slope = jump_at(root), float(np.fmin(at(root + dz), -at(root - dz)))
    if abs(apart - limit) < 0.01 or abs(slope) < 0.01:
        return root, "unclear"
    return root, "yes" if apart < limit and slope > 0.0 else "no"


def test_of_several_changes_the_one_is_taken_that_the_module_names() -> None:
    """Wavy disparities with gaps; their jumps refuse some of the roots."""
    n, rng = 32, np.random.default_rng(7)
    turn = rotation_exp([math.pi - 0.15, 0.2, 0.0])  # z towards the camera
    x, y = (rng.uniform(-0.15, 0.15, k) for k in (8, 4))
    feet, normal = np.stack([*np.meshgrid(x, y), np.zeros((4, 8))], axis=-1).reshape(-1, 3) @ turn.T, turn[:, 2]
    low, high = (rng.uniform(*ends, n).astype(np.float32) for ends in ((-3.0, -0.8), (-0.8, 0.3)))
    low[::3] = high[::3] - np.float32(0.02)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    waves = -4.5 + 2.5 * np.sin(1.5 * u + v), 0.5 + 0.7 * np.sin(0.7 * u - 0.4 * v)
    disparity = np.stack(waves, axis=-1).astype(np.float32)
    disparity[rng.random((HEIGHT, WIDTH)) < 0.01] = np.nan
    limit = 2.7
    out = Dem(*(np.full((4, 8), np.nan, np.float32) for _ in range(3)))
    turned = (np.column_stack([p[:, :3] @ turn, p[:, 3]]) for p in (LEFT, RIGHT))
    there = Cells(x, y, low.reshape(4, 8), high.reshape(4, 8))
    search(there, (-4.0, 0.4), PairCameras(*turned, EPIPOLE, SIZES), observed(disparity, limit), out)
    met = []
    for k, found in enumerate(out.elevation.ravel().astype(float)):
        pair = lines(feet[k], normal)
        bottom, dz, count, start, last = steps_of(pair, visible(pair, SIZES, (-4.0, 0.4)), (low[k], high[k]))
        at, jump_at = (partial(lambda of, k, z: of(feet[k] + z * normal, disparity), of, k) for of in (expected, jump))
        steps = changes(np.array([at(bottom + j * dz) for j in range(count + 1)]), start, int(last))
        verdicts = [stands(at, jump_at, bottom + step * dz, dz, limit) for step in steps]
        tried, (where, verdict) = next(((i, v) for i, v in enumerate(verdicts) if v[1] != "no"), (0, (np.nan, "no")))
        met.append((verdict, min(tried, 1)))
        if verdict != "unclear":
            assert found == pytest.approx(where if verdict == "yes" else np.nan, abs=0.02 * dz, nan_ok=True)
    assert min(met.count(case) for case in (("yes", 0), ("yes", 1), ("no", 0))) > 1
    assert sum(verdict == "unclear" for verdict, _ in met) < n // 4
