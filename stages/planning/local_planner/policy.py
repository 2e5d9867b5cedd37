"""Plan the next leg of a drive to a goal: its path, how much of it is safe to drive now, or why no path exists.

The path is planned to the goal over the whole map. Known free ground costs its length. These kinds of ground may be
planned over, at a higher cost, but are never driven on (the leg ends before them):

- unknown ground, since the next stop will see it;
- ground that is hazardous only by the standard deviation of its elevations;
- at a still higher cost, likely but not certain hazards and the shadows of stones: both mostly remain so from nearer.

Ground that is certainly hazardous is closed, with the vehicle's margin around it. Where that leaves no path, the
vehicle may go back as it came, since its wheels have stood there, and look for another from where it was. Ground that
was seen only from afar counts as unknown, except for its hazards and for ground that is clearly free; it has a cost of
its own, because the matcher's windows smooth away relief that is smaller than they are on the ground.

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

from rille.stages.core.arrays import Bools, Floats
from rille.stages.planning.local_planner.clearance import Footing
from rille.stages.planning.local_planner.ground import (
    MIN_LEG_WHEELBASES,
    TOLERANCE_WHEELBASES,
    Ground,
    KnownFreeGround,
    LocalPlannerParams,
)
from rille.stages.planning.local_planner.look import AHEAD, FieldOfView, PlannerMemory, Stand, Target
from rille.stages.planning.local_planner.route import (
    Piece,
    length_of,
    split,
    straightened,
    through,
    turnable,
    vertices,
    within_turn,
)
from rille.stages.planning.path_ground import Point, cell_within

Before = tuple[Floats, NDArray[np.int8]]
"""Rest of a way: vertices (vertex, 2), m, and how it is driven (piece,), 1 ahead, -1 back."""

MAX_LOOKS = 3
"""Views taken from one place without a leg, after which the unknown ground ahead is closed."""
MIN_GAIN_SHARE = 0.15
"""Of its cost, by which a new path must be cheaper to replace the present one."""
LOOK_TURN = math.radians(25.0)
"""First turn of a look around; the next ones go as far to the other side."""


@dataclass(frozen=True)
class Leg:
    """``verdict``: drive, turn, look, closed, goal or no path; ``path`` (vertex, 2) m to drive, ``gear`` (piece,) 1 for
    ahead and -1 for back; ``turn`` rad then.

    ``closed``: looking did not help; ``where`` the way is not known to be free.

    ``way`` (vertex, 2) m to the goal, as it is planned; ``rest`` (vertex, 2) m of it after the leg, and ``rest_gear``
    (piece,) how it is driven.
    """

    verdict: str
    reason: str
    path: Floats
    gear: NDArray[np.int8]
    turn: float
    way: Floats
    rest: Floats
    rest_gear: NDArray[np.int8]
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
        cheaper by :data:`MIN_GAIN_SHARE`; None: there is none.
    view : the ground that the cameras of the vehicle see.

    Raises
    ------
    InputError
        Start or goal lies outside the map.
    """
    start, heading, memory = (stand[0], stand[1]), stand[2], memory or PlannerMemory()
    for name, point in (("start", start), ("goal", goal)):
        cell_within(footing.lattice, f"the {name}", point)
    base = footing.vehicle.wheel_base
    left = math.hypot(goal[0] - start[0], goal[1] - start[1])
    if left <= TOLERANCE_WHEELBASES * base:
        return _stay("goal", f"{1000 * left:.0f} mm from the goal", start, [])
    ground = Ground(footing, start, heading, params, memory.closed)
    # Half of the tolerance, so that a vehicle that ends a little beside its place has reached the goal nevertheless.
    goals, cost, move = ground.search(goal, 0.5 * TOLERANCE_WHEELBASES * base)
    kept, least, price = list[Piece](), ground.from_start(cost), math.inf
    if before is not None:
        kept, price = ground.again(_onward(before, start, heading, ground.grid.spacing))
    if not np.isfinite(min(least, price)):
        why = _why_closed(ground, goals, cost)
        turn = 0.0 if memory.looks >= MAX_LOOKS else _free_turn(ground, memory.looks)
        if turn:
            return _stay("look", f"{why}: looks around", start, [], turn=turn)
        if memory.track:
            ground.open_track(memory.track)
            goals, cost, move = ground.search(goal, 0.5 * TOLERANCE_WHEELBASES * base)
        if not np.isfinite(ground.from_start(cost)):
            return _stay("no path", why, start, [])
    # Without this the cheaper of two ways round a stone may change at each stop, and the vehicle goes to and fro.
    way = kept if kept and price <= (1.0 + MIN_GAIN_SHARE) * least else ground.way(move)
    plan = _straight(ground, way)
    known = _known_pieces(plan)
    target = Target(ground, view, ground.lacking(plan, known)) if known < len(plan) else None
    return _Plan(ground, way, plan, target, can_look=memory.looks < MAX_LOOKS).leg()


