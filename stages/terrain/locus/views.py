"""Both images seen through the elevations: grey values of each cell in the left and the right image.

A cell is the point P = (x, y, Z); its projections p_l and p_r are read from the cubic splines through the images'
pixels, so that detail is kept. With the terrain right, both show the same.

How their difference changes with the elevation follows from either image: while a cell moves along the ray of one
camera, that camera goes on to show the same, and in the other one the cell moves by its disparity. The mean of both has
half the variance, and both have as little noise as disparities need. The change of each image at a cell that rises
straight up, instead, is mostly motion that both images share, with the noise of two gradients times that motion: many
times the disparity where the baseline is short for the distance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.kernel import kernel
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.spline import value_and_gradient
from rille.stages.numeric.windows import window_mean


class View(NamedTuple):
    """Projection (3, 4) from the frame of the lattice to pixels, and the image's spline."""

    projection: Floats
    spline: Floats32


class SurfaceViews(NamedTuple):
    """Views of both cameras, and their centres in the frame of the lattice, m."""

    left: View
    right: View
    centre: Floats
    right_centre: Floats


class OrthoPair(NamedTuple):
    """Both images at each cell (rows, cols) float32; NaN where it is unknown or not inside both images.

    ``left``, ``right``: grey values; ``left_slope``, ``right_slope``: how each changes where the cell moves along the
    ray of the *other* camera, which goes on to show the same, per metre of elevation; ``scale``: disparity a metre of
    elevation, pixels; ``area``: pixels of the left image that the cell covers.
    """

    left: Floats32
    right: Floats32
    left_slope: Floats32
    scale: Floats32
    area: Floats32
    right_slope: Floats32

    def slope(self) -> Floats32:
        """Change (rows, cols) of the right image's grey values less the left one's, per metre of elevation."""
        return np.asarray(0.5 * (self.right_slope - self.left_slope), np.float32)


def look(views: SurfaceViews, lattice: Lattice, elevation: Floats | Floats32) -> OrthoPair:
    """Both images at the elevations (rows, cols) of the cells, metres, NaN unknown."""
    out = OrthoPair(*np.full((len(OrthoPair._fields), *lattice.shape), np.nan, np.float32))
    _look(lattice.xs(), lattice.ys(), np.ascontiguousarray(elevation), lattice.cell, views, out)
    return out


def facing(elevation: Floats32, lattice: Lattice, centre: Floats, side: int) -> Floats32:
    """Area of the ground (rows, cols) in an image over that of level ground; 1 where it is unknown.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN undefined.
    centre : (3,) the camera's, m, in the frame of the lattice.
    side : of the windows, cells, whose mean slope counts.
    """
    if min(elevation.shape) < 2:
        return np.ones_like(elevation)
    ahead = [
        window_mean(np.gradient(elevation, at, axis=axis).astype(np.float32), side)
        for axis, at in ((1, lattice.xs()), (0, lattice.ys()))
    ]
    dx, dy, below = lattice.xs() - centre[0], lattice.ys()[:, None] - centre[1], elevation - centre[2]
    share = 1.0 - (dx * ahead[0] + dy * ahead[1]) / below
    return np.where(np.isfinite(share), share, 1.0).astype(np.float32)


def edge_on(area: Floats32, least: float, side: int) -> Bools:
    """Cells (rows, cols) that the camera sees edge-on: their area in the image (:func:`facing`) is below ``least``.

    Less is mostly no ground: a match is that of a window, and so is what joins the edge of a stone to the ground behind
    it, seen edge-on and above what the stone hides. Gaps of less than ``side`` cells between them count as well: the
    slope there is that of noise.
    """
    found = (area < least).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)) != 0)


@kernel
def _look(xs, ys, zs, cell, views, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` of the cells, ``cell`` m wide, at ``xs`` (cols,), ``ys`` (rows,) and ``zs`` (rows, cols)."""
    # Arrays are taken out of their tuples before the loops: each time costs an atomic count of references.
    left, right, left_slope, right_slope, scale, area = (
        out.left, out.right, out.left_slope, out.right_slope, out.scale, out.area,
    )  # fmt: skip
    spline, spline_right = views.left.spline, views.right.spline
    centre, right_centre = views.centre, views.right_centre
    P, P_right = views.left.projection, views.right.projection
    for r in range(len(ys)):
        for c in range(len(xs)):
            x, y, z = xs[c], ys[r], float(zs[r, c])
            if not np.isfinite(z):
                continue
            at, at_right = _pixel(P, x, y, z), _pixel(P_right, x, y, z)
            below, below_right = z - centre[2], z - right_centre[2]
            if below == 0.0 or below_right == 0.0:
                continue
            if not (_is_inside(at, spline.shape) and _is_inside(at_right, spline_right.shape)):
                continue
            grey, gx, gy = value_and_gradient(spline, at[0], at[1])
            shift = _shift(P, at, (x - right_centre[0]) / below_right, (y - right_centre[1]) / below_right)
            left[r, c], left_slope[r, c] = grey, gx * shift[0] + gy * shift[1]
            across, along = _motion(P, at, 0), _motion(P, at, 1)
            area[r, c] = abs(along[0] * across[1] - across[0] * along[1]) * cell * cell
            grey, gx, gy = value_and_gradient(spline_right, at_right[0], at_right[1])
            # Along the left ray the left projection stays: the motion of the right one is disparity.
            shift = _shift(P_right, at_right, (x - centre[0]) / below, (y - centre[1]) / below)
            right[r, c], right_slope[r, c] = grey, gx * shift[0] + gy * shift[1]
            scale[r, c] = math.hypot(shift[0], shift[1])


@kernel
def _pixel(P, x, y, z):  # type: ignore[no-untyped-def]
    """x, y, pixels, and the inverse of the projective depth of a point."""
    part = 1.0 / (P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3])
    across, down = P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3], P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]
    return across * part, down * part, part


@kernel
def _is_inside(at, shape):  # type: ignore[no-untyped-def]
    """Whether the spline of an image of a shape is defined at a pixel in front of the camera."""
    x, y, part = at
    rows, cols = shape
    return part > 0.0 and x >= 1.0 and y >= 1.0 and x < cols - 2.0 and y < rows - 2.0


@kernel
def _shift(P, at, dx, dy):  # type: ignore[no-untyped-def]
    """Pixels that the projection ``at`` of a point moves by a metre of elevation along the direction (dx, dy, 1)."""
    across, along, up = _motion(P, at, 0), _motion(P, at, 1), _motion(P, at, 2)
    return dx * across[0] + dy * along[0] + up[0], dx * across[1] + dy * along[1] + up[1]


@kernel
def _motion(P, at, axis):  # type: ignore[no-untyped-def]
    """Pixels that the projection ``at`` (x, y, 1 / depth) of a point moves by a metre of the point along an axis."""
    x, y, part = at
    return (P[0, axis] - x * P[2, axis]) * part, (P[1, axis] - y * P[2, axis]) * part
