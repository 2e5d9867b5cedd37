"""Removal of the perspective bias: mean-free Lucas-Kanade steps against the right image warped by the disparities.

Feature vectors compare upright windows; where the two views foreshorten a surface differently their best displacement
is biased. Warping the right image by the smoothed disparities first makes the windows alike, and what is left is a
small displacement, solved per window. A pixel keeps the step only if it makes its window fit better.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.declare import AnyArray
from stages.hfvm import rowwise
from stages.hfvm.params import HfvmParams
from stages.hfvm.window import Raster, pick

Place = tuple[int, int, int, int, int, int]
"""First column and row of the left and of the right window, rows and columns of the whole right image."""

CORRELATION_SIDE = 9
"""Pixels: fewer do not tell correlated noise from texture."""

FARTHEST = 1.5
"""Pixels: a correction beyond this is a jump to something else."""

SAME_CONTRAST = 1.3
"""Ratio of contrasts up to which residuals hardly tell it from noise: less than a tenth of the signal's variance."""
STRIDE, SAMPLES, LEAST = 3, 20000, 100
"""Pixels between the two of a difference, and how many differences the ratio of contrasts is taken from."""
SATURATED = 250.0
"""Grey level from which on an image may be clipped."""


def refine(
    left: AnyArray,
    right: AnyArray,
    right_valid: AnyArray,
    u: AnyArray,
    v: AnyArray,
    keep: AnyArray,
    params: HfvmParams,
    place: Place | None = None,
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Displacements without the perspective bias.

    Parameters
    ----------
    left, right : (row, col) float32 grey values.
    right_valid : (row, col) uint8, 1 = usable.
    u, v : (row, col) float32, smoothed displacements, pixels.
    keep : (row, col) bool, pixels that have one.
    place : where both windows lie; None: they are the images. Pixels nearer than :func:`reach` to a cut are not sound.

    Returns
    -------
    u, v : (row, col) float32, refined where that lowered the residual.
    rest : (row, col) float32, mean-free residual variance of the window, squared grey levels; inf where not known.
    """
    start_u, start_v = u, v
    at = place or (0, 0, 0, 0, *right.shape)
    first = last = np.empty(u.shape, np.float32)
    for step in range(params.refine_steps + 1):
        new_u, new_v, last = np.empty_like(u), np.empty_like(v), np.empty(u.shape, np.float32)
        radius, noise = params.refine_radius, params.refine_noise
        rowwise.lucas_kanade(left, right, right_valid, u, v, keep, radius, noise, new_u, new_v, last, *at)
        if step == 0:
            first = last
        if step < params.refine_steps:
            u, v = np.empty_like(u), np.empty_like(v)
            rowwise.local_mean(new_u, new_v, keep, 1, u, v)
    better = (last <= first) & (np.hypot(u - start_u, v - start_v) <= FARTHEST)
    return np.where(better, u, start_u), np.where(better, v, start_v), np.where(better, last, first)


def contrast(left: Raster, right: Raster, u: Raster, v: Raster, chosen: AnyArray) -> float | None:
    """Ratio of the left image's contrast to the right one's where they differ grossly (:data:`SAME_CONTRAST`), or None.

    Steps and residuals are mean-free, not free of gain: an exposure ratio of two would pass for noise. The ratio is
    that of the median differences over three columns, at matches that are not saturated.

    Parameters
    ----------
    left, right, u, v : whole images and displacements.
    chosen : flat indices of matched pixels, about :data:`SAMPLES`; none in the last columns (:data:`STRIDE`).
    """
    y, x = np.divmod(chosen, u.shape[1])
    xr, yr = np.rint(x + pick(u, y, x)).astype(np.intp), np.rint(y + pick(v, y, x)).astype(np.intp)
    inside = (xr >= 0) & (xr + STRIDE < right.shape[1]) & (yr >= 0) & (yr < right.shape[0])
    y, x, yr, xr = y[inside], x[inside], yr[inside], xr[inside]
    a, b = (np.stack([pick(c, j, i), pick(c, j, i + STRIDE)]) for c, j, i in ((left, y, x), (right, yr, xr)))
    good = (np.maximum(a, b) < SATURATED).all(axis=0)
    if np.count_nonzero(good) < LEAST:
        return None
    there, here = (float(np.median(np.abs(np.diff(c[:, good], axis=0)))) for c in (b, a))
    if min(here, there) <= 0 or max(here / there, there / here) < SAME_CONTRAST:
        return None
    return here / there


def reach(params: HfvmParams) -> int:
    """Pixels that a refined displacement and its correlation depend on to either side."""
    return params.refine_steps * (params.refine_radius + 1) + params.refine_radius + CORRELATION_SIDE // 2


def drift(params: HfvmParams) -> int:
    """Pixels of the right image beyond the start's that refinement may read: a step and a mean each move by one."""
    return 2 * params.refine_steps + 3


def correlation(rest: AnyArray, deviation: AnyArray, keep: AnyArray) -> AnyArray:
    """Correlation (row, col) of the left image with the warped right one over a wider window; 1 where not known.

    From the residual variance ``rest`` and the left image's local ``deviation``: two signals of equal variance s^2 and
    correlation r differ by 2 s^2 (1 - r). Noise that found noise to match, in a shadow or the sky, gives itself away.
    """
    both = np.empty((2, *rest.shape), np.float32)
    _known(rest, deviation, keep, both[0], both[1])
    differ, power = np.empty_like(both)
    rowwise.box_sum(both[0], CORRELATION_SIDE // 2, differ)
    rowwise.box_sum(both[1], CORRELATION_SIDE // 2, power)
    found = np.empty_like(rest)
    _correlation(differ, power, found)
    return found


@njit(cache=True, nogil=True)
def _known(rest, deviation, keep, differ, power):  # type: ignore[no-untyped-def]
    nil = np.float32(0.0)
    for y in range(rest.shape[0]):
        for x in range(rest.shape[1]):
            use = keep[y, x] & (rest[y, x] < np.inf)
            differ[y, x] = rest[y, x] if use else nil
            power[y, x] = deviation[y, x] * deviation[y, x] if use else nil


@njit(cache=True, nogil=True)
def _correlation(differ, power, found):  # type: ignore[no-untyped-def]
    one, two, least = np.float32(1.0), np.float32(2.0), np.float32(1e-6)
    for y in range(found.shape[0]):
        for x in range(found.shape[1]):
            p = power[y, x]
            found[y, x] = one - differ[y, x] / max(two * p, least) if p > 0 else one
