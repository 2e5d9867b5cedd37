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
    rows = images[0].shape[0]
    step = BLOCK_SIDE_PX * max(1, images[0].size // MAX_PIXELS)
    parts = [_blocks(images, masks, y) for y in range(BLOCK_SIDE_PX, rows - 2 * BLOCK_SIDE_PX + 1, step)]
    variances = np.concatenate(parts) if parts else np.empty(0)
    return float(np.sqrt(max(np.median(variances), 0.0))) if variances.size >= MIN_BLOCKS else 0.0


def _blocks(images: Sequence[AnyArray], masks: Sequence[AnyArray], y: int) -> AnyArray:
    """Variances of the noise in the blocks of 16 rows from ``y`` on, those with a masked pixel left out."""
    count = images[0].shape[1] // BLOCK_SIDE_PX - 2
    fine, coarse = (
        _mean_squares(images[level], masks[level], y >> level, BLOCK_SIDE_PX >> level, count) for level in (0, 1)
    )
    variances = (fine - coarse) / 0.75
    return np.asarray(variances[~np.isnan(variances)])


def _mean_squares(image: AnyArray, mask: AnyArray, first: int, side: int, count: int) -> AnyArray:
    """Mean squared second differences (count,) of the blocks in the ``side`` rows from ``first`` on, the outermost two
    left out; NaN where a pixel is masked. ``side``: a multiple of eight."""
    rows, cols = slice(first, first + side), slice(side, side * (count + 1))
    around = image[first - 1 : first + side + 1, side - 1 : side * (count + 1) + 1].astype(np.float64)
    # White noise of variance 1 has a second difference of variance 6 along an axis, 36 along both.
    bend = np.diff(np.diff(around, 2, axis=0), 2, axis=1) / 6.0
    sums = np.where(mask[rows, cols], bend * bend, np.nan).reshape(side, count, side // 8, 8).sum(axis=2)
    for _ in range(3):
        # Pairs: this order fixes the last digits.
        sums = sums[..., ::2] + sums[..., 1::2]
    return np.asarray(sums[..., 0].sum(axis=0) / (side * side))
