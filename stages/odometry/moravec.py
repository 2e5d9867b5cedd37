"""Interest points by a derivative of the Moravec operator, spread over the image (section 5.2.1).

The operator is the least of the sums of squared differences between a window and the window shifted by one pixel along
each of four directions: zero on flat grey and along an edge, large only where every shift changes the image. Moravec
(1980), Obstacle avoidance and navigation in the real world by a seeing robot rover, CMU-RI-TR-3.

Derivative: the window is 5 x 5, both senses of a direction count alike, and points are taken by rank within buckets of
equal size instead of by strength over the whole image, so that landmarks surround the camera.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.odometry.displacements import windows_at

DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
HALF = 2
"""Half the window: 5 x 5 pixels hold a corner of the finest feature kernels."""
SIDE = 2 * HALF + 1
BEFORE = (np.arange(SIDE**2) < SIDE**2 // 2).astype(np.uint8).reshape(SIDE, SIDE)
"""Neighbours of a pixel that come before it in reading order."""


def interest_operator(image: Floats32) -> Floats32:
    """Least directional sum of squared differences of a grey image (rows, cols); grey levels squared.

    The three outermost pixels, where a window leaves the image, are 0.
    """
    out = np.zeros(image.shape, np.float32)
    (rows, cols), edge = image.shape, HALF + 1
    if min(rows, cols) <= 2 * edge:
        return out
    sums = list[Floats32]()
    here = image[1:-1, 1:-1]
    for dr, dc in DIRECTIONS:
        # Both senses of a direction, or the operator would prefer the side of a corner it is shifted to.
        ahead, behind = (image[1 + r : rows - 1 + r, 1 + c : cols - 1 + c] for r, c in ((dr, dc), (-dr, -dc)))
        square = 0.5 * ((ahead - here) ** 2 + (behind - here) ** 2)
        sums.append(cv2.boxFilter(square, -1, (SIDE, SIDE), normalize=False))
    out[edge:-edge, edge:-edge] = np.minimum.reduce(sums)[HALF:-HALF, HALF:-HALF]
    return out


def interest_points(
    image: Floats32,
    valid: Bytes,
    count: int,
    *,
    noise: float,
    occupied: NDArray[np.floating] | None = None,
) -> Floats32:
    """Find at most ``count`` interest points, the strongest of each bucket first.

    Parameters
    ----------
    image, valid : (rows, cols) grey 0..255 and mask, 1 usable; no point within 8 pixels of an unusable one.
    count : points wanted; also about the number of buckets.
    noise : grey levels; a point must exceed three times what noise of this standard deviation alone gives.
    occupied : (n, 2) column, row of points that already hold their bucket; only empty buckets get new ones.

    Returns
    -------
    (n, 2) column, row, whole pixels; by bucket rank, then strength.
    """
    response = interest_operator(image)
    # The expected sum of squared differences of pure noise is 2 sigma^2 for each of the 25 pixels.
    # Three times the expectation: the threshold is on a variance, so contrast must be 1.7 times the noise.
    rows, cols = _peaks(response, 3.0 * 2.0 * SIDE**2 * noise**2)
    # 8 pixels from the image's edge and its mask: template, cubic interpolation and a step of the alignment.
    inner = clear_of_mask(valid, np.stack([cols, rows], axis=-1), 8)
    rows, cols = rows[inner], cols[inner]
    side = max(math.sqrt(image.shape[0] * image.shape[1] / max(count, 1)), 1.0)
    across = math.ceil(image.shape[1] / side)
    bucket = (rows // side).astype(np.int64) * across + (cols // side).astype(np.int64)
    if occupied is not None and len(occupied):
        # The same grid of buckets as above, in which tracked points count at their present place.
        seen = np.floor(occupied / side).astype(np.int64)
        empty = ~np.isin(bucket, seen[:, 1] * across + seen[:, 0])
        rows, cols, bucket = rows[empty], cols[empty], bucket[empty]
    strength = response[rows, cols]
    # Peaks come in reading order, which a stable sort keeps among equals.
    order = np.argsort(-strength, kind="stable")
    order = order[np.argsort(bucket[order], kind="stable")]
    # First of each bucket, then second of each: the strongest point of a poor bucket comes before a rich one's second.
    rank = np.arange(len(order)) - np.searchsorted(bucket[order], bucket[order], side="left")
    if occupied is not None:
        order, rank = order[rank == 0], rank[rank == 0]
    best = order[np.lexsort((-strength[order], rank))][:count]
    return np.stack([cols[best], rows[best]], axis=-1).astype(np.float32)


def _peaks(response: Floats32, least: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of pixels above ``least``, and greatest of the 5 x 5 neighbourhood; of equal ones the first."""
    greatest = response == cv2.dilate(response, np.ones((SIDE, SIDE), np.uint8))
    rows, cols = np.divmod(np.flatnonzero(greatest & (response > least)), response.shape[1])
    first = response[rows, cols] > cv2.dilate(response, BEFORE)[rows, cols]
    return rows[first], cols[first]


def clear_of_mask(valid: Bytes, points: Floats, border: int) -> Bools:
    """Whether points (n, 2) are at least ``border`` pixels away from the image's edge and from anything unusable."""
    inside, (around,) = windows_at(points, border, valid)
    return np.asarray(inside & (around != 0).all((1, 2)))
