"""The next leg of a drive to a goal: where to, how far of it is safe to drive now, or why no way leads there.

The way is planned to the goal over all of the map. Ground that is known and free costs its length; unknown ground may
be planned over, at a higher price, since the next stop will see it, but is never driven on: the leg ends before it. So
may ground that is hazardous only by the standard deviation of its elevations, and, dearer, what is likely hazardous but
not certainly so, and the shadows of stones: both mostly stay as they are when looked at from nearer. Ground that is
known to be hazardous, or nearer to it than the vehicle and its margin need, is closed. What was seen from afar alone
counts as unknown but for its hazards and for what is clearly free, at a price of its own: the windows of a matcher
smooth away what is smaller than they are on the ground.

So the way bends round dead ends as soon as they are seen, and where no way is left even over unknown ground there is
none. This is the usual free-space assumption (Koenig, Tovey, Smirnov 2003, doi:10.1016/S0004-3702(03)00062-6), planned
anew at each stop.

The vehicle drives ahead, or back at a higher price, and turns on the spot where its wheels have room to
(:mod:`stages.pose_graph`): it may pass between two hazards between which it could not turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.declare import Array, Bundle, Inputs, Stage
from stages.errors import InputError
from stages.footing import Footing
from stages.geometry import RigidTransform
from stages.lattice import Lattice
from stages.leg_ground import Ground
from stages.leg_params import LegParams
from stages.route import (
    Piece,
    first_metres,
    last_metres,
    length_of,
    straightened,
    through,
    turnable,
    vertices,
    within_turn,
)
from stages.vehicle import Vehicle
from stages.verdict import HAZARDOUS, UNKNOWN, UNSEEN_BIT

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Point = tuple[float, float]


FACING = math.radians(8.0)
"""What lies within it of the heading is looked at already."""


@dataclass(frozen=True)
class Leg:
    """``verdict``: drive, turn, look, closed, goal or no path; ``path`` (vertex, 2) m to drive, ``gear`` (piece,) 1 for
    ahead and -1 for back; ``turn`` rad then.

    A look around turns, or drives back to see what lies nearer than the camera's view. ``closed``: it did not help;
    ``where`` the way is not known to be free.

    ``way`` (vertex, 2) m to the goal, as it is planned; ``rest`` (vertex, 2) m what is left of it after the leg, and
    ``rest_gear`` (piece,) how it is driven; ``cost`` (row, col) m to the goal at these prices at the best
    heading, NaN where it is closed, or farther than the vehicle.
    """

    verdict: str
    reason: str
    path: Floats
    gear: NDArray[np.int8]
    turn: float
    way: Floats
    rest: Floats
    rest_gear: NDArray[np.int8]
    cost: NDArray[np.float32]
    where: Point | None = None


def plan_leg(
    footing: Footing,
    start: Point,
    heading: float,
    goal: Point,
    params: LegParams,
    looks: int = 0,
    closed: Sequence[Point] = (),
    before: tuple[Floats, NDArray[np.int8]] | None = None,
    backs: Sequence[Point] = (),
) -> Leg:
    """The next leg.

    Parameters
    ----------
    footing : of the map known so far.
    start, heading : m; rad to the left of y.
    looks : looks around since the last leg that was driven.
    closed : places about which unknown ground was looked at in vain.
    before : what was left, after the last leg, of the way planned then: (vertex, 2) m, (piece,) gear. It is kept unless
        another one is better by ``loyalty``; None: there is none.
    backs : places from which it drove back already, to see what lies before it.

    Raises
    ------
    InputError
        Start or goal lies outside the map.
    """
    for name, point in (("start", start), ("goal", goal)):
        _check(footing.lattice, name, point)
    base = footing.vehicle.wheel_base
    left = math.hypot(goal[0] - start[0], goal[1] - start[1])
    if left <= params.tolerance * base:
        nothing = np.full(footing.lattice.shape, np.nan, np.float32)
        return _stay("goal", f"{1000 * left:.0f} mm from the goal", start, [], nothing)
    ground = Ground(footing, start, heading, params, closed)
    goals, cost, move = ground.search(goal, 0.5 * params.tolerance * base)
    shown, least = ground.on_map(cost), ground.from_start(cost)
    kept, price = list[Piece](), math.inf
    if before is not None:
        kept, price = ground.again(_onward(before, start, heading, ground.grid.spacing))
    for other in ground.beside() if not np.isfinite(min(least, price)) and ground.opens(goals) else ():
        _, found, move = other.search(goal, 0.5 * params.tolerance * base)
        least = other.from_start(found)
        if np.isfinite(least):
            ground, shown = other, other.on_map(found)
            break
    if not np.isfinite(min(least, price)):
        why = _why_closed(ground, goals, cost)
        turn = 0.0 if looks >= params.looks else _free_turn(ground, 0.0, looks)
        if turn:
            return _stay("look", f"{why}: looks around", start, [], shown, turn)
        return _stay("no path", why, start, [], shown)
    way = kept if kept and price <= (1.0 + params.loyalty) * least else ground.way(move)
    plan = _plain(ground, way)
    return _onwards(ground, way, plan, shown, looks) or _look(ground, way, plan, shown, looks, backs)


def _plain(ground: Ground, way: Sequence[Piece]) -> list[Piece]:
    """A way whose first metres are made straighter, as far as they are known."""
    sure = first_metres(way[: _sure(way)], 4.0 * ground.p.length * ground.vehicle.wheel_base)
    straight = straightened(sure, ground.heading, ground.plain, ground.cell)
    return [*straight, *last_metres(way, length_of(sure))]


def _onwards(
    ground: Ground, way: Sequence[Piece], plan: Sequence[Piece], shown: NDArray[np.float32], looks: int
) -> Leg | None:
    """The leg along a way: as far as it is known, and not nearer to where it is not than can be seen from there. None:
    that is not worth a stop."""
    p, base, start, heading = ground.p, ground.vehicle.wheel_base, ground.start, ground.heading
    bound = math.radians(p.max_turn_deg)
    leg = first_metres(plan[: _sure(plan)], p.length * base)
    if length_of(leg) < min(p.least * base, length_of(way) - 1e-9):
        return None
    look_at = _unknown(ground, plan)
    off = math.inf if look_at is None else _metres_before(leg, look_at, p.blind * base, ground.cell)
    if look_at is not None and off < p.least * base:
        towards = _towards(start, look_at, heading)
        turn = max(-bound, min(bound, towards))
        if off > 0 and looks == 0 and abs(towards) >= FACING and turnable(start, heading, heading + turn, ground.clear):
            return _stay("look", f"turns {math.degrees(turn):.0f} degrees to see the way", start, plan, shown, turn)
        off = math.inf
    leg = first_metres(leg, off)
    leg, turn = within_turn(leg, heading, bound)
    if not leg:
        return _stay("turn", f"turns {math.degrees(turn):.0f} degrees to where it goes on", start, plan, shown, turn)
    end = leg[-1]
    if look_at is not None and turn == 0.0 and math.isfinite(off):
        turn = _towards(end.b, look_at, end.heading)
        turn = max(heading - bound - end.heading, min(heading + bound - end.heading, turn))
    if not turnable(end.b, end.heading, end.heading + turn, ground.clear):
        turn = 0.0
    rest = last_metres(plan, length_of(leg))
    return Leg("drive", "", *_line(leg, start), turn, vertices(way, start), *_line(rest, end.b), shown)


def _look(
    ground: Ground,
    way: Sequence[Piece],
    plan: Sequence[Piece],
    shown: NDArray[np.float32],
    looks: int,
    backs: Sequence[Point],
) -> Leg:
    """A look at where a way is not known, or that looks did not help."""
    p, base, start, heading = ground.p, ground.vehicle.wheel_base, ground.start, ground.heading
    first = min(_sure(way), len(way) - 1)
    x, y = way[first].cut(ground.grid.spacing).b
    towards = _towards(start, (x, y), heading)
    again = any(math.hypot(start[0] - bx, start[1] - by) < p.vain * base for bx, by in backs)
    if looks < p.looks and not again and (looks > 0 or abs(towards) < FACING) and ground.unseen(way, first):
        back = _free_back(ground, p.blind * base)
        if length_of(back) >= p.least * base:
            reason = f"drives back {1000 * length_of(back):.0f} mm to see the ground before it"
            rest = [Piece(back[-1].b, start, heading, 1), *plan]
            return Leg("look", reason, *_line(back, start), 0.0, vertices(way, start), *_line(rest, back[-1].b), shown)
    turn = 0.0 if looks >= p.looks else _free_turn(ground, towards, looks)
    if turn:
        return _stay("look", f"turns {math.degrees(turn):.0f} degrees to see the way", start, way, shown, turn)
    reason = f"{looks} looks around did not show the ground at ({x:.3f}, {y:.3f}) m"
    return _stay("closed", reason, start, way, shown, where=(x, y))


def _unknown(ground: Ground, way: Sequence[Piece]) -> Point | None:
    """Where a way is first not known to be free; None: nowhere."""
    first = _sure(way)
    return way[first].cut(ground.grid.spacing).b if first < len(way) else None


def _towards(at: Point, point: Point, heading: float) -> float:
    """Turn (rad) from a heading to face a point."""
    return math.remainder(math.atan2(at[0] - point[0], point[1] - at[1]) - heading, 2 * math.pi)


def _metres_before(way: Sequence[Piece], point: Point, distance: float, step: float) -> float:
    """Metres of a way before it comes nearer to a point than this; infinite: it does not; 0: it begins there."""
    done = 0.0
    for piece in way:
        n = max(2, 1 + math.ceil(piece.length / step))
        share = np.linspace(0.0, 1.0, n)
        x, y = (piece.a[i] + share * (piece.b[i] - piece.a[i]) for i in (0, 1))
        near = np.hypot(x - point[0], y - point[1]) < distance
        if near.any():
            return done + piece.length * float(share[max(int(np.argmax(near)) - 1, 0)])
        done += piece.length
    return math.inf


def _line(way: Sequence[Piece], start: Point) -> tuple[Floats, NDArray[np.int8]]:
    """Vertices (n, 2) m, the start first, and gear (n - 1,)."""
    return vertices(way, start), np.array([piece.gear for piece in way], np.int8)


def _onward(before: tuple[Floats, NDArray[np.int8]], start: Point, heading: float, least: float) -> list[Piece]:
    """What was left of a way, from where the vehicle is now; vertices nearer than ``least`` metres are passed."""
    (points, gear), first = before, 1
    while first + 1 < len(points) and math.hypot(*(points[first] - start)) < least:
        first += 1
    return through(np.concatenate([[start], points[first:]]), gear[first - 1 :], heading)


def _stay(
    verdict: str,
    reason: str,
    start: Point,
    way: Sequence[Piece],
    cost: NDArray[np.float32],
    turn: float = 0.0,
    where: Point | None = None,
) -> Leg:
    """A leg on the spot."""
    return Leg(verdict, reason, *_line([], start), turn, vertices(way, start), *_line(way, start), cost, where)


def _sure(way: Sequence[Piece]) -> int:
    """Number of pieces before the first that is not known to be free."""
    return next((i for i, piece in enumerate(way) if not piece.known), len(way))


def _free_turn(ground: Ground, towards: float, looks: int) -> float:
    """Turn (rad) to look along the way, where it looks there already to one side and then to the other, that the
    wheels have room for; 0: none."""
    bound = math.radians(ground.p.max_turn_deg)
    aside = [math.radians(d) for d in (25.0, -50.0, 75.0)]
    aside = aside[looks % 3 :] + aside[: looks % 3] + [math.radians(d) for d in (-25.0, 15.0, -15.0)]
    wanted = [*([towards] if abs(towards) >= FACING else []), *aside]
    for turn in (max(-bound, min(bound, w)) for w in wanted):
        if turnable(ground.start, ground.heading, ground.heading + turn, ground.clear):
            return turn
    return 0.0


def _free_back(ground: Ground, most: float) -> list[Piece]:
    """Straight back, at most so many metres, as far as it is free: then the camera sees what it is blind to now."""
    n = math.ceil(2.0 * most / ground.cell)
    way = np.linspace(0.0, most, n + 1)
    x, y = ground.start[0] + way * math.sin(ground.heading), ground.start[1] - way * math.cos(ground.heading)
    free = ground.free(x, y, np.full(way.shape, ground.heading))
    last = int(np.argmin(free)) - 1 if not free.all() else n
    return [Piece(ground.start, (float(x[last]), float(y[last])), ground.heading, -1)] if last > 0 else []


def shortest(footing: Footing, start: Point, heading: float, goal: Point, params: LegParams) -> float | None:
    """Length, m, of the shortest way over known ground, at no price but its length; None: none."""
    free = {"unknown_price": math.inf, "near_price": 0.0, "caution_price": 0.0, "turn_price": 0.0, "back_price": 1.0}
    ground = Ground(footing, start, heading, params.model_copy(update=free))
    _, cost, move = ground.search(goal, 0.5 * params.tolerance * footing.vehicle.wheel_base)
    if not np.isfinite(ground.from_start(cost)):
        return None
    return length_of(straightened(ground.way(move), heading, ground.clear, ground.cell))


def _check(lattice: Lattice, name: str, point: Point) -> None:
    row, col = (int(v) for v in np.rint(lattice.index(point)))
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            f"the {name} ({point[0]:.3f}, {point[1]:.3f}) m is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )


def _why_closed(ground: Ground, goals: Mask, cost: Floats) -> str:
    if not ground.opens(goals):
        return "the goal itself is on hazardous ground, or too near to it"
    row, col = np.nonzero(np.isfinite(cost).any(axis=0))
    gap = float(np.hypot(row - ground.grid.origin[0], col - ground.grid.origin[1]).min()) * ground.grid.spacing
    return f"hazards close every way: ground from which the goal can be reached ends {1000 * gap:.0f} mm away"


def _run(params: LegParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    risk = inputs["risk"]
    lattice, vehicle = Lattice.from_dict(risk.meta["lattice"]), Vehicle.model_validate(risk.meta["vehicle"])
    T_world_left = RigidTransform.from_matrix(np.asarray(inputs["pose"]["poses"])[-1])
    T = T_world_left @ RigidTransform.from_matrix(args["T_vehicle_left"]).inverse()
    start = float(T.translation[0]), float(T.translation[1])
    heading = math.atan2(-T.rotation[0, 1], T.rotation[1, 1])
    goal = (float(args["goal"][0]), float(args["goal"][1]))
    closed = [(float(x), float(y)) for x, y in args["closed"]]
    before = None
    if "before" in inputs and len(inputs["before"]["rest_gear"]):
        before = np.asarray(inputs["before"]["rest"]), np.asarray(inputs["before"]["rest_gear"])
    (classes, reason, chance), seen = seen_so_far(risk, inputs.get("far"), params)
    for sure in params.sure:
        footing = Footing.of(classes, reason, lattice, vehicle, chance, sure, params.dare, **seen)
        found = plan_leg(footing, start, heading, goal, params, int(args["looks"]), closed, before, args["backs"])
        if found.verdict == "goal" or len(found.way) > 1:
            break
    best: float | None = None
    margin: float | None = None
    for margin in (vehicle.margin, 0.0) if args.get("whole") else ():
        bare = vehicle.model_copy(update={"margin": margin})
        allowed = Footing.of(classes, reason, lattice, bare, chance, params.sure[-1], params.dare)
        best = shortest(allowed, start, heading, goal, params)
        if best is not None:
            break
    meta = {
        "shortest_m": best,
        "shortest_margin_m": margin,
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
    arrays: dict[str, NDArray[Any]] = {"path": found.path, "gear": found.gear, "way": found.way}
    arrays |= {"rest": found.rest, "rest_gear": found.rest_gear, "cost_to_go": found.cost}
    return Bundle(arrays, meta)


def seen_so_far(near: Bundle, far: Bundle | None, p: LegParams) -> tuple[list[NDArray[Any]], dict[str, Mask | None]]:
    """Classes, reasons and probabilities (row, col) of a map, of which only what was seen from near is driven on; and
    how well each cell is known, as :meth:`stages.footing.Footing.of` asks for it."""
    names = ("risk", "reason", "p_hazard")
    maps = [np.asarray(near[name]) for name in names]
    unknown, glanced = maps[0] == UNKNOWN, None
    if far is not None:
        # at the rim of what is near, a window is cut off, which widens the doubt; all of it was seen from afar, which
        # counts where it looks clearly free
        chance = np.asarray(far["p_hazard"])
        cut = unknown | (((maps[1] & UNSEEN_BIT) != 0) & (chance < p.clear))
        maps = [np.where(cut, np.asarray(far[name]), seen) for name, seen in zip(names, maps, strict=True)]
        unknown &= ~(maps[2] < p.clear)
        glanced = unknown & (maps[0] < HAZARDOUS)
    return maps, {"unknown": unknown, "glanced": glanced, "doubted": maps[2] >= p.avoid}


def _length(path: Floats) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) > 1 else 0.0


STAGE = Stage(
    name="leg",
    version=8,
    summary="the next leg of a drive to a goal, over ground that is known to be free",
    params=LegParams,
    inputs=("risk", "far?", "pose", "before?"),
    outputs=(
        Array(
            "path",
            ("vertex", "xy"),
            "float64",
            "m",
            "vertices of the leg, from where the vehicle stands",
            frame="world",
        ),
        Array("gear", ("piece",), "int8", "1", "1 where the leg is driven ahead, -1 where it is driven back"),
        Array("way", ("way_vertex", "xy"), "float64", "m", "vertices of the way to the goal as planned", frame="world"),
        Array(
            "rest", ("rest_vertex", "xy"), "float64", "m", "vertices of what is left of it after the leg", frame="world"
        ),
        Array("rest_gear", ("rest_piece",), "int8", "1", "1 where that is driven ahead, -1 where it is driven back"),
        Array("cost_to_go", ("row", "col"), "float32", "m", "price of the way from each cell to the goal", "nan"),
    ),
    requires=("numpy", "numba", "scipy"),
    run=_run,
)
