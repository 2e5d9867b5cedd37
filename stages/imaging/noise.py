"""Noise of an image, from the image alone.

White noise halves from one pyramid level to the next (the mean of 2 x 2 pixels), texture does not: it is mostly as
strong at twice the finest scale. With v0 and v1 the mean squared second differences of the two finest levels, scaled so
that white noise of variance n^2 gives n^2 at level 0,

    v0 = n^2 + t^2,  v1 = n^2 / 4 + t^2   =>   n^2 = (v0 - v1) / (1 - 1/4)

in each block of 16 x 16 pixels; the median of the blocks is the image's. The second difference across rows and columns
is Immerkaer's (1996), blind to planes and straight edges. If texture is stronger at twice the finest scale, n is 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rille.stages.core.declare import AnyArray

BLOCK_SIDE_PX = 16
"""Pixels of level 0; half as many of level 1."""

SECOND_DIFFERENCE = np.array([1, -2, 1], np.float32) / np.sqrt(np.float32(6))
"""Filter that keeps the variance of white noise."""


def standard_deviation(images: Sequence[AnyArray], masks: Sequence[AnyArray]) -> float:
    """Standard deviation of an image's noise, grey levels; 0 where it cannot be separated from texture.

    Parameters
    ----------
    images, masks : (row, col) float32 grey values and uint8 masks (1 = usable) of the two finest levels, or more.
    """
    if len(images) < 2 or min(images[0].shape) < 3 * BLOCK_SIDE_PX:
        return 0.0
    squares = [_mean_squares(images[level], masks[level], BLOCK_SIDE_PX >> level) for level in (0, 1)]
    rows, cols = squares[0].shape
    variances = (squares[0] - squares[1][:rows, :cols]) / 0.75
    variances = variances[~np.isnan(variances)]
    return float(np.sqrt(max(np.median(variances), 0.0))) if variances.size >= 20 else 0.0


def _mean_squares(image: AnyArray, mask: AnyArray, side: int) -> AnyArray:
    """Mean squared second differences of all but the outermost blocks of ``side`` pixels; NaN if a pixel is masked."""
    rows, cols = (size // side for size in image.shape)
    bend = cv2.sepFilter2D(image, cv2.CV_32F, SECOND_DIFFERENCE, SECOND_DIFFERENCE)
    square = np.where(mask, bend * bend, np.float32(np.nan))
    blocks = cv2.resize(square[: rows * side, : cols * side], (cols, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(blocks[1:-1, 1:-1])
