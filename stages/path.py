"""Local path on a risk map (section 4.7), for a vehicle with a width.

Two planners. ``rows`` is the paper's: a path that runs monotonically through the rows across the driving direction,
with all targets of the far row from one sweep (:mod:`stages.row_graph`). ``grid8`` goes in any direction and reaches
what lies beside or behind an obstacle (:mod:`stages.grid8`). ``auto`` takes the first, and the second where the first
reaches no target that was asked for.

The weight of an edge is the absolute height difference between the places where a wheel would stand: means over the
wheel's window, rounded to a step that means nothing to the vehicle. ``grid8`` adds the length, since without rows to
cross a path of no climb could be of any length. Caution ground costs a toll.

Footprint. The middle of the vehicle never enters a hazardous or unknown cell; and in the direction of each edge its
wheels keep the margin from ground that is hazardous to a wheel, and its middle keeps it from places where the vehicle
as a whole would tilt or strike (:mod:`stages.swept`). Of unknown ground three shares are tried: none under its
outline, else none under its wheels, else none under its middle. The last happens where the elevation model is
narrower than the vehicle, as beside the cameras; the result says so (``ground``).

Rows lie across the driving direction: the elevation model's own rows where it is heading-aligned (row 0 farthest), or
the rows of a grid turned by a heading or by the line from start to target, filled by nearest neighbour.

An elevation model is fan-shaped and ragged: the first and last rows with a free cell hold a few, which may lead
nowhere. So a start that is not given is, of the free cells within one vehicle length of the first row that lead on,
the one nearest to that row's middle; the target likewise at the last row. A path counts as found when it comes within
one vehicle length of the last row. A mission's map, on which the vehicle stands nowhere in particular, may be cut by
ground that it cannot cross: then the connected ground over most rows is crossed, in any direction, and what is left out
is told (``left_out_m``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stages import grid8
from stages.declare import Array, Bundle, Inputs, Memory, Params, Stage
from stages.errors import InputError
from stages.hazards import BITS
from stages.lattice import Lattice
from stages.risk import CAUTION, HAZARDOUS, UNKNOWN, check_size, window_cells
from stages.row_graph import UNREACHED, Plan, plan, row_span
from stages.row_grid import RowGrid
from stages.swept import standing
from stages.vehicle import Vehicle
from stages.windows import window_mean

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Point = tuple[float, float]
Maps = Mapping[str, NDArray[Any]]
Planner = Literal["rows", "grid8", "auto"]

GROUNDS = ("outline", "wheels", "middle")
"""What of the vehicle stays on known ground, as tried in turn."""

MOST = 0.5
"""Share of the rows: a path that stays clearer of unknown ground is worth half of its length."""

WHEEL_BITS = np.uint16(BITS["inclination"] | BITS["range"] | BITS["step"] | BITS["roughness"])
"""Hazards to a wheel on the cell; the other ones are to the vehicle with its middle there."""

WORDS = {
    "inclination": ("inclination", "max_slope_deg", "deg"),
    "step": ("step", "max_step", "m"),
    "roughness": ("roughness", "max_roughness", "m"),
    "slope": ("slope of the footprint", "max_slope_deg", "deg"),
    "tilt": ("tilt", "max_slope_deg", "deg"),
    "range": ("height range", "clearance", "m"),
    "rise": ("rise under the belly", "clearance", "m"),
}
"""Measure: in words, the vehicle's limit, unit."""


class PathParams(Params):
    """Parameters of ``path``. ``start`` and ``target`` concern the path over the whole map, not those of each stop."""

    start: Point | None = Field(
        default=None,
        description="m; x, y in the world frame; not set: the free cell nearest to the middle of the first row",
    )
    target: Point | None = Field(
        default=None,
        description="m; x, y in the world frame; not set: the free cell nearest to the middle of the last row",
    )
    planner: Planner = Field(
        default="auto",
        description="rows: ahead in every row, as in the paper; grid8: any direction; auto: grid8 where rows do not "
        "reach the target, or do not lead over the map of a mission",
    )
    height_step: float = Field(
        default=0.02, gt=0, le=1, description="share of max_step; smaller height differences count as none"
    )
    caution: float = Field(
        default=0.2, ge=0, le=10, description="m of climb that a metre of caution ground is worth: a detour of a fifth"
    )


