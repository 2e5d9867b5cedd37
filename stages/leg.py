"""The next leg of a drive to a goal: where to, how far of it is safe to drive now, or why no way leads there.

The way is planned to the goal over all of the map. Ground that is known and free costs its length; unknown ground may
be planned over, at a higher price, since the next stop will see it, but is never driven on: the leg ends before it. So
may ground that is hazardous only by the standard deviation of its elevations. Ground that is known to be hazardous, or
nearer to it than the vehicle and its margin need, is closed. So the way bends round dead ends as soon as they are seen,
and where no way is left even over unknown ground there is none. This is the usual free-space assumption (Koenig, Tovey,
Smirnov 2003, doi:10.1016/S0004-3702(03)00062-6), planned anew at each stop.

The vehicle turns on the spot, so that what it needs is the circle of its wheels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from stages.declare import Array, Bundle, Inputs, Params, Stage
from stages.errors import InputError
from stages.geometry import RigidTransform
from stages.lattice import Lattice
from stages.path import WHEEL_BITS
from stages.risk import DOUBT_BIT, HAZARDOUS, UNKNOWN
from stages.vehicle import Vehicle

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Point = tuple[float, float]


class LegParams(Params):
    """Parameters of the stage ``leg``."""

    length: float = Field(1.5, gt=0, description="wheel bases; longest leg, which is driven without a new map")
    least: float = Field(0.3, gt=0, description="wheel bases; a shorter leg is not worth a stop: look elsewhere first")
    max_turn_deg: float = Field(
        35.0, gt=5, le=120, description="degrees turned on one leg: landmarks must stay in view, half of it at least"
    )
    unknown_price: float = Field(2.0, ge=1, description="price of a metre over unknown ground, known ground is 1")
    near_price: float = Field(0.5, ge=0, description="added to the price beside hazards, falls to 0 within the margin")
    tolerance: float = Field(0.3, gt=0, description="wheel bases; the goal is reached this near")
    looks: int = Field(3, ge=1, description="looks around without a leg after which the way counts as closed")
    vain: float = Field(0.8, gt=0, description="wheel bases; radius of what is closed then, as far as it is unknown")


@dataclass(frozen=True)
class Leg:
    """``verdict``: drive, turn, look, closed, goal or no path; ``path`` (vertex, 2) m to drive; ``turn`` rad then.

    ``closed``: looking around did not help; ``where`` the way is not known to be free.

    ``way`` (vertex, 2) m to the goal, as it is planned; ``cost`` (row, col) m to the goal at these prices, NaN closed.
    """

    verdict: str
    reason: str
    path: Floats
    turn: float
    way: Floats
    cost: NDArray[np.float32]
    where: Point | None = None


def half_width(vehicle: Vehicle) -> float:
    """Radius of the circle through the wheels' centres, m."""
    return 0.5 * math.hypot(vehicle.track, vehicle.wheel_base)


@dataclass(frozen=True)
class Hazards:
    """A risk map as the circle of the vehicle meets it, (row, col).

    ``gap`` m from the vehicle standing on a cell to the nearest hazard: from the circle of its wheels to what is
    hazardous to a wheel, from its middle to where the vehicle as a whole would tilt or strike. ``unknown`` m from the
    circle to unknown ground. ``free``: the cell itself is neither hazardous nor unknown. ``proven`` m as ``gap``, to
    hazards that are not just the map's uncertainty: what is far is uncertain, and the next stop knows more.
    """

    gap: Floats
    proven: Floats
    unknown: Floats
    free: Mask

    @staticmethod
    def of(risk: NDArray[np.uint8], reason: NDArray[np.uint16] | None, cell: float, vehicle: Vehicle) -> Hazards:
        """From classes and reason bits of :mod:`stages.risk`; without bits every hazard is one to a wheel."""
        hazardous = risk == HAZARDOUS
        bits = np.full(risk.shape, WHEEL_BITS) if reason is None else reason
        wheel, doubt = (bits & WHEEL_BITS) > 0, (bits & DOUBT_BIT) > 0
        need = half_width(vehicle)
        gaps = [
            np.minimum(_distance(which & wheel, cell) - need, _distance(which & ~wheel, cell))
            for which in (hazardous, hazardous & ~doubt)
        ]
        unknown = risk == UNKNOWN
        return Hazards(gaps[0], gaps[1], _distance(unknown, cell) - need, ~(hazardous | unknown))


