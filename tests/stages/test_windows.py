"""Moving windows against scipy's filters and against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from stages.windows import fit_planes, running_max, running_min, window_mean, window_sum


def holed(seed: int, shape: tuple[int, int], share: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=shape).astype(np.float32)
    a[rng.random(shape) < share] = np.nan
    return a


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 999), rows=st.integers(1, 30), cols=st.integers(1, 30), half=st.integers(0, 20))
def test_extrema_equal_scipy(seed: int, rows: int, cols: int, half: int) -> None:
    a, n = holed(seed, (rows, cols)), 2 * half + 1
    low, high = np.where(np.isnan(a), -np.inf, a), np.where(np.isnan(a), np.inf, a)
    np.testing.assert_array_equal(running_max(a, n), maximum_filter(low, n, mode="constant", cval=-np.inf))
    np.testing.assert_array_equal(running_min(a, n), minimum_filter(high, n, mode="constant", cval=np.inf))


@pytest.mark.parametrize("n", [1, 3, 7, 25])
def test_sums_means_and_planes_equal_loops(n: int) -> None:
    z, cell = holed(n, (13, 17)), 0.5
    z[:3, :4] = np.nan
    sums, means, planes = window_sum(~np.isnan(z), n), window_mean(z, n), fit_planes(z, n, cell)
    for r in range(z.shape[0]):
        for c in range(z.shape[1]):
            part = z[max(r - n // 2, 0) : r + n // 2 + 1, max(c - n // 2, 0) : c + n // 2 + 1].astype(float)
            known = ~np.isnan(part)
            assert sums[r, c] == pytest.approx(known.sum())
            if known.any():
                assert means[r, c] == pytest.approx(part[known].mean(), abs=2.5e-7)  # float32 of about 2
            else:
                assert np.isnan(means[r, c])
            y, x = np.nonzero(known)
            design = np.column_stack([np.ones(len(x)), x * cell, y * cell])
            if np.linalg.matrix_rank(design) < 3:
                assert np.isnan(planes.slope[r, c])
                continue
            fit, *_ = np.linalg.lstsq(design, part[known], rcond=None)
            assert planes.slope[r, c] == pytest.approx(np.hypot(fit[1], fit[2]), abs=1e-9)
            rms = np.sqrt(np.mean((design @ fit - part[known]) ** 2))
            assert planes.residual[r, c] == pytest.approx(rms, abs=1e-6)  # the root of what rounding leaves of 1


@pytest.mark.parametrize("n", [1, 3, 9])
def test_sums_of_whole_numbers_are_exact(n: int) -> None:
    a = np.random.default_rng(n).integers(0, 9, (7, 12)).astype(float)
    half = n // 2
    expected = [
        [a[max(r - half, 0) : r + half + 1, max(c - half, 0) : c + half + 1].sum() for c in range(12)] for r in range(7)
    ]
    np.testing.assert_array_equal(window_sum(a, n), expected)


def test_plane_far_from_the_origin_keeps_its_slope() -> None:
    y, x = np.mgrid[:400, :300] * 0.001
    z = (100.0 + 0.25 * x - 0.1 * y).astype(np.float32)
    planes = fit_planes(z, 25, 0.001)
    # float32 at 100 m is spaced 7.6e-6 m; over a window of 24 mm that is a slope of at most 3e-4
    assert np.abs(planes.slope - np.hypot(0.25, 0.1)).max() < 3.2e-4
