"""Small holes of an elevation model: closed by interpolation between their rims, never across more than stated."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]
Flags = NDArray[np.uint8]

LEAST_TRIALS = 8
"""Known cells nearby that must tell the error of an interpolation; with fewer, half the range of its rim stands in."""

PART = 64
"""Cells of a row that are passed over together where all are known."""


def close_holes(
    elevation: Floats32,
    elevation_std: Floats32,
    max_gap: float,
    n: int,
    min_known: float,
    *,
    judged: bool = False,
    rim: float = 0.5,
) -> tuple[Floats32, Floats32, Flags]:
    """Interpolate unknown cells that lie between known ones.

    A cell is closed when known cells face each other across it, along a row, a column or a diagonal, with at most
    ``max_gap`` of unknown ground between them, and at least ``min_known`` of the window around it is known. Along
    each such line the height is interpolated linearly (a plane is restored exactly); lines weigh by the inverse
    distances to their ends. The result is never outside the range of the rim cells used.

    Parameters
    ----------
    elevation, elevation_std : (row, col) float32, metres, NaN unknown.
    max_gap : widest gap, cells.
    n, min_known : side of the window, cells, odd, and the share of its n x n cells that must be known.
    judged : whether the standard deviation has the error of the interpolation too. It is found where the answer is
        known: the same lines, laid through known cells of the window, tell by how much they miss them.
    rim : share of the rim's range that is the standard deviation where it is not judged; 0.5 holds all of it.

    Returns
    -------
    Closed elevation, its standard deviation (not below the largest of the rim's; unless ``judged``, not below ``rim``
    of its range either), and flags (uint8, 1 = closed here).
    """
    z, s = elevation.copy(), elevation_std.copy()
    return z, s, close_into(z, s, elevation, max_gap, n, min_known, judged=judged, rim=rim)


def close_into(
    z: Floats32,
    s: Floats32,
    elevation: Floats32,
    max_gap: float,
    n: int,
    min_known: float,
    *,
    judged: bool = False,
    rim: float = 0.5,
) -> Flags:
    """The same in ``z`` and ``s``, copies of the elevation and of its standard deviation; returns the flags."""
    filled = np.zeros(elevation.shape, dtype=np.uint8)
    cells = candidates(elevation, n, min_known)
    if len(cells) and max_gap > 0:
        _close(
            np.ascontiguousarray(elevation),
            np.ascontiguousarray(s),
            cells,
            float(max_gap),
            n // 2 if judged else 0,
            rim,
            z,
            s,
            filled,
        )
    return filled


def candidates(elevation: Floats32, n: int, min_known: float) -> NDArray[np.int64]:
    """Unknown cells, counted row by row, of whose n x n window at least ``min_known`` is known."""
    return np.asarray(_candidates(np.ascontiguousarray(elevation), n // 2, min_known * n * n), dtype=np.int64)


@njit(cache=True, nogil=True)
def _candidates(z, half, least):  # type: ignore[no-untyped-def]
    """Columns' counts move down with the window; along a row they are added up only where a cell is unknown."""
    rows, cols = z.shape
    n = 2 * half + 1
    line = np.zeros(cols + n, dtype=np.int32)  # behind the line's start and beyond its end there is nothing
    total = line[half + 1 : half + 1 + cols]
    upto, nothing = np.zeros(cols + n, dtype=np.int32), np.full(cols, np.nan, dtype=z.dtype)
    out, m = np.empty(cols, dtype=np.int64), 0
    for r in range(-half, rows):
        _tally(z[r + half] if r + half < rows else nothing, z[r - half - 1] if r > half else nothing, total)
        if r < 0 or not _any_unknown(z, r, 0, cols):
            continue
        if m + cols > out.shape[0]:
            more = np.empty(2 * out.shape[0] + cols, dtype=np.int64)
            more[:m] = out[:m]
            out = more
        for c in range(1, cols + n):
            upto[c] = upto[c - 1] + line[c]
        for first in range(0, cols, PART):
            end = min(first + PART, cols)
            if _any_unknown(z, r, first, end):
                for c in range(first, end):
                    if z[r, c] != z[r, c] and upto[c + n] - upto[c] >= least:
                        out[m] = r * cols + c
                        m += 1
    return out[:m]


