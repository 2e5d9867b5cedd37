"""A risk map on the grid of a planner: where the vehicle may stand, what a step costs, which ground is connected.

The rows of the grid lie across the driving direction, whichever way that points on the lattice of the elevations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.core.errors import InputError
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BODY_BITS, WHEEL_BITS
from rille.stages.hazard.risk import CAUTION, HAZARDOUS, UNKNOWN, window_cells
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.windows import window_mean
from rille.stages.planning import grid8
from rille.stages.planning.configuration_space import FreePlaces

Ints = NDArray[np.integer[Any]]
Maps = Mapping[str, NDArray[Any]]
Point = tuple[float, float]

GROUNDS = ("outline", "wheels", "middle")
"""Part of the vehicle that stays on known ground: tried in this order."""

WORTH = {"outline": 1.0, "wheels": 0.75, "middle": 0.5}
"""Weight of a row that a path crosses while this part of the vehicle stays on known ground.

Unknown ground under the belly may touch it, so the weight is lower by a quarter; unknown ground under a wheel may tip
the vehicle, so it is lower by half.
"""

MIN_UNITS_PER_CELL = 16
"""Units of cost of a cell's length, at least: with fewer, prices of a metre would round to nothing on fine cells."""


@dataclass(frozen=True)
class RowGrid:
    """Grid whose rows lie across a heading, row 0 farthest ahead; cell centres are at multiples of the cell.

    ``ahead`` is the heading as a unit vector; row 0, column 0 lies ``i0`` cells right and ``j0`` cells ahead of (0, 0).
    """

    ahead: Point
    i0: int
    j0: int
    cell: float
    rows: int
    cols: int

    @staticmethod
    def over(lattice: Lattice, heading: Point) -> RowGrid:
        """The grid that covers a lattice; with heading (0, 1) the lattice itself."""
        norm = math.hypot(*heading)
        if not (math.isfinite(norm) and norm > 0):
            raise InputError(
                "RIL-434", f"heading {heading} has no direction", remedy="give start and target that differ"
            )
        dx, dy = heading[0] / norm, heading[1] / norm
        x, y = lattice.xs()[[0, -1, 0, -1]], lattice.ys()[[0, 0, -1, -1]]
        right, ahead = (x * dy - y * dx) / lattice.cell, (x * dx + y * dy) / lattice.cell
        # A turned lattice's corners are rounded: a centre on the very edge belongs to the grid.
        i0, i1 = math.ceil(right.min() - 1e-6), math.floor(right.max() + 1e-6)
        j0, j1 = math.floor(ahead.max() + 1e-6), math.ceil(ahead.min() - 1e-6)
        return RowGrid((dx, dy), i0, j0, lattice.cell, max(j0 - j1, 0) + 1, max(i1 - i0, 0) + 1)

    def xy(self, row: NDArray[Any], col: NDArray[Any]) -> Floats:
        """Cell centres (..., 2), metres."""
        right, ahead = (self.i0 + col) * self.cell, (self.j0 - row) * self.cell
        dx, dy = self.ahead
        return np.stack([right * dy + ahead * dx, ahead * dy - right * dx], axis=-1)

    def index(self, point: Point) -> tuple[int, int]:
        """Row and column of the cell that holds a point, metres; it may be outside."""
        dx, dy = self.ahead
        right, ahead = point[0] * dy - point[1] * dx, point[0] * dx + point[1] * dy
        return round(self.j0 - ahead / self.cell), round(right / self.cell - self.i0)

    def nearest(self, point: Point) -> tuple[int, int]:
        """Row and column of the cell nearest to a point, metres: a turned grid leaves out the tips of the lattice."""
        row, col = self.index(point)
        return min(max(row, 0), self.rows - 1), min(max(col, 0), self.cols - 1)

    def sample(self, lattice: Lattice, array: NDArray[Any], outside: float) -> NDArray[Any]:
        """An array on the lattice brought to this grid by nearest neighbour."""
        # No copy where nothing is turned, which is every path of a stop.
        if self.ahead == (0.0, 1.0) and (self.i0, self.j0) == (lattice.i0, lattice.j0) and array.shape == self._shape:
            return array
        row, col = np.indices(self._shape)
        at = np.rint(lattice.index(self.xy(row, col))).astype(np.int64)
        inside = ((at >= 0) & (at < lattice.shape)).all(axis=-1)
        out = np.full((self.rows, self.cols), outside, dtype=array.dtype)
        out[inside] = array[at[inside, 0], at[inside, 1]]
        return out

    @property
    def _shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self) | {"ahead": list(self.ahead)}


class PathPrices(NamedTuple):
    """Terms of a path's cost.

    ``unit``: height [m] that costs 1; ``caution``: cost of a metre of caution ground [m of climb]; ``uncertainty``:
    cost of a metre of ground [m of climb], times its probability of a hazard; ``p_certain``: probability of a hazard
    above which ground is closed.
    """

    unit: float
    caution: float
    uncertainty: float = 0.0
    p_certain: float = 1.0


