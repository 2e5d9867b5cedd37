"""Search in wide windows along epipolar lines: for what no small window tells.

Of each pixel of a region the step along its line is found whose distances of features, summed over a window of
:data:`SIDE` x :data:`SIDE` pixels of the region, are least; by how much; and whether the match is mutual.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.images.window import Window
from rille.stages.hfvm.level import epipolar
from rille.stages.hfvm.level.features import distance
from rille.stages.numeric.windows import window_count, window_sum32

RADIUS = 6
SIDE = 2 * RADIUS + 1
"""Side of the window, pixels."""

CAP = 60
"""Greatest distance of two features [byte steps]: about three times that of noise."""

APART = 2
"""Steps from the best one to those that it must be distinct from."""

Images = tuple[AnyArray, tuple[AnyArray, AnyArray]]
"""Features of a window of the left image; features and mask of the whole right image."""


class Searched(NamedTuple):
    """What a search tells of each pixel of a region, (row, col).

    ``tried``: int32, steps that leave all of its window inside the right image. ``best, least``: float32, the step with
    the least sum of distances over the window, moved by a fraction, and that sum. ``distinct``: float32, by how much
    the sum of each step more than :data:`APART` from the best one exceeds it, 0 where there is none. ``mutual``: bool,
    whether no step so far from it leads a window more alike to the same pixel.
    """

    tried: AnyArray
    best: AnyArray
    least: AnyArray
    distinct: AnyArray
    mutual: NDArray[np.bool_]


def search(
    images: Images,
    region: NDArray[np.bool_],
    lines: AnyArray,
    steps: AnyArray,
    window: Window,
) -> Searched:
    """Search for the best step along the line of each pixel of a region.

    Parameters
    ----------
    region : (row, col) bool, pixels of the window.
    lines : of these pixels, see :func:`rille.stages.hfvm.level.epipolar.lines`.
    steps : (n,) float32 pixels, ascending by 1.
    window : where the left window lies.
    """
    rows, cols = images[1][1].shape
    best, tried = np.zeros(region.shape, np.float32), np.zeros(region.shape, np.int32)
    least, before, after, previous, passed, behind, ahead = np.full((7, *region.shape), np.inf, np.float32)
    size = np.maximum(window_count(region, SIDE), 1)
    claims = np.full((2, rows, cols), np.inf, np.float32)
    last: deque[AnyArray] = deque()
    for step in steps:
        at = np.full(region.shape, step), window.x0, window.y0
        total = _sums(images, region, lines, at)
        tried += np.isfinite(total)
        _claim(total / size, lines, at, claims)
        if len(last) > APART:
            np.minimum(passed, last.popleft(), out=passed)
        last.append(total)
        _keep(total, step, (previous, passed), (least, best, before, after, behind, ahead))
        previous = total
    rival = np.minimum(behind, ahead)
    distinct = np.subtract(rival, least, out=np.zeros_like(rival), where=np.isfinite(rival))
    mutual = np.zeros_like(region)
    _claimed(least, lines, (best, window.x0, window.y0), claims[1], mutual)
    return Searched(tried, best + _fraction(before, least, after), least, distinct, mutual)


def _fraction(before: AnyArray, least: AnyArray, after: AnyArray) -> AnyArray:
    """Where two lines of opposite slopes through three sums meet, steps from the middle one; 0 at an end of the steps.

    Sums of absolute differences are more like two lines than like a parabola.
    """
    inner = np.isfinite(before) & np.isfinite(after)
    rise = np.subtract(np.maximum(before, after), least, out=np.zeros_like(least), where=inner)
    fall = np.subtract(before, after, out=np.zeros_like(least), where=inner)
    return np.divide(0.5 * fall, rise, out=np.zeros_like(least), where=rise > 0)


def excess(
    images: Images, region: NDArray[np.bool_], lines: AnyArray, at: tuple[AnyArray, int, int], least: AnyArray
) -> AnyArray:
    """By how much a pixel's distance, mean of the window, exceeds that of the window's ``least`` sum at other steps.

    ``at``: steps (row, col) float32, and column and row of the left window. Infinite where a step leads out of the
    right image.
    """
    sums = _sums(images, region, lines, at)
    more = np.subtract(sums, least, out=np.full_like(sums, np.inf), where=np.isfinite(sums) & np.isfinite(least))
    return np.asarray(more / np.maximum(window_count(region, SIDE), 1))


def _sums(images: Images, region: NDArray[np.bool_], lines: AnyArray, at: tuple[AnyArray, int, int]) -> AnyArray:
    """Sum (row, col) of the distances of a region's pixels in each window, float32; infinite outside of the region and
    where one of them leads out of the right image."""
    cost, outside = np.zeros(region.shape, np.float32), np.zeros(region.shape, np.uint8)
    _distances(images, region, lines, at, (cost, outside))
    total = window_sum32(cost, SIDE)
    total[(cv2.dilate(outside, np.ones((SIDE, SIDE), np.uint8)) != 0) | ~region] = np.inf
    return total


@njit(cache=True, nogil=True)
def _end(lines, y, x, at):  # type: ignore[no-untyped-def]
    """Row and column of the right image that its step along its line leads a pixel to."""
    step, x0, y0 = at
    u, v = epipolar.on_line((lines[y, x, 0], lines[y, x, 1], lines[y, x, 2]), step[y, x])
    return np.int64(np.rint(y + y0 + v)), np.int64(np.rint(x + x0 + u))


@njit(cache=True, nogil=True)
def _distances(images, region, lines, at, out):  # type: ignore[no-untyped-def]
    """Distances of a region's pixels to those their step away along their lines; ``outside``: whether there is none."""
    (left, (right, valid)), (cost, outside) = images, out
    rows, cols = right.shape
    for y in range(region.shape[0]):
        for x in range(region.shape[1]):
            if region[y, x]:
                j, i = _end(lines, y, x, at)
                outside[y, x] = i < 0 or i >= cols or j < 0 or j >= rows or not valid[j, i]
                if not outside[y, x]:
                    cost[y, x] = min(distance(left[y, x], right[j, i]), CAP)


