"""Risk map: a hand-computed bump, slopes and steps against their limits, noise, unknowns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.declare import Bundle, check_outputs
from stages.lattice import Lattice
from stages.risk import (
    FILLED_BIT,
    HAZARDOUS,
    INCLINATION_BIT,
    SAFE,
    STAGE,
    STEP_BIT,
    UNKNOWN,
    UNKNOWN_BIT,
    RiskParams,
    risk_map,
    window_cells,
)
from stages.vehicle import DEFAULT_VEHICLE, Vehicle

MODEL = Vehicle(
    name="model",
    wheel_diameter=0.03,
    track=0.08,
    wheel_base=0.1,
    clearance=0.03,
    max_slope_deg=20.0,
    max_step=0.015,
    max_roughness=0.01,
    margin=0.01,
)
FINE = 0.001


def judge(z: np.ndarray, cell: float = FINE, std: float = 0.0, vehicle: Vehicle = MODEL, **params: float) -> dict:
    z = z.astype(np.float32)
    return risk_map(z, np.full_like(z, std), cell, vehicle, RiskParams(**params))


def ramp(slope: float, direction: float = 0.0, shape: tuple[int, int] = (80, 80)) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]] * FINE
    return math.tan(slope) * (x * math.cos(direction) + y * math.sin(direction))


def test_a_bump_on_five_by_five_by_hand() -> None:
    """Windows of 3 x 3; every one that holds the 20 mm bump has a step of 20 mm; corners hold 4 of 9 cells."""
    z = np.zeros((5, 5))
    z[2, 2] = 0.02
    out = judge(z, cell=0.01)
    near = np.zeros((5, 5), dtype=bool)
    near[1:4, 1:4] = True
    corner = np.zeros((5, 5), dtype=bool)
    corner[[0, 0, -1, -1], [0, -1, 0, -1]] = True
    np.testing.assert_array_equal(out["risk"] == HAZARDOUS, near)
    np.testing.assert_array_equal(out["risk"] == UNKNOWN, corner)
    diagonal = np.zeros((5, 5), dtype=bool)
    diagonal[[1, 1, 3, 3], [1, 3, 1, 3]] = True
    expected = STEP_BIT * near + INCLINATION_BIT * diagonal + UNKNOWN_BIT * corner
    np.testing.assert_array_equal(out["reason"], expected)
    np.testing.assert_allclose(out["step"][near], 0.02, rtol=1e-6)
    # beside the bump: gradient sum(x z) / sum(x^2) = 0.01 * 0.02 / (6 * 0.01^2) = 1/3, less than 0.02 / 0.02
    assert out["inclination"][2, 1] == pytest.approx(math.atan(1 / 3), abs=1e-6)
    # at its corners that along both axes: 25 degrees, over the limit
    assert out["inclination"][1, 1] == pytest.approx(math.atan(math.sqrt(2) / 3), abs=1e-6)
    assert out["inclination"][2, 2] == pytest.approx(0.0, abs=1e-6)
    # nine cells, one of 20 mm: variance 0.02^2 (1/9 - 1/81)
    assert out["roughness"][2, 2] == pytest.approx(0.02 * math.sqrt(8) / 9, rel=1e-5)


def test_window_is_the_wheel_in_cells() -> None:
    assert [window_cells(d, 0.001) for d in (0.03, 0.025, 0.001)] == [31, 25, 3]
    assert window_cells(0.3, 0.1) == 3


@pytest.mark.parametrize("direction", [0.0, 0.5, math.pi / 4, 2.0])
@pytest.mark.parametrize(("slope_deg", "hazardous"), [(19.5, False), (20.5, True)])
def test_a_slope_is_judged_alike_in_all_directions(direction: float, slope_deg: float, hazardous: bool) -> None:
    # a step limit out of the way: over the wheel's radius this slope rises 0.37 * 14 mm * sqrt(2) = 7.5 mm
    out = judge(ramp(math.radians(slope_deg), direction))
    inner = np.s_[16:-16, 16:-16]
    np.testing.assert_allclose(out["inclination"][inner], math.radians(slope_deg), atol=1e-4)
    assert ((out["reason"] & INCLINATION_BIT) > 0)[inner].all() == hazardous
    assert ((out["reason"] & STEP_BIT) == 0).all()


@pytest.mark.parametrize(("height", "hazardous"), [(0.014, False), (0.016, True)])
def test_a_step_is_found_within_a_wheels_radius(height: float, hazardous: bool) -> None:
    z = np.zeros((80, 80))
    z[:, 40:] = height
    out = judge(z, vehicle=MODEL.model_copy(update={"max_slope_deg": 60.0}))
    step = (out["reason"] & STEP_BIT) > 0
    columns = np.flatnonzero(step.any(axis=0))
    if hazardous:
        half = window_cells(0.5 * MODEL.wheel_diameter, FINE) // 2
        assert (columns[0], columns[-1]) == (40 - half, 39 + half)
    else:
        assert len(columns) == 0


@pytest.mark.parametrize(
    ("cell", "vehicle", "share"), [(0.001, MODEL, 0.25), (0.1, DEFAULT_VEHICLE, 0.125)], ids=["median", "coarse"]
)
def test_noise_does_not_make_flat_ground_hazardous(cell: float, vehicle: Vehicle, share: float) -> None:
    sigma = share * vehicle.max_step
    z = np.random.default_rng(1).normal(scale=sigma, size=(150, 150))
    out = judge(z, cell, std=sigma, vehicle=vehicle, max_std=share * 1.01)
    # coarse: a step limit is 8 sigma plus 2 k sigma, a range of nine; slope limit / (sigma / (cell sqrt(6))) = 5.9;
    # windows at the border hold six cells only, whose planes are twice as uncertain
    assert (out["risk"][1:-1, 1:-1] == HAZARDOUS).sum() == 0


def test_noise_does_not_hide_a_step() -> None:
    """A step of 1.3 limits stays one at the largest noise that counts as known: 2 k sigma is limit / 4."""
    sigma = 0.25 * MODEL.max_step
    z = np.random.default_rng(2).normal(scale=sigma, size=(100, 100))
    z[50:] += 1.3 * MODEL.max_step
    out = judge(z, std=sigma, max_std=0.26)
    assert ((out["reason"][48:52, 1:-1] & STEP_BIT) > 0).all()


def test_a_single_wrong_cell_on_fine_ground_is_no_rock_but_a_coarse_post_is() -> None:
    z = np.zeros((60, 60))
    z[30, 30] = 0.05
    assert (judge(z)["risk"] == HAZARDOUS).sum() == 0
    z[30, 30] = 0.5
    assert (judge(z, cell=0.1, vehicle=DEFAULT_VEHICLE)["risk"] == HAZARDOUS).sum() == 9


def test_uncertain_elevation_is_unknown() -> None:
    z = np.zeros((60, 60), dtype=np.float32)
    std = np.zeros_like(z)
    std[20:40, 20:40] = 0.26 * MODEL.max_step
    out = risk_map(z, std, FINE, MODEL)
    core = np.s_[28:32, 28:32]
    assert (out["risk"][core] == UNKNOWN).all()
    assert np.isnan(out["elevation"][core]).all()


def test_unknown_does_not_grow_and_small_holes_are_flagged() -> None:
    z = np.zeros((120, 120))
    z[:, :40] = np.nan
    z[60:63, 80:83] = np.nan
    out = judge(z)
    assert (out["risk"][20:100, :40] == UNKNOWN).all()
    assert (out["risk"][20:100, 40:] == SAFE).all()
    np.testing.assert_array_equal(np.argwhere(out["filled"]), np.argwhere(np.isnan(z) & (np.arange(120) > 60)))
    assert ((out["reason"] & FILLED_BIT) > 0).sum() == 9


def test_a_slope_at_a_straight_border_is_not_halved() -> None:
    z = ramp(math.radians(21), math.pi / 2)
    z[:40] = np.nan
    assert (judge(z)["risk"][40:50, 20:60] == HAZARDOUS).all()


def test_a_step_proven_by_few_cells_is_hazardous() -> None:
    z = np.full((80, 80), np.nan)
    z[40:43, 40:43] = 0.0
    z[40:43, 43:46] = 0.03
    out = judge(z, max_hole=0.0)
    assert (out["risk"][40:43, 40:46] == HAZARDOUS).all()


def test_nothing_known() -> None:
    out = judge(np.full((10, 10), np.nan))
    assert (out["risk"] == UNKNOWN).all()
    assert (out["reason"] == UNKNOWN_BIT).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), share=st.floats(0.0, 0.9))
def test_unknown_is_never_safe_and_every_hazard_has_a_reason(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    z = np.cumsum(rng.normal(scale=0.002, size=(40, 50)), axis=1)
    z[rng.random(z.shape) < share] = np.nan
    out = judge(z, cell=0.005)
    blank = np.isnan(z) & (out["filled"] == 0)
    assert (out["risk"][blank] == UNKNOWN).all()
    limits = out["reason"] & 7
    np.testing.assert_array_equal(out["risk"] == HAZARDOUS, (limits > 0) & (out["risk"] != UNKNOWN))
    np.testing.assert_array_equal((out["reason"] & UNKNOWN_BIT) > 0, out["risk"] == UNKNOWN)
    mirrored = judge(z[:, ::-1], cell=0.005)
    np.testing.assert_array_equal(mirrored["filled"], out["filled"][:, ::-1])
    np.testing.assert_allclose(mirrored["step"], out["step"][:, ::-1], atol=1e-7)
    np.testing.assert_allclose(mirrored["inclination"], out["inclination"][:, ::-1], atol=1e-6)


def test_the_stage_assembles_tiles() -> None:
    whole = Lattice.at(-10, 30, FINE, 60, 90)
    z = ramp(0.2, 1.0, whole.shape).astype(np.float32)
    parts = [Lattice.at(-10, 30, FINE, 60, 40), Lattice.at(30, 30, FINE, 60, 50)]
    dems = [
        Bundle(
            {"elevation": z[whole.window(p)], "elevation_std": np.full(p.shape, 1e-4, dtype=np.float32)},
            {"lattice": p.to_dict(), "frame": "world"},
        )
        for p in parts
    ]
    out = STAGE.run(RiskParams(), {"vehicle": MODEL.model_dump()}, {"dem": dems})
    check_outputs(STAGE, out)
    one = judge(z, std=1e-4)
    np.testing.assert_array_equal(out["risk"], one["risk"])
    assert out.meta["lattice"] == whole.to_dict()
    assert sum(out.meta["shares"][k] for k in ("safe", "hazardous", "unknown")) == pytest.approx(1.0)
    exact = STAGE.run(RiskParams(), {}, {"dem": [Bundle({"elevation": z}, {"lattice": whole.to_dict()})]})
    assert exact.meta["vehicle"]["name"] == "default rover"
