"""A path against the true risk map: no crossed cell is overlooked."""

from __future__ import annotations

import numpy as np
import pytest

from stages.declare import Bundle, NoParams, check_outputs
from stages.lattice import Lattice
from stages.path_check import STAGE, crossed_cells, path_check

LATTICE = Lattice.at(0, 9, 1.0, 10, 10)  # x 0 .. 9, y 9 .. 0


def test_cells_of_a_line_by_hand() -> None:
    cells = crossed_cells(np.array([[0.0, 0.0, 5.0], [0.0, 2.0, 5.0], [2.0, 2.0, 5.0]]), LATTICE)
    np.testing.assert_array_equal(cells, [[7, 0], [7, 1], [7, 2], [8, 0], [9, 0]])


def test_a_long_edge_does_not_jump_over_a_hazard() -> None:
    risk = np.zeros((10, 10), dtype=np.uint8)
    risk[5, 4] = 2
    risk[0, 0] = 3
    path = np.array([[4.0, 0.0, 0.0], [4.0, 9.0, 0.0]])
    hit, found = path_check(path, risk, LATTICE)
    np.testing.assert_array_equal(hit, [[5, 4]])
    value = {k: m["value"] for k, m in found.items()}
    assert value["hazard_cells"] == 1
    assert value["unknown_cells"] == 0
    assert value["crossed_cells"] == 10
    assert value["path_length"] == pytest.approx(9.0)
    assert value["hazardous_share"] == pytest.approx(0.01)


def test_outside_the_map_is_unknown() -> None:
    _, found = path_check(np.array([[4.0, 8.0, 0.0], [4.0, 12.0, 0.0]]), np.zeros((10, 10), dtype=np.uint8), LATTICE)
    assert found["unknown_cells"]["value"] == 3


def test_the_stage_without_a_path() -> None:
    risk = Bundle({"risk": np.zeros((10, 10), dtype=np.uint8)}, {"lattice": LATTICE.to_dict()})
    out = STAGE.run(NoParams(), {}, {"path": Bundle({"path": np.empty((0, 3))}, {}), "risk": risk})
    check_outputs(STAGE, out)
    assert out.meta["metrics"]["hazard_cells"]["value"] is None
    assert "no path" in out.meta["metrics"]["hazard_cells"]["how"]
