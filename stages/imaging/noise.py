"""Noise of an image, from the image alone.

White noise halves from one pyramid level to the next (the mean of 2 x 2 pixels), texture does not: what an image shows
at the finest scale it mostly shows at twice that scale as well. With v0 and v1 the mean squared second differences of
the two finest levels, scaled so that white noise of variance n^2 gives n^2 at level 0,

    v0 = n^2 + t^2,  v1 = n^2 / 4 + t^2   =>   n^2 = (v0 - v1) / (1 - 1/4)

in each block of 16 x 16 pixels; the median of the blocks is the image's. The second difference across rows and columns
is Immerkaer's (1996), blind to planes and straight edges. Where fine texture is stronger at twice its scale, n is 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rille.stages.core.declare import AnyArray

BLOCK_SIDE_PX = 16
"""Pixels of level 0; level 1 shows the same block by half as many."""

MAX_PIXELS = 1 << 20
"""Pixels: of a larger image only every so many rows of blocks are looked at."""

MIN_BLOCKS = 20
"""Blocks without a masked pixel that an estimate needs."""


def standard_deviation(images: Sequence[AnyArray], masks: Sequence[AnyArray]) -> float:
    """Standard deviation of an image's noise, grey levels; 0 where it cannot be separated from texture.

    Parameters
    ----------
    images, masks : (row, col) float32 grey values and uint8 masks (1 = usable) of the two finest levels, or more.
    """
    if len(images) < 2 or min(images[0].shape) < 3 * BLOCK_SIDE_PX:
        return 0.0
    rows, cols = images[0].shape
    blocks = cols // BLOCK_SIDE_PX - 2
    step = BLOCK_SIDE_PX * max(1, images[0].size // MAX_PIXELS)
    tops = range(BLOCK_SIDE_PX, rows - 2 * BLOCK_SIDE_PX + 1, step)
    squares = [
        np.stack([_mean_squares(images[level], masks[level], y >> level, BLOCK_SIDE_PX >> level, blocks) for y in tops])
        for level in (0, 1)
    ]
    variances = (squares[0] - squares[1]) / 0.75
    variances = variances[~np.isnan(variances)]
    return float(np.sqrt(max(np.median(variances), 0.0))) if variances.size >= MIN_BLOCKS else 0.0


def _mean_squares(image: AnyArray, mask: AnyArray, top: int, side: int, blocks: int) -> AnyArray:
    """Mean squared second differences of so many blocks of ``side`` rows from ``top`` on, the first one of them left
    out; NaN where a pixel is masked."""
    right = (blocks + 1) * side
    # The blocks' pixels, and one more to each side.
    bend = np.diff(np.diff(image[top - 1 : top + side + 1, side - 1 : right + 1], 2, axis=0), 2, axis=1)
    # White noise of variance 1 has a second difference of variance 6 along an axis, 36 along both.
    square = np.square(bend, dtype=np.float64) / 36.0
    square[mask[top : top + side, side:right] == 0] = np.nan
    return np.asarray(square.reshape(side, -1, side).mean(axis=(0, 2)))
