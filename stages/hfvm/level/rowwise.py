"""Kernels that work a row at a time over plain arrays, so that the compiler turns their loops into vector code.

Slices instead of shifted indices, and choices instead of branches: numba's handling of negative indices, and jumps,
keep a loop from being vectorised.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from rille.stages.geometry.spline import weights
from rille.stages.hfvm.level.window_pair import WindowPair
from rille.stages.numeric.line import copy_line

PLANES = 10


class Right(NamedTuple):
    """A window of the right image: coefficients of its cubic spline float32, 1 = usable uint8, and where both windows
    lie."""

    spline: Any
    valid: Any
    place: WindowPair


class StepArrays(NamedTuple):
    """What a step writes, (row, col) float32: new displacements, pixels; residual variance *before* the step (inf:
    none), squared grey levels; variance of the column displacement for a unit of variance of the grey levels."""

    u: Any
    v: Any
    energy: Any
    per_noise: Any


@njit(cache=True, nogil=True)
def local_mean(u, v, keep, radius, stride, out_u, out_v):  # type: ignore[no-untyped-def]
    """Mean of the kept pixels in a window whose displacement lies within one pixel of the centre's.

    The window reaches ``radius`` pixels, of which each ``stride``-th from its border on takes part.
    """
    rows, cols = u.shape
    su, sv, count = np.empty(cols, np.float32), np.empty(cols, np.float32), np.empty(cols, np.float32)
    one, nil = np.float32(1.0), np.float32(0.0)
    for y in range(rows):
        su[:], sv[:], count[:] = nil, nil, nil
        for j in range(y - radius, y + radius + 1, stride):
            if j < 0 or j >= rows:
                continue
            for i in range(-radius, radius + 1, stride):
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
                    # Differences are summed, since float32 keeps more of their fractions than of whole displacements.
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
def _add_up(parts, cols, out):  # type: ignore[no-untyped-def]
    """Write to ``out`` (plane, col) sums over 2 radius + 1 columns of ``parts`` (plane, col + 2 radius)."""
    for k in range(parts.shape[0]):
        part, total = parts[k], out[k]
        # The usual radius in one pass, summed in the order of the loops below: the bits must be the same.
        if part.size == cols + 4:
            one, two, three, four = part[1 : 1 + cols], part[2 : 2 + cols], part[3 : 3 + cols], part[4:]
            for x in range(cols):
                total[x] = (part[x] + (one[x] + two[x])) + (three[x] + four[x])
            continue
        for x in range(cols):
            total[x] = part[x]
        for i in range(1, part.size - cols, 2):
            one, two = part[i : i + cols], part[i + 1 : i + 1 + cols]
            for x in range(cols):
                total[x] += one[x] + two[x]


@njit(cache=True, nogil=True)
def box(planes, radius, out):  # type: ignore[no-untyped-def]
    """Sums of float32 planes (plane, row, col) over (2 radius + 1)^2 pixels, clipped at the border.

    Every window is summed afresh, so that it does not depend on where the array begins.
    """
    count, rows, cols = planes.shape
    wide = np.zeros((1, cols + 2 * radius), np.float32)
    middle = wide[0, radius : radius + cols]
    for k in range(count):
        for y in range(rows):
            first, last = max(0, y - radius), min(rows, y + radius + 1)
            row = planes[k, first]
            for x in range(cols):
                middle[x] = row[x]
            for j in range(first + 1, last - 1, 2):
                one, two = planes[k, j], planes[k, j + 1]
                for x in range(cols):
                    middle[x] += one[x] + two[x]
            # Where the border cuts the window to an even number, one row is left without a partner.
            if (last - first) % 2 == 0:
                row = planes[k, last - 1]
                for x in range(cols):
                    middle[x] += row[x]
            _add_up(wide, cols, out[k, y : y + 1])


@njit(cache=True, nogil=True)
def spline_value(coefficients, at, width, t, s):  # type: ignore[no-untyped-def]
    """Value of a cubic spline: sum_k sum_m w_k(s) w_m(t) coefficients[k, m]; these are flat, in rows of ``width``.

    ``at``: index of the pixel above and left of the point's own; ``t, s``: the point's distance right of and below it,
    within a pixel. 4 x 4 coefficients from ``at - width - 1`` on are read.
    """
    across, down = weights(t), weights(s)
    nil = np.float32(0.0)
    c0, c1, c2, c3 = nil, nil, nil, nil
    for k in range(4):
        # Unsigned indices need no check for counting from the end.
        i = np.uint64(at + (k - 1) * width - 1)
        c0 += down[k] * coefficients[i]
        c1 += down[k] * coefficients[i + np.uint64(1)]
        c2 += down[k] * coefficients[i + np.uint64(2)]
        c3 += down[k] * coefficients[i + np.uint64(3)]
    # Rows first, then pairs of columns: this order fixes the rounding of published artifacts.
    return (across[0] * c0 + across[2] * c2) + (across[1] * c1 + across[3] * c3)


@njit(cache=True, nogil=True)
def _products(left, right, now, keep, y, radius, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of the planes whose window sums a step needs, zero where a pixel takes no part.

    ``out`` (PLANES, radius + col + radius): count, gx, gy, r, gx gx, gx gy, gy gy, gx r, gy r, r r, with the gradient
    of the left image. Reach: a pixel.
    """
    rows, cols = left.shape
    (u, v), (x0, y0, rx0, ry0, rrows, rcols) = now, right.place
    width = right.spline.shape[1]
    if y < 0 or y >= rows:
        out[:] = np.float32(0.0)
        return
    one, half, nil = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    # A spline reads one coefficient before and two after.
    last_x, last_y = np.float32(rcols - 2), np.float32(rrows - 2)
    end = radius + cols
    n, gx, gy, rest = out[0, radius:end], out[1, radius:end], out[2, radius:end], out[3, radius:end]
    lu, lv, grey = u[y], v[y], left[y]
    flat, taking = right.spline.reshape(-1), keep[y]
    for x in range(cols):
        xr, yr = np.float32(x + x0) + lu[x], np.float32(y + y0) + lv[x]
        n[x] = rest[x] = nil
        if not (taking[x] and xr >= one and xr < last_x and yr >= one and yr < last_y):
            continue
        if not right.valid[np.uint64(np.int64(yr + half) - ry0), np.uint64(np.int64(xr + half) - rx0)]:
            continue
        i, j = np.int64(xr), np.int64(yr)
        at = (j - ry0) * width + i - rx0
        value = spline_value(flat, at, width, xr - np.float32(i), yr - np.float32(j))
        n[x], rest[x] = one, grey[x] - value
    above, below = left[max(y - 1, 0)], left[min(y + 1, rows - 1)]
    # As if the edge were repeated: a difference over one pixel, halved like those over two.
    gx[0], gx[cols - 1] = half * (grey[min(1, cols - 1)] - grey[0]), half * (grey[cols - 1] - grey[max(cols - 2, 0)])
    inner, west, east = gx[1 : cols - 1], grey[: cols - 2], grey[2:]
    for x in range(cols - 2):
        inner[x] = half * (east[x] - west[x])
    for x in range(cols):
        gx[x] *= n[x]
        gy[x] = half * n[x] * (below[x] - above[x])
    for k, (p, q) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, rest), (gy, rest), (rest, rest))):
        product = out[4 + k, radius:end]
        for x in range(cols):
            product[x] = p[x] * q[x]


