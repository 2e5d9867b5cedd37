"""Search of one level: several centres, a soft epipolar band, propagation with weak smoothness.

A map is one array of packed displacements, v << 16 | u (int32), beside the cost of each without smoothness. All costs
are integers, candidates come in a fixed order and only a strictly lower cost wins, so that results do not depend on
the machine. Eight candidates are looked at together (``lanes``).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.hfvm import lanes
from stages.hfvm.lanes import LANES

PULLS = 3.0
"""Byte steps a pixel: a softer band's lines are too uncertain to move a centre towards them."""


@njit(cache=True, nogil=True, inline="always")
def pack(u, v):  # type: ignore[no-untyped-def]
    """One 32-bit word of two 16-bit displacements."""
    return np.int32((v << 16) | (u & 0xFFFF))


@njit(cache=True, nogil=True, inline="always")
def columns(packed):  # type: ignore[no-untyped-def]
    """Column displacement."""
    return np.int64(np.int16(packed))


@njit(cache=True, nogil=True, inline="always")
def rows_of(packed):  # type: ignore[no-untyped-def]
    """Row displacement."""
    return np.int64(packed) >> 16


@njit(cache=True, nogil=True)
def descend(left, right, up_u, up_v, reach_x, reach_y, count, lines, mu, packed, data, ox=0, oy=0):  # type: ignore[no-untyped-def]
    """Search around the doubled displacements of the coarse parent and of its nearest neighbours.

    ``reach_x, reach_y``: search to either side (rows: of the parent's alone); ``count``: centres, see ``lanes.seek``;
    ``lines`` (3, row, col) float32: epipolar line of each pixel (:func:`stages.hfvm.epipolar.write_lines`), zeros
    without a band; ``mu``: cost per pixel off it. Where the band is sharp each centre is first moved towards its line,
    by a pixel at most: a coarse fit may be wrong by more than that. ``packed, data`` (row, col) int32 get the
    displacements and their costs.
    With nothing inside the other image the prediction stays: it leads out of it. ``ox, oy``: where the left window's
    first pixel lies in the right window; a window starts at even rows and columns. Reach: a coarse pixel.
    """
    rows, cols = left.shape
    crows, ccols = up_u.shape
    wide = ccols + 2
    centres = np.empty((crows + 2, wide), np.int32)
    _centres(up_u, up_v, lines, mu, centres)
    here, there, flat, normals = left.reshape(-1), right.reshape(-1), centres.reshape(-1), lines.reshape(-1)
    out, cost = packed.reshape(-1), data.reshape(-1)
    shape = (right.shape[0], right.shape[1], cols, rows * cols, ox)
    reach = (reach_x, reach_y, count)
    for y in range(rows):
        parents = ((y >> 1) + 1) * wide
        beside = parents + wide * (2 * (y & 1) - 1)
        for x in range(0, cols, LANES):
            lanes.seek(here, there, flat, normals, x, y + oy, y * cols, parents, beside, shape, reach, mu, out, cost)


@njit(cache=True, nogil=True)
def _centres(up_u, up_v, lines, mu, centres):  # type: ignore[no-untyped-def]
    """Doubled displacements, each moved towards its epipolar line by a pixel at most; a border repeats the edge."""
    crows, ccols = up_u.shape
    one = np.float32(1.0)
    for j in range(crows):
        normal = lines[:, 2 * j]
        for i in range(ccols):
            pu, pv = 2 * np.int64(up_u[j, i]), 2 * np.int64(up_v[j, i])
            if mu >= PULLS:
                a, b = normal[0, 2 * i], normal[1, 2 * i]
                e = min(max(a * np.float32(pu) + b * np.float32(pv) + normal[2, 2 * i], -one), one)
                pu -= np.int64(np.rint(e * a))
                pv -= np.int64(np.rint(e * b))
            centres[j + 1, i + 1] = pack(pu, pv)
    centres[1 : crows + 1, 0], centres[1 : crows + 1, ccols + 1] = (
        centres[1 : crows + 1, 1],
        centres[1 : crows + 1, ccols],
    )
    centres[0], centres[crows + 1] = centres[1], centres[crows]


@njit(cache=True, nogil=True)
def checkerboard(left, right, packed, data, dirty, lines, mu, smoothness, rounds, ox=0, oy=0):  # type: ignore[no-untyped-def]
    """Rounds of propagation in place: each pixel tries its neighbours' displacements and its own +-1.

    Cost: that of the displacement + ``smoothness`` times the sum over the four neighbours of min(|du| + |dv|, 2);
    beyond the border the neighbour on the other side stands in. The two colours of a checkerboard take turns, which
    settles in half the rounds of all at once. ``dirty`` (row, col) uint8: room; from the second round on only the
    neighbourhoods of what changed are looked at. ``ox, oy``: as in :func:`descend`. A round reaches two pixels.
    """
    rows, cols = left.shape
    here, there, flat, cost = left.reshape(-1), right.reshape(-1), packed.reshape(-1), data.reshape(-1)
    normals = lines.reshape(-1)
    shape = (right.shape[0], right.shape[1], cols, rows * cols, ox)
    todo, new, found = (
        np.empty(cols + LANES, np.int32),
        np.empty(cols + LANES, np.int32),
        np.empty(cols + LANES, np.int32),
    )
    moved = np.empty(cols + LANES, np.int32)
    dirty[:] = 1
    for turn in range(2 * rounds):
        for y in range(rows):
            above, below = (y - 1 if y > 0 else min(1, rows - 1)), (y + 1 if y < rows - 1 else max(rows - 2, 0))
            # What to look at and what changes cannot be predicted: lists, written always and kept by counting.
            flags, before, after = dirty[y], dirty[above], dirty[below]
            n = 0
            for x in range((y + turn) & 1, cols, 2):
                todo[n] = x
                n += 1 if flags[x] else 0
                flags[x] = 0
            if n == 0:
                continue
            todo[n : n + LANES] = todo[n - 1]
            start = y * cols
            for k in range(0, n, LANES):
                lanes.settle(
                    here, there, flat, cost, normals, todo, k, start, above * cols, below * cols, y + oy, shape,
                    smoothness, mu, new, found,
                )  # fmt: skip
            m = 0
            for k in range(n):
                moved[m] = k
                m += 1 if new[k] != flat[start + todo[k]] else 0
            for k in range(m):
                i = np.int64(todo[moved[k]])
                flat[start + i], cost[start + i] = new[moved[k]], found[moved[k]]
                before[i] = after[i] = flags[i] = flags[max(i - 1, 0)] = flags[min(i + 1, cols - 1)] = 1


@njit(cache=True, nogil=True)
def unpack(packed, u, v):  # type: ignore[no-untyped-def]
    """Displacements as two int16 maps."""
    for y in range(packed.shape[0]):
        for x in range(packed.shape[1]):
            u[y, x], v[y, x] = columns(packed[y, x]), rows_of(packed[y, x])


@njit(cache=True, nogil=True)
def pack_map(u, v, packed):  # type: ignore[no-untyped-def]
    """The reverse of :func:`unpack`."""
    for y in range(packed.shape[0]):
        for x in range(packed.shape[1]):
            packed[y, x] = pack(np.int64(u[y, x]), np.int64(v[y, x]))
