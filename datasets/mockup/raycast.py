"""Where rays first meet a bilinear height field: exact, by skipping blocks that lie wholly below the ray.

A pyramid of block maxima (as in Tevs, Ihrke, Seidel 2008, doi:10.1145/1342250.1342279) decides how far a ray may
jump; inside one cell the surface is the bilinear patch of its four heights and the meeting point a root of a quadratic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats

NUDGE = 1e-7
"""Cells: how far a ray is pushed over a block's border; 1e-10 m on a 1 mm grid."""


@dataclass(frozen=True)
class HeightField:
    """Heights (row, col) float32, metres; node (row, col) lies at x = x0 + col * cell, y = y0 - row * cell.

    ``maxima`` holds all levels of block maxima one after the other, level k at ``offsets[k]`` with ``shapes[k]``
    (rows, cols); a block of level k spans 2^k x 2^k cells.
    """

    height: NDArray[np.float32]
    x0: float
    y0: float
    cell: float
    maxima: NDArray[np.float32]
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]

    @staticmethod
    def build(height: NDArray[np.float32], x0: float, y0: float, cell: float) -> HeightField:
        """Height field with its pyramid of block maxima."""
        h = np.ascontiguousarray(height, dtype=np.float32)
        level = np.maximum(np.maximum(h[:-1, :-1], h[:-1, 1:]), np.maximum(h[1:, :-1], h[1:, 1:]))
        levels = [level]
        while max(level.shape) > 1:
            level = np.pad(level, ((0, level.shape[0] % 2), (0, level.shape[1] % 2)), mode="edge")
            level = np.maximum(
                np.maximum(level[::2, ::2], level[::2, 1::2]), np.maximum(level[1::2, ::2], level[1::2, 1::2])
            )
            levels.append(level)
        sizes = [a.size for a in levels]
        return HeightField(
            height=h,
            x0=x0,
            y0=y0,
            cell=cell,
            maxima=np.concatenate([a.ravel() for a in levels]),
            offsets=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
            shapes=np.array([a.shape for a in levels], dtype=np.int64),
        )

    def cast(self, origins: Floats, directions: Floats) -> Floats:
        """Smallest t > 0 at which ``origin + t * direction`` meets the surface from above; NaN for none.

        Parameters
        ----------
        origins : (n, 3) or (1, 3) float64, metres, in the frame of the bed.
        directions : (n, 3) float64, of any length.

        Notes
        -----
        A ray that enters the bed's outline below the surface (through its side) meets nothing.
        """
        t = self.contact(origins, directions)
        return np.where(np.isneginf(t), np.nan, t)

    def contact(self, origins: Floats, directions: Floats) -> Floats:
        """As :meth:`cast`, but negative infinity where the ray enters through the side of the bed."""
        return np.asarray(
            _cast(
                self.height,
                self.maxima,
                self.offsets,
                self.shapes,
                _to_grid(np.atleast_2d(origins), self.x0, self.y0, self.cell),
                _to_grid(np.atleast_2d(directions), 0.0, 0.0, self.cell),
            )
        )


def _to_grid(xyz: Floats, x0: float, y0: float, cell: float) -> Floats:
    """(n, 3) column, row, metres up."""
    return np.stack([(xyz[:, 0] - x0) / cell, (y0 - xyz[:, 1]) / cell, xyz[:, 2]], axis=1)


