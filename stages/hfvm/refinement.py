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
do not lie on lines. Solved by a fixed number of sweeps (:mod:`rille.stages.numeric.relaxation`), in turn for the way
along the lines and for that off them.

**Standard deviations** of the column disparities, or of the rows' where epipolar lines run along the columns, are
computed from figures of each pixel.

The error of a disparity is taken as the sum of independent parts, so that variances add:

    std^2 = floor^2 + (1 + 4 r)^2 (noise^2 N + relief^2 R + border^2 M)

N: variance of the least-squares displacement of the 5 x 5 window (the Cramer-Rao bound: residual variance after
refinement, times the element of the inverse structure tensor for the column, or the row). A window along a column edge
has a small one, a window along a row edge a large one. R: mean square, in the 5 x 5 window, of how far a disparity
lies from the mean of the four two pixels away (0 on a plane); errors of neighbours differ, and a window on relief or a
depth edge mixes the surfaces in it. M: share of unmatched pixels in 9 x 9; beside occlusions and failed matches a match
is often drawn to the wrong surface. r: correlation of the residual of a pixel with that of the next one along the
lines, in 31 x 31, as far as it exceeds .25. Camera noise has 0, fine grain that both images sample otherwise .25; what
JPEG, a camera's own denoising, or that of strong noise here leaves, up to .5: a window averages fewer errors if these
are alike, and neighbours err alike. The floor stands for errors that no pixel shows: sampling, lenses, the matcher's
own sub-pixel bias.

