"""Moving windows against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.numeric.windows import window_count, window_mean, window_sum, window_sum32


@pytest.mark.parametrize("n", [1, 3, 7, 25])
def test_sums_and_means_equal_loops(n: int) -> None:
    rng = np.random.default_rng(n)
    z = rng.normal(size=(13, 17)).astype(np.float32)
    z[rng.random(z.shape) < 0.2] = np.nan
    z[:3, :4] = np.nan
    sums, counts, means = window_sum(~np.isnan(z), n), window_count(~np.isnan(z), n), window_mean(z, n)
    for r in range(z.shape[0]):
        for c in range(z.shape[1]):
            part = z[max(r - n // 2, 0) : r + n // 2 + 1, max(c - n // 2, 0) : c + n // 2 + 1].astype(float)
            known = ~np.isnan(part)
            assert sums[r, c] == counts[r, c] == known.sum()
            if known.any():
                assert means[r, c] == pytest.approx(part[known].mean(), abs=2.5e-7)  # float32 of about 2
            else:
                assert np.isnan(means[r, c])


@pytest.mark.parametrize("n", [1, 3, 9])
def test_sums_of_whole_numbers_are_exact(n: int) -> None:
    a = np.random.default_rng(n).integers(0, 9, (7, 12)).astype(float)
    half = n // 2
    expected = [
        [a[max(r - half, 0) : r + half + 1, max(c - half, 0) : c + half + 1].sum() for c in range(12)] for r in range(7)
    ]
    np.testing.assert_array_equal(window_sum(a, n), expected)
    np.testing.assert_array_equal(window_sum32(a, n), expected)
    assert window_sum32(a, n).dtype == np.float32


def test_sums_in_single_precision_add_up_in_double() -> None:
    a = np.full((60, 70), 1e-4, np.float32)
    a[:, :9] = 1e4  # running sums of float32 would lose what follows
    expected = window_sum(a, 5)
    np.testing.assert_allclose(window_sum32(a, 5), expected, rtol=1e-6)


def test_a_mean_far_from_zero_keeps_its_digits() -> None:
    a = (1000.0 + np.random.default_rng(0).normal(size=(40, 50)) * 1e-3).astype(np.float32)
    expected = [[a[r - 2 : r + 3, c - 2 : c + 3].mean(dtype=float) for c in range(2, 48)] for r in range(2, 38)]
    np.testing.assert_array_equal(window_mean(a, 5)[2:-2, 2:-2], np.float32(expected))