@njit(cache=True, nogil=True)
def lucas_kanade(left, right, now, keep, window, new):  # type: ignore[no-untyped-def]
    """One mean-free step for every kept pixel, from ``now`` (columns and rows of displacement) to ``new``.

    ``window``: its radius, pixels, and the noise assumed in it, squared grey levels a pixel, float32.

    The gradient is the left image's (inverse compositional form). float32 throughout: every window is summed afresh, so
    nothing adds up. Reach: the window's radius, and of the left image a pixel more.
    """
    rows, cols = left.shape
    radius, noise = window
    size = 2 * radius + 1
    fresh = np.zeros((PLANES, cols + 2 * radius), np.float32)
    ring = np.zeros((size, PLANES * cols), np.float32)
    s = np.empty((PLANES, cols), np.float32)
    total = s.reshape(-1)
    # From above the image on: the ring must hold all rows of the first window before that is solved.
    for y in range(-radius, rows):
        _products(left, right, now, keep, y + radius, radius, fresh)
        _add_up(fresh, cols, ring[(y + radius) % size].reshape((PLANES, cols)))
        if y < 0:
            continue
        _add_rows(ring, y + radius + 1, total)
        least = np.float32(0.5 * size * size)
        row = StepArrays(new.u[y], new.v[y], new.energy[y], new.per_noise[y])
        _solve(s, least, noise, keep[y], (now[0][y], now[1][y]), row)


