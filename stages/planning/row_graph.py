"""The row-monotone graph, solved in one sweep (section 4.7).

Each node of a row has edges to three nodes of the next row (same column and its neighbours), weighted by the absolute
height difference. Rounded heights are integers, so sums are exact and ties are ties: among equals the path with fewest
sideways moves wins, then the one whose last move is straight, else to the left, else to the right.

Since all edges lead from row to row, Dijkstra's algorithm is one sweep over the rows, O(N) in the number of cells, and
yields all targets of the far row at once (Figure 3). An edge can be used where the vehicle may stand at both its ends
in the direction of the edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes
from rille.stages.planning.configuration_space import LEFT, RIGHT, STRAIGHT

Ints = NDArray[np.integer[Any]]
Cell = tuple[int, int]

UNREACHED = np.iinfo(np.int64).max // 4
MOVES = ((0, STRAIGHT), (1, LEFT), (-1, RIGHT))
"""Column of the predecessor minus the cell's own, and the direction of the move, in order of preference."""


@dataclass(frozen=True)
class Plan:
    """Result of a sweep, in cells of its grid.

    ``cells`` (vertex, 2) row, column from start to target, empty where there is no path; ``cost`` (row, col) int64 of
    :func:`sweep`; ``reachable`` (col,) of ``target_row``; ``blocking_row`` the first row that cannot be entered and
    ``reason`` in words, both empty where there is a path.
    """

    cells: NDArray[np.int64]
    cost: NDArray[np.int64]
    reachable: Bools
    target_row: int
    blocking_row: int | None = None
    reason: str = ""


class Charges(NamedTuple):
    """Costs of a path in addition to the height differences, in their unit: ``toll`` (row, col) for entering a cell,
    None: no cost; ``sideways`` for the greater length of a move to a neighbouring column."""

    toll: Ints | None = None
    sideways: int = 0


FREE = Charges()


class EndCells(NamedTuple):
    """Start and target, row and column inside a grid; None: not given."""

    start: Cell | None = None
    target: Cell | None = None


def sweep(
    height: Ints, ways: Bytes, sources: Bools, charges: Charges = FREE
) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """Least cost from any source to every cell of the row graph, towards row 0.

    Parameters
    ----------
    height : (row, col) whole numbers, any unit.
    ways : (row, col) directions as bits in which the vehicle may stand (see
        :mod:`rille.stages.planning.configuration_space`).
    sources : (row, col) cells where a path may start.
    charges : whole numbers.

    Returns
    -------
    Cost (row, col) int64: sum of absolute height differences and charges, times the number of rows, plus the sideways
    moves; and the index into :data:`MOVES` of the last move (-1 at sources and where not reached).
    """
    cost, move = np.full(height.shape, UNREACHED, np.int64), np.full(height.shape, -1, np.int8)
    toll = np.zeros_like(height) if charges.toll is None else charges.toll
    _sweep(height, ways, sources, toll, charges.sideways, cost, move)
    return cost, move


@njit(cache=True, nogil=True)
def _sweep(height, ways, sources, toll, sideways, cost, move):  # type: ignore[no-untyped-def]
    rows, cols = height.shape
    for r in range(rows - 1, -1, -1):
        for c in range(cols):
            if not ways[r, c]:
                continue
            if sources[r, c]:
                cost[r, c] = 0
                continue
            for k in range(len(MOVES) if r + 1 < rows else 0):
                offset, way = MOVES[k]
                b = c + offset
                if b < 0 or b >= cols or not ways[r, c] & ways[r + 1, b] & way or cost[r + 1, b] >= UNREACHED:
                    continue
                step = abs(height[r, c] - height[r + 1, b]) + toll[r, c] + (sideways if offset else 0)
                # Times the number of rows: all moves sideways of a path together weigh less than a unit.
                total = cost[r + 1, b] + rows * step + (1 if offset else 0)
                # Not at equal cost: the first of the moves is preferred.
                if total < cost[r, c]:
                    cost[r, c], move[r, c] = total, k


def leading(ways: Bytes, limit: int) -> Bools:
    """Free cells (row, col) from which a row up to ``limit`` can be reached."""
    out = np.zeros(ways.shape, dtype=np.bool_)
    _leading(ways, limit, out)
    return out


