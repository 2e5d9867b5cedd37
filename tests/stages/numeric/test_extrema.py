"""Running extrema over octagons against a look at every cell, and the octagon's shape."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.numeric.extrema import median3, octagon, relief, running_max


def offsets(reach: int) -> np.ndarray:
    """Cells of the octagon: |row|, |col| <= reach and |row| + |col| <= side + reach."""
    side, _ = octagon(reach)
    r, c = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.argwhere(np.abs(r) + np.abs(c) <= side + reach) - reach


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999), reach=st.integers(1, 16), share=st.floats(0.0, 1.0), rows=st.integers(1, 160))
def test_extrema_equal_a_look_at_every_cell(seed: int, reach: int, share: float, rows: int) -> None:
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(rows, 23)).astype(np.float32)
    z[rng.random(z.shape) < share] = np.nan
    padded = np.pad(z, reach, constant_values=np.nan)
    stack = np.stack([padded[reach + r : reach + r + rows, reach + c : reach + c + 23] for r, c in offsets(reach)])
    high, low = running_max(z, reach), -running_max(-z, reach)
    np.testing.assert_array_equal(high, np.where(np.isnan(stack), -np.inf, stack).max(axis=0))
    np.testing.assert_array_equal(low, np.where(np.isnan(stack), np.inf, stack).min(axis=0))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), near=st.integers(1, 9), more=st.integers(0, 12), rows=st.integers(1, 150))
def test_relief_of_two_octagons_equals_each_alone(seed: int, near: int, more: int, rows: int) -> None:
    """Also where the larger one is no widening of the smaller one."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(rows, 31)).astype(np.float32)
    z[rng.random(z.shape) < 0.4] = np.nan
    for found, reach in zip(relief(z, near, near + more), (near, near + more), strict=True):
        high, low = running_max(z, reach), -running_max(-z, reach)
        np.testing.assert_array_equal(found, np.where(high > low, high - low, np.float32(0)))
        np.testing.assert_array_equal(running_max(z, reach), high)


@pytest.mark.parametrize("reach", [7, 14, 15, 30, 31])
def test_the_octagon_reaches_as_far_in_every_direction_and_little_farther(reach: int) -> None:
    angle = np.linspace(0, 2 * math.pi, 361)
    support = (offsets(reach) @ np.array([np.sin(angle), np.cos(angle)])).max(axis=0)
    assert support.min() >= reach - 1e-9
    assert support.max() <= 1.12 * reach


def test_median_of_the_known_cells() -> None:
    rng = np.random.default_rng(3)
    z = rng.normal(size=(30, 40)).astype(np.float32)
    z[rng.random(z.shape) < 0.3] = np.nan
    padded = np.pad(z, 1, constant_values=np.nan)
    stack = np.stack([padded[r : r + 30, c : c + 40] for r in range(3) for c in range(3)])
    ordered, count = np.sort(stack, axis=0), (~np.isnan(stack)).sum(axis=0)
    upper = np.take_along_axis(ordered, np.minimum(count // 2, 8)[None], axis=0)[0]
    np.testing.assert_array_equal(median3(z), np.where(np.isnan(z), np.float32(np.nan), upper))
    # few rows or columns have no inside
    np.testing.assert_array_equal(median3(np.array([[1.0, 2.0, 5.0]], dtype=np.float32)), [[2.0, 2.0, 5.0]])
