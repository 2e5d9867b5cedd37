"""Where a vehicle may stand in each of four directions: its wheels and its outline laid over what they must not touch.

A raster path moves along rows, columns and diagonals, and a vehicle covers the same ground forwards and backwards, so
four directions are all there are. What is hazardous to a wheel was found in a window as large as the wheel, so it
counts where the middle of a wheel is. The ground between is the belly's, which is judged by clearance.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.extrema import octagon
from stages.vehicle import Vehicle

Mask = NDArray[np.bool_]
Bytes = NDArray[np.uint8]

STRAIGHT, RIGHT, ACROSS, LEFT = 1, 2, 4, 8
"""Bits of the directions: along columns; to row 0 and greater columns; along rows; to row 0 and smaller columns."""
ALL = STRAIGHT | RIGHT | ACROSS | LEFT
STEPS = ((STRAIGHT, -1, 0), (RIGHT, -1, 1), (ACROSS, 0, 1), (LEFT, -1, -1))
"""Bit, row and column of one step in each direction."""


def widened(mask: Mask, half_length: float, half_width: float, step: tuple[int, int]) -> Mask:
    """Cells from which a rectangle that is aligned with ``step`` (row, col) and centred there touches the mask.

    What lies outside counts as in the mask.

    Parameters
    ----------
    half_length, half_width : cells, of the rectangle along and across the step.
    """
    along, across = step, (step[1], -step[0])
    unit = math.hypot(*step)
    diagonal = unit > 1
    # a diagonal line leaves every other cell out: a square of two closes them
    sides = [max(0, math.ceil(v / unit - 1e-9)) for v in (half_length, half_width)]
    pad = (sides[0] + sides[1] + 1) * max(abs(along[0]), abs(along[1]), 1)
    work = np.pad(mask.astype(np.uint8), pad, constant_values=1)
    spare = np.empty_like(work)
    for n, (dr, dc) in zip(sides, (along, across), strict=True):
        work, spare = _spread(work, spare, n, dr, dc)
    if diagonal:
        work, spare = _spread(work, spare, 1, 0, 1)
    return np.asarray(work[pad:-pad, pad:-pad] != 0)


@njit(cache=True, nogil=True)
def _or(a, b, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = a[c] | b[c]


@njit(cache=True, nogil=True)
def _spread(work, spare, n, dr, dc):  # type: ignore[no-untyped-def]
    """Union over the shifts by -n .. n steps, by doubling; returns the result and the other buffer."""
    for sign in (1, -1):
        left = n
        w = 1  # union of shifts 0 .. w - 1
        while left > 0:
            k = min(w, left)
            _shifted(work, spare, sign * k * dr, sign * k * dc)
            work, spare = spare, work
            left -= k
            w += k
    return work, spare


@njit(cache=True, nogil=True)
def _shifted(work, out, dr, dc):  # type: ignore[no-untyped-def]
    """``out = work | work shifted by (dr, dc)``; what comes from outside is 0."""
    rows, cols = work.shape
    c0, c1 = max(0, dc), min(cols, cols + dc)
    for r in range(rows):
        for c in range(cols):
            out[r, c] = work[r, c]
        if 0 <= r - dr < rows and c1 > c0:
            _or(work[r, c0:c1], work[r - dr, c0 - dc : c1 - dc], out[r, c0:c1])


def grown(mask: Mask, reach: float) -> Mask:
    """Cells within ``reach`` cells of the mask: an octagon, nowhere smaller than the circle."""
    side, diagonal = octagon(math.ceil(reach - 1e-9))
    pad = side + 2 * diagonal
    if pad == 0:
        return mask.copy()
    work = np.pad(mask.astype(np.uint8), pad)
    spare = np.empty_like(work)
    for n, dr, dc in ((side, 0, 1), (side, 1, 0), (diagonal, 1, 1), (diagonal, 1, -1)):
        work, spare = _spread(work, spare, n, dr, dc)
    return np.asarray(work[pad:-pad, pad:-pad] != 0)


def standing(
    wheel_hazard: Mask,
    body_hazard: Mask,
    vehicle: Vehicle,
    cell: float,
    *,
    unknown: Mask | None = None,
    below: str = "",
) -> Bytes:
    """Directions (row, col) as bits in which the vehicle may stand with its middle on a cell.

    Parameters
    ----------
    wheel_hazard : cells to which no wheel's middle may come as near as the margin.
    body_hazard : cells to which the vehicle's middle may not.
    unknown : cells that ``below``, its "outline" (without margin) or its "wheels", may not touch; what lies outside the
        map counts as such. None: wherever its middle may be.
    """
    wheels, middle = (grown(mask, vehicle.margin / cell) for mask in (wheel_hazard, body_hazard))
    wheels = wheels | unknown if unknown is not None and below == "wheels" else wheels
    ahead, aside = 0.5 * vehicle.wheel_base / cell, 0.5 * vehicle.track / cell
    out = np.zeros(wheel_hazard.shape, dtype=np.uint8)
    for bit, dr, dc in STEPS:
        unit = math.hypot(dr, dc)
        closed = middle.copy()
        for along, across in ((ahead, aside), (ahead, -aside), (-ahead, aside), (-ahead, -aside)):
            # the wheel is at (row, col) of the middle plus this: what lies there closes the middle
            at = round((along * dr + across * dc) / unit), round((along * dc - across * dr) / unit)
            _mark(closed, wheels, at[0], at[1], unknown is not None)
        if unknown is not None and below == "outline":
            closed |= widened(unknown, vehicle.half_length / cell, vehicle.half_width / cell, (dr, dc))
        out[~closed] |= np.uint8(bit)
    return out


def _mark(out: Mask, mask: Mask, dr: int, dc: int, outside: bool) -> None:
    """Mark in ``out`` the cells from which the mask lies at (dr, dc), or ``outside`` if that counts."""
    rows, cols = mask.shape
    target = slice(max(-dr, 0), rows - max(dr, 0)), slice(max(-dc, 0), cols - max(dc, 0))
    source = slice(max(dr, 0), rows - max(-dr, 0)), slice(max(dc, 0), cols - max(-dc, 0))
    if outside:
        inner = np.ones_like(out)
        inner[target] = mask[source]
        out |= inner
    else:
        out[target] |= mask[source]
