"""The next leg: known ground only, round what is closed, as short as another program's way."""

from __future__ import annotations

import math
import re

import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.errors import InputError
from stages.lattice import Lattice
from stages.leg import Hazards, LegParams, costs, half_width, plan_leg, shortest
from stages.risk import HAZARDOUS, REASONS, SAFE, UNKNOWN
from stages.vehicle import Vehicle

ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.10, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
LATTICE = Lattice.snap((-0.4, 0.4, -0.2, 1.0), 0.01)
START, GOAL = (0.0, 0.0), (0.0, 0.8)
X, Y = LATTICE.xy()[..., 0], LATTICE.xy()[..., 1]
P = LegParams()


def ground(*changes: tuple[np.ndarray, int]) -> Hazards:
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    for where, kind in changes:
        risk[where] = kind
    return Hazards.of(risk, None, LATTICE.cell, ROVER)


def test_over_free_ground_it_goes_straight_one_leg_far() -> None:
    leg = plan_leg(ground(), LATTICE, ROVER, START, 0.0, GOAL, P)
    assert leg.verdict == "drive"
    assert np.abs(leg.path[:, 0]).max() < 1e-9
    assert leg.path[-1, 1] == pytest.approx(P.length * ROVER.wheel_base, abs=0.01)


def test_the_leg_ends_before_the_wheels_stand_on_unknown_ground() -> None:
    leg = plan_leg(ground((Y > 0.15, UNKNOWN)), LATTICE, ROVER, START, 0.0, GOAL, P)
    assert leg.verdict == "drive"
    end = leg.path[-1, 1]
    assert 0.15 - half_width(ROVER) - 0.02 < end <= 0.155 - half_width(ROVER)
    assert leg.way[-1, 1] > 0.75  # though the way is planned on over it


def test_a_wall_with_a_gap_is_gone_round_and_a_closed_one_is_no_path() -> None:
    wall = (np.abs(Y - 0.4) < 0.02) & (X < 0.1)
    leg = plan_leg(ground((wall, HAZARDOUS)), LATTICE, ROVER, START, 0.0, GOAL, P)
    assert leg.verdict == "drive"
    beside = leg.way[np.abs(leg.way[:, 1] - 0.4) < 0.02]
    assert beside[:, 0].min() >= 0.1 + half_width(ROVER) + ROVER.margin - 0.011
    closed = plan_leg(ground((np.abs(Y - 0.4) < 0.02, HAZARDOUS)), LATTICE, ROVER, START, 0.0, GOAL, P)
    assert closed.verdict == "no path"
    match = re.search(r"ends (\d+) mm away", closed.reason)
    assert match is not None
    # half a vehicle and its margin behind the wall
    assert float(match[1]) == pytest.approx(1000 * (0.42 + half_width(ROVER) + ROVER.margin), abs=15)


def test_a_goal_among_hazards_is_said() -> None:
    rock = np.hypot(X - GOAL[0], Y - GOAL[1]) < 0.05
    leg = plan_leg(ground((rock, HAZARDOUS)), LATTICE, ROVER, START, 0.0, GOAL, P)
    assert (leg.verdict, leg.reason) == ("no path", "the goal itself is on hazardous ground, or too near to it")


def test_at_the_goal_it_ends() -> None:
    assert plan_leg(ground(), LATTICE, ROVER, (0.0, 0.78), 0.0, GOAL, P).verdict == "goal"


def test_a_goal_outside_the_map_is_refused_with_the_map() -> None:
    with pytest.raises(InputError, match=r"the goal \(0.000, 3.000\) m is outside the map: give x in -0.4"):
        plan_leg(ground(), LATTICE, ROVER, START, 0.0, (0.0, 3.0), P)


def test_more_than_the_greatest_turn_is_done_on_the_spot_first() -> None:
    leg = plan_leg(ground(), LATTICE, ROVER, START, math.pi / 2, GOAL, P)
    assert (leg.verdict, len(leg.path)) == ("turn", 1)
    assert leg.turn == pytest.approx(-math.radians(P.max_turn_deg))


