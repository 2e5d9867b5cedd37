"""Both images seen through the elevations: grey values of each cell in the left and the right image.

A cell with foot F, normal N and elevation Z is the point P = F + Z N; its projections p_l and p_r are read from the
cubic splines through the images' pixels, so that detail is kept. With the terrain right, both show the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.geometry.spline import coefficients, value_and_gradient
from rille.stages.geometry.surface import Surface
from rille.stages.terrain.locus.kernel import dot, projection_rows, vector

BLOCK_ROWS = 32  # rows of cells in one kernel call, so that a large surface stays small in memory


class View(NamedTuple):
    """Projection (3, 4) from the frame of the surface to pixels, and the image's spline."""

    projection: Floats
    spline: Floats32


class SurfaceViews(NamedTuple):
    """Views of both cameras, and the left one's centre in the frame of the surface, m."""

    left: View
    right: View
    centre: Floats


class OrthoPair(NamedTuple):
    """What both images show of each cell (rows, cols) float32; NaN where it is unknown or not inside both images.

    ``left``, ``right``: grey values; ``left_slope``, ``right_slope``: how they change with the elevation, per metre;
    ``scale``: disparity a metre of elevation, pixels; ``area``: pixels of the left image that the cell covers.
    """

    left: Floats32
    right: Floats32
    left_slope: Floats32
    scale: Floats32
    area: Floats32
    right_slope: Floats32


class _Block(NamedTuple):
    """Rows ``start`` to ``stop`` of a surface, whose feet and normals (r, c, 3) begin at row ``first``."""

    feet: Floats
    normals: Floats
    first: int
    start: int
    stop: int


def views(left: Floats, right: Floats, left_image: Floats32, right_image: Floats32, centre: Floats) -> SurfaceViews:
    """Views of two images (row, col), grey values, by their projections; ``centre`` of the left camera, m."""
    return SurfaceViews(
        View(left, coefficients(left_image)), View(right, coefficients(right_image)), np.asarray(centre, np.float64)
    )


def look(views: SurfaceViews, surface: Surface, elevation: Floats | Floats32) -> OrthoPair:
    """What both images show at the elevations (rows, cols) of the cells, metres, NaN unknown."""
    out = OrthoPair(*np.full((len(OrthoPair._fields), surface.rows, surface.cols), np.nan, np.float32))
    z, cols = np.ascontiguousarray(elevation), np.arange(surface.cols)
    for start in range(0, surface.rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, surface.rows)
        # A row beyond either end, so that every cell has a neighbour below or above to measure its size with.
        first, last = max(0, start - 1), min(surface.rows, stop + 1)
        _look(_Block(*surface.block(np.arange(first, last), cols), first, start, stop), z, views, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _look(block, z, views, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` of the rows of a block."""
    # Arrays are taken out of their tuples before the loops: each time costs an atomic count of references.
    feet, normals, (rows, cols) = block.feet, block.normals, block.feet.shape[:2]
    left, right, left_slope, right_slope, scale, area = (
        out.left, out.right, out.left_slope, out.right_slope, out.scale, out.area,
    )  # fmt: skip
    spline, spline_right, centre = views.left.spline, views.right.spline, views.centre
    P, P_right = projection_rows(views.left.projection), projection_rows(views.right.projection)
    for r in range(block.start, block.stop):
        i = r - block.first
        below = i + 1 if i + 1 < rows else i - 1
        for c in range(cols):
            if not np.isfinite(z[r, c]):
                continue
            foot, normal = vector(feet, i, c), vector(normals, i, c)
            height = float(z[r, c])
            point = (
                foot[0] + height * normal[0],
                foot[1] + height * normal[1],
                foot[2] + height * normal[2],
            )
            ray = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
            toward = ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2]
            at, at_right = _pixel(P, point), _pixel(P_right, point)
            if toward == 0.0 or not (_is_inside(at, spline.shape) and _is_inside(at_right, spline_right.shape)):
                continue
            grey, gx, gy = value_and_gradient(spline, at[0], at[1])
            u, v = _motion(P, at, normal)
            left[r, c], left_slope[r, c] = grey, gx * u + gy * v
            grey, gx, gy = value_and_gradient(spline_right, at_right[0], at_right[1])
            u, v = _motion(P_right, at_right, normal)
            right[r, c], right_slope[r, c] = grey, gx * u + gy * v
            # Along the left ray the left image stays: what the right one moves by is disparity.
            part = 1.0 / toward
            u, v = _motion(P_right, at_right, (ray[0] * part, ray[1] * part, ray[2] * part))
            scale[r, c], area[r, c] = math.sqrt(u * u + v * v), 1.0
            if rows > 1 and cols > 1:
                down = _motion(P, at, _step(foot, vector(feet, below, c)))
                across = _motion(P, at, _step(foot, vector(feet, i, c + 1 if c + 1 < cols else c - 1)))
                area[r, c] = abs(down[0] * across[1] - across[0] * down[1])


@njit(cache=True, nogil=True)
def _step(a, b):  # type: ignore[no-untyped-def]
    return b[0] - a[0], b[1] - a[1], b[2] - a[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel(P, point):  # type: ignore[no-untyped-def]
    """x, y, pixels, and the inverse of the projective depth of a point."""
    p, q, w = P
    part = 1.0 / (dot(w, point) + w[3])
    return (dot(p, point) + p[3]) * part, (dot(q, point) + q[3]) * part, part


@njit(cache=True, nogil=True)
def _is_inside(at, shape):  # type: ignore[no-untyped-def]
    """Whether the spline of an image of a shape is defined at a pixel in front of the camera."""
    x, y, part = at
    rows, cols = shape
    return part > 0.0 and x >= 1.0 and y >= 1.0 and x < cols - 2.0 and y < rows - 2.0


@njit(cache=True, nogil=True, error_model="numpy")
def _motion(P, at, step):  # type: ignore[no-untyped-def]
    """Pixels that the projection ``at`` (x, y, 1 / depth) of a point moves by when the point moves by ``step``."""
    x, y, part = at
    p, q, w = P
    d2 = dot(w, step)
    return (dot(p, step) - x * d2) * part, (dot(q, step) - y * d2) * part
