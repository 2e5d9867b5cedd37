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
from rille.stages.planning.wheels import wheel_positions

STRAIGHT, RIGHT, ACROSS, LEFT = 1, 2, 4, 8
"""Bits of the directions: along columns; to row 0 and greater columns; along rows; to row 0 and smaller columns."""
ALL = STRAIGHT | RIGHT | ACROSS | LEFT
STEPS = ((STRAIGHT, -1, 0), (RIGHT, -1, 1), (ACROSS, 0, 1), (LEFT, -1, -1))
"""Bit, row and column of one step in each direction."""
ROUNDING_CELLS = 1e-6
"""Cells by which a distance may exceed a margin by rounding alone."""


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
        reach = vehicle.margin + ROUNDING_CELLS * cell
        middle = distance(body_hazard, cell) <= reach
        if closed is not None:
            middle |= closed
        near = distance(wheel_hazard, cell) <= reach
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


def _widened(mask: Bools, half_length: float, half_width: float, step: tuple[int, int]) -> Bools:
    """Cells from which a rectangle, cells, aligned with ``step`` (row, col), touches the mask or leaves the map."""
    dr, dc = step
    lines = [(half_length, dr, dc), (half_width, dc, -dr)]
    if dr and dc:
        # A diagonal line leaves every other cell out; three cells of a row close them.
        lines.append((1.0, 0, 1))
    out = mask.astype(np.uint8)
    for half, r, c in lines:
        # A size that is a whole number of steps may come out a rounding above it, and must not grow by a step.
        n = max(0, math.ceil(half / math.hypot(r, c) - 1e-9))
        k = np.arange(-n, n + 1)
        line = np.zeros((2 * n * abs(r) + 1, 2 * n * abs(c) + 1), np.uint8)
        line[n * abs(r) + k * r, n * abs(c) + k * c] = 1
        out = cv2.dilate(out, line, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return out > 0
