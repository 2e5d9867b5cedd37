"""Configuration space of a vehicle on a raster: distances to hazards, and the directions in which it may stand.

Hazards to a wheel were computed in a window as large as the wheel, so only the centre of the wheel must avoid them. The
ground between the wheels is judged by the clearance of the belly. A raster path moves along rows, columns and
diagonals, and a vehicle covers the same ground forwards and backwards, so there are four directions.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.wheels import wheel_positions

STRAIGHT, RIGHT, ACROSS, LEFT = 1, 2, 4, 8
"""Bits of the directions: along columns; to row 0 and greater columns; along rows; to row 0 and smaller columns."""
DIRECTED_STEPS = ((STRAIGHT, -1, 0), (RIGHT, -1, 1), (ACROSS, 0, 1), (LEFT, -1, -1))
"""Bit, row and column of one step in each direction."""


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
        self._vehicle, self._cell, self._unknown = vehicle, cell, unknown
        near, middle = (distance(mask, cell) <= np.float32(vehicle.margin) for mask in (wheel_hazard, body_hazard))
        if closed is not None:
            middle |= closed
        wheels = wheel_positions(vehicle)
        self._closed = [middle | self._touching(near, wheels, step, outside=False) for step in DIRECTED_STEPS]

    def ways(self, below: str = "middle") -> Bytes:
        """Directions (row, col) as bits in which it may, with ``below``, its "outline", its "wheels" or its "middle",
        on known ground."""
        unknown, wheels = self._unknown, wheel_positions(self._vehicle)
        half_cells = self._vehicle.half_length / self._cell, self._vehicle.half_width / self._cell
        out = np.zeros(self._closed[0].shape, np.uint8)
        for step, closed in zip(DIRECTED_STEPS, self._closed, strict=True):
            if unknown is not None and below == "outline":
                closed = closed | widened(unknown, *half_cells, (step[1], step[2]))
            elif unknown is not None and below == "wheels":
                closed = closed | self._touching(unknown, wheels, step, outside=True)
            out[~closed] |= np.uint8(step[0])
        return out

    def _touching(self, mask: Bools, points: Floats, step: tuple[int, int, int], *, outside: bool) -> Bools:
        """Cells (row, col) from which one of the vehicle's points (n, 2), right and ahead of its middle, m, is on the
        mask on a way along a step; cells off the map count as ``outside``."""
        (rows, cols), (_, dr, dc) = mask.shape, step
        unit = math.hypot(dr, dc) * self._cell
        # Rows grow backwards and columns to the right, so that the vehicle's right is (dc, -dr) for a step (dr, dc).
        cells = [(round((b * dr + a * dc) / unit), round((b * dc - a * dr) / unit)) for a, b in points]
        border = max(abs(v) for cell in cells for v in cell)
        padded, out = np.pad(mask, border, constant_values=outside), np.zeros_like(mask)
        for r, c in cells:
            out |= padded[border + r : border + r + rows, border + c : border + c + cols]
        return out


def widened(mask: Bools, half_length: float, half_width: float, step: tuple[int, int]) -> Bools:
    """Cells from which a rectangle, in cells, aligned with ``step`` (row, col), touches the mask or leaves the map."""
    # A size that is a whole number of steps may come out a rounding above it, and must not grow by a step.
    along, across = (max(0, math.ceil(v / math.hypot(*step) - 1e-9)) for v in (half_length, half_width))
    lines = [_line(along, *step), _line(across, step[1], -step[0])]
    if step[0] and step[1]:
        # A diagonal line leaves every other cell out; three cells of a row close them.
        lines.append(_line(1, 0, 1))
    # A line may lead off the map and the next one back.
    border = sum(len(line) for line in lines)
    out = np.pad(mask, border, constant_values=True).astype(np.uint8)
    for line in lines:
        out = cv2.dilate(out, line)
    return out[border:-border, border:-border] > 0


def _line(n: int, row: int, col: int) -> Bytes:
    """Kernel of the cells on a line of ``n`` steps (row, col) to either side."""
    at, kernel = np.arange(-n, n + 1), np.zeros((2 * n + 1, 2 * n + 1), np.uint8)
    kernel[n + row * at, n + col * at] = 1
    return kernel
