"""Configuration space of a vehicle on a raster: the places where it may stand in each of four directions.

A raster path moves along rows, columns and diagonals, and a vehicle covers the same ground forwards and backwards, so
there are four directions. Hazards to a wheel were found in a window as large as the wheel, so only the centre of the
wheel must avoid them. The ground between the wheels is judged by the clearance of the belly.
"""

from __future__ import annotations

import math

from rille.stages.core.arrays import Bools, Bytes
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import octagon
from rille.stages.numeric.packed import Canvas, codes

STRAIGHT, RIGHT, ACROSS, LEFT = 1, 2, 4, 8
"""Bits of the directions: along columns; to row 0 and greater columns; along rows; to row 0 and smaller columns."""
ALL = STRAIGHT | RIGHT | ACROSS | LEFT
STEPS = ((STRAIGHT, -1, 0), (RIGHT, -1, 1), (ACROSS, 0, 1), (LEFT, -1, -1))
"""Bit, row and column of one step in each direction."""


def _sides(half_length: float, half_width: float, step: tuple[int, int]) -> list[int]:
    """Steps along and across that cover a rectangle."""
    # A size that is a whole number of steps may come out a rounding above it, and must not grow by a step.
    return [max(0, math.ceil(v / math.hypot(*step) - 1e-9)) for v in (half_length, half_width)]


def _reach(half_length: float, half_width: float, step: tuple[int, int]) -> int:
    """Border that a canvas needs for :func:`_widen`, cells."""
    return sum(_sides(half_length, half_width, step)) + 1


def _widen(canvas: Canvas, half_length: float, half_width: float, step: tuple[int, int]) -> None:
    """Set the cells from which a rectangle that is aligned with ``step`` (row, col) and centred there touches the mask.

    ``half_length``, ``half_width``: cells, of the rectangle along and across the step.
    """
    along, across = step, (step[1], -step[0])
    for n, (dr, dc) in zip(_sides(half_length, half_width, step), (along, across), strict=True):
        canvas.spread(n, dr, dc)
    if step[0] and step[1]:
        # a diagonal line leaves every other cell out: a square of two closes them
        canvas.spread(1, 0, 1)


def _grow(canvas: Canvas, reach: float) -> None:
    """Set the cells within ``reach`` cells (at most the border) of the mask: an octagon that holds the circle."""
    # Rounded up: a margin that is a fraction of a cell too wide closes a way, one too narrow touches a hazard.
    side, diagonal = octagon(math.ceil(reach - 1e-9))
    for n, dr, dc in ((side, 0, 1), (side, 1, 0), (diagonal, 1, 1), (diagonal, 1, -1)):
        canvas.spread(n, dr, dc)


class FreePlaces:
    """Where the vehicle may stand: its wheels and its middle laid over hazards once, for whatever is below it."""

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
        unknown : cells that the outline (without margin) or the wheels may not touch, where that is asked for; what
            lies outside the map counts as such. None: none, and nothing outside.
        closed : cells on which its middle may not be, without a margin.
        """
        self._half = vehicle.half_length / cell, vehicle.half_width / cell
        ahead, aside = 0.5 * vehicle.wheel_base / cell, 0.5 * vehicle.track / cell
        self._places = [_wheels(ahead, aside, dr, dc) for _, dr, dc in STEPS]
        reaches = [_reach(*self._half, (dr, dc)) for _, dr, dc in STEPS]
        margin = vehicle.margin / cell
        offsets = (abs(v) for four in self._places for at in four for v in at)
        # One border that holds whatever is spread or moved below, for canvases are joined only if their borders are
        # alike.
        self._border = max(*reaches, *offsets, math.ceil(margin - 1e-9))
        self._unknown = unknown
        on_wheels, on_middle = (Canvas.of(mask, self._border) for mask in (wheel_hazard, body_hazard))
        for canvas in (on_wheels, on_middle):
            _grow(canvas, margin)
            # The margin of a hazard may reach past the map; a wheel there is closed, if at all, as unknown ground.
            canvas.clear_border()
        if closed is not None:
            on_middle.join(Canvas.of(closed, self._border))
        self._closed = [self._under(places, on_wheels, on_middle) for places in self._places]

    def ways(self, below: str = "middle") -> Bytes:
        """Directions (row, col) as bits in which it may, with ``below``, its "outline", its "wheels" or its "middle",
        on known ground."""
        if below == "middle" or self._unknown is None:
            found = self._closed
        else:
            unknown = Canvas.of(self._unknown, self._border, outside=True)
            # The outline is spread below, and covers the wheels; they only must not leave the map.
            beyond = unknown if below == "wheels" else Canvas.outside(self._unknown.shape, self._border)
            found = [
                self._under(places, beyond, closed) for places, closed in zip(self._places, self._closed, strict=True)
            ]
            if below == "outline":
                for (_, dr, dc), canvas in zip(STEPS, found, strict=True):
                    outline = unknown.copy()
                    _widen(outline, *self._half, (dr, dc))
                    canvas.join(outline)
        return codes(found, [bit for bit, _, _ in STEPS])

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
    # Rows grow backwards and columns to the right, so that the vehicle's left is (-dc, dr) for a step (dr, dc).
    return [(round((a * dr + b * dc) / unit), round((a * dc - b * dr) / unit)) for a, b in corners]
