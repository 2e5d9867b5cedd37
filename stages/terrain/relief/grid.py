"""Values on square cells that lie anyhow in the plane, such as elevations of another program's raster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.shading import gradient


@dataclass(frozen=True)
class Grid:
    """Values (rows, cols), NaN unknown, and the map (2, 3) from (col, row, 1) of cell centres to x, y, metres.

    Cells are squares; rows may be turned or mirrored against the axes.
    """

    values: Floats
    matrix: Floats

    @staticmethod
    def on(lattice: Lattice, values: Floats) -> Grid:
        """Values (rows, cols) on a lattice."""
        placed = np.array([[lattice.cell, 0.0, lattice.x0], [0.0, -lattice.cell, lattice.y0]])
        return Grid(np.asarray(values, np.float64), placed)

    @property
    def cell(self) -> float:
        """Side of a cell, metres."""
        return float(np.sqrt(abs(np.linalg.det(self.matrix[:, :2]))))

    @property
    def outline(self) -> tuple[Floats, float]:
        """Middle x, y (2,) and distance of the corners of all cells from there, metres."""
        rows, cols = self.values.shape
        middle = self.matrix @ [0.5 * (cols - 1), 0.5 * (rows - 1), 1.0]
        return middle, 0.5 * self.cell * float(np.hypot(rows, cols))

    def centres(self) -> Floats:
        """Coordinates x, y (rows, cols, 2) of the cells' centres, metres."""
        row, col = np.mgrid[: self.values.shape[0], : self.values.shape[1]]
        return np.stack([col, row], axis=-1) @ self.matrix[:, :2].T + self.matrix[:, 2]

    def points(self) -> Floats:
        """Coordinates x, y and value (rows, cols, 3) of the cells."""
        return np.concatenate([self.centres(), self.values[..., None]], axis=-1)

    def index(self, xy: Floats) -> Floats:
        """Fractional (row, col) (..., 2) of points (..., 2)."""
        # The matrix gives x, y of column and row; the order is turned round to index arrays.
        col_row = (xy - self.matrix[:, 2]) @ np.linalg.inv(self.matrix[:, :2]).T
        return np.asarray(col_row[..., ::-1])

    def at(self, xy: Floats, values: Floats | None = None) -> Floats:
        """Bilinear value (...) at points (..., 2), of other values of the cells where they are given.

        NaN where one of the cells that count is unknown, or outside.
        """
        index = np.moveaxis(self.index(xy), -1, 0)
        nearest = np.rint(index)
        index = np.where(np.abs(index - nearest) < 1e-6, nearest, index)  # the same cells: the same values
        # The mask is interpolated like the values: its share shows where an unknown cell took part. NaN would spoil
        # points, too, that give the unknown cell the weight 0.
        parts = self._parts if values is None else _parts(values)
        share, z = (scipy.ndimage.map_coordinates(a, index, order=1, mode="constant", cval=0.0) for a in parts)
        return np.where(share > 1.0 - 1e-9, z, np.nan)

    @cached_property
    def _parts(self) -> tuple[Floats, Floats]:
        # Kept: an estimation asks for few points of a large map again and again.
        return _parts(self.values)

    def slopes(self) -> Floats:
        """Gradient dz/dx, dz/dy (2, rows, cols) of elevations, NaN unknown."""
        # The gradient takes y to grow upwards, against the rows.
        along = gradient(self.values, 1.0) * np.array([1.0, -1.0])[:, None, None]  # per column, per row
        return np.tensordot(np.linalg.inv(self.matrix[:, :2]).T, along, axes=1)

    def halved(self) -> Grid:
        """The same with cells twice as wide, means of those of four cells that are known."""
        rows, cols = (n // 2 for n in self.values.shape)
        four = self.values[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2)
        count = np.isfinite(four).sum(axis=(1, 3))
        mean = np.where(count >= 2, np.nansum(four, axis=(1, 3)) / np.maximum(count, 1), np.nan)
        return Grid(mean, self.matrix @ np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]))

    def part(self, window: tuple[slice, slice]) -> Grid:
        """The cells of a window (rows, cols)."""
        corner = [[1.0, 0.0, window[1].start], [0.0, 1.0, window[0].start], [0.0, 0.0, 1.0]]
        return Grid(self.values[window], self.matrix @ np.array(corner))

    def within(self, xy: Sequence[float], distance: float) -> Grid:
        """The part that holds all within a distance of a place, metres; it may be empty."""
        at = self.index(np.asarray(xy, np.float64))
        (row, col), (last, right) = (
            np.clip(np.rint(at + side * distance / self.cell), 0, self.values.shape).astype(int) for side in (-1, 1)
        )
        return self.part((slice(row, last), slice(col, right)))


def _parts(values: Floats) -> tuple[Floats, Floats]:
    """1 where values are known, and they themselves, both 0 elsewhere."""
    known = np.isfinite(values)
    return known.astype(np.float64), np.where(known, values, 0.0)
