"""Exhaustive search of the top level; the levels below are searched by ``propagation``."""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.features import distance
from stages.hfvm.lanes import FAR

NONE = 1 << 40
"""Cost above every cost."""


@njit(cache=True, nogil=True)
def exhaustive(left, right, reach_x, reach_y, radius, out_u, out_v, out_cost):  # type: ignore[no-untyped-def]
    """Null prediction and large search area (4.3.4), for the top level: least distance summed over a window.

    Mean over the window's pixels that both images show; of equal ones the shorter displacement wins. ``out_cost``:
    the distance of each pixel alone, which is what ``propagation`` counts with.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    best = np.full((rows, cols), NONE)
    out_u[:], out_v[:] = 0, 0
    single, across = np.zeros((rows, cols + 2 * radius), np.int64), np.zeros((rows, cols), np.int64)
    for v in range(-reach_y, reach_y + 1):
        top, bottom = max(0, -v), min(rows, rrows - v)
        for u in range(-reach_x, reach_x + 1):
            first, last = max(0, -u), min(cols, rcols - u)
            if top >= bottom or first >= last:
                continue
            single[top:bottom] = 0
            for y in range(top, bottom):
                for x in range(first, last):
                    single[y, x + radius] = distance(left[y, x], right[y + v, x + u])
                across[y] = single[y, :cols]
                for i in range(1, 2 * radius + 1):
                    across[y] += single[y, i : i + cols]
            for y in range(top, bottom):
                a, b = max(top, y - radius), min(bottom, y + radius + 1)
                for x in range(first, last):
                    total = np.int64(0)
                    for j in range(a, b):
                        total += across[j, x]
                    n = (b - a) * (min(last, x + radius + 1) - max(first, x - radius))
                    cost = (total * 16 // n) * 4096 + abs(u) + abs(v)
                    if cost < best[y, x]:
                        best[y, x] = cost
                        out_u[y, x], out_v[y, x] = u, v
    for y in range(rows):
        for x in range(cols):
            out_cost[y, x] = distance(left[y, x], right[y + out_v[y, x], x + out_u[y, x]]) if best[y, x] < NONE else FAR
