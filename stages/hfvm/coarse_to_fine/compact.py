"""A second, compact feature set: grey steps from a pixel to its eight neighbours (preset ``accurate``).

The kernels of Table 1 reach six pixels and so carry a foreground's disparity beyond its edge. Where the choice among
candidates has been narrowed down by them, steps that reach one pixel place the edge. As the other features they enter
as signed square roots, one byte each, and know nothing of the images' brightness.
"""

from __future__ import annotations

import numpy as np

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
    rows, cols = image.shape
    a = np.pad(np.asarray(image, np.float32), 1, mode="edge")
    words = np.zeros((rows, cols), np.uint64)
    for k, (j, i) in enumerate(NEIGHBOURS):
        step = a[1 + j : 1 + j + rows, 1 + i : 1 + i + cols] - a[1:-1, 1:-1]
        byte = np.float32(128.5) + SCALE * np.sign(step) * np.sqrt(np.abs(step))
        words |= np.clip(byte, 0, 255).astype(np.uint64) << np.uint64(8 * k)
    return words
