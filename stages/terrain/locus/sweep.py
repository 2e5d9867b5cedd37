"""Gauss-Seidel sweeps of the refined elevations, in reading order to the bit, a diagonal of cells at a time.

A cell takes part in second differences of its own row and column only, so it depends on the cells to its left and above
as they are after this sweep, and on those to its right and below as they were before. All cells of one diagonal
(row + column) are therefore independent of each other. The arrays are sheared so that a diagonal is a line in memory:
its cells are then computed side by side, and the next sweep follows three diagonals behind, while they are still near.
They have the type of the terms; single precision is enough, since elevations are taken about their mean: it changes the
result by less than a hundredth of what a cell moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Bools, Floats32

BORDER = 2
"""Diagonals and rows of nothing around: a second difference reaches two cells far."""
BEHIND = 3
"""Diagonals that a sweep keeps behind the one before it."""


class Terms(NamedTuple):
    """What is minimised over z: sum power (z - start)^2 - 2 pull z, and the weighted squares of second differences.

    ``power``, ``pull`` (rows, cols) the images' terms at ``start``, NaN unknown; ``keep`` cells that move; ``across``,
    ``down`` weights of the second differences at a cell, 0 at borders and beside unknown cells.
    """

    power: Floats32
    pull: Floats32
    start: Floats32
    keep: Bools
    across: Floats32
    down: Floats32


class _Sheared(NamedTuple):
    """Arrays (diagonal, row) with a border: elevations; weights of the second differences along a row and a column;
    what the images want; and the sum of all weights, 0 where a cell does not move."""

    at: Floats32
    by_row: Floats32
    by_column: Floats32
    wanted: Floats32
    total: Floats32


def diagonals(shape: tuple[int, int], dtype: type = np.float32) -> Floats32:
    """Room for the sheared arrays of (rows, cols) cells, for any number of calls: memory that is new costs more than
    a few sweeps."""
    rows, cols = shape
    return np.empty((5, rows + cols - 1 + 2 * BORDER, rows + 2 * BORDER), dtype)


@njit(cache=True, nogil=True)
def sweep(terms, z, sweeps, overshoot, room):  # type: ignore[no-untyped-def]
    """Minimise the terms in place: ``z`` (rows, cols), NaN unknown; ``overshoot`` is the factor on each step, ``room``
    what :func:`diagonals` gives."""
    power, pull, start, keep, across, down = terms
    rows, cols = z.shape
    room[:4] = 0.0
    room[4] = np.nan
    at, by_row, by_column, wanted, total = room[0], room[1], room[2], room[3], room[4]
    middle = np.nanmean(z)
    for r in range(rows):
        for c in range(cols):
            if z[r, c] == z[r, c]:
                t, i = r + c + BORDER, r + BORDER
                by_row[t, i], by_column[t, i], at[t, i] = across[r, c], down[r, c], z[r, c] - middle
                if keep[r, c]:
                    wanted[t, i] = power[r, c] * (start[r, c] - middle) + pull[r, c]
                    total[t, i] = power[r, c]
    low, high = _totals(by_row, by_column, total)
    sheared, sums = _Sheared(at, by_row, by_column, wanted, total), np.empty(rows, power.dtype)
    # All sweeps run in one pass over the diagonals, each a few behind the one before it, while these are in the cache.
    for turn in range(rows + cols - 1 + BEHIND * (sweeps - 1)):
        for k in range(sweeps):
            t = turn - BEHIND * k + BORDER
            if t >= BORDER and t < room.shape[1] - BORDER and low[t] < high[t]:
                _diagonal(sheared, t, low[t], high[t] - low[t], power.dtype.type(overshoot), sums)
    for r in range(rows):
        for c in range(cols):
            if keep[r, c]:
                z[r, c] = at[r + c + BORDER, r + BORDER] + middle


@njit(cache=True, nogil=True)
def _totals(by_row, by_column, total):  # type: ignore[no-untyped-def]
    """Add what the second differences weigh to ``total``, 0 where it is NaN; from where to where a diagonal has any."""
    diagonals, rows = total.shape
    four = total.dtype.type(4.0)
    low, high = np.zeros(diagonals, np.int64), np.zeros(diagonals, np.int64)
    for t in range(BORDER, diagonals - BORDER):
        low[t] = i = BORDER
        j = rows - BORDER
        own, a, b = total[t, i:j], by_row[t, i:j], by_column[t, i:j]
        before, above = by_row[t - 1, i:j], by_column[t - 1, i - 1 : j - 1]
        behind, below = by_row[t + 1, i:j], by_column[t + 1, i + 1 : j + 1]
        for m in range(j - i):
            s = four * a[m] + four * b[m]
            s = own[m] + (((s + before[m]) + above[m]) + behind[m] + below[m])
            own[m] = s if s == s else own.dtype.type(0.0)
        while low[t] < rows - BORDER and not total[t, low[t]] > 0.0:
            low[t] += 1
        high[t] = rows - BORDER
        while high[t] > low[t] and not total[t, high[t] - 1] > 0.0:
            high[t] -= 1
    return low, high


@njit(cache=True, nogil=True, error_model="numpy")
def _diagonal(sheared, t, i, n, overshoot, sums):  # type: ignore[no-untyped-def]
    """Cells ``i`` to ``i + n`` of diagonal ``t``; ``sums`` is room for what the second differences want of each."""
    at, by_row, by_column, wanted, total = sheared
    j, two = i + n, at.dtype.type(2.0)
    left, right, above, below = at[t - 1, i:j], at[t + 1, i:j], at[t - 1, i - 1 : j - 1], at[t + 1, i + 1 : j + 1]
    a, b = by_row[t, i:j], by_column[t, i:j]
    for m in range(n):
        sums[m] = two * a[m] * (left[m] + right[m]) + two * b[m] * (above[m] + below[m])
    a, b = by_row[t - 1, i:j], by_column[t - 1, i - 1 : j - 1]
    before, over = at[t - 2, i:j], at[t - 2, i - 2 : j - 2]
    for m in range(n):
        sums[m] = (sums[m] + a[m] * (two * left[m] - before[m])) + b[m] * (two * above[m] - over[m])
    a, b = by_row[t + 1, i:j], by_column[t + 1, i + 1 : j + 1]
    behind, under = at[t + 2, i:j], at[t + 2, i + 2 : j + 2]
    for m in range(n):
        sums[m] = (sums[m] + a[m] * (two * right[m] - behind[m])) + b[m] * (two * below[m] - under[m])
    own, goal, all_ = at[t, i:j], wanted[t, i:j], total[t, i:j]
    for m in range(n):
        moved = own[m] + overshoot * ((goal[m] + sums[m]) / all_[m] - own[m])
        own[m] = moved if all_[m] > 0.0 else own[m]
