"""Edge-keeping median of interpolated displacements (preset ``accurate``).

Filling along rows is blind to its own image: streaks cross the outlines of things. Every interpolated pixel takes the
median of its neighbourhood, each neighbour weighing the more the nearer and the more alike in grey it is. Matches stay.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray

RADIUS = 7
"""Pixels: reach of the median; beyond it a neighbour says little."""

GREY = 8.0
"""Grey levels of difference at which a neighbour's weight has fallen to 1/e."""

MEASURED = 2.0
"""Weight of a measured neighbour against an interpolated one."""

STRIDE = 2
"""Pixels between the neighbours that are asked: of 15 x 15 every fourth one, since neighbours hardly differ."""

STEP = 0.0625
"""Pixels: displacements nearer to each other than this count as equal."""

SCALE = 4096.0
"""Weights are integers in this unit, so that sums do not depend on their order."""


def median(u: AnyArray, v: AnyArray, keep: AnyArray, filled: AnyArray, grey: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Displacements whose interpolated pixels are replaced by a weighted median.

    Parameters
    ----------
    u, v : (row, col) float32 displacements, pixels.
    keep, filled : (row, col), not zero where measured, and where interpolated.
    grey : (row, col) float32 grey levels of the left image.
    """
    steps = np.exp(-np.arange(256) / GREY)
    apart = np.exp(-np.arange(2 * RADIUS + 1) / RADIUS)
    # One more, so that no weight is zero: of weights without a sum the least value would win.
    table = np.rint(SCALE * apart[:, None] * steps[None, :]).astype(np.int32) + 1
    out_u, out_v = u.copy(), v.copy()
    _median((u, v), keep.astype(np.uint8), filled.astype(np.uint8), grey, table, (out_u, out_v))
    return out_u, out_v


@njit(cache=True, nogil=True)
def _median(given, keep, filled, grey, table, out):  # type: ignore[no-untyped-def]
    """The column displacement decides; the row displacement is that of the same neighbour.

    The median is the least value that at least half of the weight does not exceed. It is found by halving the range of
    the values, counted in :data:`STEP`: sorting them takes several times as long.
    """
    (u, v), (out_u, out_v), measured = given, out, np.int32(MEASURED)
    rows, cols = u.shape
    most = (2 * RADIUS // STRIDE + 1) ** 2
    value, weight, place = np.empty(most, np.int32), np.empty(most, np.int32), np.empty((most, 2), np.int32)
    per_pixel = np.float32(1.0 / STEP)
    for y in range(rows):
        for x in range(cols):
            if not filled[y, x]:
                continue
            n = 0
            # Odd steps from the pixel: neither itself nor its row, along which streaks run, is asked.
            for j in range(y - RADIUS, y + RADIUS + 1, STRIDE):
                for i in range(x - RADIUS, x + RADIUS + 1, STRIDE):
                    if 0 <= j < rows and 0 <= i < cols and keep[j, i] | filled[j, i]:
                        step = min(np.int64(abs(grey[j, i] - grey[y, x])), 255)
                        weight[n] = table[abs(j - y) + abs(i - x), step] * (measured if keep[j, i] else np.int32(1))
                        value[n] = np.int32(np.rint(u[j, i] * per_pixel))
                        place[n, 0], place[n, 1] = j, i
                        n += 1
            found = _weighted_median(value[:n], weight[:n])
            for k in range(n):
                if value[k] == found:
                    out_u[y, x], out_v[y, x] = u[place[k, 0], place[k, 1]], v[place[k, 0], place[k, 1]]
                    break


@njit(cache=True, nogil=True)
def _weighted_median(value, weight):  # type: ignore[no-untyped-def]
    """The least of the values (int32) below or at which at least half of the weight (int32) lies."""
    low, high, total = value[0], value[0], np.int64(0)
    for k in range(len(value)):
        low, high = min(low, value[k]), max(high, value[k])
        total += weight[k]
    while low < high:
        middle = low + (high - low) // 2
        below = np.int64(0)
        for k in range(len(value)):
            below += weight[k] if value[k] <= middle else np.int32(0)
        if 2 * below >= total:
            high = middle
        else:
            low = middle + 1
    return low
