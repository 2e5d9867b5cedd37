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
from rille.stages.numeric.line import copy_line
from rille.stages.planning.configuration_space import LEFT, RIGHT, STRAIGHT

Ints = NDArray[np.integer[Any]]
Cell = tuple[int, int]

UNREACHED = np.iinfo(np.int64).max // 4
MOVES = (0, 1, -1)
"""Column of the predecessor minus the cell's own, in order of preference: came straight, to the left, to the right."""


@dataclass(frozen=True)
class Plan:
    """Result of a sweep, in cells of its grid.

    ``cells`` (vertex, 2) row, column from start to target, empty where there is no path; ``cost`` (row, col) int64 of
    :func:`sweep`; ``reachable`` (col,) of ``target_row``; ``blocking_row`` the first row that cannot be entered and
    ``reason`` in words, both empty where a path was found.
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
    cost, move = np.empty(height.shape, dtype=np.int64), np.empty(height.shape, dtype=np.int8)
    toll = np.zeros_like(height) if charges.toll is None else charges.toll
    _sweep(np.ascontiguousarray(height), ways, (toll, charges.sideways), sources, cost, move)
    return cost, move


@njit(cache=True, nogil=True)
def _sweep(height, ways, charges, sources, cost, move):  # type: ignore[no-untyped-def]
    """Rows are worked on as lines, each from the first to the last cell that can be reached; the last one is kept with
    an unreachable cell at either end. Costs there are four times as large, plus the index of the move."""
    rows, cols = height.shape
    toll = charges[0]
    # Times four, as all costs here, and one more step: of equal costs the fewest moves sideways win.
    sideways = 4 * (rows * charges[1] + 1)
    last, around = np.full(cols + 2, 4 * UNREACHED, dtype=np.int64), np.zeros(cols + 2, dtype=np.uint8)
    lines = np.zeros((2, cols + 2), dtype=np.int64)
    best, step, can = np.empty(cols, dtype=np.int64), np.empty(cols, dtype=np.int64), np.empty(cols, dtype=np.uint8)
    low, high = cols, -1  # the reached cells of the last row lie between
    for r in range(rows - 1, -1, -1):
        here, before = lines[r % 2], lines[1 - r % 2]
        first, end = _between(sources[r])
        left, right = max(min(low - 1, first), 0), min(max(high + 2, end), cols)
        cost[r, :left], move[r, :left] = UNREACHED, -1
        cost[r, max(right, left) :], move[r, max(right, left) :] = UNREACHED, -1
        if right <= left:
            low, high = cols, -1
            continue
        if r + 1 < rows:
            copy_line(ways[r + 1], around[1:])
        inner = slice(left, right)
        # Times the number of rows: the steps beside the charge of all moves sideways of a path weigh less than a unit.
        _scale(height[r, inner], 4 * rows, here[left + 1 : right + 1])
        _scale(toll[r, inner], 4 * rows, step[inner])
        _allow(ways[r, inner], around[left : right + 2], can[inner])
        reached = last[left : right + 2], before[left : right + 2]
        _enter(here[left + 1 : right + 1], step[inner], can[inner], reached, sideways, best[inner])
        _unpack(best[inner], cost[r, inner], move[r, inner])
        for c in range(first, end):
            if sources[r, c] and ways[r, c]:
                best[c], cost[r, c], move[r, c] = 0, 0, -1
        for c in range(left, right):
            last[c + 1] = best[c] & ~3
        low, high = left, right - 1
        while low <= high and cost[r, low] >= UNREACHED:
            low += 1
        while high >= low and cost[r, high] >= UNREACHED:
            high -= 1
        if high < low:
            low, high = cols, -1


@njit(cache=True, nogil=True)
def _between(mask):  # type: ignore[no-untyped-def]
    """The first set cell of a line, and the one after the last; the line's length and 0 where none is."""
    n, some = mask.shape[0], np.uint8(0)
    for c in range(n):
        some |= np.uint8(mask[c])
    if not some:
        return n, 0
    first, end = 0, n
    while not mask[first]:
        first += 1
    while not mask[end - 1]:
        end -= 1
    return first, end


@njit(cache=True, nogil=True)
def _scale(values, by, out):  # type: ignore[no-untyped-def]
    for c in range(values.shape[0]):
        out[c] = np.int64(values[c]) * by


@njit(cache=True, nogil=True)
def _allow(here, around, out):  # type: ignore[no-untyped-def]
    """Directions in which a cell can be entered from the last row."""
    for c in range(here.shape[0]):
        out[c] = here[c] & (around[c + 1] & STRAIGHT | around[c + 2] & LEFT | around[c] & RIGHT)


@njit(cache=True, nogil=True)
def _enter(height, toll, can, reached, sideways, out):  # type: ignore[no-untyped-def]
    """Least cost of one row from the last one, with the index of the move in the last two bits: of equal costs the
    first move is the least. ``reached``: cost and height of the last row. Without branches, so that cells go side by
    side."""
    last, before = reached
    far = np.int64(4 * UNREACHED)
    for c in range(height.shape[0]):
        way, h, step = can[c], height[c], toll[c]
        a = last[c + 1] + (abs(h - before[c + 1]) + step)
        a = a if (way & STRAIGHT != 0) & (last[c + 1] < far) else far
        # 1 or 2 is the index of the move, which decides ties.
        b = last[c + 2] + (abs(h - before[c + 2]) + step) + (sideways + 1)
        b = b if (way & LEFT != 0) & (last[c + 2] < far) else far
        d = last[c] + (abs(h - before[c]) + step) + (sideways + 2)
        d = d if (way & RIGHT != 0) & (last[c] < far) else far
        best = a if a < b else b
        out[c] = best if best < d else d


