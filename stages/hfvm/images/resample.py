"""Cubic interpolation of images."""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.validity import Validity

MATCHED, OUT_OF_IMAGE = np.uint8(Validity.MATCHED), np.uint8(Validity.OUT_OF_IMAGE)
FOUND = np.uint8(Validity.MATCHED | Validity.INTERPOLATED)


@njit(cache=True, nogil=True)
def sample_cubic(a, x, y, x0=0, y0=0):  # type: ignore[no-untyped-def]
    """Catmull-Rom value and gradient at (x, y), two pixels or more inside, of an image that ``a`` shows from x0, y0."""
    i, j = int(x), int(y)
    t, s = x - np.float32(i), y - np.float32(j)
    # After the fractions have been taken: in float32 they must not depend on where the window begins.
    i, j = i - x0, j - y0
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


@njit(cache=True, nogil=True)
def enlarge(maps, valid, right_shape, out, x0=0, y0=0):  # type: ignore[no-untyped-def]
    """Displacements of the next finer level: each doubled, for 2 x 2 pixels.

    ``maps`` and ``out``: column and row displacements, validity, error of matching back, distance; each (row, col).
    Both images' pixel centres shift alike, so nothing is to be added. A masked pixel (``valid`` 0) is undefined, and
    so is one whose displacement then leaves the right image; both are marked. ``x0, y0``: first column and row of a
    window (even).
    """
    u, v, bits, error, distance = maps
    out_u, out_v, out_bits, out_error, out_distance = out
    two, nan = np.float32(2.0), np.float32(np.nan)
    for y in range(out_u.shape[0]):
        for x in range(out_u.shape[1]):
            j, i = y >> 1, x >> 1
            a, b, bit = two * u[j, i], two * v[j, i], bits[j, i]
            xr, yr = x + x0 + a, y + y0 + b
            # A negated comparison, so that NaN is outside.
            outside = not (xr >= 0 and xr <= right_shape[1] - 1 and yr >= 0 and yr <= right_shape[0] - 1)
            if not valid[y, x] or (outside and bit & MATCHED):
                bit = (bit & ~FOUND) | OUT_OF_IMAGE
            if not bit & FOUND:
                a = b = nan
            out_u[y, x], out_v[y, x], out_bits[y, x] = a, b, bit
            # An error in pixels doubles with them, a feature distance does not.
            out_error[y, x], out_distance[y, x] = two * error[j, i], distance[j, i]
