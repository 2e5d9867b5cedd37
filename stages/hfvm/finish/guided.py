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
    table = np.rint(SCALE * apart[:, None] * steps[None, :]).astype(np.int64) + 1
    out_u, out_v = u.copy(), v.copy()
    _median((u, v), keep.astype(np.uint8), filled.astype(np.uint8), grey, table, (out_u, out_v))
    return out_u, out_v


@njit(cache=True, nogil=True)
def _median(given, keep, filled, grey, table, out):  # type: ignore[no-untyped-def]
    """The column displacement decides; the row displacement is that of the same neighbour."""
    (u, v), (out_u, out_v), measured = given, out, np.int64(MEASURED)
    rows, cols = u.shape
    most = (2 * RADIUS + 1) ** 2
    value, other, weight = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.int64)
    for y in range(rows):
        for x in range(cols):
            if not filled[y, x]:
                continue
            n, total = 0, np.int64(0)
            for j in range(max(0, y - RADIUS), min(rows, y + RADIUS + 1)):
                for i in range(max(0, x - RADIUS), min(cols, x + RADIUS + 1)):
                    if not (keep[j, i] or filled[j, i]):
                        continue
                    step = min(int(abs(grey[j, i] - grey[y, x])), 255)
                    weight[n] = table[abs(j - y) + abs(i - x), step] * (measured if keep[j, i] else 1)
                    value[n], other[n] = u[j, i], v[j, i]
                    total += weight[n]
                    n += 1
            order = np.argsort(value[:n], kind="mergesort")
            passed = np.int64(0)
            for k in order:
                passed += weight[k]
                if 2 * passed >= total:
                    out_u[y, x], out_v[y, x] = value[k], other[k]
                    break
