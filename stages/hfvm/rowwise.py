"""Kernels that work a row at a time over plain arrays, so that the compiler turns their loops into vector code.

Slices instead of shifted indices, and choices instead of branches: numba's handling of negative indices, and jumps,
keep a loop from being vectorised.
"""

from __future__ import annotations

import numpy as np
from numba import njit

PLANES = 9


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
                cu, cv, ou, ov, ok = u[y, a:b], v[y, a:b], u[j, a + i : b + i], v[j, a + i : b + i], keep[j, a + i : b + i]
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


@njit(cache=True, nogil=True, inline="always")
def _cubic(t):  # type: ignore[no-untyped-def]
    """Catmull-Rom weights of four samples, and of their derivative."""
    h, two, three = np.float32(0.5), np.float32(2.0), np.float32(3.0)
    one, four, five = np.float32(1.0), np.float32(4.0), np.float32(5.0)
    return (
        h * t * (two * t - one - t * t),
        h * (two + t * t * (three * t - five)),
        h * t * (one + four * t - three * t * t),
        h * t * t * (t - one),
        h * (four * t - one - three * t * t),
        h * t * (np.float32(9.0) * t - np.float32(10.0)),
        h * (one + np.float32(8.0) * t - np.float32(9.0) * t * t),
        h * t * (three * t - two),
    )


@njit(cache=True, nogil=True)
def sample_row(image, x, y, value, gx, gy):  # type: ignore[no-untyped-def]
    """Catmull-Rom values and gradients at float32 points, each two pixels or more inside the image."""
    flat = image.reshape(-1)
    width = np.uint64(image.shape[1])
    one = np.uint64(1)
    nil = np.float32(0.0)
    for k in range(x.size):
        i, j = np.int32(x[k]), np.int32(y[k])
        a0, a1, a2, a3, d0, d1, d2, d3 = _cubic(x[k] - np.float32(i))
        b0, b1, b2, b3, e0, e1, e2, e3 = _cubic(y[k] - np.float32(j))
        at = np.uint64(j - 1) * width + np.uint64(i - 1)
        total, dx, dy = nil, nil, nil
        for w, e in ((b0, e0), (b1, e1), (b2, e2), (b3, e3)):
            r0, r1, r2, r3 = flat[at], flat[at + one], flat[at + one + one], flat[at + one + one + one]
            row = r0 * a0 + r1 * a1 + r2 * a2 + r3 * a3
            total += w * row
            dy += e * row
            dx += w * (r0 * d0 + r1 * d1 + r2 * d2 + r3 * d3)
            at += width
        value[k], gx[k], gy[k] = total, dx, dy


@njit(cache=True, nogil=True)
def _products(left, right, right_valid, u, v, keep, y, room, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of the planes whose window sums a step needs, zero where a pixel takes no part.

    ``room`` (6, col) float32; ``out`` (PLANES + 1, col): count, gx, gy, r, gx gx, gx gy, gy gy, gx r, gy r, r r.
    """
    rows, cols = left.shape
    rrows, rcols = right.shape
    out[:] = np.float32(0.0)
    if y < 0 or y >= rows:
        return
    px, py, value, gx, gy, used = room[0], room[1], room[2], room[3], room[4], room[5]
    one, half = np.float32(1.0), np.float32(0.5)
    last_x, last_y = np.float32(rcols - 2), np.float32(rrows - 2)
    lu, lv, lk, n = u[y], v[y], keep[y], out[0]
    count = 0
    valid = right_valid.reshape(-1)
    for x in range(cols):
        xr, yr = np.float32(x) + lu[x], np.float32(y) + lv[x]
        inside = lk[x] & (xr >= one) & (xr < last_x) & (yr >= one) & (yr < last_y)
        at = np.uint64(yr + half) * np.uint64(rcols) + np.uint64(xr + half) if inside else np.uint64(0)
        inside &= valid[at] != 0
        n[x] = one if inside else np.float32(0.0)
        # The points of the pixels that take part, close together.
        px[count], py[count], used[count] = xr, yr, np.float32(x)
        count += np.int64(inside)
    sample_row(right, px[:count], py[:count], value, gx, gy)
    grey = left[y]
    for k in range(count):
        x = np.int64(used[k])
        r = grey[x] - value[k]
        a, b = gx[k], gy[k]
        out[1, x], out[2, x], out[3, x] = a, b, r
        out[4, x], out[5, x], out[6, x] = a * a, a * b, b * b
        out[7, x], out[8, x], out[9, x] = a * r, b * r, r * r


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
def lucas_kanade(left, right, right_valid, u, v, keep, radius, noise, new_u, new_v, energy):  # type: ignore[no-untyped-def]
    """One mean-free step for every kept pixel; ``energy``: residual variance *before* the step (inf: none).

    float32 throughout: the planes are summed afresh for every window, so nothing adds up.
    """
    rows, cols = left.shape
    size = 2 * radius + 1
    room = np.empty((6, cols + 1), np.float32)
    fresh = np.empty((PLANES + 1, cols), np.float32)
    ring = np.zeros((size, PLANES + 1, cols), np.float32)
    s = np.empty((PLANES + 1, cols), np.float32)
    for y in range(-radius, rows):
        _products(left, right, right_valid, u, v, keep, y + radius, room, fresh)
        _across(fresh, radius, ring[(y + radius) % size])
        if y < 0:
            continue
        for k in range(PLANES + 1):
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
