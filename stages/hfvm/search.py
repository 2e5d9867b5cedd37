"""One-level search of the fast matcher: several centres, a soft epipolar band, propagation with weak smoothness.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins, so that results do not
depend on the machine. A map is a pair of int16 arrays (columns, rows) of displacements in pixels of its level.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.features import distance

UNDEFINED = -32768
"""Column displacement of a pixel without any candidate."""

FAR = 1 << 40
"""Cost above every cost."""


@njit(cache=True, nogil=True)
def line_at(f, x, y):  # type: ignore[no-untyped-def]
    """Epipolar line of left pixel (x, y) as unit normal and offset of *displacements*: n . d + c = 0."""
    a = f[0, 0] * x + f[0, 1] * y + f[0, 2]
    b = f[1, 0] * x + f[1, 1] * y + f[1, 2]
    c = f[2, 0] * x + f[2, 1] * y + f[2, 2]
    n = np.sqrt(a * a + b * b)
    if n < 1e-12:
        return 0.0, 0.0, 0.0
    return a / n, b / n, (c + a * x + b * y) / n


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
def descend(left, right, up_u, up_v, f, mu, out_u, out_v):  # type: ignore[no-untyped-def]
    """Search around the doubled displacements of the coarse parent and its eight neighbours, each +-1.

    ``f``: fundamental matrix in this level's pixels; ``mu``: cost per pixel off the epipolar line, 0 = no band. With a
    band, each centre is first moved to the nearest point of the line.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    crows, ccols = up_u.shape
    box = np.empty((9, 4), np.int64)  # least and greatest column, least and greatest row of each search area
    for cy in range(crows):
        for cx in range(ccols):
            a, b, c = line_at(f, 2.0 * cx + 0.5, 2.0 * cy + 0.5)
            n = 0
            for k in range(9):
                j = cy + (k + 4) % 9 // 3 - 1
                i = cx + (k + 4) % 3 - 1
                if j < 0 or j >= crows or i < 0 or i >= ccols or up_u[j, i] == UNDEFINED:
                    continue
                u = 2 * np.int64(up_u[j, i])
                v = 2 * np.int64(up_v[j, i])
                if mu > 0:
                    e = a * u + b * v + c
                    u -= np.int64(np.rint(e * a))
                    v -= np.int64(np.rint(e * b))
                known = False
                for m in range(n):
                    if box[m, 0] == u - 1 and box[m, 2] == v - 1:
                        known = True
                if not known:
                    box[n, 0], box[n, 1], box[n, 2], box[n, 3] = u - 1, u + 1, v - 1, v + 1
                    n += 1
            # Where the centres lie close together one rectangle holds them all and costs less than n squares.
            if n > 1:
                u0, u1 = box[:n, 0].min(), box[:n, 1].max()
                v0, v1 = box[:n, 2].min(), box[:n, 3].max()
                if (u1 - u0 + 1) * (v1 - v0 + 1) <= 9 * n:
                    box[0, 0], box[0, 1], box[0, 2], box[0, 3] = u0, u1, v0, v1
                    n = 1
            for y in range(2 * cy, min(2 * cy + 2, rows)):
                for x in range(2 * cx, min(2 * cx + 2, cols)):
                    la, lb, lc = 0.0, 0.0, 0.0
                    if mu > 0:
                        la, lb, lc = line_at(f, np.float64(x), np.float64(y))
                    word = left[y, x]
                    best = np.int64(FAR)
                    bu, bv = np.int64(UNDEFINED), np.int64(0)
                    for m in range(n):
                        for v in range(max(box[m, 2], -y), min(box[m, 3], rrows - 1 - y) + 1):
                            for u in range(max(box[m, 0], -x), min(box[m, 1], rcols - 1 - x) + 1):
                                cost = distance(word, right[y + v, x + u])
                                if mu > 0:
                                    cost += np.int64(mu * abs(la * u + lb * v + lc))
                                if cost < best:
                                    best = cost
                                    bu, bv = u, v
                    out_u[y, x] = bu
                    out_v[y, x] = bv


@njit(cache=True, nogil=True)
def propagate(left, right, u_map, v_map, f, mu, smoothness, rounds):  # type: ignore[no-untyped-def]
    """Jacobi rounds: each pixel tries its neighbours' displacements and its own +-1, in place.

    Cost: feature distance + ``mu`` |distance from the epipolar line| + ``smoothness`` times the sum over the four
    neighbours of min(|du| + |dv|, 3). A pixel whose neighbourhood did not change in the last round is left out: it
    would decide the same.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    next_u = u_map.copy()
    next_v = v_map.copy()
    changed = np.ones((rows + 2, cols + 2), np.uint8)
    nu = np.empty(4, np.int64)
    nv = np.empty(4, np.int64)
    for _ in range(rounds):
        now = np.zeros((rows + 2, cols + 2), np.uint8)
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
                if y > 0 and u_map[y - 1, x] != UNDEFINED:
                    nu[n], nv[n] = u_map[y - 1, x], v_map[y - 1, x]
                    n += 1
                if x > 0 and u_map[y, x - 1] != UNDEFINED:
                    nu[n], nv[n] = u_map[y, x - 1], v_map[y, x - 1]
                    n += 1
                if x + 1 < cols and u_map[y, x + 1] != UNDEFINED:
                    nu[n], nv[n] = u_map[y, x + 1], v_map[y, x + 1]
                    n += 1
                if y + 1 < rows and u_map[y + 1, x] != UNDEFINED:
                    nu[n], nv[n] = u_map[y + 1, x], v_map[y + 1, x]
                    n += 1
                la, lb, lc = 0.0, 0.0, 0.0
                if mu > 0:
                    la, lb, lc = line_at(f, np.float64(x), np.float64(y))
                word = left[y, x]
                own_u, own_v = np.int64(u_map[y, x]), np.int64(v_map[y, x])
                best = np.int64(FAR)
                bu, bv = own_u, own_v
                for k in range(-1, 4 + n):
                    if k < 4:
                        if own_u == UNDEFINED:
                            continue
                        u, v = own_u, own_v
                        if k == 0:
                            u -= 1
                        elif k == 1:
                            u += 1
                        elif k == 2:
                            v -= 1
                        elif k == 3:
                            v += 1
                    else:
                        u, v = nu[k - 4], nv[k - 4]
                        if abs(u - own_u) + abs(v - own_v) <= 1:
                            continue
                        known = False
                        for m in range(k - 4):
                            if nu[m] == u and nv[m] == v:
                                known = True
                        if known:
                            continue
                    if x + u < 0 or x + u >= rcols or y + v < 0 or y + v >= rrows:
                        continue
                    cost = np.int64(0)
                    for m in range(n):
                        cost += min(abs(nu[m] - u) + abs(nv[m] - v), 3)
                    cost = cost * smoothness + distance(word, right[y + v, x + u])
                    if mu > 0:
                        cost += np.int64(mu * abs(la * u + lb * v + lc))
                    if cost < best:
                        best = cost
                        bu, bv = u, v
                if bu != own_u or bv != own_v:
                    now[y + 1, x + 1] = 1
                next_u[y, x] = bu
                next_v[y, x] = bv
        changed = now
        u_map[:] = next_u
        v_map[:] = next_v
