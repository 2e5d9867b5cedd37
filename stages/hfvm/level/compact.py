"""A second, compact feature set: grey steps from a pixel to its eight neighbours.

The kernels of Table 1 reach six pixels and so carry a foreground's disparity beyond its edge. Where the choice among
candidates has been narrowed down by them, steps that reach one pixel place the edge. As the other features they enter
as signed square roots, one byte each, and know nothing of the images' brightness.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.level.features import Words

NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Rows and columns to the neighbour of each byte, lowest byte first."""

SCALE = np.float32(8.0)
"""Byte steps per root of a grey level: the greatest step, 255, just fills a byte."""


def pack(image: AnyArray) -> Words:
    """Compact features of one image.

    Parameters
    ----------
    image : (row, col) float32, grey 0..255; completed by repeating its edge.

    Returns
    -------
    (row, col) uint64, byte k is ``128 + round(8 sign(s) sqrt|s|)`` of the step s to neighbour k, clipped.
    """
    words = np.empty(image.shape, np.uint64)
    _pack(cv2.copyMakeBorder(np.asarray(image, np.float32), 1, 1, 1, 1, cv2.BORDER_REPLICATE), words)
    return words


@njit(cache=True, nogil=True)
def _pack(framed, words):  # type: ignore[no-untyped-def]
    """Words of an image that has a frame of one pixel."""
    # 128 stands for no step, so that the sign fits into a byte; the half more makes truncation round.
    middle, top = np.float32(128.5), np.float32(255.0)
    for y in range(words.shape[0]):
        for x in range(words.shape[1]):
            word = np.uint64(0)
            for k in range(len(NEIGHBOURS)):
                step = framed[y + 1 + NEIGHBOURS[k][0], x + 1 + NEIGHBOURS[k][1]] - framed[y + 1, x + 1]
                root = SCALE * np.sqrt(abs(step))
                byte = min(max(middle + (root if step > 0 else -root), np.float32(0.0)), top)
                word |= np.uint64(byte) << np.uint64(8 * k)
            words[y, x] = word
