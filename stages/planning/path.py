"""Local path on a risk map (section 4.7), for a vehicle with a width.

Two planners. ``rows`` is the paper's: a path that runs monotonically through the rows across the driving direction,
with all targets of the far row from one sweep (:mod:`rille.stages.planning.row_graph`). ``grid8`` goes in any direction
and reaches what lies beside or behind an obstacle (:mod:`rille.stages.planning.grid8`). ``auto`` takes the first, and
the second where the first reaches no target that was asked for.

The weight of an edge is the absolute height difference between the places where a wheel would stand: means over the
wheel's window, rounded to a step that means nothing to the vehicle. ``grid8`` adds the length, since without rows to
cross a path of no climb could be of any length; ``rows`` a part of what a diagonal is longer (``detour_cost``), else a
path over level ground would follow the noise of its elevations. Caution ground costs a toll.

Footprint. The middle of the vehicle never enters a hazardous or unknown cell; and in the direction of each edge its
wheels keep the margin from ground that is hazardous to a wheel, and its middle keeps it from places where the vehicle
as a whole would tilt or strike (:mod:`rille.stages.planning.configuration_space`). Of unknown ground three
shares are tried: none under its outline, else none under its wheels, else none under its middle. The last happens
where the elevation model is narrower than the vehicle, as beside the cameras; the result says so (``ground``).

Rows lie across the driving direction: the elevation model's own rows where it is heading-aligned (row 0 farthest), or
the rows of a grid turned by a heading or by the line from start to target, filled by nearest neighbour.

An elevation model is fan-shaped and ragged: the first and last rows with a free cell hold a few, which may lead
nowhere. So a start that is not given is, of the free cells within one vehicle length of the first row that lead on,
the one nearest to that row's middle; the target likewise at the last row.

Where no path comes within one vehicle length of the last row, ``auto`` goes, in any direction, as far as connected
ground leads from the first rows: that is a path if it leads at least one vehicle length ahead, and ``ended_by`` says
what ends it. A mission's map, on which the vehicle stands nowhere in particular, may be cut by ground that it cannot
cross: then the connected ground over most rows (of that around the end that is given, if one is) is crossed, and the
length left out is reported (``left_out_m``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.declare import Array, Bundle, Memory, Params, stage
from rille.stages.core.errors import InputError
from rille.stages.facts.planning import PathFacts, RiskFacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import HAZARDOUS, UNKNOWN, check_size
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning import grid8
from rille.stages.planning.path_ground import GROUNDS, Maps, PathMaps, PathPrices, Point, RowGrid
from rille.stages.planning.path_words import GOAL, Route, describe, ending, hazard_words
from rille.stages.planning.row_graph import UNREACHED, Charges, EndCells, Plan, nearest_middle, plan, row_span

__all__ = ["PathParams", "Route", "describe", "find_path", "path_stage"]

Planner = Literal["rows", "grid8", "auto"]
Ends = tuple[Point | None, Point | None]


class PathParams(Params):
    """Parameters of ``path``. ``start`` and ``target`` concern the path over the whole map, not those of each stop."""

    start: Point | None = Field(
        default=None,
        description="start x, y in the world frame [m]; null: the free cell nearest to the middle of the first row",
    )
    target: Point | None = Field(
        default=None,
        description="target x, y in the world frame [m]; null: the free cell nearest to the middle of the last row",
    )
    planner: Planner = Field(
        default="auto",
        description="rows: one step ahead in every row, as in the paper; grid8: any direction; auto: grid8 where rows"
        " do not reach the target, or do not cross the map",
    )
    height_step: float = Field(
        default=0.02, gt=0, le=1, description="smallest height difference that costs [share of max_step]"
    )
    detour_cost: float = Field(
        default=0.2,
        ge=0,
        le=10,
        description="cost of a metre by which planner rows departs from straight ahead [m of climb]; 0: heights alone "
        "count, as in the paper; 0.2: about the rolling resistance of loose ground; grid8 counts its whole length as "
        "climb",
    )
    caution_cost: float = Field(
        default=0.2,
        ge=0,
        le=10,
        description="cost of a metre over caution ground [m of climb]; 0.2: worth a detour of a fifth",
    )
    uncertainty_cost: float = Field(
        default=5.0,
        ge=0,
        le=1000,
        description="cost of a metre over ground [m of climb], times its probability of a hazard; 5: at a probability "
        "of 0.1 worth a detour of a half",
    )
    p_certain_hazard: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="probability of a hazard from which ground is closed, even where no measure exceeds its limit by "
        "enough standard deviations to be a hazard; where this alone closes all paths, the reason says so",
    )


def find_path(
    maps: Maps,
    lattice: Lattice,
    vehicle: Vehicle,
    *,
    heading: Point = (0.0, 1.0),
    ends: Ends = (None, None),
    stretch: bool = False,
    params: PathParams | None = None,
) -> Route:
    """Path over a risk map.

    Parameters
    ----------
    maps : arrays (row, col) of stage ``risk``: ``risk``, ``reason``, ``elevation``; the others serve messages.
    heading : driving direction (dx, dy) in the frame of the lattice; start and target together override it.
    ends : start and target, x, y, metres; None: see the module. Those of ``params`` are not looked at.
    stretch : with no target, cross the connected ground over most rows where no path leads over all of them; else go
        from the first rows as far as connected ground leads.

    Raises
    ------
    InputError
        Start or target lies outside the map, in a hazard or on unknown ground; or rows are to lie across the heading,
        and it has no direction.
    DegenerateError
        The vehicle is wider than the map.
    """
    search = _Search(maps, lattice, vehicle, ends, params or PathParams())
    check_size(vehicle, lattice.shape, lattice.cell)
    for name, point in zip(("start", "target"), ends, strict=True):
        if point is not None:
            _check_end(maps, lattice, vehicle, name, point)
    start, target = ends[0], ends[1]
    if start is not None and target is not None:
        heading = (target[0] - start[0], target[1] - start[1])
    route = search.route(heading, stretch=stretch)
    limit = search.params.p_certain_hazard
    if len(route.cells):
        return replace(route, ended_by=GOAL if target is not None else ending(route, maps, lattice, vehicle, limit))
    # A limit that closed nothing cannot be the reason.
    if limit >= 1 or "p_hazard" not in maps:
        return route
    # Searched once more without the limit, only to name the figure that would open a way.
    without = replace(search, params=search.params.model_copy(update={"p_certain_hazard": 1.0}))
    other = without.route(heading, stretch=stretch)
    if not len(other.cells):
        return route
    at = tuple(np.rint(lattice.index(other.xyz[:, :2])).astype(np.int64).T)
    # Rounded up to three digits, so that a path with the printed figure as its limit exists.
    chance = math.ceil(1e3 * float(np.nanmax(maps["p_hazard"][at])) - 1e-3) / 1e3
    reason = (
        f"ground with a p_hazard above path.p_certain_hazard {limit:g} closes every path; without it one "
        f"leads over ground of up to {chance:.3g}: raise path.p_certain_hazard to that to take it"
    )
    return replace(route, plan=replace(route.plan, reason=reason))


@dataclass(frozen=True)
class _Search:
    """Arguments of :func:`find_path` that both planners read."""

    maps: Maps
    lattice: Lattice
    vehicle: Vehicle
    ends: Ends
    params: PathParams

    def route(self, heading: Point, *, stretch: bool) -> Route:
        """Path of the planner that is asked for; ``auto``: by rows, else in any direction."""
        before = None if self.params.planner == "grid8" else self.by_rows(heading)
        if before is not None and (self.params.planner == "rows" or len(before.cells)):
            return before
        return self.by_grid(before, near=not stretch and self.ends[1] is None)

    def ground(self, grid: RowGrid) -> PathMaps:
        """The maps on a grid."""
        p = self.params
        unit = p.height_step * self.vehicle.max_step
        prices = PathPrices(unit, p.caution_cost, p.uncertainty_cost, p.p_certain_hazard)
        return PathMaps(self.maps, self.lattice, grid, self.vehicle, prices)

    @property
    def length_cells(self) -> int:
        """The vehicle's length from the front of the front wheels to the back of the rear ones, cells."""
        return math.ceil(2.0 * self.vehicle.half_length / self.lattice.cell)

    def by_rows(self, heading: Point) -> Route:
        """Path monotone in rows across a heading."""
        ground = self.ground(RowGrid.over(self.lattice, heading))
        grid, span = ground.grid, row_span(~ground.closed)
        ends = EndCells(*(None if point is None else grid.nearest(point) for point in self.ends))
        # A diagonal is longer than a row is wide; the rows themselves every path crosses.
        sideways = round(self.params.detour_cost * (grid8.DIAGONAL - 1) * grid.cell / ground.unit)
        for name in GROUNDS:
            charges = Charges(ground.toll, sideways)
            planned = plan(ground.height, ground.ways(name), self.length_cells, ends, span, charges)
            if len(planned.cells):
                break
        cost = ground.metres(planned.cost, UNREACHED, grid.rows)
        return Route(planned.cells, ground.xyz(planned.cells), planned, grid, "rows", name, cost, span or (0, 0))

    def by_grid(self, before: Route | None, *, near: bool) -> Route:
        """Path in any direction; ``near``: from the first rows, or the start, as far as connected ground leads."""
        grid = before.grid if near and before is not None else RowGrid.over(self.lattice, (0.0, 1.0))
        ground = self.ground(grid)
        # A step costs its length in units of height: else a path of no climb could be of any length.
        unit = max(1, round(self.lattice.cell / ground.unit))
        ends = EndCells(*(None if point is None else grid.index(point) for point in self.ends))
        length, span = self.length_cells, row_span(~ground.closed) or (0, 0)
        if near and ends.start is None:
            ground.first_row = max(span[1] - min(length, (span[1] - span[0]) // 4), 0)
        nothing = np.empty((0, 2), dtype=np.int64)
        cells, cost, name = nothing, np.full(ground.height.shape, UNREACHED), GROUNDS[0]
        # With a free end a stricter ground would always find some path, on however small a part.
        for name in GROUNDS if None not in ends else ground.by_worth(ends.start or ends.target):
            ways = ground.ways(name)
            first, last = _free_ends(ground, name, ends, far=near)
            if first is None or last is None or not ways[first] or not ways[last]:
                continue
            if ends == (None, None) and first[0] - last[0] < length:
                continue
            cost, step = grid8.cost_to_go(ground.height, ways, last, first, unit, ground.toll)
            if cost[first] < UNREACHED:
                cells = grid8.trace(step, first)
                break
        free = "no ground that is known and safe leads a vehicle's length ahead"
        reason = free if None in ends else "start and target are not connected by ground that the vehicle may cross"
        # A plan by rows of a turned grid is in rows that are none of this grid.
        same = before is not None and before.grid == grid
        base = before.plan if before is not None and same else Plan(nothing, cost, np.zeros(grid.cols, dtype=bool), 0)
        planned = replace(base, cells=cells, cost=cost, reachable=np.zeros(grid.cols, dtype=bool), reason=reason)
        if len(cells):
            planned = replace(planned, target_row=int(cells[-1, 0]), blocking_row=None, reason="")
            planned.reachable[cells[-1, 1]] = True
        return Route(cells, ground.xyz(cells), planned, grid, "grid8", name, ground.metres(cost, UNREACHED), span)


def _check_end(maps: Maps, lattice: Lattice, vehicle: Vehicle, name: str, point: Point) -> None:
    """Refuse a start or target outside the map, in a hazard or on unknown ground, with the figure that decides."""
    row, col = (int(v) for v in np.rint(lattice.index(point)))
    where = f"path.{name} ({point[0]:g}, {point[1]:g}) m"
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            "RIL-406",
            f"{where} is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )
    kind = maps["risk"][row, col]
    if kind == UNKNOWN:
        free = np.argwhere(maps["risk"] < HAZARDOUS)
        away = (
            f", the nearest ground to drive on is {_away(free, row, col, lattice.cell):.3g} m away" if len(free) else ""
        )
        raise InputError("RIL-407", f"{where} lies on unknown ground{away}", remedy=f"choose another {name}")
    if kind == HAZARDOUS:
        raise InputError(
            "RIL-408",
            f"{where} lies in a hazard: {hazard_words(maps, (row, col), vehicle)}",
            remedy=f"choose another {name}",
        )


def _away(cells: NDArray[np.intp], row: int, col: int, cell: float) -> float:
    return float(np.hypot(cells[:, 0] - row, cells[:, 1] - col).min()) * cell


def _free_ends(ground: PathMaps, below: str, ends: EndCells, *, far: bool) -> EndCells:
    """Ends as given; else, of the connected ground over most rows (that of the end that is given), the cell nearest to
    the middle of the first row, and the one nearest to that of the last; ``far``: to that of its own last one, in it.

    Parameters
    ----------
    below : of :data:`rille.stages.planning.path_ground.GROUNDS`, the part that stays on known ground.
    """
    span = row_span(ground.ways(below) > 0)
    if span is None:
        return EndCells()
    if None not in ends:
        return ends
    number, spans = ground.parts(below)
    given = ends.start or ends.target
    part = int(number[given]) if given is not None else int(np.argmax(spans[:, 1] - spans[:, 0]))
    cells = number == part
    if part < 0 or not cells.any():
        return ends
    row = int(spans[part, 0]) if far else span[0]
    ahead, behind = (cells[: row + 1], ground.first_row) if far else (cells, 0)
    r, c = nearest_middle(cells[behind:], span[1] - behind)
    return EndCells(ends.start or (r + behind, c), ends.target or nearest_middle(ahead, row))


@stage(
    "path",
    version=3,
    outputs=[
        Array("path", ("vertex", "xyz"), "float64", "m", "vertices from start to target; z = mean under a wheel"),
        Array("cost_to_go", ("row", "col"), "float32", "m", "rows: cost from the start; grid8: to the target", "nan"),
        Array("reachable", ("col",), "uint8", "1", "1 where the target row can be reached"),
    ],
    memory=Memory(factor=6.0, lower=("locus.cell_size",)),
)
def path_stage(
    params: PathParams, risk: Bundle[RiskFacts], *, use: str | None = None, heading: Sequence[float] = (0.0, 1.0)
) -> Bundle[PathFacts]:
    """Path of least height differences for a vehicle with a width: monotone in the rows, or any direction."""
    lattice, vehicle = Lattice.from_dict(risk.meta["lattice"]), Vehicle.model_validate(risk.meta["vehicle"])
    local = use == "local"
    dx, dy = heading
    maps = {name: np.asarray(risk[name]) for name in risk.arrays}
    ends = (None, None) if local else (params.start, params.target)
    route = find_path(maps, lattice, vehicle, heading=(dx, dy), ends=ends, stretch=not local, params=params)
    arrays: dict[str, NDArray[Any]] = {
        "path": route.xyz,
        "cost_to_go": route.cost,
        "reachable": route.plan.reachable.astype(np.uint8),
    }
    facts = describe(route, maps, lattice, vehicle) | {"frame": risk.meta.get("frame", "local")}
    return Bundle(arrays, cast(PathFacts, facts))
