"""Local path: a hand-computed field, oracles on random grids, blocked rows, turned grids."""

from __future__ import annotations

import math

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from stages.declare import Bundle, check_outputs
from stages.errors import InputError
from stages.lattice import Lattice
from stages.path import STAGE, UNREACHED, PathParams, farthest_row, find_path, free_cells, plan, sweep
from stages.vehicle import Vehicle

MODEL = Vehicle(
    name="model",
    wheel_diameter=0.03,
    track=0.03,
    wheel_base=0.02,
    clearance=0.03,
    max_slope_deg=20.0,
    max_step=0.01,
    max_roughness=0.01,
    margin=0.0,
)
CELL = 0.01


def edges(height: np.ndarray, free: np.ndarray) -> list[tuple[tuple[int, int], tuple[int, int], int]]:
    """The row graph as a list, from each cell to the next row (one less), weighted as `sweep` says."""
    rows, cols = height.shape
    return [
        ((r, c), (r - 1, d), int(abs(height[r, c] - height[r - 1, d])) * rows + (c != d))
        for r in range(rows - 1, 0, -1)
        for c in range(cols)
        for d in (c - 1, c, c + 1)
        if 0 <= d < cols and free[r, c] and free[r - 1, d]
    ]


def grid(seed: int, rows: int, cols: int, blocked: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 9, (rows, cols)), rng.random((rows, cols)) >= blocked


def test_five_by_five_by_hand() -> None:
    """A ridge of 3 in row 2 with a saddle of 1 in column 3; the start is the middle of row 4.

    Over the saddle: 0 + 1 + 1 + 0 = 2; straight over the ridge 3 + 3 = 6; column 4 of the saddle row is blocked.
    """
    height = np.zeros((5, 5), dtype=np.int64)
    height[2] = 3
    height[2, 3] = 1
    free = np.ones((5, 5), dtype=bool)
    free[2, 4] = False
    found = plan(height, free)
    assert found.target_row == 0
    assert found.reachable.all()
    cost = found.cost // 5
    np.testing.assert_array_equal(cost[0], [6, 2, 2, 2, 2])
    np.testing.assert_array_equal(found.cells[:, 0], [4, 3, 2, 1, 0])
    assert found.cells[2, 1] == 3
    assert (found.cells[0, 1], found.cells[-1, 1]) == (2, 2)


def test_among_equals_straight_then_left_then_right() -> None:
    flat, free = np.zeros((6, 7), dtype=np.int64), np.ones((6, 7), dtype=bool)
    np.testing.assert_array_equal(plan(flat, free).cells[:, 1], 3)
    free[3, 3] = False  # either side takes two moves aside: the last of them is to the left, before it straight
    np.testing.assert_array_equal(plan(flat, free).cells[:, 1], [3, 4, 4, 3, 3, 3])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 9999), rows=st.integers(2, 12), cols=st.integers(1, 12), blocked=st.floats(0.0, 0.6))
