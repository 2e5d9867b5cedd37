"""Disparities of half the resolution at the full one."""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.validity import Validity
from rille.stages.hfvm.images import plane

MATCHED, OUT_OF_IMAGE = np.uint8(Validity.MATCHED), np.uint8(Validity.OUT_OF_IMAGE)
FOUND = np.uint8(Validity.MATCHED | Validity.INTERPOLATED)


@njit(cache=True, nogil=True)
def enlarge(maps, valid, right_shape, alignment, out, x0=0, y0=0):  # type: ignore[no-untyped-def]
    """Displacements of the next finer level: each doubled, for 2 x 2 pixels.

    ``maps`` and ``out``: column and row displacements, validity, error of matching back, distance; each (row, col).
    Both images' pixel centres shift alike, so nothing is to be added; but where the right image was aligned, the four
    pixels are moved as the plane moves them. ``alignment``: its homography (1, 3, 3) at this level, nothing (0, 3, 3)
    without one, and the inverse. A masked pixel (``valid`` 0) is undefined, and
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
            if len(alignment[0]):
                a, b = _beside(alignment[0][0], alignment[1][0], (x + x0, y + y0), (a, b))
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


@njit(cache=True, nogil=True)
def _beside(h, back, pixel, displacement):  # type: ignore[no-untyped-def]
    """Displacement of a pixel beside the middle of its square of 2 x 2, whose ``displacement`` is given."""
    (x, y), (u, v) = pixel, displacement
    middle_x, middle_y = (x & ~1) + 0.5, (y & ~1) + 0.5
    p, q, w = plane.mapped(back, middle_x + u, middle_y + v)
    # Beyond the horizon there is no place.
    w = w if w > 0.0 else np.nan
    p, q, w = plane.mapped(h, p / w + (x - middle_x), q / w + (y - middle_y))
    w = w if w > 0.0 else np.nan
    return np.float32(p / w - x), np.float32(q / w - y)
