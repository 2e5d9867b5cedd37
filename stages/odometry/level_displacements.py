"""Coarse displacements between two frames, and what they are at given points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.odometry.affinity import known, known_median


@dataclass(frozen=True)
class LevelDisplacements:
    """Coarse displacements (rows, cols) of a pyramid level, in level 0 pixels, NaN undefined."""

    column: Floats32
    row: Floats32
    level: int

    def at(self, points: Floats) -> Floats:
        """Displacement (n, 2) at points (n, 2), pixels: median of the defined ones among 3 x 3; NaN none."""
        k = 0.5**self.level
        rows, cols = self.column.shape
        # Pixel of the coarse level that holds the point: edges lie half a pixel before the centres.
        centre = np.floor((np.nan_to_num(points) + 0.5) * k).astype(np.intp)
        dy, dx = (o.ravel() for o in np.mgrid[-1:2, -1:2])
        y, x = np.clip(centre[:, 1:] + dy, 0, rows - 1), np.clip(centre[:, :1] + dx, 0, cols - 1)
        both = np.stack([self.column[y, x], self.row[y, x]], -1).astype(np.float64)
        there = np.asarray(np.isfinite(both).all(axis=-1))
        count = there.sum(axis=1)
        both = np.where(there[..., None], both, np.nan)
        value = np.stack([known_median(both[..., k], count) for k in range(2)], axis=-1)
        return np.where(known(points)[:, None], value, np.nan)
