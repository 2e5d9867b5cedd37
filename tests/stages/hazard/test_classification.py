"""Classes against a plain calculation on arrays, and the probability as a rising function."""

from __future__ import annotations

import numpy as np
import pytest
from vehicles import MODEL

from rille.stages.hazard.classification import (
    CAUTION,
    DOUBT_BIT,
    FARTHEST,
    HAZARDOUS,
    STEPS,
    UNKNOWN,
    Rules,
    _table,
    classify,
)
from rille.stages.hazard.hazards import BITS, MEASURES, Measured, limits, noise_factors

RULES = Rules(sigmas=1.25, caution=0.75, max_p=0.02, min_known=0.5)


@pytest.mark.parametrize("stride", [1, 4])
def test_classes_and_reasons_equal_a_plain_calculation(stride: int) -> None:
    rng = np.random.default_rng(stride)
    shape, cell, window = (14, 21), 0.001, 0.03
    coarse = tuple(-(-n // stride) for n in shape)

    def random(size: tuple[int, ...], most: float) -> np.ndarray:
        return (most * rng.random(size)).astype(np.float32)

    limit = limits(MODEL)
    blocks = {name: random(coarse, 1.2 * limit[name]) for name in ("roughness", "slope", "tilt", "rise")}
    measured = Measured(
        random(shape, 0.018), random(shape, 0.012), blocks, random(coarse, 2e-3), random(coarse, 2e-3),
        random(coarse, 1.0), random(coarse, 0.1), stride, window,
    )  # fmt: skip

    def spread(a: np.ndarray) -> np.ndarray:
        return np.repeat(np.repeat(a, stride, axis=0), stride, axis=1)[: shape[0], : shape[1]].astype(float)

    values = {name: spread(a) for name, a in blocks.items()}
    values |= {"step": measured.step.astype(float), "range": measured.range.astype(float)}
    values["inclination"] = values["range"] / window
    noise, under, share = spread(measured.noise), spread(measured.noise_under), spread(measured.share)
    closed = random(shape, 1.0)
    closed[:3] = np.nan
    out = classify(measured, closed, np.zeros(shape, np.uint8), MODEL, window, cell, RULES)

    factors = noise_factors(MODEL, window, cell)
    bits, hopeful = np.zeros(shape, int), np.ones(shape, bool)
    most = np.zeros(shape)
    for name in MEASURES:
        bias, wide = factors[name]
        s = under if name in ("slope", "tilt", "rise") else noise
        load = (values[name] + max(0.0, 1.25 * wide - bias) * s) / limit[name]
        bits += BITS[name] * (load > 1)
        most = np.maximum(most, load)
        hopeful &= values[name] - bias * s <= limit[name]
    hazard = (most > 1) & ~np.isnan(closed)
    np.testing.assert_array_equal(out["risk"] == HAZARDOUS, hazard)
    np.testing.assert_array_equal(out["reason"] & 127, np.where(hazard, bits, 0))
    np.testing.assert_array_equal((out["reason"] & DOUBT_BIT) > 0, hazard & hopeful)
    unknown = np.isnan(closed) | ((share < 0.5) & ~hazard)
    np.testing.assert_array_equal(out["risk"] == UNKNOWN, unknown)
    near = ~hazard & ~unknown & ((most > 0.75) | (out["p_hazard"] > 0.02))
    np.testing.assert_array_equal(out["risk"] == CAUTION, near)
    np.testing.assert_array_equal(np.isnan(out["tilt"]), unknown)
    np.testing.assert_allclose(out["tilt"][~unknown], np.arctan(values["tilt"])[~unknown], rtol=1e-6)
    assert 0 < hazard.mean() < 0.9


def test_the_probability_rises_from_0_to_1_and_is_a_half_near_the_limit() -> None:
    table = _table()
    assert (np.diff(table) >= 0).all()
    assert (table[0], table[-1]) == (0.0, 1.0)
    assert table[int((FARTHEST - 0.4) * STEPS)] == pytest.approx(0.358, abs=0.01)  # Student's t with 3 degrees
    assert table[int(FARTHEST * STEPS)] == pytest.approx(0.69, abs=0.01)
