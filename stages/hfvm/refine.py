"""Removal of the perspective bias: mean-free Lucas-Kanade steps against the right image warped by the disparities.

Feature vectors compare upright windows; where the two views foreshorten a surface differently their best displacement
is biased. Warping the right image by the smoothed disparities first makes the windows alike, and what is left is a
small displacement, solved per window. A pixel keeps the step only if it makes its window fit better.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from stages.declare import AnyArray
from stages.hfvm.params import HfvmParams
from stages.hfvm.resample import sample_cubic
from stages.hfvm.subpixel import local_mean
from stages.windows import window_sum

PLANES = 10

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


@njit(cache=True, nogil=True)
def _products(left, right, right_valid, u, v, keep, y, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of the ten planes whose window sums the step needs."""
    rows, cols = left.shape
    rrows, rcols = right.shape
    for x in range(cols):
        for k in range(PLANES):
            out[k, x] = 0.0
        if y < 0 or y >= rows or not keep[y, x]:
            continue
        xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
        if not (xr >= 1 and xr < rcols - 2 and yr >= 1 and yr < rrows - 2):
            continue
        if not right_valid[int(yr + np.float32(0.5)), int(xr + np.float32(0.5))]:
            continue
        w, gx, gy = sample_cubic(right, xr, yr)
        r = left[y, x] - w
        out[0, x] = 1.0
        out[1, x] = gx
        out[2, x] = gy
        out[3, x] = r
        out[4, x] = gx * gx
        out[5, x] = gx * gy
        out[6, x] = gy * gy
        out[7, x] = gx * r
        out[8, x] = gy * r
        out[9, x] = r * r


@njit(cache=True, nogil=True)
def _step(left, right, right_valid, u, v, keep, radius, noise, ring, column, fresh, new_u, new_v, energy):  # type: ignore[no-untyped-def]
    """One step for every kept pixel; ``energy`` is its mean-free residual variance *before* the step (inf: none).

    ``ring`` (size, planes, col), ``column`` and ``fresh`` (planes, col): zeros, room for running window sums.
    """
    rows, cols = left.shape
    size = 2 * radius + 1
    s = np.empty(PLANES)
    for y in range(-radius, rows):
        _products(left, right, right_valid, u, v, keep, y + radius, fresh)
        slot = (y + radius) % size
        for k in range(PLANES):
            for x in range(cols):
                column[k, x] += fresh[k, x] - ring[slot, k, x]
                ring[slot, k, x] = fresh[k, x]
        if y < 0:
            continue
        for k in range(PLANES):
            s[k] = 0.0
        for x in range(-radius, cols):
            if x + radius < cols:
                for k in range(PLANES):
                    s[k] += column[k, x + radius]
            if x - radius - 1 >= 0:
                for k in range(PLANES):
                    s[k] -= column[k, x - radius - 1]
            if x < 0:
                continue
            new_u[y, x], new_v[y, x], energy[y, x] = u[y, x], v[y, x], np.inf
            n = s[0]
            if not keep[y, x] or n < 0.5 * size * size:
                continue
            a = s[4] - s[1] * s[1] / n + noise * n
            b = s[5] - s[1] * s[2] / n
            c = s[6] - s[2] * s[2] / n + noise * n
            p = s[7] - s[1] * s[3] / n
            q = s[8] - s[2] * s[3] / n
            det = a * c - b * b
            energy[y, x] = max(s[9] - s[3] * s[3] / n, 0.0) / n
            new_u[y, x] += np.float32(min(max((c * p - b * q) / det, -1.0), 1.0))
            new_v[y, x] += np.float32(min(max((a * q - b * p) / det, -1.0), 1.0))


def refine(
    left: AnyArray,
    right: AnyArray,
    right_valid: AnyArray,
    u: AnyArray,
    v: AnyArray,
    keep: AnyArray,
    params: HfvmParams,
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Displacements without the perspective bias.

    Parameters
    ----------
    left, right : (row, col) float32 grey values.
    right_valid : (row, col) uint8, 1 = usable.
    u, v : (row, col) float32, smoothed displacements, pixels.
    keep : (row, col) bool, pixels that have one.

    Returns
    -------
    u, v : (row, col) float32, refined where that lowered the residual.
    rest : (row, col) float32, mean-free residual variance of the window, squared grey levels; inf where not known.
    """
    start_u, start_v = u, v
    first = last = np.empty(u.shape, np.float32)
    for step in range(params.refine_steps + 1):
        new_u, new_v, last = np.empty_like(u), np.empty_like(v), np.empty(u.shape, np.float32)
        size, cols = 2 * params.refine_radius + 1, u.shape[1]
        room = (np.zeros((size, PLANES, cols)), np.zeros((PLANES, cols)), np.zeros((PLANES, cols)))
        _step(
            left, right, right_valid, u, v, keep, params.refine_radius, params.refine_noise, *room, new_u, new_v, last
        )
        if step == 0:
            first = last
        if step < params.refine_steps:
            u, v = np.empty_like(u), np.empty_like(v)
            local_mean(new_u, new_v, keep, 1, u, v)
    better = (last <= first) & (np.hypot(u - start_u, v - start_v) <= FARTHEST)
    return np.where(better, u, start_u), np.where(better, v, start_v), np.where(better, last, first)


def level_contrast(left: AnyArray, right: AnyArray, u: AnyArray, v: AnyArray, keep: AnyArray) -> AnyArray:
    """The right image, its contrast made that of the left one where they differ grossly (:data:`SAME_CONTRAST`).

    Steps and residuals are mean-free, not free of gain: an exposure ratio of two would pass for noise. The ratio is
    that of the median differences over three columns, at matches that are not saturated.
    """
    y, x = np.nonzero(keep[:, :-STRIDE])
    y, x = y[:: 1 + len(y) // SAMPLES], x[:: 1 + len(x) // SAMPLES]
    xr, yr = np.rint(x + u[y, x]).astype(np.intp), np.rint(y + v[y, x]).astype(np.intp)
    inside = (xr >= 0) & (xr + STRIDE < right.shape[1]) & (yr >= 0) & (yr < right.shape[0])
    y, x, yr, xr = y[inside], x[inside], yr[inside], xr[inside]
    a, b = np.stack([left[y, x], left[y, x + STRIDE]]), np.stack([right[yr, xr], right[yr, xr + STRIDE]])
    good = (np.maximum(a, b) < SATURATED).all(axis=0)
    if np.count_nonzero(good) < LEAST:
        return right
    there, here = (float(np.median(np.abs(np.diff(c[:, good], axis=0)))) for c in (b, a))
    if min(here, there) <= 0 or max(here / there, there / here) < SAME_CONTRAST:
        return right
    return right * np.float32(here / there)


def correlation(rest: AnyArray, deviation: AnyArray, keep: AnyArray) -> AnyArray:
    """Correlation (row, col) of the left image with the warped right one over a wider window; 1 where not known.

    From the residual variance ``rest`` and the left image's local ``deviation``: two signals of equal variance s^2 and
    correlation r differ by 2 s^2 (1 - r). Noise that found noise to match, in a shadow or the sky, gives itself away.
    """
    known = keep & np.isfinite(rest)
    differ = window_sum(np.where(known, rest, 0.0), CORRELATION_SIDE)
    power = window_sum(np.where(known, deviation * deviation, 0.0), CORRELATION_SIDE)
    return np.where(power > 0, 1.0 - differ / np.maximum(2.0 * power, 1e-6), 1.0)