@dataclass(frozen=True)
class Route:
    """A path and how it was found.

    ``cells`` (vertex, 2) on ``grid`` and ``xyz`` (vertex, 3) metres, z the mean height under a wheel, both empty where
    there is none; ``plan`` of the row graph, ``planner`` that gave the path, ``ground`` one of :data:`GROUNDS`;
    ``cost`` (row, col) metres: from the start by rows, to the target by grid8; NaN where not reached.
    ``span``: farthest and nearest row of the grid that are free somewhere.
    """

    cells: Ints
    xyz: Floats
    plan: Plan
    grid: RowGrid
    planner: str
    ground: str
    cost: NDArray[np.float32]
    span: tuple[int, int]


def find_path(
    maps: Maps,
    lattice: Lattice,
    vehicle: Vehicle,
    *,
    heading: Point = (0.0, 1.0),
    start: Point | None = None,
    target: Point | None = None,
    stretch: bool = False,
    params: PathParams | None = None,
) -> Route:
    """Path over a risk map.

    Parameters
    ----------
    maps : arrays (row, col) of stage ``risk``: ``risk``, ``reason``, ``elevation``; the others serve messages.
    heading : driving direction (dx, dy) in the frame of the lattice; start and target together override it.
    start, target : x, y, metres; None: see the module. Those of ``params`` are not looked at.
    stretch : with neither of them, cross the connected ground over most rows where no path leads over all of them.

    Raises
    ------
    InputError
        Start or target lies outside the map, in a hazard or on unknown ground, or they are the same cell; or the
        vehicle is wider than the map.
    """
    p = params or PathParams()
    check_size(vehicle, lattice.shape, lattice.cell)
    for name, point in (("start", start), ("target", target)):
        if point is not None:
            check_end(maps, lattice, vehicle, name, point)
    if start is not None and target is not None:
        heading = (target[0] - start[0], target[1] - start[1])
    found = None
    if p.planner != "grid8":
        found = _by_rows(maps, lattice, vehicle, heading, start, target, p)
    if p.planner == "grid8" or (
        p.planner == "auto"
        and found is not None
        and not len(found.cells)
        and (target is not None or (stretch and start is None))
    ):
        found = _by_grid(maps, lattice, vehicle, start, target, p, found)
    assert found is not None
    return found


class _Ground:
    """The maps on a grid, and where the vehicle may stand there."""

    def __init__(self, maps: Maps, lattice: Lattice, grid: RowGrid, vehicle: Vehicle, p: PathParams) -> None:
        self.grid, self.vehicle = grid, vehicle
        self.unit = p.height_step * vehicle.max_step
        self.risk = grid.sample(lattice, maps["risk"], UNKNOWN)
        hazard = self.risk == HAZARDOUS
        reason = grid.sample(lattice, maps["reason"], 0)
        self.closed = hazard | (self.risk == UNKNOWN)
        self.wheel_hazard = hazard & ((reason & WHEEL_BITS) > 0)
        self.body_hazard = hazard & ((reason & np.uint16(sum(BITS.values()) - int(WHEEL_BITS))) > 0)
        mean = window_mean(maps["elevation"], window_cells(vehicle.wheel_diameter, lattice.cell))
        self.stand = grid.sample(lattice, mean, np.nan)
        self.height = np.rint(np.where(self.closed, 0.0, self.stand) / self.unit).astype(np.int64)
        self.toll = (self.risk == CAUTION) * np.int64(round(p.caution * grid.cell / self.unit))

    def ways(self, ground: str) -> Bytes:
        """Directions (row, col) as bits with ``ground`` on the known."""
        unknown = self.risk == UNKNOWN
        given = None if ground == "middle" else unknown
        ways = standing(self.wheel_hazard, self.body_hazard, self.vehicle, self.grid.cell, unknown=given, below=ground)
        ways[self.closed] = 0
        return ways

    def xyz(self, cells: Ints) -> Floats:
        row, col = cells[:, 0], cells[:, 1]
        return np.column_stack([self.grid.xy(row, col), self.stand[row, col]])


