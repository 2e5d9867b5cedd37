"""Search in wide windows along epipolar lines: for what no small window tells.

Of each pixel of a region the step along its line is found whose distances of features, summed over a square window of
the region, are least; by how much; and whether the match is mutual.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.features import distance
from rille.stages.hfvm.windows import Window
from rille.stages.numeric.windows import window_count, window_sum32

WINDOW_RADIUS_PX = 6
WINDOW_SIDE_PX = 2 * WINDOW_RADIUS_PX + 1
"""Side of the window, pixels."""

MAX_DISTANCE = 60
"""Greatest distance of two features [byte steps]: about three times that of noise."""

MIN_DISTINCT_STEPS = 2
"""Steps from the best one to those that it must be distinct from."""


class WordPair(NamedTuple):
    """Features of both images and mask of the right one, (row, col); ``window``: where the region lies in the left."""

    left: AnyArray
    right: AnyArray
    valid: AnyArray
    window: Window


class Searched(NamedTuple):
    """What a search tells of each pixel of a region, (row, col).

    ``tried``: int32, steps that leave all of its window inside the right image. ``best, least``: float32, the step with
    the least sum of distances over the window, moved by a fraction, and that sum. ``distinct``: float32, by how much
    the sum of each step more than :data:`MIN_DISTINCT_STEPS` from the best one exceeds it, 0 where there is none.
    ``mutual``: bool, whether no step so far from it leads a window more alike to the same pixel.
    """

    tried: AnyArray
    best: AnyArray
    least: AnyArray
    distinct: AnyArray
    mutual: NDArray[np.bool_]


class Best(NamedTuple):
    """Of each pixel so far: the best step; its sum; the sums a step before and after it; the least ones far from it."""

    step: AnyArray
    least: AnyArray
    before: AnyArray
    after: AnyArray
    behind: AnyArray
    ahead: AnyArray


def search(images: WordPair, region: NDArray[np.bool_], lines: AnyArray, steps: AnyArray) -> Searched:
    """Search for the best step along the line of each pixel of a region.

    Parameters
    ----------
    region : (row, col) bool, pixels of the window.
    lines : of these pixels, see :func:`rille.stages.hfvm.epipolar.lines`.
    steps : (n,) float32 pixels, ascending by 1.
    """
    rows, cols = images.valid.shape
    best, tried = np.zeros(region.shape, np.float32), np.zeros(region.shape, np.int32)
    searched = Best(best, *np.full((5, *region.shape), np.inf, np.float32))
    previous, passed = np.full((2, *region.shape), np.inf, np.float32)
    size = np.maximum(window_count(region, WINDOW_SIDE_PX), 1)
    claims = np.full((2, rows, cols), np.inf, np.float32)
    last: deque[AnyArray] = deque()
    for step in steps:
        at = np.full(region.shape, step)
        total = _sums(images, region, lines, at)
        tried += np.isfinite(total)
        _claim(total / size, lines, step, (images.window.x0, images.window.y0), claims)
        if len(last) > MIN_DISTINCT_STEPS:
            np.minimum(passed, last.popleft(), out=passed)
        last.append(total)
        _keep(total, step, previous, passed, searched)
        previous = total
    rival = np.minimum(searched.behind, searched.ahead)
    distinct = np.subtract(rival, searched.least, out=np.zeros_like(rival), where=np.isfinite(rival))
    mutual = np.zeros_like(region)
    _claimed(searched.least, lines, best, (images.window.x0, images.window.y0), claims[1], mutual)
    fraction = _fraction(searched.before, searched.least, searched.after)
    return Searched(tried, best + fraction, searched.least, distinct, mutual)


def _fraction(before: AnyArray, least: AnyArray, after: AnyArray) -> AnyArray:
    """Where two lines of opposite slopes through three sums meet, steps from the middle one; 0 at an end of the steps.

    Sums of absolute differences are more like two lines than like a parabola.
    """
    inner = np.isfinite(before) & np.isfinite(after)
    rise = np.subtract(np.maximum(before, after), least, out=np.zeros_like(least), where=inner)
    fall = np.subtract(before, after, out=np.zeros_like(least), where=inner)
    return np.divide(0.5 * fall, rise, out=np.zeros_like(least), where=rise > 0)


def excess(images: WordPair, region: NDArray[np.bool_], lines: AnyArray, at: AnyArray, least: AnyArray) -> AnyArray:
    """By how much a pixel's distance, mean of the window, exceeds that of the window's ``least`` sum at other steps.

    ``at``: steps (row, col) float32. Infinite where a step leads out of the
    right image.
    """
    sums = _sums(images, region, lines, at)
    more = np.subtract(sums, least, out=np.full_like(sums, np.inf), where=np.isfinite(sums) & np.isfinite(least))
    return np.asarray(more / np.maximum(window_count(region, WINDOW_SIDE_PX), 1))


class Words(NamedTuple):
    """Features of a window of the left image and of the right image, and the right one's mask."""

    left: AnyArray
    right: AnyArray
    valid: AnyArray


