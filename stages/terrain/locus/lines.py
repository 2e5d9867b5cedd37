"""Lines of cells, and the steps in which :mod:`rille.stages.terrain.locus.kernel` searches them, for many cells at
once."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rille.stages.terrain.locus.points import LANES, LEFT_A, LEFT_B, NEAR, RIGHT_A, RIGHT_B, line_of

STEP_PX = 1.0  # search step: disparity is bilinear between pixels, so nothing hides in a shorter one
MARGIN = 2  # steps that the interval handed down from the coarse level is widened by
MAX_STEPS = 4096.0  # of one locus: more than the diagonal of a 12 megapixel image

FOOT, NORMAL, LOW, HIGH = (k * LANES for k in (13, 16, 19, 20))
BOTTOM, TOP, DZ, COUNT, START, LAST = (k * LANES for k in range(21, 27))
"""Planes of a buffer of lanes beside the lines: foot (3) and normal (3) of each cell, the interval that the search
starts in; the part of the line that both images see, a step, how many there are, first and last one searched."""
PLANES = 27


@njit(cache=True, nogil=True, error_model="numpy")
def lines(n, left, right, lanes):  # type: ignore[no-untyped-def]
    """Projections of the lines of ``n`` cells by the (3, 4) projections of both images."""
    for side in range(2):
        p = right if side else left
        for k in range(3):
            p0, p1, p2, p3 = p[k, 0], p[k, 1], p[k, 2], p[k, 3]
            a, b = (RIGHT_A if side else LEFT_A) + k * LANES, (RIGHT_B if side else LEFT_B) + k * LANES
            for m in range(n):
                x, y, z = lanes[FOOT + m], lanes[FOOT + LANES + m], lanes[FOOT + 2 * LANES + m]
                lanes[a + m] = p3 + p0 * x + p1 * y + p2 * z
                x, y, z = lanes[NORMAL + m], lanes[NORMAL + LANES + m], lanes[NORMAL + 2 * LANES + m]
                lanes[b + m] = p0 * x + p1 * y + p2 * z


@njit(cache=True, nogil=True, error_model="numpy")
def clip(n, sizes, z_min, z_max, lanes):  # type: ignore[no-untyped-def]
    """The part of z_min..z_max where each line projects into both images; empty (bottom > top) where there is none."""
    wl, hl, wr, hr = sizes[0] - 1.0, sizes[1] - 1.0, sizes[2] - 1.0, sizes[3] - 1.0
    for m in range(n):
        low, high = _inside(line_of(lanes, LEFT_A, LEFT_B, m), wl, hl, z_min, z_max)
        lanes[BOTTOM + m], lanes[TOP + m] = _inside(line_of(lanes, RIGHT_A, RIGHT_B, m), wr, hr, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(line, w, h, low, high):  # type: ignore[no-untyped-def]
    """The part of low..high where 0 <= x <= w, 0 <= y <= h in front of the camera: x = X / W with W > 0 is X >= 0."""
    low, high = _bound(line.a0, line.b0, low, high)
    low, high = _bound(w * line.a2 - line.a0, w * line.b2 - line.b0, low, high)
    low, high = _bound(line.a1, line.b1, low, high)
    low, high = _bound(h * line.a2 - line.a1, h * line.b2 - line.b1, low, high)
    return _bound(line.a2 - NEAR, line.b2, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _bound(p, q, low, high):  # type: ignore[no-untyped-def]
    """The part of low..high where p + z q >= 0."""
    z = -p / q
    from_below, from_above = (q > 0.0) & (z > low), (q < 0.0) & (z < high)
    nowhere = (q == 0.0) & (p < 0.0)
    return z if from_below else low, z if from_above else (-np.inf if nowhere else high)


@njit(cache=True, nogil=True, error_model="numpy")
def spans(n, lanes):  # type: ignore[no-untyped-def]
    """Divide the lines into steps of a pixel at most where they are seen fastest."""
    for m in range(n):
        bottom, top = lanes[BOTTOM + m], lanes[TOP + m]
        # d p / d Z = (a_2 b - b_2 a) / w^2 with w linear in Z: the speed is greatest at one of the ends.
        left, right = line_of(lanes, LEFT_A, LEFT_B, m), line_of(lanes, RIGHT_A, RIGHT_B, m)
        fastest = max(_speed(left, bottom), _speed(left, top))
        fastest = max(fastest, _speed(right, bottom), _speed(right, top))
        count = max(1.0, min(np.ceil(fastest * (top - bottom) / STEP_PX), MAX_STEPS))
        dz = (top - bottom) / count
        lanes[DZ + m], lanes[COUNT + m] = dz, count
        lanes[START + m] = max(0.0, min(count, np.ceil((lanes[HIGH + m] - bottom) / dz) + MARGIN))
        lanes[LAST + m] = np.floor((lanes[LOW + m] - bottom) / dz) - MARGIN


@njit(cache=True, nogil=True, error_model="numpy")
def _speed(line, z):  # type: ignore[no-untyped-def]
    """Image speed |d p / d Z|, pixels per metre: with p = (a + Z b) / w it is |b - p b_2| / w."""
    w = max(line.a2 + z * line.b2, NEAR)
    x, y = (line.a0 + z * line.b0) / w, (line.a1 + z * line.b1) / w
    dx, dy = (line.b0 - x * line.b2) / w, (line.b1 - y * line.b2) / w
    return math.sqrt(dx * dx + dy * dy)
