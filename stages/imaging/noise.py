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
from numba import njit

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
    squares = np.empty((2, images[0].shape[1] // BLOCK_SIDE_PX - 2))
    for level, side in ((0, BLOCK_SIDE_PX), (1, BLOCK_SIDE_PX // 2)):
        _mean_squares(images[level], masks[level], y >> level, side, squares[level])
    variances = (squares[0] - squares[1]) / 0.75
    return np.asarray(variances[~np.isnan(variances)])


@njit(cache=True, nogil=True)
def _mean_squares(image, mask, first, side, squares):  # type: ignore[no-untyped-def]
    """Mean squared second differences of the blocks in the ``side`` rows from ``first`` on, the outermost two left out;
    NaN where a pixel is masked. ``side``: a multiple of eight."""
    width = squares.size * side
    down, square, part = np.empty(width + 2), np.empty(width), np.empty(8)
    squares[:] = 0.0
    for y in range(first, first + side):
        # The blocks' columns, and one more to either side.
        a, b, c = image[y - 1][side - 1 :], image[y][side - 1 :], image[y + 1][side - 1 :]
        usable = mask[y][side:]
        for x in range(width + 2):
            down[x] = (np.float64(c[x]) - b[x]) - (np.float64(b[x]) - a[x])
        for x in range(width):
            # White noise of variance 1 has a second difference of variance 6 along an axis, 36 along both.
            bend = ((down[x + 2] - down[x + 1]) - (down[x + 1] - down[x])) / 6.0
            square[x] = bend * bend if usable[x] else np.nan
        for k in range(squares.size):
            # Eight sums side by side: this order fixes the last digits.
            part[:] = 0.0
            for x in range(k * side, (k + 1) * side, 8):
                for i in range(8):
                    part[i] += square[x + i]
            squares[k] += ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]))
    squares /= side * side
