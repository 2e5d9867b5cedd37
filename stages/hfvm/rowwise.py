"""Kernels that work a row at a time over plain arrays, so that the compiler turns their loops into vector code.

Slices instead of shifted indices, and choices instead of branches: numba's handling of negative indices, and jumps,
keep a loop from being vectorised.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.hfvm import lanes

PLANES = 10


@njit(cache=True, nogil=True)
def local_mean(u, v, keep, radius, out_u, out_v):  # type: ignore[no-untyped-def]
    """Mean over (2 radius + 1)^2 kept pixels whose displacement lies within one pixel of the centre's."""
    rows, cols = u.shape
    su, sv, count = np.empty(cols, np.float32), np.empty(cols, np.float32), np.empty(cols, np.float32)
    one, nil = np.float32(1.0), np.float32(0.0)
    for y in range(rows):
        su[:], sv[:], count[:] = nil, nil, nil
        for j in range(max(0, y - radius), min(rows, y + radius + 1)):
            for i in range(-radius, radius + 1):
                a, b = max(0, -i), min(cols, cols - i)
                if a >= b:
                    continue
                cu, cv, ou, ov, ok = (
                    u[y, a:b],
                    v[y, a:b],
                    u[j, a + i : b + i],
                    v[j, a + i : b + i],
                    keep[j, a + i : b + i],
                )
                tu, tv, tn = su[a:b], sv[a:b], count[a:b]
                for x in range(b - a):
                    du, dv = ou[x] - cu[x], ov[x] - cv[x]
                    use = ok[x] & (abs(du) <= one) & (abs(dv) <= one)
                    tu[x] += du if use else nil
                    tv[x] += dv if use else nil
                    tn[x] += one if use else nil
        for x in range(cols):
            n = max(count[x], one)
            out_u[y, x] = u[y, x] + (su[x] / n if keep[y, x] else nil)
            out_v[y, x] = v[y, x] + (sv[x] / n if keep[y, x] else nil)


@njit(cache=True, nogil=True)
def box_sum(a, radius, out):  # type: ignore[no-untyped-def]
    """Sums in float64 over (2 radius + 1)^2 pixels, clipped at the border.

    Each is added up afresh in one order, so that it does not depend on where the array begins; a running sum would.
    """
    rows, cols = a.shape
    down, total = np.empty(cols), np.empty(cols)
    for y in range(rows):
        down[:] = 0.0
        for j in range(max(0, y - radius), min(rows, y + radius + 1)):
            row = a[j]
            for x in range(cols):
                down[x] += row[x]
        total[:] = 0.0
        for i in range(-radius, radius + 1):
            first, last = max(0, -i), min(cols, cols - i)
            if first >= last:
                continue
            here, there = total[first:last], down[first + i : last + i]
            for x in range(last - first):
                here[x] += there[x]
        out[y] = total


@njit(cache=True, nogil=True)
def _products(left, right, right_valid, u, v, keep, y, out, x0=0, y0=0, rx0=0, ry0=0, rrows=-1, rcols=-1):  # type: ignore[no-untyped-def]
    """Row ``y`` of the planes whose window sums a step needs, zero where a pixel takes no part.

    ``out`` (PLANES, col): count, gx, gy, r, gx gx, gx gy, gy gy, gx r, gy r, r r. Windows as in
    :func:`stages.hfvm.consistency.backmatch`; ``rrows`` negative: the right window is the whole image.
    """
    rows, cols = left.shape
    width = right.shape[1]
    height, length = right.shape if rrows < 0 else (rrows, rcols)
    out[:] = np.float32(0.0)
    if y < 0 or y >= rows:
        return
    one, half = np.float32(1.0), np.float32(0.5)
    last_x, last_y = np.float32(length - 2), np.float32(height - 2)
    lu, lv, grey, n, gx, gy, rest = u[y], v[y], left[y], out[0], out[1], out[2], out[3]
    flat, taking = right.reshape(-1), keep[y]
    for x in range(cols):
        xr, yr = np.float32(x + x0) + lu[x], np.float32(y + y0) + lv[x]
        if not (taking[x] and xr >= one and xr < last_x and yr >= one and yr < last_y):
            continue
        if not right_valid[np.uint64(np.int64(yr + half) - ry0), np.uint64(np.int64(xr + half) - rx0)]:
            continue
        i, j = np.int64(xr), np.int64(yr)
        at = (j - ry0) * width + i - rx0
        value, a, b = lanes.cubic(flat, at, width, xr - np.float32(i), yr - np.float32(j))
        n[x], gx[x], gy[x], rest[x] = one, a, b, grey[x] - value
    for k, (p, q) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, rest), (gy, rest), (rest, rest))):
        product = out[4 + k]
        for x in range(cols):
            product[x] = p[x] * q[x]


