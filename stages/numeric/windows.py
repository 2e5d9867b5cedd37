"""Sums, means and correlations over moving windows of a raster.

Windows are square, centred and of odd side ``n``; cells outside of the raster do not count.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32


def window_sum(a: NDArray, n: int) -> Floats:
    """Sum (row, col), float64, over the window; exact for integers."""
    total: Floats = _box(np.ascontiguousarray(a, dtype=np.float64), -1, n)
    return total


def window_sum32(a: NDArray, n: int) -> Floats32:
    """As :func:`window_sum`, but float32 before and after the sum, which takes half of the memory."""
    total: Floats32 = _box(np.ascontiguousarray(a, dtype=np.float32), -1, n)
    return total


def window_count(mask: Bools, n: int) -> NDArray[np.int32]:
    """Number (row, col) of set cells in the window."""
    total: NDArray[np.int32] = _box(mask.view(np.uint8), cv2.CV_32S, n)
    return total


def window_room(shape: tuple[int, int], n: int) -> NDArray[np.int32]:
    """Number (row, col) of cells of the raster in the window."""
    middle = [np.arange(size, dtype=np.int32) for size in shape]
    rows, cols = (np.minimum(a, n // 2) + np.minimum(a[::-1], n // 2) + 1 for a in middle)
    room: NDArray[np.int32] = np.multiply.outer(rows, cols)
    return room


def _box(values: NDArray, depth: int, n: int) -> Any:
    return cv2.boxFilter(values, depth, (n, n), normalize=False, borderType=cv2.BORDER_CONSTANT)


def window_mean(a: Floats32, n: int) -> Floats32:
    """Mean (row, col) of the known cells in the window; NaN where there is none."""
    known = ~np.isnan(a)
    # Subtracted before summing, for smaller rounding errors.
    middle = a[known].mean(dtype=np.float64) if known.any() else 0.0
    total, count = window_sum(np.where(known, a - middle, 0.0), n), window_sum(known, n)
    mean = np.full(a.shape, np.nan, dtype=np.float32)
    np.divide(total, count, out=total, where=count > 0)
    np.add(total, middle, out=mean, where=count > 0, casting="same_kind")
    return mean


def window_correlation(a: Floats32, b: Floats, n: int) -> Floats:
    """Correlation (row, col) of two images 0..255 in the window; NaN where an image is not known or is uniform."""
    both = np.where(np.isnan(b), np.nan, 1.0)
    # Less a level near the middle, for smaller rounding errors.
    x, y = ((image - 128.0) * both for image in (a, b))
    mean_a, mean_b, ab, aa, bb = (window_mean(m.astype(np.float32), n) for m in (x, y, x * y, x * x, y * y))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((ab - mean_a * mean_b) / np.sqrt((aa - mean_a**2) * (bb - mean_b**2)), np.float64)
