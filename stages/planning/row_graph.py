"""The row-monotone graph, solved in one sweep (section 4.7).

Each node of a row has edges to three nodes of the next row (same column and its neighbours), weighted by the absolute
height difference. Heights are whole numbers, so sums are exact and ties are ties: of equal moves the straight one wins,
then the one to the left.

Since all edges lead from row to row, Dijkstra's algorithm is one sweep over the rows, O(N) in the number of cells, and
yields all targets of the far row at once (Figure 3). An edge can be used where the vehicle may stand at both its ends
in the direction of the edge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes
from rille.stages.core.kernel import kernel
from rille.stages.planning.configuration_space import ACROSS, LEFT, RIGHT, STRAIGHT

Cell = tuple[int, int]
Ints = NDArray[np.int64]

UNREACHED = np.iinfo(np.int64).max // 4
NEIGHBOURS = (
    (-1, 0, STRAIGHT), (-1, -1, LEFT), (-1, 1, RIGHT),
    (1, 0, STRAIGHT), (0, -1, ACROSS), (0, 1, ACROSS), (1, -1, RIGHT), (1, 1, LEFT),
)  # fmt: skip
"""Row, column and direction of the eight steps to a neighbour; the first three lead to the next row."""


class GridCosts(NamedTuple):
    """Costs of steps from cell to cell, whole numbers of one unit.

    ``height`` (row, col), of which a difference of one costs one; ``ways`` (row, col) bits of the directions in which
    the vehicle may stand (:mod:`rille.stages.planning.configuration_space`); ``toll`` (row, col), cost of entering a
    cell; ``lengths`` (8,), cost of the length of each step of :data:`NEIGHBOURS`.
    """

    height: Ints
    ways: Bytes
    toll: Ints
    lengths: Ints


def sweep(terrain: GridCosts, first: Ints) -> tuple[Ints, NDArray[np.int8]]:
    """Least cost (row, col) int64 of every cell by steps ahead, :data:`UNREACHED` where none leads; and the last step
    there, an index into :data:`NEIGHBOURS`, -1 at starts and where not reached. ``first`` (row, col): cost of starting
    at a cell, :data:`UNREACHED` where that is not permitted."""
    cost, step = first.copy(), np.full(first.shape, -1, np.int8)
    _sweep(terrain, cost, step)
    return cost, step


@kernel
def _sweep(terrain, cost, step):  # type: ignore[no-untyped-def]
    height, ways, toll = terrain.height, terrain.ways, terrain.toll
    rows, cols = height.shape
    for r in range(rows - 2, -1, -1):
        for c in range(cols):
            for k in range(3):
                _, dc, way = NEIGHBOURS[k]
                b = c - dc
                if b < 0 or b >= cols or not ways[r, c] & ways[r + 1, b] & way or cost[r + 1, b] >= UNREACHED:
                    continue
                total = cost[r + 1, b] + abs(height[r, c] - height[r + 1, b]) + toll[r, c] + terrain.lengths[k]
                # Not at equal cost: the first of the steps is preferred.
                if total < cost[r, c]:
                    cost[r, c], step[r, c] = total, k


def trace(step: NDArray[np.int8], target: Cell) -> Ints:
    """Cells (vertex, 2) from the start of a search to a cell that it reached."""
    cells = [target]
    while step[cells[-1]] >= 0:
        (r, c), (dr, dc, _) = cells[-1], NEIGHBOURS[step[cells[-1]]]
        cells.append((r - dr, c - dc))
    # Steps lead back from the target.
    return np.array(cells[::-1], dtype=np.int64)