def test_it_looks_around_then_closes_what_stays_unknown_and_goes_another_way() -> None:
    risk = ground(((np.abs(Y - 0.15) < 0.05) & (X < 0.1), UNKNOWN))
    start, goal = (-0.3, 0.02), (-0.3, 0.8)
    for looks in range(P.looks):
        assert plan_leg(risk, LATTICE, ROVER, start, 0.0, goal, P, looks).verdict == "look"
    places: list[tuple[float, float]] = []
    while (leg := plan_leg(risk, LATTICE, ROVER, start, 0.0, goal, P, P.looks, places)).where is not None:
        places.append(leg.where)
        assert len(places) < 12
    assert leg.verdict == "turn"
    assert leg.turn < 0  # to the right, where more is known


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(4, 9), st.integers(4, 9))
def test_costs_are_those_of_networkx(seed: int, rows: int, cols: int) -> None:
    rng = np.random.default_rng(seed)
    price = np.where(rng.random((rows, cols)) < 0.25, np.inf, rng.uniform(1, 3, (rows, cols)))
    goals = np.zeros((rows, cols), bool)
    goals[rng.integers(rows), rng.integers(cols)] = True
    cost, _ = costs(price, goals, 0.5)
    graph = networkx.Graph()
    graph.add_nodes_from((r, c) for r in range(rows) for c in range(cols))
    for r, c in list(graph):
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            b = (r + dr, c + dc)
            if b in graph and np.isfinite(price[r, c] + price[b]):
                graph.add_edge((r, c), b, weight=0.5 * (price[r, c] + price[b]) * 0.5 * math.hypot(dr, dc))
    goal = tuple(int(v) for v in np.argwhere(goals)[0])
    lengths = networkx.single_source_dijkstra_path_length(graph, goal) if np.isfinite(price[goal]) else {}
    for cell in graph:
        assert cost[cell] == pytest.approx(lengths.get(cell, np.inf))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_no_leg_comes_near_a_hazard_or_onto_unknown_ground(seed: int) -> None:
    rng = np.random.default_rng(seed)
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    for _ in range(8):
        x, y, r = rng.uniform(-0.4, 0.4), rng.uniform(0.12, 0.9), rng.uniform(0.01, 0.04)
        risk[np.hypot(X - x, Y - y) < r] = rng.choice([HAZARDOUS, UNKNOWN])
    leg = plan_leg(Hazards.of(risk, None, LATTICE.cell, ROVER), LATTICE, ROVER, START, 0.0, GOAL, P)
    line = np.concatenate([np.linspace(a, b, 20) for a, b in zip(leg.path, leg.path[1:], strict=False)] or [leg.path])
    line = line[np.hypot(*line.T) > 0.3 * ROVER.wheel_base]  # where it stands already is as it is
    for kind, need in ((HAZARDOUS, half_width(ROVER) + ROVER.margin), (UNKNOWN, half_width(ROVER))):
        there = np.column_stack([X[risk == kind], Y[risk == kind]])
        if len(there) and len(line):
            gap = np.hypot(*(line[:, None] - there[None]).transpose(2, 0, 1)).min()
            assert gap > need - 0.5 * math.sqrt(2) * LATTICE.cell - 1e-9  # a point of the line is within its cell


def test_hazards_to_the_whole_vehicle_count_at_its_middle_alone() -> None:
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    reason = np.zeros(LATTICE.shape, np.uint16)
    at = (60, 40)
    risk[at] = HAZARDOUS
    gaps = {}
    for name in ("step", "tilt"):
        reason[at] = REASONS[name]
        gaps[name] = Hazards.of(risk, reason, LATTICE.cell, ROVER).gap[60, 50]
    reason[at] |= REASONS["uncertain"]
    doubtful = Hazards.of(risk, reason, LATTICE.cell, ROVER)
    assert doubtful.gap[60, 50] == pytest.approx(0.1)
    assert doubtful.proven[60, 50] == np.inf
    assert gaps["tilt"] == pytest.approx(0.1)
    assert gaps["step"] == pytest.approx(0.1 - half_width(ROVER))


def test_uncertain_ground_is_planned_over_and_not_driven_on() -> None:
    risk, reason = np.full(LATTICE.shape, SAFE, np.uint8), np.zeros(LATTICE.shape, np.uint16)
    wall = np.abs(Y - 0.2) < 0.02
    risk[wall], reason[wall] = HAZARDOUS, REASONS["step"] | REASONS["uncertain"]
    leg = plan_leg(Hazards.of(risk, reason, LATTICE.cell, ROVER), LATTICE, ROVER, START, 0.0, GOAL, P)
    assert leg.verdict == "drive"
    assert leg.path[-1, 1] <= 0.18 - half_width(ROVER) - ROVER.margin + LATTICE.cell
    assert leg.way[-1, 1] > 0.75


def test_the_shortest_way_is_straight_or_none() -> None:
    length = shortest(ground(), LATTICE, ROVER, START, GOAL, 0.015)
    assert length == pytest.approx(0.8 - 0.015, abs=0.011)
    wall = ground((np.abs(Y - 0.4) < 0.02, HAZARDOUS))
    assert shortest(wall, LATTICE, ROVER, START, GOAL, 0.015) is None
    assert shortest(ground((Y > 0.5, UNKNOWN)), LATTICE, ROVER, START, GOAL, 0.015) is None
