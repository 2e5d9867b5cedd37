"""A way over a pose graph as straight pieces to drive, with turns on the spot between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.pose_graph import AHEAD, ANGLES, BACK, PoseGraph, angle_of

Floats = NDArray[np.float64]
Clear = Callable[[Floats, Floats, Floats], bool]
"""Whether the vehicle may be at all of the poses x, y (m), heading (rad)."""

STEP_TURN = math.radians(5.0)


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


def pieces(
    graph: PoseGraph, known: tuple[NDArray[np.bool_], ...], moves: Sequence[tuple[int, int, int, int]]
) -> list[Piece]:
    """Steps of a way as pieces; a turn over unknown ground makes the piece after it unknown.

    ``known``: poses, steps and turns of the graph that are.
    """
    out: list[Piece] = []
    grid, sure = graph.grid, True
    for (k, r, c, m), (k1, r1, c1, _) in itertools.pairwise(moves):
        if m in (AHEAD, BACK):
            begin = (r, c) if (m == AHEAD) == (k % 16 < 8) else (r1, c1)
            here = known[0][k % 8, r, c] and known[0][k % 8, r1, c1] and known[1][k % 8, begin[0], begin[1]]
            x, y = grid.xy(np.array([r, r1], np.float64), np.array([c, c1], np.float64))
            a, b = (float(x[0]), float(y[0])), (float(x[1]), float(y[1]))
            out.append(Piece(a, b, grid.heading + angle_of(k), 1 if m == AHEAD else -1, bool(here and sure)))
            sure = True
        else:
            sure = sure and bool(known[2][min(k, k1) % 8, r, c] and known[0][k1 % 8, r, c])
    return out


def straightened(way: Sequence[Piece], heading: float, clear: Clear, spacing: float) -> list[Piece]:
    """Fewer and longer pieces of a known way: each as far as can be driven to directly, from ``heading`` on."""
    out: list[Piece] = []
    i = 0
    while i < len(way):
        last = i
        while last + 1 < len(way) and way[last + 1].gear == way[i].gear:
            last += 1
        j, best = i, way[i]
        for end in range(last, i, -1):
            line = _line(way[i], way[end])
            after = way[end + 1].heading if end + 1 < len(way) else line.heading
            if abs(line.heading - way[i].heading) < 0.5 * math.pi and _drivable(line, heading, after, clear, spacing):
                j, best = end, line
                break
        out.append(best)
        heading, i = best.heading, j + 1
    return out


def _line(first: Piece, last: Piece) -> Piece:
    dx, dy = first.gear * (last.b[0] - first.a[0]), first.gear * (last.b[1] - first.a[1])
    turn = math.remainder(math.atan2(-dx, dy) - first.heading, 2 * math.pi)
    return Piece(first.a, last.b, first.heading + turn, first.gear)


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


def first_metres(way: Sequence[Piece], length: float) -> list[Piece]:
    """The first ``length`` metres of a way."""
    out: list[Piece] = []
    for piece in way:
        if length <= 0:
            break
        out.append(piece.cut(length) if piece.length > length else piece)
        length -= piece.length
    return out


def within_turn(way: Sequence[Piece], heading: float, bound: float) -> tuple[list[Piece], float]:
    """The way as far as its headings stay within a bound (rad) about the present one; and the turn (rad) at its end
    towards where it goes on.

    That is as far as it stays within the bound too and what remains is between two headings of the planner. Where it
    goes on then is a way that is planned again; a turn that ends elsewhere may find none there, and turn back. Where
    there is no such turn there is none after a piece that is driven, and one to the bound where nothing is.
    """
    out, now = list[Piece](), heading
    for piece in way:
        if abs(piece.heading - heading) > bound + 1e-9:
            wanted = piece.heading - now
            side = math.copysign(1.0, wanted)
            room = bound - side * (now - heading)
            turn = _cut(abs(wanted), room)
            if turn is None:
                turn = 0.0 if out else room
            return out, side * turn
        now = piece.heading
        out.append(piece)
    return out, 0.0


def _cut(wanted: float, bound: float) -> float | None:
    """The greatest part of a turn within the bound of which the rest is between two headings; None: there is none."""
    parts = wanted - np.sort(ANGLES)
    parts = parts[(parts > 0) & (parts <= bound + 1e-9)]
    return float(parts[0]) if parts.size else None


def length_of(way: Sequence[Piece]) -> float:
    """Metres."""
    return sum(piece.length for piece in way)


def vertices(way: Sequence[Piece], start: tuple[float, float]) -> Floats:
    """Vertices (vertex, 2) metres, the start first."""
    return np.array([start, *(piece.b for piece in way)], dtype=np.float64).reshape(-1, 2)
