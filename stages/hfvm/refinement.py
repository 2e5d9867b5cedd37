"""Refinement of displacements, by windows and by a relief through all of them; and their standard deviations.

**Windows.** Mean-free Lucas-Kanade steps against the right image warped by the disparities remove the perspective
bias.

Feature vectors compare upright windows; where the two views foreshorten a surface differently their best displacement
is biased. Warping the right image by the smoothed disparities makes the windows alike, and leaves a small displacement,
solved per window. A pixel keeps the step only if it improves the fit of its window.

Steps are computed in the frame of the aligned right image, where neighbours have similar displacements even between
turned views; grey values and gradients are those of the spline through the right image itself, so that it is
interpolated only once.

**Relief.** Displacements of all matches at once, piecewise smooth and along epipolar lines.

Windows trade noise against relief, and each solves for a row displacement that the geometry of the rig already knows.
Here the displacements (u, v) of all matched pixels minimise

    sum w (r - g . (du, dv))^2  +  k (distance from the epipolar line)^2  +  stiffness sum s |second difference|^2

with r the difference of the left image and the right one warped by the last step, free of its robust local mean; g the
warped gradient, both of the cubic spline through the pixels, which keeps detail that a local cubic kernel blurs; w
falling with r and s with the second difference, so that neither a wrong pixel nor an edge pulls its neighbours.
Stiffness begins weak and tolerant of bends: at full strength it would keep the errors of windows beside edges as
relief. The lines are fitted to the matches themselves (:mod:`rille.stages.hfvm.epipolar`); k is reduced where matches
do not lie on lines. Solved by a fixed number of Gauss-Seidel sweeps in reading order.

**Standard deviations** of the column disparities, or of the rows' where epipolar lines run along the columns, are
computed from figures of each pixel.

The error of a disparity is taken as the sum of independent parts, so that variances add:

    std^2 = floor^2 + noise^2 N + relief^2 R + border^2 M

N: variance of the least-squares displacement of the 5 x 5 window (the Cramer-Rao bound: residual variance after
refinement, times the element of the inverse structure tensor for the column, or the row). A window along a column edge
has a small one, a window along a row edge a large one. R: mean square, in the 5 x 5 window, of how far a disparity
lies from the mean of the four two pixels away (0 on a plane); errors of neighbours differ, and a window on relief or a
depth edge mixes the surfaces in it. M: share of unmatched pixels in 9 x 9; beside occlusions and failed matches a match
is often drawn to the wrong surface. The floor stands for errors that no pixel shows: sampling, lenses, the matcher's
own sub-pixel bias.

Of the pixels with similar N, R and M, 68 % err by less than one standard deviation and 95 % by less than two. So the
standard deviation is no root mean square: a few mismatches (a repeated pattern, a hidden pixel that resembles another)
err by ten and more, no feature reveals them, and no finite variance covers them. Back-matching error and feature
distance add nothing once N, R and M are known; their fitted factors were zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.geometry.spline import value_and_gradient
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import thinned
from rille.stages.numeric.relaxation import OVERRELAXATION
from rille.stages.numeric.windows import window_count, window_room, window_sum, window_sum32

Maps = tuple[AnyArray, AnyArray]
Frame = Callable[[AnyArray, AnyArray], Maps]
"""Displacements to the right image of those in the frame in which steps are taken, both (row, col) float32 pixels."""

WINDOW_RADIUS_PX = 2
"""Pixels: the windows are 5 x 5; larger ones have less noise, and smooth small relief away."""

MAX_CORRECTION_PX = 1.5
"""Pixels: a larger correction is a jump to another match."""


class Refined(NamedTuple):
    """Displacements (row, col) float32; the mean-free residual variance of their windows, squared grey levels (inf:
    none); and the variance of the column displacement (or the row's) for grey values of unit variance."""

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
    images: SplineImages, to_right: Frame, start: Maps, keep: AnyArray, steps: int, upright: bool = False
) -> Refined:
    """Displacements without the perspective bias, in the frame of ``start``.

    Parameters
    ----------
    to_right : from the frame in which steps are taken to the right image.
    start : (row, col) float32, smoothed displacements, pixels.
    keep : (row, col) bool, pixels that have one.
    upright : whether the variance is that of the row displacement.
    """
    now, rests, axes = start, list[AnyArray](), _axes(to_right, start)
    for _ in range(steps):
        planes = np.empty((4, *keep.shape), np.float32)
        _window_steps(images, to_right(*now), axes, keep, planes, upright)
        step_u, step_v, rest, per_noise = planes
        rests.append(rest)
        now = local_mean(now[0] + step_u, now[1] + step_v, keep, 1, 1)
    _take_back(start, rests[0], now, rests[-1])
    return Refined(*now, rests[-1], per_noise)


