"""Local path on a risk map (section 4.7), for a vehicle with a width.

Two planners. ``rows`` is the paper's: a path that runs monotonically through the rows of the map, row 0 farthest, with
all targets of the far row from one sweep (:mod:`rille.stages.planning.row_graph`). ``grid8`` goes in any direction and
reaches what lies beside or behind an obstacle (:mod:`rille.stages.planning.grid8`). ``auto`` takes the first, and the
second where the first reaches no target that was asked for.

The weight of an edge is the absolute height difference between the places where a wheel would stand: means over the
wheel's window, rounded to a step that does not matter to the vehicle. ``grid8`` adds the length, since without rows to
cross a path of no climb could be of any length; ``rows`` a part of what a diagonal is longer (``detour_cost``), else a
path over level ground would follow the noise of its elevations. Caution ground costs a toll.

Footprint. The middle of the vehicle never enters a hazardous or unknown cell; and in the direction of each edge its
wheels keep the margin from ground that is hazardous to a wheel, and its middle keeps it from places where the vehicle
as a whole would tilt or strike (:mod:`rille.stages.planning.configuration_space`). Of unknown ground three
shares are tried: none under its outline, else none under its wheels, else none under its middle. The last happens
where the elevation model is narrower than the vehicle, as beside the cameras; the result says so (``ground``).

An elevation model is fan-shaped and ragged: the first and last rows with a free cell hold a few, which may lead
nowhere. So a start that is not given is, of the free cells within one vehicle length of the first row that lead on, the
one nearest to that row's middle; the target likewise at the last row. Over a map that reaches far behind the place
where the rig began, as after an orbit, the start is the cell nearest to that place, on connected ground over most rows.

Where no path by rows comes within one vehicle length of the last row, ``auto`` goes, in any direction, as far as
connected ground leads from the first rows. Unless a target is given, a path leads at least one vehicle length ahead,
else there is none; ``ended_by`` says what ends it. A mission's map, on which the vehicle stands nowhere in particular,
may be cut by ground that it cannot cross: then the connected ground over most rows (of that around the end that is
given, if one is) is crossed, and the length left out is reported (``left_out_m``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Array, Bundle, Memory, stage
from rille.stages.core.errors import InputError
from rille.stages.facts.planning import PathFacts, RiskFacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import MEASURES
from rille.stages.hazard.risk import DOUBT_BIT, HAZARDOUS, UNKNOWN, check_size, too_large
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.grid8 import search
from rille.stages.planning.path_ground import (
    COST_UNIT_M,
    GROUNDS,
    Maps,
    PathMaps,
    PathParams,
    Point,
    cell_of,
    cell_within,
)
from rille.stages.planning.row_graph import UNREACHED, Cell, Ints, sweep, trace


@dataclass(frozen=True)
class Route:
    """A path and how it was found.

    ``cells`` (vertex, 2) of the lattice and ``xyz`` (vertex, 3) metres, z the mean height under a wheel, both empty
    where there is none; ``planner`` that gave it, ``ground`` one of :data:`GROUNDS`. ``span``: farthest and nearest row
    that are free somewhere. ``reason`` why there is no path, and ``blocking_row``, the first one that cannot be entered
    by rows, None where there is a path, or none was sought by rows; ``ended_by``: why a path goes no farther, None
    where there is none.
    """

    cells: Ints
    xyz: Floats
    planner: str
    ground: str
    span: tuple[int, int]
    reason: str = ""
    blocking_row: int | None = None
    ended_by: str | None = None


GOAL = "the goal"
WORST = {
    "max_inclination": ("inclination", np.nanmax),
    "max_tilt": ("tilt", np.nanmax),
    "least_clearance": ("clearance", np.nanmin),
    "max_p_hazard": ("p_hazard", np.nanmax),
}
"""Facts of a path that are the worst values of a map along it."""
ENDS = ("the edge of the map", "unknown ground", "ground too uncertain to be called safe", "a hazard")
"""What ends a path."""


def ending(route: Route, maps: Maps, lattice: Lattice, vehicle: Vehicle, p_certain: float) -> str:
    """The one of :data:`ENDS` that holds most of the cells beyond a path's end: as wide as the vehicle and its margin,
    and as far ahead of its middle. Ground above the probability ``p_certain`` is uncertain, as is a hazard that
    standard deviations alone make one."""
    far, wide = (
        math.ceil((half + vehicle.margin) / lattice.cell) for half in (vehicle.half_length, vehicle.half_width)
    )
    row, col = np.meshgrid(np.arange(1, far + 2), np.arange(-wide, wide + 1))
    at = route.cells[-1] + np.stack([-row, col], axis=-1)
    inside = ((at >= 0) & (at < lattice.shape)).all(axis=-1)
    here = tuple(at[inside].T)
    risk, chance = maps["risk"][here], maps["p_hazard"][here] if "p_hazard" in maps else np.zeros(len(here[0]))
    proven = (risk == HAZARDOUS) & (maps["reason"][here] & DOUBT_BIT == 0)
    uncertain = ((risk == HAZARDOUS) & ~proven) | ((risk < HAZARDOUS) & (chance > p_certain))
    counts = [np.count_nonzero(kind) for kind in (~inside, risk == UNKNOWN, uncertain, proven)]
    return ENDS[int(np.argmax(counts))]


def describe(route: Route, maps: Maps, lattice: Lattice, vehicle: Vehicle) -> dict[str, Any]:
    """Facts of a route: length, climb, and the worst values along it."""
    xyz, row = route.xyz, route.blocking_row
    meta: dict[str, Any] = {
        "found": len(xyz) > 0,
        "planner": route.planner,
        "ground": route.ground,
        "reason": route.reason if len(xyz) else _why(route.reason, maps, vehicle),
        "blocking_y": None if row is None else (lattice.j0 - row) * lattice.cell,
        "ended_by": route.ended_by,
    }
    if len(xyz) == 0:
        others = ("length_m", "climb_m", "start", "target", "left_out_m")
        return meta | dict.fromkeys((*WORST, *others))
    at = tuple(route.cells.T)
    steps, ends = np.diff(xyz, axis=0), route.cells[[0, -1], 0]
    worst = {name: float(of(maps[band][at])) if band in maps else None for name, (band, of) in WORST.items()}
    return (
        meta
        | worst
        | {
            "length_m": float(np.sqrt((steps**2).sum(axis=1)).sum()),
            "climb_m": float(np.maximum(steps[:, 2], 0.0).sum()),
            # Rows with known ground before the start and beyond the target.
            "left_out_m": [float(rows) * lattice.cell for rows in (route.span[1] - ends[0], ends[1] - route.span[0])],
            "start": [float(v) for v in xyz[0]],
            "target": [float(v) for v in xyz[-1]],
        }
    )


def _why(reason: str, maps: Maps, vehicle: Vehicle) -> str:
    """Why there is no path; if hazards leave no ground to drive on, the limit that closes most."""
    risk = maps["risk"]
    judged = int((risk != UNKNOWN).sum())
    # Where something is free, the search's own reason says more than a count of hazards.
    if judged == 0 or (risk[risk != UNKNOWN] < HAZARDOUS).any():
        return reason
    counts = [int(((maps["reason"] & m.bit) > 0).sum()) for m in MEASURES]
    most, count = max(zip(MEASURES, counts, strict=True), key=lambda pair: pair[1])
    # Angles do not depend on the scale, but on the vertical.
    asked = ", and is the vertical right (world.up)?" if most.in_degrees else " at the scale of the sequence?"
    return (
        f"all {judged} known cells are hazardous, {100 * count / judged:.0f} % of them by {most.words}: "
        f"is vehicle.{most.limit} {getattr(vehicle, most.limit):g}{asked}"
    )


def hazard_words(maps: Maps, at: tuple[int, int], vehicle: Vehicle) -> str:
    """The measures over their limits at a cell, with both figures."""
    parts = []
    for m in MEASURES:
        if not int(maps["reason"][at]) & m.bit:
            continue
        limit = getattr(vehicle, m.limit)
        if m.band not in maps:
            parts.append(f"{m.words} over vehicle.{m.limit}")
            continue
        value, unit = float(maps[m.band][at]), "deg" if m.in_degrees else "m"
        value = limit - value if m.left else math.degrees(value) if m.in_degrees else value
        # Below the limit by itself: the figure alone would seem to say that the ground is permitted.
        doubt = "" if value > limit else " plus risk.sigmas standard deviations"
        parts.append(f"{m.words} {value:.3g} {unit}{doubt}, vehicle.{m.limit} {limit:g}")
    return "; ".join(parts)


__all__ = ["PathParams", "Route", "describe", "find_path", "path_stage"]

Ends = tuple[Point | None, Point | None]
Cells = tuple[Cell | None, Cell | None]

BY_ROWS = "hazardous or unknown ground closes the whole width"
AHEAD = "no ground that is known and safe leads a vehicle's length ahead"
NO_CELLS: Ints = np.empty((0, 2), np.int64)
JOINED = "start and target are not connected by ground that the vehicle may cross"


def find_path(
    maps: Maps,
    lattice: Lattice,
    vehicle: Vehicle,
    *,
    ends: Ends = (None, None),
    stretch: bool = False,
    params: PathParams | None = None,
    begin: Sequence[float] | None = None,
) -> Route:
    """Path over a risk map.

    Parameters
    ----------
    maps : arrays (row, col) of stage ``risk``: ``risk``, ``reason``, ``elevation``; the others serve messages.
    ends : start and target, x, y, metres; None: see the module. Those of ``params`` are not looked at.
    stretch : where rows do not cross the map, cross the connected ground over most rows, wherever it begins; else go
        from the first rows as far as connected ground leads.
    begin : x, y, metres, where the rig began.

    Raises
    ------
    InputError
        Start or target lies outside the map, in a hazard or on unknown ground.
    DegenerateError
        The vehicle is wider than the map, or longer than from corner to corner.
    """
    params = params or PathParams()
    check_size(vehicle, lattice.shape, lattice.cell)
    for name, point in zip(("start", "target"), ends, strict=True):
        if point is not None:
            _check_end(maps, lattice, vehicle, name, point)
    start, target = (None if point is None else cell_of(lattice, point) for point in ends)
    cells, limit = (start, target), params.p_certain_hazard
    ground = PathMaps(maps, lattice, vehicle, params)
    if start is None and begin is not None:
        cells = (_begun(ground, vehicle, cell_of(lattice, begin)), target)
    route = _route(ground, vehicle, cells, stretch, params)
    if len(route.cells):
        return replace(route, ended_by=GOAL if ends[1] is not None else ending(route, maps, lattice, vehicle, limit))
    # A limit that closed nothing cannot be the reason.
    if limit >= 1 or "p_hazard" not in maps:
        return route
    # Searched once more without the limit, only to name the figure that would open a way.
    unlimited = params.model_copy(update={"p_certain_hazard": 1.0})
    other = _route(PathMaps(maps, lattice, vehicle, unlimited), vehicle, cells, stretch, unlimited)
    if not len(other.cells):
        return route
    # Rounded up to three digits, so that a path with the printed figure as its limit exists.
    chance = math.ceil(1e3 * float(np.nanmax(maps["p_hazard"][tuple(other.cells.T)])) - 1e-3) / 1e3
    reason = (
        f"ground with a p_hazard above path.p_certain_hazard {limit:g} closes every path; without it one "
        f"leads over ground of up to {chance:.3g}: raise path.p_certain_hazard to that to take it"
    )
    return replace(route, reason=reason)


def _begun(ground: PathMaps, vehicle: Vehicle, begin: Cell) -> Cell | None:
    """The cell nearest to where the rig began, of the connected ground over most rows; None where the map reaches no
    vehicle's length behind that place, or no farther ahead."""
    length = math.ceil(2.0 * vehicle.half_length / ground.lattice.cell)
    far, near = row_span(~ground.closed)
    free = np.argwhere(max((ground.connected(below, 0, None) for below in GROUNDS), key=lambda part: part[1])[0])
    if not len(free) or begin[0] >= near - length:
        return None
    row, col = (int(k) for k in free[np.argmin(((free - begin) ** 2).sum(axis=1))])
    return (row, col) if row > far + length else None


