"""Standard deviation of every matched column disparity, from what the matcher knows at the pixel.

The error of a disparity is taken as the sum of independent parts, so that variances add:

    std^2 = floor^2 + noise^2 N + relief^2 R + border^2 M

N: variance of the least-squares displacement of the 5 x 5 window (the Cramer-Rao bound: residual variance after
refinement, times the column element of the inverse structure tensor). A window along a column edge has a small one,
a window along a row edge a large one. R: mean square, in the 5 x 5 window, of how far a disparity
lies from the mean of the four two pixels away (0 on a plane); errors of neighbours differ, and a window on relief or a
depth edge mixes the surfaces in it. M: share of unmatched pixels in 9 x 9; beside occlusions and failed matches a match
is often drawn to the wrong surface. The floor stands for errors that no pixel shows: sampling, lenses, the matcher's
own sub-pixel bias.

Of the pixels with similar N, R and M, 68 % err by less than one standard deviation and 95 % by less than two. So the
standard deviation is no root mean square: a few mismatches (a repeated pattern, a hidden pixel that resembles another)
err by ten and more, no feature reveals them, and no finite variance covers them. Back-matching error and feature
distance add nothing once N, R and M are known; their fitted factors were zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.level import rowwise

RADIUS = 2
"""Pixels: the windows of sub-pixel search and refinement are 5 x 5."""

SURROUNDINGS = 9
"""Pixels: side of the window in which unmatched pixels count; about the reach of features and windows together."""


BLANK = 0.2
"""Standard deviation (pixels) that is added to a match without texture that its surroundings confirm; the parts below
do not explain it. From the five pairs of :data:`rille.stages.hfvm.level.consistency.SUPPORT`: .13 to .26."""


class Factors(NamedTuple):
    """Factors of the parts; ``floor`` and ``border`` in pixels, the others without unit."""

    floor: float
    noise: float
    relief: float
    border: float


REFINED = Factors(floor=0.13, noise=0.41, relief=1.71, border=0.80)
"""Refined disparities. For each of several floors ``benchmarks/disparity_std.py --fit`` found the others on four mockup
pairs (seeds 1, 2 and 6, and seed 7 with noise of 4 grey levels); the floor, which no simulated lens shows, is the one
with which the five photographed pairs that are for choosing come nearest to 68 %: 66 %, and 89 % below twice of it (70
and 92 % without one whose truth lies .15 px beside all matchers). On other mockup seeds: 70 and 91 %. 2026-11-25."""

RELIEF = Factors(floor=0.10, noise=0.45, relief=1.51, border=0.47)
"""Disparities of the relief, found alike with preset ``accurate``: 57 and 85 % on those photographed pairs, 70 and 90 %
on other mockup seeds; a floor of .12 px (62 and 88 %) would hold 78 % of the errors of some of those."""

UNREFINED = Factors(floor=0.1, noise=0.7, relief=2.5, border=1.1)
"""Disparities as the sub-pixel search and local mean left them; N is then that of the fixed noise ``refine_noise``."""

PAPER = Factors(floor=0.2, noise=0.0, relief=1.05, border=1.7)
"""Preset ``paper`` without refinement: each pixel for itself, so that R shows the whole of the noise."""


def standard_deviation(
    noise: AnyArray, column: AnyArray, keep: NDArray[np.bool_], params: HfvmParams
) -> NDArray[np.float32]:
    """Standard deviation of matched column disparities.

    Parameters
    ----------
    noise : (row, col) float32, part N of every pixel, squared pixels.
    column : (row, col) float32 column disparities, pixels.
    keep : (row, col) bool, matched pixels.

    Returns
    -------
    (row, col) float32 pixels, NaN where not matched.
    """
    f = _factors(params)
    parts = neighbours(column, keep)
    found = np.empty(keep.shape, np.float32)
    squares = tuple(np.float32(a * a) for a in f)
    _add(noise, parts, keep, squares, found)
    return found


def _factors(params: HfvmParams) -> Factors:
    if params.variational_steps:
        return RELIEF
    if params.refine:
        return REFINED
    return PAPER if params.preset == "paper" else UNREFINED


def neighbours(column: AnyArray, keep: NDArray[np.bool_]) -> AnyArray:
    """Parts R and M of every pixel (2, row, col), see the module; meaningless where not matched."""
    planes, sums = np.zeros((3, *keep.shape), np.float32), np.empty((3, *keep.shape), np.float32)
    _bends(column, keep, planes)
    rowwise.box(planes[:2], RADIUS, sums[:2])
    rowwise.box(planes[2:], SURROUNDINGS // 2, sums[2:])
    _shares(sums, SURROUNDINGS // 2, planes)
    return np.asarray(planes[:2])


@njit(cache=True, nogil=True)
def _bends(column, keep, planes):  # type: ignore[no-untyped-def]
    """Squared departure from the mean of four pixels ``RADIUS`` away, where all are kept; its count; the kept ones."""
    rows, cols = keep.shape
    r = RADIUS
    one, nil, quarter = np.float32(1.0), np.float32(0.0), np.float32(0.25)
    for y in range(rows):
        kept, own = planes[2, y], keep[y]
        for x in range(cols):
            kept[x] = one if own[x] else nil
        if y < r or y >= rows - r or cols <= 2 * r:
            continue
        end = cols - r
        d, up, down, west, east = (
            column[y, r:end],
            column[y - r, r:end],
            column[y + r, r:end],
            column[y, : end - r],
            column[y, 2 * r :],
        )
        k, ku, kd, kw, ke = keep[y, r:end], keep[y - r, r:end], keep[y + r, r:end], keep[y, : end - r], keep[y, 2 * r :]
        square, count = planes[0, y, r:end], planes[1, y, r:end]
        for x in range(end - r):
            use = k[x] & ku[x] & kd[x] & kw[x] & ke[x]
            e = d[x] - quarter * ((up[x] + down[x]) + (west[x] + east[x]))
            square[x] = e * e if use else nil
            count[x] = one if use else nil


@njit(cache=True, nogil=True)
def _shares(sums, radius, parts):  # type: ignore[no-untyped-def]
    """Mean of the squares, and share of the window inside the image that is not kept."""
    rows, cols = sums.shape[1:]
    one = np.float32(1.0)
    for y in range(rows):
        tall = min(rows, y + radius + 1) - max(0, y - radius)
        square, count, kept, relief, border = sums[0, y], sums[1, y], sums[2, y], parts[0, y], parts[1, y]
        for x in range(cols):
            room = np.float32(tall * (min(cols, x + radius + 1) - max(0, x - radius)))
            relief[x] = square[x] / max(count[x], one)
            border[x] = one - kept[x] / room


@njit(cache=True, nogil=True)
def _add(noise, parts, keep, squares, found):  # type: ignore[no-untyped-def]
    floor, by_noise, by_relief, by_border = squares
    nan = np.float32(np.nan)
    for y in range(keep.shape[0]):
        n, r, m, own, out = noise[y], parts[0, y], parts[1, y], keep[y], found[y]
        for x in range(keep.shape[1]):
            std = np.sqrt(floor + by_noise * n[x] + by_relief * r[x] + by_border * m[x])
            out[x] = std if own[x] else nan