@njit(cache=True, nogil=True)
def _take_back(start, first, new, last):  # type: ignore[no-untyped-def]
    """Restore displacements and residuals where the steps led too far, or to a worse fit.

    Residuals are those before a step: after a single one ``last`` is ``first``, and the distance alone counts.
    """
    (u, v), (new_u, new_v), farthest = start, new, np.float32(MAX_CORRECTION_PX**2)
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            du, dv = new_u[y, x] - u[y, x], new_v[y, x] - v[y, x]
            better = (last[y, x] <= first[y, x]) & (du * du + dv * dv <= farthest)
            new_u[y, x] = new_u[y, x] if better else u[y, x]
            new_v[y, x] = new_v[y, x] if better else v[y, x]
            last[y, x] = last[y, x] if better else first[y, x]


@njit(cache=True, nogil=True)
def local_mean(u, v, keep, radius, stride):  # type: ignore[no-untyped-def]
    """Mean displacements of the kept pixels of each window that lie within one pixel of the middle's displacement.

    The window reaches ``radius`` pixels, of which each ``stride``-th from its border on takes part. ``u, v``: (row,
    col) float32; ``keep``: bool.
    """
    out_u, out_v, (rows, cols) = np.empty_like(u), np.empty_like(v), u.shape
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
                cu, cv, ok = u[y, a:b], v[y, a:b], keep[j, a + i : b + i]
                ou, ov = u[j, a + i : b + i], v[j, a + i : b + i]
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
    return out_u, out_v


def _axes(to_right: Frame, now: Maps) -> AnyArray:
    """Where a column and a row of the frame of steps lead in the right image, which may be turned and scaled against
    it: planes (4, row, col) float32, (4, 0, 0) where both frames are one."""
    there = to_right(*now)
    if there[0] is now[0]:
        return np.empty((4, 0, 0), np.float32)
    ends = *to_right(now[0] + 1, now[1]), *to_right(now[0], now[1] + 1)
    return np.stack([end - begin for end, begin in zip(ends, 2 * there, strict=True)])


@njit(cache=True, nogil=True)
def _window_steps(images, now, axes, keep, out, upright):  # type: ignore[no-untyped-def]
    """Steps of all windows; each is summed afresh, so that nothing adds up. Reach: the window's radius.

    ``out``: planes (4, row, col): columns and rows, zero where there is no step; residual variance before the step,
    infinite where there is none; and the variance of the column, or the row, for a unit of variance of the grey levels.
    """
    (rows, cols), radius, size = keep.shape, WINDOW_RADIUS_PX, 2 * WINDOW_RADIUS_PX + 1
    fresh, total = np.zeros((10, cols + 2 * radius), np.float32), np.empty((10, cols), np.float32)
    ring = np.zeros((size, 10, cols), np.float32)
    # From above the image on: the ring must hold all rows of the first window before that is solved.
    for y in range(-radius, rows):
        row = ring[(y + radius) % size]
        _products(images, now, axes, keep, y + radius, fresh[:, radius : radius + cols])
        for k in range(10):
            part, line = fresh[k], row[k]
            for x in range(cols):
                line[x] = (part[x] + (part[x + 1] + part[x + 2])) + (part[x + 3] + part[x + 4])
        if y >= 0:
            for k in range(10):
                a, b, c, d, e, line = ring[0, k], ring[1, k], ring[2, k], ring[3, k], ring[4, k], total[k]
                for x in range(cols):
                    line[x] = (a[x] + (b[x] + c[x])) + (d[x] + e[x])
            _solve_windows(total, keep[y], out[:, y], upright)


