"""Exhaustive search of the top level; the levels below are searched by ``propagation``."""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.hfvm.level.features import distance
from rille.stages.hfvm.native.problem import FAR

NONE = np.iinfo(np.int32).max
"""Cost above every cost."""


@njit(cache=True, nogil=True)
def _keep_least(total, tall, columns, radius, tried, best, out):  # type: ignore[no-untyped-def]
    """Take what is ``tried`` where the mean of ``total``, in sixteenths, then its length, is less than ``best``."""
    (first, last), (u, v), (out_u, out_v) = columns, tried, out
    length = np.int32(abs(u) + abs(v))
    for x in range(first, last):
        inner = first + radius <= x < last - radius
        wide = 2 * radius + 1 if inner else min(last, x + radius + 1) - max(first, x - radius)
        # Mean and length in one number, so that one comparison decides both: 2040 x 16 x 4096 is below 2^31.
        cost = np.int32(np.float64(total[x]) * 16.0 / np.float64(tall * wide)) * np.int32(4096) + length
        # Strictly less: of equal ones the first displacement in row, column order stays.
        if cost < best[x]:
            best[x], out_u[x], out_v[x] = cost, u, v


@njit(cache=True, nogil=True)
def exhaustive(images, reach, radius, out):  # type: ignore[no-untyped-def]
    """Null prediction and large search area (4.3.4), for the top level: least distance summed over a window.

    ``images``: words of the left and the right one, (row, col); ``reach``: columns and rows to either side. Mean over
    the window's pixels that both images show; of equal ones the shorter displacement wins. ``out``: column and row
    displacement, and the distance of each pixel alone, which is what ``propagation`` counts with.
    """
    (left, right), (reach_x, reach_y), (out_u, out_v, out_cost) = images, reach, out
    rows, cols = left.shape
    rrows, rcols = right.shape
    side = 2 * radius + 1
    best = np.full((rows, cols), NONE, np.int32)
    out_u[:], out_v[:] = 0, 0
    single = np.zeros((rows + 2 * radius, cols + 2 * radius), np.int32)
    total = np.zeros(cols, np.int32)
    for v in range(-reach_y, reach_y + 1):
        top, bottom = max(0, -v), min(rows, rrows - v)
        for u in range(-reach_x, reach_x + 1):
            first, last = max(0, -u), min(cols, rcols - u)
            if top >= bottom or first >= last:
                continue
            # A frame of nothing stands for pixels that not both images show.
            single[top : top + radius] = 0
            for y in range(top, bottom):
                row, words, others = single[y + radius], left[y], right[y + v]
                row[:] = 0
                for x in range(first, last):
                    row[x + radius] = distance(words[x], others[x + u])
            single[bottom + radius : bottom + 2 * radius] = 0
            for y in range(top, bottom):
                total[:] = 0
                for j in range(y, y + side):
                    for i in range(side):
                        part = single[j, i : i + cols]
                        for x in range(cols):
                            total[x] += part[x]
                tall = min(bottom, y + radius + 1) - max(top, y - radius)
                _keep_least(total, tall, (first, last), radius, (u, v), best[y], (out_u[y], out_v[y]))
    for y in range(rows):
        for x in range(cols):
            out_cost[y, x] = distance(left[y, x], right[y + out_v[y, x], x + out_u[y, x]]) if best[y, x] < NONE else FAR
