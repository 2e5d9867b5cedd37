"""Cubic splines through the pixels of an image: coefficients, and their weights at a point between pixels.

The value at a point is the sum of 4 x 4 coefficients, times a weight along the row and one along the column. Unlike a
local cubic kernel, a spline keeps detail of few pixels. Unser (1999), doi:10.1109/79.799930.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Floats32
from rille.stages.core.kernel import kernel

TAPS_RADIUS_PX = 10
"""Pixels to either side that a coefficient depends on; the cut changes about a thousandth of a grey level."""

POLE = math.sqrt(3.0) - 2.0
TAPS = np.float32(math.sqrt(3.0) * POLE ** np.abs(np.arange(-TAPS_RADIUS_PX, TAPS_RADIUS_PX + 1)))
"""The inverse of the filter 1/6, 4/6, 1/6."""


def coefficients(image: ArrayLike) -> Floats32:
    """Coefficients (row, col) float32 of the cubic spline through the pixels of an image (row, col).

    The image is mirrored at its borders. Coefficients of a window equal the image's, :data:`TAPS_RADIUS_PX` pixels or
    more from the cut.
    """
    grey = np.asarray(image, np.float32)
    return np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, TAPS, TAPS, borderType=cv2.BORDER_REFLECT_101))


@kernel
def weights(t):  # type: ignore[no-untyped-def]
    """Weights of the coefficients at -1, 0, 1, 2 for a point at ``t``, 0..1; float32."""
    q, four, three, two, sixth = np.float32(1) - t, np.float32(4), np.float32(3), np.float32(2), np.float32(1 / 6)
    second, third = four - three * t * t * (two - t), four - three * q * q * (two - q)
    return q * q * q * sixth, second * sixth, third * sixth, t * t * t * sixth


@kernel
def slopes(t):  # type: ignore[no-untyped-def]
    """Derivatives of :func:`weights`."""
    q, half, three, four = np.float32(1) - t, np.float32(0.5), np.float32(3), np.float32(4)
    return -half * q * q, half * t * (three * t - four), -half * q * (three * q - four), half * t * t


@kernel
def value_and_gradient(spline, x, y):  # type: ignore[no-untyped-def]
    """Value of a spline, by its coefficients (row, col), at a point, and its derivatives along x and y; float32.

    The point lies at 1 <= x < cols - 2, and y alike: a spline reads from one pixel before to two after it.
    """
    i, j = np.uint32(x), np.uint32(y)
    t, s = x - np.float32(i), y - np.float32(j)
    wx, wy, dx, dy = weights(t), weights(s), slopes(t), slopes(s)
    value = along_x = along_y = np.float32(0.0)
    for k in range(4):
        row = spline[j + k - 1]
        a, b, c, d = row[i - 1], row[i], row[i + 1], row[i + 2]
        across = wx[0] * a + wx[1] * b + wx[2] * c + wx[3] * d
        along = dx[0] * a + dx[1] * b + dx[2] * c + dx[3] * d
        value += wy[k] * across
        along_x += wy[k] * along
        along_y += dy[k] * across
    return value, along_x, along_y