def _by_rows(
    maps: Maps,
    lattice: Lattice,
    vehicle: Vehicle,
    heading: Point,
    start: Point | None,
    target: Point | None,
    p: PathParams,
) -> Route:
    ground = _Ground(maps, lattice, RowGrid.over(lattice, heading), vehicle, p)
    grid = ground.grid
    first, last = (None if point is None else grid.index(point) for point in (start, target))
    tolerance = math.ceil((vehicle.wheel_base + vehicle.wheel_diameter) / lattice.cell)
    span = row_span(~ground.closed)
    for name in GROUNDS:
        found = plan(ground.height, ground.ways(name), tolerance, first, last, span=span, toll=ground.toll)
        if len(found.cells):
            break
    cost = np.where(found.cost < UNREACHED, found.cost // grid.rows * ground.unit, np.nan).astype(np.float32)
    return Route(found.cells, ground.xyz(found.cells), found, grid, "rows", name, cost, span or (0, 0))


def _by_grid(
    maps: Maps,
    lattice: Lattice,
    vehicle: Vehicle,
    start: Point | None,
    target: Point | None,
    p: PathParams,
    before: Route | None,
) -> Route:
    ground = _Ground(maps, lattice, RowGrid.over(lattice, (0.0, 1.0)), vehicle, p)
    grid, unit = ground.grid, max(1, round(lattice.cell / ground.unit))
    given = tuple(None if point is None else grid.index(point) for point in (start, target))
    nothing = np.empty((0, 2), dtype=np.int64)
    cells, cost, name = nothing, np.full(ground.height.shape, UNREACHED), GROUNDS[0]
    for name in _worth(ground) if given == (None, None) else GROUNDS:
        ways = ground.ways(name)
        first, last = _chosen(ways, given[0], given[1], ground, unit)
        if first is None or last is None or not ways[first] or not ways[last]:
            continue
        cost, step = grid8.cost_to_go(ground.height, ways, last, first, unit, ground.toll)
        if cost[first] < UNREACHED:
            cells = grid8.trace(step, first)
            break
    reason = "" if len(cells) else "start and target are not connected by ground that the vehicle may cross"
    base = before.plan if before is not None else Plan(nothing, cost, np.zeros(grid.cols, dtype=bool), 0)
    found = replace(base, cells=cells, cost=cost, reachable=np.zeros(grid.cols, dtype=bool), reason=reason)
    if len(cells):
        found = replace(found, target_row=int(cells[-1, 0]), blocking_row=None)
        found.reachable[cells[-1, 1]] = True
    metres = np.where(cost < UNREACHED, cost * ground.unit, np.nan).astype(np.float32)
    return Route(cells, ground.xyz(cells), found, grid, "grid8", name, metres, row_span(~ground.closed) or (0, 0))


def _worth(ground: _Ground) -> tuple[str, ...]:
    """Of :data:`GROUNDS` those on which connected ground covers most of the rows that it covers on any."""
    spans = [grid8.parts(ground.ways(name))[1] for name in GROUNDS]
    rows = [int((s[:, 1] - s[:, 0]).max(initial=0)) for s in spans]
    return tuple(name for name, n in zip(GROUNDS, rows, strict=True) if n >= MOST * max(rows))


def _chosen(
    ways: Bytes, start: tuple[int, int] | None, target: tuple[int, int] | None, ground: _Ground, unit: int
) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """Ends as given; else, of the connected ground over most rows (that of the target), the cell nearest to the middle
    of the first row, and of those that it reaches the one nearest to that of the last."""
    span = row_span(ways > 0)
    if span is None:
        return None, None
    if start is None:
        number, spans = grid8.parts(ways)
        most = number[target] if target is not None else int(np.argmax(spans[:, 1] - spans[:, 0]))
        if most < 0:
            return None, target
        start = _nearest(number == most, span[1])
    if target is None:
        cost, _ = grid8.cost_to_go(ground.height, ways, start, None, unit, ground.toll)
        target = _nearest(cost < UNREACHED, span[0])
    return start, target


def _nearest(cells: NDArray[np.bool_], row: int) -> tuple[int, int]:
    """The set cell nearest to the middle of a row, as :mod:`stages.row_graph` has it."""
    r, c = np.nonzero(cells)
    best = int(np.argmin(2 * np.abs(r - row) + np.abs(2 * c - (cells.shape[1] - 1))))
    return int(r[best]), int(c[best])


def check_end(maps: Maps, lattice: Lattice, vehicle: Vehicle, name: str, point: Point) -> None:
    """Refuse a start or target outside the map, in a hazard or on unknown ground, with the figure that decides."""
    row, col = (int(v) for v in np.rint(lattice.index(point)))
    where = f"path.{name} ({point[0]:g}, {point[1]:g}) m"
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            f"{where} is outside the map", remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m"
        )
    kind = maps["risk"][row, col]
    if kind == UNKNOWN:
        free = np.argwhere(maps["risk"] < HAZARDOUS)
        away = (
            f", the nearest ground to drive on is {_away(free, row, col, lattice.cell):.3g} m away" if len(free) else ""
        )
        raise InputError(f"{where} lies on unknown ground{away}", remedy=f"choose another {name}")
    if kind == HAZARDOUS:
        raise InputError(
            f"{where} lies in a hazard: {hazard_words(maps, (row, col), vehicle)}", remedy=f"choose another {name}"
        )


