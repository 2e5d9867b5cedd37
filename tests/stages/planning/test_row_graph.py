"""Row graph: a hand-computed field, oracles on random grids, ties."""

from __future__ import annotations

from itertools import pairwise

import networkx as nx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from rille.stages.planning.configuration_space import ACROSS, LEFT, RIGHT, STRAIGHT
from rille.stages.planning.row_graph import NEIGHBOURS, UNREACHED, GridCosts, sweep, trace

ALL_DIRECTIONS = STRAIGHT | RIGHT | ACROSS | LEFT


def terrain(height: np.ndarray, ways: np.ndarray, sideways: int = 0, toll: np.ndarray | int = 0) -> GridCosts:
    lengths = np.array([sideways if dc else 0 for _, dc, _ in NEIGHBOURS])
    return GridCosts(height.astype(np.int64), ways, np.zeros(height.shape, np.int64) + toll, lengths)


def starting(shape: tuple[int, int], *cells: tuple[int, int]) -> np.ndarray:
    first = np.full(shape, UNREACHED)
    first[tuple(np.transpose(cells))] = 0
    return first


def edges(
    height: np.ndarray, free: np.ndarray, sideways: int, toll: np.ndarray
) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """The row graph as a list, from each cell to the next row (one less)."""
    rows, cols = height.shape
    return [
        ((r, c), (r - 1, d), int(abs(height[r, c] - height[r - 1, d])) + (c != d) * sideways + int(toll[r - 1, d]))
        for r in range(rows - 1, 0, -1)
        for c in range(cols)
        for d in (c - 1, c, c + 1)
        if 0 <= d < cols and free[r, c] and free[r - 1, d]
    ]


def every_way(free: np.ndarray) -> np.ndarray:
    """Directions as bits: all of them where a cell is free."""
    return np.where(free, np.uint8(ALL_DIRECTIONS), np.uint8(0))


def test_five_by_five_by_hand() -> None:
    """A ridge of 3 in row 2 with a saddle of 1 in column 3; the start is the middle of row 4.

    Over the saddle: 0 + 1 + 1 + 0 = 2; straight over the ridge 3 + 3 = 6; column 4 of the saddle row is blocked.
    """
    height = np.zeros((5, 5), dtype=np.int64)
    height[2] = 3
    height[2, 3] = 1
    free = np.ones((5, 5), dtype=bool)
    free[2, 4] = False
    cost, step = sweep(terrain(height, every_way(free)), starting((5, 5), (4, 2)))
    np.testing.assert_array_equal(cost[0], [6, 2, 2, 2, 2])
    cells = trace(step, (0, 2))
    np.testing.assert_array_equal(cells[:, 0], [4, 3, 2, 1, 0])
    assert cells[2, 1] == 3


def test_among_equals_straight_then_left_then_right() -> None:
    flat, free = np.zeros((6, 7), dtype=np.int64), np.ones((6, 7), dtype=bool)
    columns = lambda: trace(sweep(terrain(flat, every_way(free), 1), starting((6, 7), (5, 3)))[1], (0, 3))[:, 1]  # noqa: E731
    np.testing.assert_array_equal(columns(), 3)
    free[3, 3] = False  # either side takes two moves aside: the last of them is to the left, before it straight
    np.testing.assert_array_equal(columns(), [3, 4, 4, 3, 3, 3])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 9999),
    rows=st.integers(2, 12),
    cols=st.integers(1, 12),
    blocked=st.floats(0.0, 0.6),
    sideways=st.integers(0, 3),
)
def test_costs_equal_networkx_and_scipy(seed: int, rows: int, cols: int, blocked: float, sideways: int) -> None:
    rng = np.random.default_rng(seed)
    height, free = rng.integers(0, 9, (rows, cols)), rng.random((rows, cols)) >= blocked
    toll = rng.integers(0, 3, (rows, cols))
    start = rows - 1, cols // 2
    free[start] = True
    cost, step = sweep(terrain(height, every_way(free), sideways, toll), starting(height.shape, start))
    listed = edges(height, free, sideways, toll)
    graph = nx.DiGraph()
    graph.add_node(start)
    graph.add_weighted_edges_from(listed)
    expected = nx.single_source_dijkstra_path_length(graph, start)
    reached = {(int(r), int(c)): int(cost[r, c]) for r, c in np.argwhere(cost < UNREACHED)}
    assert reached == expected
    weight = {(a, b): w for a, b, w in listed}
    for cell in reached:
        cells = [tuple(int(v) for v in at) for at in trace(step, cell)]
        assert (cells[0], cells[-1]) == (start, cell)
        assert sum(weight[a, b] for a, b in pairwise(cells)) == cost[cell]

    # scipy drops edges of weight 0: shift all by 1, since all paths to a row have equally many edges
    triples = [(a[0] * cols + a[1], b[0] * cols + b[1], w + 1) for a, b, w in listed]
    if triples:
        i, j, w = zip(*triples, strict=True)
        sparse = csr_matrix((w, (i, j)), shape=(rows * cols, rows * cols))
        distance = dijkstra(sparse, indices=start[0] * cols + start[1]).reshape(rows, cols)
        hops = rows - 1 - np.arange(rows)[:, None]
        np.testing.assert_array_equal(np.where(cost < UNREACHED, cost + hops, np.inf), distance)


def test_a_path_begins_where_its_start_and_its_way_cost_least() -> None:
    flat, ways = np.zeros((4, 5), dtype=np.int64), np.full((4, 5), ALL_DIRECTIONS, np.uint8)
    first = starting((4, 5), (3, 0), (2, 3))
    first[2, 3] = 1
    cost, step = sweep(terrain(flat, ways, 2), first)
    assert [trace(step, (0, c))[0].tolist() for c in (0, 1, 2, 3)] == [[3, 0], [3, 0], [2, 3], [2, 3]]
    assert cost[0].tolist() == [0, 2, 3, 1, 3]


def test_an_edge_is_used_where_both_ends_allow_its_direction() -> None:
    """Straight on is closed in row 1; from there only to the left, which row 0 must allow, too."""
    ways = np.full((3, 4), STRAIGHT | LEFT | RIGHT, dtype=np.uint8)
    ways[1] = LEFT
    flat, first = np.zeros((3, 4), dtype=np.int64), starting((3, 4), (2, 2))
    cost, _ = sweep(terrain(flat, ways), first)
    np.testing.assert_array_equal(np.argwhere(cost < UNREACHED), [[0, 0], [1, 1], [2, 2]])
    ways[0] = STRAIGHT
    cost, _ = sweep(terrain(flat, ways), first)
    assert not (cost[0] < UNREACHED).any()


def test_steps_ahead_lead_to_the_next_row() -> None:
    assert [dr for dr, _, _ in NEIGHBOURS[:3]] == [-1, -1, -1]
    assert len({(dr, dc) for dr, dc, _ in NEIGHBOURS}) == 8
