"""Lanes and steps of the Locus kernel against plain loops over single points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq

from rille.stages.terrain.locus import kernel
from rille.stages.terrain.locus.kernel import (
    BOTTOM,
    COUNT,
    DZ,
    FOOT,
    HIGH,
    LANES,
    LAST,
    LINE_PLANES,
    LOW,
    MARGIN,
    NORMAL,
    POINT_PLANES,
    POINTS,
    START,
    STEPS,
    TOP,
    BlockCells,
    LineSteps,
    Observed,
    PairCameras,
    Z,
    climb,
    clip,
    lines,
    meet,
    pixels,
    raise_to,
    roots,
    search,
    spans,
)

WIDTH, HEIGHT = 40, 30
LEFT = np.array([[50.0, 0.0, 20.0, 3.0], [0.0, 50.0, 15.0, -2.0], [0.0, 0.0, 1.0, 1.0]])
RIGHT = np.array([[50.0, 0.0, 20.0, -4.0], [0.0, 50.0, 15.0, -1.0], [0.0, 0.0, 1.0, 1.02]])
EPIPOLE = np.array([-7.0, 1.0, 0.02])
SIZES = np.array([WIDTH, HEIGHT, WIDTH, HEIGHT], float)


def cells(n: int = 20, spread: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Feet and normals (n, 3), and lanes that hold them and their lines."""
    rng = np.random.default_rng(1)
    feet, normals = rng.uniform(-spread, spread, (n, 3)), rng.normal(size=(n, 3)) * 0.2 + [0.0, 0.0, 1.0]
    lanes = np.zeros(LINE_PLANES * LANES)
    for k in range(3):
        lanes[FOOT + k * LANES :][:n], lanes[NORMAL + k * LANES :][:n] = feet[:, k], normals[:, k]
    lines(n, LEFT, RIGHT, lanes)
    return feet, normals, lanes


def pixel(projection: np.ndarray, point: np.ndarray) -> np.ndarray:
    h = projection[:, :3] @ point + projection[:, 3]
    return h[:2] / h[2]


def mismatch(point: np.ndarray, disparity: np.ndarray) -> tuple[float, float]:
    p, q = pixel(LEFT, point), pixel(RIGHT, point)
    if not (0 <= p[0] < WIDTH - 1 and 0 <= p[1] < HEIGHT - 1):
        return np.nan, np.nan
    (c, r), (fx, fy) = p.astype(int), p % 1
    d = (1 - fy) * ((1 - fx) * disparity[r, c] + fx * disparity[r, c + 1])
    d = d + fy * ((1 - fx) * disparity[r + 1, c] + fx * disparity[r + 1, c + 1])
    g, e = p + d - q, q * EPIPOLE[2] - EPIPOLE[:2]
    e /= np.linalg.norm(e)
    return float(g @ e), float(g[1] * e[0] - g[0] * e[1])


def test_points_of_lanes_and_of_steps_equal_single_points() -> None:
    feet, normals, lanes = cells()
    rng = np.random.default_rng(2)
    disparity = rng.normal(size=(HEIGHT, WIDTH, 2)).astype(np.float32)
    disparity[10:12, 5:9] = np.nan
    plain = np.ones((HEIGHT, WIDTH), np.float32)
    seen = Observed(disparity.ravel(), plain, plain, np.ones(2), np.ones(2))
    room = np.zeros(POINT_PLANES * POINTS)
    step, dz, found = 3.0, 0.02, 0
    for way in (-1.0, 1.0):
        for k in range(len(feet)):
            climb(lanes, k, LineSteps(-0.2, step, way, dz), (HEIGHT, WIDTH), room[STEPS * k :])
        meet(STEPS * len(feet), EPIPOLE, seen, room)
        steps = room.copy()
        for m in range(STEPS):
            z = -0.2 + (step + way * m) * dz
            lanes[Z : Z + len(feet)] = z
            raise_to(lanes, len(feet), (HEIGHT, WIDTH), room)
            meet(len(feet), EPIPOLE, seen, room)
            for k in range(len(feet)):
                expected = mismatch(feet[k] + z * normals[k], disparity)
                for plane, value in zip((kernel.S, kernel.ACROSS), expected, strict=True):
                    one, among = pixels(room, plane, k), pixels(steps, plane, STEPS * k + m)
                    assert one == pytest.approx(value, abs=1e-9, nan_ok=True)
                    assert np.array_equal(one, among, equal_nan=True)
                found += np.isfinite(expected[0])
    assert 0.1 < found / (2 * STEPS * len(feet)) < 0.98