Of the pixels with similar N, R, M and r, 68 % err by less than one standard deviation and 95 % by less than two. So the
standard deviation is no root mean square: a few mismatches (a repeated pattern, a hidden pixel that resembles another)
err by ten and more, no feature reveals them, and no finite variance covers them. Back-matching error and feature
distance add nothing once N, R and M are known; their fitted factors were zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.geometry.spline import value_and_gradient
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.image import thinned
from rille.stages.numeric.relaxation import bend_weights, relax
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
    none); the variance of the column displacement (or the row's) for grey values of unit variance; and the correlation
    of the residuals of neighbours."""

    u: AnyArray
    v: AnyArray
    rest: AnyArray
    per_noise: AnyArray
    likeness: AnyArray


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
        planes = _warped(images, *to_right(*now), keep, WINDOW_RADIUS_PX)
        if axes is not None:
            gx, gy = (plane[_inner(plane, WINDOW_RADIUS_PX)] for plane in planes[1:3])
            gx[:], gy[:] = gx * axes[0] + gy * axes[1], gx * axes[2] + gy * axes[3]
        step_u, step_v, rest, per_noise = _window_steps(planes, keep, upright)
        rests.append(rest)
        now = local_mean(now[0] + step_u, now[1] + step_v, keep, 1, 1)
    # Residuals are those before a step: after a single one the last are the first, and the distance alone counts.
    better = (rests[-1] <= rests[0]) & (np.hypot(now[0] - start[0], now[1] - start[1]) <= MAX_CORRECTION_PX)
    u, v, rest = (np.where(better, new, old) for new, old in zip((*now, rests[-1]), (*start, rests[0]), strict=True))
    used, gx, gy, off = (plane[_inner(plane, WINDOW_RADIUS_PX)] for plane in planes)
    return Refined(u, v, rest, per_noise, _likeness(off - gx * step_u - gy * step_v, used, upright))


def _likeness(rest: AnyArray, used: AnyArray, upright: bool) -> AnyArray:
    """Correlation (row, col) float32 of the residual of a pixel with that of the next column (``upright``: row)."""
    # Less their mean, as windows see them; 10.0 grey levels: residual that counts half, as in `_grey`.
    rest = (rest - window_sum32(rest, 5) / np.maximum(window_sum32(used, 5), np.float32(1))) * used
    rest /= np.float32(1) + (rest * np.float32(1.0 / 10.0)) ** 2
    beside = np.zeros_like(rest)
    here, there = (np.s_[:-1], np.s_[1:]) if upright else (np.s_[:, :-1], np.s_[:, 1:])
    np.multiply(rest[here], rest[there], out=beside[here])
    # 31 pixels: side of the window, whose correlation has a standard deviation of .03.
    return window_sum32(beside, 31) / np.maximum(window_sum32(rest * rest, 31), np.float32(1e-6))


@kernel
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


def _axes(to_right: Frame, now: Maps) -> AnyArray | None:
    """Where a column and a row of the frame of steps lead in the right image, which may be turned and scaled against
    it: planes (4, row, col) float32, 0 beyond its horizon; None where both frames are one."""
    there = to_right(*now)
    if there[0] is now[0]:
        return None
    ends = *to_right(now[0] + 1, now[1]), *to_right(now[0], now[1] + 1)
    axes = np.stack([end - begin for end, begin in zip(ends, 2 * there, strict=True)])
    axes[~np.isfinite(axes)] = 0
    return axes


PAIRS = tuple((i, j) for i in range(4) for j in range(i, 4))
"""Products that are summed over a window: of each two of 1, gradient (x, y) and difference, see :func:`_warped`."""


@kernel
def _window_steps(planes, keep, upright):  # type: ignore[no-untyped-def]
    """Steps of all windows, from :func:`_warped` with a frame of a window's radius.

    Planes (4, row, col): columns and rows, zero where there is no step; residual variance before the step, infinite
    where there is none; and the variance of the column, or the row, for a unit of variance of the grey levels.
    """
    (rows, cols), side = keep.shape, 2 * WINDOW_RADIUS_PX + 1
    out = np.empty((4, rows, cols), np.float32)
    column, sums = np.empty(cols + side - 1, np.float32), np.empty((len(PAIRS), cols), np.float32)
    for y in range(rows):
        for k, (i, j) in enumerate(PAIRS):
            a, b, window = planes[i], planes[j], sums[k]
            for x in range(column.size):
                total = np.float32(0)
                for row in range(side):
                    total += a[y + row, x] * b[y + row, x]
                column[x] = total
            for x in range(cols):
                total = np.float32(0)
                for beside in range(side):
                    total += column[x + beside]
                window[x] = total
        _solve_windows(sums, keep[y], upright, (out[0, y], out[1, y], out[2, y], out[3, y]))
    return out


@kernel
def _solve_windows(sums, keep, upright, out):  # type: ignore[no-untyped-def]
    """Steps (4, col) of a row, from the sums of :data:`PAIRS` over the window of each of its pixels."""
    one, nil, far = np.float32(1), np.float32(0), np.float32(np.inf)
    # Assumed noise, squared grey levels a pixel, on the diagonal shortens steps where texture is weak, and keeps the
    # determinant positive. A window needs half of its pixels.
    noise, least = np.float32(8), np.float32(0.5 * (2 * WINDOW_RADIUS_PX + 1) ** 2)
    step_u, step_v, left, per_noise = out
    for x in range(keep.size):
        n = max(sums[0, x], one)
        use, gx, gy, r = keep[x] & (n >= least), sums[1, x] / n, sums[2, x] / n, sums[3, x] / n
        # Products of the gradient and the difference, less their means over the window.
        a, b, c = sums[4, x] - gx * gx * n + noise * n, sums[5, x] - gx * gy * n, sums[7, x] - gy * gy * n + noise * n
        p, q, det = sums[6, x] - gx * r * n, sums[8, x] - gy * r * n, a * c - b * b
        # A pixel at most: beyond it the step is a guess.
        step_u[x] = min(max((c * p - b * q) / det, -one), one) if use else nil
        step_v[x] = min(max((a * q - b * p) / det, -one), one) if use else nil
        # Rounding may leave the residual of a perfect fit below zero.
        left[x] = max(sums[9, x] - r * r * n, nil) / n if use else far
        per_noise[x] = (a if upright else c) / det if use else nil


def _inner(plane: AnyArray, frame: int) -> tuple[slice, slice]:
    """Index of a plane without its frame of so many pixels."""
    rows, cols = plane.shape
    return slice(frame, rows - frame), slice(frame, cols - frame)


def _warped(images: SplineImages, u: AnyArray, v: AnyArray, keep: AnyArray, frame: int = 0) -> AnyArray:
    """Planes (4, row, col) in a ``frame`` of pixels, zero where a pixel takes no part: 1, gradient (x, y) of the right
    image, left minus it."""
    rows, cols = u.shape
    planes = np.zeros((4, rows + 2 * frame, cols + 2 * frame), np.float32)
    _warp(images, u, v, keep, planes[:, *_inner(planes[0], frame)])
    return planes


@kernel
def _warp(images, u, v, keep, out):  # type: ignore[no-untyped-def]
    spline, half = images.spline, np.float32(0.5)
    last_x, last_y = spline.shape[1] - 2, spline.shape[0] - 2
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
            if not (keep[y, x] and xr >= 1 and xr < last_x and yr >= 1 and yr < last_y):
                continue
            # Unsigned indices need no check for counting from the end.
            if images.valid[np.uint64(yr + half), np.uint64(xr + half)]:
                value, gx, gy = value_and_gradient(spline, xr, yr)
                out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x] = 1, gx, gy, images.left[y, x] - value


def surroundings(rest: AnyArray, deviations: Maps, keep: AnyArray, noise: tuple[float, float]) -> Maps:
    """Correlation of the left image with the warped right one over a wider window, and the residual variance there.

    Both (row, col) float32; correlation 1 and residual 0 where unknown. They follow from the residual variance ``rest``
    and the local ``deviations`` of the left image and of the right one at the matches: signals of deviations a and b
    and correlation r differ by a^2 + b^2 - 2 r a b. Matches of noise with noise, in a shadow or the sky, correlate
    little. ``noise``: variances of the noise of both images before they were denoised; these are subtracted from a^2,
    b^2 and the difference, if that raises the correlation and the left image shows more than noise.
    """
    known = keep & (rest < np.inf)
    planes = (np.where(known, a, np.float32(0)) for a in (rest, *(d * d for d in deviations)))
    # Fewer pixels do not tell correlated noise from texture.
    sums = tuple(window_sum32(plane, 9) for plane in (*planes, known))
    correlation, differ = np.empty_like(rest), np.empty_like(rest)
    _correlations(sums, (np.float32(noise[0]), np.float32(noise[1])), correlation, differ)
    return correlation, differ


@kernel
def _correlations(sums, noise, correlation, differ):  # type: ignore[no-untyped-def]
    """Correlations and mean differences of windows, from their sums: of the variances of the difference and of both
    images, and of the number of pixels."""
    differs, left, right, counts = sums
    # 0.4: local deviation for each grey level of noise that was removed from the left image, up to which it may be
    # noise alone, of which denoising leaves about .3.
    shown, both, one, nil = np.float32(0.4**2) * noise[0], noise[0] + noise[1], np.float32(1), np.float32(0)
    for y in range(correlation.shape[0]):
        for x in range(correlation.shape[1]):
            n, a, b = counts[y, x], left[y, x], right[y, x]
            alike = _alike(differs[y, x], a, b)
            without = _alike(max(differs[y, x] - both * n, nil), a - noise[0] * n, b - noise[1] * n)
            alike = max(alike, without) if a > shown * n else alike
            correlation[y, x] = alike if a > nil else one
            differ[y, x] = differs[y, x] / max(n, one)


@kernel
def _alike(differ, a, b):  # type: ignore[no-untyped-def]
    """Correlation of signals of the variances ``a, b`` whose difference has the variance ``differ``."""
    a, b = max(a, np.float32(1e-6)), max(b, np.float32(1e-6))
    return (a + b - differ) / (np.float32(2) * np.sqrt(a * b))


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
    (a, b, c), trust = _lines(u, v, keep, images.spline.shape)
    # 1000.0 squared grey levels for a pixel off the line: more than the strongest texture says.
    hold, one = np.float32(1000.0 * trust), np.ones(u.shape, np.float32)
    along, off = (np.where(keep, d, np.float32(np.nan)) for d in (b * u - a * v, a * u + b * v + c))

    def displaced(along: AnyArray, off: AnyArray) -> Maps:
        """Displacements by their ways along the lines, and their distances off them."""
        return b * along + a * (off - c), b * (off - c) - a * along

    start, start_off = along, np.float32(1.0 - trust) * off
    # Four steps instead of seven: the median error of the judged half is .165 px instead of .160.
    for soft in (True, True, False, False):
        stiffness, bend = BEND_STIFFNESS * (0.15 if soft else 1.0), MAX_BEND_PX * (2.0 if soft else 1.0)
        weight, gx, gy, rest = _grey(images, *displaced(along, off), keep)
        bends = bend_weights(along, one, bend, stiffness)
        # First along the lines, then off them, with what is left of the difference.
        slope = b * gx - a * gy
        moved = relax(along, weight * slope**2, weight * slope * rest, bends, keep, sweeps=10)
        rest, along, slope = rest - slope * np.nan_to_num(moved - along), moved, a * gx + b * gy
        pull = weight * slope * rest - hold * np.nan_to_num(off)
        off = relax(off, weight * slope**2 + hold, pull, bends, keep, sweeps=10)
    good = np.hypot(along - start, off - start_off) <= MAX_CORRECTION_PX
    best = displaced(np.where(good, along, start), np.where(good, off, start_off))
    return np.where(keep, best[0], u), np.where(keep, best[1], v)


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
    """Epipolar lines (3, row, col) fitted to the matches, and trust in them, 0..1; (3, 1, 1) along the rows, and 0, if
    they are undetermined or bent."""
    y, x = thinned(keep, 4000)
    fit = epipolar.fit_points(x, y, u[y, x], v[y, x], keep.shape, right_shape)
    none = np.array([0.0, 1.0, 0.0], np.float32)[:, None, None], 0.0
    if fit is None:
        return none
    lines = np.moveaxis(epipolar.lines(fit[0], u.shape), 2, 0)
    # Clipped, so that a patch of wrong matches does not count as a bend.
    off = np.where(keep, np.clip(lines[0] * u + lines[1] * v + lines[2], -0.5, 0.5), np.float32(0))
    # 65 pixels: side of a neighbourhood; where lenses bend the lines its matches lie off them to one side.
    bent = (window_sum32(off, 65) / np.maximum(window_count(keep, 65), 1))[y, x]
    # 0.05 pixels: median distance from the lines up to which they are trusted fully; beyond it by its inverse square.
    trust = min(1.0, (0.05 / max(fit[1], 1e-9)) ** 2)
    # 0.1 pixels: median of those means up to which the lines are trusted; noise has .02.
    return (lines, trust) if epipolar.typical(bent) <= 0.1 else none


BLANK_STD_PX = 0.2
"""Standard deviation (pixels) added to matches of textureless regions, which the parts below do not contain."""

# Factors of the parts. For each of several floors ``benchmarks/disparity_std.py --fit`` found the others on four mockup
# pairs (seeds 1, 2 and 6, and seed 7 with noise of 4 grey levels); the floor, which no simulated lens shows, is the one
# with which the five photographed pairs that are for choosing come nearest to 68 %: 66 %, and 89 % below twice of it
# (70 and 92 % without one whose truth lies .15 px beside all matchers). On other mockup seeds: 70 and 91 %. 2026-11-25.
# The relief of preset ``accurate`` errs less: its standard deviations are too great.
FLOOR_PX = 0.13
NOISE_FACTOR = 0.41


def standard_deviation(
    noise: AnyArray, likeness: AnyArray, disparity: AnyArray, keep: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Standard deviation of matched disparities of one axis.

    Parameters
    ----------
    noise : (row, col) float32, part N of every pixel, squared pixels.
    likeness : (row, col) float32, correlation r of the residuals of neighbours.
    disparity : (row, col) float32 pixels.
    keep : (row, col) bool, matched pixels.

    Returns
    -------
    (row, col) float32 pixels, NaN where not matched.
    """
    by_noise, relief, border = parts(noise, likeness, disparity, keep)
    variance = np.float32(FLOOR_PX**2) + np.float32(NOISE_FACTOR**2) * by_noise
    variance += np.float32(1.71**2) * relief + np.float32(0.80**2) * border
    return np.where(keep, np.sqrt(variance), np.float32(np.nan))


def parts(
    noise: AnyArray, likeness: AnyArray, disparity: AnyArray, keep: NDArray[np.bool_]
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Parts N, R and M of :func:`standard_deviation`, each as much larger as errors of neighbours are alike."""
    # Chosen with the pairs for choosing, and a rendered one with noise, blurred noise, and JPEG of qualities 35 to 95.
    more = (np.float32(1) + np.float32(4.0) * np.maximum(likeness - np.float32(0.25), np.float32(0))) ** 2
    relief, border = neighbours(disparity, keep)
    return noise * more, relief * more, border * more


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
