"""A risk map as a planner meets it: where the vehicle may stand, what a step costs, which ground is connected."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bools, Bytes, Floats
from rille.stages.core.declare import Params
from rille.stages.core.errors import InputError
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BODY_BITS, WHEEL_BITS
from rille.stages.hazard.risk import CAUTION, HAZARDOUS, UNKNOWN, window_cells
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.windows import window_mean
from rille.stages.planning.configuration_space import FreePlaces
from rille.stages.planning.grid8 import parts
from rille.stages.planning.row_graph import NEIGHBOURS, Cell, GridCosts, Ints

Maps = Mapping[str, NDArray[Any]]
Point = tuple[float, float]

GROUNDS = {"outline": 1.0, "wheels": 0.75, "middle": 0.5}
"""Part of the vehicle that stays on known ground, from the strictest on, with the weight of a row that is crossed so.

Unknown ground under the belly may touch it, so the weight is lower by a quarter; unknown ground under a wheel may tip
the vehicle, so it is lower by half.
"""
COST_UNIT_M = 1e-6
"""m of climb that cost one."""
Planner = Literal["rows", "grid8", "auto"]


class PathParams(Params):
    """Parameters of ``path``. ``start`` and ``target`` concern the path over the whole map, not those of each stop.

    Attributes
    ----------
    start : start x, y, world frame [m]; not set: within a vehicle's length of the first row, or where the rig began, if
        that is farther up the map.
    target : target x, y, world frame [m]; not set: as far as rows or connected ground lead.
    planner : rows: one step ahead in every row, as in the paper; grid8: any direction; auto: grid8 where rows do not
        reach the target, or do not cross the map.
    detour_cost : cost of a metre by which planner rows departs from straight ahead [m of climb]; 0: heights alone
        count, as in the paper; 0.2: about the rolling resistance of loose ground; grid8 counts its length as climb.
    caution_cost : cost of a metre of caution ground [m of climb]; 0.2: worth a detour of a fifth.
    uncertainty_cost : cost of a metre [m of climb], times its probability of a hazard; 5: at 0.1 worth a detour of
        half.
    p_certain_hazard : probability of a hazard from which ground is closed, though no measure exceeds its limit by
        enough standard deviations; where this alone closes all paths, the reason says so.
    """

    start: Point | None = None
    target: Point | None = None
    planner: Planner = "auto"
    detour_cost: float = Field(0.2, ge=0, le=10)
    caution_cost: float = Field(0.2, ge=0, le=10)
    uncertainty_cost: float = Field(5.0, ge=0, le=1000)
    p_certain_hazard: float = Field(0.1, gt=0, le=1)


def cell_of(lattice: Lattice, point: Sequence[float] | Floats) -> Cell:
    """Row and column of the cell that holds a point x, y, m; they may lie outside of the lattice."""
    row, col = np.rint(lattice.index(point)).astype(np.int64).tolist()
    return row, col


def cell_within(lattice: Lattice, name: str, point: Sequence[float]) -> Cell:
    """The same; a point, called ``name``, outside of the lattice is refused."""
    row, col = cell_of(lattice, point)
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            "RIL-406",
            f"{name} ({point[0]:g}, {point[1]:g}) m is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )
    return row, col


class PathMaps:
    """The maps of a planner.

    ``stand`` (row, col) float32 m, mean height under a wheel; ``height`` the same in numbers of :data:`COST_UNIT_M`, 0
    where closed; ``toll`` (row, col) in the same unit, of entering caution and doubtful ground; ``closed`` (row, col):
    where the vehicle's middle may not be.
    """

    def __init__(self, maps: Maps, lattice: Lattice, vehicle: Vehicle, params: PathParams) -> None:
        """
        Parameters
        ----------
        maps : arrays (row, col) of stage ``risk`` on ``lattice``: ``risk``, ``reason``, ``elevation`` and, where
            uncertainty costs, ``p_hazard``.
        """
        self.lattice, risk = lattice, maps["risk"]
        chance = maps["p_hazard"] if "p_hazard" in maps else np.zeros(1, np.float32)
        self.stand = window_mean(maps["elevation"], window_cells(vehicle.wheel_diameter, lattice.cell))
        self.closed = (risk >= HAZARDOUS) | (chance > np.float32(params.p_certain_hazard))
        # Smaller height differences cost nothing.
        step = 0.02 * vehicle.max_step
        steps = np.rint(np.where(self.closed, np.float32(0), self.stand) / np.float32(step))
        self.height: Ints = np.rint(steps.astype(np.float64) * (step / COST_UNIT_M)).astype(np.int64)
        caution, doubt = (
            price * lattice.cell / COST_UNIT_M for price in (params.caution_cost, params.uncertainty_cost)
        )
        # NaN, which is unknown and closed, costs nothing.
        self.toll: Ints = np.rint(np.float32(doubt) * np.nan_to_num(chance)).astype(np.int64)
        self.toll = self.toll + np.where(risk == CAUTION, round(caution), 0)
        hazard = risk == HAZARDOUS
        wheels, body = (hazard & (maps["reason"] & bits != 0) for bits in (WHEEL_BITS, BODY_BITS))
        self._places = FreePlaces(wheels, body, vehicle, lattice.cell, risk == UNKNOWN, self.closed)
        self._ways: dict[str, Bytes] = {}
        self._parts: dict[str, tuple[NDArray[np.int32], Ints]] = {}

    def ways(self, below: str) -> Bytes:
        """Directions (row, col), as bits, in which it may stand with ``below`` (:data:`GROUNDS`) on known ground."""
        if below not in self._ways:
            self._ways[below] = self._places.ways(below)
        return self._ways[below]

    def terrain(self, below: str, price: float, free: float) -> GridCosts:
        """Costs of steps on a ground; a metre of way costs ``price`` metres of climb, but ``free`` cells of each step
        cost nothing."""
        cells = np.array([math.hypot(dr, dc) - free for dr, dc, _ in NEIGHBOURS])
        lengths = np.rint(price * cells * self.lattice.cell / COST_UNIT_M).astype(np.int64)
        return GridCosts(self.height, self.ways(below), self.toll, lengths)

    def xyz(self, cells: Ints) -> Floats:
        """Points (vertex, 3), metres, of cells (vertex, 2)."""
        row, col = cells[:, 0], cells[:, 1]
        return np.column_stack([self.lattice.xs()[col], self.lattice.ys()[row], self.stand[row, col]])

    def connected(self, below: str, behind: int, at: Cell | None) -> tuple[Bools, float]:
        """Connected ground (row, col) around a cell ``at``, or without one that which reaches back to row ``behind``
        and covers most rows; and its worth, rows times the weight of :data:`GROUNDS`."""
        if below not in self._parts:
            self._parts[below] = parts(self.ways(below))
        number, spans = self._parts[below]
        rows = np.where(spans[:, 1] < behind, 0, spans[:, 1] - spans[:, 0] + 1)
        part = int(number[at]) if at is not None else int(np.argmax(rows)) if len(rows) else -1
        worth = GROUNDS[below] * int(rows[part]) if part >= 0 else 0.0
        return (number == part) & (worth > 0), worth
