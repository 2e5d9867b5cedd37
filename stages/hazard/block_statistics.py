"""An elevation model reduced to blocks of n x n cells: extremes, known cells, noise, and differences of heights.

Measures that compare distant cells, or take means over a window, are computed on blocks. No cell is left out, since a
block keeps its highest and its lowest height and whole sums.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32


class Blocks(NamedTuple):
    """Arrays (row, col) of blocks: ``high`` and ``low`` float32 m, NaN where no cell is known; sums float64:

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
    closed : the surface with holes closed, whose cells are counted, with their standard deviation ``std``.
    n, lag : side of a block, and distance of the compared cells, cells.
    """
    high, low = (reduce(extreme, _of_blocks(surface, n, np.nan)) for extreme in (np.fmax, np.fmin))
    known = ~np.isnan(closed)
    variance = np.where(known, std * std, np.float32(0.0))
    pairs, deviation = np.zeros(surface.shape, np.uint8), np.zeros(surface.shape, np.float32)
    for ahead, behind in ((np.s_[lag:], np.s_[:-lag]), (np.s_[:, lag:], np.s_[:, :-lag])):
        apart = surface[ahead] - surface[behind]
        both = ~np.isnan(apart)
        square = np.where(both, apart * apart, np.float32(0.0))
        for end in (ahead, behind):
            pairs[end] += both
            deviation[end] += square
    sums = (reduce(np.add, _of_blocks(a, n, 0), np.zeros(high.shape)) for a in (known, variance, pairs, deviation))
    return Blocks(high, low, *sums)


def _of_blocks(a: NDArray[Any], n: int, fill: float) -> Iterator[NDArray[Any]]:
    """The first, second ... cells (row, col) of all blocks; the last blocks, which may be partial, get ``fill``."""
    whole = np.pad(a, [(0, -size % n) for size in a.shape], constant_values=fill)
    return (whole[i::n, j::n] for i, j in np.ndindex(n, n))