@njit(cache=True, nogil=True)
def _add_rows(ring, first, total):  # type: ignore[no-untyped-def]
    """Sum of the rows of a ring, from its row ``first`` on."""
    size = ring.shape[0]
    # The usual radius in one pass, in the order of the loop below.
    if size == 5:
        one, two, three = ring[first % size], ring[(first + 1) % size], ring[(first + 2) % size]
        four, five = ring[(first + 3) % size], ring[(first + 4) % size]
        for x in range(total.size):
            total[x] = (one[x] + (two[x] + three[x])) + (four[x] + five[x])
        return
    copy_line(ring[first % size], total)
    for j in range(1, size, 2):
        one, two = ring[(first + j) % size], ring[(first + 1 + j) % size]
        for x in range(total.size):
            total[x] += one[x] + two[x]


@njit(cache=True, nogil=True)
def _solve(s, least, noise, keep, now, new):  # type: ignore[no-untyped-def]
    """Steps of one row from the window sums."""
    (u, v), (new_u, new_v, energy, per_noise) = now, new
    one, nil, far = np.float32(1.0), np.float32(0.0), np.float32(np.inf)
    count, sum_gx, sum_gy, sum_r = s[0], s[1], s[2], s[3]
    sum_gx_gx, sum_gx_gy, sum_gy_gy, sum_gx_r, sum_gy_r, sum_r_r = s[4], s[5], s[6], s[7], s[8], s[9]
    for x in range(u.size):
        use = keep[x] & (count[x] >= least)
        n = count[x] if use else one
        inverse = one / n
        m1, m2, m3 = sum_gx[x] * inverse, sum_gy[x] * inverse, sum_r[x] * inverse
        # Noise on the diagonal shortens steps where texture is weak.
        a = sum_gx_gx[x] - sum_gx[x] * m1 + noise * n
        b = sum_gx_gy[x] - sum_gx[x] * m2
        c = sum_gy_gy[x] - sum_gy[x] * m2 + noise * n
        p = sum_gx_r[x] - sum_gx[x] * m3
        q = sum_gy_r[x] - sum_gy[x] * m3
        # A window of noise alone has a determinant of at least (noise n)^2.
        det = a * c - b * b
        good = use & (det > nil)
        inverse_det = one / (det if det > nil else one)
        du, dv = (c * p - b * q) * inverse_det, (a * q - b * p) * inverse_det
        # Rounding may leave the residual of a perfect fit below zero.
        energy[x] = max(sum_r_r[x] - sum_r[x] * m3, nil) * inverse if use else far
        per_noise[x] = c * inverse_det if good else nil
        # A pixel at most, as ``refine.drift`` counts on.
        new_u[x] = u[x] + (min(max(du, -one), one) if good else nil)
        new_v[x] = v[x] + (min(max(dv, -one), one) if good else nil)