@njit(cache=True, nogil=True)
def _unpack(best, cost, move):  # type: ignore[no-untyped-def]
    far = np.int64(4 * UNREACHED)
    for c in range(best.shape[0]):
        cost[c] = best[c] >> 2
    for c in range(best.shape[0]):
        move[c] = np.int8(best[c] & 3) if best[c] < far else np.int8(-1)


def leading(ways: Bytes, limit: int) -> Bools:
    """Free cells (row, col) from which a row up to ``limit`` can be reached."""
    out = np.empty(ways.shape, dtype=np.bool_)
    _leading(ways, limit, out)
    return out


@njit(cache=True, nogil=True)
def _leading(ways, limit, out):  # type: ignore[no-untyped-def]
    rows, cols = ways.shape
    ahead = np.zeros(cols + 2, dtype=np.uint8)  # ways of the cells of the last row that lead on
    for r in range(rows):
        here, line = ways[r], out[r]
        for c in range(cols):
            on = ahead[c + 1] & STRAIGHT | ahead[c] & LEFT | ahead[c + 2] & RIGHT
            line[c] = here[c] & on != 0 or (r <= limit and here[c] != 0)
        for c in range(cols):
            ahead[c + 1] = here[c] if line[c] else 0


def plan(
    height: Ints,
    ways: Bytes,
    tolerance: int = 0,
    ends: tuple[Cell | None, Cell | None] = (None, None),
    span: tuple[int, int] | None = None,
    charges: Charges = FREE,
    explain: bool = True,
) -> Plan:
    """Path from the nearest to the farthest row, or between given cells.

    Parameters
    ----------
    height : (row, col) rounded heights, whole numbers. Row 0 is farthest.
    ways : (row, col) directions as bits in which the vehicle may stand.
    tolerance : rows by which a start or target that is not given may miss the nearest or farthest row with a free cell;
        at most a quarter of the rows between them.
    ends : start and target, row and column inside the grid, or None.
    span : the farthest and the nearest row that count; None: those with a free cell.
    charges : see :func:`sweep`.
    explain : where there is no path, find out how far one can go.
    """
    rows, cols = ways.shape
    start, target = ends
    first_last = span or row_span(ways > 0)
    unreached = np.broadcast_to(np.int64(UNREACHED), ways.shape)
    nothing = Plan(np.empty((0, 2), dtype=np.int64), unreached, np.zeros(cols, dtype=bool), 0)
    for name, cell in (("start", start), ("target", target)):
        if cell is not None and not ways[cell]:
            return _blocked(nothing, cell[0], f"the {name} is not a free cell")
    if first_last is None:
        return _blocked(nothing, rows - 1, "there is no free cell")
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
            return _blocked(nothing, target[0], "the target is not ahead of the start")
    good = candidates & leading(allowed, limit)
    if not good.any():
        if not explain:
            return nothing
        cost, _ = sweep(height, allowed, candidates, charges)
        reached = np.flatnonzero((cost < UNREACHED).any(axis=1))
        stop = int(reached[0]) - 1 if len(reached) else nearest
        why = "hazardous or unknown ground closes the whole width"
        return _blocked(replace(nothing, cost=cost, target_row=limit), stop, why)
    source = np.zeros(ways.shape, dtype=bool)
    # One source, not all candidates: costs are then those of the path's own start, as the report draws them.
    source[nearest_middle(good, nearest)] = True
    cost, move = sweep(height, allowed, source, charges)
    row, col = nearest_middle(cost[: limit + 1] < UNREACHED, farthest)
    return Plan(_trace(move, row, col), cost, cost[row] < UNREACHED, row)


def row_span(free: Bools) -> tuple[int, int] | None:
    """The farthest and the nearest row with a free cell."""
    occupied = np.flatnonzero(free.any(axis=1))
    return (int(occupied[0]), int(occupied[-1])) if len(occupied) else None


def _blocked(at: Plan, row: int, reason: str) -> Plan:
    return replace(at, blocking_row=row, reason=reason)


def nearest_middle(cells: Bools, row: int) -> tuple[int, int]:
    """The set cell with the fewest moves along rows and columns to the middle of a row; the first one among equals.

    At least one is set.
    """
    r, c = _nearest_middle(cells, row)
    return int(r), int(c)


@njit(cache=True, nogil=True)
def _nearest_middle(cells, row):  # type: ignore[no-untyped-def]
    rows, cols = cells.shape
    best, found = np.iinfo(np.int64).max, (-1, -1)
    for r in range(rows):
        if 2 * abs(r - row) >= best:
            continue
        for c in range(*_between(cells[r])):
            if cells[r, c]:
                away = 2 * abs(r - row) + abs(2 * c - (cols - 1))
                if away < best:
                    best, found = away, (r, c)
    return found


def _trace(move: NDArray[np.int8], row: int, col: int) -> NDArray[np.int64]:
    """Cells (vertex, 2) from the source to the given cell."""
    out = np.empty((move.shape[0] - row, 2), dtype=np.int64)
    # Moves lead back from the target, so the walk is turned round.
    return out[: _walk(move, row, col, out)][::-1].copy()


@njit(cache=True, nogil=True)
def _walk(move, row, col, out):  # type: ignore[no-untyped-def]
    n = 0
    while True:
        out[n, 0], out[n, 1] = row, col
        n += 1
        k = move[row, col]
        if k < 0:
            return n
        row, col = row + 1, col + MOVES[k]
