"""The surface of the triangles between neighbouring pixels, sampled at the centres of cells."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.geometry.lattice import Lattice

Floats = NDArray[np.float64]


def without_jumps(column: NDArray, row: NDArray, usable: NDArray[np.bool_], max_jump: float) -> NDArray[np.bool_]:
    """Quadrangles (rows - 1, cols - 1) whose four disparities are usable and within ``max_jump`` pixels."""
    corners = [np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[:-1, 1:], np.s_[1:, 1:]]
    stacks = [np.stack([np.where(usable, m, np.nan)[c] for c in corners]) for m in (column, row)]
    with np.errstate(invalid="ignore"):
        ranges = [s.max(axis=0) - s.min(axis=0) for s in stacks]
        return np.hypot(*ranges) <= max_jump


def rasterise(points: Floats, quads: NDArray[np.bool_], lattice: Lattice) -> Floats:
    """Greatest elevation (row, col) of two triangles a quadrangle over each cell centre; NaN where there is none.

    Parameters
    ----------
    points : (rows, cols, 3) of the pixels, metres, frame of the lattice.
    quads : (rows - 1, cols - 1) quadrangles that are surface.
    """
    out = np.full(lattice.shape, np.nan)
    index = lattice.index(points[..., :2])
    _fill(np.ascontiguousarray(index), np.ascontiguousarray(points[..., 2]), quads, out)
    return out


@njit(cache=True)
def _fill(index: Floats, z: Floats, quads: NDArray[np.bool_], out: Floats) -> None:
    for r in range(quads.shape[0]):
        for c in range(quads.shape[1]):
            if quads[r, c]:
                for half in range(2):
                    r1, c1 = (r + 1, c) if half == 0 else (r, c + 1)
                    _triangle(index[r, c], index[r1, c1], index[r + 1, c + 1], z[r, c], z[r1, c1], z[r + 1, c + 1], out)


@njit(cache=True)
def _triangle(a: Floats, b: Floats, c: Floats, za: float, zb: float, zc: float, out: Floats) -> None:
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if not abs(area) > 1e-12:
        return
    top, bottom = max(0, math.ceil(min(a[0], b[0], c[0]))), min(out.shape[0] - 1, math.floor(max(a[0], b[0], c[0])))
    first, last = max(0, math.ceil(min(a[1], b[1], c[1]))), min(out.shape[1] - 1, math.floor(max(a[1], b[1], c[1])))
    for i in range(top, bottom + 1):
        for j in range(first, last + 1):
            u = ((i - a[0]) * (c[1] - a[1]) - (j - a[1]) * (c[0] - a[0])) / area
            v = ((b[0] - a[0]) * (j - a[1]) - (b[1] - a[1]) * (i - a[0])) / area
            if u >= -1e-9 and v >= -1e-9 and u + v <= 1.0 + 1e-9:
                height = za + u * (zb - za) + v * (zc - za)
                if not out[i, j] >= height:
                    out[i, j] = height
