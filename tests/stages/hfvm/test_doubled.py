"""From half the resolution to the whole one: displacements, their slopes and their standard deviations."""

from __future__ import annotations

import numpy as np

from rille.stages.core.validity import Validity
from rille.stages.hfvm.matcher import doubled


def small(column: np.ndarray) -> dict[str, np.ndarray]:
    alike = np.ones_like(column)
    return {
        "column_disparity": column,
        "row_disparity": 0 * alike,
        "backmatch_error": 0.3 * alike,
        "distance": 7 * alike,
        "disparity_std": 0.2 * alike,
        "validity": np.full(column.shape, Validity.MATCHED, np.uint8),
    }


def test_pixels_are_twice_as_many_and_half_as_wide() -> None:
    slope, jump = np.float32(0.25), np.float32(-6.0)
    column = np.tile(slope * np.arange(16, dtype=np.float32), (6, 1))
    column[:, 8:] += jump
    big = doubled(small(column), np.ones((12, 32), np.uint8), (12, 200), (100, 0))
    # A pixel of the whole image lies a quarter of a small one beside the middle of its own.
    at = (np.arange(32) - 0.5) / 2
    expected = 2 * (slope * at + np.where(at < 7.5, 0, jump))
    inside = np.r_[2:14, 18:30]  # but beside the jump and the border, where slopes differ
    np.testing.assert_allclose(big["column_disparity"][:, inside], np.tile(expected[inside], (12, 1)), atol=1e-5)
    # There none is followed: all four pixels have twice the displacement of theirs.
    np.testing.assert_allclose(big["column_disparity"][5, 14:18], 2 * np.repeat(column[2, 7:9], 2), atol=1e-5)
    np.testing.assert_allclose(big["disparity_std"], 0.4, rtol=1e-6)
    np.testing.assert_allclose(big["backmatch_error"], 0.6, rtol=1e-6)
    assert (big["distance"] == 7).all()


def test_what_leaves_the_right_image_or_is_masked_is_undefined() -> None:
    column, valid = np.full((6, 16), -4.0, np.float32), np.ones((12, 32), np.uint8)
    valid[3, 20] = 0
    big = doubled(small(column), valid, (12, 32), (0, 0))
    gone = (np.arange(32) < 8)[None, :] | (valid == 0)
    assert (np.isnan(big["column_disparity"]) == gone).all()
    assert (np.isnan(big["disparity_std"]) == gone).all()
    assert ((big["validity"] & Validity.MATCHED == 0) == gone).all()
