"""Removal of the perspective bias: mean-free Lucas-Kanade steps against the right image warped by the disparities.

Feature vectors compare upright windows; where the two views foreshorten a surface differently their best displacement
is biased. Warping the right image by the smoothed disparities first makes the windows alike, and what is left is a
small displacement, solved per window. A pixel keeps the step only if it makes its window fit better.

Steps use the left image's gradient, so they are taken in the frame of the aligned right image, where neighbours move
alike even between turned views; grey values are read from the right image itself, which is interpolated only once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.geometry.spline import weights
from rille.stages.numeric.windows import window_sum32

Frame = Callable[[AnyArray, AnyArray], tuple[AnyArray, AnyArray]]
"""Displacements to the right image of those in the frame in which steps are taken, both (row, col) float32 pixels."""

WINDOW_RADIUS_PX = 2
"""Pixels: the windows are 5 x 5; larger ones have less noise, and smooth small relief away."""

ASSUMED_NOISE_VARIANCE = 8.0
"""Assumed noise, squared grey levels per pixel: it shortens steps where texture is weak."""

SUM_PLANES = 10

CORRELATION_SIDE_PX = 9
"""Pixels: fewer do not tell correlated noise from texture."""

MAX_CORRECTION_PX = 1.5
"""Pixels: a correction beyond this is a jump to something else."""

NOISE_TEXTURE_RATIO = 0.4
"""Local deviation for each grey level of noise that was removed from the left image, up to which it may be noise alone,
of which denoising leaves about .3."""


class Refined(NamedTuple):
    """Displacements (row, col) float32, the mean-free residual variance of their windows, squared grey levels (inf:
    none), and the variance of the column displacement for a unit of variance of the grey levels."""

    u: AnyArray
    v: AnyArray
    rest: AnyArray
    per_noise: AnyArray


class SplineImages(NamedTuple):
    """Grey values of the left image, coefficients of the right one's cubic spline (float32), right mask (uint8)."""

    left: AnyArray
    spline: AnyArray
    valid: AnyArray


def refine(
    images: SplineImages, to_right: Frame, start: tuple[AnyArray, AnyArray], keep: AnyArray, steps: int
) -> Refined:
    """Displacements without the perspective bias, in the frame in which they are given.

    Parameters
    ----------
    to_right : from the frame in which steps are taken to the right image.
    start : (row, col) float32, smoothed displacements, pixels.
    keep : (row, col) bool, pixels that have one.
    """
    (now_u, now_v), first = start, None
    for _ in range(steps):
        there = to_right(now_u, now_v)
        step_u, step_v, last, per_noise = (np.empty(keep.shape, np.float32) for _ in range(4))
        _step(images, there, keep, (step_u, step_v, last, per_noise))
        first = last if first is None else first
        # The same arrays mean no alignment, and nothing to convert.
        if there[0] is not now_u:
            step_u, step_v = now_u + (step_u - there[0]), now_v + (step_v - there[1])
        now_u, now_v = local_mean(step_u, step_v, keep, 1, 1)
    _take_back(start, first, (now_u, now_v), last)
    return Refined(now_u, now_v, last, per_noise)


def local_mean(u: AnyArray, v: AnyArray, keep: AnyArray, radius: int, stride: int) -> tuple[AnyArray, AnyArray]:
    """Means of the kept pixels in a window whose displacement lies within one pixel of the middle's.

    The window reaches ``radius`` pixels, of which each ``stride``-th from its border on takes part.
    """
    out = np.empty_like(u), np.empty_like(v)
    _local_mean(u, v, keep, (radius, stride), out)
    return out


