"""Successive over-relaxation of fields that are smooth but for their bends: surfaces, disparities.

Fields f_1 .. f_k (k, rows, cols) minimise together, with the second differences f_xx along rows and f_yy along columns,

    sum ((f - f_0)' A (f - f_0) - 2 b' (f - f_0))  +  sum across |f_xx|^2  +  sum down |f_yy|^2

where A (k x k) and b (k) are what the data say of each cell about its start f_0, and ``across`` and ``down`` the
weights of the bends (:func:`bend_weights`), 0 where a neighbour is unknown.

A cell shares second differences with the two cells beside it on each side of its row and of its column, so three
colours, (row + column) mod 3, part the cells into sets without a common term. In each sweep one colour after the other
is relaxed; within a colour the order makes no difference.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.arrays import Bools, Floats32

OVERSHOOT = 1.7
"""Factor on each step, which stays convergent below 2."""
BORDER = 2
"""Cells of nothing around: a second difference reaches two cells far."""


@njit(cache=True, nogil=True)
def bend_weights(field, scale, bend, strength):  # type: ignore[no-untyped-def]
    """Weights ``across``, ``down`` (rows, cols) of the second differences at each cell, float32.

    They are ``strength scale^2 / (1 + (|scale second difference| / bend)^2)``: strong on smooth parts, weak at edges,
    0 where a neighbour is NaN.

    Parameters
    ----------
    field : (k, rows, cols), NaN unknown.
    scale : (rows, cols) units of ``bend`` in one of the field; NaN unknown.
    """
    count, rows, cols = field.shape
    across, down = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    for r in range(rows):
        for c in range(cols):
            s = scale[r, c]
            if not s > 0.0:
                continue
            if 0 < c < cols - 1:
                square = 0.0
                for k in range(count):
                    square += (field[k, r, c - 1] - field[k, r, c] + field[k, r, c + 1] - field[k, r, c]) ** 2
                if np.isfinite(square):
                    across[r, c] = strength * s * s / (1.0 + square * (s / bend) ** 2)
            if 0 < r < rows - 1:
                square = 0.0
                for k in range(count):
                    square += (field[k, r - 1, c] - field[k, r, c] + field[k, r + 1, c] - field[k, r, c]) ** 2
                if np.isfinite(square):
                    down[r, c] = strength * s * s / (1.0 + square * (s / bend) ** 2)
    return across, down


def relax(
    start: Floats32, power: Floats32, pull: Floats32, bends: tuple[Floats32, Floats32], keep: Bools, sweeps: int
) -> Floats32:
    """Fields (k, rows, cols) float32 after a number of sweeps.

    Parameters
    ----------
    start : (k, rows, cols) float32 to start from, NaN unknown; k is 1 or 2.
    power, pull : (k, k, rows, cols) and (k, rows, cols) float32, A and b; 0 where the data say nothing.
    bends : ``across`` and ``down`` as :func:`bend_weights` gives them.
    keep : (rows, cols) known cells that move; the others are returned as they are.
    """
    # About the mean, so that single precision is enough.
    middle = np.array([np.nanmean(f) if np.isfinite(f).any() else 0.0 for f in start], np.float32)[:, None, None]
    around = (BORDER, BORDER)
    at = np.pad(np.nan_to_num(start - middle), [(0, 0), around, around])
    across, down = (np.pad(b, BORDER) for b in bends)
    goal, inverse = _equations(power, pull, at, (across, down), keep)
    _sweeps(at, goal, inverse, (across, down), sweeps)
    moved = at[:, BORDER:-BORDER, BORDER:-BORDER]
    return np.where(keep, moved + middle, start)


@njit(cache=True, nogil=True)
def _equations(power, pull, at, bends, keep):  # type: ignore[no-untyped-def]
    """A f_0 + b (k, rows, cols) of the cells that move, and the inverse (k, k, rows, cols) of A and all weights of the
    cell's bends; 0 where these determine nothing."""
    across, down = bends
    goal, inverse = np.zeros_like(pull), np.zeros_like(power)
    count, rows, cols = goal.shape
    for r in range(rows):
        for c in range(cols):
            if not keep[r, c]:
                continue
            i, j = r + BORDER, c + BORDER
            bend = np.float32(4.0) * (across[i, j] + down[i, j])
            bend += across[i, j - 1] + across[i, j + 1] + down[i - 1, j] + down[i + 1, j]
            for k in range(count):
                goal[k, r, c] = pull[k, r, c]
                for m in range(count):
                    goal[k, r, c] += power[k, m, r, c] * at[m, i, j]
            first = power[0, 0, r, c] + bend
            if count == 1:
                inverse[0, 0, r, c] = np.float32(1.0) / first if first > 0.0 else np.float32(0.0)
                continue
            mixed, second = power[0, 1, r, c], power[1, 1, r, c] + bend
            det = first * second - mixed * mixed
            if det > 0.0:
                inverse[0, 0, r, c], inverse[1, 1, r, c] = second / det, first / det
                inverse[0, 1, r, c] = inverse[1, 0, r, c] = -mixed / det
    return goal, inverse


@njit(cache=True, nogil=True)
def _sweeps(at, goal, inverse, bends, sweeps):  # type: ignore[no-untyped-def]
    """Relax in place; ``at`` and ``bends`` have a border."""
    count, rows, cols = goal.shape
    passes, overshoot, wanted = 3 * sweeps, np.float32(OVERSHOOT), np.zeros(2, np.float32)
    # Each pass of a colour two rows behind the one before it: the same result as one after the other, while the rows
    # are in the cache.
    for turn in range(rows + BORDER * (passes - 1)):
        for n in range(passes):
            r = turn - BORDER * n
            if r < 0 or r >= rows:
                continue
            for c in range((n - r) % 3, cols, 3):
                if count == 1:
                    own, part = at[0, r + BORDER, c + BORDER], inverse[0, 0, r, c]
                    moved = part * (goal[0, r, c] + _bend_pull(at, 0, bends, r, c))
                    at[0, r + BORDER, c + BORDER] = own + overshoot * (moved - own) if part > 0.0 else own
                elif inverse[0, 0, r, c] > 0.0:
                    for k in range(2):
                        wanted[k] = goal[k, r, c] + _bend_pull(at, k, bends, r, c)
                    for k in range(2):
                        moved = inverse[k, 0, r, c] * wanted[0] + inverse[k, 1, r, c] * wanted[1]
                        own = at[k, r + BORDER, c + BORDER]
                        at[k, r + BORDER, c + BORDER] = own + overshoot * (moved - own)


@njit(cache=True, nogil=True, forceinline=True)
def _bend_pull(f, k, bends, r, c):  # type: ignore[no-untyped-def]
    """Sum of what the second differences want field ``k`` to be at a cell, times their weights: as their middle and as
    either end. Of arrays with a border the cell is at (r + 2, c + 2)."""
    (a, d), two = bends, np.float32(2.0)
    i, j = np.uint32(r), np.uint32(c)  # unsigned: not counted from the end, so no check at each use
    left, right, above, below = f[k, i + 2, j + 1], f[k, i + 2, j + 3], f[k, i + 1, j + 2], f[k, i + 3, j + 2]
    total = two * (a[i + 2, j + 2] * (left + right) + d[i + 2, j + 2] * (above + below))
    total += a[i + 2, j + 1] * (two * left - f[k, i + 2, j]) + a[i + 2, j + 3] * (two * right - f[k, i + 2, j + 4])
    return total + (
        d[i + 1, j + 2] * (two * above - f[k, i, j + 2]) + d[i + 3, j + 2] * (two * below - f[k, i + 4, j + 2])
    )
