"""Undoing a known rotation between two frames of one camera, so that matching sees only what its translation does.

A camera that only turns moves its image by the homography ``K R K^-1``, whatever the scene. Feature vectors compare
upright windows: beyond ten degrees of roll they match less and less, at 25 degrees a third of the tracks is wrong. With
an attitude the later frame is resampled first to how the earlier one was held; an error of the attitude of some degrees
does no harm, since matching still searches in two dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Camera
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

    @staticmethod
    def of(rotation: ArrayLike, camera: Camera) -> Derotation:
        """Build from the rotation R_b_a (3, 3) between two frames of a camera.

        Raises
        ------
        InputError
            The matrix is not a rotation.
        """
        R = np.asarray(rotation, dtype=np.float64)
        if R.shape != (3, 3) or not np.isfinite(R).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-4:
            raise InputError(
                "RIL-305", "an attitude is not a 3 x 3 rotation", remedy="check the attitudes of the sequence"
            )
        K = camera.matrix
        # R_b_a takes rays of a to rays of b: a pixel of the upright frame is looked up in b.
        return Derotation(K @ R @ np.linalg.inv(K), (camera.height, camera.width))

    @property
    def reach(self) -> float:
        """Greatest displacement of an image corner, pixels; infinite where one turns out of the half space ahead."""
        rows, cols = self.shape
        corners = np.array([[x, y, 1.0] for y in (0.0, rows - 1.0) for x in (0.0, cols - 1.0)])
        moved = corners @ self.homography.T
        # A corner behind the camera has an image, on the wrong side.
        if (moved[:, 2] <= 0).any():
            return float("inf")
        return float(np.linalg.norm(moved[:, :2] / moved[:, 2:] - corners[:, :2], axis=1).max())

    @property
    def roll_deg(self) -> float:
        """Rotation, degrees, column towards row, that the homography makes of the image about its centre."""
        centre = np.array([(self.shape[1] - 1) / 2.0, (self.shape[0] - 1) / 2.0, 1.0])
        x, y, w = self.homography @ centre
        # Quotient rule of (H p)_xy / (H p)_z: what a homography does to lengths and angles there.
        slopes = self.homography[:2, :2] - np.outer([x / w, y / w], self.homography[2, :2])
        return math.degrees(math.atan2((slopes[1, 0] - slopes[0, 1]) / w, (slopes[0, 0] + slopes[1, 1]) / w))

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
