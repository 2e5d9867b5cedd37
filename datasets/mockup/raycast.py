"""First intersection of rays with a bilinear height field: exact, by skipping blocks that lie wholly below the ray.

A pyramid of block maxima (as in Tevs, Ihrke, Seidel 2008, doi:10.1145/1342250.1342279) decides how far a ray may
jump; inside one cell the surface is the bilinear patch of its four heights, and the intersection a root of a quadratic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.kernel import inlined, kernel


@dataclass(frozen=True)
class HeightField:
    """Heights (row, col) float32, metres; node (row, col) lies at x = x0 + col * cell, y = y0 - row * cell.

    ``maxima`` holds all levels of block maxima one after the other, level k at ``offsets[k]`` with ``widths[k]``
    columns; a block of level k spans 2^k x 2^k cells.
    """

    height: Floats32
    x0: float
    y0: float
    cell: float
    maxima: Floats32
    offsets: NDArray[np.int64]
    widths: NDArray[np.int64]

    @staticmethod
    def build(height: Floats32, x0: float, y0: float, cell: float) -> HeightField:
        """Height field with its pyramid of block maxima."""
        height = np.ascontiguousarray(height, dtype=np.float32)
        levels = [_largest_of_four(height, 1)]
        while max(levels[-1].shape) > 1:
            rows, cols = levels[-1].shape
            even = np.pad(levels[-1], ((0, rows % 2), (0, cols % 2)), mode="edge")
            levels.append(_largest_of_four(even, 2))
        maxima = np.concatenate([level.ravel() for level in levels])
        offsets = np.cumsum([0, *(level.size for level in levels[:-1])])
        return HeightField(height, x0, y0, cell, maxima, offsets, np.array([level.shape[1] for level in levels]))

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
        o = _to_grid(np.atleast_2d(origins), self.x0, self.y0, self.cell)
        d = _to_grid(np.atleast_2d(directions), 0.0, 0.0, self.cell)
        return np.asarray(_cast(self.height, (self.maxima, self.offsets, self.widths), o, d))


def _largest_of_four(a: Floats32, step: int) -> Floats32:
    """Maxima of 2 x 2 values, a pair of rows and columns each ``step``."""
    rows, cols = a.shape
    corners = [a[i : rows - 1 + i : step, j : cols - 1 + j : step] for i in (0, 1) for j in (0, 1)]
    return np.asarray(np.maximum.reduce(corners))


def _to_grid(xyz: Floats, x0: float, y0: float, cell: float) -> Floats:
    """(n, 3) column, row, metres up."""
    return np.stack([(xyz[:, 0] - x0) / cell, (y0 - xyz[:, 1]) / cell, xyz[:, 2]], axis=1)


@kernel
def _cast(height, pyramid, origins, directions):  # type: ignore[no-untyped-def]
    """Ray parameters (n,) in grid coordinates (column, row, metres), see :meth:`HeightField.contact`."""
    maxima, offsets, widths = pyramid
    n = directions.shape[0]
    out = np.full(n, np.nan)
    top = offsets.shape[0] - 1
    highest = maxima[offsets[top]]
    edge_c, edge_r = height.shape[1] - 1.0, height.shape[0] - 1.0
    for i in range(n):
        o = i if origins.shape[0] > 1 else 0
        oc, orow, oz = origins[o, 0], origins[o, 1], origins[o, 2]
        dc, dr, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        # A ray that moves by less than a millionth of a cell on its way through the bed is vertical.
        if abs(dc) < 1e-7 * abs(dz):
            dc = 0.0
        if abs(dr) < 1e-7 * abs(dz):
            dr = 0.0
        inv_c = 1.0 / dc if dc != 0.0 else np.inf
        inv_r = 1.0 / dr if dr != 0.0 else np.inf
        # Clip the ray to the outline and to below the highest point.
        enter_c, leave_c = _within(oc, dc, inv_c, edge_c)
        enter_r, leave_r = _within(orow, dr, inv_r, edge_r)
        t, end = max(0.0, enter_c, enter_r), min(leave_c, leave_r)
        if oz + t * dz > highest:
            if dz >= 0.0:
                continue
            t = max(t, (highest - oz) / dz)
        speed = max(abs(dc), abs(dr))
        # Pushed over a block's border by a part of a cell: 1e-10 m on a grid of 1 mm.
        eps = 1e-7 / speed if speed > 0.0 else 0.0
        level, nudge = top, 0.0
        # A vertical ray stays in its cell, and leaves it at infinity.
        while t - nudge <= end and t < np.inf:
            c = min(max(oc + t * dc, 0.0), edge_c)
            r = min(max(orow + t * dr, 0.0), edge_r)
            ic = min(int(c), height.shape[1] - 2) >> level
            ir = min(int(r), height.shape[0] - 2) >> level
            t_exit = min(end, _leaves(oc, dc, inv_c, ic, level), _leaves(orow, dr, inv_r, ir, level))
            t_exit = max(t_exit, t)
            lowest = oz + (t_exit if dz < 0.0 else t) * dz
            if lowest > maxima[offsets[level] + ir * widths[level] + ic]:
                t, nudge, level = t_exit + eps, eps, min(level + 1, top)
                continue
            if level > 0:
                level -= 1
                continue
            # The bilinear patch: gap(s) = f0 + f1 s + f2 s^2 along the ray, from before the nudge that led here, within
            # which a steep ray may pass the surface.
            at = t - nudge
            u, v = oc + at * dc - ic, orow + at * dr - ir
            h00, h01 = np.float64(height[ir, ic]), np.float64(height[ir, ic + 1])
            h10, h11 = np.float64(height[ir + 1, ic]), np.float64(height[ir + 1, ic + 1])
            bc, br, bcr = h01 - h00, h10 - h00, h11 - h10 - h01 + h00
            f0 = oz + at * dz - (h00 + bc * u + br * v + bcr * u * v)
            # Below the surface: by rounding, or the ray came in through the bed's side and meets nothing.
            if f0 <= 0.0:
                out[i] = at if nudge > 0.0 or f0 > -1e-9 else -np.inf
                break
            f1 = dz - bc * dc - br * dr - bcr * (u * dr + v * dc)
            s = _first_root(f0, f1, -bcr * dc * dr)
            if s <= t_exit + eps - at:
                out[i] = at + s
                break
            # The next patch is mostly a neighbour, so climb the pyramid from below.
            t, nudge, level = t_exit + eps, eps, min(1, top)
    return out


@inlined
def _within(o, d, inv, edge):  # type: ignore[no-untyped-def]
    """Ray parameters between which a ray is over the grid along one axis; ``inv`` = 1 / ``d``."""
    if d == 0.0:
        return (-np.inf, np.inf) if 0.0 <= o <= edge else (np.inf, -np.inf)
    a, b = -o * inv, (edge - o) * inv
    return min(a, b), max(a, b)


@inlined
def _leaves(o, d, inv, block, level):  # type: ignore[no-untyped-def]
    """Ray parameter at which a ray leaves a block of the pyramid along one axis."""
    if d == 0.0:
        return np.inf
    return (((block + 1 if d > 0.0 else block) << level) - o) * inv


@inlined
def _first_root(f0, f1, f2):  # type: ignore[no-untyped-def]
    """Smallest positive root of f0 + f1 s + f2 s^2 with f0 > 0; infinity for none."""
    disc = f1 * f1 - 4.0 * f2 * f0
    if disc < 0.0:
        return np.inf
    # Both terms have the sign of f1, so nothing cancels; the roots are q / f2 and f0 / q.
    q = -0.5 * (f1 + (np.sqrt(disc) if f1 >= 0.0 else -np.sqrt(disc)))
    a = q / f2 if f2 != 0.0 else np.inf
    b = f0 / q if q != 0.0 else np.inf
    return min(a if a > 0.0 else np.inf, b if b > 0.0 else np.inf)