def _away(cells: NDArray[np.intp], row: int, col: int, cell: float) -> float:
    return float(np.hypot(cells[:, 0] - row, cells[:, 1] - col).min()) * cell


def hazard_words(maps: Maps, at: tuple[int, int], vehicle: Vehicle) -> str:
    """The measures over their limits at a cell, with both figures."""
    band = {"range": "height_range", "rise": "clearance"}
    told = []
    for name, bit in BITS.items():
        if not int(maps["reason"][at]) & bit:
            continue
        words, limit, unit = WORDS[name]
        values = maps.get(band.get(name, name))
        if values is None:
            told.append(f"{words} over vehicle.{limit}")
            continue
        value = float(values[at])
        value = vehicle.clearance - value if name == "rise" else math.degrees(value) if unit == "deg" else value
        told.append(f"{words} {value:.3g} {unit}, vehicle.{limit} {getattr(vehicle, limit):g}")
    return "; ".join(told)


def _run(params: PathParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    source: Bundle = inputs["risk"]
    lattice, vehicle = Lattice.from_dict(source.meta["lattice"]), Vehicle.model_validate(source.meta["vehicle"])
    local = args.get("use") == "local"
    dx, dy = args.get("heading", (0.0, 1.0))
    maps = {name: np.asarray(source[name]) for name in source.arrays}
    ends = {} if local else {"start": params.start, "target": params.target}
    route = find_path(maps, lattice, vehicle, heading=(dx, dy), stretch=not local, params=params, **ends)
    arrays: dict[str, NDArray[Any]] = {
        "path": route.xyz,
        "cost_to_go": route.cost,
        "reachable": route.plan.reachable.astype(np.uint8),
    }
    return Bundle(arrays, describe(route, maps, lattice, vehicle) | {"frame": source.meta.get("frame", "local")})


def describe(route: Route, maps: Maps, lattice: Lattice, vehicle: Vehicle) -> dict[str, Any]:
    """Facts of a route: length, climb, and the worst that it meets."""
    found, grid, xyz = route.plan, route.grid, route.xyz
    meta: dict[str, Any] = {
        "found": len(xyz) > 0,
        "planner": route.planner,
        "ground": route.ground,
        "reason": found.reason or "" if len(xyz) else _why(found, maps, vehicle),
        "blocking_row": found.blocking_row,
        "blocking_y": None if found.blocking_row is None else (grid.j0 - found.blocking_row) * grid.cell,
        "beside_unknown": route.ground != GROUNDS[0],
        "target_row": found.target_row,
        "reachable_targets": int(found.reachable.sum()),
        "vertices": len(xyz),
        "grid": grid.to_dict(),
    }
    none = ("length_m", "climb_m", "max_inclination", "max_tilt", "least_clearance", "max_p_hazard", "caution_share")
    if len(xyz) == 0:
        return meta | dict.fromkeys((*none, "start", "target", "left_out_m"))
    at = tuple(np.rint(lattice.index(xyz[:, :2])).astype(np.int64).T)
    steps = np.diff(xyz, axis=0)
    return meta | {
        "length_m": float(np.sqrt((steps**2).sum(axis=1)).sum()),
        "climb_m": float(np.maximum(steps[:, 2], 0.0).sum()),
        "max_inclination": _worst(maps, "inclination", at, np.nanmax),
        "max_tilt": _worst(maps, "tilt", at, np.nanmax),
        "least_clearance": _worst(maps, "clearance", at, np.nanmin),
        "max_p_hazard": _worst(maps, "p_hazard", at, np.nanmax),
        "caution_share": float((maps["risk"][at] == CAUTION).mean()),
        "left_out_m": _left_out(route),
        "start": [float(v) for v in xyz[0]],
        "target": [float(v) for v in xyz[-1]],
    }


def _left_out(route: Route) -> list[float]:
    """Metres of rows with known ground before the start and beyond the target."""
    span, rows = route.span, route.cells[[0, -1], 0]
    return [float(span[1] - rows[0]) * route.grid.cell, float(rows[1] - span[0]) * route.grid.cell]


def _worst(maps: Maps, name: str, at: Any, of: Any) -> float | None:
    return float(of(maps[name][at])) if name in maps else None


def _why(found: Plan, maps: Maps, vehicle: Vehicle) -> str:
    """Why there is no path; where hazards leave nothing to drive on, the limit that does the most."""
    risk = maps["risk"]
    judged = int((risk != UNKNOWN).sum())
    if judged == 0 or (risk[risk != UNKNOWN] < HAZARDOUS).any():
        return found.reason
    most = max(BITS, key=lambda name: int(((maps["reason"] & BITS[name]) > 0).sum()))
    share = float(((maps["reason"] & BITS[most]) > 0).sum()) / judged
    words, limit, _ = WORDS[most]
    return (
        f"all {judged} known cells are hazardous, {100 * share:.0f} % of them by {words}: "
        f"is vehicle.{limit} {getattr(vehicle, limit):g} at the scale of the sequence?"
    )


STAGE = Stage(
    name="path",
    version=2,
    summary="path of least height differences for a vehicle with a width: monotone in the rows, or any direction",
    params=PathParams,
    inputs=("risk",),
    outputs=(
        Array("path", ("vertex", "xyz"), "float64", "m", "vertices from start to target; z = mean under a wheel"),
        Array("cost_to_go", ("row", "col"), "float32", "m", "rows: cost from the start; grid8: to the target", "nan"),
        Array("reachable", ("col",), "uint8", "1", "1 where the target row can be reached"),
    ),
    requires=("numpy", "numba", "scipy"),
    run=_run,
    memory=Memory(factor=6.0, lower=("locus.cell_size",)),
)
