"""Reference surfaces for Locus reconstruction (paper, section 4.4): feet and normals, whatever the shape.

A reference surface is a regular grid of *feet* with a unit normal each, which points to the side that the cameras are
on; a cell's elevation is the signed distance of the terrain from the foot along the normal. The Locus kernel knows
nothing else, so plane, cylinder and sphere (and any other analytic shape) are one case to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Floats
from rille.stages.geometry.lattice import Lattice


@dataclass(frozen=True)
class Surface:
    """Grid of ``rows`` x ``cols`` cells on a reference surface.

    ``locate(rows, cols)`` gives feet (n, 3) in metres and unit normals (n, 3) of cells (n,), in one frame; it is
    called for a few rows at a time, so that a large surface never lies in memory as a whole. ``grid(rows, cols)`` gives
    the same for rows (r,) x columns (c,) as (r, c, 3), contiguous, where that takes less time.
    """

    rows: int
    cols: int
    locate: Callable[[Floats, Floats], tuple[Floats, Floats]]
    grid: Callable[[Floats, Floats], tuple[Floats, Floats]] | None = None

    def block(self, rows: ArrayLike, cols: ArrayLike) -> tuple[Floats, Floats]:
        """Feet and normals (r, c, 3), contiguous, of the cells at ``rows`` (r,) x ``cols`` (c,)."""
        if self.grid is not None:
            return self.grid(np.asarray(rows, np.float64), np.asarray(cols, np.float64))
        r, c = np.meshgrid(np.asarray(rows, np.float64), np.asarray(cols, np.float64), indexing="ij")
        feet, normals = self.locate(r.ravel(), c.ravel())
        shape = (*r.shape, 3)
        return np.ascontiguousarray(feet.reshape(shape)), np.ascontiguousarray(normals.reshape(shape))


def plane(lattice: Lattice) -> Surface:
    """The plane z = 0 of the lattice's frame; elevation is z."""
    xs, ys = lattice.xs(), lattice.ys()

    def locate(rows: Floats, cols: Floats) -> tuple[Floats, Floats]:
        feet = np.stack([xs[cols.astype(np.intp)], ys[rows.astype(np.intp)], np.zeros(rows.size)], axis=-1)
        return feet, np.broadcast_to([0.0, 0.0, 1.0], feet.shape)

    def grid(rows: Floats, cols: Floats) -> tuple[Floats, Floats]:
        # Whole rows at once: filling (r, c, 3) by its last axis takes several times as long.
        line, up = np.zeros((cols.size, 3)), np.zeros((cols.size, 3))
        line[:, 0], up[:, 2] = xs[cols.astype(np.intp)], 1.0
        feet, normals = (np.broadcast_to(v, (rows.size, cols.size, 3)).copy() for v in (line, up))
        feet[..., 1] = ys[rows.astype(np.intp)][:, None]
        return feet, normals

    return Surface(lattice.rows, lattice.cols, locate, grid)