def test_costs_equal_networkx_and_scipy(seed: int, rows: int, cols: int, blocked: float) -> None:
    height, free = grid(seed, rows, cols, blocked)
    free[-1, cols // 2] = True
    source = np.zeros_like(free)
    source[-1, cols // 2] = True
    cost, move = sweep(height, free, source)
    graph = nx.DiGraph()
    graph.add_node((rows - 1, cols // 2))
    graph.add_weighted_edges_from(edges(height, free))
    expected = nx.single_source_dijkstra_path_length(graph, (rows - 1, cols // 2))
    reached = {(int(r), int(c)): int(cost[r, c]) for r, c in np.argwhere(cost < UNREACHED)}
    assert reached == expected
    assert ((move >= 0) == ((cost < UNREACHED) & ~source)).all()

    # scipy drops edges of weight 0: shift all by 1, since all paths to a row have equally many edges
    triples = [(a[0] * cols + a[1], b[0] * cols + b[1], w + 1) for a, b, w in edges(height, free)]
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
    found = plan(height, free, tolerance)
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


def test_farthest_row_equals_networkx() -> None:
    height, free = grid(5, 10, 9, 0.45)
    graph = nx.DiGraph([(a, b) for a, b, _ in edges(height, free)])
    graph.add_nodes_from(map(tuple, np.argwhere(free).tolist()))
    far = farthest_row(free)
    for node in graph:
        assert far[node] == min(r for r, _ in {node} | nx.descendants(graph, node))


@pytest.mark.parametrize("row", [3, 7, 12])
def test_a_closed_row_is_named(row: int) -> None:
    free = np.ones((16, 9), dtype=bool)
    free[row] = False
    found = plan(np.zeros((16, 9), dtype=np.int64), free, tolerance=2)
    assert len(found.cells) == 0
    assert found.blocking_row == row
    assert "row" in found.reason
    assert not found.reachable.any()


def test_a_stray_cell_before_or_behind_does_not_block() -> None:
    free = np.ones((20, 15), dtype=bool)
    free[:3], free[-3:] = False, False
    free[1, 0] = free[-1, -1] = True  # each with a gap between itself and the rest
    found = plan(np.zeros((20, 15), dtype=np.int64), free, tolerance=3)
    np.testing.assert_array_equal(found.cells[[0, -1]], [[16, 7], [3, 7]])
    assert plan(np.zeros((20, 15), dtype=np.int64), free, tolerance=0).blocking_row == 18


def test_a_closed_row_of_a_small_map_is_not_excused_by_the_vehicles_length() -> None:
    free = np.ones((12, 9), dtype=bool)
    free[5] = False
    assert plan(np.zeros((12, 9), dtype=np.int64), free, tolerance=50).blocking_row == 5


def test_given_ends() -> None:
    flat, free = np.zeros((12, 12), dtype=np.int64), np.ones((12, 12), dtype=bool)
    found = plan(flat, free, start=(10, 1), target=(2, 8))
    np.testing.assert_array_equal(found.cells[[0, -1]], [[10, 1], [2, 8]])
    assert "not ahead" in plan(flat, free, start=(2, 1), target=(10, 1)).reason
    free[10, 1] = False
    refused = plan(flat, free, start=(10, 1))
    assert (refused.blocking_row, refused.reason) == (10, "the start is not a free cell")
    assert plan(flat, np.zeros_like(free)).reason == "there is no free cell"


def test_a_target_out_of_the_fan_of_the_start_is_not_reached() -> None:
    free = np.ones((6, 20), dtype=bool)
    found = plan(np.zeros((6, 20), dtype=np.int64), free, start=(5, 0), target=(0, 6))
    assert len(found.cells) == 0


def test_the_margin_is_kept_in_metres() -> None:
    risk = np.zeros((21, 21), dtype=np.uint8)
    risk[10, 10] = 1
    risk[0, :] = 2
    free = free_cells(risk, CELL, margin=0.03)
    y, x = np.mgrid[:21, :21]
    expected = (np.hypot(y - 10, x - 10) * CELL > 0.03) & (risk == 0)
    np.testing.assert_array_equal(free, expected)
    assert free[1].all()  # unknown does not grow


def terrain(seed: int, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Random islands of hazard and unknown on gently rolling ground."""
    rng = np.random.default_rng(seed)
    risk = np.zeros(lattice.shape, dtype=np.uint8)
    for kind in (1, 2):
        for _ in range(6):
            r, c = rng.integers(0, lattice.rows), rng.integers(0, lattice.cols)
            risk[r : r + 4, c : c + 4] = kind
    y, x = np.mgrid[: lattice.rows, : lattice.cols]
    z = (0.003 * np.sin(x / 5 + seed) * np.cos(y / 7)).astype(np.float32)
    return risk, np.where(risk == 2, np.float32(np.nan), z)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), angle=st.floats(-math.pi, math.pi))
def test_unknown_and_hazard_are_never_entered(seed: int, angle: float) -> None:
    lattice = Lattice.at(-20, 30, CELL, 40, 36)
    risk, z = terrain(seed, lattice)
    found, _, xyz = find_path(risk, z, lattice, MODEL, heading=(math.sin(angle), math.cos(angle)))
    if len(xyz):
        at = np.rint(lattice.index(xyz[:, :2])).astype(int)
        assert (risk[at[:, 0], at[:, 1]] == 0).all()
        assert np.isfinite(xyz).all()
        step = np.diff(xyz[:, :2], axis=0) @ [math.sin(angle), math.cos(angle)]
        np.testing.assert_allclose(step, CELL, atol=1e-9)
    else:
        assert found.blocking_row is not None


@pytest.mark.parametrize("wide", [True, False])
def test_a_path_keeps_half_a_wheel_from_unknown_where_it_can(wide: bool) -> None:
    lattice = Lattice.at(-15, 60, CELL, 40, 31)
    risk, z = np.zeros(lattice.shape, dtype=np.uint8), np.zeros(lattice.shape, dtype=np.float32)
    risk[10:30, 8:23] = 2
    if not wide:
        risk[10:30, :7] = risk[10:30, 24:] = 2  # gaps of one cell remain on both sides
    found, _, xyz = find_path(risk, z, lattice, MODEL)
    assert found.beside_unknown is not wide
    at = np.rint(lattice.index(xyz[:, :2])).astype(int)
    unknown = np.argwhere(risk == 2)
    nearest = np.hypot(*(at[:, None] - unknown[None]).transpose(2, 0, 1)).min() * CELL
    assert (nearest > 0.5 * MODEL.wheel_diameter) == wide
    assert nearest > 0


def test_from_start_to_target_in_metres() -> None:
    lattice = Lattice.at(-50, 50, CELL, 101, 101)
    risk, z = np.zeros(lattice.shape, dtype=np.uint8), np.zeros(lattice.shape, dtype=np.float32)
    _, _, xyz = find_path(risk, z, lattice, MODEL, start=(-0.3, -0.2), target=(0.3, 0.25))
    # ends are moved to the centres of their cells on the turned grid: half a diagonal
    assert np.hypot(*(xyz[0, :2] - [-0.3, -0.2])) < 0.71 * CELL
    assert np.hypot(*(xyz[-1, :2] - [0.3, 0.25])) < 0.71 * CELL
    assert (np.hypot(*np.diff(xyz[:, :2], axis=0).T)).sum() == pytest.approx(0.75, abs=2 * CELL)
    with pytest.raises(InputError, match=r"path.target \(2, 0\) m is outside the map.*x in -0.505"):
        find_path(risk, z, lattice, MODEL, start=(-0.3, -0.2), target=(2.0, 0.0))
    with pytest.raises(InputError, match="start and target that differ"):
        find_path(risk, z, lattice, MODEL, start=(0.1, 0.1), target=(0.1, 0.1))


@pytest.mark.parametrize("blocked", [False, True])
def test_the_stage(blocked: bool) -> None:
    lattice = Lattice.at(-10, 60, CELL, 50, 21)
    risk = np.zeros(lattice.shape, dtype=np.uint8)
    if blocked:
        risk[20] = 1
    y = lattice.ys()[:, None] + np.zeros(lattice.cols)
    arrays = {
        "risk": risk,
        "elevation": (0.1 * y).astype(np.float32),
        "inclination": np.full(lattice.shape, math.atan(0.1), dtype=np.float32),
    }
    source = Bundle(arrays, {"lattice": lattice.to_dict(), "vehicle": MODEL.model_dump(), "frame": "local"})
    out = STAGE.run(PathParams(start=(9.0, 9.0)), {"use": "local"}, {"risk": source})
    check_outputs(STAGE, out)
    assert out.meta["found"] is not blocked
    if blocked:
        assert out.meta["blocking_row"] == 20
        assert out.meta["blocking_y"] == pytest.approx(lattice.ys()[20])
        assert out["path"].shape == (0, 3)
        return
    assert out.meta["vertices"] == 50
    assert out.meta["start"][:2] == pytest.approx([0.0, lattice.ys()[-1]])
    assert out.meta["max_inclination"] == pytest.approx(math.atan(0.1))
    # a wheel's mean at the first and last row leans on what lies inside: half a cell of its three
    assert out.meta["climb_m"] == pytest.approx(0.1 * 49 * CELL, abs=0.1 * CELL + 1e-6)
    assert out.meta["length_m"] == pytest.approx(49 * CELL * math.hypot(1, 0.1), rel=1e-3)
    # heights are rounded to 0.02 of 10 mm
    assert out["cost_to_go"][0, 10] == pytest.approx(0.1 * 49 * CELL, abs=0.1 * CELL + 2e-4)
    assert out["reachable"].all()
