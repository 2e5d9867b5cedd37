"""Successive over-relaxation of a field that is smooth but for its bends, such as a surface.

The field f (rows, cols) minimises, with the second differences f_xx along rows and f_yy along columns,

    sum (power (f - f_0)^2 - 2 pull (f - f_0))  +  sum across f_xx^2  +  sum down f_yy^2

where ``power`` and ``pull`` are what the data say of each cell about its start f_0, and ``across`` and ``down`` the
weights of the bends (:func:`bend_weights`), 0 where a neighbour is unknown.

A cell shares second differences with two cells to each side of its row and of its column, so the cells of one diagonal
(row + column) do not depend on each other. A sweep goes from diagonal to diagonal, which is the order of reading to
the bit. A diagonal is a line in memory here, so its cells are computed as vectors, and the next sweep follows a few
diagonals behind, while they are in the cache.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Bools, Floats32

OVERRELAXATION = 1.7
"""Factor on each step, which stays convergent below 2."""
BORDER = 2
"""Diagonals and rows of nothing around: a second difference reaches two cells far."""
SWEEP_LAG_DIAGONALS = 3
"""Diagonals that a sweep keeps behind the one before it."""


class _Equations(NamedTuple):
    """Arrays (diagonal, row) with a border: the field ``at``, the weights ``across`` and ``down``, ``goal``
    power f_0 + pull, and ``inverse`` 1 over all weights of a cell, 0 where it does not move."""

    at: Floats32
    across: Floats32
    down: Floats32
    goal: Floats32
    inverse: Floats32


@njit(cache=True, nogil=True)
def bend_weights(field, scale, bend, strength):  # type: ignore[no-untyped-def]
    """Weights ``across``, ``down`` (rows, cols) of the second differences at each cell, float32.

    They are ``strength scale^2 / (1 + (scale second difference / bend)^2)``: strong on smooth parts, weak at edges, 0
    where a neighbour is NaN.

    Parameters
    ----------
    field : (rows, cols), NaN unknown.
    scale : (rows, cols) units of ``bend`` in one of the field; NaN unknown.
    """
    rows, cols = field.shape
    across, down = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    for r in range(rows):
        for c in range(cols):
            s = scale[r, c]
            if not s > 0.0:
                continue
            if 0 < c < cols - 1:
                second = field[r, c - 1] - field[r, c] + field[r, c + 1] - field[r, c]
                if np.isfinite(second):
                    across[r, c] = strength * s * s / (1.0 + (second * s / bend) ** 2)
            if 0 < r < rows - 1:
                second = field[r - 1, c] - field[r, c] + field[r + 1, c] - field[r, c]
                if np.isfinite(second):
                    down[r, c] = strength * s * s / (1.0 + (second * s / bend) ** 2)
    return across, down


def relax(
    start: Floats32, power: Floats32, pull: Floats32, bends: tuple[Floats32, Floats32], keep: Bools, sweeps: int
) -> Floats32:
    """Field (rows, cols) float32 after a number of sweeps.

    Parameters
    ----------
    start : (rows, cols) float32 to start from, NaN unknown.
    power, pull : (rows, cols) float32; 0 where the data say nothing.
    bends : ``across`` and ``down`` as :func:`bend_weights` gives them.
    keep : (rows, cols) known cells that move; the others are returned as they are.
    """
    if not keep.any():
        return start
    # About the mean, so that single precision is enough.
    middle = np.nanmean(start)
    rows, cols = start.shape
    equations = _Equations(*np.zeros((len(_Equations._fields), rows + cols - 1 + 2 * BORDER, rows + 2 * BORDER), "f4"))
    _shear(start - middle, power, pull, bends, keep, equations)
    _sweeps(equations, cols, sweeps)
    out = start.copy()
    _read(equations.at, middle, keep, out)
    return out


@njit(cache=True, nogil=True)
def _shear(start, power, pull, bends, keep, out):  # type: ignore[no-untyped-def]
    """Fill the equations from arrays (rows, cols); what is NaN in the start stays 0."""
    (across, down), (rows, cols) = bends, start.shape
    four, none = np.float32(4.0), np.float32(0.0)
    # Arrays are taken out of their tuple before the loop: each time costs an atomic count of references.
    at, by_row, by_column, goal, inverse = out.at, out.across, out.down, out.goal, out.inverse
    for r in range(rows):
        for c in range(cols):
            if not np.isfinite(start[r, c]):
                continue
            t, i = r + c + BORDER, r + BORDER
            at[t, i], by_row[t, i], by_column[t, i] = start[r, c], across[r, c], down[r, c]
            if not keep[r, c]:
                continue
            goal[t, i] = power[r, c] * start[r, c] + pull[r, c]
            # Of the bend about the cell, and of those that end there.
            weight = power[r, c] + four * (across[r, c] + down[r, c])
            weight += (across[r, c - 1] if c > 0 else none) + (across[r, c + 1] if c + 1 < cols else none)
            weight += (down[r - 1, c] if r > 0 else none) + (down[r + 1, c] if r + 1 < rows else none)
            if weight > 0.0:
                inverse[t, i] = np.float32(1.0) / weight


@njit(cache=True, nogil=True)
def _read(at, middle, keep, out):  # type: ignore[no-untyped-def]
    """Fill the cells that move from the field of the equations."""
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            if keep[r, c]:
                out[r, c] = at[r + c + BORDER, r + BORDER] + middle


@njit(cache=True, nogil=True)
def _sweeps(equations, cols, sweeps):  # type: ignore[no-untyped-def]
    """Relax a field of a number of columns in place."""
    diagonals = equations.at.shape[0] - 2 * BORDER
    rows = diagonals + 1 - cols
    sums = np.empty(rows, np.float32)
    for turn in range(diagonals + SWEEP_LAG_DIAGONALS * (sweeps - 1)):
        for k in range(sweeps):
            t = turn - SWEEP_LAG_DIAGONALS * k
            if 0 <= t < diagonals:
                _relax_diagonal(equations, t + BORDER, max(0, t + 1 - cols) + BORDER, min(rows, t + 1) + BORDER, sums)


@njit(cache=True, nogil=True)
def _relax_diagonal(equations, t, i, j, sums):  # type: ignore[no-untyped-def]
    """Relax the cells of rows i to j of diagonal t; ``sums``: room for a number each."""
    at, across, down = equations.at, equations.across, equations.down
    two, overshoot, n = np.float32(2.0), np.float32(OVERRELAXATION), j - i
    # What the second differences along the row, then the column want the cell to be, times their weights: as their
    # second end, their middle and their first end.
    before, weight, behind = across[t - 1, i:j], across[t, i:j], across[t + 1, i:j]
    far, left, right, beyond = at[t - 2, i:j], at[t - 1, i:j], at[t + 1, i:j], at[t + 2, i:j]
    goal = equations.goal[t, i:j]
    for m in range(n):
        sums[m] = goal[m] + before[m] * (two * left[m] - far[m]) + behind[m] * (two * right[m] - beyond[m])
        sums[m] += two * weight[m] * (left[m] + right[m])
    before, weight, behind = down[t - 1, i - 1 : j - 1], down[t, i:j], down[t + 1, i + 1 : j + 1]
    far, above, below = at[t - 2, i - 2 : j - 2], at[t - 1, i - 1 : j - 1], at[t + 1, i + 1 : j + 1]
    beyond = at[t + 2, i + 2 : j + 2]
    for m in range(n):
        sums[m] += before[m] * (two * above[m] - far[m]) + behind[m] * (two * below[m] - beyond[m])
        sums[m] += two * weight[m] * (above[m] + below[m])
    own, inverse = at[t, i:j], equations.inverse[t, i:j]
    for m in range(n):
        moved = own[m] + overshoot * (inverse[m] * sums[m] - own[m])
        own[m] = moved if inverse[m] > 0.0 else own[m]
