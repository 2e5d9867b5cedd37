"""Row graph: a hand-computed field, oracles on random grids, blocked rows."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from rille.stages.planning.configuration_space import ALL, LEFT, RIGHT, STRAIGHT
from rille.stages.planning.row_graph import UNREACHED, Charges, EndCells, leading, nearest_middle, plan, sweep


def edges(
    height: np.ndarray, free: np.ndarray, sideways: int = 0
) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """The row graph as a list, from each cell to the next row (one less), weighted as `sweep` says."""
    rows, cols = height.shape
    return [
        ((r, c), (r - 1, d), int(abs(height[r, c] - height[r - 1, d])) * rows + (c != d) * (1 + rows * sideways))
        for r in range(rows - 1, 0, -1)
        for c in range(cols)
        for d in (c - 1, c, c + 1)
        if 0 <= d < cols and free[r, c] and free[r - 1, d]
    ]


def grid(seed: int, rows: int, cols: int, blocked: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 9, (rows, cols)), rng.random((rows, cols)) >= blocked


def every_way(free: np.ndarray) -> np.ndarray:
    """Directions as bits: all of them where a cell is free."""
    return np.where(free, np.uint8(ALL), np.uint8(0))


def test_five_by_five_by_hand() -> None:
    """A ridge of 3 in row 2 with a saddle of 1 in column 3; the start is the middle of row 4.

    Over the saddle: 0 + 1 + 1 + 0 = 2; straight over the ridge 3 + 3 = 6; column 4 of the saddle row is blocked.
    """
    height = np.zeros((5, 5), dtype=np.int64)
    height[2] = 3
    height[2, 3] = 1
    free = np.ones((5, 5), dtype=bool)
    free[2, 4] = False
    found = plan(height, every_way(free))
    assert found.target_row == 0
    assert found.reachable.all()
    cost = found.cost // 5
    np.testing.assert_array_equal(cost[0], [6, 2, 2, 2, 2])
    np.testing.assert_array_equal(found.cells[:, 0], [4, 3, 2, 1, 0])
    assert found.cells[2, 1] == 3
    assert (found.cells[0, 1], found.cells[-1, 1]) == (2, 2)


def test_among_equals_straight_then_left_then_right() -> None:
    flat, free = np.zeros((6, 7), dtype=np.int64), np.ones((6, 7), dtype=bool)
    np.testing.assert_array_equal(plan(flat, every_way(free)).cells[:, 1], 3)
    free[3, 3] = False  # either side takes two moves aside: the last of them is to the left, before it straight
    np.testing.assert_array_equal(plan(flat, every_way(free)).cells[:, 1], [3, 4, 4, 3, 3, 3])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 9999),
    rows=st.integers(2, 12),
    cols=st.integers(1, 12),
    blocked=st.floats(0.0, 0.6),
    sideways=st.integers(0, 3),
)
def test_costs_equal_networkx_and_scipy(seed: int, rows: int, cols: int, blocked: float, sideways: int) -> None:
    height, free = grid(seed, rows, cols, blocked)
    free[-1, cols // 2] = True
    source = np.zeros_like(free)
    source[-1, cols // 2] = True
    cost, move = sweep(height, every_way(free), source, Charges(sideways=sideways))
    graph = nx.DiGraph()
    graph.add_node((rows - 1, cols // 2))
    graph.add_weighted_edges_from(edges(height, free, sideways))
    expected = nx.single_source_dijkstra_path_length(graph, (rows - 1, cols // 2))
    reached = {(int(r), int(c)): int(cost[r, c]) for r, c in np.argwhere(cost < UNREACHED)}
    assert reached == expected
    assert ((move >= 0) == ((cost < UNREACHED) & ~source)).all()

    # scipy drops edges of weight 0: shift all by 1, since all paths to a row have equally many edges
    triples = [(a[0] * cols + a[1], b[0] * cols + b[1], w + 1) for a, b, w in edges(height, free, sideways)]
    if triples:
        i, j, w = zip(*triples, strict=True)
        sparse = csr_matrix((w, (i, j)), shape=(rows * cols, rows * cols))
        distance = dijkstra(sparse, indices=(rows - 1) * cols + cols // 2).reshape(rows, cols)
        hops = rows - 1 - np.arange(rows)[:, None]
        np.testing.assert_array_equal(np.where(cost < UNREACHED, cost + hops, np.inf), distance)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 9999), blocked=st.floats(0.0, 0.7), tolerance=st.integers(0, 3))
def test_a_path_is_free_monotone_and_as_cheap_as_its_cost(seed: int, blocked: float, tolerance: int) -> None:
    height, free = grid(seed, 14, 11, blocked)
    found = plan(height, every_way(free), tolerance)
    if len(found.cells) == 0:
        assert found.blocking_row is not None
        assert not (found.cost[found.blocking_row] < UNREACHED).any()
        return
    r, c = found.cells.T
    assert free[r, c].all()
    np.testing.assert_array_equal(np.diff(r), -1)
    assert (np.abs(np.diff(c)) <= 1).all()
    occupied = np.flatnonzero(free.any(axis=1))
    assert r[0] >= occupied[-1] - tolerance
    assert r[-1] <= occupied[0] + tolerance
    walked = np.abs(np.diff(height[r, c])).sum() * 14 + np.abs(np.diff(c)).sum()
    assert walked == found.cost[r[-1], c[-1]]
    assert found.reachable[c[-1]]


@pytest.mark.parametrize("limit", [0, 2, 5])
def test_what_leads_on_equals_networkx(limit: int) -> None:
    height, free = grid(5, 10, 9, 0.45)
    graph = nx.DiGraph([(a, b) for a, b, _ in edges(height, free)])
    graph.add_nodes_from(map(tuple, np.argwhere(free).tolist()))
    found = leading(every_way(free), limit)
    for node in graph:
        assert found[node] == (min(r for r, _ in {node} | nx.descendants(graph, node)) <= limit)
    assert not found[~free].any()


@pytest.mark.parametrize("row", [3, 7, 12])
def test_a_closed_row_is_named(row: int) -> None:
    free = np.ones((16, 9), dtype=bool)
    free[row] = False
    found = plan(np.zeros((16, 9), dtype=np.int64), every_way(free), tolerance=2)
    assert len(found.cells) == 0
    assert found.blocking_row == row
    assert "the whole width" in found.reason
    assert not found.reachable.any()


def test_a_stray_cell_before_or_behind_does_not_block() -> None:
    free = np.ones((20, 15), dtype=bool)
    free[:3], free[-3:] = False, False
    free[1, 0] = free[-1, -1] = True  # each with a gap between itself and the rest
    found = plan(np.zeros((20, 15), dtype=np.int64), every_way(free), tolerance=3)
    np.testing.assert_array_equal(found.cells[[0, -1]], [[16, 7], [3, 7]])
    assert plan(np.zeros((20, 15), dtype=np.int64), every_way(free), tolerance=0).blocking_row == 18


@pytest.mark.parametrize("row", [3, 5, 8])
def test_a_closed_row_of_a_small_map_is_not_excused_by_the_vehicles_length(row: int) -> None:
    """A path may miss a quarter of 11 rows at either end."""
    free = np.ones((12, 9), dtype=bool)
    free[row] = False
    assert plan(np.zeros((12, 9), dtype=np.int64), every_way(free), tolerance=50).blocking_row == row


def test_given_ends() -> None:
    flat, free = np.zeros((12, 12), dtype=np.int64), np.ones((12, 12), dtype=bool)
    found = plan(flat, every_way(free), ends=EndCells((10, 1), (2, 8)))
    np.testing.assert_array_equal(found.cells[[0, -1]], [[10, 1], [2, 8]])
    for row in (2, 10):
        assert "not ahead" in plan(flat, every_way(free), ends=EndCells((row, 1), (10, 8))).reason
    free[10, 1] = False
    refused = plan(flat, every_way(free), ends=EndCells((10, 1)))
    assert (refused.blocking_row, refused.reason) == (10, "the start is not a free cell")
    assert plan(flat, every_way(np.zeros_like(free))).reason


def test_a_target_out_of_the_fan_of_the_start_is_not_reached() -> None:
    free = np.ones((6, 20), dtype=bool)
    found = plan(np.zeros((6, 20), dtype=np.int64), every_way(free), ends=EndCells((5, 0), (0, 6)))
    assert len(found.cells) == 0


def test_an_edge_is_used_where_both_ends_allow_its_direction() -> None:
    """Straight on is closed in row 1; from there only to the left, which row 0 must allow, too."""
    ways = np.full((3, 4), STRAIGHT | LEFT | RIGHT, dtype=np.uint8)
    ways[1] = LEFT
    source = np.zeros((3, 4), dtype=bool)
    source[2, 2] = True
    cost, _ = sweep(np.zeros((3, 4), dtype=np.int64), ways, source)
    np.testing.assert_array_equal(np.argwhere(cost < UNREACHED), [[0, 0], [1, 1], [2, 2]])
    ways[0] = STRAIGHT
    cost, _ = sweep(np.zeros((3, 4), dtype=np.int64), ways, source)
    assert not (cost[0] < UNREACHED).any()


def test_a_toll_is_paid_on_entering() -> None:
    flat, free, toll = np.zeros((5, 7), dtype=np.int64), np.ones((5, 7), dtype=bool), np.zeros((5, 7), dtype=np.int64)
    toll[2, 3] = 2  # two moves aside cost two parts of a step of height
    assert plan(flat, every_way(free), charges=Charges(toll)).cells[2, 1] != 3


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 9999), rows=st.integers(1, 9), cols=st.integers(1, 9))
def test_the_cell_nearest_to_the_middle_of_a_row_is_the_first_of_the_nearest(seed: int, rows: int, cols: int) -> None:
    rng = np.random.default_rng(seed)
    cells, row = rng.random((rows, cols)) < 0.3, int(rng.integers(rows))
    cells[rng.integers(rows), rng.integers(cols)] = True
    listed = [(int(r), int(c)) for r, c in np.argwhere(cells)]
    assert nearest_middle(cells, row) == min(listed, key=lambda at: abs(at[0] - row) + abs(at[1] - 0.5 * (cols - 1)))
