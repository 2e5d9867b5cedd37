"""Sums and means over moving windows of a raster.

Windows are square, centred and of odd side ``n``; outside of the raster there is nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32


def window_sum(a: NDArray, n: int) -> Floats:
    """Sum (row, col), float64, over the window; whole numbers add up exactly."""
    values = np.ascontiguousarray(a, dtype=np.float64)
    total: Floats = cv2.boxFilter(values, -1, (n, n), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return total


def window_mean(a: Floats32, n: int) -> Floats32:
    """Mean (row, col) of the known cells in the window; NaN where there is none."""
    known = ~np.isnan(a)
    middle = a[known].mean(dtype=np.float64) if known.any() else 0.0  # sums of what is left round less
    total, count = window_sum(np.where(known, a - middle, 0.0), n), window_sum(known, n)
    mean = np.full(a.shape, np.nan, dtype=np.float32)
    np.divide(total, count, out=total, where=count > 0)
    np.add(total, middle, out=mean, where=count > 0, casting="same_kind")
    return mean