def _route(ground: PathMaps, vehicle: Vehicle, ends: Cells, stretch: bool, params: PathParams) -> Route:
    """Path of the planner that is asked for; ``auto``: by rows, else in any direction. Others as in :func:`find_path`,
    ``ends`` as cells."""
    far, near = span = row_span(~ground.closed)
    length, target = math.ceil(2.0 * vehicle.half_length / ground.lattice.cell), ends[1]
    # On a short map ends that are a vehicle's length from its borders would leave out most of it.
    slack, blocking = min(length, (near - far) // 4), None if params.planner == "grid8" else near
    for planner in ("rows", "grid8") if params.planner == "auto" else (params.planner,):
        rows, ahead = planner == "rows", length if stretch else None
        found = _by_rows(ground, ends, slack, params) if rows else _anywhere(ground, ends, slack, ahead)
        for below, cells, top in found:
            # To a target that is asked for it is as far as that is.
            if len(cells) and (target is not None or cells[0, 0] - cells[-1, 0] >= length):
                return Route(cells, ground.xyz(cells), planner, below, span)
            blocking = top - 1 if rows else blocking
    reason = BY_ROWS if params.planner == "rows" else AHEAD if None in ends else JOINED
    if blocking is not None and blocking < far:
        # Rows cross the map: the target lies aside of what they reach, or the map is shorter than the vehicle.
        reason, blocking = AHEAD if target is None else JOINED, None
    return Route(NO_CELLS, np.empty((0, 3)), planner, "middle", span, reason, blocking)


def _by_rows(ground: PathMaps, ends: Cells, slack: int, params: PathParams) -> Iterator[tuple[str, Ints, int]]:
    """Paths a row a step, to the target or, without one, to within ``slack`` rows of the last row: for each part of the
    vehicle that stays on known ground, from the strictest on, its name, cells (vertex, 2), empty where there is none,
    and the farthest row reached."""
    (far, near), (start, target) = row_span(~ground.closed), ends
    for below in GROUNDS:
        starts = _starts(ground.ways(below) > 0, start, near - slack)
        if starts.any():
            # The length that every path has, a row a step, is free.
            terrain = ground.terrain(below, params.detour_cost, 1.0)
            cost, steps = sweep(terrain, first_costs(starts, near, ground.lattice.cell))
            reached = cost < UNREACHED
            top = row_span(reached)[0]
            end = nearest_middle(reached[: far + slack + 1], far) if top <= far + slack else None
            yield below, _traced(steps, reached, target or end), top


def _anywhere(ground: PathMaps, ends: Cells, slack: int, ahead: int | None) -> Iterator[tuple[str, Ints, int]]:
    """Paths in any direction, to the target or, without one, as far as connected ground leads; as of :func:`_by_rows`,
    but with a free end from the ground on that leads over most rows. ``ahead``: least rows of a mission's path, which
    may begin anywhere and end up to ``slack`` rows earlier; None: it is that of a stop."""
    (_, near), (start, target), grounds = row_span(~ground.closed), ends, list(GROUNDS)
    behind = near - slack if ahead is None else 0
    if None in ends:
        # With a free end a stricter ground would always find some path, on however small a part.
        grounds.sort(key=lambda below: -ground.connected(below, behind, start or target)[1])
    for below in grounds:
        cells = ground.ways(below) > 0 if start else ground.connected(below, behind, target)[0]
        starts = _starts(cells, start, behind)
        if starts.any():
            # A step costs its length as climb: else a path of no climb could be of any length.
            first = nearest_middle(starts, near)
            cost, steps = search(ground.terrain(below, 1.0, 0.0), first, target)
            reached = cost < UNREACHED
            top = row_span(reached)[0]
            # As far as it leads for a stop; a mission's path need not end in the very last corner.
            last = top if ahead is None else max(top, min(top + slack, first[0] - ahead))
            yield below, _traced(steps, reached, target or nearest_middle(reached[: last + 1], top)), top


def _traced(steps: NDArray[np.int8], reached: Bools, end: Cell | None) -> Ints:
    """Cells (vertex, 2) of the path to an end, empty where that was not reached."""
    return NO_CELLS if end is None or not reached[end] else trace(steps, end)


def _starts(cells: Bools, start: Cell | None, behind: int) -> Bools:
    """Those of the cells (row, col) where a path may start: the one that is given, else all from row ``behind`` on."""
    out, where = np.zeros_like(cells), np.s_[behind:] if start is None else start
    out[where] = cells[where]
    return out


def _check_end(maps: Maps, lattice: Lattice, vehicle: Vehicle, name: str, point: Point) -> None:
    """Refuse a start or target outside the map, in a hazard or on unknown ground, with the figure that decides."""
    row, col = cell_within(lattice, f"path.{name}", point)
    where = f"path.{name} ({point[0]:g}, {point[1]:g}) m"
    kind = maps["risk"][row, col]
    if kind == UNKNOWN:
        free, away = np.argwhere(maps["risk"] < HAZARDOUS), ""
        if len(free):
            metres = float(np.hypot(*(free - (row, col)).T).min()) * lattice.cell
            away = f", the nearest ground to drive on is {metres:.3g} m away"
        raise InputError("RIL-407", f"{where} lies on unknown ground{away}", remedy=f"choose another {name}")
    if kind == HAZARDOUS:
        raise InputError(
            "RIL-408",
            f"{where} lies in a hazard: {hazard_words(maps, (row, col), vehicle)}",
            remedy=f"choose another {name}",
        )


def first_costs(starts: Bools, row: int, cell: float) -> Ints:
    """Cost (row, col) of starting at a cell, :data:`UNREACHED` where that is not permitted: by a cost for
    each metre along rows and columns from the middle of a row."""
    rows, cols = (np.arange(n) for n in starts.shape)
    moves = np.abs(rows - row)[:, None] + np.abs(cols - len(cols) // 2)
    # 1e3: cost of a metre [m of climb] by which a path by rows begins beside its place, more than that of any ground.
    return np.where(starts, moves * round(1e3 * cell / COST_UNIT_M), UNREACHED)


def row_span(cells: Bools) -> tuple[int, int]:
    """The farthest and the nearest row with a set cell; 0, 0: there is none."""
    rows = np.flatnonzero(cells.any(axis=1))
    return (int(rows[0]), int(rows[-1])) if len(rows) else (0, 0)


def nearest_middle(cells: Bools, row: int) -> Cell:
    """The set cell with the fewest moves along rows and columns to the middle of a row; the first one among equals.

    At least one is set.
    """
    r, c = np.nonzero(cells)
    k = int(np.argmin(2 * np.abs(r - row) + np.abs(2 * c - (cells.shape[1] - 1))))
    return int(r[k]), int(c[k])


@stage(
    "path",
    outputs=[Array("path", ("vertex", "xyz"), "float64", "m", "vertices from start to target; z = mean under a wheel")],
    memory=Memory(factor=6.0, lower=("locus.cell_size",)),
)
def path_stage(
    params: PathParams, risk: Bundle[RiskFacts], *, use: str | None = None, begin: Sequence[float] | None = None
) -> Bundle[PathFacts]:
    """Path of least height differences for a vehicle with a width: monotone in the rows, or any direction."""
    lattice, vehicle = Lattice.from_dict(risk.meta["lattice"]), Vehicle.model_validate(risk.meta["vehicle"])
    local = use == "local"
    maps = {name: np.asarray(risk[name]) for name in risk.arrays}
    ends = (None, None) if local else (params.start, params.target)
    if local and (large := too_large(vehicle, lattice.shape, lattice.cell)):
        route = Route(NO_CELLS, np.empty((0, 3)), params.planner, "middle", (0, 0), large)
    else:
        route = find_path(maps, lattice, vehicle, ends=ends, stretch=not local, params=params, begin=begin)
    facts = describe(route, maps, lattice, vehicle) | {"frame": risk.meta.get("frame", "local")}
    return Bundle({"path": route.xyz}, cast(PathFacts, facts))
