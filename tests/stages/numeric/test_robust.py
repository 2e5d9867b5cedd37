"""Robust statistics: their defining properties, and that kernels compile them to the same bits."""

import numpy as np
import pytest
from numba import njit

from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, cauchy, huber_weight, mad_sigma


def test_the_spread_of_normal_errors_is_their_standard_deviation_and_outliers_hardly_move_it():
    errors = np.random.default_rng(1).normal(3.0, 2.0, 100_000)
    assert mad_sigma(errors) == pytest.approx(2.0, rel=0.02)
    errors[:1000] = 1e6
    assert mad_sigma(errors) == pytest.approx(2.0, rel=0.05)
    assert mad_sigma(np.array([1.0, -3.0, 2.0]), 0.0) == pytest.approx(2 * 1.4826)


def test_the_bisquare_has_its_efficiency_where_errors_are_normal():
    """Asymptotic efficiency ``E[psi']^2 / E[psi^2]`` of the constant: 95 %."""
    r = np.linspace(-8.0, 8.0, 200_001)
    density = np.exp(-0.5 * r * r)
    psi = r * bisquare(r / TUKEY_BISQUARE)
    share = np.sum(np.gradient(psi, r) * density) ** 2 / (np.sum(psi**2 * density) * np.sum(density))
    assert share == pytest.approx(0.95, abs=1e-3)


def test_hubers_weight_bounds_the_residual():
    for r in (0.1, 1.0, 2.4, 2.6, 10.0):
        assert huber_weight(r, 2.5) * r == pytest.approx(min(r, 2.5))


def test_cauchys_weight_is_that_of_its_logarithmic_cost():
    """The weight is the derivative of ``spread^2 / 2 log(1 + (r / spread)^2)`` over the residual."""
    r, spread = np.linspace(0.01, 20.0, 100_000), 2.5
    cost = 0.5 * spread**2 * np.log1p((r / spread) ** 2)
    np.testing.assert_allclose(cauchy(r, spread)[1:-1], (np.gradient(cost, r) / r)[1:-1], rtol=1e-3)


def test_kernels_compile_the_same_numbers():
    r = np.random.default_rng(2).uniform(0.0, 6.0, 1000)

    @njit
    def compiled(r):
        out = np.empty((2, len(r)))
        for i in range(len(r)):
            out[0, i], out[1, i] = bisquare(r[i] / 4.685), huber_weight(r[i], 2.5)
        return out

    plain = [bisquare(r / 4.685), huber_weight(r, 2.5)]
    np.testing.assert_array_equal(compiled(r), plain)
