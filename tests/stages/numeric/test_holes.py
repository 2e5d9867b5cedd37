"""Closing of small holes: exact on planes, bounded in width, never beyond the rim's heights."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_cdt

from rille.stages.numeric.holes import candidates, close_holes


def plane(rows: int, cols: int) -> np.ndarray:
    y, x = np.mgrid[:rows, :cols]
    return (0.25 * x - 0.5 * y).astype(np.float32)


@pytest.mark.parametrize(("width", "closed"), [(1, True), (3, True), (4, False)])
def test_a_square_hole_is_closed_up_to_the_width_given(width: int, closed: bool) -> None:
    z = plane(21, 21)
    truth = z.copy()
    z[8 : 8 + width, 8 : 8 + width] = np.nan
    out, std, filled = close_holes(z, np.full_like(z, 0.1), 3.0, 9, 0.5)
    if closed:
        # quarters are exact in binary; only the division rounds
        np.testing.assert_allclose(out, truth, atol=1e-6)
        assert filled.sum() == width**2
        np.testing.assert_array_equal(std[filled == 0], np.float32(0.1))
        assert (std[filled == 1] >= 0.1).all()  # or that of a height in the range of the rim, which slopes
    else:
        inside = np.zeros_like(filled)
        inside[8 : 8 + width, 8 : 8 + width] = 1
        # the corners' diagonals are shorter than the width; the middle is not to be reached
        assert filled[9:11, 9:11].sum() == 0
        assert not (filled & ~inside).any()


def test_a_long_crack_is_bridged_but_an_open_border_is_not() -> None:
    z = plane(20, 40)
    z[10, :] = np.nan
    z[:2, 5:9] = np.nan
    _, _, filled = close_holes(z, np.zeros_like(z), 3.0, 9, 0.5)
    assert filled[10, 1:-1].all()
    assert filled[:2, 6:8].sum() == 0  # four wide, and open towards the border


def test_sparse_cells_are_not_spun_into_ground() -> None:
    z = np.full((30, 30), np.nan, dtype=np.float32)
    z[::3, ::3] = 1.0
    _, _, filled = close_holes(z, np.zeros_like(z), 3.0, 9, 0.5)
    assert filled.sum() == 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 9999), share=st.floats(0.05, 0.6), gap=st.floats(0.0, 6.0))
def test_closing_is_bounded(seed: int, share: float, gap: float) -> None:
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(24, 31)).astype(np.float32)
    z[rng.random(z.shape) < share] = np.nan
    out, _, filled = close_holes(z, np.zeros_like(z), gap, 7, 0.5)
    known = ~np.isnan(z)
    np.testing.assert_array_equal(out[known], z[known])
    assert not (filled[known]).any()
    np.testing.assert_array_equal(np.isnan(out), ~known & (filled == 0))
    reach = distance_transform_cdt(~known, metric="chessboard")
    assert (reach[filled == 1] <= (gap + 1) / 2).all()
    if filled.any():
        assert np.nanmin(z) <= out[filled == 1].min()
        assert out[filled == 1].max() <= np.nanmax(z)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), half=st.integers(1, 6), share=st.floats(0.0, 1.0), rows=st.integers(1, 30))
def test_candidates_are_the_unknown_cells_whose_window_is_known_enough(
    seed: int, half: int, share: float, rows: int
) -> None:
    rng = np.random.default_rng(seed)
    z = np.zeros((rows, 17), dtype=np.float32)
    z[rng.random(z.shape) < share] = np.nan
    n, known = 2 * half + 1, ~np.isnan(z)
    padded = np.pad(known, half)
    count = sum(padded[r : r + rows, c : c + 17].astype(int) for r in range(n) for c in range(n))
    np.testing.assert_array_equal(candidates(z, n, 0.4), np.flatnonzero(~known & (count >= 0.4 * n * n)))
