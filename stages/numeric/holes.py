"""Close small holes of an elevation model by interpolation between their rims, up to a largest gap."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats32
from rille.stages.core.kernel import kernel
from rille.stages.numeric.windows import window_count

RIM_STD_SHARE = 1.0 / math.sqrt(12.0)
"""Standard deviation of a height that lies anywhere within a range, over that range."""
RAY_STEPS = np.array([[0, 1], [1, 0], [1, 1], [1, -1]])
"""Rows and columns from a cell to the next one of its row, its column and its two diagonals."""


def close_holes(
    elevation: Floats32, elevation_std: Floats32, max_gap: float, n: int, min_known: float
) -> tuple[Floats32, Floats32, Bytes]:
    """Interpolate unknown cells that lie between known ones.

    A cell is closed if known cells face each other across it, along a row, a column or a diagonal, with at most
    ``max_gap`` of unknown ground between them, and if at least ``min_known`` of the window around it is known. Along
    each such line the height is interpolated linearly (a plane is restored exactly); lines are weighted by the inverse
    distances to their ends. The result lies within the range of the rim cells.

    Parameters
    ----------
    elevation, elevation_std : (row, col) float32, metres, NaN unknown.
    max_gap : widest gap, cells.
    n, min_known : side of the window, cells, odd, and the share of its n x n cells that must be known.

    Returns
    -------
    Closed elevation, its standard deviation (not below the largest of the rim's, nor below that of a height anywhere
    in the rim's range), and flags (uint8, 1 = closed here).
    """
    z, std, filled = elevation.copy(), elevation_std.copy(), np.zeros(elevation.shape, np.uint8)
    cells = candidates(elevation, n, min_known)
    if len(cells) and max_gap > 0:
        _close(np.ascontiguousarray(elevation), cells, max_gap, z, std, filled)
    return z, std, filled


def candidates(elevation: Floats32, n: int, min_known: float) -> NDArray[np.int64]:
    """Unknown cells, as flat indices, with at least ``min_known`` of their n x n window known."""
    unknown = np.isnan(elevation)
    if not unknown.any():
        return np.empty(0, dtype=np.int64)
    return np.flatnonzero(unknown & (window_count(~unknown, n) >= min_known * n * n))


@kernel
def _close(z, cells, max_gap, out, std, filled):  # type: ignore[no-untyped-def]
    """Close the ``cells`` that lie between known ones of ``z``."""
    cols = z.shape[1]
    for at in cells:
        r, c = at // cols, at % cols
        total = weight = worst = 0.0
        low, high = np.inf, -np.inf
        for k in range(4):
            dr, dc = RAY_STEPS[k, 0], RAY_STEPS[k, 1]
            # A step along a diagonal is longer: the gap is limited in distance, not in cells.
            unit = math.sqrt(dr * dr + dc * dc)
            reach = int(max_gap / unit + 1e-9)
            a = _to_known(z, (r, c), (-dr, -dc), reach)
            # a + b - 1 cells of the line are unknown
            b = _to_known(z, (r, c), (dr, dc), reach - a + 1) if a else 0
            if not b:
                continue
            p, q = (r - a * dr, c - a * dc), (r + b * dr, c + b * dc)
            near, far = 1.0 / (unit * a), 1.0 / (unit * b)
            total += near * z[p] + far * z[q]
            weight += near + far
            worst = max(worst, std[p], std[q])
            low, high = min(low, z[p], z[q]), max(high, z[p], z[q])
        if weight > 0.0:
            out[r, c], filled[r, c] = total / weight, 1
            # An interpolated cell is not more certain than the least certain one that it comes from.
            std[r, c] = max(worst, RIM_STD_SHARE * (high - low))


@kernel
def _to_known(z, cell, step, reach):  # type: ignore[no-untyped-def]
    """Number of steps from a cell to the next known one, at most ``reach``; 0: there is none."""
    rows, cols = z.shape
    for k in range(1, reach + 1):
        r, c = cell[0] + k * step[0], cell[1] + k * step[1]
        if r < 0 or r >= rows or c < 0 or c >= cols:
            return 0
        if not math.isnan(z[r, c]):
            return k
    return 0
