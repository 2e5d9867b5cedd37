"""State lattice of a vehicle that turns on the spot: positions and headings as one graph, searched from goal to start.

Positions lie on a square grid that is aligned with the start pose and contains it exactly. The 16 headings are the
directions to the neighbours one and two steps away. From a pose the vehicle drives one step ahead or back along its
heading, or turns to the next heading. Each pose, the middle of each step and the middle of each turn has a cost per
metre, infinite where the vehicle may not be; a step costs its length times the highest of these along it. The search is
Dijkstra's; ties go to the pose of the lower index.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.kernel import kernel
from rille.stages.geometry.lattice import Lattice
from rille.stages.planning.local_planner.clearance import Footing, Gaps

Prices = Callable[[Gaps, Floats, Floats], tuple[Bools, Floats]]
"""Of poses by their gaps, x and y (m): whether they may be driven on what is known, and the price of a metre."""

HALF_TURN_HEADINGS = 8
HEADING_STEPS = np.array([(-1, 0), (-2, -1), (-1, -1), (-1, -2), (0, -1), (1, -2), (1, -1), (2, -1)])
HEADING_STEPS = np.concatenate([HEADING_STEPS, -HEADING_STEPS])
"""Row and column of one step along each heading, from ahead to the left."""
HEADING_ANGLES = np.mod(np.arctan2(-HEADING_STEPS[:, 1], -HEADING_STEPS[:, 0]), 2 * np.pi)
STEP_LENGTHS = np.hypot(HEADING_STEPS[:, 0], HEADING_STEPS[:, 1])
AHEAD, BACK, TO_LEFT, TO_RIGHT = 0, 1, 2, 3


@dataclass(frozen=True)
class PoseGrid:
    """Places (row, col): ``middle + spacing * R(heading) (col - col0, row0 - row)``, metres."""

    middle: tuple[float, float]
    heading: float
    spacing: float
    shape: tuple[int, int]
    origin: tuple[int, int]

    @staticmethod
    def over(lattice: Lattice, middle: tuple[float, float], heading: float, spacing: float) -> PoseGrid:
        """Lattice through ``middle`` that covers a whole map."""
        x0, x1, y0, y1 = lattice.bounds
        corners = np.array([(x, y) for x in (x0, x1) for y in (y0, y1)]) - middle
        c, s = math.cos(heading), math.sin(heading)
        right, ahead = (corners @ [[c, -s], [s, c]] / spacing).T
        row0, col0 = math.ceil(ahead.max()), math.ceil(-right.min())
        shape = row0 + 1 + math.ceil(-ahead.min()), col0 + 1 + math.ceil(right.max())
        return PoseGrid(middle, heading, spacing, shape, (row0, col0))

    def places(self) -> tuple[Floats, Floats]:
        """x and y (row, col), m, of all places."""
        return self.xy(*np.indices(self.shape, np.float64))

    def xy(self, row: Floats, col: Floats) -> tuple[Floats, Floats]:
        """Metres, of fractional rows and columns."""
        right, ahead = (col - self.origin[1]) * self.spacing, (self.origin[0] - row) * self.spacing
        c, s = math.cos(self.heading), math.sin(self.heading)
        return self.middle[0] + c * right - s * ahead, self.middle[1] + s * right + c * ahead

    def index(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Fractional rows and columns of places, m."""
        dx, dy = (x - self.middle[0]) / self.spacing, (y - self.middle[1]) / self.spacing
        c, s = math.cos(self.heading), math.sin(self.heading)
        return self.origin[0] + s * dx - c * dy, self.origin[1] + c * dx + s * dy


