"""Small holes of an elevation model: closed by interpolation between their rims, never across more than stated."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.numeric.windows import window_count

LEAST_TRIALS = 8
"""Known cells nearby that must tell the error of an interpolation; with fewer, half the range of its rim stands in."""


def close_holes(
    elevation: Floats32,
    elevation_std: Floats32,
    max_gap: float,
    n: int,
    min_known: float,
    *,
    judged: bool = False,
) -> tuple[Floats32, Floats32, Bytes]:
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

    Returns
    -------
    Closed elevation, its standard deviation (not below the largest of the rim's; unless ``judged``, not below half of
    its range either), and flags (uint8, 1 = closed here).
    """
    z, s = elevation.copy(), elevation_std.copy()
    return z, s, close_into((z, s), elevation, max_gap, n, min_known, judged=judged)


def close_into(
    closed: tuple[Floats32, Floats32],
    elevation: Floats32,
    max_gap: float,
    n: int,
    min_known: float,
    *,
    judged: bool = False,
    rim: float = 0.5,
) -> Bytes:
    """Interpolate in place: in ``closed``, copies of the elevation and its standard deviation; return the flags.

    ``rim``: share of the rim's range that is the standard deviation where it is not judged; 0.5 holds all of it.
    """
    z, s = closed
    filled = np.zeros(elevation.shape, dtype=np.uint8)
    cells = candidates(elevation, n, min_known)
    if len(cells) and max_gap > 0:
        known = np.ascontiguousarray(elevation), np.ascontiguousarray(s)
        _close(known, cells, (STEPS, *_rays(max_gap)), (n // 2 if judged else 0, rim), (z, s, filled))
    return filled


def candidates(elevation: Floats32, n: int, min_known: float) -> NDArray[np.int64]:
    """Unknown cells, counted row by row, of whose n x n window at least ``min_known`` is known."""
    unknown = np.isnan(elevation)
    if not unknown.any():
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero(unknown & (window_count(~unknown, n) >= min_known * n * n))


STEPS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])
"""Rows and columns from a cell to the next one of its row, its column and its two diagonals."""


def _rays(max_gap: float) -> tuple[NDArray[np.int64], Floats]:
    """Cells that a gap may span along each of :data:`STEPS`, and the inverse distance to the k-th cell of each."""
    # A step along a diagonal is longer: the gap is limited in distance, not in cells.
    units = np.sqrt((STEPS * STEPS).sum(axis=1).astype(np.float64))
    with np.errstate(divide="ignore"):
        inverse = 1.0 / (units[:, None] * np.arange(int(max_gap + 1e-9) + 2))
    return (max_gap / units + 1e-9).astype(np.int64), inverse


@njit(cache=True, nogil=True)
def _close(known, cells, rays, trial, closed):  # type: ignore[no-untyped-def]
    z_in, s_in = known
    steps, reaches, inverse = rays
    window, rim = trial
    z, s, filled = closed
    rows, cols = z_in.shape
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
            # No cell that is interpolated is more certain than the least certain that it comes from.
            s[r, c] = max(worst, rim * (high - low))
            filled[r, c] = 1
            if window > 0:
                # Only heights that were known before: a closed hole proves nothing about interpolation.
                missed = _missed(z_in, r, c, window, lines[:used], weights[:used], weight)
                s[r, c] = max(worst, rim * (high - low) if math.isnan(missed) else missed)


@njit(cache=True, nogil=True)
def _missed(z, r, c, window, lines, weights, weight):  # type: ignore[no-untyped-def]
    """RMS by which the lines of a cell miss the known cells around it; NaN where too few of them tell."""
    rows, cols = z.shape
    square = 0.0
    trials = 0
    for p in range(max(r - window, 0), min(r + window + 1, rows)):
        for q in range(max(c - window, 0), min(c + window + 1, cols)):
            if math.isnan(z[p, q]):
                continue
            total = 0.0
            for k in range(lines.shape[0]):
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
