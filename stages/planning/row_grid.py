"""Grid whose rows lie across a driving direction, whichever way that points on the lattice of the elevations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.errors import InputError
from rille.stages.geometry.lattice import Lattice

Floats = NDArray[np.float64]
Point = tuple[float, float]


@dataclass(frozen=True)
class RowGrid:
    """Grid whose rows lie across a heading, row 0 farthest ahead; cell centres are at multiples of the cell.

    ``ahead`` is the heading as a unit vector; row 0, column 0 lies ``i0`` cells right and ``j0`` cells ahead of (0, 0).
    """

    ahead: Point
    i0: int
    j0: int
    cell: float
    rows: int
    cols: int

    @staticmethod
    def over(lattice: Lattice, heading: Point) -> RowGrid:
        """The grid that covers a lattice; with heading (0, 1) the lattice itself."""
        norm = math.hypot(*heading)
        if not (math.isfinite(norm) and norm > 0):
            raise InputError(
                "RIL-434", f"heading {heading} has no direction", remedy="give start and target that differ"
            )
        dx, dy = heading[0] / norm, heading[1] / norm
        x, y = lattice.xs()[[0, -1, 0, -1]], lattice.ys()[[0, 0, -1, -1]]
        right, ahead = (x * dy - y * dx) / lattice.cell, (x * dx + y * dy) / lattice.cell
        i0, i1 = math.ceil(right.min() - 1e-6), math.floor(right.max() + 1e-6)
        j0, j1 = math.floor(ahead.max() + 1e-6), math.ceil(ahead.min() - 1e-6)
        return RowGrid((dx, dy), i0, j0, lattice.cell, max(j0 - j1, 0) + 1, max(i1 - i0, 0) + 1)

    def xy(self, row: NDArray[Any], col: NDArray[Any]) -> Floats:
        """Cell centres (..., 2), metres."""
        right, ahead = (self.i0 + col) * self.cell, (self.j0 - row) * self.cell
        dx, dy = self.ahead
        return np.stack([right * dy + ahead * dx, ahead * dy - right * dx], axis=-1)

    def index(self, point: Point) -> tuple[int, int]:
        """Row and column of the cell that holds a point, metres; it may be outside."""
        dx, dy = self.ahead
        right, ahead = point[0] * dy - point[1] * dx, point[0] * dx + point[1] * dy
        return round(self.j0 - ahead / self.cell), round(right / self.cell - self.i0)

    def sample(self, lattice: Lattice, array: NDArray[Any], outside: float) -> NDArray[Any]:
        """An array on the lattice brought to this grid by nearest neighbour."""
        if self.ahead == (0.0, 1.0) and (self.i0, self.j0) == (lattice.i0, lattice.j0) and array.shape == self._shape:
            return array
        row, col = np.indices(self._shape)
        at = np.rint(lattice.index(self.xy(row, col))).astype(np.int64)
        inside = ((at >= 0) & (at < lattice.shape)).all(axis=-1)
        out = np.full((self.rows, self.cols), outside, dtype=array.dtype)
        out[inside] = array[at[inside, 0], at[inside, 1]]
        return out

    @property
    def _shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"ahead": list(self.ahead), "i0": self.i0, "j0": self.j0, "cell": self.cell} | {
            "rows": self.rows,
            "cols": self.cols,
        }
