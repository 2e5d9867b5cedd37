"""Lee's (1980) filter: noise is averaged where texture is hardly stronger than it, and left where texture is stronger.

With mean m and variance s^2 of the 3 x 3 pixels around it and noise of standard deviation n, a grey value a becomes

    m + max(0, 1 - EXCESS n^2 / s^2) (a - m)

(J.-S. Lee, Digital image enhancement and noise filtering by use of local statistics, IEEE Transactions on Pattern
Analysis and Machine Intelligence 2, 165-168; there EXCESS is 1.)
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import AnyArray

EXCESS = 2.5
"""The variance of nine pixels of white noise reaches 2.5 times its expectation in one of two hundred places; all others
are averaged alike. A texture of random dots, which looks like noise, then still matches where it is shifted by a
fraction of a pixel: .87 and more of it, with 1 as little as .07. Bad-2 of noisy pairs is alike from 1 to 2.5."""

PIXELS = 9
"""Pixels of the window: where it shows no texture its mean stands for the pixel, and a ninth of the noise's variance is
left."""

LEAST_VARIANCE = 1e-3
"""Squared grey levels: what rounding may leave of the variance of a flat window, or take from it."""


def lee(image: AnyArray, noise: float) -> Floats32:
    """Denoised grey values (row, col).

    Parameters
    ----------
    image : (row + 2, col + 2) float32 grey values 0..255, a pixel more to every side.
    noise : standard deviation, grey levels.
    """
    found = np.empty((image.shape[0] - 2, image.shape[1] - 2), np.float32)
    _lee(np.ascontiguousarray(image), np.float32(EXCESS * noise * noise), found)
    return found


@njit(cache=True, nogil=True)
def _lee(image, excess, found):  # type: ignore[no-untyped-def]
    """Sums of fixed order and no fast maths: values depend neither on the CPU nor on where the window begins."""
    middle, ninth, nil = np.float32(128.0), np.float32(1.0 / 9.0), np.float32(0.0)
    least = np.float32(LEAST_VARIANCE)
    sums, squares = np.empty(image.shape[1], np.float32), np.empty(image.shape[1], np.float32)
    for y in range(found.shape[0]):
        above, here, below, out = image[y], image[y + 1], image[y + 2], found[y]
        for x in range(image.shape[1]):
            # From the middle of the range: the difference of squares below then loses fewer digits.
            a, b, c = above[x] - middle, here[x] - middle, below[x] - middle
            sums[x], squares[x] = a + b + c, a * a + b * b + c * c
        for x in range(found.shape[1]):
            mean = (sums[x] + sums[x + 1] + sums[x + 2]) * ninth
            variance = max((squares[x] + squares[x + 1] + squares[x + 2]) * ninth - mean * mean, least)
            gain = max(variance - excess, nil) / variance
            out[x] = (mean + gain * (here[x + 1] - middle - mean)) + middle
