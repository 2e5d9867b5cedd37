"""Feature-vector matching of given points at full resolution (paper, 5.2.1, second iteration).

A single pixel's distance finds a point to .27 px, distances summed over 7 x 7 pixels to .15 px. The template is
resampled at the point's sub-pixel position, and under an affinity if one is given, so that a change of scale between
the images does not spoil it. Found points are matched back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages import features
from stages.cubic import cubic
from stages.features import distance
from stages.hfvm.params import HfvmParams
from stages.hfvm.subpixel import linear
from stages.pyramid import Pyramid, filled

Floats = NDArray[np.float64]

SUM_RADIUS = 3
"""Pixels: distances are summed over 7 x 7."""

BACKMATCH = 1.0
"""Pixels: greatest distance between a point and where matching there and back leads (4.3.3)."""

DEFAULT_WEIGHTS = HfvmParams().weights


@dataclass(frozen=True)
class PointMatches:
    """``points`` (n, 2) column, row in image b; ``distance`` (n,) mean, byte steps; both NaN where not ``ok``."""

    points: Floats
    distance: Floats
    ok: NDArray[np.bool_]


def match_points(
    a: Pyramid, b: Pyramid, points: Floats, predicted: Floats, affinity: Floats | None = None, radius: int = 4
) -> Floats:
    """Positions (n, 2) in ``b`` of points of ``a``; NaN where not found. See :func:`find_points`."""
    return find_points(a, b, points, predicted, affinity, radius).points


def find_points(
    a: Pyramid,
    b: Pyramid,
    points: Floats,
    predicted: Floats,
    affinity: Floats | None = None,
    radius: int = 4,
    *,
    threshold: float = 90.0,
    weights: tuple[float, ...] = DEFAULT_WEIGHTS,
) -> PointMatches:
    """Sub-pixel positions in image ``b`` of points of image ``a`` (level 0 of two pyramids).

    Parameters
    ----------
    points, predicted : (n, 2) column, row in a, and about where in b, pixels; NaN rows are lost.
    affinity : (n, 2, 2) maps offsets from the point in a to offsets in b (column, row); None: no change of shape.
    radius : pixels searched to every side of the prediction.
    threshold : mean distance, byte steps, above which a point is not matchable.
    weights : of the eight features.

    Notes
    -----
    A point is lost where its prediction, its template or its match leaves the image or lies on a masked pixel, where
    the least distance exceeds the threshold or lies on the border of the search area, and where back-matching fails.
    """
    n = len(points)
    a_image, b_image = filled(a)[0], filled(b)[0]
    a_valid, b_valid = a.valid[0], b.valid[0]
    shape = np.tile(np.eye(2), (n, 1, 1)) if affinity is None else np.asarray(affinity, dtype=np.float64)
    usable = np.isfinite(np.concatenate([points, predicted, shape.reshape(n, 4)], axis=1)).all(axis=1)
    usable &= np.abs(np.linalg.det(np.where(usable[:, None, None], shape, np.eye(2)))) > 0.1
    found, cost, ok = np.full((n, 2), np.nan), np.full(n, np.nan), np.zeros(n, dtype=bool)
    who = np.flatnonzero(usable)
    there, there_cost = _search(a_image, b_image, points[who], predicted[who], shape[who], radius, weights)
    good = np.isfinite(there_cost) & (there_cost <= threshold)
    good &= _on_valid(a_valid, points[who]) & _on_valid(b_valid, there)
    who, there, there_cost = who[good], there[good], there_cost[good]
    back, _ = _search(b_image, a_image, there, points[who], np.asarray(np.linalg.inv(shape[who])), radius, weights)
    good = np.hypot(*(back - points[who]).T) <= BACKMATCH
    who = who[good]
    found[who], cost[who], ok[who] = there[good], there_cost[good], True
    return PointMatches(found, cost, ok)


def _on_valid(valid: NDArray[np.uint8], points: Floats) -> NDArray[np.bool_]:
    """Whether the nearest pixel of each point exists and is usable."""
    known = np.asarray(np.isfinite(points).all(axis=1))
    x, y = np.rint(np.where(known[:, None], points, 0.0)).astype(np.int64).T
    inside = known & (x >= 0) & (x < valid.shape[1]) & (y >= 0) & (y < valid.shape[0])
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    return np.asarray(inside & (valid[y, x] != 0))


def _search(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    points: Floats,
    predicted: Floats,
    affinity: Floats,
    radius: int,
    weights: tuple[float, ...],
) -> tuple[Floats, Floats]:
    """Best positions (n, 2) and mean distances (n,), NaN where not found, one direction."""
    side = 2 * (SUM_RADIUS + features.RADIUS) + 1
    wide = side + 2 * (radius + 1)
    template = np.zeros((len(points), side, side), np.float32)
    area = np.zeros((len(points), wide, wide), np.float32)
    whole = np.rint(predicted)
    inside = np.empty((2, len(points)), np.uint8)
    _cut(a, points, np.linalg.inv(affinity), template, inside[0])
    _copy(b, whole.astype(np.int64), area, inside[1])
    words = features.pack_inner(template, weights)
    searched = features.pack_inner(area, weights)
    offset, cost = np.empty((len(points), 2)), np.empty(len(points))
    _best(words, searched, radius, offset, cost)
    lost = (inside == 0).any(0) | (cost < 0)
    return np.where(lost[:, None], np.nan, whole + offset), np.where(lost, np.nan, cost)


@njit(cache=True, nogil=True)
def _cut(image, points, shape, out, inside):  # type: ignore[no-untyped-def]
    """Patches around points, pixel offsets taken through ``shape``; ``inside`` 0 where the centre is off the image.

    Positions beyond the border take the nearest inner one.
    """
    rows, cols = image.shape
    side = out.shape[1]
    for k in range(len(points)):
        px, py = points[k, 0], points[k, 1]
        inside[k] = px >= 0 and px <= cols - 1 and py >= 0 and py <= rows - 1
        if not inside[k] or rows < 4 or cols < 4:
            inside[k] = 0
            continue
        for j in range(side):
            for i in range(side):
                dx, dy = i - side // 2, j - side // 2
                x = px + shape[k, 0, 0] * dx + shape[k, 0, 1] * dy
                y = py + shape[k, 1, 0] * dx + shape[k, 1, 1] * dy
                x, y = min(max(x, 1.0), cols - 2.001), min(max(y, 1.0), rows - 2.001)
                out[k, j, i] = cubic(image, x, y)


@njit(cache=True, nogil=True)
def _copy(image, points, out, inside):  # type: ignore[no-untyped-def]
    """As :func:`_cut`, around whole pixels and without a change of shape."""
    rows, cols = image.shape
    half = out.shape[1] // 2
    for k in range(len(points)):
        px, py = points[k, 0], points[k, 1]
        inside[k] = px >= 0 and px <= cols - 1 and py >= 0 and py <= rows - 1 and rows >= 4 and cols >= 4
        if not inside[k]:
            continue
        for j in range(out.shape[1]):
            y = min(max(py + j - half, 1), rows - 2)
            for i in range(out.shape[2]):
                out[k, j, i] = image[y, min(max(px + i - half, 1), cols - 2)]


@njit(cache=True, nogil=True)
def _best(words, area, radius, offset, cost):  # type: ignore[no-untyped-def]
    """Least summed distance of each template in its area; offsets with linear sub-pixel parts, mean distance or -1."""
    n = 2 * SUM_RADIUS + 1
    side = 2 * radius + 3
    sums = np.empty((side, side), np.int64)
    for k in range(len(words)):
        for v in range(side):
            for u in range(side):
                total = np.int64(0)
                for j in range(n):
                    for i in range(n):
                        total += distance(words[k, j, i], area[k, v + j, u + i])
                sums[v, u] = total
        bu, bv = 1, 1
        for v in range(side):
            for u in range(side):
                if sums[v, u] < sums[bv, bu]:
                    bu, bv = u, v
        cost[k] = -1.0
        offset[k, 0], offset[k, 1] = 0.0, 0.0
        if bu < 1 or bu > side - 2 or bv < 1 or bv > side - 2:
            continue
        cost[k] = sums[bv, bu] / (n * n)
        offset[k, 0] = bu - radius - 1 + linear(sums[bv, bu - 1], sums[bv, bu], sums[bv, bu + 1])
        offset[k, 1] = bv - radius - 1 + linear(sums[bv - 1, bu], sums[bv, bu], sums[bv + 1, bu])
