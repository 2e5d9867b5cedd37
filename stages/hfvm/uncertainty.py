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

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.lucas_kanade import WINDOW_RADIUS_PX
from rille.stages.numeric.windows import window_count, window_room, window_sum32

SURROUNDINGS_SIDE_PX = 9
"""Pixels: side of the window in which unmatched pixels count; about the reach of features and windows together."""

BLANK_STD_PX = 0.2
"""Standard deviation (pixels) that is added to a match without texture; the parts below do not explain it."""

# Factors of the parts. For each of several floors ``benchmarks/disparity_std.py --fit`` found the others on four mockup
# pairs (seeds 1, 2 and 6, and seed 7 with noise of 4 grey levels); the floor, which no simulated lens shows, is the one
# with which the five photographed pairs that are for choosing come nearest to 68 %: 66 %, and 89 % below twice of it
# (70 and 92 % without one whose truth lies .15 px beside all matchers). On other mockup seeds: 70 and 91 %. 2026-11-25.
# The relief of preset ``accurate`` errs less: its standard deviations are too great.
FLOOR_PX = 0.13
NOISE_FACTOR = 0.41
RELIEF_FACTOR = 1.71
BORDER_PX = 0.80


def standard_deviation(noise: AnyArray, column: AnyArray, keep: NDArray[np.bool_]) -> NDArray[np.float32]:
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
    relief, border = neighbours(column, keep)
    variance = np.float32(FLOOR_PX**2) + np.float32(NOISE_FACTOR**2) * noise
    variance += np.float32(RELIEF_FACTOR**2) * relief + np.float32(BORDER_PX**2) * border
    return np.where(keep, np.sqrt(variance), np.float32(np.nan))


def neighbours(column: AnyArray, keep: NDArray[np.bool_]) -> tuple[AnyArray, AnyArray]:
    """Parts R and M of every pixel (row, col), see the module; meaningless where not matched."""
    radius = WINDOW_RADIUS_PX  # that of sub-pixel search and refinement
    side, bend = 2 * radius + 1, np.zeros(keep.shape, np.float32)
    near, far, here = slice(None, -2 * radius), slice(2 * radius, None), slice(radius, -radius)
    sides = column[near, here] + column[far, here] + column[here, near] + column[here, far]
    bend[here, here] = column[here, here] - np.float32(0.25) * sides
    # All five are matched, and in the image.
    five = np.zeros((side, side), np.uint8)
    five[radius, ::radius] = five[::radius, radius] = 1
    use = cv2.erode(keep.view(np.uint8), five, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    bend *= use
    relief, count = window_sum32(bend * bend, side), np.maximum(window_count(use.view(bool), side), 1)
    missing, room = window_count(~keep, SURROUNDINGS_SIDE_PX), window_room(keep.shape, SURROUNDINGS_SIDE_PX)
    share = np.divide(missing, room, dtype=np.float32, casting="same_kind")
    return np.divide(relief, count, dtype=np.float32, casting="same_kind"), share