@njit(cache=True, nogil=True)
def _leading(ways, limit, out):  # type: ignore[no-untyped-def]
    rows, cols = ways.shape
    for r in range(rows):
        for c in range(cols):
            out[r, c] = r <= limit and ways[r, c] != 0
            for k in range(len(MOVES) if r > limit else 0):
                offset, way = MOVES[k]
                a = c - offset
                if 0 <= a < cols and out[r - 1, a] and ways[r, c] & ways[r - 1, a] & way:
                    out[r, c] = True


def plan(
    height: Ints,
    ways: Bytes,
    tolerance: int = 0,
    ends: EndCells = EndCells(),  # noqa: B008  (it cannot be changed)
    span: tuple[int, int] | None = None,
    charges: Charges = FREE,
) -> Plan:
    """Path from the nearest to the farthest row, or between given cells.

    Parameters
    ----------
    height : (row, col) rounded heights, whole numbers. Row 0 is farthest.
    ways : (row, col) directions as bits in which the vehicle may stand.
    tolerance : rows by which a start or target that is not given may miss the nearest or farthest row with a free cell;
        at most a quarter of the rows between them.
    span : the farthest and the nearest row that count; None: those with a free cell.
    charges : see :func:`sweep`.
    """
    rows, cols = ways.shape
    start, target = ends.start, ends.target
    first_last = span or row_span(ways > 0)
    unreached = np.broadcast_to(np.int64(UNREACHED), ways.shape)
    nothing = Plan(np.empty((0, 2), dtype=np.int64), unreached, np.zeros(cols, dtype=bool), 0)
    for name, cell in ends._asdict().items():
        if cell is not None and not ways[cell]:
            return replace(nothing, blocking_row=cell[0], reason=f"the {name} is not a free cell")
    if first_last is None:
        return replace(nothing, blocking_row=rows - 1, reason="there is no free cell")
    farthest, nearest = first_last
    # On a short map a vehicle's length could make start and target swap their rows.
    tolerance = min(tolerance, (nearest - farthest) // 4)
    limit = farthest + tolerance
    candidates = np.zeros(ways.shape, dtype=bool)
    if start is not None:
        candidates[start] = True
    else:
        near = slice(max(nearest - tolerance, 0), nearest + 1)
        candidates[near] = ways[near] > 0
    allowed = ways
    if target is not None:
        allowed = ways.copy()
        # Beyond the target a path may not go, since every edge leads on; the target's own row keeps the target alone.
        allowed[: target[0] + 1] = 0
        allowed[target], limit = ways[target], target[0]
        candidates[: target[0] + 1] = False
        if not candidates.any():
            return replace(nothing, blocking_row=target[0], reason="the target is not ahead of the start")
    good = candidates & leading(allowed, limit)
    if not good.any():
        cost, _ = sweep(height, allowed, candidates, charges)
        reached = np.flatnonzero((cost < UNREACHED).any(axis=1))
        stop = int(reached[0]) - 1 if len(reached) else nearest
        why = "hazardous or unknown ground closes the whole width"
        return replace(nothing, cost=cost, target_row=limit, blocking_row=stop, reason=why)
    source = np.zeros(ways.shape, dtype=bool)
    # One source, not all candidates: costs are then those of the path's own start, as the report draws them.
    source[nearest_middle(good, nearest)] = True
    cost, move = sweep(height, allowed, source, charges)
    row, col = nearest_middle(cost[: limit + 1] < UNREACHED, farthest)
    return Plan(_trace(move, (row, col)), cost, cost[row] < UNREACHED, row)


def row_span(free: Bools) -> tuple[int, int] | None:
    """The farthest and the nearest row with a free cell."""
    occupied = np.flatnonzero(free.any(axis=1))
    return (int(occupied[0]), int(occupied[-1])) if len(occupied) else None


def nearest_middle(cells: Bools, row: int) -> Cell:
    """The set cell with the fewest moves along rows and columns to the middle of a row; the first one among equals.

    At least one is set.
    """
    r, c = np.nonzero(cells)
    k = int(np.argmin(2 * np.abs(r - row) + np.abs(2 * c - (cells.shape[1] - 1))))
    return int(r[k]), int(c[k])


def _trace(move: NDArray[np.int8], target: Cell) -> NDArray[np.int64]:
    """Cells (vertex, 2) from the source to the target."""
    cells = [target]
    while move[cells[-1]] >= 0:
        (r, c), (offset, _) = cells[-1], MOVES[move[cells[-1]]]
        cells.append((r + 1, c + offset))
    # Moves lead back from the target.
    return np.array(cells[::-1], dtype=np.int64)
