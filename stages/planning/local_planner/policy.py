"""Plan the next leg of a drive to a goal: its path, how much of it is safe to drive now, or why no path exists.

The path is planned to the goal over the whole map. Known free ground costs its length. These kinds of ground may be
planned over, at a higher cost, but are never driven on (the leg ends before them):

- unknown ground, since the next stop will see it;
- ground that is hazardous only by the standard deviation of its elevations;
- at a still higher cost, likely but not certain hazards and the shadows of stones: both mostly remain so from nearer.

Ground that is certainly hazardous is closed, with the vehicle's margin around it. Ground that was seen only from afar
counts as unknown, except for its hazards and for ground that is clearly free; it has a cost of its own, because the
matcher's windows smooth away relief that is smaller than they are on the ground.

So the path avoids dead ends as soon as they are seen, and if no path is left even over unknown ground, there is none.
This is the usual free-space assumption (Koenig, Tovey, Smirnov 2003, doi:10.1016/S0004-3702(03)00062-6), planned
anew at each stop.

The vehicle drives ahead, or back at a higher price, and turns on the spot where its wheels have room to
(:mod:`rille.stages.planning.local_planner.state_lattice`): it may pass between two hazards between which it could not
turn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.errors import InputError
from rille.stages.geometry.lattice import Lattice
from rille.stages.planning.local_planner.clearance import Footing
from rille.stages.planning.local_planner.ground import Ground
from rille.stages.planning.local_planner.look import AHEAD, ROUND, TWICE, FieldOfView, PlannerMemory, Stand, Target
from rille.stages.planning.local_planner.params import LocalPlannerParams
from rille.stages.planning.local_planner.route import (
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

Point = tuple[float, float]
Before = tuple[Floats, NDArray[np.int8]]
"""What is left of a way: vertices (vertex, 2), m, and how it is driven (piece,), 1 ahead, -1 back."""

ASIDE = tuple(math.radians(d) for d in (15.0, -15.0))
"""Turns for another look at what is in view."""


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
    cost: Floats32
    where: Point | None = None


def plan_leg(
    footing: Footing,
    stand: Stand,
    goal: Point,
    params: LocalPlannerParams,
    memory: PlannerMemory | None = None,
    before: Before | None = None,
    view: FieldOfView = AHEAD,
) -> Leg:
    """The next leg.

    Parameters
    ----------
    footing : of the map known so far.
    stand : where the vehicle is.
    goal : m.
    memory : earlier looks of the vehicle; None: none.
    before : rest of the path planned at the last stop: (vertex, 2) m, (piece,) gear. It is kept unless another one is
        cheaper by ``replan_hysteresis``; None: there is none.
    view : the ground that the cameras of the vehicle see.

    Raises
    ------
    InputError
        Start or goal lies outside the map.
    """
    start, heading, memory = (stand[0], stand[1]), stand[2], memory or PlannerMemory()
    looks = memory.looks
    for name, point in (("start", start), ("goal", goal)):
        _check(footing.lattice, name, point)
    base = footing.vehicle.wheel_base
    left = math.hypot(goal[0] - start[0], goal[1] - start[1])
    if left <= params.tolerance * base:
        nothing = np.full(footing.lattice.shape, np.nan, np.float32)
        return _stay("goal", f"{1000 * left:.0f} mm from the goal", start, [], nothing)
    ground = Ground(footing, start, heading, params, memory.closed)
    # Half of the tolerance, so that a vehicle that ends a little beside its place has reached the goal nevertheless.
    goals, cost, move = ground.search(goal, 0.5 * params.tolerance * base)
    shown, least = ground.on_map(cost), ground.from_start(cost)
    kept, price = list[Piece](), math.inf
    if before is not None:
        kept, price = ground.again(_onward(before, start, heading, ground.grid.spacing))
    # Only as the last resort: each of them builds a graph of its own, which takes as long as the first.
    for other in ground.beside() if not np.isfinite(min(least, price)) and ground.opens(goals) else ():
        _, found, move = other.search(goal, 0.5 * params.tolerance * base)
        least = other.from_start(found)
        if np.isfinite(least):
            ground, shown = other, other.on_map(found)
            break
    if not np.isfinite(min(least, price)):
        why = _why_closed(ground, goals, cost)
        turn = 0.0 if looks >= params.max_looks else _free_turn(ground, looks)
        if turn:
            return _stay("look", f"{why}: looks around", start, [], shown, turn)
        return _stay("no path", why, start, [], shown)
    # Without this the cheaper of two ways round a stone may change at each stop, and the vehicle goes to and fro.
    way = kept if kept and price <= (1.0 + params.replan_hysteresis) * least else ground.way(move)
    plan = _plain(ground, way)
    first = _sure(plan)
    target = Target.of(ground, plan, first, view, memory.stands) if first < len(plan) else None
    onwards = _onwards(ground, way, plan, shown, target, looks)
    if onwards is None:
        assert target is not None, "what is known to the goal can be driven"
        return _look(target, way, plan, shown, looks)
    return onwards


def _plain(ground: Ground, way: Sequence[Piece]) -> list[Piece]:
    """A way whose first metres are made straighter, as far as they are known."""
    # Beyond some legs the map will have changed before the vehicle is there: straightening it is for nothing.
    sure = first_metres(way[: _sure(way)], 4.0 * ground.p.max_length * ground.vehicle.wheel_base)
    straight = straightened(sure, ground.heading, ground.plain, ground.cell)
    return [*straight, *last_metres(way, length_of(sure))]


def _onwards(
    ground: Ground,
    way: Sequence[Piece],
    plan: Sequence[Piece],
    shown: Floats32,
    target: Target | None,
    looks: int,
) -> Leg | None:
    """Return the leg along a path: to the end of known ground, or to the last place that sees the unknown ground.

    None: this leg would be shorter than ``min_length``.
    """
    p, base, start, heading = ground.p, ground.vehicle.wheel_base, ground.start, ground.heading
    bound = math.radians(p.max_turn_deg)
    leg = first_metres(plan[: _sure(plan)], p.max_length * base)
    # A last piece to the goal may be shorter.
    if length_of(leg) < min(p.min_length * base, length_of(plan) - 1e-9):
        return None
    seen = None if target is None else target.last_view(leg, bound)
    facing = 0.0
    if seen is not None and seen[0] >= p.min_length * base:
        leg, facing = first_metres(leg, seen[0]), seen[1]
    elif target is not None and looks < p.max_looks:
        turn = target.turn(start, heading, bound, bound)
        if turn:
            return _stay("look", f"turns {math.degrees(turn):.0f} degrees to see the way", start, plan, shown, turn)
    leg, turn = within_turn(leg, heading, bound)
    if not leg:
        return _stay("turn", f"turns {math.degrees(turn):.0f} degrees to where it goes on", start, plan, shown, turn)
    end = leg[-1]
    turn = turn or facing
    if not turnable(end.b, end.heading, end.heading + turn, ground.clear):
        turn = 0.0
    rest = last_metres(plan, length_of(leg))
    return Leg("drive", "", *_line(leg, start), turn, vertices(way, start), *_line(rest, end.b), shown)


def _look(target: Target, way: Sequence[Piece], plan: Sequence[Piece], shown: Floats32, looks: int) -> Leg:
    """A look at where a way is not known, or that looks did not help."""
    ground = target.ground
    p, start, heading = ground.p, ground.start, ground.heading
    if looks < p.max_looks:
        turn = target.turn(start, heading, ROUND, ROUND, TWICE)
        if turn == 0.0:  # in view, but not known: once more from a little aside
            turn = next((t for t in ASIDE if turnable(start, heading, heading + t, ground.clear)), 0.0)
        if turn:
            bound = math.radians(p.max_turn_deg)
            turn = max(-bound, min(bound, turn))
            return _stay("look", f"turns {math.degrees(turn):.0f} degrees to see the way", start, way, shown, turn)
        found = target.back()
        if found is not None:
            back, turn = found
            reason = f"drives back {1000 * length_of(back):.0f} mm to see the ground before it"
            rest = [Piece(back[-1].b, start, heading, 1), *plan]
            return Leg("look", reason, *_line(back, start), turn, vertices(way, start), *_line(rest, back[-1].b), shown)
    x, y = way[min(_sure(way), len(way) - 1)].cut(ground.grid.spacing).b
    reason = f"the ground at ({x:.3f}, {y:.3f}) m was looked at in vain"
    return _stay("closed", reason, start, way, shown, where=(x, y))


def _line(way: Sequence[Piece], start: Point) -> tuple[Floats, NDArray[np.int8]]:
    """Vertices (n, 2) m, the start first, and gear (n - 1,)."""
    return vertices(way, start), np.array([piece.gear for piece in way], np.int8)


def _onward(before: Before, start: Point, heading: float, least: float) -> list[Piece]:
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
    cost: Floats32,
    turn: float = 0.0,
    where: Point | None = None,
) -> Leg:
    """A leg on the spot."""
    return Leg(verdict, reason, *_line([], start), turn, vertices(way, start), *_line(way, start), cost, where)


def _sure(way: Sequence[Piece]) -> int:
    """Number of pieces before the first that is not known to be free."""
    return next((i for i, piece in enumerate(way) if not piece.known), len(way))


def _free_turn(ground: Ground, looks: int) -> float:
    """Turn (rad) to look around, to one side and then to the other, that the wheels have room for; 0: none."""
    bound = math.radians(ground.p.max_turn_deg)
    # Each turn starts where the last one ended: they look 25 degrees to the left of the first heading, 25 to the right
    # and 50 to the left, as far as the bound lets them.
    aside = [math.radians(d) for d in (25.0, -50.0, 75.0)]
    aside = aside[looks % 3 :] + aside[: looks % 3] + [math.radians(d) for d in (-25.0, 15.0, -15.0)]
    for turn in (max(-bound, min(bound, a)) for a in aside):
        if turnable(ground.start, ground.heading, ground.heading + turn, ground.clear):
            return turn
    return 0.0


def shortest(footing: Footing, stand: Stand, goal: Point, params: LocalPlannerParams) -> float | None:
    """Length, m, of the shortest way over known ground, at no price but its length; None: none."""
    free = {"unknown_cost": math.inf, "proximity_cost": 0.0, "caution_cost": 0.0, "turn_cost": 0.0, "reverse_cost": 1.0}
    start, heading = (stand[0], stand[1]), stand[2]
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
            "RIL-366",
            f"the {name} ({point[0]:.3f}, {point[1]:.3f}) m is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )


def _why_closed(ground: Ground, goals: Bools, cost: Floats) -> str:
    if not ground.opens(goals):
        return "the goal itself is on hazardous ground, or too near to it"
    row, col = np.nonzero(np.isfinite(cost).any(axis=0))
    gap = float(np.hypot(row - ground.grid.origin[0], col - ground.grid.origin[1]).min()) * ground.grid.spacing
    return f"hazards close every way: ground from which the goal can be reached ends {1000 * gap:.0f} mm away"