@njit(cache=True, nogil=True)
def _tally(enters, leaves, total):  # type: ignore[no-untyped-def]
    for c in range(total.shape[0]):
        total[c] += np.int32(enters[c] == enters[c]) - np.int32(leaves[c] == leaves[c])


@njit(cache=True, nogil=True)
def _any_unknown(z, r, first, end):  # type: ignore[no-untyped-def]
    row, left, unknown = np.uint64(r), np.uint64(first), np.uint8(0)
    for c in range(np.uint64(end - first)):
        unknown |= np.uint8(z[row, left + c] != z[row, left + c])
    return unknown > 0


@njit(cache=True, nogil=True)
def _close(z_in, s_in, cells, max_gap, window, rim, z, s, filled):  # type: ignore[no-untyped-def]
    rows, cols = z_in.shape
    steps = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])
    units = np.sqrt((steps * steps).sum(axis=1).astype(np.float64))
    reaches = (max_gap / units + 1e-9).astype(np.int64)
    inverse = 1.0 / (units.reshape(4, 1) * np.arange(int(max_gap + 1e-9) + 2))
    lines = np.empty((4, 4), dtype=np.int64)
    weights = np.empty((4, 2))
    heights, noise = z_in.reshape(-1), s_in.reshape(-1)
    for at in cells:
        r, c = at // cols, at % cols
        total = 0.0
        weight = 0.0
        worst = 0.0
        low, high = np.inf, -np.inf
        used = 0
        for k in range(4):
            dr, dc, reach = steps[k, 0], steps[k, 1], reaches[k]
            step = dr * cols + dc
            # of either side the cells inside the map
            behind, ahead = (r, rows - 1 - r) if dr else (cols, cols)
            if dc > 0:
                behind, ahead = min(behind, c), min(ahead, cols - 1 - c)
            elif dc < 0:
                behind, ahead = min(behind, cols - 1 - c), min(ahead, c)
            most, a = min(reach, behind), 1
            while a <= most and math.isnan(heights[at - a * step]):
                a += 1
            if a > most:
                continue
            # a + b - 1 cells of the line are unknown
            most, b = min(reach - a + 1, ahead), 1
            while b <= most and math.isnan(heights[at + b * step]):
                b += 1
            if b > most:
                continue
            p, q = at - a * step, at + b * step
            wa, wb = inverse[k, a], inverse[k, b]
            total += wa * heights[p] + wb * heights[q]
            weight += wa + wb
            worst = max(worst, noise[p], noise[q])
            low, high = min(low, heights[p], heights[q]), max(high, heights[p], heights[q])
            lines[used, 0], lines[used, 1], lines[used, 2], lines[used, 3] = dr, dc, a, b
            weights[used, 0], weights[used, 1] = wa, wb
            used += 1
        if weight > 0.0:
            z[r, c] = total / weight
            s[r, c] = max(worst, rim * (high - low))
            filled[r, c] = 1
            if window > 0:
                missed = _missed(z_in, r, c, window, lines, weights, used, weight)
                s[r, c] = max(worst, rim * (high - low) if math.isnan(missed) else missed)


@njit(cache=True, nogil=True)
def _missed(z, r, c, window, lines, weights, used, weight):  # type: ignore[no-untyped-def]
    """RMS by which the lines of a cell miss the known cells around it; NaN where too few of them tell."""
    rows, cols = z.shape
    square = 0.0
    trials = 0
    for p in range(max(r - window, 0), min(r + window + 1, rows)):
        for q in range(max(c - window, 0), min(c + window + 1, cols)):
            if math.isnan(z[p, q]):
                continue
            total = 0.0
            for k in range(used):
                dr, dc, a, b = lines[k, 0], lines[k, 1], lines[k, 2], lines[k, 3]
                pa, qa, pb, qb = p - a * dr, q - a * dc, p + b * dr, q + b * dc
                if min(pa, qa, qb) < 0 or max(qa, qb) >= cols or pb >= rows:
                    total = math.nan
                    break
                total += weights[k, 0] * z[pa, qa] + weights[k, 1] * z[pb, qb]
            if not math.isnan(total):
                square += (total / weight - z[p, q]) ** 2
                trials += 1
    return math.sqrt(square / trials) if trials >= LEAST_TRIALS else math.nan
