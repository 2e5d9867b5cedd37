"""A way over a pose graph as straight pieces to drive, with turns on the spot between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.planning.local_planner.state_lattice import AHEAD, BACK, LatticeGraph, angle_of

Clear = Callable[[Floats, Floats, Floats], bool]
"""Whether the vehicle may be at all of the poses x, y (m), heading (rad)."""

STEP_TURN = math.radians(5.0)
MIN_LENGTH_M = 1e-9
"""m; a shorter piece is a rounding error, and has no heading."""


@dataclass(frozen=True)
class Piece:
    """A straight piece from ``a`` to ``b`` (m), driven with ``heading`` (rad, counted on over turns), ``gear`` 1 ahead
    or -1 back; ``known``: the vehicle may drive there on what is known."""

    a: tuple[float, float]
    b: tuple[float, float]
    heading: float
    gear: int
    known: bool = True

    @property
    def length(self) -> float:
        """Metres."""
        return math.hypot(self.b[0] - self.a[0], self.b[1] - self.a[1])

    def cut(self, length: float) -> Piece:
        """The first ``length`` metres."""
        part = min(1.0, length / self.length)
        b = (self.a[0] + part * (self.b[0] - self.a[0]), self.a[1] + part * (self.b[1] - self.a[1]))
        return Piece(self.a, b, self.heading, self.gear, self.known)


def pieces(graph: LatticeGraph, moves: Sequence[tuple[int, int, int, int]]) -> list[Piece]:
    """Steps of a way as pieces; a turn over unknown ground makes the piece after it unknown."""
    out: list[Piece] = []
    grid, (pose, step, turn), sure = graph.grid, graph.known, True
    for (k, r, c, m), (k1, r1, c1, _) in itertools.pairwise(moves):
        if m in (AHEAD, BACK):
            # A step is stored once, with the place from which it leads ahead along the heading below half a turn.
            begin = (r, c) if (m == AHEAD) == (k % 16 < 8) else (r1, c1)
            here = pose[k % 8, r, c] and pose[k % 8, r1, c1] and step[k % 8, begin[0], begin[1]]
            x, y = grid.xy(np.array([r, r1], np.float64), np.array([c, c1], np.float64))
            a, b = (float(x[0]), float(y[0])), (float(x[1]), float(y[1]))
            out.append(Piece(a, b, grid.heading + angle_of(k), 1 if m == AHEAD else -1, bool(here and sure)))
            sure = True
        else:
            sure = sure and bool(turn[min(k, k1) % 8, r, c] and pose[k1 % 8, r, c])
    return out


def straightened(way: Sequence[Piece], heading: float, clear: Clear, spacing: float) -> list[Piece]:
    """Fewer and longer pieces of a known way: each as far as can be driven to directly, from ``heading`` on."""
    out: list[Piece] = []
    i = 0
    while i < len(way):
        last = i
        # Within one gear: a place where the vehicle reverses has its reason, and stays.
        while last + 1 < len(way) and way[last + 1].gear == way[i].gear:
            last += 1
        j, best = i, way[i]
        for end in range(last, i, -1):
            line = straight(way[i].a, way[end].b, way[i].heading, way[i].gear)
            after = way[end + 1].heading if end + 1 < len(way) else line.heading
            # A quarter turn or more off means that the way bends back: the straight line would be driven the other way
            # round.
            if abs(line.heading - way[i].heading) < 0.5 * math.pi and _drivable(line, heading, after, clear, spacing):
                j, best = end, line
                break
        out.append(best)
        heading, i = best.heading, j + 1
    return out


def straight(a: tuple[float, float], b: tuple[float, float], heading: float, gear: int) -> Piece:
    """The piece between two points, m; its heading is counted on from the one given, by the shorter turn."""
    dx, dy = gear * (b[0] - a[0]), gear * (b[1] - a[1])
    return Piece(a, b, heading + math.remainder(math.atan2(-dx, dy) - heading, 2 * math.pi), gear)


def _drivable(line: Piece, before: float, after: float, clear: Clear, spacing: float) -> bool:
    n = max(2, 1 + math.ceil(2.0 * line.length / spacing))
    share = np.linspace(0.0, 1.0, n)
    x, y = (line.a[i] + share * (line.b[i] - line.a[i]) for i in (0, 1))
    return (
        clear(x, y, np.full(n, line.heading))
        and turnable(line.a, before, line.heading, clear)
        and turnable(line.b, line.heading, after, clear)
    )


def turnable(at: tuple[float, float], before: float, after: float, clear: Clear) -> bool:
    """Whether the vehicle may turn on the spot from one heading to another, in the direction of their difference."""
    n = max(2, 1 + math.ceil(abs(after - before) / STEP_TURN))
    return clear(np.full(n, at[0]), np.full(n, at[1]), np.linspace(before, after, n))


def split(way: Sequence[Piece], length: float) -> tuple[list[Piece], list[Piece]]:
    """The first ``length`` metres of a way, and the rest."""
    first, rest = list[Piece](), list[Piece]()
    for piece in way:
        if length >= piece.length - MIN_LENGTH_M:
            first.append(piece)
        elif length <= MIN_LENGTH_M:
            rest.append(piece)
        else:
            first.append(piece.cut(length))
            rest.append(replace(piece, a=first[-1].b))
        length -= piece.length
    return first, rest


def within_turn(way: Sequence[Piece], heading: float, bound: float) -> tuple[list[Piece], float]:
    """The way as far as all its headings, the present one too, lie within a bound (rad) of each other; and the turn
    (rad) at its end towards where it goes on, as far as that keeps to the bound too."""
    out, low, high, now = list[Piece](), heading, heading, heading
    for piece in way:
        if max(high, piece.heading) - min(low, piece.heading) > bound + 1e-9:
            right, left = room_to_turn(low, high, now, bound)
            return out, max(-right, min(left, piece.heading - now))
        low, high, now = min(low, piece.heading), max(high, piece.heading), piece.heading
        out.append(piece)
    return out, 0.0


def room_to_turn(low: float, high: float, now: float, bound: float) -> tuple[float, float]:
    """Return the largest turns (rad) to the right and to the left after which all headings, so far from ``low`` to
    ``high``, differ by at most ``bound``."""
    return max(0.0, now - high + bound), max(0.0, low - now + bound)


def length_of(way: Sequence[Piece]) -> float:
    """Metres."""
    return sum(piece.length for piece in way)


def through(points: Floats, gear: NDArray[np.int8], heading: float) -> list[Piece]:
    """Straight pieces between points (n, 2), m, each driven with its ``gear`` (n - 1,); headings are counted on from
    the one given, by the shorter turn."""
    out: list[Piece] = []
    for a, b, g in zip(points[:-1].tolist(), points[1:].tolist(), gear.tolist(), strict=True):
        out.append(straight((a[0], a[1]), (b[0], b[1]), out[-1].heading if out else heading, g))
    return out


def vertices(way: Sequence[Piece], start: tuple[float, float]) -> Floats:
    """Vertices (vertex, 2) metres, the start first."""
    return np.array([start, *(piece.b for piece in way)], dtype=np.float64).reshape(-1, 2)