@dataclass(frozen=True)
class _Plan:
    """A way to the goal, with straightened first metres ``pieces``; the ground that has to be seen, None where all is
    known; whether the vehicle may look once more."""

    ground: Ground
    way: Sequence[Piece]
    pieces: Sequence[Piece]
    target: Target | None
    can_look: bool

    def leg(self) -> Leg:
        """Return the leg to the end of known ground, or to the last place that sees the unknown ground; where it would
        be shorter than the shortest leg, a look, or the place that looking did not open."""
        ground, target = self.ground, self.target
        base, start, heading = ground.vehicle.wheel_base, ground.start, ground.heading
        bound = math.radians(ground.p.max_turn_deg)
        leg, _ = split(self.pieces[: _known_pieces(self.pieces)], ground.p.max_length * base)
        least = MIN_LEG_WHEELBASES * base
        # A last piece to the goal may be shorter.
        if length_of(leg) < min(least, length_of(self.pieces) - 1e-9):
            # 120 degrees: largest turn that is tried to see the way from one place; one beyond the bound of a
            # leg is made in several legs.
            return self._look(math.radians(120.0)) or self._closed()
        facing = 0.0
        view = None if target is None else target.last_view(leg, bound)
        if view is not None and view[0] >= least:
            leg, facing = split(leg, view[0])[0], view[1]
        elif (look := self._look(bound)) is not None:
            return look
        leg, turn = within_turn(leg, heading, bound)
        if not leg:
            reason = f"turns {math.degrees(turn):.0f} degrees to where it goes on"
            return _stay("turn", reason, start, self.pieces, turn=turn)
        end, turn = leg[-1], turn or facing
        if not turnable(end.b, end.heading, end.heading + turn, ground.clear):
            turn = 0.0
        _, rest = split(self.pieces, length_of(leg))
        return Leg("drive", "", *_line(leg, start), turn, vertices(self.way, start), *_line(rest, end.b))

    def _look(self, widest: float) -> Leg | None:
        """A turn on the spot that shows the target; None: it was looked at too often, or is in view, or cannot be."""
        if self.target is None or not self.can_look:
            return None
        turn = self.target.turn(self.ground.start, self.ground.heading, widest, widest)
        if not turn:
            return None
        bound = math.radians(self.ground.p.max_turn_deg)
        turn = max(-bound, min(bound, turn))
        reason = f"turns {math.degrees(turn):.0f} degrees to see the way"
        return _stay("look", reason, self.ground.start, self.pieces, turn=turn)

    def _closed(self) -> Leg:
        """The place that looking did not open."""
        way, start = self.way, self.ground.start
        x, y = way[min(_known_pieces(way), len(way) - 1)].cut(self.ground.grid.spacing).b
        reason = f"the ground at ({x:.3f}, {y:.3f}) m was looked at in vain"
        return _stay("closed", reason, start, way, where=(x, y))


def _straight(ground: Ground, way: Sequence[Piece]) -> list[Piece]:
    """A way whose first metres are made straighter, as far as they are known."""
    # Beyond some legs the map will have changed before the vehicle is there: straightening it is for nothing.
    known = _known_pieces(way)
    first, rest = split(way[:known], 4.0 * ground.p.max_length * ground.vehicle.wheel_base)
    return [*straightened(first, ground.heading, ground.plain, ground.cell), *rest, *way[known:]]


def _line(way: Sequence[Piece], start: Point) -> tuple[Floats, NDArray[np.int8]]:
    """Vertices (n, 2) m, the start first, and gear (n - 1,)."""
    return vertices(way, start), np.array([piece.gear for piece in way], np.int8)


def _onward(before: Before, start: Point, heading: float, least: float) -> list[Piece]:
    """Rest of a way from the vehicle's place; vertices nearer than ``least`` metres are passed."""
    (points, gear), first = before, 1
    while first + 1 < len(points) and math.hypot(*(points[first] - start)) < least:
        first += 1
    return through(np.concatenate([[start], points[first:]]), gear[first - 1 :], heading)


def _stay(
    verdict: str,
    reason: str,
    start: Point,
    way: Sequence[Piece],
    *,
    turn: float = 0.0,
    where: Point | None = None,
) -> Leg:
    """A leg without a path, on the spot."""
    return Leg(verdict, reason, *_line([], start), turn, vertices(way, start), *_line(way, start), where)


def _known_pieces(way: Sequence[Piece]) -> int:
    """Number of pieces before the first that is not known to be free."""
    return next((i for i, piece in enumerate(way) if not piece.known), len(way))


def _free_turn(ground: Ground, looks: int) -> float:
    """Turn (rad) to look around, to one side and then farther to the other, that the wheels have room for; 0: none."""
    side = 1.0 if looks % 2 == 0 else -1.0
    turn = side * min(LOOK_TURN * (looks + 1), math.radians(ground.p.max_turn_deg))
    free = (t for t in (turn, -turn) if turnable(ground.start, ground.heading, ground.heading + t, ground.clear))
    return next(free, 0.0)


def shortest(footing: Footing, stand: Stand, goal: Point, params: LocalPlannerParams) -> float | None:
    """Length, m, of the shortest way over known ground, at no price but its length; None: none."""
    start, heading = (stand[0], stand[1]), stand[2]
    ground = KnownFreeGround(footing, start, heading, params)
    _, cost, move = ground.search(goal, 0.5 * TOLERANCE_WHEELBASES * footing.vehicle.wheel_base)
    if not np.isfinite(ground.from_start(cost)):
        return None
    return length_of(straightened(ground.way(move), heading, ground.clear, ground.cell))


def _why_closed(ground: Ground, goals: Bools, cost: Floats) -> str:
    if not ground.opens(goals):
        return "the goal itself is on hazardous ground, or too near to it"
    row, col = np.nonzero(np.isfinite(cost).any(axis=0))
    gap = float(np.hypot(row - ground.grid.origin[0], col - ground.grid.origin[1]).min()) * ground.grid.spacing
    return f"hazards close every way: ground from which the goal can be reached ends {1000 * gap:.0f} mm away"
