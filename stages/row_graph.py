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

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.swept import ALL, LEFT, RIGHT, STRAIGHT

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]
Ways = NDArray[np.uint8]

UNREACHED = np.iinfo(np.int64).max // 4
MOVES = (0, 1, -1)
"""Column of the predecessor minus the cell's own, in order of preference: came straight, to the left, to the right."""
WAYS = (STRAIGHT, LEFT, RIGHT)
"""Bits of the directions of the moves."""


@dataclass(frozen=True)
class Plan:
    """What the sweep found, in cells of its grid.

    ``cells`` (vertex, 2) row, column from start to target, empty where there is no path; ``cost`` (row, col) int64 of
    :func:`sweep`; ``reachable`` (col,) of ``target_row``; ``blocking_row`` the first row that cannot be entered and
    ``reason`` in words, both empty where a path was found. ``beside_unknown``: no path keeps half a wheel from unknown.
    """

    cells: Ints
    cost: Ints
    reachable: Mask
    target_row: int
    blocking_row: int | None = None
    reason: str = ""
    beside_unknown: bool = False


def ways_of(free: Mask | Ways) -> Ways:
    """Directions (row, col) as bits; a mask means all or none."""
    return np.where(free, np.uint8(ALL), np.uint8(0)) if free.dtype == np.bool_ else np.asarray(free, np.uint8)


def sweep(height: Ints, free: Mask | Ways, sources: Mask, toll: Ints | None = None) -> tuple[Ints, NDArray[np.int8]]:
    """Least cost from any source to every cell of the row graph, towards row 0.

    Parameters
    ----------
    height : (row, col) int64, any unit.
    free, sources : (row, col) cells that may be entered, or directions as bits; cells where a path may start.
    toll : (row, col) int64, added on entering a cell, in the unit of the heights.

    Returns
    -------
    Cost (row, col) int64: sum of absolute height differences and tolls, times the number of rows, plus the sideways
    moves; and the index into :data:`MOVES` of the last move (-1 at sources and where not reached).
    """
    ways = ways_of(free)
    cost = np.where(sources & (ways > 0), 0, UNREACHED).astype(np.int64)
    move = np.full(height.shape, -1, dtype=np.int8)
    _sweep(np.ascontiguousarray(height), ways, np.zeros_like(height) if toll is None else toll, cost, move)
    return cost, move


@njit(cache=True, nogil=True)
def _sweep(height, ways, toll, cost, move):  # type: ignore[no-untyped-def]
    rows, cols = height.shape
    for r in range(rows - 2, -1, -1):
        for c in range(cols):
            here = ways[r, c]
            if here == 0 or cost[r, c] != UNREACHED:
                continue
            best, found = UNREACHED, -1
            for k in range(3):
                d = c + MOVES[k]
                if d < 0 or d >= cols or cost[r + 1, d] >= UNREACHED or not here & ways[r + 1, d] & WAYS[k]:
                    continue
                total = cost[r + 1, d] + (abs(height[r, c] - height[r + 1, d]) + toll[r, c]) * rows + (k != 0)
                if total < best:
                    best, found = total, k
            if found >= 0:
                cost[r, c], move[r, c] = best, found


def farthest_row(free: Mask | Ways) -> Ints:
    """Smallest row (row, col) that can be reached from each free cell; the number of rows where not free."""
    ways = ways_of(free)
    far = np.full(ways.shape, ways.shape[0], dtype=np.int64)
    _farthest(ways, far)
    return far


@njit(cache=True, nogil=True)
def _farthest(ways, far):  # type: ignore[no-untyped-def]
    rows, cols = ways.shape
    for r in range(rows):
        for c in range(cols):
            if ways[r, c] == 0:
                continue
            best = r
            for k in range(3):
                d = c - MOVES[k]
                if r > 0 and 0 <= d < cols and ways[r, c] & ways[r - 1, d] & WAYS[k] and far[r - 1, d] < best:
                    best = far[r - 1, d]
            far[r, c] = best