def _distance(mask: Mask, cell: float) -> Floats:
    far = distance_transform_edt(~mask) * cell if mask.any() else np.full(mask.shape, np.inf)
    return np.asarray(far, dtype=np.float64)


def costs(price: Floats, goals: Mask, cell: float) -> tuple[Floats, NDArray[np.int32]]:
    """Least cost from each cell to one of the goals over 8 neighbours, and the next cell on the way (flat, < 0 none).

    ``price`` (row, col) a metre, infinite where closed; a step costs the mean of both cells' prices.
    """
    rows, cols = price.shape
    number = np.arange(rows * cols).reshape(rows, cols)
    ends, lengths = [], []
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, rows - dr), slice(max(0, -dc), cols - max(0, dc)))
        b = (slice(dr, rows), slice(max(0, dc), cols + min(0, dc)))
        mean = 0.5 * (price[a] + price[b])
        there = np.isfinite(mean)
        ends.append(np.stack([number[a][there], number[b][there]]))
        lengths.append(mean[there] * cell * math.hypot(dr, dc))
    pairs, length = np.concatenate(ends, axis=1), np.concatenate(lengths)
    graph = coo_array((length, (pairs[0], pairs[1])), shape=(rows * cols, rows * cols)).tocsr()
    sources = number[goals & np.isfinite(price)]
    if sources.size == 0:
        return np.full(price.shape, np.inf), np.full(rows * cols, -9999, np.int32)
    cost, nearer, _ = dijkstra(graph, directed=False, indices=sources, return_predecessors=True, min_only=True)
    return np.asarray(cost).reshape(rows, cols), np.asarray(nearer)


def plan_leg(
    hazards: Hazards,
    lattice: Lattice,
    vehicle: Vehicle,
    start: Point,
    heading: float,
    goal: Point,
    params: LegParams,
    looks: int = 0,
    closed: list[Point] | None = None,
) -> Leg:
    """The next leg.

    Parameters
    ----------
    hazards : of the map known so far.
    start, heading : m; rad to the left of y.
    looks : looks around since the last leg that was driven.
    closed : places about which unknown ground was looked at in vain.

    Raises
    ------
    InputError
        Start or goal lies outside the map.
    """
    at, target = (_cell_of(lattice, name, p) for name, p in (("start", start), ("goal", goal)))
    base, cell = vehicle.wheel_base, lattice.cell
    xy = lattice.xy()
    nothing = np.full(lattice.shape, np.nan, np.float32)
    left = math.hypot(goal[0] - start[0], goal[1] - start[1])
    if left <= params.tolerance * base:
        return Leg("goal", f"{1000 * left:.0f} mm from the goal", _line([start]), 0.0, _line([start]), nothing)
    here = np.hypot(xy[..., 0] - start[0], xy[..., 1] - start[1]) <= 0.3 * base
    opened = (hazards.proven > vehicle.margin) | here
    known = ((hazards.gap > vehicle.margin) & (hazards.unknown > 0.0) & hazards.free) | here
    for x, y in closed or []:
        opened &= known | (np.hypot(xy[..., 0] - x, xy[..., 1] - y) > params.vain * base)
    price = np.where(known, 1.0, params.unknown_price)
    if vehicle.margin > 0:
        price = price + params.near_price * np.clip(2.0 - hazards.gap / vehicle.margin, 0.0, 1.0)
    price = np.where(opened, price, np.inf)
    goals = np.hypot(xy[..., 0] - goal[0], xy[..., 1] - goal[1]) <= 0.5 * params.tolerance * base
    cost, nearer = costs(price, goals, cell)
    shown = np.where(np.isfinite(cost), cost, np.nan).astype(np.float32)
    if not np.isfinite(cost[at]):
        reason = _why_closed(price, goals, target, cost, at, lattice)
        return Leg("no path", reason, _line([start]), 0.0, _line([start]), shown)
    cells = _follow(nearer, at, lattice)
    way = _points(lattice, cells, start)
    path = _safe_part(cells, way, known, lattice, params.length * base)
    if _length(path) >= min(params.least * base, left):
        path, turn = _within_turn(path, heading, math.radians(params.max_turn_deg))
        if len(path) > 1:
            return Leg("drive", "", path, 0.0, way, shown)
        return Leg("turn", f"turns {math.degrees(turn):.0f} degrees to where it goes on", path, turn, way, shown)
    if looks >= params.looks:
        free = known[cells[:, 0], cells[:, 1]]
        x, y = way[int(np.argmin(free))] if not free.all() else way[-1]
        reason = f"{looks} looks around did not show the ground at ({x:.3f}, {y:.3f}) m"
        return Leg("closed", reason, _line([start]), 0.0, way, shown, (float(x), float(y)))
    ahead = way[min(len(way) - 1, max(1, int(1.5 * base / cell)))]
    turn = _look_to(_turn_to(start, ahead, heading), looks, math.radians(params.max_turn_deg))
    return Leg("look", f"turns {math.degrees(turn):.0f} degrees to see the way", _line([start]), turn, way, shown)


