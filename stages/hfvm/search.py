"""Exhaustive search of the top level; the levels below are searched by ``propagation``."""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.features import distance

FAR = 1 << 40
"""Cost above every cost."""


@njit(cache=True, nogil=True)
def exhaustive(left, right, reach_x, reach_y, radius, out_u, out_v):  # type: ignore[no-untyped-def]
    """Null prediction and large search area (4.3.4), for the top level: least distance summed over a window."""
    rows, cols = left.shape
    rrows, rcols = right.shape
    for y in range(rows):
        for x in range(cols):
            best = np.int64(FAR)
            bu, bv = 0, 0
            for v in range(max(-reach_y, -y), min(reach_y, rrows - 1 - y) + 1):
                for u in range(max(-reach_x, -x), min(reach_x, rcols - 1 - x) + 1):
                    total, n = np.int64(0), 0
                    for j in range(max(-radius, -y, -y - v), min(radius, rows - 1 - y, rrows - 1 - y - v) + 1):
                        for i in range(max(-radius, -x, -x - u), min(radius, cols - 1 - x, rcols - 1 - x - u) + 1):
                            total += distance(left[y + j, x + i], right[y + j + v, x + i + u])
                            n += 1
                    # Mean over the pixels that both see; of equal ones the shorter displacement wins.
                    cost = (total * 16 // n) * 4096 + abs(u) + abs(v)
                    if cost < best:
                        best = cost
                        bu, bv = u, v
            out_u[y, x] = bu
            out_v[y, x] = bv
