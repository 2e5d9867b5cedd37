"""Path in any direction over the eight-connected grid, for targets that the row graph cannot reach.

Dijkstra's algorithm with a binary heap, from the target to the start: the final cost of a cell is its cost to go. The
cost of an edge is the weighted sum of its length, its climb or descent, and the cost of the cell entered (``toll``), in
whole numbers, so that sums are exact. Ties go to the lower cell index. scipy's Dijkstra needs the graph as a matrix of
15 million entries for a map of 1300 x 1500, which takes longer to build than this takes to search.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes
from rille.stages.numeric.heap import grown, pop, push
from rille.stages.planning.configuration_space import ACROSS, LEFT, RIGHT, STRAIGHT
from rille.stages.planning.row_graph import UNREACHED

Ints = NDArray[np.int64]
Whole = NDArray[np.integer[Any]]

NEIGHBOURS = (
    (-1, 0, STRAIGHT), (1, 0, STRAIGHT), (0, -1, ACROSS), (0, 1, ACROSS),
    (-1, 1, RIGHT), (1, -1, RIGHT), (-1, -1, LEFT), (1, 1, LEFT),
)  # fmt: skip
"""Row, column and direction of the eight edges."""

DIAGONAL = 1.4142135623730951


def cost_to_go(
    height: Whole, ways: Bytes, target: tuple[int, int], start: tuple[int, int] | None, unit: int, toll: Whole
) -> tuple[Ints, NDArray[np.int8]]:
    """Least cost from every cell to the target.

    Parameters
    ----------
    height : (row, col) whole numbers, of which a difference of one costs one.
    ways : (row, col) bits of the directions in which the vehicle may stand
        (:mod:`rille.stages.planning.configuration_space`).
    target, start : row and column. The search ends at ``start``; None: when the cost of every cell is final.
    unit : cost of the length of a straight step, at least 1.
    toll : (row, col) whole numbers, cost of entering a cell.

    Returns
    -------
    Cost (row, col) int64, ``UNREACHED`` where not reached; and index into :data:`NEIGHBOURS` of the next step, -1 at
    the target and where not reached.
    """
    cost = np.full(height.shape, UNREACHED, dtype=np.int64)
    step = np.full(height.shape, -1, dtype=np.int8)
    end = -1 if start is None else start[0] * height.shape[1] + start[1]
    # Rounded to whole units: float sums of equal paths would differ by the order of their steps, and ties with them.
    lengths = np.array([unit if dr == 0 or dc == 0 else round(unit * DIAGONAL) for dr, dc, _ in NEIGHBOURS])
    ground = _Ground(np.ascontiguousarray(height), ways, toll, lengths)
    _search(ground, target[0] * height.shape[1] + target[1], end, cost, step)
    return cost, step


def trace(step: NDArray[np.int8], start: tuple[int, int]) -> Ints:
    """Cells (vertex, 2) from a reached start to the target."""
    cells = [start]
    while step[cells[-1]] >= 0:
        dr, dc, _ = NEIGHBOURS[step[cells[-1]]]
        cells.append((cells[-1][0] + dr, cells[-1][1] + dc))
    return np.array(cells, dtype=np.int64)


def parts(ways: Bytes) -> tuple[NDArray[np.int32], Ints]:
    """Ground that is connected by edges: its number of every cell (row, col), -1 where the vehicle may not stand; and
    the first and the last row of each (number, 2), in reading order of their first cells."""
    number = np.full(ways.shape, -1, dtype=np.int32)
    # At most one a cell; memory that is not written is not taken.
    spans = np.empty((ways.size, 2), dtype=np.int64)
    count = _flood(ways, number, spans)
    return number, spans[:count].copy()


@njit(cache=True, nogil=True)
def _flood(ways, number, spans):  # type: ignore[no-untyped-def]
    rows, cols = ways.shape
    stack = np.empty(ways.size, dtype=np.int64)
    count = 0
    for at in range(ways.size):
        # In reading order of first cells: the numbers do not depend on the order in which the stack is emptied.
        if ways[at // cols, at % cols] == 0 or number[at // cols, at % cols] >= 0:
            continue
        spans[count, 0] = spans[count, 1] = at // cols
        number[at // cols, at % cols], stack[0], size = count, at, 1
        while size:
            size -= 1
            r, c = stack[size] // cols, stack[size] % cols
            spans[count, 1] = max(spans[count, 1], r)
            for k in range(8):
                dr, dc, way = NEIGHBOURS[k]
                i, j = r + dr, c + dc
                if i < 0 or j < 0 or i >= rows or j >= cols or number[i, j] >= 0:
                    continue
                # An edge needs its direction at both ends, as in the search below, so that parts are what the search
                # can join.
                if ways[r, c] & ways[i, j] & way:
                    number[i, j], stack[size] = count, i * cols + j
                    size += 1
        count += 1
    return count


class _Ground(NamedTuple):
    """Heights, directions and tolls (row, col) of :func:`cost_to_go`, and the cost of the length of each edge (8,)."""

    height: Whole
    ways: Bytes
    toll: Whole
    lengths: Ints


@njit(cache=True, nogil=True)
def _search(ground, target, end, cost, step):  # type: ignore[no-untyped-def]
    height, ways, toll = ground.height, ground.ways, ground.toll
    rows, cols = height.shape
    keys, nodes, size = np.empty(1024, dtype=np.int64), np.empty(1024, dtype=np.int64), 1
    keys[0], nodes[0] = 0, target
    cost[target // cols, target % cols] = 0
    while size:
        key, node = keys[0], nodes[0]
        size = pop(keys, nodes, size)
        r, c = node // cols, node % cols
        # A cell that was reached more cheaply later is in the heap twice: the dearer entry is skipped.
        if key > cost[r, c]:
            continue
        if node == end:
            break
        for k in range(8):
            dr, dc, way = NEIGHBOURS[k]
            i, j = r - dr, c - dc  # the step from there leads here
            if i < 0 or j < 0 or i >= rows or j >= cols or not ways[r, c] & ways[i, j] & way:
                continue
            # The search runs from the target, so the cell entered on the way there is (r, c), whose toll is paid.
            total = key + ground.lengths[k] + abs(height[r, c] - height[i, j]) + toll[r, c]
            # Not at equal cost: what was reached first stays, so that ties do not hang on the heap's layout.
            if total < cost[i, j]:
                cost[i, j], step[i, j] = total, k
                if size == keys.shape[0]:
                    keys, nodes = grown(keys), grown(nodes)
                push(keys, nodes, size, total, i * cols + j)
                size += 1