def test_on_the_last_row_and_column_no_pixel_is_read_beyond_the_image() -> None:
    plain = np.ones((HEIGHT, WIDTH), np.float32)
    seen = Observed(np.ones(2 * HEIGHT * WIDTH, np.float32), plain, plain, np.ones(2), np.ones(2))
    lanes, room = np.zeros(LINE_PLANES * LANES), np.zeros(POINT_PLANES * POINTS)
    for m, (x, y) in enumerate([(WIDTH - 1, 5), (5, HEIGHT - 1), (WIDTH - 1.01, HEIGHT - 1.01), (0, 0), (-0.01, 5)]):
        for a in (kernel.LEFT_A, kernel.RIGHT_A):
            lanes[a + m], lanes[a + LANES + m], lanes[a + 2 * LANES + m] = x, y, 1.0
    raise_to(lanes, 5, (HEIGHT, WIDTH), room)
    meet(5, EPIPOLE, seen, room)
    assert np.isfinite([pixels(room, kernel.S, m) for m in range(5)]).tolist() == [False, False, True, True, False]


def test_a_root_beside_a_kink_is_found_in_every_lane() -> None:
    """s falls from 3 to -0.05 px before column 11 and by 0.01 px behind it: a plain chord would creep to the kink."""
    disparity = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    disparity[:, 10:13, 0] = 7.05, -0.05, -1.07
    plain = np.ones((HEIGHT, WIDTH), np.float32)
    lanes, room = np.zeros(kernel.ROOT_PLANES * LANES), np.zeros(POINT_PLANES * POINTS)
    for plane, value in ((kernel.LEFT_A, (10.5, 10.0, 1.0)), (kernel.RIGHT_A, (11.0, 10.0, 1.0))):
        for k in range(3):
            lanes[plane + k * LANES :][:LANES] = value[k]
    lanes[kernel.LEFT_B :][:LANES] = 1.0  # column 10.5 + z
    # Every other lane has a bracket that ends at the kink.
    ends = [(0.0, 3.0, 0.5, -0.05) if k % 2 else (0.0, 3.0, 1.0, -0.06) for k in range(LANES)]
    lanes[kernel.Z0 : kernel.Z0 + 4 * LANES] = np.array(ends).T.ravel()
    roots(
        LANES,
        lanes,
        np.array([-1.0, 0.0, 0.0]),
        Observed(disparity.ravel(), plain, plain, np.ones(2), np.ones(2)),
        room,
    )
    found = lanes[kernel.ROOT : kernel.ROOT + LANES]
    np.testing.assert_allclose(found, 0.5 - 0.05 / 6.1, atol=kernel.SOLVED_PX / 6.1)


def test_lines_end_where_an_image_does_and_steps_are_a_pixel_at_most() -> None:
    feet, normals, lanes = cells(30, 0.6)
    n = len(feet)
    lanes[LOW : LOW + n], lanes[HIGH : HIGH + n] = 0.05, np.where(np.arange(n) % 2, 0.1, 3.0)
    clip(n, SIZES, -0.4, 2.0, lanes)
    spans(n, lanes)
    short = 0
    for k in range(n):
        bottom, top, dz, count = (lanes[plane + k] for plane in (BOTTOM, TOP, DZ, COUNT))
        z = np.linspace(-0.4, 2.0, 4001)
        ends = [[pixel(p, feet[k] + v * normals[k]) for v in z] for p in (LEFT, RIGHT)]
        inside = np.all([(p >= 0) & (p <= [WIDTH - 1, HEIGHT - 1]) for p in np.array(ends)], axis=(0, 2))
        if not inside.any():
            assert top - bottom < 1e-3
            continue
        assert bottom == pytest.approx(z[inside][0], abs=1e-3)
        assert top == pytest.approx(z[inside][-1], abs=1e-3)
        short += top < 2.0 or bottom > -0.4
        assert count * dz == pytest.approx(top - bottom)
        for p in (LEFT, RIGHT):
            line = np.array([pixel(p, feet[k] + v * normals[k]) for v in np.linspace(bottom, top, int(count) + 1)])
            assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 1.0 + 1e-9
        start, last = (bottom + lanes[plane + k] * dz for plane in (START, LAST))
        assert min(lanes[HIGH + k] + MARGIN * dz, top) - 1e-9 <= start <= top + 1e-9
        assert last <= 0.05 - MARGIN * dz
    assert short > n // 2


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


