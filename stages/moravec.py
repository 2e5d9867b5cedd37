"""Interest points by a derivative of the Moravec operator, spread over the image (section 5.2.1).

The operator is the least of the sums of squared differences between a window and the window shifted by one pixel along
each of four directions: zero on flat grey and along an edge, large only where every shift changes the image. Moravec
(1980), Obstacle avoidance and navigation in the real world by a seeing robot rover, CMU-RI-TR-3.

Derivative: the window is 5 x 5, both senses of a direction count alike, and points are taken by rank within buckets of
equal size instead of by strength over the whole image, so that landmarks surround the camera.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
HALF = 2
"""Half the window: 5 x 5 pixels hold a corner of the finest feature kernels."""


def interest_operator(image: Floats) -> Floats:
    """Least directional sum of squared differences of a grey image (rows, cols); grey levels squared.

    The three outermost pixels, where a window leaves the image, are 0.
    """
    rows, cols = image.shape
    out = np.zeros((rows, cols), np.float32)
    reach = HALF + 1
    if min(rows, cols) <= 2 * reach:
        return out
    least: Floats | None = None
    for dr, dc in DIRECTIONS:
        square = np.zeros((rows, cols), np.float32)
        for sr, sc in ((dr, dc), (-dr, -dc)):
            a = image[1:-1, 1:-1]
            b = image[1 + sr : rows - 1 + sr, 1 + sc : cols - 1 + sc]
            square[1:-1, 1:-1] += (b - a) ** 2
        ssd = _window_sum(square) * np.float32(0.5)
        least = ssd if least is None else np.minimum(least, ssd)
    assert least is not None
    out[reach:-reach, reach:-reach] = least[reach - HALF : -(reach - HALF), reach - HALF : -(reach - HALF)]
    return out


def _window_sum(a: Floats) -> Floats:
    """Sums (rows - 4, cols - 4) over 5 x 5 windows, in a fixed order."""
    n = 2 * HALF + 1
    rows, cols = a.shape
    tall = a[: rows - n + 1].copy()
    for i in range(1, n):
        tall += a[i : rows - n + 1 + i]
    wide = tall[:, : cols - n + 1].copy()
    for i in range(1, n):
        wide += tall[:, i : cols - n + 1 + i]
    return wide


def interest_points(
    image: Floats,
    valid: NDArray[np.uint8],
    count: int,
    *,
    noise: float,
    border: int,
    occupied: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:
    """At most ``count`` interest points, the strongest of each bucket first.

    Parameters
    ----------
    image, valid : (rows, cols) grey 0..255 and mask, 1 usable; no point within ``border`` pixels of an unusable one.
    count : points wanted; also about the number of buckets.
    noise : grey levels; a point must exceed three times what noise of this standard deviation alone gives.
    border : pixels kept free of points, so that the templates of matching lie inside.
    occupied : (n, 2) column, row of points that already hold their bucket; only empty buckets get new ones.

    Returns
    -------
    (n, 2) column, row, whole pixels; by bucket rank, then strength.
    """
    response = interest_operator(image)
    usable = _peaks(response) & _inside(valid, border)
    # The expected sum of squared differences of pure noise is 2 sigma^2 for each of the 25 pixels.
    usable &= response > 3.0 * 2.0 * (2 * HALF + 1) ** 2 * noise**2
    rows, cols = np.nonzero(usable)
    side = max(math.sqrt(image.shape[0] * image.shape[1] / max(count, 1)), 1.0)
    across = math.ceil(image.shape[1] / side)
    bucket = (rows // side).astype(np.int64) * across + (cols // side).astype(np.int64)
    if occupied is not None and len(occupied):
        seen = np.floor(occupied / side).astype(np.int64)
        empty = ~np.isin(bucket, seen[:, 1] * across + seen[:, 0])
        rows, cols, bucket = rows[empty], cols[empty], bucket[empty]
    strength = response[rows, cols]
    order = np.lexsort((cols, rows, -strength, bucket))
    rank = np.arange(len(order)) - np.searchsorted(bucket[order], bucket[order], side="left")
    if occupied is not None:
        order, rank = order[rank == 0], rank[rank == 0]
    best = order[np.lexsort((-strength[order], rank))][:count]
    return np.stack([cols[best], rows[best]], axis=-1).astype(np.float32)


def _peaks(response: Floats) -> Bools:
    """Greatest of its 5 x 5 neighbourhood; of equal ones the first in reading order."""
    rows, cols = response.shape
    peak = response > 0
    padded = np.pad(response, HALF, constant_values=-1.0)
    for dr in range(-HALF, HALF + 1):
        for dc in range(-HALF, HALF + 1):
            other = padded[HALF + dr : HALF + dr + rows, HALF + dc : HALF + dc + cols]
            if (dr, dc) < (0, 0):
                peak &= response > other
            elif (dr, dc) > (0, 0):
                peak &= response >= other
    return peak


def _inside(valid: NDArray[np.uint8], border: int) -> Bools:
    """Pixels at least ``border`` away from the image's edge and from anything unusable (Chebyshev distance)."""
    good = np.pad(valid != 0, border, constant_values=False).astype(np.int32)
    for axis in (0, 1):
        total = np.cumsum(good, axis=axis)
        total = np.concatenate([np.zeros_like(total.take([0], axis)), total], axis=axis)
        n = total.shape[axis] - (2 * border + 1)
        full = total.take(range(2 * border + 1, 2 * border + 1 + n), axis) - total.take(range(n), axis)
        good = (full == 2 * border + 1).astype(np.int32)
    return good.astype(bool)


def clear_of_mask(valid: NDArray[np.uint8], points: NDArray[np.float64], border: int) -> Bools:
    """Whether points (n, 2) are at least ``border`` pixels away from the image's edge and from anything unusable."""
    rows, cols = valid.shape
    p = np.floor(np.where(np.isfinite(points), points, -1.0) + 0.5).astype(np.intp)
    inside = ((p >= border) & (p < np.array([cols, rows]) - border)).all(1)
    p[~inside] = border
    dy, dx = (o.ravel() for o in np.mgrid[-border : border + 1, -border : border + 1])
    window = valid[np.clip(p[:, 1:] + dy, 0, rows - 1), np.clip(p[:, :1] + dx, 0, cols - 1)]
    return np.asarray(inside & (window.min(axis=1) != 0))
