"""Configuration space of a vehicle on a raster: distances to hazards, and the directions in which it may stand.

Hazards to a wheel were computed in a window as large as the wheel, so only the centre of the wheel must avoid them. The
ground between the wheels is judged by the clearance of the belly. A raster path moves along rows, columns and
diagonals, and a vehicle covers the same ground forwards and backwards, so there are four directions.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from rille.stages.core.arrays import Bools, Bytes, Floats32
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import octagon
from rille.stages.planning.wheels import wheel_positions

STRAIGHT, RIGHT, ACROSS, LEFT = 1, 2, 4, 8
"""Bits of the directions: along columns; to row 0 and greater columns; along rows; to row 0 and smaller columns."""
ALL = STRAIGHT | RIGHT | ACROSS | LEFT
STEPS = ((STRAIGHT, -1, 0), (RIGHT, -1, 1), (ACROSS, 0, 1), (LEFT, -1, -1))
"""Bit, row and column of one step in each direction."""
ROUNDING_CELLS = 1e-9
"""Cells by which rounding alone may make a whole number of cells larger."""


def distance(mask: Bools, cell: float) -> Floats32:
    """Distance (row, col), m, of the middle of each cell to that of the nearest set one; infinite where none is."""
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    cells = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # In 64 bits, so that a whole number of cells is the same number of metres as a margin of the same length.
    return np.asarray(cells.astype(np.float64) * cell, np.float32)


class FreePlaces:
    """Cells on which the vehicle may stand, by direction and by the part of it that stays on known ground."""

    def __init__(
        self,
        wheel_hazard: Bools,
        body_hazard: Bools,
        vehicle: Vehicle,
        cell: float,
        unknown: Bools | None = None,
        closed: Bools | None = None,
    ) -> None:
        """
        Parameters
        ----------
        wheel_hazard : (row, col) cells to which no wheel's middle may come as near as the margin.
        body_hazard : cells to which the vehicle's middle may not.
        cell : side of a cell, metres.
        unknown : cells that the outline (without margin) or the wheels may not touch, where that is asked for; the
            outside of the map counts as such. None: none, and nothing outside.
        closed : cells on which its middle may not be, without a margin.
        """
        self._half_cells = vehicle.half_length / cell, vehicle.half_width / cell
        self._wheels = [_wheel_cells(vehicle, cell, dr, dc) for _, dr, dc in STEPS]
        self._unknown = unknown
        near, middle = (_grown(mask, vehicle.margin / cell) for mask in (wheel_hazard, body_hazard))
        if closed is not None:
            middle |= closed
        self._closed = [middle | _touching(near, wheels, outside=False) for wheels in self._wheels]

    def ways(self, below: str = "middle") -> Bytes:
        """Directions (row, col) as bits in which it may, with ``below``, its "outline", its "wheels" or its "middle",
        on known ground."""
        out = np.zeros(self._closed[0].shape, np.uint8)
        for (bit, *step), wheels, closed in zip(STEPS, self._wheels, self._closed, strict=True):
            if self._unknown is not None and below == "outline":
                closed = closed | _widened(self._unknown, *self._half_cells, (step[0], step[1]))
            elif self._unknown is not None and below == "wheels":
                closed = closed | _touching(self._unknown, wheels, outside=True)
            out[~closed] |= np.uint8(bit)
        return out


def _wheel_cells(vehicle: Vehicle, cell: float, dr: int, dc: int) -> list[tuple[int, int]]:
    """Row and column of the four wheels from the middle, cells, on a way along (dr, dc)."""
    unit = math.hypot(dr, dc) * cell
    # Rows grow backwards and columns to the right, so that the vehicle's right is (dc, -dr) for a step (dr, dc).
    return [(round((b * dr + a * dc) / unit), round((b * dc - a * dr) / unit)) for a, b in wheel_positions(vehicle)]


def _touching(mask: Bools, wheels: list[tuple[int, int]], *, outside: bool) -> Bools:
    """Cells (row, col) from which a wheel stands on the mask; cells off the map count as ``outside``."""
    rows, cols = mask.shape
    border = max(abs(v) for wheel in wheels for v in wheel)
    padded = np.pad(mask, border, constant_values=outside)
    moved = [padded[border + r : border + r + rows, border + c : border + c + cols] for r, c in wheels]
    return np.asarray(np.logical_or.reduce(moved))


def _grown(mask: Bools, reach: float) -> Bools:
    """Cells within ``reach`` cells of the mask: an octagon that holds the circle."""
    # Rounded up: a margin that is a fraction of a cell too wide closes a way, one too narrow touches a hazard.
    side, diagonal = octagon(math.ceil(reach - ROUNDING_CELLS))
    return _dilated(mask, [(side, 0, 1), (side, 1, 0), (diagonal, 1, 1), (diagonal, 1, -1)], outside=False)


def _widened(mask: Bools, half_length: float, half_width: float, step: tuple[int, int]) -> Bools:
    """Cells from which a rectangle, cells, aligned with ``step`` (row, col), touches the mask or leaves the map."""
    # A size that is a whole number of steps may come out a rounding above it, and must not grow by a step.
    along, across = (max(0, math.ceil(v / math.hypot(*step) - ROUNDING_CELLS)) for v in (half_length, half_width))
    lines = [(along, step[0], step[1]), (across, step[1], -step[0])]
    if step[0] and step[1]:
        # A diagonal line leaves every other cell out; three cells of a row close them.
        lines.append((1, 0, 1))
    return _dilated(mask, lines, outside=True)


def _dilated(mask: Bools, lines: list[tuple[int, int, int]], *, outside: bool) -> Bools:
    """The mask dilated by lines, one after the other: of so many steps (row, col) to either side; cells off the map
    count as ``outside``."""
    # A line may lead off the map and the next one back.
    border = sum(n for n, _, _ in lines)
    out = np.pad(mask, border, constant_values=outside)
    for n, r, c in lines:
        reached = 0
        while reached < n:
            # Lines of 2 k + 1 cells, moved by as many to either side, make a line three times as long.
            step = min(2 * reached + 1, n - reached)
            source, reached = out.copy(), reached + step
            for i, j in ((step * r, step * c), (-step * r, -step * c)):
                out[_from(i), _from(j)] |= source[_from(-i), _from(-j)]
    rows, cols = mask.shape
    return np.asarray(out[border : border + rows, border : border + cols])


def _from(offset: int) -> slice:
    """The part of an axis that an equal axis covers when it is moved by an offset."""
    return slice(max(offset, 0), min(offset, 0) or None)
