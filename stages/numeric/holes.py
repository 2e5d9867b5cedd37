"""Small holes of an elevation model: closed by interpolation between their rims, never across more than stated."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.numeric.windows import window_count

MIN_TRIALS = 8
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
    maps = _Maps(*closed, np.zeros(elevation.shape, dtype=np.uint8))
    cells = candidates(elevation, n, min_known)
    if len(cells) and max_gap > 0:
        _close(np.ascontiguousarray(elevation), cells, _rays(max_gap), _Trial(n // 2 if judged else 0, rim), maps)
    return maps.filled


def candidates(elevation: Floats32, n: int, min_known: float) -> NDArray[np.int64]:
    """Unknown cells, counted row by row, of whose n x n window at least ``min_known`` is known."""
    unknown = np.isnan(elevation)
    if not unknown.any():
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero(unknown & (window_count(~unknown, n) >= min_known * n * n))


RAY_STEPS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])
"""Rows and columns from a cell to the next one of its row, its column and its two diagonals."""


class _Rays(NamedTuple):
    """``steps`` as :data:`RAY_STEPS`; along each of them, the cells ``reach`` that a gap may span, and the ``inverse``
    distance to the k-th cell (4, k)."""

    steps: NDArray[np.int64]
    reach: NDArray[np.int64]
    inverse: Floats


class _Trial(NamedTuple):
    """``window``: cells to either side within which known cells tell the error of a cell's lines, 0: none; ``rim``:
    share of the rim's range that stands for it where they do not."""

    window: int
    rim: float


class _Maps(NamedTuple):
    """Maps (row, col) to be closed: elevation and its standard deviation, m, and flags of closed cells."""

    elevation: Floats32
    std: Floats32
    filled: Bytes


def _rays(max_gap: float) -> _Rays:
    # A step along a diagonal is longer: the gap is limited in distance, not in cells.
    units = np.sqrt((RAY_STEPS * RAY_STEPS).sum(axis=1).astype(np.float64))
    with np.errstate(divide="ignore"):
        inverse = 1.0 / (units[:, None] * np.arange(int(max_gap + 1e-9) + 2))
    return _Rays(RAY_STEPS, (max_gap / units + 1e-9).astype(np.int64), inverse)


@njit(cache=True, nogil=True)
def _close(z, cells, rays, trial, maps):  # type: ignore[no-untyped-def]
    """Close the ``cells`` that lie between known ones of ``z``."""
    cols = z.shape[1]
    lines, weights = np.empty((4, 4), dtype=np.int64), np.empty((4, 2))
    for at in cells:
        r, c = at // cols, at % cols
        total = weight = worst = 0.0
        low, high = np.inf, -np.inf
        used = 0
        for k in range(4):
            dr, dc, reach = rays.steps[k, 0], rays.steps[k, 1], rays.reach[k]
            a = _to_known(z, (r, c), (-dr, -dc), reach)
            # a + b - 1 cells of the line are unknown
            b = _to_known(z, (r, c), (dr, dc), reach - a + 1) if a else 0
            if not b:
                continue
            p, q = (r - a * dr, c - a * dc), (r + b * dr, c + b * dc)
            lines[used, 0], lines[used, 1], lines[used, 2], lines[used, 3] = dr, dc, a, b
            weights[used, 0], weights[used, 1] = rays.inverse[k, a], rays.inverse[k, b]
            total += weights[used, 0] * z[p] + weights[used, 1] * z[q]
            weight += weights[used, 0] + weights[used, 1]
            worst = max(worst, maps.std[p], maps.std[q])
            low, high = min(low, z[p], z[q]), max(high, z[p], z[q])
            used += 1
        if used:
            missed = math.nan
            if trial.window > 0:
                # Only heights that were known before: a closed hole proves nothing about interpolation.
                missed = _missed(z, (r, c), trial.window, lines[:used], weights[:used])
            maps.elevation[r, c], maps.filled[r, c] = total / weight, 1
            # No cell that is interpolated is more certain than the least certain that it comes from.
            maps.std[r, c] = max(worst, trial.rim * (high - low) if math.isnan(missed) else missed)


@njit(cache=True, nogil=True)
def _to_known(z, cell, step, reach):  # type: ignore[no-untyped-def]
    """Number of steps from a cell to the next known one, ``reach`` at most; 0: there is none."""
    rows, cols = z.shape
    for k in range(1, reach + 1):
        r, c = cell[0] + k * step[0], cell[1] + k * step[1]
        if r < 0 or r >= rows or c < 0 or c >= cols:
            return 0
        if not math.isnan(z[r, c]):
            return k
    return 0


@njit(cache=True, nogil=True)
def _missed(z, cell, window, lines, weights):  # type: ignore[no-untyped-def]
    """RMS by which the lines of a cell miss the known cells around it; NaN where too few of them tell."""
    (rows, cols), (r, c), weight = z.shape, cell, weights.sum()
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
    return math.sqrt(square / trials) if trials >= MIN_TRIALS else math.nan
