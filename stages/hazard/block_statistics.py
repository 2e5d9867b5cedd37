"""An elevation model reduced to blocks of n x n cells: extremes, known cells, noise, and differences of heights.

What looks at places far apart, or at means over a window, does so on blocks: nothing is left out, since a block keeps
its highest and its lowest height and whole sums. Each row of cells is worked on as a line; lines of a row of blocks are
added column by column, then n columns at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.numeric.line import copy_line

STRIP = 512
"""Columns of cells that are worked on at a time, at most."""


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
    # Rounded up: the last block of a row or column may be partial, and counts what it has.
    shape = tuple(-(-size // n) for size in surface.shape)
    high, low = (np.empty(shape, dtype=np.float32) for _ in range(2))
    sums = np.empty((4, *shape))
    _reduce(surface, closed, std, n, lag, (high, low, *sums))
    return Blocks(high, low, *sums)


@njit(cache=True, nogil=True)
def _reduce(z, closed, s, n, lag, out):  # type: ignore[no-untyped-def]
    """Fill ``out``, the arrays of :class:`Blocks`: each row of blocks by strips of whole blocks, whose lines stay in
    the innermost cache."""
    high, low, count, variance, pairs, deviation = out
    rows, cols = z.shape
    width = n * max(1, STRIP // n)
    top, bottom = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    known, met = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    noise, apart = np.empty(width), np.empty(width)
    nothing, line = np.full(cols, np.nan, dtype=np.float32), np.empty(width + 2 * lag, dtype=np.float32)
    for i in range(high.shape[0]):
        for left in range(0, cols, width):
            right = min(left + width, cols)
            size, strip = right - left, slice(left, right)
            blocks = slice(left // n, left // n - (-size // n))
            top[:], bottom[:], known[:], met[:], noise[:], apart[:] = -np.inf, np.inf, 0, 0, 0, 0
            for r in range(i * n, min(i * n + n, rows)):
                above, below = z[r - lag] if r >= lag else nothing, z[r + lag] if r + lag < rows else nothing
                _surround(z[r], left - lag, line[: size + 2 * lag])
                _extremes(z[r, strip], top, bottom)
                _noise(closed[r, strip], s[r, strip], known, noise)
                _apart(z[r, strip], line[2 * lag :], line, apart, met)
                _apart(z[r, strip], above[strip], below[strip], apart, met)
            _highest(top[:size], n, np.float32(1.0), high[i, blocks])
            _highest(bottom[:size], n, np.float32(-1.0), low[i, blocks])
            _total(known[:size], n, count[i, blocks])
            _total(noise[:size], n, variance[i, blocks])
            _total(met[:size], n, pairs[i, blocks])
            _total(apart[:size], n, deviation[i, blocks])


@njit(cache=True, nogil=True)
def _surround(line, left, out):  # type: ignore[no-untyped-def]
    """The line from column ``left`` on, NaN beyond its ends."""
    first, end = max(left, 0), min(left + out.shape[0], line.shape[0])
    out[: first - left] = np.nan
    copy_line(line[first:end], out[first - left : end - left])
    out[end - left :] = np.nan


@njit(cache=True, nogil=True)
def _highest(line, n, sign, out):  # type: ignore[no-untyped-def]
    """Of each n columns the highest value, or the lowest with a negative sign; NaN where it is not finite."""
    whole, first = line.shape[0] // n, 0
    if n == 4:  # of a known number the compiler takes several blocks at once
        for j in range(whole):
            a, b, d, e = sign * line[4 * j], sign * line[4 * j + 1], sign * line[4 * j + 2], sign * line[4 * j + 3]
            a, d = a if a > b else b, d if d > e else e
            a = a if a > d else d
            out[j] = sign * a if a > np.float32(-np.inf) else np.float32(np.nan)
        first = whole
    for j in range(first, out.shape[0]):
        a = np.float32(-np.inf)
        for c in range(j * n, min(j * n + n, line.shape[0])):
            a = max(a, sign * line[c])
        out[j] = sign * a if a > np.float32(-np.inf) else np.float32(np.nan)


@njit(cache=True, nogil=True)
def _total(line, n, out):  # type: ignore[no-untyped-def]
    """Sum of each n columns, one after the other, in 64 bits."""
    whole, first = line.shape[0] // n, 0
    if n == 4:
        for j in range(whole):
            # The additions of the loop below in its order, so that both give the same bits.
            a, b = np.float64(line[4 * j]), np.float64(line[4 * j + 1])
            out[j] = ((a + b) + np.float64(line[4 * j + 2])) + np.float64(line[4 * j + 3])
        first = whole
    for j in range(first, out.shape[0]):
        total = 0.0
        for c in range(j * n, min(j * n + n, line.shape[0])):
            total += line[c]
        out[j] = total


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
        # A choice instead of a branch, here and below, so that cells go side by side.
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