@njit(cache=True, nogil=True)
def _across(fresh, radius, out):  # type: ignore[no-untyped-def]
    """Sums over 2 radius + 1 columns, clipped at the ends."""
    cols = fresh.shape[1]
    for k in range(fresh.shape[0]):
        total = out[k]
        total[:] = np.float32(0.0)
        for i in range(-radius, radius + 1):
            a, b = max(0, -i), min(cols, cols - i)
            if a >= b:
                continue
            here, there = total[a:b], fresh[k, a + i : b + i]
            for x in range(b - a):
                here[x] += there[x]


@njit(cache=True, nogil=True)
def lucas_kanade(  # type: ignore[no-untyped-def]
    left, right, right_valid, u, v, keep, radius, noise, new_u, new_v, energy, x0, y0, rx0, ry0, rrows, rcols
):
    """One mean-free step for every kept pixel; ``energy``: residual variance *before* the step (inf: none).

    float32 throughout: the planes are summed afresh for every window, so nothing adds up. Windows as in
    :func:`stages.hfvm.consistency.backmatch`.
    """
    rows, cols = left.shape
    size = 2 * radius + 1
    fresh = np.empty((PLANES, cols), np.float32)
    ring = np.zeros((size, PLANES, cols), np.float32)
    s = np.empty((PLANES, cols), np.float32)
    for y in range(-radius, rows):
        _products(left, right, right_valid, u, v, keep, y + radius, fresh, x0, y0, rx0, ry0, rrows, rcols)
        _across(fresh, radius, ring[(y + radius) % size])
        if y < 0:
            continue
        for k in range(PLANES):
            total = s[k]
            total[:] = ring[(y + radius + 1) % size, k]
            for j in range(1, size):
                row = ring[(y + radius + 1 + j) % size, k]
                for x in range(cols):
                    total[x] += row[x]
        _solve(s, np.float32(0.5 * size * size), np.float32(noise), keep[y], u[y], v[y], new_u[y], new_v[y], energy[y])


@njit(cache=True, nogil=True)
def _solve(s, least, noise, keep, u, v, new_u, new_v, energy):  # type: ignore[no-untyped-def]
    """Steps of one row from the window sums."""
    one, nil, far = np.float32(1.0), np.float32(0.0), np.float32(np.inf)
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9 = s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8], s[9]
    for x in range(u.size):
        use = keep[x] & (s0[x] >= least)
        n = s0[x] if use else one
        inverse = one / n
        m1, m2, m3 = s1[x] * inverse, s2[x] * inverse, s3[x] * inverse
        a = s4[x] - s1[x] * m1 + noise * n
        b = s5[x] - s1[x] * m2
        c = s6[x] - s2[x] * m2 + noise * n
        p = s7[x] - s1[x] * m3
        q = s8[x] - s2[x] * m3
        # A window of noise alone has a determinant of at least (noise n)^2.
        det = a * c - b * b
        inverse_det = one / (det if det > nil else one)
        du, dv = (c * p - b * q) * inverse_det, (a * q - b * p) * inverse_det
        good = use & (det > nil)
        energy[x] = max(s9[x] - s3[x] * m3, nil) * inverse if use else far
        new_u[x] = u[x] + (min(max(du, -one), one) if good else nil)
        new_v[x] = v[x] + (min(max(dv, -one), one) if good else nil)
