"""One-level search of the fast matcher: several centres, a soft epipolar band, propagation with weak smoothness.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins, so that results do not
depend on the machine. A map is a pair of int16 arrays (columns, rows) of displacements in pixels of its level.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.declare import AnyArray
from stages.features import distance

TRUNCATION = 2
"""Pixels: beyond this a step to a neighbour costs no more, so that depth edges stay."""

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


@njit(cache=True, nogil=True)
def descend(left, right, up_u, up_v, reach_x, reach_y, lines, mu, out_u, out_v):  # type: ignore[no-untyped-def]
    """Search around the doubled displacements of the coarse parent and its eight neighbours.

    ``reach_x, reach_y``: search to either side of each; ``lines`` (row, col, 3) float32: epipolar line of each pixel
    (:func:`stages.hfvm.epipolar.lines`); ``mu``: cost per pixel off it, 0 = no band (``lines`` is not read). With a
    band, each centre is first moved towards its line, by a pixel at most: a coarse fit may be wrong by more than that.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    crows, ccols = up_u.shape
    box = np.empty((9, 4), np.int64)  # least and greatest column, least and greatest row of each search area
    area = (2 * reach_x + 1) * (2 * reach_y + 1)
    for cy in range(crows):
        for cx in range(ccols):
            n = 0
            own_u, own_v = np.int64(0), np.int64(0)
            u0, v0 = np.int64(1 << 20), np.int64(1 << 20)
            u1, v1 = -u0, -v0
            for k in range(9):
                j = cy + (k + 4) % 9 // 3 - 1
                i = cx + (k + 4) % 3 - 1
                if j < 0 or j >= crows or i < 0 or i >= ccols:
                    continue
                pu = 2 * np.int64(up_u[j, i])
                pv = 2 * np.int64(up_v[j, i])
                if mu > 0:
                    a, b = lines[2 * cy, 2 * cx, 0], lines[2 * cy, 2 * cx, 1]
                    e = a * pu + b * pv + lines[2 * cy, 2 * cx, 2]
                    e = min(max(e, np.float32(-1.0)), np.float32(1.0))
                    pu -= np.int64(np.rint(e * a))
                    pv -= np.int64(np.rint(e * b))
                if k == 0:
                    own_u, own_v = pu, pv
                known = False
                for m in range(n):
                    if box[m, 0] == pu - reach_x and box[m, 2] == pv - reach_y:
                        known = True
                if not known:
                    box[n, 0], box[n, 1] = pu - reach_x, pu + reach_x
                    box[n, 2], box[n, 3] = pv - reach_y, pv + reach_y
                    u0, u1 = min(u0, pu - reach_x), max(u1, pu + reach_x)
                    v0, v1 = min(v0, pv - reach_y), max(v1, pv + reach_y)
                    n += 1
            # Where the centres lie close together one rectangle holds them all and costs less than n areas.
            if (u1 - u0 + 1) * (v1 - v0 + 1) <= area * n:
                box[0, 0], box[0, 1], box[0, 2], box[0, 3] = u0, u1, v0, v1
                n = 1
            for y in range(2 * cy, min(2 * cy + 2, rows)):
                for x in range(2 * cx, min(2 * cx + 2, cols)):
                    word = left[y, x]
                    best = np.int64(FAR)
                    # With nothing inside the other image the prediction stays: it leads out of it.
                    bu, bv = own_u, own_v
                    for m in range(n):
                        for v in range(max(box[m, 2], -y), min(box[m, 3], rrows - 1 - y) + 1):
                            for u in range(max(box[m, 0], -x), min(box[m, 1], rcols - 1 - x) + 1):
                                cost = distance(word, right[y + v, x + u])
                                if mu > 0:
                                    cost += np.int64(mu * abs(lines[y, x, 0] * u + lines[y, x, 1] * v + lines[y, x, 2]))
                                if cost < best:
                                    best = cost
                                    bu, bv = np.int64(u), np.int64(v)
                    out_u[y, x] = bu
                    out_v[y, x] = bv


def propagate(
    left: AnyArray, right: AnyArray, u: AnyArray, v: AnyArray, lines: AnyArray, mu: float, smoothness: int, rounds: int
) -> tuple[AnyArray, AnyArray]:
    """Jacobi rounds: each pixel tries its neighbours' displacements and its own +-1; the improved map.

    Cost: feature distance + ``mu`` |distance from the epipolar line| + ``smoothness`` times the sum over the four
    neighbours of min(|du| + |dv|, 2). A pixel whose neighbourhood did not change in the last round is left out: it
    would decide the same.
    """
    rows, cols = u.shape
    changed = np.ones((rows + 2, cols + 2), np.uint8)
    for _ in range(rounds):
        new_u, new_v, now = u.copy(), v.copy(), np.zeros((rows + 2, cols + 2), np.uint8)
        _jacobi(left, right, u, v, changed, lines, mu, smoothness, new_u, new_v, now)
        u, v, changed = new_u, new_v, now
    return u, v


@njit(cache=True, nogil=True)
def _jacobi(left, right, u_map, v_map, changed, lines, mu, smoothness, new_u, new_v, now):  # type: ignore[no-untyped-def]
    """One round; ``changed`` and ``now`` have a border of one pixel."""
    rows, cols = left.shape
    rrows, rcols = right.shape
    nu = np.empty(4, np.int64)
    nv = np.empty(4, np.int64)
    for y in range(rows):
        for x in range(cols):
            if not (
                changed[y + 1, x + 1]
                | changed[y, x + 1]
                | changed[y + 1, x]
                | changed[y + 1, x + 2]
                | changed[y + 2, x + 1]
            ):
                continue
            n = 0
            for k in range(4):
                j, i = y, x
                if k == 0:
                    j = y - 1
                elif k == 1:
                    i = x - 1
                elif k == 2:
                    i = x + 1
                else:
                    j = y + 1
                if j >= 0 and j < rows and i >= 0 and i < cols:
                    nu[n], nv[n] = u_map[j, i], v_map[j, i]
                    n += 1
            word = left[y, x]
            own_u, own_v = np.int64(u_map[y, x]), np.int64(v_map[y, x])
            best = np.int64(FAR)
            bu, bv = own_u, own_v
            for k in range(-1, 4 + n):
                u, v = own_u, own_v
                if k == 0:
                    u -= 1
                elif k == 1:
                    u += 1
                elif k == 2:
                    v -= 1
                elif k == 3:
                    v += 1
                elif k >= 4:
                    u, v = nu[k - 4], nv[k - 4]
                    if abs(u - own_u) + abs(v - own_v) <= 1:
                        continue
                if x + u < 0 or x + u >= rcols or y + v < 0 or y + v >= rrows:
                    continue
                cost = np.int64(0)
                for m in range(n):
                    cost += min(abs(nu[m] - u) + abs(nv[m] - v), TRUNCATION)
                cost *= smoothness
                if cost >= best:
                    continue
                cost += distance(word, right[y + v, x + u])
                if mu > 0:
                    cost += np.int64(mu * abs(lines[y, x, 0] * u + lines[y, x, 1] * v + lines[y, x, 2]))
                if cost < best:
                    best = cost
                    bu, bv = u, v
            if bu != own_u or bv != own_v:
                now[y + 1, x + 1] = 1
                new_u[y, x] = bu
                new_v[y, x] = bv
