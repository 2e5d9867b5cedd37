"""Cubic interpolation of images."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def sample_cubic(a, x, y):  # type: ignore[no-untyped-def]
    """Catmull-Rom value and gradient of ``a`` at (x, y), two pixels or more inside."""
    i, j = int(x), int(y)
    t, s = x - np.float32(i), y - np.float32(j)
    h, two, three = np.float32(0.5), np.float32(2.0), np.float32(3.0)
    one, four, five = np.float32(1.0), np.float32(4.0), np.float32(5.0)
    wx = (
        h * t * (two * t - one - t * t),
        h * (two + t * t * (three * t - five)),
        h * t * (one + four * t - three * t * t),
        h * t * t * (t - one),
    )
    wy = (
        h * s * (two * s - one - s * s),
        h * (two + s * s * (three * s - five)),
        h * s * (one + four * s - three * s * s),
        h * s * s * (s - one),
    )
    gx = (
        h * (four * t - one - three * t * t),
        h * t * (np.float32(9.0) * t - np.float32(10.0)),
        h * (one + np.float32(8.0) * t - np.float32(9.0) * t * t),
        h * t * (three * t - two),
    )
    gy = (
        h * (four * s - one - three * s * s),
        h * s * (np.float32(9.0) * s - np.float32(10.0)),
        h * (one + np.float32(8.0) * s - np.float32(9.0) * s * s),
        h * s * (three * s - two),
    )
    value = dx = dy = np.float32(0.0)
    for k in range(4):
        r0, r1, r2, r3 = a[j - 1 + k, i - 1], a[j - 1 + k, i], a[j - 1 + k, i + 1], a[j - 1 + k, i + 2]
        row = r0 * wx[0] + r1 * wx[1] + r2 * wx[2] + r3 * wx[3]
        value += wy[k] * row
        dy += gy[k] * row
        dx += wy[k] * (r0 * gx[0] + r1 * gx[1] + r2 * gx[2] + r3 * gx[3])
    return value, dx, dy
