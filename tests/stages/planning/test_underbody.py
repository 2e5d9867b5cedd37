"""Ground that was not seen may be under the belly where it cannot be too high; never under a wheel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import SAFE, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.local_planner.clearance import Footing, Hazards, Straddle, clears
from rille.stages.terrain.occlusion_bounds import Bounds

ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.10, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
LATTICE = Lattice.snap((-0.2, 0.2, -0.2, 0.2), 0.004)
X, Y = LATTICE.xy()[..., 0], LATTICE.xy()[..., 1]
SPOT = np.hypot(X, Y) < 0.012


def footing(hidden: np.ndarray, upper: np.ndarray, ground: np.ndarray | float = 0.0) -> Footing:
    """Ground of a height (row, col) m, with hidden ground of which an upper bound (row, col) m is known."""
    risk = np.where(hidden, np.uint8(UNKNOWN), np.uint8(SAFE))
    ground = np.broadcast_to(ground, LATTICE.shape)
    bounds = Bounds(
        np.where(hidden, upper, ground).astype(np.float32), np.where(hidden, np.nan, ground).astype(np.float32)
    )
    return Footing.of(Hazards(risk), LATTICE, ROVER, bounds=bounds)


def unknown(risk: Footing, x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> float:
    return float(risk.gaps(np.array([x]), np.array([y]), np.array([heading])).unknown[0])


@pytest.mark.parametrize("heading", [0.0, 0.4, -1.2, 2.5])
def test_a_spot_that_cannot_be_too_high_may_be_under_the_belly(heading: float) -> None:
    low, high = (np.full(LATTICE.shape, ROVER.clearance + d) for d in (-0.001, 0.001))
    assert unknown(footing(SPOT, low), heading=heading) > 0
    assert unknown(footing(SPOT, high), heading=heading) <= 0
    void = footing(np.hypot(X, Y) < 0.025, np.full(LATTICE.shape, np.nan))
    assert unknown(void, heading=heading) <= 0
    assert float(void.gaps(*(np.array([v]) for v in (0.0, 0.0, heading))).frontier[0]) <= 0
    assert unknown(Footing.of(Hazards(np.where(SPOT, UNKNOWN, SAFE).astype(np.uint8)), LATTICE, ROVER)) <= 0


def test_the_clearance_is_over_the_plane_of_the_wheels() -> None:
    slope = 0.2 * Y - 0.3
    for above, free in ((-0.004, True), (0.004, False)):
        upper = slope + ROVER.clearance + above - 0.25 * 0.2 * ROVER.wheel_base
        assert (unknown(footing(SPOT, upper, slope)) > 0) == free


@settings(max_examples=60, deadline=None)
@given(st.floats(-0.07, 0.07), st.floats(-0.07, 0.07), st.floats(-3.2, 3.2))
def test_no_wheel_comes_nearer_to_it_than_the_margin(x: float, y: float, heading: float) -> None:
    risk = footing(SPOT, np.zeros(LATTICE.shape))
    c, s = np.cos(heading), np.sin(heading)
    wheels = [(x + a * c - b * s, y + a * s + b * c) for a in (-0.04, 0.04) for b in (-0.05, 0.05)]
    away = min(float(np.hypot(X[SPOT] - p, Y[SPOT] - q).min()) for p, q in wheels)
    if away < ROVER.margin - LATTICE.cell:
        assert unknown(risk, x, y, heading) <= 0
    if away > ROVER.margin + 2 * LATTICE.cell:
        assert unknown(risk, x, y, heading) > 0


def test_steep_stands_and_wheels_on_what_was_not_seen_do_not_count() -> None:
    low = np.full(LATTICE.shape, -1.0)
    for slope, free in ((0.30, True), (0.42, False)):  # 20 degrees are 0.36
        assert (unknown(footing(SPOT, low, slope * Y)) > 0) == free
        assert (unknown(footing(SPOT, low, slope * X)) > 0) == free
    seen = footing(SPOT, low)
    straddle = seen.maps.straddle
    far = np.asarray(straddle.stand).copy()
    far[:, Y > 0.03] = np.nan  # the front wheels stand where only the far view knows the ground
    maps = seen.maps._replace(straddle=straddle._replace(stand=far))
    blind = Footing(LATTICE, ROVER, maps)
    assert unknown(blind) <= 0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.floats(-0.03, 0.03), st.floats(-0.03, 0.03), st.floats(-3.2, 3.2))
def test_raising_what_may_be_there_never_opens_ground(seed: int, x: float, y: float, heading: float) -> None:
    rng = np.random.default_rng(seed)
    hidden = np.hypot(X - rng.uniform(-0.03, 0.03), Y - rng.uniform(-0.03, 0.03)) < 0.01
    upper = rng.uniform(0.0, 0.03, LATTICE.shape)
    upper[rng.random(LATTICE.shape) < 0.01] = np.nan
    more = upper + rng.uniform(0.0, 0.01, LATTICE.shape)
    before, after, without = (
        unknown(footing(hidden, u), x, y, heading) > 0 for u in (upper, more, np.full(LATTICE.shape, np.nan))
    )
    assert before >= after >= without


def test_a_hollow_under_one_wheel_does_not_make_up_for_a_rise_at_another() -> None:
    rng, clearance = np.random.default_rng(5), 0.02
    weights, limits = rng.dirichlet(np.ones(4), 9), np.array([0.08, 0.1, clearance, 0.1])
    met = set()
    for point in np.arange(200) % 9:
        top, heights = rng.uniform(-0.03, 0.06), rng.uniform(-0.05, 0.05, 4)
        one = np.full((1, 1), top, np.float32)
        expected = weights[point] @ np.maximum(0.0, top - heights) <= clearance
        met.add(bool(expected))
        assert clears(Straddle(one, one, np.stack([one, one]), weights, limits), point, 0, 0, heights) == expected
    assert met == {True, False}
