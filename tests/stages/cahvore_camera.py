"""A whole CAHV, CAHVOR or CAHVORE camera, as the oracle of the readers that make a lens and a pinhole of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Floats
from rille.stages.geometry.cahvore import Bending, Vector


@dataclass(frozen=True)
class Cahvore:
    """A camera in its reference frame, metres: centre C, axis A (unit), H and V (pixels), and its lens."""

    c: Vector
    a: Vector
    h: Vector
    v: Vector
    lens: Bending

    def project(self, points: ArrayLike) -> Floats:
        """Column and row (n, 2) of points (n, 3), m; NaN behind the camera and beyond what the lens sees."""
        bent = self.lens.bend(np.asarray(points, np.float64) - self.c)
        depth = bent @ np.asarray(self.a)
        depth = np.where(depth > 0, depth, np.nan)
        return np.column_stack([bent @ np.asarray(self.h) / depth, bent @ np.asarray(self.v) / depth])

    def rays(self, pixels: ArrayLike) -> Floats:
        """Unit directions (n, 3) of pixels (n, 2) column, row, in the reference frame."""
        p = np.asarray(pixels, np.float64)
        a = np.asarray(self.a)
        directions = np.cross(np.asarray(self.h) - p[:, :1] * a, np.asarray(self.v) - p[:, 1:] * a)
        # The cross product fixes the line, not its sense: rays lead away from the image, ahead.
        directions *= np.sign(directions @ a)[:, None]
        return self.lens.straighten(directions)
