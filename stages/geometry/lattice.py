"""Regular lattice of cell centres for elevation models.

All lattices of one cell size are parts of one infinite lattice: cell centres are at *integer multiples* of the cell, so
two models of one frame overlap cell by cell and merge without resampling (an offset of half a cell would move landmarks
by as much as the noise of the disparity). Row 0 lies at the greatest y, as in a map with north up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import ConfigError, InputError

Window = tuple[slice, slice]

MAX_CELLS = 50_000_000
"""Most cells of one lattice: a float32 array of them takes 200 MB, and a stage holds several."""


@dataclass(frozen=True)
class Lattice:
    """Cell centres ``x = x0 + col * cell``, ``y = y0 - row * cell``, metres, of a local or the world frame.

    ``x0`` and ``y0`` are rounded to the exact product of an integer and ``cell``, so that equal cells have equal
    coordinates in every lattice.

    Raises
    ------
    InputError
        ``cell`` is not positive, the lattice is empty or its origin is no multiple of the cell.
    ConfigError
        The lattice has more than :data:`MAX_CELLS` cells.
    """

    x0: float
    y0: float
    cell: float
    rows: int
    cols: int

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell) and self.cell > 0):
            raise InputError(
                "RIL-354", f"cell size {self.cell} m is not positive", remedy="give the cell size in metres"
            )
        assert self.rows > 0
        assert self.cols > 0
        if self.rows * self.cols > MAX_CELLS:
            enough = 1.06 * self.cell * math.sqrt(self.rows * self.cols / MAX_CELLS)  # rounding takes up to 5 %
            raise ConfigError(
                "RIL-356",
                f"{self.rows} x {self.cols} cells of {self.cell:g} m are more than {MAX_CELLS}",
                remedy=f"set locus.cell_size to {enough:.2g} m or more, narrow locus.extent, or drive to a nearer goal",
            )
        for name, value in (("x0", self.x0), ("y0", self.y0)):
            index = value / self.cell
            # 1e-3: far from the origin rounding of the float is a part of a cell.
            if not math.isfinite(index) or abs(index - round(index)) > 1e-3:
                raise InputError("RIL-357", f"lattice origin {name}={value} is no multiple of the cell {self.cell}")
            object.__setattr__(self, name, round(index) * self.cell)

    @staticmethod
    def at(i0: int, j0: int, cell: float, rows: int, cols: int) -> Lattice:
        """Lattice by the integer indices of its first cell: ``x0 = i0 * cell``, ``y0 = j0 * cell``."""
        return Lattice(i0 * cell, j0 * cell, cell, rows, cols)

    @staticmethod
    def snap(bounds: Sequence[float], cell: float) -> Lattice:
        """Smallest lattice whose cells (not only their centres) cover ``bounds`` = x_min, x_max, y_min, y_max."""
        x_min, x_max, y_min, y_max = (float(v) for v in bounds)
        assert x_min <= x_max
        assert y_min <= y_max
        slack = 1e-6  # a bound on a cell's border does not add the next cell
        low = [math.floor(v / cell + 0.5 + slack) for v in (x_min, y_min)]
        high = [math.ceil(v / cell - 0.5 - slack) for v in (x_max, y_max)]
        high = [max(pair) for pair in zip(low, high, strict=True)]
        return Lattice.at(low[0], high[1], cell, high[1] - low[1] + 1, high[0] - low[0] + 1)

    @property
    def i0(self) -> int:
        """Integer column of the first cell: ``x0 / cell``."""
        return round(self.x0 / self.cell)

    @property
    def j0(self) -> int:
        """Integer row of the first cell, counted upwards: ``y0 / cell``."""
        return round(self.y0 / self.cell)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, cols)."""
        return self.rows, self.cols

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outline x_min, x_max, y_min, y_max of the cells, metres."""
        half = 0.5 * self.cell
        x, y = self.xs(), self.ys()
        return float(x[0]) - half, float(x[-1]) + half, float(y[-1]) - half, float(y[0]) + half

    @property
    def radius(self) -> float:
        """Distance, m, of the farthest corner from the origin."""
        x0, x1, y0, y1 = self.bounds
        return math.hypot(max(-x0, x1), max(-y0, y1))

    def xs(self) -> Floats:
        """Coordinate x (cols,) of the cell centres, metres."""
        # Integer times cell, not a sum of steps: the same cell has the same bits in every lattice.
        return np.arange(self.i0, self.i0 + self.cols, dtype=np.float64) * self.cell

    def ys(self) -> Floats:
        """Coordinate y (rows,) of the cell centres, metres, decreasing."""
        return np.arange(self.j0, self.j0 - self.rows, -1, dtype=np.float64) * self.cell

    def xy(self) -> Floats:
        """Cell centres (rows, cols, 2), metres."""
        x, y = np.meshgrid(self.xs(), self.ys())
        return np.stack([x, y], axis=-1)

    def index(self, xy: ArrayLike) -> Floats:
        """Fractional (row, col) (..., 2) of points (..., 2), metres; cell centres are integers."""
        p = np.asarray(xy, dtype=np.float64)
        return np.stack([self.j0 - p[..., 1] / self.cell, p[..., 0] / self.cell - self.i0], axis=-1)

    def values(self, array: NDArray[Any], index: NDArray[Any], outside: float) -> NDArray[Any]:
        """Values (...) of an array (row, col) in the cells next to fractional (row, col) (..., 2); ``outside`` where
        there is none."""
        at = np.rint(index)
        inside = ((at >= 0) & (at < self.shape)).all(axis=-1)
        row, col = np.moveaxis(np.where(inside[..., None], at, 0).astype(np.int64), -1, 0)
        return np.where(inside, array[row, col], outside)

    def union(self, other: Lattice) -> Lattice:
        """Smallest lattice that holds both."""
        self._same_cell(other)
        i0, j0 = min(self.i0, other.i0), max(self.j0, other.j0)
        i1 = max(self.i0 + self.cols, other.i0 + other.cols)
        j1 = min(self.j0 - self.rows, other.j0 - other.rows)
        return Lattice.at(i0, j0, self.cell, j0 - j1, i1 - i0)

    def intersection(self, other: Lattice) -> Lattice | None:
        """Lattice of the cells that both have; None if they do not overlap."""
        self._same_cell(other)
        i0, j0 = max(self.i0, other.i0), min(self.j0, other.j0)
        cols = min(self.i0 + self.cols, other.i0 + other.cols) - i0
        rows = j0 - max(self.j0 - self.rows, other.j0 - other.rows)
        return Lattice.at(i0, j0, self.cell, rows, cols) if rows > 0 and cols > 0 else None

    def window(self, part: Lattice) -> Window:
        """Slices (rows, cols) of an array on this lattice that hold ``part``, which must lie inside."""
        self._same_cell(part)
        row, col = self.j0 - part.j0, part.i0 - self.i0
        assert 0 <= row <= self.rows - part.rows
        assert 0 <= col <= self.cols - part.cols
        return slice(row, row + part.rows), slice(col, col + part.cols)

    def tiles(self, size: int) -> Iterator[Lattice]:
        """Tiles of at most ``size`` x ``size`` cells, from the top left.

        Tile borders are at multiples of ``size`` of the infinite lattice: inner tiles, and the results on them, stay
        valid when the lattice grows.
        """
        for top in _cuts(-self.j0, self.rows, size):
            for left in _cuts(self.i0, self.cols, size):
                yield Lattice.at(left[0], -top[0], self.cell, top[1], left[1])

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"x0": self.x0, "y0": self.y0, "cell": self.cell, "rows": self.rows, "cols": self.cols}

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> Lattice:
        """Inverse of :meth:`to_dict`."""
        return Lattice(float(d["x0"]), float(d["y0"]), float(d["cell"]), int(d["rows"]), int(d["cols"]))

    def _same_cell(self, other: Lattice) -> None:
        if self.cell != other.cell:
            raise InputError(
                "RIL-361",
                f"lattices of {self.cell:g} m and {other.cell:g} m cells do not fit together",
                remedy="use one cell_size for the whole run",
            )


def _cuts(first: int, count: int, size: int) -> list[tuple[int, int]]:
    """(start, length) of the pieces of ``first .. first + count`` between multiples of ``size``."""
    edges = [first, *range((first // size + 1) * size, first + count, size), first + count]
    return [(a, b - a) for a, b in itertools.pairwise(edges)]


def union(lattices: Iterable[Lattice]) -> Lattice:
    """Smallest lattice that holds all of ``lattices`` (at least one)."""
    return reduce(Lattice.union, lattices)


def mosaic(parts: Sequence[tuple[Lattice, NDArray[Any]]], nodata: float, target: Lattice | None = None) -> NDArray[Any]:
    """Assemble arrays (rows, cols) on several lattices; cells of no part are ``nodata``.

    Parameters
    ----------
    parts : lattice and array of each part, all of one dtype. Where parts overlap, the later one wins.
    nodata : value of cells without a part (NaN for floats).
    target : lattice of the result; default: the union of the parts.
    """
    whole = target or union(lattice for lattice, _ in parts)
    out = np.full(whole.shape, nodata, dtype=parts[0][1].dtype if parts else np.float32)
    for lattice, array in parts:
        assert array.shape == lattice.shape
        common = whole.intersection(lattice)
        if common is not None:
            out[whole.window(common)] = array[lattice.window(common)]
    return out