class Distances(NamedTuple):
    """Distances of pixels, and where there is nothing to compare them with."""

    cost: AnyArray
    outside: AnyArray


def _sums(images: WordPair, region: NDArray[np.bool_], lines: AnyArray, at: AnyArray) -> AnyArray:
    """Sum (row, col) of the distances of a region's pixels in each window, float32; infinite outside of the region and
    where one of them leads out of the right image."""
    cost, outside = np.zeros(region.shape, np.float32), np.zeros(region.shape, np.uint8)
    left = np.ascontiguousarray(images.left[images.window.slices])
    place = images.window.x0, images.window.y0
    _distances(Words(left, images.right, images.valid), region, lines, at, place, Distances(cost, outside))
    total = window_sum32(cost, WINDOW_SIDE_PX)
    total[(cv2.dilate(outside, np.ones((WINDOW_SIDE_PX, WINDOW_SIDE_PX), np.uint8)) != 0) | ~region] = np.inf
    return total


@njit(cache=True, nogil=True)
def _end(line, step, x, y):  # type: ignore[no-untyped-def]
    """Row and column of the right image that its step along its line leads a pixel to."""
    u, v = epipolar.on_line((line[0], line[1], line[2]), step)
    return np.int64(np.rint(y + v)), np.int64(np.rint(x + u))


@njit(cache=True, nogil=True)
def _distances(words, region, lines, at, place, out):  # type: ignore[no-untyped-def]
    """Distances of a region's pixels to those their step away along their lines."""
    rows, cols = words.right.shape
    for y in range(region.shape[0]):
        for x in range(region.shape[1]):
            if region[y, x]:
                j, i = _end(lines[y, x], at[y, x], x + place[0], y + place[1])
                out.outside[y, x] = i < 0 or i >= cols or j < 0 or j >= rows or not words.valid[j, i]
                if not out.outside[y, x]:
                    out.cost[y, x] = min(distance(words.left[y, x], words.right[j, i]), MAX_DISTANCE)


@njit(cache=True, nogil=True)
def _claim(mean, lines, step, place, claims):  # type: ignore[no-untyped-def]
    """Of each right pixel the least ``mean`` distance of the windows led to it, and the step that did."""
    for y in range(mean.shape[0]):
        for x in range(mean.shape[1]):
            if mean[y, x] < np.inf:
                j, i = _end(lines[y, x], step, x + place[0], y + place[1])
                if mean[y, x] < claims[0, j, i]:
                    claims[0, j, i], claims[1, j, i] = mean[y, x], step


@njit(cache=True, nogil=True)
def _claimed(least, lines, best, place, steps, mutual):  # type: ignore[no-untyped-def]
    """Whether the step that claims the right pixel is like the pixel's own."""
    for y in range(least.shape[0]):
        for x in range(least.shape[1]):
            if least[y, x] < np.inf:
                j, i = _end(lines[y, x], best[y, x], x + place[0], y + place[1])
                mutual[y, x] = abs(steps[j, i] - best[y, x]) <= MIN_DISTINCT_STEPS


@njit(cache=True, nogil=True)
def _keep(total, step, previous, passed, best):  # type: ignore[no-untyped-def]
    """Update ``best`` (:class:`Best`) with the sums of one more step.

    ``previous``: the sums of the step before; ``passed``: the least of all steps more than :data:`MIN_DISTINCT_STEPS`
    behind this one.
    """
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            if total[y, x] < best.least[y, x]:
                best.step[y, x], best.least[y, x] = step, total[y, x]
                best.before[y, x], best.after[y, x] = previous[y, x], np.inf
                best.behind[y, x], best.ahead[y, x] = passed[y, x], np.inf
            elif step - best.step[y, x] == 1:
                best.after[y, x] = total[y, x]
            elif step - best.step[y, x] > MIN_DISTINCT_STEPS:
                best.ahead[y, x] = min(best.ahead[y, x], total[y, x])
