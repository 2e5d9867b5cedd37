"""Where a vehicle may stand in each of four directions: its wheels and its outline laid over what they must not touch.

A raster path moves along rows, columns and diagonals, and a vehicle covers the same ground forwards and backwards, so
four directions are all there are. What is hazardous to a wheel was found in a window as large as the wheel, so it
counts where the middle of a wheel is. The ground between is the belly's, which is judged by clearance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.extrema import octagon
from stages.packed import Canvas
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
    # a diagonal line leaves every other cell out: a square of two closes them
    sides = [max(0, math.ceil(v / unit - 1e-9)) for v in (half_length, half_width)]
    canvas = Canvas.of(mask, sum(sides) + 1, outside=True)
    for n, (dr, dc) in zip(sides, (along, across), strict=True):
        canvas.spread(n, dr, dc)
    if unit > 1:
        canvas.spread(1, 0, 1)
    return canvas.mask()


def grown(mask: Mask, reach: float) -> Mask:
    """Cells within ``reach`` cells of the mask: an octagon, nowhere smaller than the circle."""
    side, diagonal = octagon(math.ceil(reach - 1e-9))
    canvas = Canvas.of(mask, side + 2 * diagonal)
    for n, dr, dc in ((side, 0, 1), (side, 1, 0), (diagonal, 1, 1), (diagonal, 1, -1)):
        canvas.spread(n, dr, dc)
    return canvas.mask()


class Stand:
    """Where the vehicle may stand: its wheels and its middle laid over hazards once, for whatever is below it."""

    def __init__(
        self,
        wheel_hazard: Mask,
        body_hazard: Mask,
        vehicle: Vehicle,
        cell: float,
        unknown: Mask | None = None,
        closed: Mask | None = None,
    ) -> None:
        """
        Parameters
        ----------
        wheel_hazard : (row, col) cells to which no wheel's middle may come as near as the margin.
        body_hazard : cells to which the vehicle's middle may not.
        cell : side of a cell, metres.
        unknown : cells that the outline (without margin) or the wheels may not touch, where that is asked for; what
            lies outside the map counts as such. None: none, and nothing outside.
        closed : cells on which its middle may not be, without a margin.
        """
        self._half = vehicle.half_length / cell, vehicle.half_width / cell
        ahead, aside = 0.5 * vehicle.wheel_base / cell, 0.5 * vehicle.track / cell
        self._places = [_wheels(ahead, aside, dr, dc) for _, dr, dc in STEPS]
        self._border = max(abs(v) for four in self._places for at in four for v in at)
        self._unknown = unknown
        wheels, middle = (grown(mask, vehicle.margin / cell) for mask in (wheel_hazard, body_hazard))
        on_wheels, on_middle = (
            Canvas.of(wheels, self._border),
            Canvas.of(middle if closed is None else middle | closed, self._border),
        )
        self._closed = [self._under(places, on_wheels, on_middle) for places in self._places]

    def ways(self, below: str = "middle") -> Bytes:
        """Directions (row, col) as bits in which it may, with ``below``, its "outline", its "wheels" or its "middle",
        on known ground."""
        out = np.zeros((self._closed[0].rows, self._closed[0].cols), dtype=np.uint8)
        if below != "middle" and self._unknown is not None:
            beyond = self._unknown if below == "wheels" else np.zeros_like(self._unknown)
            beyond_wheels = Canvas.of(beyond, self._border, outside=True)
        for (bit, dr, dc), places, closed in zip(STEPS, self._places, self._closed, strict=True):
            if below == "middle" or self._unknown is None:
                mask = closed.mask()
            else:
                mask = self._under(places, beyond_wheels, closed).mask()
                if below == "outline":
                    mask |= widened(self._unknown, *self._half, (dr, dc))
            out |= mask.view(np.uint8) * np.uint8(bit)
        return out ^ np.uint8(ALL)

    @staticmethod
    def _under(places: list[tuple[int, int]], wheels: Canvas, closed: Canvas) -> Canvas:
        """What is closed already, and the cells from which a wheel touches ``wheels``."""
        out = closed.copy()
        for dr, dc in places:
            out.add(wheels, -dr, -dc)
        return out


def _wheels(ahead: float, aside: float, dr: int, dc: int) -> list[tuple[int, int]]:
    """Row and column of the four wheels from the middle, cells, on a way along (dr, dc)."""
    unit = math.hypot(dr, dc)
    corners = ((ahead, aside), (ahead, -aside), (-ahead, aside), (-ahead, -aside))
    return [(round((a * dr + b * dc) / unit), round((a * dc - b * dr) / unit)) for a, b in corners]
