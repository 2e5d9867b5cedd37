"""Reference surfaces for Locus reconstruction (paper, section 4.4): feet and normals, whatever the shape.

A reference surface is a regular grid of *feet* with a unit normal each, which points to the side that the cameras are
on; a cell's elevation is the signed distance of the terrain from the foot along the normal. The Locus kernel knows
nothing else, so plane, cylinder and sphere (and any other analytic shape) are one case to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.geometry.lattice import Lattice


@dataclass(frozen=True)
class Surface:
    """Grid of ``rows`` x ``cols`` cells on a reference surface.

    ``block(rows, cols)`` gives feet (r, c, 3) in metres and unit normals (r, c, 3), contiguous, of the cells at
    ``rows`` (r,) x ``cols`` (c,), in one frame; it is called for a few rows at a time, so that a large surface never
    lies in memory as a whole.
    """

    rows: int
    cols: int
    block: Callable[[NDArray[np.intp], NDArray[np.intp]], tuple[Floats, Floats]]


def plane(lattice: Lattice) -> Surface:
    """The plane z = 0 of the lattice's frame; elevation is z."""
    xs, ys = lattice.xs(), lattice.ys()

    def block(rows: NDArray[np.intp], cols: NDArray[np.intp]) -> tuple[Floats, Floats]:
        # Whole rows at once: filling (r, c, 3) by its last axis takes several times as long.
        line, up = np.zeros((cols.size, 3)), np.zeros((cols.size, 3))
        line[:, 0], up[:, 2] = xs[cols], 1.0
        feet, normals = (np.broadcast_to(v, (rows.size, cols.size, 3)).copy() for v in (line, up))
        feet[..., 1] = ys[rows][:, None]
        return feet, normals

    return Surface(lattice.rows, lattice.cols, block)
