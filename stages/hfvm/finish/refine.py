"""Removal of the perspective bias: mean-free Lucas-Kanade steps against the right image warped by the disparities.

Feature vectors compare upright windows; where the two views foreshorten a surface differently their best displacement
is biased. Warping the right image by the smoothed disparities first makes the windows alike, and what is left is a
small displacement, solved per window. A pixel keeps the step only if it makes its window fit better.

Steps use the left image's gradient, so they are taken in the frame of the aligned right image, where neighbours move
alike even between turned views; grey values are read from the right image itself, which is interpolated only once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.level import rowwise

Frame = Callable[[AnyArray, AnyArray], tuple[AnyArray, AnyArray]]
"""Displacements to the right image of those in the frame in which steps are taken, both (row, col) float32 pixels."""


CORRELATION_SIDE = 9
"""Pixels: fewer do not tell correlated noise from texture."""

FARTHEST = 1.5
"""Pixels: a correction beyond this is a jump to something else."""

NOISE_TEXTURE = 0.4
"""Local deviation for each grey level of noise that was removed from the left image, up to which it may be noise alone,
of which denoising leaves about .3."""

SAME_CONTRAST = 1.3
"""Ratio of contrasts up to which residuals hardly tell it from noise: less than a tenth of the signal's variance."""
STRIDE, SAMPLES, LEAST = 3, 8000, 100
"""Pixels between the two of a difference, and how many differences the ratio of contrasts is taken from."""
SATURATED = 250.0
"""Grey level from which on an image may be clipped."""