def _look_to(wanted: float, looks: int, bound: float) -> float:
    """Turn to look along the way; where it looks there already, to one side and then to the other."""
    if abs(wanted) < math.radians(8.0):
        wanted = math.radians((25.0, -50.0, 75.0)[looks % 3])
    return max(-bound, min(bound, wanted))


def shortest(
    hazards: Hazards, lattice: Lattice, vehicle: Vehicle, start: Point, goal: Point, tolerance: float
) -> float | None:
    """Length, m, of the shortest way over known, free ground to within ``tolerance`` metres of the goal; None: none."""
    xy = lattice.xy()
    here = np.hypot(xy[..., 0] - start[0], xy[..., 1] - start[1]) <= 0.3 * vehicle.wheel_base
    known = ((hazards.gap > vehicle.margin) & (hazards.unknown > 0.0) & hazards.free) | here
    goals = np.hypot(xy[..., 0] - goal[0], xy[..., 1] - goal[1]) <= tolerance
    cost, nearer = costs(np.where(known, 1.0, np.inf), goals, lattice.cell)
    at = _cell_of(lattice, "start", start)
    if not np.isfinite(cost[at]):
        return None
    cells = _follow(nearer, at, lattice)
    return _length(_safe_part(cells, _points(lattice, cells, start), known, lattice, math.inf))


def _cell_of(lattice: Lattice, name: str, point: Point) -> tuple[int, int]:
    row, col = (int(v) for v in np.rint(lattice.index(point)))
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            f"the {name} ({point[0]:.3f}, {point[1]:.3f}) m is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )
    return row, col


def _why_closed(
    price: Floats, goals: Mask, target: tuple[int, int], cost: Floats, at: tuple[int, int], lattice: Lattice
) -> str:
    if not np.isfinite(price[goals]).any():
        return "the goal itself is on hazardous ground, or too near to it"
    reach = np.isfinite(cost)
    back = lattice.xy()[reach] - lattice.xy()[at]
    gap = float(np.hypot(back[:, 0], back[:, 1]).min())
    return f"hazards close every way: ground from which the goal can be reached ends {1000 * gap:.0f} mm away"


def _line(points: list[Point]) -> Floats:
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def _length(path: Floats) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) > 1 else 0.0