class PathMaps:
    """The maps on a grid.

    ``unit``: metres of height that cost one, the unit of the prices or a part of it; ``stand`` (row, col) float32 m,
    mean height under a wheel; ``height`` the same in units, 0 where closed; ``toll`` (row, col) units, of caution and
    doubtful ground; ``closed`` (row, col): where the vehicle's middle may not be. ``first_row``: connected ground that
    does not reach back to this row is left out.
    """

    def __init__(
        self,
        maps: Maps,
        lattice: Lattice,
        grid: RowGrid,
        vehicle: Vehicle,
        prices: PathPrices,
    ) -> None:
        """
        Parameters
        ----------
        maps : arrays (row, col) of stage ``risk`` on ``lattice``: ``risk``, ``reason``, ``elevation`` and, where
            uncertainty costs, ``p_hazard``.
        """
        # Heights are rounded to the unit of the prices; costs are counted in parts of it where cells are fine.
        parts = max(1, math.ceil(MIN_UNITS_PER_CELL * prices.unit / grid.cell))
        self.grid, self.unit = grid, prices.unit / parts
        risk = grid.sample(lattice, maps["risk"], UNKNOWN)
        reason = grid.sample(lattice, maps["reason"], 0)
        chance = grid.sample(lattice, maps["p_hazard"], np.nan) if "p_hazard" in maps else np.zeros(1, np.float32)
        mean = window_mean(maps["elevation"], window_cells(vehicle.wheel_diameter, lattice.cell))
        self.stand = grid.sample(lattice, mean, np.nan)
        # A limit of 1 is none, even where rounding lifts a probability above it.
        limit = np.float32(prices.p_certain if prices.p_certain < 1 else np.inf)
        self.closed = (risk >= HAZARDOUS) | (chance > limit)
        height = np.where(self.closed, np.float32(0), self.stand) / np.float32(prices.unit)
        self.height: Ints = parts * np.rint(height).astype(np.int64)
        caution, doubt = (price * grid.cell / self.unit for price in (prices.caution, prices.uncertainty))
        # NaN, which is unknown and closed, costs nothing.
        self.toll: Ints = np.rint(np.float32(doubt) * np.nan_to_num(chance)).astype(np.int64)
        self.toll = self.toll + np.where(risk == CAUTION, round(caution), 0)
        hazard = risk == HAZARDOUS
        wheels, body = (hazard & (reason & bits != 0) for bits in (WHEEL_BITS, BODY_BITS))
        self._stand = FreePlaces(wheels, body, vehicle, grid.cell, risk == UNKNOWN, self.closed)
        self._ways: dict[str, Bytes] = {}
        self._parts: dict[str, tuple[NDArray[np.int32], Ints]] = {}
        self.first_row = 0

    def ways(self, below: str) -> Bytes:
        """Directions (row, col) as bits with ``below``, one of :data:`GROUNDS`, on the known."""
        if below not in self._ways:
            self._ways[below] = self._stand.ways(below)
        return self._ways[below]

    def parts(self, below: str) -> tuple[NDArray[np.int32], Ints]:
        """Connected ground, see :func:`rille.stages.planning.grid8.parts`."""
        if below not in self._parts:
            number, spans = grid8.parts(self.ways(below))
            ahead = spans[:, 1] < self.first_row
            number[np.isin(number, np.flatnonzero(ahead))] = -1
            self._parts[below] = number, np.where(ahead[:, None], 0, spans)
        return self._parts[below]

    def by_worth(self, at: tuple[int, int] | None = None) -> list[str]:
        """Sort :data:`GROUNDS` by rows covered by connected ground, weighted by :data:`WORTH`; most first.

        ``at``: a cell (row, col); that of the ground around it alone counts.
        """

        def worth(name: str) -> float:
            number, spans = self.parts(name)
            if at is not None:
                spans = spans[number[at] : number[at] + 1] if number[at] >= 0 else spans[:0]
            return WORTH[name] * int((spans[:, 1] - spans[:, 0]).max(initial=0))

        return sorted(GROUNDS, key=worth, reverse=True)

    def metres(self, cost: Ints, unreached: int, each: int = 1) -> Floats32:
        """A cost (row, col) of which ``each`` are a unit, rounded down to units, in metres; NaN where not reached."""
        # Whole numbers far below 2^53, divided as floats: a division of integers takes several times as long.
        return np.where(cost < unreached, np.floor(cost / each) * self.unit, np.nan).astype(np.float32)

    def xyz(self, cells: NDArray[np.int64]) -> Floats:
        """Points (vertex, 3), metres, of cells (vertex, 2)."""
        row, col = cells[:, 0], cells[:, 1]
        return np.column_stack([self.grid.xy(row, col), self.stand[row, col]])
