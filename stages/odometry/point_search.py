"""Feature-vector matching of given points at full resolution (paper, 5.2.1, second iteration).

A single pixel's distance finds a point to .27 px, distances summed over 7 x 7 pixels to .15 px. The template is
resampled at the point's sub-pixel position, and under an affinity if one is given, so that a change of scale between
the images does not spoil it. Found points are matched back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.geometry.cubic import cubic
from rille.stages.hfvm import features
from rille.stages.hfvm.native.reference import linear
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import Pyramid

SUM_RADIUS = 3
SIDE = 2 * SUM_RADIUS + 1
"""Side [pixels] of the square over which distances are summed."""

BACKMATCH = 1.0
"""Largest distance [pixels] between a point and the result of matching it there and back (4.3.3)."""
BACK_RADIUS = 3
"""Largest search radius [pixels] of back-matching: three times the permitted error; smaller ones refuse too little."""

WEIGHTS = HfvmParams().weights
THRESHOLD = 90.0
"""Mean distance [byte steps] above which a point does not count as found."""


def match_points(
    a: Pyramid, b: Pyramid, points: Floats, predicted: Floats, affinity: Floats, radius: int
) -> tuple[Floats, Floats]:
    """Sub-pixel positions in image ``b`` of points of image ``a`` (level 0 of two pyramids).

    Parameters
    ----------
    points, predicted : (n, 2) column, row in a, and about where in b, pixels; NaN rows are lost.
    affinity : (n, 2, 2) maps offsets from the point in a to offsets in b (column, row).
    radius : pixels searched to every side of the prediction.

    Returns
    -------
    position : (n, 2) column, row in b; NaN where not found.
    distance : (n,) mean distance of the feature vectors, byte steps; NaN likewise.

    Notes
    -----
    A point is lost where its prediction leaves the image, where it or its match does or lies on a masked pixel, where
    the least distance exceeds :data:`THRESHOLD` or lies on the border of the search area, and where back-matching
    fails.
    """
    n = len(points)
    a_image, b_image = a.filled[0], b.filled[0]
    a_valid, b_valid = a.valid[0], b.valid[0]
    usable = np.isfinite(np.concatenate([points, predicted, affinity.reshape(n, 4)], axis=1)).all(axis=1)
    # An affinity that folds the template to a tenth of its area or less draws no texture.
    usable &= np.abs(np.linalg.det(np.where(usable[:, None, None], affinity, np.eye(2)))) > 0.1
    found, cost = np.full((n, 2), np.nan), np.full(n, np.nan)
    who = np.flatnonzero(usable)
    there, there_cost = _search(a_image, b_image, points[who], predicted[who], affinity[who], radius)
    good = np.isfinite(there_cost) & (there_cost <= THRESHOLD)
    good &= _on_valid(a_valid, points[who]) & _on_valid(b_valid, there)
    who, there, there_cost = who[good], there[good], there_cost[good]
    # The way back starts at the point itself: it must lead there within a pixel, so little is searched.
    inverse, reach = np.asarray(np.linalg.inv(affinity[who])), min(radius, BACK_RADIUS)
    back, _ = _search(b_image, a_image, there, points[who], inverse, reach)
    good = np.hypot(*(back - points[who]).T) <= BACKMATCH
    who = who[good]
    found[who], cost[who] = there[good], there_cost[good]
    return found, cost


def _on_valid(valid: Bytes, points: Floats) -> Bools:
    """Whether the nearest pixel of each point exists and is usable."""
    known = np.asarray(np.isfinite(points).all(axis=1))
    x, y = np.rint(np.where(known[:, None], points, 0.0)).astype(np.int64).T
    inside = known & (x >= 0) & (x < valid.shape[1]) & (y >= 0) & (y < valid.shape[0])
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    return np.asarray(inside & (valid[y, x] != 0))


def _search(
    a: Floats32,
    b: Floats32,
    points: Floats,
    predicted: Floats,
    affinity: Floats,
    radius: int,
) -> tuple[Floats, Floats]:
    """Best positions (n, 2) and mean distances (n,), NaN where not found, one direction."""
    whole = np.rint(predicted)
    scale = np.asarray(WEIGHTS, np.float32) * np.float32(features.STEPS_PER_UNIT)
    offset, cost = np.zeros((len(points), 2)), np.full(len(points), -1.0)
    # The template is drawn as b shows it: offsets in b are taken back to a.
    inverse = np.ascontiguousarray(np.linalg.inv(affinity))
    templates = _Templates(np.ascontiguousarray(points), whole.astype(np.int64), inverse)
    _search_all(a, b, templates, radius, scale, offset, cost)
    lost = cost < 0
    return np.where(lost[:, None], np.nan, whole + offset), np.where(lost, np.nan, cost)


class _Templates(NamedTuple):
    """``points`` (n, 2) in a, the pixels (n, 2) of b that they are searched around, and the affinities (n, 2, 2)
    through which they are drawn."""

    points: Floats
    whole: NDArray[np.int64]
    shape: Floats


@njit(cache=True, nogil=True)
def _search_all(a, b, templates, radius, scale, offset, cost):  # type: ignore[no-untyped-def]
    """Each point by itself: its template, the area around its prediction, and where in it the template fits best."""
    # Features at all places of the sum need their kernels' reach around.
    side = 2 * (SUM_RADIUS + features.RADIUS) + 1
    wide = side + 2 * (radius + 1)
    template, area = np.zeros((side, side), np.float32), np.empty((wide, wide), np.float32)
    m = wide - 2 * features.RADIUS
    words, searched = np.empty((SIDE, SIDE), np.uint64), np.empty((m, m), np.uint64)
    deviation = np.empty((m, m), np.float32)
    for k in range(len(templates.points)):
        x, y = templates.points[k]
        if not _cut(a, x, y, templates.shape[k], template) or not _copy(b, templates.whole[k], area):
            continue
        features.pack_rows(template, 0, scale, words, deviation)
        features.pack_rows(area, 0, scale, searched, deviation)
        cost[k] = _best(words.view(np.uint8), searched.view(np.uint8), radius + 1, offset[k])


@njit(cache=True, nogil=True)
def _cut(image, px, py, shape, out):  # type: ignore[no-untyped-def]
    """Patch around a point, pixel offsets taken through ``shape``; False where its centre is off the image.

    Positions beyond the border take the nearest inner one; corners stay what they were.
    """
    rows, cols = image.shape
    side = out.shape[0]
    if not (px >= 0 and px <= cols - 1 and py >= 0 and py <= rows - 1) or rows < 4 or cols < 4:
        return False
    for j in range(side):
        for i in range(side):
            dx, dy = i - side // 2, j - side // 2
            # Features look along their row, their column and at 5 x 5 pixels: none reads the patch's corners.
            if min(abs(dx), abs(dy)) > SUM_RADIUS and max(abs(dx), abs(dy)) > SUM_RADIUS + features.VARIANCE_RADIUS:
                continue
            x = px + shape[0, 0] * dx + shape[0, 1] * dy
            y = py + shape[1, 0] * dx + shape[1, 1] * dy
            # Cubic interpolation reads one pixel before and two behind.
            x, y = min(max(x, 1.0), cols - 2.001), min(max(y, 1.0), rows - 2.001)
            out[j, i] = cubic(image, x, y)
    return True


@njit(cache=True, nogil=True)
def _copy(image, point, out):  # type: ignore[no-untyped-def]
    """As :func:`_cut`, around a whole pixel and without a change of shape."""
    rows, cols = image.shape
    half = out.shape[0] // 2
    px, py = point
    if not (px >= 0 and px <= cols - 1 and py >= 0 and py <= rows - 1 and rows >= 4 and cols >= 4):
        return False
    for j in range(out.shape[0]):
        # As the template, which is interpolated and so keeps a pixel from the border: both must repeat the same pixels.
        y = min(max(py + j - half, 1), rows - 2)
        for i in range(out.shape[1]):
            out[j, i] = image[y, min(max(px + i - half, 1), cols - 2)]
    return True


@njit(cache=True, nogil=True)
def _sum_at(template, area, u, v, most):  # type: ignore[no-untyped-def]
    """Summed distance (Eq. 1, absolute form) at a place of the area; given up after the row that exceeds ``most``.

    Both as bytes, eight a pixel.
    """
    total = np.int64(0)
    for j in range(SIDE):
        a, b = template[j], area[v + j, 8 * u : 8 * (u + SIDE)]
        for i in range(8 * SIDE):
            total += max(a[i], b[i]) - min(a[i], b[i])
        if total > most:
            break
    return total


@njit(cache=True, nogil=True)
def _best(template, area, middle, offset):  # type: ignore[no-untyped-def]
    """Mean distance of a template at its best place in an area, of equals the first in reading order; -1 at the border.

    ``middle`` places to every side of the prediction; ``offset`` (2,) from there, with linear sub-pixel parts.
    """
    all_of_it = np.int64(2**62)
    most, bu, bv = all_of_it, middle, middle
    # From the prediction outwards, so that most places are given up early.
    for ring in range(middle + 1):
        for v in range(middle - ring, middle + ring + 1):
            step = 1 if abs(v - middle) == ring else max(2 * ring, 1)
            for u in range(middle - ring, middle + ring + 1, step):
                total = _sum_at(template, area, u, v, most)
                # Rings are no reading order: of equals the first in reading order is kept all the same.
                if total < most or (total == most and (v < bv or (v == bv and u < bu))):
                    most, bu, bv = total, u, v
    # At the rim the least distance may lie beyond it, and the sub-pixel part has no neighbour there.
    if min(bu, bv) < 1 or max(bu, bv) > 2 * middle - 1:
        return -1.0
    before = _sum_at(template, area, bu - 1, bv, all_of_it)
    behind = _sum_at(template, area, bu + 1, bv, all_of_it)
    above = _sum_at(template, area, bu, bv - 1, all_of_it)
    below = _sum_at(template, area, bu, bv + 1, all_of_it)
    offset[0] = bu - middle + linear(before, most, behind)
    offset[1] = bv - middle + linear(above, most, below)
    return most / (SIDE * SIDE)
