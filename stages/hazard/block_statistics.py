"""An elevation model reduced to blocks of n x n cells: extremes, known cells, noise, and differences of heights.

Measures of places far apart, or of means over a window, are computed on blocks. No cell is left out, since a block
keeps its highest and its lowest height and whole sums.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32


class Blocks(NamedTuple):
    """Arrays (row, col) of blocks: ``high`` and ``low`` float32 m, NaN where nothing is known; sums float64:

    ``known``: number of known cells, ``variance``: their squared standard deviations (m2), ``pairs``: cells ``lag``
    apart along either axis, counted at both ends, and ``deviation``: their squared differences (m2).
    """

    high: Floats32
    low: Floats32
    known: Floats
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
    # Rounded up: the last block of a row or column may be partial, and counts the cells that it has.
    shape = tuple(-(-size // n) for size in surface.shape)
    blocks = Blocks(*(np.full(shape, np.nan, np.float32) for _ in range(2)), *(np.zeros(shape) for _ in range(4)))
    _reduce_heights(surface, closed, std, n, blocks)
    _reduce_differences(np.pad(surface, lag, constant_values=np.nan), n, lag, blocks.pairs, blocks.deviation)
    return blocks


@njit(cache=True, nogil=True)
def _reduce_heights(surface, closed, std, n, blocks):  # type: ignore[no-untyped-def]
    """Fill the extremes, the counts and the variances."""
    rows, cols = surface.shape
    for r in range(rows):
        for j in range(blocks.high.shape[1]):
            high, low = blocks.high[r // n, j], blocks.low[r // n, j]
            count, variance = 0, np.float32(0.0)
            for c in range(j * n, min(j * n + n, cols)):
                z = surface[r, c]
                # NaN compares false, so the first known height replaces it.
                high = high if high >= z or math.isnan(z) else z
                low = low if low <= z or math.isnan(z) else z
                if not math.isnan(closed[r, c]):
                    count += 1
                    variance += std[r, c] * std[r, c]
            blocks.high[r // n, j], blocks.low[r // n, j] = high, low
            blocks.known[r // n, j] += count
            blocks.variance[r // n, j] += variance


@njit(cache=True, nogil=True)
def _reduce_differences(padded, n, lag, pairs, deviation):  # type: ignore[no-untyped-def]
    """Add the squared differences of cells ``lag`` apart; ``padded`` is the surface with a border of ``lag`` NaN."""
    rows, cols = padded.shape[0] - 2 * lag, padded.shape[1] - 2 * lag
    none = np.float32(0.0)
    for r in range(rows):
        here, above, below = padded[r + lag], padded[r], padded[r + 2 * lag]
        for j in range(pairs.shape[1]):
            count, total = 0, none
            for c in range(j * n, min(j * n + n, cols)):
                z = here[c + lag]
                for other in (above[c + lag], below[c + lag], here[c], here[c + 2 * lag]):
                    d = z - other
                    known = d == d  # NaN is unequal to itself
                    count += known
                    total += d * d if known else none
            pairs[r // n, j] += count
            deviation[r // n, j] += total