def refine(
    left: AnyArray,
    right: rowwise.Right,
    to_right: Frame,
    u: AnyArray,
    v: AnyArray,
    keep: AnyArray,
    params: HfvmParams,
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """Displacements without the perspective bias, in the frame in which they are given.

    Parameters
    ----------
    left : (row, col) float32 grey values.
    right : the window of the right image. Pixels nearer than :func:`reach` to a cut are not sound.
    to_right : from the frame in which steps are taken to the right image.
    u, v : (row, col) float32, smoothed displacements, pixels.
    keep : (row, col) bool, pixels that have one.

    Returns
    -------
    u, v : (row, col) float32, refined where that lowered the residual; as given with ``params.refine`` off.
    rest : (row, col) float32, mean-free residual variance of the window, squared grey levels; inf where not known.
    per_noise : (row, col) float32, variance of the column displacement for a unit of variance of the grey levels.
    """
    step_u, step_v, first, per_noise = (np.empty(u.shape, np.float32) for _ in range(4))
    now_u, now_v, last = u, v, first
    for step in range(params.refine_steps):
        last = first if step == 0 else np.empty(u.shape, np.float32)
        there_u, there_v = to_right(now_u, now_v)
        window = params.refine_radius, np.float32(params.refine_noise)
        told = rowwise.StepArrays(step_u, step_v, last, per_noise)
        rowwise.lucas_kanade(left, right, (there_u, there_v), keep, window, told)
        if not params.refine:
            break
        # The same arrays mean no alignment, and nothing to convert.
        if there_u is not now_u:
            step_u, step_v = now_u + (step_u - there_u), now_v + (step_v - there_v)
        now_u, now_v = np.empty_like(u), np.empty_like(v)
        rowwise.local_mean(step_u, step_v, keep, 1, 1, now_u, now_v)
    if not params.refine:
        return u, v, first, per_noise
    _take_back(u, v, first, np.float32(FARTHEST), now_u, now_v, last)
    return now_u, now_v, last, per_noise


@njit(cache=True, nogil=True)
def _take_back(u, v, first, farthest, new_u, new_v, last):  # type: ignore[no-untyped-def]
    """Start displacements and residuals where steps led far or away from a fit."""
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            du, dv = new_u[y, x] - u[y, x], new_v[y, x] - v[y, x]
            # After a single step both are one array (residuals are those before it): the distance alone counts.
            better = (last[y, x] <= first[y, x]) & (du * du + dv * dv <= farthest * farthest)
            new_u[y, x] = new_u[y, x] if better else u[y, x]
            new_v[y, x] = new_v[y, x] if better else v[y, x]
            last[y, x] = last[y, x] if better else first[y, x]


def contrast(left: AnyArray, right: AnyArray, u: AnyArray, v: AnyArray, keep: AnyArray) -> float:
    """Return the factor that gives the right image the contrast of the left one if they differ much, else 1.

    Steps and residuals are mean-free, not free of gain: an exposure ratio of two would pass for noise. The ratio is
    that of the median differences over three columns, at matches that are not saturated (:data:`SAME_CONTRAST`).
    ``u, v``: whole pixels.
    """
    y, x = np.nonzero(keep[:, :-STRIDE])
    y, x = y[:: 1 + len(y) // SAMPLES], x[:: 1 + len(x) // SAMPLES]
    xr, yr = x + u[y, x].astype(np.intp), y + v[y, x].astype(np.intp)
    inside = (xr >= 0) & (xr + STRIDE < right.shape[1]) & (yr >= 0) & (yr < right.shape[0])
    y, x, yr, xr = y[inside], x[inside], yr[inside], xr[inside]
    a, b = np.stack([left[y, x], left[y, x + STRIDE]]), np.stack([right[yr, xr], right[yr, xr + STRIDE]])
    good = (np.maximum(a, b) < SATURATED).all(axis=0)
    if np.count_nonzero(good) < LEAST:
        return 1.0
    there, here = (float(np.median(np.abs(np.diff(c[:, good], axis=0)))) for c in (b, a))
    if min(here, there) <= 0 or max(here / there, there / here) < SAME_CONTRAST:
        return 1.0
    return here / there


def reach(params: HfvmParams) -> int:
    """Pixels that a refined displacement and its surroundings depend on to either side."""
    steps = params.refine_steps if params.refine else 1
    return steps * (params.refine_radius + 1) + 1 + CORRELATION_SIDE // 2


def drift(params: HfvmParams) -> int:
    """Pixels of the right image beyond the start's that refinement may read: a step and a mean each move by one."""
    return 2 * params.refine_steps + 3


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
    planes, sums = (np.empty((3, *rest.shape), np.float32) for _ in range(2))
    _known(rest, deviation, keep, planes)
    rowwise.box(planes, CORRELATION_SIDE // 2, sums)
    _correlation(sums, (np.float32(noise[0]), np.float32(noise[0] + noise[1])), planes[0], planes[1])
    return planes[0], planes[1]


@njit(cache=True, nogil=True)
def _known(rest, deviation, keep, planes):  # type: ignore[no-untyped-def]
    nil, one = np.float32(0.0), np.float32(1.0)
    for y in range(rest.shape[0]):
        differ, power, count = planes[0, y], planes[1, y], planes[2, y]
        for x in range(rest.shape[1]):
            use = keep[y, x] & (rest[y, x] < np.inf)
            differ[x] = rest[y, x] if use else nil
            power[x] = deviation[y, x] * deviation[y, x] if use else nil
            count[x] = one if use else nil


@njit(cache=True, nogil=True)
def _correlation(sums, noise, found, around):  # type: ignore[no-untyped-def]
    one, two, least, nil = np.float32(1.0), np.float32(2.0), np.float32(1e-6), np.float32(0.0)
    own, both = noise
    texture = np.float32(NOISE_TEXTURE * NOISE_TEXTURE)
    for y in range(found.shape[0]):
        differ, power, count = sums[0, y], sums[1, y], sums[2, y]
        for x in range(found.shape[1]):
            with_noise = one - differ[x] / max(two * power[x], least)
            difference, signal = max(differ[x] - both * count[x], nil), power[x] - own * count[x]
            textured = power[x] > texture * own * count[x]
            without = one - difference / max(two * signal, least) if textured else with_noise
            found[y, x] = max(with_noise, without) if power[x] > 0 else one
            around[y, x] = differ[x] / max(count[x], one)