@njit(cache=True, nogil=True)
def _local_mean(u, v, keep, window, out):  # type: ignore[no-untyped-def]
    (radius, stride), (out_u, out_v) = window, out
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
def _products(images, now, keep, y, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of the planes whose window sums a step needs, zero where a pixel takes no part.

    ``out`` (SUM_PLANES, radius + col + radius): count, gx, gy, r, gx gx, gx gy, gy gy, gx r, gy r, r r, with the
    gradient of the left image. Reach: a pixel.
    """
    left, spline, valid = images.left, images.spline, images.valid
    (rows, cols), (rrows, rcols) = left.shape, spline.shape
    (u, v), radius = now, WINDOW_RADIUS_PX
    if y < 0 or y >= rows:
        out[:] = np.float32(0.0)
        return
    one, half, nil = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    # A spline reads one coefficient before and two after.
    last_x, last_y = np.float32(rcols - 2), np.float32(rrows - 2)
    end = radius + cols
    n, gx, gy, rest = out[0, radius:end], out[1, radius:end], out[2, radius:end], out[3, radius:end]
    lu, lv, grey = u[y], v[y], left[y]
    flat, taking = spline.reshape(-1), keep[y]
    for x in range(cols):
        xr, yr = np.float32(x) + lu[x], np.float32(y) + lv[x]
        n[x] = rest[x] = nil
        if not (taking[x] and xr >= one and xr < last_x and yr >= one and yr < last_y):
            continue
        if not valid[np.uint64(yr + half), np.uint64(xr + half)]:
            continue
        i, j = np.int64(xr), np.int64(yr)
        value = spline_value(flat, j * rcols + i, rcols, xr - np.float32(i), yr - np.float32(j))
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
def _step(images, now, keep, new):  # type: ignore[no-untyped-def]
    """One mean-free step for every kept pixel, from ``now`` (columns and rows of displacement) to ``new``.

    ``new``: displacements, residual variance before the step (inf: none), variance for a unit of variance of the grey
    levels. The gradient is the left image's (inverse compositional form). float32 throughout: every window is summed
    afresh, so nothing adds up. Reach: the window's radius, and of the left image a pixel more.
    """
    rows, cols = keep.shape
    size = 2 * WINDOW_RADIUS_PX + 1
    fresh = np.zeros((SUM_PLANES, cols + 2 * WINDOW_RADIUS_PX), np.float32)
    ring = np.zeros((size, SUM_PLANES, cols), np.float32)
    total = np.empty((SUM_PLANES, cols), np.float32)
    # From above the image on: the ring must hold all rows of the first window before that is solved.
    for y in range(-WINDOW_RADIUS_PX, rows):
        _products(images, now, keep, y + WINDOW_RADIUS_PX, fresh)
        for k in range(SUM_PLANES):
            part, out = fresh[k], ring[(y + WINDOW_RADIUS_PX) % size, k]
            one, two, three, four = part[1 : 1 + cols], part[2 : 2 + cols], part[3 : 3 + cols], part[4:]
            for x in range(cols):
                out[x] = (part[x] + (one[x] + two[x])) + (three[x] + four[x])
        if y < 0:
            continue
        first = y + WINDOW_RADIUS_PX + 1
        for k in range(SUM_PLANES):
            one, two, three = ring[first % size, k], ring[(first + 1) % size, k], ring[(first + 2) % size, k]
            four, five, out = ring[(first + 3) % size, k], ring[(first + 4) % size, k], total[k]
            for x in range(cols):
                out[x] = (one[x] + (two[x] + three[x])) + (four[x] + five[x])
        _solve(total, keep[y], y, now, new)


@njit(cache=True, nogil=True)
def _solve(s, keep, y, now, new):  # type: ignore[no-untyped-def]
    """Steps of row ``y`` from the window sums."""
    u, v = now[0][y], now[1][y]
    new_u, new_v, energy, per_noise = new[0][y], new[1][y], new[2][y], new[3][y]
    noise, least = np.float32(ASSUMED_NOISE_VARIANCE), np.float32(0.5 * (2 * WINDOW_RADIUS_PX + 1) ** 2)
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
        # A pixel at most: beyond it the step is a guess.
        new_u[x] = u[x] + (min(max(du, -one), one) if good else nil)
        new_v[x] = v[x] + (min(max(dv, -one), one) if good else nil)


@njit(cache=True, nogil=True)
def _take_back(start, first, new, last):  # type: ignore[no-untyped-def]
    """Start displacements and residuals where steps led far or away from a fit."""
    (u, v), (new_u, new_v), farthest = start, new, np.float32(MAX_CORRECTION_PX)
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            du, dv = new_u[y, x] - u[y, x], new_v[y, x] - v[y, x]
            # After a single step both are one array (residuals are those before it): the distance alone counts.
            better = (last[y, x] <= first[y, x]) & (du * du + dv * dv <= farthest * farthest)
            new_u[y, x] = new_u[y, x] if better else u[y, x]
            new_v[y, x] = new_v[y, x] if better else v[y, x]
            last[y, x] = last[y, x] if better else first[y, x]


def surroundings(
    rest: AnyArray, deviation: AnyArray, keep: AnyArray, noise: tuple[float, float]
) -> tuple[AnyArray, AnyArray]:
    """Correlation of the left image with the warped right one over a wider window, and the residual variance there.

    Both (row, col) float32; correlation 1 and residual 0 where not known. From the residual variance ``rest`` and the
    left image's local ``deviation``: two signals of equal variance s^2 and correlation r differ by 2 s^2 (1 - r).
    Noise that found noise to match, in a shadow or the sky, gives itself away. ``noise``: variances that the left and
    the right image's noise had before they were denoised. What the noise explains of s^2 and of the difference is then
    left out, if that makes them more alike and the left image shows more than noise.
    """
    known = keep & (rest < np.inf)
    nil = np.float32(0.0)
    planes = np.where(known, rest, nil), np.where(known, deviation * deviation, nil), known.astype(np.float32)
    sums = tuple(window_sum32(plane, CORRELATION_SIDE_PX) for plane in planes)
    correlation, around = np.empty_like(rest), np.empty_like(rest)
    _correlation(sums, (np.float32(noise[0]), np.float32(noise[0] + noise[1])), correlation, around)
    return correlation, around


@njit(cache=True, nogil=True)
def _correlation(sums, noise, correlation, around):  # type: ignore[no-untyped-def]
    one, two, least, nil = np.float32(1.0), np.float32(2.0), np.float32(1e-6), np.float32(0.0)
    own, both = noise
    texture = np.float32(NOISE_TEXTURE_RATIO * NOISE_TEXTURE_RATIO)
    for y in range(correlation.shape[0]):
        differ, power, count = sums[0][y], sums[1][y], sums[2][y]
        for x in range(correlation.shape[1]):
            with_noise = one - differ[x] / max(two * power[x], least)
            difference, signal = max(differ[x] - both * count[x], nil), power[x] - own * count[x]
            textured = power[x] > texture * own * count[x]
            without = one - difference / max(two * signal, least) if textured else with_noise
            correlation[y, x] = max(with_noise, without) if power[x] > 0 else one
            around[y, x] = differ[x] / max(count[x], one)
