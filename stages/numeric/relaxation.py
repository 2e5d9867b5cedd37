"""Successive over-relaxation of a field that is smooth but for its bends, such as a surface.

The field f (rows, cols) minimises, with the second differences f_xx along rows and f_yy along columns,

    sum (power (f - f_0)^2 - 2 pull (f - f_0))  +  sum across f_xx^2  +  sum down f_yy^2

where ``power`` and ``pull`` are what the data say of each cell about its start f_0, and ``across`` and ``down`` the
weights of the bends (:func:`bend_weights`), 0 where a neighbour is unknown.

A cell shares second differences with the two cells beside it on each side of its row and of its column, so three
colours, (row + column) mod 3, part the cells into sets without a common term. In each sweep one colour after the other
is relaxed; within a colour the order makes no difference. Every third column of a row is stored side by side, so that
the cells of a colour are neighbours in memory and are relaxed as vectors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Bools, Floats32

OVERSHOOT = 1.7
"""Factor on each step, which stays convergent below 2."""
COLOURS = 3
BORDER = 2
"""Rows of nothing around: a second difference reaches two cells far. Beside them it is a column of each colour."""


class _Equations(NamedTuple):
    """Arrays (row, colour of the column, column / 3) with a border: the field ``at``, the weights ``across`` and
    ``down``, ``goal`` power f_0 + pull, and ``inverse`` 1 over all weights of a cell, 0 where it does not move."""

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
    shape = start.shape[0] + 2 * BORDER, COLOURS, -(-start.shape[1] // COLOURS) + 2
    equations = _Equations(*np.zeros((len(_Equations._fields), *shape), np.float32))
    _colour(start - middle, power, pull, bends, equations)
    _invert(power, keep, equations)
    _sweeps(equations, sweeps)
    moved = equations.at[BORDER:-BORDER].transpose(0, 2, 1).reshape(len(start), -1)[:, COLOURS:]
    return np.where(keep, moved[:, : start.shape[1]] + middle, start)


@njit(cache=True, nogil=True)
def _colour(start, power, pull, bends, out):  # type: ignore[no-untyped-def]
    """Fill the equations, all but the inverse, from arrays (rows, cols); what is NaN in the start stays 0."""
    (across, down), at, goal = bends, out.at, out.goal
    by_row, by_column = out.across, out.down
    for r in range(start.shape[0]):
        for c in range(start.shape[1]):
            i, k, m = r + BORDER, c % COLOURS, c // COLOURS + 1
            by_row[i, k, m], by_column[i, k, m], goal[i, k, m] = across[r, c], down[r, c], pull[r, c]
            if np.isfinite(start[r, c]):
                at[i, k, m] = start[r, c]
                goal[i, k, m] += power[r, c] * start[r, c]


@njit(cache=True, nogil=True)
def _invert(power, keep, out):  # type: ignore[no-untyped-def]
    """Fill the inverse of all weights of a cell: of the data, of the bend about it, and of those that end there."""
    across, down, inverse, four = out.across, out.down, out.inverse, np.float32(4.0)
    for r in range(power.shape[0]):
        for c in range(power.shape[1]):
            i, k, m = r + BORDER, c % COLOURS, c // COLOURS + 1
            before, behind = (c - 1) % COLOURS, (c + 1) % COLOURS
            weight = power[r, c] + four * (across[i, k, m] + down[i, k, m]) + down[i - 1, k, m] + down[i + 1, k, m]
            weight += across[i, before, (c - 1) // COLOURS + 1] + across[i, behind, (c + 1) // COLOURS + 1]
            if keep[r, c] and weight > 0.0:
                inverse[i, k, m] = np.float32(1.0) / weight


@njit(cache=True, nogil=True)
def _sweeps(equations, sweeps):  # type: ignore[no-untyped-def]
    """Relax the field in place."""
    rows, passes = equations.at.shape[0] - 2 * BORDER, COLOURS * sweeps
    sums = np.empty(equations.at.shape[2] - 2, np.float32)
    # Each pass of a colour two rows behind the one before it: the same result as one after the other, while the rows
    # are in the cache.
    for turn in range(rows + BORDER * (passes - 1)):
        for n in range(passes):
            r = turn - BORDER * n
            if 0 <= r < rows:
                _relax_row(equations, r + BORDER, (n - r) % COLOURS, sums)


@njit(cache=True, nogil=True)
def _relax_row(equations, r, colour, sums):  # type: ignore[no-untyped-def]
    """Relax the cells of a row whose columns are of a colour; ``sums``: room for a number each."""
    at, across, down = equations.at, equations.across, equations.down
    own, two, overshoot = _beside(at[r], colour, 0), np.float32(2.0), np.float32(OVERSHOOT)
    left, right, above, below = (
        _beside(at[r], colour, -1), _beside(at[r], colour, 1), _beside(at[r - 1], colour, 0),
        _beside(at[r + 1], colour, 0),
    )  # fmt: skip
    a, d = _beside(across[r], colour, 0), _beside(down[r], colour, 0)
    # What the second differences want the cell to be, times their weights: as their middle, and as either end.
    for m in range(sums.size):
        sums[m] = two * (a[m] * (left[m] + right[m]) + d[m] * (above[m] + below[m]))
    _add_end(_beside(across[r], colour, -1), left, _beside(at[r], colour, -2), sums)
    _add_end(_beside(across[r], colour, 1), right, _beside(at[r], colour, 2), sums)
    _add_end(_beside(down[r - 1], colour, 0), above, _beside(at[r - 2], colour, 0), sums)
    _add_end(_beside(down[r + 1], colour, 0), below, _beside(at[r + 2], colour, 0), sums)
    goal, inverse = _beside(equations.goal[r], colour, 0), _beside(equations.inverse[r], colour, 0)
    for m in range(sums.size):
        moved = own[m] + overshoot * (inverse[m] * (goal[m] + sums[m]) - own[m])
        own[m] = moved if inverse[m] > 0.0 else own[m]


@njit(cache=True, nogil=True)
def _beside(row, colour, shift):  # type: ignore[no-untyped-def]
    """Numbers of a row (colour, column / 3) ``shift`` columns beside those of a colour, without the border."""
    column = colour + shift
    first = 1 + column // COLOURS
    return row[column % COLOURS, first : first + row.shape[1] - 2]


@njit(cache=True, nogil=True)
def _add_end(weight, middle, far, sums):  # type: ignore[no-untyped-def]
    """Add what second differences about ``middle`` want their near end to be."""
    two = np.float32(2.0)
    for m in range(sums.size):
        sums[m] += weight[m] * (two * middle[m] - far[m])
