"""Cubic interpolation of grey values."""

from __future__ import annotations

import numpy as np

from rille.stages.core.kernel import inlined


@inlined
def cubic(a, x, y):  # type: ignore[no-untyped-def]
    """Catmull-Rom value (float32) of an image ``a`` at (x, y), a pixel or more inside."""
    whole_x, whole_y = np.int64(x), np.int64(y)
    # Unsigned indices need no check for negative ones.
    i, j, step = np.uint64(whole_x), np.uint64(whole_y), np.uint64(1)
    t, s = np.float32(x) - np.float32(whole_x), np.float32(y) - np.float32(whole_y)
    left, right, far = i - step, i + step, i + step + step
    above, below, bottom = j - step, j + step, j + step + step
    # Constants of type float32: with Python's floats numba would compute in float64.
    h, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    three, four, five = np.float32(3.0), np.float32(4.0), np.float32(5.0)
    w0, w3 = h * t * (two * t - one - t * t), h * t * t * (t - one)
    w1, w2 = h * (two + t * t * (three * t - five)), h * t * (one + four * t - three * t * t)
    v0, v3 = h * s * (two * s - one - s * s), h * s * s * (s - one)
    v1, v2 = h * (two + s * s * (three * s - five)), h * s * (one + four * s - three * s * s)
    value = np.float32(0.0)
    value += v0 * (a[above, left] * w0 + a[above, i] * w1 + a[above, right] * w2 + a[above, far] * w3)
    value += v1 * (a[j, left] * w0 + a[j, i] * w1 + a[j, right] * w2 + a[j, far] * w3)
    value += v2 * (a[below, left] * w0 + a[below, i] * w1 + a[below, right] * w2 + a[below, far] * w3)
    value += v3 * (a[bottom, left] * w0 + a[bottom, i] * w1 + a[bottom, right] * w2 + a[bottom, far] * w3)
    return value
