"""Running maxima, ranges and medians in windows: order statistics of the heights.

The window is an octagon rather than a square. Over a square the highest minus the lowest height of a plane is larger by
a factor of 1.41 if the plane falls along the diagonal. Over a regular octagon this factor is at most 1.08 (for small
windows see :func:`octagon`), and in no direction is the range smaller than along an axis. An octagon is a square
widened along both diagonals, so its running maximum is that of a square, then of two diagonal lines (``cv2.dilate``).

Everything here commutes with any rising function of the heights: if the relief grows, so does every difference of two
of these results (the argument is in :mod:`rille.stages.hazard.measures`).
"""

from __future__ import annotations

import cv2
import numpy as np

from rille.stages.core.arrays import Floats32

UNKNOWN_HEIGHT = np.float32(-np.inf)
"""Value of unknown cells: every height is above it."""


def octagon(reach: int) -> tuple[int, int]:
    """Return the half side of a square and the steps along each diagonal that widen it to an octagon, in cells.

    The octagon extends by exactly ``reach`` cells from its centre along the axes. Its vertices lie at (reach, side),
    where side is the first number returned: at 1.08 ``reach`` for a regular octagon. Whole cells make this at most
    1.12 ``reach`` from 20 cells on, 1.17 from 7 and 1.21 from 4; for 1 to 3 cells the octagon is a square (1.42).
    """
    diagonal = int(reach / (2.0 + np.sqrt(2.0)))
    return reach - 2 * diagonal, diagonal


def running_max(surface: Floats32, reach: int) -> Floats32:
    """Return the highest known value (row, col) in the octagon of ``reach`` cells; -inf where all are NaN."""
    side, diagonal = octagon(reach)
    line = np.eye(2 * diagonal + 1, dtype=np.uint8)
    z, border = np.where(np.isnan(surface), UNKNOWN_HEIGHT, surface), float(UNKNOWN_HEIGHT)
    z = cv2.copyMakeBorder(z, *(reach,) * 4, cv2.BORDER_CONSTANT, value=border)
    for window in (np.ones((2 * side + 1, 2 * side + 1), dtype=np.uint8), line, line[:, ::-1].copy()):
        if window.size > 1:
            # OpenCV's own border would repeat the edge; the padding must stay unknown.
            z = cv2.dilate(z, window, borderType=cv2.BORDER_CONSTANT, borderValue=border)
    return np.ascontiguousarray(z[reach:-reach, reach:-reach])


def relief(surface: Floats32, near: int, reach: int) -> tuple[Floats32, Floats32]:
    """Highest minus lowest value (row, col) within two octagons, ``near`` and ``reach`` >= near.

    It is 0 where all cells are unknown.
    """
    high, depth = ([running_max(z, n) for n in (near, reach)] for z in (surface, -surface))
    # Highest minus lowest: the highest plus the greatest depth.
    small, large = (np.maximum(a + b, np.float32(0.0)) for a, b in zip(high, depth, strict=True))
    return small, large


def median3(surface: Floats32) -> Floats32:
    """Median (row, col) of the known cells in 3 x 3; unknown stays unknown.

    Of an even number the upper one, so that the median is one of the heights.
    """
    padded = np.pad(surface, 1, constant_values=np.nan)
    out = np.ascontiguousarray(cv2.medianBlur(padded, 3)[1:-1, 1:-1])  # right where all nine are known
    known = ~np.isnan(padded)
    all_nine = cv2.erode(known.view(np.uint8), np.ones((3, 3), dtype=np.uint8)).view(bool)[1:-1, 1:-1]
    row, col = np.nonzero(known[1:-1, 1:-1] & ~all_nine)
    nine = np.stack([padded[row + i, col + j] for i in range(3) for j in range(3)], axis=1)
    count = np.count_nonzero(~np.isnan(nine), axis=1)
    nine.sort(axis=1)  # unknown comes last
    out[row, col] = nine[np.arange(len(row)), count // 2]
    out[~known[1:-1, 1:-1]] = np.nan
    return out
