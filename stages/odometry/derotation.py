"""Undoing the rotation between two frames of one camera, so that matching sees only what its translation does.

A camera that only turns moves its image by the homography ``K R K^-1``, whatever the scene. Feature vectors compare
upright windows: beyond ten degrees of roll they match less and less, at 25 degrees a third of the tracks is wrong. So
the later frame is resampled to how the earlier one was held; an error of some degrees does no harm, since matching
still searches in two dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.hfvm.plane import translation, warp
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid, PyramidParams

MARGIN = 32
"""Pixels added on every side of the derotated frame, for what moves outwards; one pixel of the sixth pyramid level, so
that no motion is a whole number of pixels on every level, which matches best."""


@dataclass(frozen=True)
class Derotation:
    """``homography`` (3, 3): pixels of frame b held as a was, to pixels of b; ``shape`` (rows, columns)."""

    homography: Floats
    shape: tuple[int, int]

    def apply(self, b: Pyramid) -> Pyramid:
        """Pyramid of frame b held like a, with a margin; masked where b does not reach."""
        image = np.empty((self.shape[0] + 2 * MARGIN, self.shape[1] + 2 * MARGIN), np.float32)
        valid = np.empty(image.shape, np.uint8)
        # Masked pixels are filled before the interpolation, which would spread their NaN.
        grey, usable = b.filled[0], b.valid[0]
        warp(grey, usable, self.homography @ translation(-MARGIN), image, valid)
        return pyramid.build(image, PyramidParams(levels=b.levels), valid)

    def compose(self, u: NDArray[Any], v: NDArray[Any], level: int) -> tuple[Floats32, Floats32]:
        """Displacements (row, col) to the original frame b of those to the result of :meth:`apply`.

        Both in pixels of level 0, on the grid of level ``level``; NaN stays NaN.
        """
        scale = 2.0**level
        y, x = ((i + 0.5) * scale - 0.5 for i in np.indices(u.shape, dtype=np.float64))
        p = np.stack([x + u - MARGIN, y + v - MARGIN, np.ones_like(x)])
        q = np.einsum("ij,jrc->irc", self.homography, p)
        # Points that turn out of the half space ahead have no place in b.
        ahead = np.where(q[2] > 1e-6, q[2], np.nan)
        return (q[0] / ahead - x).astype(np.float32), (q[1] / ahead - y).astype(np.float32)
