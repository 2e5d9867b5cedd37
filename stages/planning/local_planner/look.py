"""Where a vehicle looks next: at the ground for which its way is not known to be free, from where that comes into view.

What lies nearer than the images show, or to the side, is looked at before the vehicle comes too near to it, or from
farther back; by the geometry of the cameras. What was in view already, from the same side and no farther, and is not
known nevertheless, hides behind a stone or is the stone: looking again shows no more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.planning.local_planner.ground import Ground
from rille.stages.planning.local_planner.route import Piece, length_of, room_to_turn
from rille.stages.planning.local_planner.views import FieldOfView, Stand, bearing, looked

Floats = NDArray[np.float64]
Point = tuple[float, float]

STEP = math.radians(5.0)
"""Between the turns that are tried."""
ROUND = math.radians(120.0)
"""Largest of them: more than a leg may turn is turned in several."""
SIDE = math.radians(25.0)
"""Directions less apart show the same of what hides behind stones."""
FARTHER = 1.25
"""Times as far a look shows less."""
TWICE = 2
"""Looks from one side at one place are enough where they cost no way."""


@dataclass(frozen=True)
class Target:
    """Ground that has to be seen, ``points`` (n, 2) m, by what is in ``view``; ``before``: direction (rad) and distance
    (m) from which it was looked at already; ``unseen``: never from near, else it is doubtful though it was."""

    ground: Ground
    view: FieldOfView
    points: Floats
    unseen: bool
    before: list[tuple[float, float]]

    @staticmethod
    def of(ground: Ground, way: Sequence[Piece], first: int, view: FieldOfView, stands: Sequence[Stand]) -> Target:
        """What the first piece of a way that is not known needs; ``stands``: from where it looked so far."""
        points, unseen = ground.lacking(way, first)
        return Target(ground, view, points, unseen, looked(view, [*stands, (*ground.start, ground.heading)], points))

    def shows(self, stand: Stand, looks: int = 1) -> bool:
        """Whether it is in view from a place, and was looked at fewer times from there or nearer."""
        if not self.view.holds(self.points, stand):
            return False
        side, far = bearing(self.points, stand)
        same = (d <= FARTHER * far and abs(math.remainder(a - side, 2 * math.pi)) < SIDE for a, d in self.before)
        return sum(same) < looks

    def turn(self, at: Point, heading: float, right: float, left: float, looks: int = 1) -> float | None:
        """Least turn (rad) on the spot, within bounds and where the wheels have room, after which it is in view."""
        found = [0.0]
        for sign, most in ((1.0, left), (-1.0, right)):
            turns = np.array([sign * k * STEP for k in range(1, 1 + math.floor(max(most, 0.0) / STEP + 1e-9))])
            free = self.ground.free(np.full(turns.shape, at[0]), np.full(turns.shape, at[1]), heading + turns)
            found += turns[np.logical_and.accumulate(free)].tolist()
        return next((t for t in sorted(found, key=abs) if self.shows((*at, heading + t), looks)), None)

    def last_view(self, leg: Sequence[Piece], bound: float) -> tuple[float, float] | None:
        """Metres of a leg after which it is last in view, and the turn (rad) for that, with all headings of the leg
        within a bound (rad) of each other; None: nowhere on it."""
        headings = np.array([self.ground.heading, *(piece.heading for piece in leg)])
        low, high = np.minimum.accumulate(headings), np.maximum.accumulate(headings)
        for done, k, share in _backward(leg, 2.0 * self.ground.cell):
            piece = leg[k]
            at = tuple(a + share * (b - a) for a, b in zip(piece.a, piece.b, strict=True))
            room = room_to_turn(float(low[k + 1]), float(high[k + 1]), piece.heading, bound)
            turn = self.turn((at[0], at[1]), piece.heading, *room)
            if turn is not None:
                return done, turn
        return None

    def back(self) -> tuple[list[Piece], float] | None:
        """The least way straight back, and turn (rad) then, after which it is in view; None: there is none, or it was
        seen from near and is doubtful, which it mostly stays."""
        if not self.unseen:
            return None
        ground, bound = self.ground, math.radians(self.ground.p.max_turn_deg)
        p, base = ground.p, ground.vehicle.wheel_base
        for piece in free_back(ground, p.blind * base):
            if length_of([piece]) < p.least * base:
                continue
            turn = self.turn(piece.b, ground.heading, bound, bound)
            if turn is not None:
                return [piece], turn
        return None


def free_back(ground: Ground, most: float) -> list[Piece]:
    """Straight back, as far as it is free and at most so many metres: pieces, each longer than the one before."""
    n = math.ceil(2.0 * most / ground.cell)
    way = np.linspace(0.0, most, n + 1)
    x, y = ground.start[0] + way * math.sin(ground.heading), ground.start[1] - way * math.cos(ground.heading)
    free = np.logical_and.accumulate(ground.free(x, y, np.full(way.shape, ground.heading)))
    ends = list(zip(x[free].tolist(), y[free].tolist(), strict=True))
    return [Piece(ground.start, end, ground.heading, -1) for end in ends[1:]]


def _backward(leg: Sequence[Piece], step: float) -> Iterator[tuple[float, int, float]]:
    """Places of a leg from its end on: metres from its beginning, number of the piece and the share of it."""
    done = length_of(leg)
    for k, piece in reversed(list(enumerate(leg))):
        done -= piece.length
        for share in np.linspace(1.0, 0.0, max(2, 1 + math.ceil(piece.length / step))).tolist():
            yield done + share * piece.length, k, share
