"""A path against the true risk map: no crossed cell is overlooked."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.evaluation.path_check import crossed_cells, path_check, path_check_stage, shortest
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BITS
from rille.stages.hazard.risk import HAZARDOUS
from rille.stages.hazard.vehicle import Vehicle

LATTICE = Lattice.at(0, 9, 1.0, 10, 10)  # x 0 .. 9, y 9 .. 0


def test_cells_of_a_line_by_hand() -> None:
    cells = crossed_cells(np.array([[0.0, 0.0, 5.0], [0.0, 2.0, 5.0], [2.0, 2.0, 5.0]]), LATTICE)
    np.testing.assert_array_equal(cells, [[7, 0], [7, 1], [7, 2], [8, 0], [9, 0]])


def test_a_long_edge_does_not_jump_over_a_hazard() -> None:
    risk = np.zeros((10, 10), dtype=np.uint8)
    risk[5, 4] = 2
    risk[0, 0] = 3
    path = np.array([[4.0, 0.0, 0.0], [4.0, 9.0, 0.0]])
    found = path_check(path, risk, LATTICE)
    value = {k: m["value"] for k, m in found.items()}
    assert value["hazard_cells"] == 1
    assert value["unknown_cells"] == 0
    assert value["crossed_cells"] == 10
    assert value["path_length"] == pytest.approx(9.0)
    assert value["hazardous_share"] == pytest.approx(0.01)


def test_outside_the_map_is_unknown() -> None:
    found = path_check(np.array([[4.0, 8.0, 0.0], [4.0, 12.0, 0.0]]), np.zeros((10, 10), dtype=np.uint8), LATTICE)
    assert found["unknown_cells"]["value"] == 3


def maps(hazardous: np.ndarray) -> dict[str, np.ndarray]:
    bits = np.where(hazardous, np.uint16(BITS["step"]), np.uint16(0))
    risk = np.where(hazardous, np.uint8(HAZARDOUS), np.uint8(0))
    return {"risk": risk, "reason": bits, "elevation": np.zeros(risk.shape, np.float32)}


WIDE = Lattice.at(0, 99, 0.01, 100, 100)  # x 0 .. 0.99, y 0.99 .. 0
ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.1, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
BESIDE = np.array([[0.5, 0.1, 0.0], [0.8, 0.5, 0.0], [0.5, 0.9, 0.0]])


def test_a_detour_over_free_ground_is_as_much_longer_as_it_is() -> None:
    found = shortest(BESIDE, maps(np.zeros((100, 100), bool)), WIDE, ROVER)
    assert found["shortest_length"]["value"] == pytest.approx(0.8)
    assert found["length_ratio"]["value"] == pytest.approx(1.25)


def test_the_shortest_way_goes_round_a_wall_with_half_a_track_and_the_margin() -> None:
    wall = np.zeros((100, 100), bool)
    wall[45:54, :65] = True  # y 0.46 .. 0.54, x up to 0.64
    found = shortest(BESIDE, maps(wall), WIDE, ROVER)
    # past a corner, in steps to eight neighbours: aside by so much at 45 degrees, there and back
    aside = 0.64 + 0.5 * ROVER.track + ROVER.margin - 0.5
    assert found["shortest_length"]["value"] == pytest.approx(0.8 + 2 * (math.sqrt(2) - 1) * aside, abs=0.05)
    assert "keeping the margin" in found["shortest_length"]["how"]


def test_where_the_margin_closes_every_way_the_shortest_is_without_it_or_none() -> None:
    walls = np.zeros((100, 100), bool)
    walls[40:60] = True
    walls[40:60, 46:55] = False  # as wide as the wheels stand, and a cell
    found = shortest(BESIDE, maps(walls), WIDE, ROVER)
    assert found["shortest_length"]["value"] == pytest.approx(0.8, abs=0.03)
    assert "without the margin" in found["shortest_length"]["how"]
    walls[40:60] = True
    assert shortest(BESIDE, maps(walls), WIDE, ROVER)["length_ratio"]["value"] is None


def test_the_stage_without_a_path() -> None:
    meta = {"lattice": LATTICE.to_dict(), "vehicle": ROVER.model_dump()}
    risk = Bundle(maps(np.zeros((10, 10), bool)), meta)
    out = path_check_stage.run(NoParams(), {}, {"path": Bundle({"path": np.empty((0, 3))}, {}), "risk": risk})
    check_outputs(path_check_stage, out)
    assert out.meta["metrics"].keys() == {"hazardous_share", "length_ratio"}
    assert "no path" in out.meta["metrics"]["length_ratio"]["how"]
