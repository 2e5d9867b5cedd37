"""An elevation model reduced to blocks of n x n cells: extremes, known cells, noise, and differences of heights.

What looks at places far apart, or at means over a window, does so on blocks: nothing is left out, since a block keeps
its highest and its lowest height and whole sums. Each row of cells is worked on as a line; lines of a row of blocks are
added column by column, then n columns at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]


@dataclass(frozen=True)
class Blocks:
    """Arrays (row, col) of blocks: ``high`` and ``low`` float32 m, NaN where nothing is known; sums float64:

    ``count`` of known cells, ``variance`` of their squared standard deviations (m2), ``pairs`` of cells ``lag`` apart
    along either axis, counted at both ends, and ``deviation`` of their squared differences (m2).
    """

    high: Floats32
    low: Floats32
    count: Floats
    variance: Floats
    pairs: Floats
    deviation: Floats


def reduce_to_blocks(surface: Floats32, closed: Floats32, std: Floats32, n: int, lag: int) -> Blocks:
    """Blocks of a surface (row, col), metres, NaN unknown.

    Parameters
    ----------
    closed : the surface with holes closed; cells are counted, with their standard deviation ``std``, on it.
    n, lag : side of a block, and distance of the cells that are compared, cells.
    """
    shape = tuple(-(-size // n) for size in surface.shape)
    high, low = (np.empty(shape, dtype=np.float32) for _ in range(2))
    sums = np.empty((4, *shape))
    _reduce(surface, closed, std, n, lag, high, low, *sums)
    return Blocks(high, low, *sums)


def sum_around(a: Floats, n: int) -> Floats:
    """Sum (row, col) over the n x n blocks around each, clipped at the border; n odd. Differences of prefix sums."""
    out = np.empty_like(a)
    _sum_around(a, n // 2, out)
    return out


@njit(cache=True, nogil=True)
def _sum_around(a, half, out):  # type: ignore[no-untyped-def]
    rows, cols = a.shape
    down = np.zeros((rows + 1, cols))
    for r in range(rows):
        for c in range(cols):
            down[r + 1, c] = down[r, c] + a[r, c]
    # from before the first column, where nothing is, to as far behind the last one as the window goes
    along = np.zeros(cols + 2 * half + 1)
    inner = along[half + 1 : half + 1 + cols]
    for r in range(rows):
        first, last = down[max(r - half, 0)], down[min(r + half + 1, rows)]
        total = 0.0
        for c in range(cols):
            total += last[c] - first[c]
            inner[c] = total
        along[half + 1 + cols :] = total
        _differences(along[2 * half + 1 :], along, out[r])


@njit(cache=True, nogil=True)
def _differences(p, q, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = p[c] - q[c]


@njit(cache=True, nogil=True)
def _reduce(z, closed, s, n, lag, high, low, count, variance, pairs, deviation):  # type: ignore[no-untyped-def]
    rows, cols = z.shape
    floor = np.float32(-np.inf)
    top, bottom = np.empty(cols, dtype=np.float32), np.empty(cols, dtype=np.float32)
    known, met = np.empty(cols, dtype=np.float32), np.empty(cols, dtype=np.float32)
    noise, apart = np.empty(cols), np.empty(cols)
    nothing, line = np.full(cols, np.nan, dtype=np.float32), np.full(cols + 2 * lag, np.nan, dtype=np.float32)
    for i in range(high.shape[0]):
        for c in range(cols):
            top[c], bottom[c] = floor, -floor
            known[c], met[c], noise[c], apart[c] = 0, 0, 0, 0
        for r in range(i * n, min(i * n + n, rows)):
            line[lag : lag + cols] = z[r]
            _extremes(z[r], top, bottom)
            _noise(closed[r], s[r], known, noise)
            _apart(z[r], line[2 * lag :], line[:cols], apart, met)
            _apart(z[r], z[r - lag] if r >= lag else nothing, z[r + lag] if r + lag < rows else nothing, apart, met)
        for j in range(high.shape[1]):
            a, b = floor, -floor
            total, spread, both, far = 0.0, 0.0, 0.0, 0.0
            for c in range(j * n, min(j * n + n, cols)):
                a, b = max(a, top[c]), min(b, bottom[c])
                total += known[c]
                spread += noise[c]
                both += met[c]
                far += apart[c]
            high[i, j] = a if a > floor else np.nan
            low[i, j] = b if b < -floor else np.nan
            count[i, j], variance[i, j], pairs[i, j], deviation[i, j] = total, spread, both, far


@njit(cache=True, nogil=True)
def _extremes(z, top, bottom):  # type: ignore[no-untyped-def]
    for c in range(z.shape[0]):
        v = z[c]
        top[c] = v if v > top[c] else top[c]  # NaN compares false
        bottom[c] = v if v < bottom[c] else bottom[c]


@njit(cache=True, nogil=True)
def _noise(closed, s, known, noise):  # type: ignore[no-untyped-def]
    for c in range(s.shape[0]):
        here = closed[c] == closed[c]
        known[c] += np.float32(1.0) if here else np.float32(0.0)
        noise[c] += s[c] * s[c] if here else np.float32(0.0)


@njit(cache=True, nogil=True)
def _apart(z, one, other, apart, met):  # type: ignore[no-untyped-def]
    """Adds squared differences from two lines, one after the other, and how many are known."""
    none = np.float32(0.0)
    for c in range(z.shape[0]):
        a, b = z[c] - one[c], z[c] - other[c]
        here, there = a == a, b == b
        a, b = a * a if here else none, b * b if there else none
        apart[c] = (apart[c] + a) + b
        met[c] += (np.float32(1.0) if here else none) + (np.float32(1.0) if there else none)
