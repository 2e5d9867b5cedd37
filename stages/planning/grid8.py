"""Paths in any direction over the eight-connected grid, for targets that the row graph cannot reach.

Dijkstra's algorithm with a binary heap, from the start. The cost of a step is its length, its climb or descent, and the
toll of the cell entered, in whole numbers, so that sums are exact. Ties go to the lower cell index. scipy's Dijkstra
needs the graph as a matrix of 15 million entries for a map of 1300 x 1500, which takes longer to build than this takes
to search.
"""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes
from rille.stages.core.kernel import kernel
from rille.stages.planning.row_graph import NEIGHBOURS, UNREACHED, Cell, GridCosts, Ints


def search(terrain: GridCosts, start: Cell, target: Cell | None = None) -> tuple[Ints, NDArray[np.int8]]:
    """Least cost (row, col) int64 from the start, :data:`UNREACHED` where no step leads; and the last step there, an
    index into :data:`NEIGHBOURS`, -1 at the start and where not reached. The search ends at ``target``; None: when the
    cost of every cell is final."""
    shape = terrain.ways.shape
    cost, step = np.full(shape, UNREACHED, np.int64), np.full(shape, -1, np.int8)
    first, last = (-1 if cell is None else cell[0] * shape[1] + cell[1] for cell in (start, target))
    _search(terrain, first, last, cost, step)
    return cost, step


@kernel
def _search(terrain, first, last, cost, step):  # type: ignore[no-untyped-def]
    height, ways, toll = terrain.height, terrain.ways, terrain.toll
    rows, cols = height.shape
    cost[first // cols, first % cols] = 0
    heap = [(np.int64(0), np.int64(first))]
    while heap:
        key, node = heappop(heap)
        r, c = node // cols, node % cols
        # A cell that was reached more cheaply later is in the heap twice: the dearer entry is skipped.
        if key > cost[r, c]:
            continue
        if node == last:
            break
        for k in range(8):
            dr, dc, way = NEIGHBOURS[k]
            i, j = r + dr, c + dc
            if i < 0 or j < 0 or i >= rows or j >= cols or not ways[r, c] & ways[i, j] & way:
                continue
            total = key + terrain.lengths[k] + abs(height[r, c] - height[i, j]) + toll[i, j]
            # Not at equal cost: the first step stays, so that ties do not depend on the heap's layout.
            if total < cost[i, j]:
                cost[i, j], step[i, j] = total, k
                heappush(heap, (total, i * cols + j))


def parts(ways: Bytes) -> tuple[NDArray[np.int32], Ints]:
    """Parts of ground that edges connect: the part of each cell (row, col), -1 where the vehicle may not stand; and the
    first and the last row of each (number, 2), in reading order of their first cells."""
    number = np.full(ways.shape, -1, dtype=np.int32)
    # At most one a cell; memory that is not written is not taken.
    spans = np.empty((ways.size, 2), dtype=np.int64)
    count = _flood(ways, number, spans)
    return number, spans[:count].copy()


@kernel
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
                # An edge needs its direction at both ends, as in the search, so that parts are what the search
                # can join.
                if ways[r, c] & ways[i, j] & way:
                    number[i, j], stack[size] = count, i * cols + j
                    size += 1
        count += 1
    return count