@njit(cache=True, nogil=True)
def _claim(mean, lines, at, claims):  # type: ignore[no-untyped-def]
    """Of each right pixel the least ``mean`` distance of the windows led to it, and the step that did."""
    for y in range(mean.shape[0]):
        for x in range(mean.shape[1]):
            if mean[y, x] < np.inf:
                j, i = _end(lines, y, x, at)
                if mean[y, x] < claims[0, j, i]:
                    claims[0, j, i], claims[1, j, i] = mean[y, x], at[0][y, x]


@njit(cache=True, nogil=True)
def _claimed(least, lines, at, steps, mutual):  # type: ignore[no-untyped-def]
    """Whether the step that claims the right pixel is like the pixel's own."""
    for y in range(least.shape[0]):
        for x in range(least.shape[1]):
            if least[y, x] < np.inf:
                j, i = _end(lines, y, x, at)
                mutual[y, x] = abs(steps[j, i] - at[0][y, x]) <= APART


@njit(cache=True, nogil=True)
def _keep(total, step, earlier, out):  # type: ignore[no-untyped-def]
    """The best step so far of each pixel, and its sum; the sums beside it; the least ones far behind it and ahead.

    ``earlier``: the sums of the step before; the least of all steps more than APART behind this one.
    """
    (previous, passed), (least, best, before, after, behind, ahead) = earlier, out
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            if total[y, x] < least[y, x]:
                least[y, x], best[y, x] = total[y, x], step
                before[y, x], after[y, x] = previous[y, x], np.inf
                behind[y, x], ahead[y, x] = passed[y, x], np.inf
            elif step - best[y, x] == 1:
                after[y, x] = total[y, x]
            elif step - best[y, x] > APART:
                ahead[y, x] = min(ahead[y, x], total[y, x])