def plan(
    height: Ints,
    free: Mask | Ways,
    tolerance: int = 0,
    start: tuple[int, int] | None = None,
    target: tuple[int, int] | None = None,
    span: tuple[int, int] | None = None,
    toll: Ints | None = None,
) -> Plan:
    """Path from the nearest to the farthest row, or between given cells.

    Parameters
    ----------
    height : (row, col) int64 rounded heights. ``free`` : cells that may be entered, or directions as
        bits. Row 0 is farthest.
    tolerance : rows by which a start or target that is not given may miss the nearest or farthest row with a free cell;
        at most a quarter of the rows between them.
    start, target : row and column, inside the grid.
    span : the farthest and the nearest row that count; None: those with a free cell.
    toll : see :func:`sweep`.
    """
    ways = ways_of(free)
    free = ways > 0
    rows, cols = free.shape
    first_last = span or row_span(free)
    nothing = Plan(np.empty((0, 2), dtype=np.int64), np.full(free.shape, UNREACHED), np.zeros(cols, dtype=bool), 0)
    for name, cell in (("start", start), ("target", target)):
        if cell is not None and not free[cell]:
            return _blocked(nothing, cell[0], f"the {name} is not a free cell")
    if first_last is None:
        return _blocked(nothing, rows - 1, "there is no free cell")
    farthest, nearest = first_last
    tolerance = min(tolerance, (nearest - farthest) // 4)
    limit = farthest + tolerance
    candidates = np.zeros_like(free)
    if start is not None:
        candidates[start] = True
    else:
        candidates[max(nearest - tolerance, 0) : nearest + 1] = free[max(nearest - tolerance, 0) : nearest + 1]
    allowed = ways
    if target is not None:
        allowed = ways.copy()
        allowed[: target[0] + 1] = 0
        allowed[target], limit = ways[target], target[0]
        candidates[: target[0] + 1] = False
        if not candidates.any():
            return _blocked(nothing, target[0], "the target is not ahead of the start")
    far = farthest_row(allowed)
    good = candidates & (far <= limit)
    if not good.any():
        cost, _ = sweep(height, allowed, candidates, toll)
        stop = int(far[candidates].min()) - 1 if candidates.any() else nearest
        return _blocked(
            Plan(nothing.cells, cost, nothing.reachable, limit), stop, "no free cell of this row can be entered"
        )
    source = np.zeros_like(free)
    source[_nearest_middle(good, nearest)] = True
    cost, move = sweep(height, allowed, source, toll)
    ends = cost < UNREACHED
    ends[limit + 1 :] = False
    row, col = _nearest_middle(ends, farthest)
    return Plan(_trace(move, row, col), cost, cost[row] < UNREACHED, row)


def row_span(free: Mask) -> tuple[int, int] | None:
    """The farthest and the nearest row with a free cell."""
    occupied = np.flatnonzero(free.any(axis=1))
    return (int(occupied[0]), int(occupied[-1])) if len(occupied) else None


def _blocked(at: Plan, row: int, reason: str) -> Plan:
    return replace(at, blocking_row=row, reason=reason)


def _nearest_middle(cells: Mask, row: int) -> tuple[int, int]:
    """The set cell with the fewest moves along rows and columns to the middle of a row; the first one among equals."""
    r, c = np.nonzero(cells)
    best = int(np.argmin(2 * np.abs(r - row) + np.abs(2 * c - (cells.shape[1] - 1))))
    return int(r[best]), int(c[best])


def _trace(move: NDArray[np.int8], row: int, col: int) -> Ints:
    """Cells (vertex, 2) from the source to the given cell."""
    cells = [(row, col)]
    while move[row, col] >= 0:
        row, col = row + 1, col + MOVES[move[row, col]]
        cells.append((row, col))
    return np.array(cells[::-1], dtype=np.int64)
