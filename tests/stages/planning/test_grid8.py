"""Path in any direction: costs equal networkx and scipy, paths are as cheap as their costs, ties are stable."""

from __future__ import annotations

from itertools import pairwise

import networkx as nx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from rille.stages.planning.grid8 import parts, search
from rille.stages.planning.row_graph import NEIGHBOURS, UNREACHED, GridCosts, trace

UNIT = 7
LENGTHS = np.array([UNIT if 0 in (dr, dc) else 10 for dr, dc, _ in NEIGHBOURS])


def edges(height: np.ndarray, ways: np.ndarray, toll: np.ndarray) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """Every step that both its ends allow: length 7, or 10 on a diagonal, plus the climb or descent and the toll."""
    rows, cols = height.shape
    return [
        (
            (r, c),
            (r + dr, c + dc),
            (UNIT if 0 in (dr, dc) else 10)
            + abs(int(height[r, c] - height[r + dr, c + dc]))
            + int(toll[r + dr, c + dc]),
        )
        for r in range(rows)
        for c in range(cols)
        for dr, dc, way in NEIGHBOURS
        if 0 <= r + dr < rows and 0 <= c + dc < cols and ways[r, c] & ways[r + dr, c + dc] & way
    ]


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 9999), rows=st.integers(1, 11), cols=st.integers(1, 11), blocked=st.floats(0.0, 0.6))
def test_costs_equal_networkx_and_scipy(seed: int, rows: int, cols: int, blocked: float) -> None:
    rng = np.random.default_rng(seed)
    # Of few different heights and tolls, so that many paths cost the same.
    height, toll = (rng.integers(0, rng.integers(1, most), (rows, cols)) for most in (9, 3))
    ways = np.where(rng.random((rows, cols)) < blocked, 0, rng.integers(1, 16, (rows, cols))).astype(np.uint8)
    start = int(rng.integers(rows)), int(rng.integers(cols))
    cost, step = search(GridCosts(height, ways, toll, LENGTHS), start)
    graph = nx.DiGraph()
    graph.add_node(start)
    listed = edges(height, ways, toll)
    graph.add_weighted_edges_from(listed)
    expected = nx.single_source_dijkstra_path_length(graph, start)
    reached = {(int(r), int(c)): int(cost[r, c]) for r, c in np.argwhere(cost < UNREACHED)}
    assert reached == expected
    if listed:
        i, j, w = zip(*((a[0] * cols + a[1], b[0] * cols + b[1], w) for a, b, w in listed), strict=True)
        distance = dijkstra(csr_matrix((w, (i, j)), shape=(rows * cols,) * 2), indices=start[0] * cols + start[1])
        np.testing.assert_array_equal(np.where(cost < UNREACHED, cost, np.inf).ravel(), distance)
    weight = {(a, b): w for a, b, w in listed}
    behind: dict[tuple[int, int], list[tuple[int, tuple[int, int]]]] = {}
    for a, b, w in listed:
        if a in reached and reached[b] == reached[a] + w:
            behind.setdefault(b, []).append((reached[a], a))
    for target in reached:
        cells = [tuple(int(v) for v in cell) for cell in trace(step, target)]
        assert (cells[0], cells[-1]) == (start, target)
        assert sum(weight[a, b] for a, b in pairwise(cells)) == cost[target]
        if start != target:
            assert cells[-2] == min(behind[target])[1], (
                "of equals the one nearer to the start, then that of lower index"
            )


def test_the_search_ends_at_the_target_and_its_cost_is_the_same() -> None:
    height = np.random.default_rng(2).integers(0, 9, (60, 70))
    terrain = GridCosts(height, np.full((60, 70), 15, dtype=np.uint8), np.zeros((60, 70), dtype=np.int64), LENGTHS)
    whole, _ = search(terrain, (50, 60))
    part, step = search(terrain, (50, 60), (48, 55))
    assert part[48, 55] == whole[48, 55]
    assert (part == UNREACHED).sum() > 1000
    assert len(trace(step, (48, 55))) >= 6


def test_costs_of_a_large_map_equal_scipy() -> None:
    """So large that thousands of cells wait for their turn."""
    n = 400
    height, at = np.random.default_rng(6).integers(0, 30, (n, n)), np.arange(n * n).reshape(n, n)
    cost, _ = search(GridCosts(height, np.full((n, n), 15, np.uint8), np.zeros_like(height), LENGTHS), (200, 200))
    graph = []
    for length, here, there in (
        (7, np.s_[1:], np.s_[:-1]),
        (7, np.s_[:, 1:], np.s_[:, :-1]),
        (10, np.s_[1:, 1:], np.s_[:-1, :-1]),
        (10, np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        weights = length + np.abs(height[here] - height[there])
        graph.append(csr_matrix((weights.ravel(), (at[here].ravel(), at[there].ravel())), shape=(n * n, n * n)))
    expected = dijkstra(sum(graph[1:], graph[0]), directed=False, indices=at[200, 200])
    np.testing.assert_array_equal(cost.ravel(), expected)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 9999), rows=st.integers(1, 11), cols=st.integers(1, 11))
def test_connected_parts_equal_networkx(seed: int, rows: int, cols: int) -> None:
    rng = np.random.default_rng(seed)
    ways = np.where(rng.random((rows, cols)) < 0.5, 0, rng.integers(1, 16, (rows, cols))).astype(np.uint8)
    nothing = np.zeros((rows, cols), dtype=np.int64)
    graph = nx.Graph()
    graph.add_nodes_from((int(r), int(c)) for r, c in np.argwhere(ways > 0))
    graph.add_edges_from((a, b) for a, b, _ in edges(nothing, ways, nothing))
    number, spans = parts(ways)
    assert (number >= 0).sum() == graph.number_of_nodes()
    expected = sorted(nx.connected_components(graph), key=min)
    assert len(spans) == len(expected)
    for k, cells in enumerate(expected):
        assert {(int(r), int(c)) for r, c in np.argwhere(number == k)} == cells
        assert spans[k].tolist() == [min(cells)[0], max(r for r, _ in cells)]


def test_there_may_be_thousands_of_parts() -> None:
    ways = np.zeros((90, 90), dtype=np.uint8)
    ways[::2, ::2] = 15  # no cell beside another
    number, spans = parts(ways)
    np.testing.assert_array_equal(number[::2, ::2].ravel(), np.arange(45 * 45))
    np.testing.assert_array_equal(spans, np.repeat(np.arange(0, 90, 2), 45)[:, None].repeat(2, axis=1))
