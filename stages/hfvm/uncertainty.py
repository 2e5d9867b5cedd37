"""Standard deviation of every matched column disparity, from what the matcher knows at the pixel.

The error of a disparity is taken as the sum of independent parts, so that variances add:

    std^2 = floor^2 + noise^2 N + relief^2 R + border^2 M

N: variance of the least-squares displacement of the 5 x 5 window (the Cramer-Rao bound: residual variance after
refinement, times the column element of the inverse structure tensor). A window along a column edge has a small one,
a window along a row edge a large one. R: variance of the matched disparities of the 5 x 5 window about their plane;
errors of neighbours differ, and a window on relief or a depth edge answers for a part of each surface. M: share of
unmatched pixels in 9 x 9; beside occlusions and failed matches a match leans on the wrong surface. The floor is what
no pixel shows: sampling, lenses, the matcher's own sub-pixel bias.

What the number means: of the pixels with like features 68 % err by less than one and 95 % by less than two of it. So
it is no root mean square: a few mismatches (a repeated pattern, a hidden pixel that found a likeness) err by ten and
more, look sound to every feature, and no finite variance covers them. Back-matching error and feature distance tell
nothing more once N, R and M are known; their fitted factors were zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.declare import AnyArray
from stages.hfvm import rowwise
from stages.hfvm.params import HfvmParams
from stages.windows import window_sum

RADIUS = 2
"""Pixels: the windows of sub-pixel search and refinement are 5 x 5."""

PLANES = 12

SURROUNDINGS = 9
"""Pixels: side of the window in which unmatched pixels count; about the reach of features and windows together."""


@dataclass(frozen=True)
class Factors:
    """Factors of the parts; ``floor`` and ``border`` in pixels, the others without unit."""

    floor: float
    noise: float
    relief: float
    border: float


REFINED = Factors(floor=0.1, noise=0.65, relief=1.75, border=0.6)
"""Refined disparities. Fitted by ``benchmarks/disparity_std.py`` (rounded) to four mockup pairs: seeds 1, 2 and 6, and
seed 7 with noise of 4 grey levels. On other seeds and frames 71-73 % of the errors are below std and 92-93 % below
twice that; on scenes of another kind 56/85 (blurred twice as much) to 75/95 (steeper view), on two photographed pairs
whose truth errs by .1 px itself 63/86 and 58/85. The floor is set, not fitted: what smooth textured surfaces show."""

UNREFINED = Factors(floor=0.1, noise=0.7, relief=2.5, border=1.1)
"""Disparities as the sub-pixel search and local mean left them; N is then that of the fixed noise ``refine_noise``."""

PAPER = Factors(floor=0.2, noise=0.0, relief=1.05, border=1.7)
"""Preset ``paper`` without refinement: each pixel for itself, so that R shows the whole of the noise."""


def standard_deviation(
    left: AnyArray, rest: AnyArray | None, column: AnyArray, keep: NDArray[np.bool_], params: HfvmParams
) -> NDArray[np.float32]:
    """Standard deviation of matched column disparities.

    Parameters
    ----------
    left : (row, col) float32 grey values.
    rest : (row, col) mean-free residual variance of each window, squared grey levels, inf where not known; None:
        disparities were not refined.
    column : (row, col) float32 column disparities, pixels.
    keep : (row, col) bool, matched pixels.

    Returns
    -------
    (row, col) float32 pixels, NaN where not matched.
    """
    unrefined = PAPER if params.preset == "paper" else UNREFINED
    f = unrefined if rest is None else REFINED
    noise, relief, border = parts(left, rest, column, keep, params)
    variance = f.floor**2 + f.noise**2 * noise + f.relief**2 * relief + f.border**2 * border
    return np.where(keep, np.sqrt(variance), np.nan).astype(np.float32)


def parts(
    left: AnyArray, rest: AnyArray | None, column: AnyArray, keep: NDArray[np.bool_], params: HfvmParams
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """N, R and M of every pixel (see the module); 0 where not matched."""
    per_noise, relief = (np.zeros(keep.shape, np.float32) for _ in range(2))
    _window(np.asarray(left, np.float32), column, keep, np.float32(params.refine_noise), per_noise, relief)
    count = window_sum(keep, SURROUNDINGS)
    border = np.where(keep, 1.0 - count / window_sum(np.ones(keep.shape), SURROUNDINGS), 0.0)
    if rest is None:
        return params.refine_noise * per_noise, relief, border
    # One window's residual is itself uncertain; that of its surroundings is not.
    known = keep & np.isfinite(rest)
    total = np.empty(keep.shape)
    rowwise.box_sum(np.where(known, rest, 0.0), SURROUNDINGS // 2, total)
    return per_noise * total / np.maximum(window_sum(known, SURROUNDINGS), 1.0), relief, border


@njit(cache=True, nogil=True)
def _window(left, column, keep, noise, per_noise, relief):  # type: ignore[no-untyped-def]
    """Column variance per unit of noise variance, and variance of the disparities about their plane, of each window."""
    rows, cols = left.shape
    c, s = np.zeros((PLANES, cols + 2 * RADIUS)), np.empty(PLANES)
    for y in range(rows):
        _columns(left, column, keep, y, c)
        for x in range(cols):
            if not keep[y, x]:
                continue
            mx = mxx = mxy = zx = 0.0
            s[:] = 0.0
            for i in range(2 * RADIUS + 1):
                for k in range(PLANES):
                    s[k] += c[k, x + i]
                dx = np.float64(i - RADIUS)
                mx += dx * c[6, x + i]
                mxx += dx * dx * c[6, x + i]
                mxy += dx * c[7, x + i]
                zx += dx * c[9, x + i]
            n, m, my, z = s[0], s[6], s[7], s[9]
            # The same noise term that holds the refinement's windows holds this one.
            gxx, gyy = s[3] - s[1] * s[1] / n + noise * n, s[5] - s[2] * s[2] / n + noise * n
            gxy = s[4] - s[1] * s[2] / n
            per_noise[y, x] = gyy / (gxx * gyy - gxy * gxy)
            mxx, myy, mxy = mxx - mx * mx / m, s[8] - my * my / m, mxy - mx * my / m
            zx, zy, zz = zx - z * mx / m, s[10] - z * my / m, s[11] - z * z / m
            det = mxx * myy - mxy * mxy
            if det > 0.1:  # three pixels off a line have at least 1/3
                zz -= (zx * (zx * myy - zy * mxy) + zy * (zy * mxx - zx * mxy)) / det
            relief[y, x] = max(zz, 0.0) / m


@njit(cache=True, nogil=True)
def _columns(left, column, keep, y, c):  # type: ignore[no-untyped-def]
    """Sums ``c`` (plane, RADIUS + col) over the window's rows about row ``y``.

    Planes: count, products of the left image's gradient; of kept pixels count, moments of dy, of the disparity.
    """
    rows, cols = left.shape
    c[:] = 0.0
    for j in range(max(0, y - RADIUS), min(rows, y + RADIUS + 1)):
        above, below, dy = max(j - 1, 0), min(j + 1, rows - 1), np.float64(j - y)
        for x in range(cols):
            a = 0.5 * (left[j, min(x + 1, cols - 1)] - left[j, max(x - 1, 0)])
            b = 0.5 * (left[below, x] - left[above, x])
            i = x + RADIUS
            c[0, i] += 1.0
            c[1, i] += a
            c[2, i] += b
            c[3, i] += a * a
            c[4, i] += a * b
            c[5, i] += b * b
            if keep[j, x]:
                d = np.float64(column[j, x])
                c[6, i] += 1.0
                c[7, i] += dy
                c[8, i] += dy * dy
                c[9, i] += d
                c[10, i] += d * dy
                c[11, i] += d * d