@njit(cache=True, nogil=True)
def _products(images, now, axes, keep, y, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of the planes (10, col) that are summed: count, gx, gy, r, gx gx, gx gy, gy gy, gx r, gy r, r r; zero
    where a pixel takes no part."""
    out[:] = np.float32(0.0)
    if y < len(keep):
        warp_row(images, now[0], now[1], keep, y, out)
        count, gx, gy, rest = out[0], out[1], out[2], out[3]
        if axes.size:
            for x in range(gx.size):
                if count[x] > 0:
                    along = gx[x] * axes[0, y, x] + gy[x] * axes[1, y, x]
                    gx[x], gy[x] = along, gx[x] * axes[2, y, x] + gy[x] * axes[3, y, x]
        for k, (p, q) in enumerate(((gx, gx), (gx, gy), (gy, gy), (gx, rest), (gy, rest), (rest, rest))):
            product = out[4 + k]
            for x in range(gx.size):
                product[x] = p[x] * q[x]


@njit(cache=True, nogil=True)
def _solve_windows(sums, keep, out, upright):  # type: ignore[no-untyped-def]
    """Steps of a row from the sums (10, col) over each pixel's window."""
    # Assumed noise, 8 squared grey levels a pixel, shortens steps where texture is weak.
    noise, least = np.float32(8.0), np.float32(0.5 * (2 * WINDOW_RADIUS_PX + 1) ** 2)
    one, nil, far = np.float32(1.0), np.float32(0.0), np.float32(np.inf)
    for x in range(keep.size):
        n = max(sums[0, x], one)
        use = keep[x] & (n >= least)
        sum_gx, sum_gy, sum_r = sums[1, x], sums[2, x], sums[3, x]
        # Noise on the diagonal shortens steps where texture is weak, and keeps the determinant positive.
        a = sums[4, x] - sum_gx * sum_gx / n + noise * n
        b = sums[5, x] - sum_gx * sum_gy / n
        c = sums[6, x] - sum_gy * sum_gy / n + noise * n
        p, q = sums[7, x] - sum_gx * sum_r / n, sums[8, x] - sum_gy * sum_r / n
        det = a * c - b * b
        # A pixel at most: beyond it the step is a guess.
        out[0, x] = min(max((c * p - b * q) / det, -one), one) if use else nil
        out[1, x] = min(max((a * q - b * p) / det, -one), one) if use else nil
        # Rounding may leave the residual of a perfect fit below zero.
        out[2, x] = max(sums[9, x] - sum_r * sum_r / n, nil) / n if use else far
        out[3, x] = (a if upright else c) / det if use else nil


def _warped(images: SplineImages, u: AnyArray, v: AnyArray, keep: AnyArray) -> AnyArray:
    """Planes (4, row, col), zero where a pixel takes no part: 1, gradient (x, y) of the right image, left minus it."""
    planes = np.zeros((4, *u.shape), np.float32)
    for y in range(len(u)):
        warp_row(images, u, v, keep, y, planes[:, y])
    return planes


@njit(cache=True, nogil=True)
def warp_row(images, u, v, keep, y, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of :func:`_warped`; ``out`` (4, col) comes as zeros."""
    spline, half = images.spline, np.float32(0.5)
    last_x, last_y = spline.shape[1] - 2, spline.shape[0] - 2
    for x in range(u.shape[1]):
        xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
        if not (keep[y, x] and xr >= 1 and xr < last_x and yr >= 1 and yr < last_y):
            continue
        # Unsigned indices need no check for counting from the end.
        if not images.valid[np.uint64(yr + half), np.uint64(xr + half)]:
            continue
        value, gx, gy = value_and_gradient(spline, xr, yr)
        out[0, x], out[1, x], out[2, x], out[3, x] = 1, gx, gy, images.left[y, x] - value


def surroundings(rest: AnyArray, deviations: Maps, keep: AnyArray, noise: tuple[float, float]) -> Maps:
    """Correlation of the left image with the warped right one over a wider window, and the residual variance there.

    Both (row, col) float32; correlation 1 and residual 0 where unknown. They follow from the residual variance ``rest``
    and the local ``deviations`` of the left image and of the right one at the matches: signals of deviations a and b
    and correlation r differ by a^2 + b^2 - 2 r a b. Matches of noise with noise, in a shadow or the sky, correlate
    little. ``noise``: variances of the noise of both images before they were denoised; these are subtracted from a^2,
    b^2 and the difference, if that raises the correlation and the left image shows more than noise.
    """
    known = keep & (rest < np.inf)
    nil = np.float32(0.0)
    planes = (*(np.where(known, a, nil) for a in (rest, *(d * d for d in deviations))), known.astype(np.float32))
    # Fewer pixels do not tell correlated noise from texture.
    sums = tuple(window_sum32(plane, 9) for plane in planes)
    correlation, around = np.empty_like(rest), np.empty_like(rest)
    _correlation(sums, (np.float32(noise[0]), np.float32(noise[1])), correlation, around)
    return correlation, around


@njit(cache=True, nogil=True)
def _correlation(sums, noise, correlation, around):  # type: ignore[no-untyped-def]
    nil, one = np.float32(0.0), np.float32(1.0)
    # 0.4: local deviation for each grey level of noise that was removed from the left image, up to which it may be
    # noise alone, of which denoising leaves about .3.
    texture = np.float32(0.4 * 0.4)
    for y in range(correlation.shape[0]):
        differ, left, right, count = sums[0][y], sums[1][y], sums[2][y], sums[3][y]
        for x in range(correlation.shape[1]):
            n, a, b = count[x], left[x], right[x]
            found = _alike(differ[x], a, b)
            if a > texture * noise[0] * n:
                rest = max(differ[x] - (noise[0] + noise[1]) * n, nil)
                found = max(found, _alike(rest, a - noise[0] * n, b - noise[1] * n))
            correlation[y, x] = found if a > 0 else one
            around[y, x] = differ[x] / max(n, one)


@njit(cache=True, nogil=True, inline="always")
def _alike(differ, a, b):  # type: ignore[no-untyped-def]
    """Correlation of signals of the variances ``a, b`` whose difference has the variance ``differ``."""
    least = np.float32(1e-6)
    a, b = max(a, least), max(b, least)
    return (a + b - differ) / (np.float32(2.0) * np.sqrt(a * b))


BEND_STIFFNESS = 2000.0
"""Cost, squared grey levels, of a bend of one pixel; larger: smoother, small relief lost."""

MAX_BEND_PX = 0.05
"""Second difference, pixels, beyond which the stiffness gives way to an edge."""


def fit_relief(images: SplineImages, u: AnyArray, v: AnyArray, keep: AnyArray) -> Maps:
    """Displacements of the relief that fits best.

    Parameters
    ----------
    u, v : (row, col) float32 displacements to start from, pixels.
    keep : (row, col) bool, pixels to use and to improve; the others are returned as they are.

    Notes
    -----
    A pixel that is led farther than :data:`MAX_CORRECTION_PX` from where it started
    stays there. Only the way along its line counts: a match that was found rows off its line is on the same thing more
    often than not, and the lines know its row.
    """
    start_u, start_v = u, v
    u, v = np.where(keep, u, np.float32(0)), np.where(keep, v, np.float32(0))
    lines, trust = _lines(u, v, keep, images.spline.shape)
    # 1000.0 squared grey levels for a pixel off the line: more than the strongest texture says.
    holds = lines * np.float32(np.sqrt(1000.0 * trust))
    # Four steps instead of seven: the median error of the judged half is .165 px instead of .160.
    for soft in (True, True, False, False):
        stiffness, bend = BEND_STIFFNESS * (0.15 if soft else 1.0), MAX_BEND_PX * (2.0 if soft else 1.0)
        grey = _grey(images, u, v, keep)
        stiff = _stiffness(u, v, keep, np.float32(bend), np.float32(stiffness))
        normal = np.zeros((5, *u.shape), np.float32)
        _normal(grey, u, v, holds, keep, stiff, normal)
        u, v = _relax(normal, stiff, u, v)
    if trust > 0:
        start_u, start_v = _feet(lines, trust, start_u, start_v, keep)
    good = keep & (np.hypot(u - start_u, v - start_v) <= MAX_CORRECTION_PX)
    return np.where(good, u, start_u), np.where(good, v, start_v)


def _grey(images: SplineImages, u: AnyArray, v: AnyArray, keep: AnyArray) -> AnyArray:
    """Planes (4, row, col): weight of each pixel (0: unused), gradient (x, y) of the warped right image, and difference
    of the images less its local mean."""
    planes = _warped(images, u, v, keep)
    known, _, _, rest = planes
    mean, weight = np.zeros_like(rest), known
    # The first mean has equal weights; the later ones give pixels across an edge little weight.
    for _ in range(3):
        # A window with less weight than a tenth of a pixel has no pixel in use.
        # 9 pixels: window of the local mean; brightness varies more slowly.
        mean = window_sum(weight * rest, 9) / np.maximum(window_sum(weight, 9), 0.1)
        # 10.0 grey levels: residual that halves a pixel's weight, well above camera noise.
        weight = known / (np.float32(1.0) + ((rest - mean) * np.float32(1.0 / 10.0)) ** 2)
    planes[0] = weight
    planes[3] -= mean
    return planes


def _lines(u: AnyArray, v: AnyArray, keep: AnyArray, right_shape: tuple[int, int]) -> tuple[AnyArray, float]:
    """Epipolar lines (row, col, 3) fitted to the matches, and trust in them, 0..1: 0 if undetermined or bent."""
    y, x = thinned(keep, 4000)
    fit = epipolar.fit_points(x, y, u[y, x], v[y, x], keep.shape, right_shape)
    if fit is None:
        return np.zeros((*u.shape, 3), np.float32), 0.0
    lines = epipolar.lines(fit[0], u.shape)
    # Clipped, so that a patch of wrong matches does not count as a bend.
    off = np.clip(lines[..., 0] * u + lines[..., 1] * v + lines[..., 2], -0.5, 0.5)
    off = np.where(keep, off, np.float32(0))
    # 65 pixels: side of a neighbourhood; where lenses bend the lines its matches lie off them to one side.
    bent = (window_sum32(off, 65) / np.maximum(window_count(keep, 65), 1))[y, x]
    # 0.05 pixels: median distance from the lines up to which they are trusted fully; beyond it by its inverse square.
    trust = min(1.0, (0.05 / max(fit[1], 1e-9)) ** 2)
    # 0.1 pixels: median of those means up to which the lines are trusted; noise has .02.
    return lines, trust if epipolar.typical(bent) <= 0.1 else 0.0


def _feet(lines: AnyArray, trust: float, u: AnyArray, v: AnyArray, keep: AnyArray) -> Maps:
    """Displacements with the kept ones moved towards their lines, by the share ``trust`` of the distance."""
    off = lines[..., 0] * u + lines[..., 1] * v + lines[..., 2]
    e = np.where(keep, np.float32(trust) * off, np.float32(0))
    return u - e * lines[..., 0], v - e * lines[..., 1]


def _stiffness(u: AnyArray, v: AnyArray, keep: AnyArray, bend: np.float32, stiffness: np.float32) -> AnyArray:
    """Weights (2, row, col) of the second difference at each pixel along its row and column, 0 where a neighbour is
    unknown."""
    planes = np.zeros((2, *u.shape), np.float32)
    before, here, after = slice(None, -2), slice(1, -1), slice(2, None)
    for out, a, b, there in ((planes[0], u, v, keep), (planes[1].T, u.T, v.T, keep.T)):
        d, e = (m[:, before] - m[:, here] + m[:, after] - m[:, here] for m in (a, b))
        weight = stiffness / (np.float32(1.0) + (d * d + e * e) / (bend * bend))
        np.copyto(out[:, here], weight, where=there[:, before] & there[:, here] & there[:, after])
    return planes


@njit(cache=True, nogil=True)
def _normal(grey, u, v, holds, keep, stiff, out):  # type: ignore[no-untyped-def]
    """Inverted normal equations of each pixel, for the sweeps: (m n; n o) (u, v) = (p, q) + terms of its neighbours.

    ``out`` (5, row, col): o / det, n / det, m / det, p, q; zero where a pixel stays as it is. ``grey``: of
    :func:`_grey`; ``holds``: lines whose distance is in grey levels.
    """
    rows, cols = u.shape
    four = np.float32(4.0)
    for y in range(rows):
        for x in range(cols):
            if not keep[y, x]:
                continue
            w, gx, gy, rest = grey[0, y, x], grey[1, y, x], grey[2, y, x], grey[3, y, x]
            lx, ly, off = holds[y, x, 0], holds[y, x, 1], holds[y, x, 2]
            a, b, c = w * gx * gx + lx * lx, w * gx * gy + lx * ly, w * gy * gy + ly * ly
            # Of the squared distance from the line only its offset is left: the displacement itself cancels.
            warp = gx * u[y, x] + gy * v[y, x] + rest
            p, q = w * gx * warp - lx * off, w * gy * warp - ly * off
            s = four * (stiff[0, y, x] + stiff[1, y, x])
            s += (stiff[0, y, x - 1] if x > 0 else 0) + (stiff[0, y, x + 1] if x < cols - 1 else 0)
            s += (stiff[1, y - 1, x] if y > 0 else 0) + (stiff[1, y + 1, x] if y < rows - 1 else 0)
            m, o = a + s, c + s
            det = m * o - b * b
            # Else hardly any texture, line or neighbour holds the pixel, and it stays.
            if det > np.float32(1.0):
                out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x], out[4, y, x] = o / det, b / det, m / det, p, q


def _relax(normal: AnyArray, stiff: AnyArray, u: AnyArray, v: AnyArray) -> Maps:
    """Displacements after ten Gauss-Seidel sweeps; zeros stand for the neighbours of the border."""
    u, v, across, down = (np.pad(a, 2) for a in (u, v, *stiff))
    _sweep(normal, across, down, u, v)
    return np.ascontiguousarray(u[2:-2, 2:-2]), np.ascontiguousarray(v[2:-2, 2:-2])


@njit(cache=True, nogil=True)
def _sweep(normal, across, down, u, v):  # type: ignore[no-untyped-def]
    """Gauss-Seidel sweeps on ``u, v`` in place; all but ``normal`` have a frame of two pixels.

    A pixel takes part in three second differences of its row and three of its column: as their middle, where it counts
    twice, and as either end. ``su``, ``sv``: the weighted values that they want.
    """
    _, rows, cols = normal.shape
    two, overshoot = np.float32(2.0), np.float32(OVERRELAXATION)
    for _ in range(10):
        for y in range(rows):
            minor_v, cross, minor_u, p, q = normal[0, y], normal[1, y], normal[2, y], normal[3, y], normal[4, y]
            k, k_up, k_own, k_down = across[y + 2], down[y + 1, 2:], down[y + 2, 2:], down[y + 3, 2:]
            uo, u1, u2, u3, u4 = u[y + 2], u[y, 2:], u[y + 1, 2:], u[y + 3, 2:], u[y + 4, 2:]
            vo, v1, v2, v3, v4 = v[y + 2], v[y, 2:], v[y + 1, 2:], v[y + 3, 2:], v[y + 4, 2:]
            for x in range(cols):
                # Zero marks a pixel that stays: elsewhere it is positive.
                if minor_v[x] == 0:
                    continue
                kw, ko, ke, ku, kc, kd = k[x + 1], two * k[x + 2], k[x + 3], k_up[x], two * k_own[x], k_down[x]
                su = p[x] + (kc * (u2[x] + u3[x]) + ku * (two * u2[x] - u1[x]) + kd * (two * u3[x] - u4[x]))
                sv = q[x] + (kc * (v2[x] + v3[x]) + ku * (two * v2[x] - v1[x]) + kd * (two * v3[x] - v4[x]))
                su += ke * (two * uo[x + 3] - uo[x + 4]) + ko * uo[x + 3] - kw * uo[x] + (ko + two * kw) * uo[x + 1]
                sv += ke * (two * vo[x + 3] - vo[x + 4]) + ko * vo[x + 3] - kw * vo[x] + (ko + two * kw) * vo[x + 1]
                uo[x + 2] += overshoot * (minor_v[x] * su - cross[x] * sv - uo[x + 2])
                vo[x + 2] += overshoot * (minor_u[x] * sv - cross[x] * su - vo[x + 2])


BLANK_STD_PX = 0.2
"""Standard deviation (pixels) added to matches of textureless regions, which the parts below do not contain."""

# Factors of the parts. For each of several floors ``benchmarks/disparity_std.py --fit`` found the others on four mockup
# pairs (seeds 1, 2 and 6, and seed 7 with noise of 4 grey levels); the floor, which no simulated lens shows, is the one
# with which the five photographed pairs that are for choosing come nearest to 68 %: 66 %, and 89 % below twice of it
# (70 and 92 % without one whose truth lies .15 px beside all matchers). On other mockup seeds: 70 and 91 %. 2026-11-25.
# The relief of preset ``accurate`` errs less: its standard deviations are too great.
FLOOR_PX = 0.13
NOISE_FACTOR = 0.41


def standard_deviation(noise: AnyArray, disparity: AnyArray, keep: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Standard deviation of matched disparities of one axis.

    Parameters
    ----------
    noise : (row, col) float32, part N of every pixel, squared pixels.
    disparity : (row, col) float32 pixels.
    keep : (row, col) bool, matched pixels.

    Returns
    -------
    (row, col) float32 pixels, NaN where not matched.
    """
    relief, border = neighbours(disparity, keep)
    variance = np.float32(FLOOR_PX**2) + np.float32(NOISE_FACTOR**2) * noise
    variance += np.float32(1.71**2) * relief + np.float32(0.80**2) * border
    return np.where(keep, np.sqrt(variance), np.float32(np.nan))


def neighbours(disparity: AnyArray, keep: NDArray[np.bool_]) -> Maps:
    """Parts R and M of every pixel (row, col), see the module; meaningless where not matched."""
    radius = WINDOW_RADIUS_PX  # that of sub-pixel search and refinement
    side, bend = 2 * radius + 1, np.zeros(keep.shape, np.float32)
    near, far, here = slice(None, -2 * radius), slice(2 * radius, None), slice(radius, -radius)
    sides = disparity[near, here] + disparity[far, here] + disparity[here, near] + disparity[here, far]
    bend[here, here] = disparity[here, here] - np.float32(0.25) * sides
    # All five are matched, and in the image.
    five = np.zeros((side, side), np.uint8)
    five[radius, ::radius] = five[::radius, radius] = 1
    use = cv2.erode(keep.view(np.uint8), five, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    bend *= use
    relief, count = window_sum32(bend * bend, side), np.maximum(window_count(use.view(bool), side), 1)
    # 9 pixels: side of the window in which unmatched pixels count; about the reach of features and windows together.
    missing, room = window_count(~keep, 9), window_room(keep.shape, 9)
    share = np.divide(missing, room, dtype=np.float32, casting="same_kind")
    return np.divide(relief, count, dtype=np.float32, casting="same_kind"), share
