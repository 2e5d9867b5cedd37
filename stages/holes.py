"""Small holes of an elevation model: closed by interpolation between their rims, never across more than stated."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.windows import window_sum

Floats32 = NDArray[np.float32]
Flags = NDArray[np.uint8]


def close_holes(
    elevation: Floats32, elevation_std: Floats32, max_gap: float, n: int, min_known: float
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

    Returns
    -------
    Closed elevation, its standard deviation (the larger one of the rim's), and flags (uint8, 1 = closed here).
    """
    known = ~np.isnan(elevation)
    candidate = ~known & (window_sum(known, n) >= min_known * n * n)
    z, s = elevation.copy(), elevation_std.copy()
    filled = np.zeros(elevation.shape, dtype=np.uint8)
    cells = np.argwhere(candidate)
    if len(cells) and max_gap > 0:
        _close(elevation, elevation_std, cells, float(max_gap), z, s, filled)
    return z, s, filled


@njit(cache=True, nogil=True)
def _close(z_in, s_in, cells, max_gap, z, s, filled):  # type: ignore[no-untyped-def]
    rows, cols = z_in.shape
    steps = ((0, 1), (1, 0), (1, 1), (1, -1))
    for i in range(cells.shape[0]):
        r, c = cells[i, 0], cells[i, 1]
        total = 0.0
        weight = 0.0
        worst = 0.0
        for dr, dc in steps:
            unit = math.sqrt(float(dr * dr + dc * dc))
            reach = int(max_gap / unit + 1e-9)
            a = 1
            while a <= reach:
                ra, ca = r - a * dr, c - a * dc
                if ra < 0 or ca < 0 or ca >= cols or not math.isnan(z_in[ra, ca]):
                    break
                a += 1
            ra, ca = r - a * dr, c - a * dc
            if a > reach or ra < 0 or ca < 0 or ca >= cols:
                continue
            # a + b - 1 cells of the line are unknown
            b = 1
            while a + b - 1 <= reach:
                rb, cb = r + b * dr, c + b * dc
                if rb >= rows or cb < 0 or cb >= cols or not math.isnan(z_in[rb, cb]):
                    break
                b += 1
            rb, cb = r + b * dr, c + b * dc
            if a + b - 1 > reach or rb >= rows or cb < 0 or cb >= cols:
                continue
            wa, wb = 1.0 / (a * unit), 1.0 / (b * unit)
            total += wa * z_in[ra, ca] + wb * z_in[rb, cb]
            weight += wa + wb
            worst = max(worst, s_in[ra, ca], s_in[rb, cb])
        if weight > 0.0:
            z[r, c] = total / weight
            s[r, c] = worst
            filled[r, c] = 1
