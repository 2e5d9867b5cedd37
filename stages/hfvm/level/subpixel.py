"""Sub-pixel displacements (paper, 4.3.2) from distances summed around the winner, and their local mean.

One pixel's distances err by .29 px (median, true disparities known), those summed over 5 x 5 by .14 px, with the mean
of consistent neighbours .13 px.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.hfvm.level import simd
from rille.stages.hfvm.level.features import distance
from rille.stages.hfvm.level.simd import SUM_RADIUS

NOTHING, ALONE, SUMMED = 0, 1, 2
"""What a pixel has: no distance, its own, those of its window."""


@njit(cache=True, nogil=True)
def linear(before, at, after):  # type: ignore[no-untyped-def]
    """Where two lines of equal and opposite slope through three distances meet, within half a pixel."""
    steep = np.float32(max(before, after) - at)
    # Neither side costs more: after propagation and median the middle need not be the least.
    if steep <= 0:
        return np.float32(0.0)
    d = np.float32(before - after) / steep * np.float32(0.5)
    # Where one side costs less than the middle the lines meet more than half a pixel away.
    return min(max(d, np.float32(-0.5)), np.float32(0.5))


@njit(cache=True, nogil=True)
def summed(images, maps, wanted, out, at=(0, 0)):  # type: ignore[no-untyped-def]
    """Sub-pixel displacements of an integer map from distances summed over 5 x 5 pixels.

    ``images``: words of the left and the right one, (row, col). ``maps``: column and row displacements of the left
    one's pixels; ``out``: where the refined ones, and the distance, are written. Only where ``wanted`` is not zero and
    the window, shifted by a pixel, lies inside both images; elsewhere the integer map is copied. The distance is the
    mean of a pixel's at the integer displacement, or the pixel's own where the window is not inside; -1 outside the
    other image and where not wanted. ``at``: column and row of the left window's first pixel in the right window; both
    windows must reach SUM_RADIUS (right: and one) pixels farther than what counts.
    """
    (left, right), (u_map, v_map), (out_u, out_v, out_distance) = images, maps, out
    rows, cols = left.shape
    shapes = rows, cols, right.shape[0], right.shape[1]
    flat = left.reshape(-1), right.reshape(-1)
    # Four sums are written however short a run is, so the last column needs room beyond it.
    four, last, state = np.zeros(cols + 4, np.uint64), np.zeros(cols + 4, np.uint64), np.zeros(cols, np.int8)
    count = np.float32((2 * SUM_RADIUS + 1) * (2 * SUM_RADIUS + 1))
    for y in range(rows):
        _windows(flat, y, (u_map[y], v_map[y]), wanted[y], shapes, at, (four, last, state))
        us, vs, first, second, third = u_map[y], v_map[y], out_u[y], out_v[y], out_distance[y]
        # Sixteen bits hold a sum: 25 distances of at most 8 x 255.
        low = np.uint64(0xFFFF)
        for x in range(cols):
            middle = np.int64(four[x] & low)
            west, east = np.int64((four[x] >> np.uint64(16)) & low), np.int64((four[x] >> np.uint64(32)) & low)
            north, south = np.int64(four[x] >> np.uint64(48)), np.int64(last[x])
            summed_up = state[x] == SUMMED
            first[x] = np.float32(us[x]) + (linear(west, middle, east) if summed_up else np.float32(0.0))
            second[x] = np.float32(vs[x]) + (linear(north, middle, south) if summed_up else np.float32(0.0))
            third[x] = (
                np.float32(middle) / count
                if summed_up
                else np.float32(middle)
                if state[x] == ALONE
                else np.float32(-1.0)
            )


@njit(cache=True, nogil=True)
def _windows(flat, y, row, wanted, shapes, at, out):  # type: ignore[no-untyped-def]
    """Sums of the windows of a row: ``out`` are ``four, last`` of ``simd.sums``, and what they are worth, ``state``.

    Neighbours of equal displacement are summed together. A pixel's own distance stands where its window is not inside.
    """
    (here, there), (us, vs), (four, last, state), (ox, oy) = flat, row, out, at
    rows, cols, rrows, rcols = shapes
    far = SUM_RADIUS + 1
    x = 0
    while x < cols:
        u, v = np.int64(us[x]), np.int64(vs[x])
        xr, yr = x + ox + u, y + oy + v
        state[x] = NOTHING
        if not wanted[x] or xr < 0 or xr >= rcols or yr < 0 or yr >= rrows:
            x += 1
            continue
        inside = min(x, y, rows - 1 - y) >= SUM_RADIUS and min(xr, yr, rrows - 1 - yr) >= far
        most = min(simd.SIDE_BY_SIDE, cols - SUM_RADIUS - x, rcols - far - xr) if inside else 0
        if most <= 0:
            state[x], four[x] = ALONE, distance(here[y * cols + x], there[yr * rcols + xr])
            x += 1
            continue
        n = 1
        while n < most and us[x + n] == u and vs[x + n] == v and wanted[x + n]:
            n += 1
        simd.sums(flat, (y * cols + x, yr * rcols + xr), (cols, rcols), n, (four, last), x)
        state[x : x + n] = SUMMED
        x += n
