"""Successive over-relaxation of a field that is smooth except at bends, such as a surface.

The field f (rows, cols) minimises, with the second differences f_xx along rows and f_yy along columns,

    sum (power (f - f_0)^2 - 2 pull (f - f_0))  +  sum across f_xx^2  +  sum down f_yy^2

where ``power`` and ``pull`` are the data's terms about the start f_0 of each cell, and ``across`` and ``down`` the
weights of the bends (:func:`bend_weights`), 0 where a neighbour is unknown.

A sweep takes the cells in the order of reading.
"""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.core.kernel import kernel

BORDER = 2
"""Empty cells around the field: a second difference reaches two cells."""


def bend_weights(field: Floats32, scale: Floats32, bend: float, strength: float) -> tuple[Floats32, Floats32]:
    """Weights ``across``, ``down`` (rows, cols) of the second differences at each cell, float32.

    They are ``strength scale^2 / (1 + (scale second difference / bend)^2)``: large on smooth parts, small at edges, 0
    where a neighbour is NaN.

    Parameters
    ----------
    field : (rows, cols), NaN unknown.
    scale : (rows, cols) units of ``bend`` in one of the field; NaN unknown.
    """
    across, down = np.zeros_like(field), np.zeros_like(field)
    for axis, out in ((1, across), (0, down)):
        inner = (slice(None),) * axis + (slice(1, -1),)
        units = scale[inner]
        weight = strength * units**2 / (1.0 + (np.diff(field, 2, axis=axis) * units / bend) ** 2)
        out[inner] = np.nan_to_num(weight)
    return across, down


def relax(
    start: Floats32, power: Floats32, pull: Floats32, bends: tuple[Floats32, Floats32], keep: Bools, sweeps: int
) -> Floats32:
    """Field (rows, cols) float32 after a number of sweeps.

    Parameters
    ----------
    start : (rows, cols) float32 to start from, NaN unknown.
    power, pull : (rows, cols) float32; 0 without data.
    bends : ``across`` and ``down`` of :func:`bend_weights`.
    keep : (rows, cols) known cells that move; the others are returned unchanged.
    """
    if not keep.any():
        return start
    # About the mean, so that single precision is enough.
    middle = np.nanmean(start)
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    field, across, down = (np.pad(a, BORDER) for a in (np.nan_to_num(start - middle), *bends))
    # Weights of the bend at the cell, and of those that end there.
    weight = power + 4 * (across + down)[inner] + across[inner[0], 1:-3] + across[inner[0], 3:-1]
    weight += down[1:-3, inner[1]] + down[3:-1, inner[1]]
    inverse = np.divide(1, weight, out=np.zeros_like(weight), where=keep & (weight > 0))
    _sweep(field, across, down, power * field[inner] + pull, inverse, sweeps)
    return np.where(keep, field[inner] + middle, start)


@kernel
def _sweep(field, across, down, goal, inverse, sweeps):  # type: ignore[no-untyped-def]
    """Relax a field in place; it and the weights of the bends have a border.

    ``goal`` (rows, cols): power f_0 + pull; ``inverse``: 1 over all weights of a cell, 0 where it does not move.

    A cell is the weighted mean of its goal and of the values by which each second difference vanishes, with the row
    (its first end, second end and middle), then with the column. Of these only the two cells before it in its row are
    moved just before. Everything else is therefore summed up for the whole row first, many cells at a time.
    """
    # 1.7: factor on each step, which stays convergent below 2.
    two, overshoot = np.float32(2.0), np.float32(1.7)
    step = overshoot * inverse
    stay = np.where(inverse > 0.0, np.float32(1.0) - overshoot, np.float32(1.0)).astype(np.float32)
    rows, cols = goal.shape
    before2 = step * across[BORDER:-BORDER, 1:-3]
    before = two * (before2 + step * across[BORDER:-BORDER, 2:-2])
    rest = np.empty(cols, np.float32)
    for _ in range(sweeps):
        for r in range(rows):
            i = r + BORDER
            above2, above, row, below, below2 = field[i - 2], field[i - 1], field[i], field[i + 1], field[i + 2]
            bend, bend_above, bend_here, bend_below = across[i], down[i - 1], down[i], down[i + 1]
            for c in range(cols):
                j = c + BORDER
                total = goal[r, c] + bend[j + 1] * (two * row[j + 1] - row[j + 2]) + two * bend[j] * row[j + 1]
                total += bend_above[j] * (two * above[j] - above2[j]) + bend_below[j] * (two * below[j] - below2[j])
                total += two * bend_here[j] * (above[j] + below[j])
                rest[c] = stay[r, c] * row[j] + step[r, c] * total
            for c in range(cols):
                j = c + BORDER
                row[j] = rest[c] - before2[r, c] * row[j - 2] + before[r, c] * row[j - 1]
