"""Poses on a risk map: distances by hand, and by looking at every cell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import CAUTION, HAZARDOUS, REASONS, SAFE, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.local_planner.clearance import DOUBTED_GROUND, Footing, Hazards

ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.10, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
LATTICE = Lattice.snap((-0.3, 0.3, -0.3, 0.3), 0.005)
XY = LATTICE.xy()
X, Y = XY[..., 0], XY[..., 1]
WHEELS = np.array([(a, b) for a in (-0.04, 0.04) for b in (-0.05, 0.05)])


def at(footing: Footing, x: float, y: float, heading: float) -> tuple[float, float, float, float]:
    g = footing.gaps(np.array([x]), np.array([y]), np.array([heading]))
    return float(g.gap[0]), float(g.proven[0]), float(g.unknown[0]), float(g.caution[0])


def test_turned_by_a_right_angle_the_wheels_are_where_they_are() -> None:
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    risk[np.hypot(X - 0.05, Y - 0.1) < 1e-9] = HAZARDOUS
    footing = Footing.of(Hazards(risk), LATTICE, ROVER)
    assert at(footing, 0.0, 0.0, 0.0)[0] == pytest.approx(math.hypot(0.01, 0.05))
    assert at(footing, 0.0, 0.0, math.pi / 2)[0] == pytest.approx(math.hypot(0.0, 0.06))  # a wheel is at (0.05, 0.04)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3.1, 3.1))
def test_gaps_are_those_of_looking_at_every_cell(seed: int, x: float, y: float, heading: float) -> None:
    rng = np.random.default_rng(seed)
    risk = rng.choice([SAFE, HAZARDOUS, UNKNOWN], LATTICE.shape, p=[0.98, 0.01, 0.01]).astype(np.uint8)
    reason = np.where(rng.random(risk.shape) < 0.5, REASONS["tilt"], REASONS["step"]).astype(np.uint16)
    gap, _, unknown, _ = at(Footing.of(Hazards(risk, reason), LATTICE, ROVER), x, y, heading)
    c, s = math.cos(heading), math.sin(heading)
    wheels = WHEELS @ np.array([[c, s], [-s, c]]) + (x, y)
    step, tilt = (XY[(risk == HAZARDOUS) & (reason == REASONS[name])] for name in ("step", "tilt"))
    least = min(
        float(np.hypot(*(wheels[:, None] - step[None]).transpose(2, 0, 1)).min()),
        float(np.hypot(*(tilt - (x, y)).T).min()),
    )
    half = 0.5 * math.sqrt(2) * LATTICE.cell  # a point counts as the middle of its cell
    assert gap == pytest.approx(least, abs=half + 1e-6)
    inside = (XY[risk == UNKNOWN] - (x, y)) @ np.array([[c, -s], [s, c]])
    beside = (np.abs(inside) > np.array([0.04, 0.05]) + 2 * half).any(axis=1)
    away = np.hypot(*(wheels[:, None] - XY[risk == UNKNOWN][None]).transpose(2, 0, 1)).min()
    if beside.all() and away > ROVER.margin + 2 * half:
        assert unknown > 0
    if away < ROVER.margin - half:
        assert unknown < 0


def test_unknown_ground_wider_than_half_a_wheel_is_never_missed() -> None:
    for x, y in np.random.default_rng(1).uniform((-0.04, -0.05), (0.04, 0.05), (60, 2)):
        risk = np.full(LATTICE.shape, SAFE, np.uint8)
        risk[np.hypot(X - x, Y - y) < 0.0125] = UNKNOWN
        assert at(Footing.of(Hazards(risk), LATTICE, ROVER), 0.0, 0.0, 0.0)[2] <= 0


def test_wheels_keep_the_margin_from_unknown_ground_and_no_more() -> None:
    for far in np.arange(0.045, 0.12, 0.001):
        risk = np.where(far < X, np.uint8(UNKNOWN), np.uint8(SAFE))
        edge = X[risk == UNKNOWN].min()
        beneath = at(Footing.of(Hazards(risk), LATTICE, ROVER), 0.0, 0.0, 0.0)[2] <= 0
        assert beneath == (edge < 0.04 + ROVER.margin + 0.5 * LATTICE.cell + 1e-9)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-4.0, 4.0))
def test_cells_beneath_are_those_for_which_it_may_not_stand_there(x: float, y: float, heading: float) -> None:
    footing = Footing.of(Hazards(np.full(LATTICE.shape, SAFE, np.uint8)), LATTICE, ROVER)
    beneath = footing.beneath(np.ones(LATTICE.shape, bool), (x, y, heading))
    assert len(np.unique(beneath, axis=0)) == len(beneath) > 0
    taken = {tuple(np.rint(LATTICE.index(p)).astype(int)) for p in beneath}
    for row, col in np.random.default_rng(0).integers((20, 20), (100, 100), (60, 2)):
        unknown = np.full(LATTICE.shape, SAFE, np.uint8)
        unknown[row, col] = UNKNOWN
        gap = at(Footing.of(Hazards(unknown), LATTICE, ROVER), x, y, heading)[2]
        if gap <= 0.0:
            assert (row, col) in taken
        elif (row, col) in taken:
            assert gap < 0.5 * math.hypot(0.015, 0.015) + 2.0 * LATTICE.cell, "points of the belly are 15 mm apart"


def test_unknown_spots_where_a_wheel_has_no_room_are_no_frontier() -> None:
    spot, hole = np.hypot(X, Y - 0.05) < 0.012, np.hypot(X, Y - 0.05) < 0.03
    for unknown, is_one in ((spot, False), (hole, True), (Y > 0.03, True), (np.abs(Y - 0.05) < 0.006, False)):
        risk = np.where(unknown, np.uint8(UNKNOWN), np.uint8(SAFE))
        gaps = Footing.of(Hazards(risk), LATTICE, ROVER).gaps(*np.zeros((3, 1)))
        assert gaps.unknown[0] <= 0
        assert (gaps.frontier[0] <= 0) == is_one
        assert gaps.frontier[0] >= gaps.unknown[0]


def test_outside_the_map_it_may_not_be() -> None:
    footing = Footing.of(Hazards(np.full(LATTICE.shape, SAFE, np.uint8)), LATTICE, ROVER)
    assert at(footing, 0.0, 0.0, 0.0) == (np.inf, np.inf, np.inf, 0.0)
    assert at(footing, 0.27, 0.0, 0.0)[2] < 0  # two wheels are beyond its edge
    assert at(footing, 0.4, 0.0, 0.0)[:2] == (-np.inf, -np.inf)


def test_hazards_of_little_probability_are_not_proven() -> None:
    risk = np.where(np.hypot(X, Y - 0.1) < 0.01, np.uint8(HAZARDOUS), np.uint8(SAFE))
    p = np.where(Y > 0.1, 0.6, 0.95).astype(np.float32)
    reason = np.full(risk.shape, REASONS["step"], np.uint16)
    gap, proven, _, _ = at(Footing.of(Hazards(risk, reason, p), LATTICE, ROVER, p_certain=0.9), 0.04, 0.17, 0.0)
    below = at(Footing.of(Hazards(risk, reason, p), LATTICE, ROVER, p_certain=0.5), 0.04, 0.17, 0.0)
    assert gap == below[0] == below[1]
    assert proven > gap


def test_caution_counts_wheels_and_middle() -> None:
    risk = np.where(X > 0.02, np.uint8(CAUTION), np.uint8(SAFE))
    footing = Footing.of(Hazards(risk), LATTICE, ROVER)
    assert [at(footing, x, 0.0, 0.0)[3] for x in (-0.1, 0.0, 0.1)] == [0, 2, 5]


def test_what_is_hazardous_by_sigma_alone_and_improbable_is_doubted_ground() -> None:
    risk = np.where(np.hypot(X - 0.04, Y - 0.05) < 0.01, np.uint8(HAZARDOUS), np.uint8(SAFE))
    reason = np.full(risk.shape, REASONS["step"] | REASONS["uncertain"], np.uint16)
    p = np.full(risk.shape, 0.2, np.float32)
    hazards, here = Hazards(risk, reason, p), np.zeros((3, 1))
    daring, not_so = (
        Footing.of(hazards, LATTICE, ROVER, p_certain=0.9, p_traversable=d).gaps(*here) for d in (0.3, 0.1)
    )
    assert (daring.gap[0], daring.doubtful[0], daring.doubted[0], daring.caution[0]) == (np.inf, np.inf, 1, 0)
    assert (not_so.gap[0], not_so.doubtful[0], not_so.doubted[0], not_so.caution[0]) == (np.inf, 0.0, 0, 0)


def test_what_a_wheel_meets_is_doubted_below_the_wheels_alone() -> None:
    risk, here = np.full(LATTICE.shape, SAFE, np.uint8), np.zeros((3, 1))
    middle, wheel = (np.hypot(X - x, Y - y) < 0.01 for x, y in ((0.0, 0.0), (0.04, 0.05)))
    for doubted, count in ((middle, 0), (wheel, 1)):
        assert Footing.of(Hazards(risk, doubted=doubted), LATTICE, ROVER).gaps(*here).doubted[0] == count


def test_whether_a_wheel_may_be_dared_does_not_depend_on_how_the_vehicle_would_stand() -> None:
    risk = np.where(np.hypot(X - 0.04, Y - 0.05) < 0.01, np.uint8(HAZARDOUS), np.uint8(SAFE))
    reason = np.full(risk.shape, REASONS["step"] | REASONS["uncertain"], np.uint16)
    standing, wheel = np.full(risk.shape, 0.4, np.float32), np.full(risk.shape, 0.2, np.float32)
    hazards, here = Hazards(risk, reason, standing, wheel), np.zeros((3, 1))
    gaps = Footing.of(hazards, LATTICE, ROVER, p_certain=0.9, p_traversable=0.3).gaps(*here)
    assert (gaps.doubtful[0], gaps.doubted[0]) == (np.inf, 1)


def test_ground_within_a_quarter_of_a_wheel_of_doubted_ground_is_dear() -> None:
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    unknown = Y > 0.2
    footing = Footing.of(Hazards(risk, unknown=unknown, doubted=X > 0.059), LATTICE, ROVER)
    assert np.array_equal(
        footing.maps.wheels.cost_class == DOUBTED_GROUND, (X > 0.054) & ~unknown
    )  # a cell of 5 mm beside it, not the next