def stands(at: Callable[[float], tuple[float, float]], below: float, dz: float, limit: float) -> tuple[float, str]:
    """The root of the step above ``below``, and whether it stands: "yes", "no", or "unclear", too near to a gap or a
    limit for another calculation to tell."""
    inner = np.array([at(z)[0] for z in np.linspace(below, below + dz, 30)])
    if not np.isfinite(inner).all() or (np.diff(np.sign(inner)) != 0).sum() != 1:
        return np.nan, "unclear"
    root = brentq(lambda z: at(z)[0], below, below + dz)
    residual, slope = abs(at(root)[1]), float(np.fmin(at(root + dz)[0], -at(root - dz)[0]))
    if abs(residual - limit) < 0.01 or abs(slope) < 0.01:
        return root, "unclear"
    return root, "yes" if residual < limit and slope > 0.0 else "no"


def test_of_several_changes_the_one_is_taken_that_the_module_names() -> None:
    """Wavy disparities with gaps; the row disparity refuses some of the roots."""
    (feet, normals, lanes), n, rng = cells(LANES, 0.15), LANES, np.random.default_rng(7)
    normals = -normals  # towards the camera
    lanes[NORMAL : NORMAL + 3 * LANES] *= -1.0
    lines(n, LEFT, RIGHT, lanes)
    low, high = (rng.uniform(*ends, n).astype(np.float32) for ends in ((-3.0, -0.8), (-0.8, 0.3)))
    low[::3] = high[::3] - np.float32(0.02)
    lanes[LOW : LOW + n], lanes[HIGH : HIGH + n] = low, high
    clip(n, SIZES, -4.0, 0.4, lanes)
    spans(n, lanes)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    waves = -4.5 + 2.5 * np.sin(1.5 * x + y), 0.5 + 0.7 * np.sin(0.7 * x - 0.4 * y)
    disparity = np.stack(waves, axis=-1).astype(np.float32)
    disparity[rng.random((HEIGHT, WIDTH)) < 0.01] = np.nan
    plain, limit = np.ones((HEIGHT, WIDTH), np.float32), 0.45
    seen = Observed(disparity.ravel(), plain, plain, np.array([limit, np.inf]), np.ones(2))
    out = tuple(np.full((1, n), np.nan, np.float32) for _ in range(4))
    block = BlockCells(feet[None], normals[None], low[None], high[None])
    search(block, (-4.0, 0.4), PairCameras(LEFT, RIGHT, EPIPOLE, SIZES), seen, out)
    met = []
    for k, found in enumerate(out[0][0].astype(float)):
        bottom, dz = lanes[BOTTOM + k], lanes[DZ + k]
        count, start, last = (int(lanes[plane + k]) for plane in (COUNT, START, LAST))
        at = partial(lambda k, z: mismatch(feet[k] + z * normals[k], disparity), k)
        steps = changes(np.array([at(bottom + j * dz)[0] for j in range(count + 1)]), start, last)
        verdicts = [stands(at, bottom + step * dz, dz, limit) for step in steps]
        tried, (root, verdict) = next(((i, v) for i, v in enumerate(verdicts) if v[1] != "no"), (0, (np.nan, "no")))
        met.append((verdict, min(tried, 1)))
        if verdict != "unclear":
            assert found == pytest.approx(root if verdict == "yes" else np.nan, abs=0.02 * dz, nan_ok=True)
    assert min(met.count(case) for case in (("yes", 0), ("yes", 1), ("no", 0))) > 1
    assert sum(verdict == "unclear" for verdict, _ in met) < n // 4
