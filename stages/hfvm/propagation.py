"""Search of one level: several centres, a soft epipolar band, propagation with weak smoothness.

A map is one array of packed displacements, v << 16 | u (int32), beside the cost of each without smoothness. All costs
are integers, candidates come in a fixed order and only a strictly lower cost wins, so that results do not depend on
the machine. Eight candidates are looked at together (``lanes``).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.features import distance
from stages.hfvm import lanes
from stages.hfvm.lanes import COST, LANES, NOTHING, ORDER, TRUNCATION

FAR = 1 << 25
"""Cost above every cost."""


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
def own_cost(word, right, x, y, packed, line, mu):  # type: ignore[no-untyped-def]
    """Distance and band at one displacement, FAR outside the image; ``x, y``: the pixel's place in ``right``."""
    u, v = columns(packed), rows_of(packed)
    rows, cols = right.shape
    if x + u < 0 or x + u >= cols or y + v < 0 or y + v >= rows:
        return np.int64(FAR)
    cost = distance(word, right[y + v, x + u])
    if mu > 0:
        cost += np.int64(mu * abs(line[0] * u + line[1] * v + line[2]))
    return cost


@njit(cache=True, nogil=True)
def descend(left, right, up_u, up_v, reach_x, reach_y, lines, mu, packed, data, ox=0, oy=0):  # type: ignore[no-untyped-def]
    """Search around the doubled displacements of the coarse parent and its eight neighbours.

    ``reach_x, reach_y``: search to either side of each; ``lines`` (row, col, 3) float32: epipolar line of each pixel
    (:func:`stages.hfvm.epipolar.lines`); ``mu``: cost per pixel off it, 0 = no band (``lines`` is not read). With a
    band, each centre is first moved towards its line, by a pixel at most: a coarse fit may be wrong by more than that.
    ``packed, data`` (row, col) int32 get the displacements and their costs. With nothing inside the other image the
    prediction stays: it leads out of it. ``ox, oy``: where the left window's first pixel lies in the right window.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    crows, ccols = up_u.shape
    words = right.reshape(-1)
    box = np.empty((9, 4), np.int64)
    area = (2 * reach_x + 1) * (2 * reach_y + 1)
    nil = np.float32(0.0)
    # Centres with their edge repeated: that adds none.
    us, vs = np.empty((crows + 2, ccols + 2), np.int32), np.empty((crows + 2, ccols + 2), np.int32)
    _centres(up_u, up_v, lines, mu, rows, cols, us, vs)
    low_u, high_u = np.empty(ccols + 2, np.int32), np.empty(ccols + 2, np.int32)
    low_v, high_v = np.empty(ccols + 2, np.int32), np.empty(ccols + 2, np.int32)
    for cy in range(crows):
        _range(us[cy : cy + 3], low_u, high_u)
        _range(vs[cy : cy + 3], low_v, high_v)
        for cx in range(ccols):
            own_u, own_v = np.int64(us[cy + 1, cx + 1]), np.int64(vs[cy + 1, cx + 1])
            u0 = np.int64(min(low_u[cx], low_u[cx + 1], low_u[cx + 2])) - reach_x
            u1 = np.int64(max(high_u[cx], high_u[cx + 1], high_u[cx + 2])) + reach_x
            v0 = np.int64(min(low_v[cx], low_v[cx + 1], low_v[cx + 2])) - reach_y
            v1 = np.int64(max(high_v[cx], high_v[cx + 1], high_v[cx + 2])) + reach_y
            # Where the centres lie close together one rectangle holds them all and costs less than n areas.
            n = 1
            size = (u1 - u0 + 1) * (v1 - v0 + 1)
            if size > 2 * area:
                n = _areas(us[cy : cy + 3, cx : cx + 3], vs[cy : cy + 3, cx : cx + 3], reach_x, reach_y, box)
            if size <= area * max(n, 2):
                box[0, 0], box[0, 1], box[0, 2], box[0, 3] = u0, u1, v0, v1
                n = 1
            for y in range(2 * cy, min(2 * cy + 2, rows)):
                for x in range(2 * cx, min(2 * cx + 2, cols)):
                    word = left[y, x]
                    a = b = c = nil
                    if mu > 0:
                        a, b, c = lines[y, x, 0], lines[y, x, 1], lines[y, x, 2]
                    best = np.int64(NOTHING)
                    first = np.int64(0)
                    bu, bv = own_u, own_v
                    for m in range(n):
                        ua, ub = max(box[m, 0], -x - ox), min(box[m, 1], rcols - 1 - x - ox)
                        if ub < ua:
                            continue
                        v, last_v = max(box[m, 2], -y - oy), min(box[m, 3], rrows - 1 - y - oy)
                        while v <= last_v:
                            start = (y + oy + v) * rcols + x + ox
                            u = ua
                            while u <= ub:
                                key = lanes.run(
                                    word, words, start + u, min(ub - u + 1, LANES), u, v, a, b, c, mu, first
                                )
                                better = key < best
                                best = key if better else best
                                bu = u + (key & ((1 << ORDER) - 1)) - first if better else bu
                                bv = v if better else bv
                                first += LANES
                                u += LANES
                            v += 1
                    packed[y, x] = pack(bu, bv)
                    data[y, x] = best >> ORDER if best < NOTHING else FAR


@njit(cache=True, nogil=True)
def _centres(up_u, up_v, lines, mu, rows, cols, us, vs):  # type: ignore[no-untyped-def]
    """Doubled displacements, each moved towards its epipolar line by a pixel at most; a border repeats the edge."""
    crows, ccols = up_u.shape
    one = np.float32(1.0)
    for j in range(crows + 2):
        cy = min(max(j - 1, 0), crows - 1)
        y = min(2 * cy, rows - 1)
        for i in range(ccols + 2):
            cx = min(max(i - 1, 0), ccols - 1)
            pu, pv = 2 * np.int64(up_u[cy, cx]), 2 * np.int64(up_v[cy, cx])
            if mu > 0:
                x = min(2 * cx, cols - 1)
                a, b = lines[y, x, 0], lines[y, x, 1]
                e = min(max(a * pu + b * pv + lines[y, x, 2], -one), one)
                pu -= np.int64(np.rint(e * a))
                pv -= np.int64(np.rint(e * b))
            us[j, i], vs[j, i] = pu, pv


@njit(cache=True, nogil=True)
def _range(three, low, high):  # type: ignore[no-untyped-def]
    """Least and greatest of three rows, column by column."""
    a, b, c = three[0], three[1], three[2]
    for x in range(low.size):
        low[x] = min(a[x], b[x], c[x])
        high[x] = max(a[x], b[x], c[x])


@njit(cache=True, nogil=True)
def _areas(us, vs, reach_x, reach_y, box):  # type: ignore[no-untyped-def]
    """Different search areas among nine centres, the middle one first: least and greatest column and row."""
    n = 0
    for k in range(9):
        u, v = np.int64(us[(k + 4) % 9 // 3, (k + 4) % 3]), np.int64(vs[(k + 4) % 9 // 3, (k + 4) % 3])
        known = False
        for m in range(n):
            known |= (box[m, 0] == u - reach_x) & (box[m, 2] == v - reach_y)
        if not known:
            box[n, 0], box[n, 1], box[n, 2], box[n, 3] = u - reach_x, u + reach_x, v - reach_y, v + reach_y
            n += 1
    return n


@njit(cache=True, nogil=True)
def costs(left, right, lines, mu, packed, data, ox=0, oy=0):  # type: ignore[no-untyped-def]
    """Costs of a map without smoothness."""
    line = np.zeros(3, np.float32)
    for y in range(left.shape[0]):
        for x in range(left.shape[1]):
            at = lines[y, x] if mu > 0 else line
            data[y, x] = own_cost(left[y, x], right, x + ox, y + oy, packed[y, x], at, mu)


@njit(cache=True, nogil=True, inline="always")
def _step(a, b):  # type: ignore[no-untyped-def]
    return min(abs(columns(a) - columns(b)) + abs(rows_of(a) - rows_of(b)), TRUNCATION)


@njit(cache=True, nogil=True)
def _border(left, right, packed, x, y, data, smoothness, line, mu, ox, oy):  # type: ignore[no-untyped-def]
    """Decision at a pixel that lacks a neighbour: displacement and its cost."""
    rows, cols = left.shape
    near = np.empty(4, np.int32)
    n = 0
    for k in range(4):
        j, i = y + (k == 3) - (k == 0), x + (k == 2) - (k == 1)
        if j >= 0 and j < rows and i >= 0 and i < cols:
            near[n] = packed[j, i]
            n += 1
    own = packed[y, x]
    best, found = np.int64(FAR), own
    for k in range(-1, 4 + n):
        tried = own
        if k >= 4:
            tried = near[k - 4]
        elif k >= 0:
            tried = pack(columns(own) + (k == 1) - (k == 0), rows_of(own) + (k == 3) - (k == 2))
        rough = np.int64(0)
        for m in range(n):
            rough += _step(near[m], tried)
        cost = own_cost(left[y, x], right, x + ox, y + oy, tried, line, mu)
        if cost < FAR and cost + smoothness * rough < best:
            best, found = cost + smoothness * rough, tried
    return found, best


@njit(cache=True, nogil=True)
def _roughness(flat, rows, cols, p, tried):  # type: ignore[no-untyped-def]
    y = p // cols
    x = p - y * cols
    rough = np.int64(0)
    if y > 0:
        rough += _step(flat[p - cols], tried)
    if x > 0:
        rough += _step(flat[p - 1], tried)
    if x < cols - 1:
        rough += _step(flat[p + 1], tried)
    if y < rows - 1:
        rough += _step(flat[p + cols], tried)
    return rough


@njit(cache=True, nogil=True)
def checkerboard(left, right, packed, data, dirty, lines, mu, smoothness, rounds, ox=0, oy=0):  # type: ignore[no-untyped-def]
    """Rounds of propagation in place: each pixel tries its neighbours' displacements and its own +-1.

    Cost: that of the displacement + ``smoothness`` times the sum over the four neighbours of min(|du| + |dv|, 2). The
    two colours of a checkerboard take turns, which settles in half the rounds of all at once. ``dirty`` (row, col)
    uint8: room; from the second round on only the neighbourhoods of what changed are looked at. ``ox, oy``: as in
    :func:`descend`; a window of an image must start at even rows and columns, so that the colours are the image's.
    Reach: two pixels a round.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    words = right.reshape(-1)
    nil = np.zeros(3, np.float32)
    todo, moved, keys = np.empty(cols + 1, np.int32), np.empty(cols + 1, np.int32), np.empty(cols + 1, np.int64)
    dirty[:] = 1
    for turn in range(2 * rounds):
        for y in range(rows):
            first = (y + turn) & 1
            if y == 0 or y == rows - 1:
                for x in range(first, cols, 2):
                    line = lines[y, x] if mu > 0 else nil
                    _edge(left, right, packed, x, y, data, dirty, smoothness, line, mu, ox, oy)
                continue
            if first == 0:
                line = lines[y, 0] if mu > 0 else nil
                _edge(left, right, packed, 0, y, data, dirty, smoothness, line, mu, ox, oy)
            if (cols - 1) & 1 == first:
                x = cols - 1
                line = lines[y, x] if mu > 0 else nil
                _edge(left, right, packed, x, y, data, dirty, smoothness, line, mu, ox, oy)
            # What to look at and what changes cannot be predicted: lists, written always and kept by counting.
            flags, here, over, under, cost = dirty[y], packed[y], packed[y - 1], packed[y + 1], data[y]
            n = 0
            for x in range(2 - first, cols - 1, 2):
                todo[n] = x
                n += 1 if flags[x] else 0
                flags[x] = 0
            m = 0
            for k in range(n):
                i = np.int64(todo[k])
                a = b = c = np.float32(0.0)
                if mu > 0:
                    a, b, c = lines[y, i, 0], lines[y, i, 1], lines[y, i, 2]
                own = here[i]
                key = lanes.around(
                    left[y, i], words, rrows, rcols, i + ox, y + oy, own, np.int64(cost[i]), over[i], here[i - 1],
                    here[i + 1], under[i], smoothness, a, b, c, mu,
                )  # fmt: skip
                moved[m], keys[m] = i, key
                m += 1 if np.int32(key) != own else 0
            for k in range(m):
                i = np.int64(moved[k])
                new = np.int32(keys[k])
                rough = _step(over[i], new) + _step(here[i - 1], new) + _step(here[i + 1], new) + _step(under[i], new)
                here[i] = new
                cost[i] = (keys[k] >> COST) - smoothness * rough
                flags[i] = flags[i - 1] = flags[i + 1] = dirty[y - 1, i] = dirty[y + 1, i] = 1


@njit(cache=True, nogil=True)
def _edge(left, right, packed, x, y, data, dirty, smoothness, line, mu, ox, oy):  # type: ignore[no-untyped-def]
    """A pixel of ``checkerboard`` that lacks a neighbour."""
    rows, cols = left.shape
    if not dirty[y, x]:
        return
    dirty[y, x] = 0
    new, total = _border(left, right, packed, x, y, data, smoothness, line, mu, ox, oy)
    if new == packed[y, x]:
        return
    packed[y, x] = new
    data[y, x] = total - smoothness * _roughness(packed.reshape(-1), rows, cols, y * cols + x, new)
    dirty[y, x] = dirty[max(y - 1, 0), x] = dirty[y, max(x - 1, 0)] = 1
    dirty[y, min(x + 1, cols - 1)] = dirty[min(y + 1, rows - 1), x] = 1


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
