"""Classes against a plain calculation on arrays, and the probability as a rising function."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special
from vehicles import MODEL

from rille.stages.hazard.classification import (
    CAUTION,
    DOUBT_BIT,
    HAZARDOUS,
    LIFT,
    MAX_EXCESS,
    UNKNOWN,
    UNSEEN_BIT,
    RiskParams,
    _chance,
    classify,
)
from rille.stages.hazard.measures import MEASURES, HazardInput, Measure
from rille.stages.numeric.extrema import running_max

RULES = RiskParams(sigmas=1.25, caution=0.75, max_p=0.02, min_known=0.5)


def random_terrain(seed: int, stride: int) -> HazardInput:
    """Cells whose measures are all below and above their limits somewhere, with gaps."""
    rng = np.random.default_rng(seed)
    cell = 0.001 if stride == 4 else 0.005
    z = np.cumsum(rng.normal(scale=0.0012 if stride == 4 else 0.002, size=(70, 90)), axis=1).astype(np.float32)
    z[rng.random(z.shape) < 0.1] = np.nan
    z[:9] = np.nan
    std = rng.uniform(0.0, 0.002, z.shape).astype(np.float32)
    return HazardInput(z, z, std, cell, MODEL, 0.03)


@pytest.mark.parametrize("stride", [1, 4])
def test_classes_and_reasons_equal_a_plain_calculation(stride: int) -> None:
    terrain = random_terrain(stride, stride)
    shape = terrain.closed.shape
    assert terrain.stride == stride

    def spread(a: np.ndarray) -> np.ndarray:
        return np.repeat(np.repeat(a, stride, axis=0), stride, axis=1)[: shape[0], : shape[1]].astype(float)

    noises = [spread(a) for a in (terrain.window_noise(), terrain.footprint_noise())]
    values = {m.name: spread(v) if m.on_blocks else v.astype(float) for m in MEASURES for v in [m.kernel(terrain)]}
    share = spread(terrain.known_share())
    out = classify(terrain, np.zeros(shape, np.uint8), RULES)

    bits, hopeful = np.zeros(shape, int), np.ones(shape, bool)
    most = np.zeros(shape)
    for m in MEASURES:
        bias, wide = m.bias / m.length(terrain), m.spread / m.length(terrain)
        load = (values[m.name] + max(0.0, 1.25 * wide - bias) * noises[m.below]) / m.greatest(MODEL)
        bits += m.bit * (load > 1)
        most = np.maximum(most, load)
        hopeful &= values[m.name] - bias * noises[m.below] <= m.greatest(MODEL)
    hazard = (most > 1) & ~np.isnan(terrain.closed)
    np.testing.assert_array_equal(out["risk"] == HAZARDOUS, hazard)
    np.testing.assert_array_equal(out["reason"] & 127, np.where(hazard, bits, 0))
    np.testing.assert_array_equal((out["reason"] & DOUBT_BIT) > 0, hazard & hopeful)
    unknown = np.isnan(terrain.closed) | ((share < 0.5) & ~hazard)
    np.testing.assert_array_equal(out["risk"] == UNKNOWN, unknown)
    near = ~hazard & ~unknown & ((most > 0.75) | (out["p_hazard"] > 0.02))
    np.testing.assert_array_equal(out["risk"] == CAUTION, near)
    np.testing.assert_array_equal(np.isnan(out["tilt"]), unknown)
    np.testing.assert_allclose(out["tilt"][~unknown], np.arctan(values["tilt"])[~unknown], rtol=1e-6)
    assert 0 < hazard.mean() < 0.9
    # Both probabilities are one rising function, of all measures and of the wheel's.
    wheels = [m for m in MEASURES if not m.below]
    alone = classify(terrain, np.zeros(shape, np.uint8), RULES, tuple(wheels))
    known = ~unknown & (alone["risk"] != UNKNOWN)
    np.testing.assert_array_equal(out["p_wheel"][known], alone["p_hazard"][known])
    assert (out["p_wheel"] <= out["p_hazard"])[known].all()


def test_noise_is_that_of_the_ground_below_and_of_the_shorter_side_between_wheels() -> None:
    z, std = np.zeros((2, 60, 60), np.float32)
    std[30, 30] = 0.01
    terrain = HazardInput(z, z, std, 0.005, MODEL, 0.03)
    # Half of the mean of its length and width, 0.130 and 0.095 m, to either side.
    rows, cols = np.nonzero(terrain.footprint_noise())
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (19, 41, 19, 41)
    assert {m.name: m.length(terrain) for m in MEASURES if m.name in ("slope", "tilt")} == {"slope": 0.08, "tilt": 0.08}


@pytest.mark.parametrize(("window", "unseen"), [(0.03, False), (0.5, True)])
def test_ground_that_is_unknown_in_the_window_alone_is_unseen(window: float, unseen: bool) -> None:
    z = np.zeros((120, 120), np.float32)
    z[50:62, 10:22] = np.nan
    terrain = HazardInput(z, z, np.zeros_like(z), 0.005, MODEL, window)
    reason = classify(terrain, np.zeros(z.shape, np.uint8), RULES)["reason"]
    assert bool(reason[56, 60] & UNSEEN_BIT) == unseen


def test_a_new_measure_is_one_row_and_its_kernel() -> None:
    """A negative obstacle: ground that falls away within two wheels, measured from the cell down."""

    def drop(terrain: HazardInput) -> np.ndarray:
        low = -running_max(-terrain.surface, 2 * terrain.reach)
        return np.nan_to_num(np.maximum(terrain.surface - low, 0.0))

    row = Measure("drop", 1 << 11, drop, "max_step", 0.05, 0.9, "drop", "drop", "height above the lowest ground near")
    z = np.zeros((120, 120), np.float32)
    z[:, 60:] = -0.02  # down by more than the 15 mm that the wheels climb
    terrain = HazardInput(z, z, np.zeros_like(z), 0.001, MODEL, 0.03)
    out = classify(terrain, np.zeros(z.shape, np.uint8), RULES, (*MEASURES, row))
    near = np.zeros(z.shape, bool)
    near[:, 30:60] = True  # two wheel radii of 15 mm before the edge, and nothing below it
    np.testing.assert_array_equal((out["reason"] & row.bit) > 0, near)
    assert (out["risk"][near] == HAZARDOUS).all()
    np.testing.assert_allclose(out["drop"][near], 0.02, atol=1e-7)
    assert np.nanmax(out["drop"][~near]) == 0.0
    without = classify(HazardInput(z, z, np.zeros_like(z), 0.001, MODEL, 0.03), np.zeros(z.shape, np.uint8), RULES)
    assert (without["risk"] <= out["risk"]).all()
    assert (without["risk"][:, 31] < HAZARDOUS).all()


def test_the_probability_rises_from_0_to_1_and_is_a_half_near_the_limit() -> None:
    steps = np.linspace(-MAX_EXCESS, MAX_EXCESS, 2049).astype(np.float32)
    found = _chance(steps)
    assert (np.diff(found) >= 0).all()
    assert (found[0], found[-1]) == (0.0, 1.0)
    # Student's t with 3 degrees of freedom below the lift, and above it.
    below, above = steps < -0.4, (steps > 0.2) & (steps < MAX_EXCESS)
    np.testing.assert_allclose(found[below][1:], special.stdtr(3, steps[below][1:]), atol=1e-6)
    np.testing.assert_allclose(found[above], special.stdtr(3, steps[above] + LIFT), atol=1e-6)
    assert _chance(np.zeros(1, np.float32)) == pytest.approx(0.69, abs=0.01)
