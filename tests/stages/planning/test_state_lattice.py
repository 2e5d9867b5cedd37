"""Places and headings as a graph: its costs are another program's, its grid lies through the start."""

from __future__ import annotations

import itertools
import math

import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.geometry.lattice import Lattice
from rille.stages.planning.local_planner.state_lattice import (
    HEADING_ANGLES,
    HEADING_STEPS,
    LatticeGraph,
    PoseGrid,
    angle_of,
)


def networked(graph: LatticeGraph, turn_price: float, back: float) -> networkx.DiGraph:
    """The same graph, edge by edge from its words."""
    out = networkx.DiGraph()
    rows, cols = graph.grid.shape
    for k in range(16):
        for r in range(rows):
            for c in range(cols):
                out.add_node((k, r, c))
                i, j = r + int(HEADING_STEPS[k][0]), c + int(HEADING_STEPS[k][1])
                if 0 <= i < rows and 0 <= j < cols:
                    middle = graph.step[k, r, c] if k < 8 else graph.step[k - 8, i, j]
                    price = max(graph.pose[k % 8, r, c], graph.pose[k % 8, i, j], middle)
                    length = math.hypot(i - r, j - c) * graph.grid.spacing
                    if math.isfinite(price):
                        out.add_edge((k, r, c), (k, i, j), weight=price * length)
                        out.add_edge((k, i, j), (k, r, c), weight=price * length * back)
                left = (k + 1) % 16
                price = max(graph.pose[k % 8, r, c], graph.pose[left % 8, r, c], graph.turn[k % 8, r, c])
                if math.isfinite(price):
                    turn = (HEADING_ANGLES[left] - HEADING_ANGLES[k]) % (2 * math.pi)
                    out.add_edge((k, r, c), (left, r, c), weight=price * turn * turn_price)
                    out.add_edge((left, r, c), (k, r, c), weight=price * turn * turn_price)
    return out


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(3, 6), st.integers(3, 6))
def test_costs_are_those_of_networkx(seed: int, rows: int, cols: int) -> None:
    rng = np.random.default_rng(seed)
    prices = [
        np.where(rng.random((8, rows, cols)) < 0.25, np.inf, rng.uniform(1, 3, (8, rows, cols))) for _ in range(3)
    ]
    origin = int(rng.integers(rows)), int(rng.integers(cols))
    known = tuple(np.isfinite(p) for p in prices)
    graph = LatticeGraph(PoseGrid((0.0, 0.0), 0.0, 0.5, (rows, cols), origin), *prices, known)
    goals = np.zeros((rows, cols), bool)
    goal = int(rng.integers(rows)), int(rng.integers(cols))
    goals[goal] = True
    cost, move = graph.search(goals, 0.3, 2.0, whole=True)
    sources = {(k, *goal) for k in range(16) if math.isfinite(prices[0][k % 8, goal[0], goal[1]])}
    other = networked(graph, 0.3, 2.0)
    lengths = networkx.multi_source_dijkstra_path_length(other.reverse(), sources) if sources else {}
    for pose in other:
        assert cost[pose] == pytest.approx(lengths.get(pose, math.inf))
    early, first = graph.search(goals, 0.3, 2.0)
    assert early[0][origin] == cost[0][origin]
    if math.isfinite(cost[0][origin]):
        way = graph.follow(first)
        assert way == graph.follow(move)
        assert way[0][:3] == (0, *origin)
        assert way[-1][1:3] == goal
        edges = [((a[0] % 16, *a[1:3]), (b[0] % 16, *b[1:3])) for a, b in itertools.pairwise(way)]
        assert sum(other.edges[e]["weight"] for e in edges) == pytest.approx(cost[0][origin])


class Asked:
    """A footing that gives back where it was asked."""

    def gaps(self, x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> tuple[np.ndarray, ...]:
        return x, y, heading


def test_prices_are_those_of_a_pose_of_half_a_step_ahead_and_of_half_a_turn_to_the_left() -> None:
    grid = PoseGrid((0.3, -0.2), 0.4, 0.05, (4, 5), (2, 1))
    x, y, heading = (
        LatticeGraph.of(Asked(), grid, lambda gaps, x, y, which=which: (x == x, gaps[which]))  # type: ignore[arg-type]
        for which in range(3)
    )
    row, col = np.indices(grid.shape).astype(float)
    for k in range(8):
        half_turn = 0.5 * (math.remainder(HEADING_ANGLES[k + 1] - HEADING_ANGLES[k], 2 * math.pi))
        for what, (dr, dc), turn in (
            ("pose", (0, 0), 0.0),
            ("step", 0.5 * HEADING_STEPS[k], 0.0),
            ("turn", (0, 0), half_turn),
        ):
            found = [getattr(graph, what)[k] for graph in (x, y, heading)]
            np.testing.assert_allclose(found[:2], grid.xy(row + dr, col + dc), atol=1e-12)
            np.testing.assert_allclose(found[2], 0.4 + HEADING_ANGLES[k] + turn)


def test_headings_go_once_round_to_the_left() -> None:
    assert np.diff(HEADING_ANGLES).min() > math.radians(18)
    assert math.degrees(HEADING_ANGLES[2]) == pytest.approx(45.0)
    assert HEADING_STEPS[4].tolist() == [0, -1]
    assert angle_of(18) == pytest.approx(2 * math.pi + HEADING_ANGLES[2])
    assert angle_of(-2) == pytest.approx(-HEADING_ANGLES[2])


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(-0.1, 0.5), st.floats(-3.1, 3.1))
def test_the_grid_lies_through_the_start_and_covers_the_map(x: float, y: float, heading: float) -> None:
    lattice = Lattice.snap((-0.4, 0.4, -0.2, 1.0), 0.02)
    grid = PoseGrid.over(lattice, (x, y), heading, 0.03)
    at = np.array([float(v) for v in grid.origin])
    assert np.hypot(*(np.array(grid.xy(at[0], at[1])) - (x, y))) < 1e-12
    ahead = np.array(grid.xy(at[0] - 1, at[1])) - (x, y)
    assert ahead == pytest.approx([-0.03 * math.sin(heading), 0.03 * math.cos(heading)], abs=1e-12)
    x0, x1, y0, y1 = lattice.bounds
    rows, cols = (np.array([-0.5, n - 0.5]) for n in grid.shape)
    sides = np.array([grid.xy(r, c) for r in rows for c in cols])
    c, s = math.cos(heading), math.sin(heading)
    corners = np.array([(x, y) for x in (x0, x1) for y in (y0, y1)])
    inward = np.array([[c, -s], [s, c]])
    assert ((corners @ inward).min(axis=0) >= (sides @ inward).min(axis=0)).all()
    assert ((corners @ inward).max(axis=0) <= (sides @ inward).max(axis=0)).all()