@dataclass(frozen=True)
class LatticeGraph:
    """Cost of a metre (heading within 180 degrees, row, col) at each pose (``pose``), half a step ahead of it
    (``step``) and half way to the next heading on the left (``turn``); infinite where closed. ``known``: three masks of
    the same shape, of the poses, steps and turns that lie on known ground."""

    grid: PoseGrid
    pose: Floats
    step: Floats
    turn: Floats
    known: tuple[Bools, Bools, Bools]

    @staticmethod
    def of(footing: Footing, grid: PoseGrid, prices: Prices) -> LatticeGraph:
        """Compute the costs on a map; a vehicle covers the same ground backwards, so headings within 180 degrees do."""
        row, col = np.indices(grid.shape, np.float64)
        price, known = (np.empty((3, HALF_TURN_HEADINGS, *grid.shape), kind) for kind in (np.float64, np.bool_))
        for k in range(HALF_TURN_HEADINGS):
            # Of all 16 headings: the turn to the left of the eighth ends at the ninth.
            angle, after = HEADING_ANGLES[k : k + 2]
            for where, (steps, turned) in enumerate(((0.0, angle), (0.5, angle), (0.0, 0.5 * (angle + after)))):
                dr, dc = steps * HEADING_STEPS[k]
                x, y = grid.xy(row + dr, col + dc)
                gaps = footing.gaps(x, y, np.full(x.shape, grid.heading + turned))
                known[where, k], price[where, k] = prices(gaps, x, y)
        return LatticeGraph(grid, price[0], price[1], price[2], (known[0], known[1], known[2]))

    def open_at(self, x: Floats, y: Floats, heading: Floats, price: float) -> None:
        """Make the poses (n,) at x, y (m) and heading (rad), and those next to them, known at this price at most;
        places beside the lattice are left out."""
        row, col = (np.rint(v).astype(np.int64) for v in self.grid.index(x, y))
        inside = (row >= 0) & (row < self.grid.shape[0]) & (col >= 0) & (col < self.grid.shape[1])
        on = np.zeros(self.pose.shape, np.bool_)
        for k, angle in enumerate(HEADING_ANGLES):
            off = np.remainder(heading - self.grid.heading - angle + np.pi, 2 * np.pi) - np.pi
            # 25 degrees: of a heading of the lattice from one that was driven; the next heading is at most 27
            # degrees away.
            along = inside & (np.abs(off) < math.radians(25.0))
            on[k % HALF_TURN_HEADINGS, row[along], col[along]] = True
        on = scipy.ndimage.binary_dilation(on, np.ones((1, 3, 3)))
        for cost, known in zip((self.pose, self.step, self.turn), self.known, strict=True):
            cost[on] = np.minimum(cost[on], price)
            known[on] = True

    def search(
        self, goals: Bools, turn_price: float, back: float, *, whole: bool = False
    ) -> tuple[Floats, NDArray[np.int8]]:
        """Least cost of the poses (16, row, col) to a goal, and the move towards it, -1 none.

        Parameters
        ----------
        goals : (row, col) places, at any heading.
        turn_price : cost of a turn, metres of driving ahead per radian.
        back : cost of a metre driven back; a metre ahead costs 1.
        whole : search all poses; else end at the start.
        """
        size = (2 * HALF_TURN_HEADINGS, *self.grid.shape)
        cost, move = np.full(size, np.inf), np.full(size, -1, np.int8)
        r, c = self.grid.origin
        end = -1 if whole else r * size[2] + c
        angles = np.mod(np.diff(np.append(HEADING_ANGLES, 2 * np.pi)), 2 * np.pi)
        moves = _Moves(HEADING_STEPS, STEP_LENGTHS * self.grid.spacing, angles * turn_price, back)
        _search(_Costs(self.pose, self.step, self.turn), goals, moves, end, cost, move)
        return cost, move

    def follow(self, move: NDArray[np.int8]) -> list[tuple[int, int, int, int]]:
        """Poses and moves from the start: heading, counted on to the left (negative to the right), row, col, move."""
        at, out = (0, *self.grid.origin), []
        while True:
            k, r, c = at
            m = int(move[k % (2 * HALF_TURN_HEADINGS), r, c])
            out.append((k, r, c, m))
            if m < 0:
                return out
            dr, dc = (int(v) for v in HEADING_STEPS[k % (2 * HALF_TURN_HEADINGS)])
            at = {AHEAD: (k, r + dr, c + dc), BACK: (k, r - dr, c - dc), TO_LEFT: (k + 1, r, c)}.get(m, (k - 1, r, c))


def angle_of(k: int) -> float:
    """Angle (rad) of a heading that is counted on over full turns."""
    turns, rest = divmod(k, 2 * HALF_TURN_HEADINGS)
    return 2 * math.pi * turns + float(HEADING_ANGLES[rest])


class _Costs(NamedTuple):
    """Those of :class:`LatticeGraph`."""

    pose: Floats
    step: Floats
    turn: Floats


class _Moves(NamedTuple):
    """Of each heading (16): row and column of a step ahead, its length (m), the price of a turn to the left; and the
    price of driving back, ahead is 1."""

    steps: NDArray[np.int64]
    lengths: Floats
    turns: Floats
    back: float


@kernel
def _search(prices, goals, moves, end, cost, move):  # type: ignore[no-untyped-def]
    rows, cols = goals.shape
    area = rows * cols
    heap = [(0.0, np.int64(0)) for _ in range(0)]  # none yet, of this type
    for k, r, c in np.ndindex(16, rows, cols):
        if goals[r, c] and prices.pose[k % 8, r, c] < np.inf:
            cost[k, r, c] = 0.0
            heappush(heap, (0.0, k * area + r * cols + c))
    while heap:
        key, node = heappop(heap)
        k, r, c = node // area, node % area // cols, node % cols
        # Reached more cheaply since it was pushed: this entry is out of date.
        if key > cost[k, r, c]:
            continue
        if node == end:
            break
        here = prices.pose[k % 8, r, c]
        for m in range(4):
            before, i, j, scale = k, r, c, 1.0
            if m < 2:
                sign = -1 if m == 0 else 1
                i, j = r + sign * moves.steps[k, 0], c + sign * moves.steps[k, 1]
                if i < 0 or j < 0 or i >= rows or j >= cols:
                    continue
                # the step along heading k % 8 that joins both places begins at one of them
                first = (m == 0) == (k < 8)
                between = prices.step[k % 8, i, j] if first else prices.step[k % 8, r, c]
                scale = moves.lengths[k] * (moves.back if m == 1 else 1.0)
            else:
                # Searched backwards: a turn to the left (2) that ends at k began one heading to its right.
                before = (k + 15) % 16 if m == 2 else (k + 1) % 16
                lower = before if m == 2 else k
                between, scale = prices.turn[lower % 8, r, c], moves.turns[lower]
            # The highest cost of both ends and the middle, so that a step does not jump over costly ground.
            price = max(here, prices.pose[before % 8, i, j], between)
            total = key + scale * price
            if total < cost[before, i, j]:
                cost[before, i, j], move[before, i, j] = total, m
                heappush(heap, (total, before * area + i * cols + j))