def _follow(nearer: NDArray[np.int32], at: tuple[int, int], lattice: Lattice) -> NDArray[np.int64]:
    """Cells (vertex, 2) from a cell to the goal."""
    here = at[0] * lattice.cols + at[1]
    cells = [here]
    while nearer[here] >= 0:
        here = int(nearer[here])
        cells.append(here)
    flat = np.array(cells)
    return np.stack([flat // lattice.cols, flat % lattice.cols], axis=1)


def _points(lattice: Lattice, cells: NDArray[np.int64], start: Point) -> Floats:
    points = lattice.xy()[cells[:, 0], cells[:, 1]]
    points[0] = start
    return np.asarray(points)


def _safe_part(cells: NDArray[np.int64], way: Floats, known: Mask, lattice: Lattice, length: float) -> Floats:
    """The way up to where it is not known to be free, as straight pieces over free cells, and of it ``length`` metres.

    It is straightened before it is cut: where a way on a grid turns is a matter of ties.
    """
    free = known[cells[:, 0], cells[:, 1]]
    stop = int(np.argmin(free)) if not free.all() else len(free)
    if stop < 2:
        return way[:1]
    chosen, i = [way[0]], 0
    while i < stop - 1:
        i = next(j for j in range(stop - 1, i, -1) if j == i + 1 or _sees(way[i], way[j], known, lattice))
        chosen.append(way[i])
    return _cut(np.array(chosen), length)


def _cut(path: Floats, length: float) -> Floats:
    """The first ``length`` metres of a path."""
    out, left = [path[0]], length
    for a, b in itertools.pairwise(path):
        step = float(np.hypot(*(b - a)))
        if step >= left:
            return np.array([*out, a + (left / step) * (b - a)])
        out.append(b)
        left -= step
    return np.array(out)


def _sees(a: Floats, b: Floats, known: Mask, lattice: Lattice) -> bool:
    """Whether the straight line from a to b stays on free cells."""
    n = max(2, math.ceil(2.0 * math.hypot(*(b - a)) / lattice.cell))
    points = a + np.linspace(0.0, 1.0, n)[:, None] * (b - a)
    at = np.rint(lattice.index(points)).astype(np.int64)
    return bool(known[at[:, 0], at[:, 1]].all())


def _turn_to(a: Point | Floats, b: Point | Floats, heading: float) -> float:
    return math.remainder(math.atan2(-(b[0] - a[0]), b[1] - a[1]) - heading, 2 * math.pi)


def _within_turn(path: Floats, heading: float, bound: float) -> tuple[Floats, float]:
    """The path as far as the turns on it stay within a bound, and the part of a larger first turn that does."""
    total = 0.0
    for k in range(len(path) - 1):
        turn = _turn_to(path[k], path[k + 1], heading)
        if abs(total + turn) > bound + 1e-9:
            return path[: k + 1], (math.copysign(bound, turn) if k == 0 else 0.0)
        total, heading = total + turn, heading + turn
    return path, 0.0


def _run(params: LegParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    risk = inputs["risk"]
    lattice, vehicle = Lattice.from_dict(risk.meta["lattice"]), Vehicle.model_validate(risk.meta["vehicle"])
    T_world_left = RigidTransform.from_matrix(np.asarray(inputs["pose"]["poses"])[-1])
    T = T_world_left @ RigidTransform.from_matrix(args["T_vehicle_left"]).inverse()
    start = float(T.translation[0]), float(T.translation[1])
    heading = math.atan2(-T.rotation[0, 1], T.rotation[1, 1])
    goal = (float(args["goal"][0]), float(args["goal"][1]))
    hazards = Hazards.of(np.asarray(risk["risk"]), np.asarray(risk["reason"]), lattice.cell, vehicle)
    closed = [(float(x), float(y)) for x, y in args["closed"]]
    found = plan_leg(hazards, lattice, vehicle, start, heading, goal, params, int(args["looks"]), closed)
    best = None
    if args.get("whole"):
        tolerance = 0.5 * params.tolerance * vehicle.wheel_base
        best = shortest(hazards, lattice, vehicle, start, goal, tolerance)
    meta = {
        "shortest_m": best,
        "verdict": found.verdict,
        "reason": found.reason,
        "turn": found.turn,
        "where": None if found.where is None else list(found.where),
        "start": [*start, heading],
        "goal": list(goal),
        "left_m": math.hypot(goal[0] - start[0], goal[1] - start[1]),
        "length_m": _length(found.path),
        "way_m": _length(found.way),
    }
    return Bundle({"path": found.path, "way": found.way, "cost_to_go": found.cost}, meta)


STAGE = Stage(
    name="leg",
    version=1,
    summary="the next leg of a drive to a goal, over ground that is known to be free",
    params=LegParams,
    inputs=("risk", "pose"),
    outputs=(
        Array(
            "path",
            ("vertex", "xy"),
            "float64",
            "m",
            "vertices of the leg, from where the vehicle stands",
            frame="world",
        ),
        Array("way", ("way_vertex", "xy"), "float64", "m", "vertices of the way to the goal as planned", frame="world"),
        Array("cost_to_go", ("row", "col"), "float32", "m", "price of the way from each cell to the goal", "nan"),
    ),
    requires=("numpy", "scipy"),
    run=_run,
)
