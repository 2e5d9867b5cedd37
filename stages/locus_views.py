"""Both images seen through the elevations: grey values of each cell in the left and the right image.

A cell with foot F, normal N and elevation Z is the point P = F + Z N; its projections p_l and p_r are read from the
cubic splines through the images' pixels, so that detail is kept. With the terrain right, both show the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from stages.surface import Surface

Float32 = NDArray[np.float32]
Floats = NDArray[np.float64]

BLOCK_ROWS = 64  # rows of cells in one call, so that a large surface's feet stay small in memory
PLANES = 6


@dataclass(frozen=True)
class Views:
    """Projections (3, 4) from the frame of the surface to pixels, splines of both images, the left camera's centre."""

    left: Floats
    right: Floats
    splines: tuple[Float32, Float32]
    centre: Floats


def views(left: Floats, right: Floats, left_image: Float32, right_image: Float32, centre: Floats) -> Views:
    """Views of two images (row, col), grey values; ``centre`` of the left camera in the frame of the surface, m."""
    splines = [scipy.ndimage.spline_filter(image, 3, np.float32, mode="mirror") for image in (left_image, right_image)]
    return Views(left, right, (splines[0], splines[1]), np.asarray(centre, np.float64))


def look(views: Views, surface: Surface, elevation: Floats) -> Float32:
    """What both images show at the elevations of the cells.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN unknown.

    Returns
    -------
    (6, rows, cols) float32: grey value of the left and of the right image; how the left one changes with the
    elevation, per metre; disparity a metre of elevation, pixels; pixels of the left image that a cell covers; how the
    right one changes with the elevation. NaN where a cell is unknown or not inside both images.
    """
    out = np.full((PLANES, surface.rows, surface.cols), np.nan, np.float32)
    cols = np.arange(surface.cols)
    for start in range(0, surface.rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, surface.rows)
        # A row beyond either end, so that every cell has a neighbour below or above to measure its size with.
        first, last = max(0, start - 1), min(surface.rows, stop + 1)
        feet, normals = surface.block(np.arange(first, last), cols)
        z = np.ascontiguousarray(elevation[first:last])
        part = np.full((PLANES, last - first, surface.cols), np.nan, np.float32)
        _look(feet, normals, z, views.left, views.right, views.centre, *views.splines, part)
        out[:, start:stop] = part[:, start - first : stop - first]
    return out


@njit(cache=True, nogil=True)
def _project(p, at):  # type: ignore[no-untyped-def]
    """Homogeneous projection of a point; its depth comes last."""
    return (
        p[0, 0] * at[0] + p[0, 1] * at[1] + p[0, 2] * at[2] + p[0, 3],
        p[1, 0] * at[0] + p[1, 1] * at[1] + p[1, 2] * at[2] + p[1, 3],
        p[2, 0] * at[0] + p[2, 1] * at[1] + p[2, 2] * at[2] + p[2, 3],
    )


@njit(cache=True, nogil=True)
def _motion(p, h, way):  # type: ignore[no-untyped-def]
    """Pixels that the projection ``h`` of a point moves by when the point moves along ``way``, a metre."""
    d0 = p[0, 0] * way[0] + p[0, 1] * way[1] + p[0, 2] * way[2]
    d1 = p[1, 0] * way[0] + p[1, 1] * way[1] + p[1, 2] * way[2]
    d2 = p[2, 0] * way[0] + p[2, 1] * way[1] + p[2, 2] * way[2]
    return (d0 - h[0] / h[2] * d2) / h[2], (d1 - h[1] / h[2] * d2) / h[2]


@njit(cache=True, nogil=True)
def _read(spline, x, y, w, slope):  # type: ignore[no-untyped-def]
    """Value and gradient (x, y) of a cubic spline at a pixel or more from the edge."""
    i, j = int(x), int(y)
    for axis, t in ((0, x - i), (1, y - j)):
        q = 1.0 - t
        w[axis, 0], w[axis, 3] = q * q * q / 6.0, t * t * t / 6.0
        w[axis, 1], w[axis, 2] = (4.0 - 3.0 * t * t * (2.0 - t)) / 6.0, (4.0 - 3.0 * q * q * (2.0 - q)) / 6.0
        slope[axis, 0], slope[axis, 3] = -0.5 * q * q, 0.5 * t * t
        slope[axis, 1], slope[axis, 2] = 0.5 * t * (3.0 * t - 4.0), -0.5 * q * (3.0 * q - 4.0)
    value = gx = gy = 0.0
    for k in range(4):
        across = along = 0.0
        for m in range(4):
            c = spline[j - 1 + k, i - 1 + m]
            across += w[0, m] * c
            along += slope[0, m] * c
        value += w[1, k] * across
        gx += w[1, k] * along
        gy += slope[1, k] * across
    return value, gx, gy


@njit(cache=True, nogil=True)
def _look(feet, normals, z, left, right, centre, left_spline, right_spline, out):  # type: ignore[no-untyped-def]
    rows, cols = z.shape
    w, slope = np.empty((2, 4)), np.empty((2, 4))
    at, way = np.empty(3), np.empty(3)
    for r in range(rows):
        for c in range(cols):
            if not np.isfinite(z[r, c]):
                continue
            foot, normal = feet[r, c], normals[r, c]
            toward = 0.0
            for k in range(3):
                at[k] = foot[k] + z[r, c] * normal[k]
                way[k] = at[k] - centre[k]
                toward += way[k] * normal[k]
            a, b = _project(left, at), _project(right, at)
            if a[2] <= 0.0 or b[2] <= 0.0 or toward == 0.0:
                continue
            xl, yl, xr, yr = a[0] / a[2], a[1] / a[2], b[0] / b[2], b[1] / b[2]
            if not (_inside(left_spline, xl, yl) and _inside(right_spline, xr, yr)):
                continue
            # Along the left ray the left image stays: what the right one moves by is disparity.
            for k in range(3):
                way[k] /= toward
            disparity = _motion(right, b, way)
            grey_left, lx, ly = _read(left_spline, xl, yl, w, slope)
            grey_right, rx, ry = _read(right_spline, xr, yr, w, slope)
            move_left, move_right = _motion(left, a, normal), _motion(right, b, normal)
            out[0, r, c], out[1, r, c] = grey_left, grey_right
            out[2, r, c] = lx * move_left[0] + ly * move_left[1]
            out[5, r, c] = rx * move_right[0] + ry * move_right[1]
            out[3, r, c] = np.sqrt(disparity[0] ** 2 + disparity[1] ** 2)
            below, beside = (r + 1 if r + 1 < rows else r - 1), (c + 1 if c + 1 < cols else c - 1)
            if below < 0 or beside < 0:
                out[4, r, c] = 1.0
                continue
            down = _motion(left, a, feet[below, c] - foot)
            across = _motion(left, a, feet[r, beside] - foot)
            out[4, r, c] = abs(down[0] * across[1] - down[1] * across[0])


@njit(cache=True, nogil=True)
def _inside(spline, x, y):  # type: ignore[no-untyped-def]
    return x >= 1.0 and y >= 1.0 and x < spline.shape[1] - 2 and y < spline.shape[0] - 2