@njit(cache=True, nogil=True)
def _cast(height, maxima, offsets, shapes, origins, directions):  # type: ignore[no-untyped-def]
    """Ray parameters (n,) in grid coordinates (column, row, metres), see :meth:`HeightField.contact`."""
    n = directions.shape[0]
    out = np.full(n, np.nan)
    top = offsets.shape[0] - 1
    highest = maxima[offsets[top]]
    edge_c, edge_r = height.shape[1] - 1.0, height.shape[0] - 1.0
    for i in range(n):
        o = i if origins.shape[0] > 1 else 0
        oc, orow, oz = origins[o, 0], origins[o, 1], origins[o, 2]
        dc, dr, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        # what drifts by less than a millionth of a cell on the way through the bed is vertical
        if abs(dc) < 1e-7 * abs(dz):
            dc = 0.0
        if abs(dr) < 1e-7 * abs(dz):
            dr = 0.0
        inv_c = 1.0 / dc if dc != 0.0 else np.inf
        inv_r = 1.0 / dr if dr != 0.0 else np.inf
        if (dc == 0.0 and not 0.0 <= oc <= edge_c) or (dr == 0.0 and not 0.0 <= orow <= edge_r):
            continue
        # clip the ray to the outline and to what lies below the highest point
        t, end = 0.0, np.inf
        if dc != 0.0:
            a, b = -oc * inv_c, (edge_c - oc) * inv_c
            t, end = max(t, min(a, b)), min(end, max(a, b))
        if dr != 0.0:
            a, b = -orow * inv_r, (edge_r - orow) * inv_r
            t, end = max(t, min(a, b)), min(end, max(a, b))
        if oz + t * dz > highest:
            if dz >= 0.0:
                continue
            t = max(t, (highest - oz) / dz)
        speed = max(abs(dc), abs(dr))
        eps = NUDGE / speed if speed > 0.0 else 0.0
        level = top
        first = True
        while t - (0.0 if first else eps) <= end:
            c = min(max(oc + t * dc, 0.0), edge_c)
            r = min(max(orow + t * dr, 0.0), edge_r)
            size = 1 << level
            ic = min(int(c), height.shape[1] - 2) >> level
            ir = min(int(r), height.shape[0] - 2) >> level
            t_exit = end
            if dc > 0.0:
                t_exit = min(t_exit, ((ic + 1) * size - oc) * inv_c)
            elif dc < 0.0:
                t_exit = min(t_exit, (ic * size - oc) * inv_c)
            if dr > 0.0:
                t_exit = min(t_exit, ((ir + 1) * size - orow) * inv_r)
            elif dr < 0.0:
                t_exit = min(t_exit, (ir * size - orow) * inv_r)
            t_exit = max(t_exit, t)
            lowest = oz + (t_exit if dz < 0.0 else t) * dz
            if lowest > maxima[offsets[level] + ir * shapes[level, 1] + ic]:
                t = t_exit + eps
                level = min(level + 1, top)
                first = False
                if eps == 0.0:
                    break
                continue
            if level > 0:
                level -= 1
                continue
            # the bilinear patch: gap(s) = f0 + f1 s + f2 s^2 along the ray
            # (before the nudge that led here, lest a steep ray passes the surface within it)
            at = t if first else t - eps
            u, v = oc + at * dc - ic, orow + at * dr - ir
            h00, h01 = np.float64(height[ir, ic]), np.float64(height[ir, ic + 1])
            h10, h11 = np.float64(height[ir + 1, ic]), np.float64(height[ir + 1, ic + 1])
            bc, br, bcr = h01 - h00, h10 - h00, h11 - h10 - h01 + h00
            f0 = oz + at * dz - (h00 + bc * u + br * v + bcr * u * v)
            # Below the surface already: the ray came in through the bed's side and meets nothing, or it is rounding.
            if f0 <= 0.0:
                out[i] = at if not first or f0 > -1e-9 else -np.inf
                break
            f1 = dz - bc * dc - br * dr - bcr * (u * dr + v * dc)
            f2 = -bcr * dc * dr
            s = _first_root(f0, f1, f2)
            if s <= t_exit + eps - at:
                out[i] = at + s
                break
            t = t_exit + eps
            # The next patch is mostly a neighbour: the pyramid is climbed again from below, not entered at the top.
            level = min(1, top)
            first = False
            if eps == 0.0:
                break
    return out


@njit(cache=True, nogil=True, inline="always")
def _first_root(f0, f1, f2):  # type: ignore[no-untyped-def]
    """Smallest positive root of f0 + f1 s + f2 s^2 with f0 > 0; infinity for none."""
    disc = f1 * f1 - 4.0 * f2 * f0
    if disc < 0.0:
        return np.inf
    # Both terms have the sign of f1, so nothing cancels; the roots are q / f2 and f0 / q.
    q = -0.5 * (f1 + (np.sqrt(disc) if f1 >= 0.0 else -np.sqrt(disc)))
    a = q / f2 if f2 != 0.0 else np.inf
    b = f0 / q if q != 0.0 else np.inf
    if a <= 0.0:
        a = np.inf
    if b <= 0.0:
        b = np.inf
    return min(a, b)
