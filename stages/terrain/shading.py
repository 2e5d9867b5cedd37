"""Slope and shaded relief of an elevation model.

The gradient is that of the plane fitted to the 3 x 3 cells around each, weighted 1, 2, 1 along both axes: Horn's (1981,
doi:10.1109/PROC.1981.11918) where all nine are known, so that GDAL's and our slopes agree there. Elsewhere the same
plane is fitted to the known ones, if they determine it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.numeric.windows import window_count


def gradient(elevation: ArrayLike, cell: float) -> Floats:
    """Slope of the terrain towards greater x and greater y (2, rows, cols), metres per metre; NaN unknown.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN unknown; row 0 at the greatest y.
    cell : side of a cell, metres.
    """
    z = np.asarray(elevation, dtype=np.float64)
    known = np.isfinite(z)
    # Weighted sums of 1, x, y, xx, xy, yy and of z, xz, yz about each cell; y is against the rows.
    one, line, square = np.array([1.0, 2.0, 1.0]), np.array([-1.0, 0.0, 1.0]), np.array([1.0, 0.0, 1.0])
    there, height = known.astype(np.float64), np.where(known, z, 0.0)
    kernels = ((one, one), (line, one), (one, -line), (square, one), (line, -line), (one, square))
    n, sx, sy, xx, xy, yy = (_filtered(there, *kernel) for kernel in kernels)
    sz, xz, yz = (_filtered(height, *kernel) for kernel in kernels[:3])
    safe = np.maximum(n, 1.0)
    xx, xy, yy = xx - sx * sx / safe, xy - sx * sy / safe, yy - sy * sy / safe
    xz, yz = xz - sx * sz / safe, yz - sy * sz / safe
    det = xx * yy - xy * xy
    # Of nine cells six do not lie on two lines only, and the plane has three unknowns.
    good = known & (window_count(known, 3) >= 6) & (det > 1e-9)
    det = np.where(good, det, 1.0)
    slopes = np.stack([(yy * xz - xy * yz) / det, (xx * yz - xy * xz) / det]) / cell
    return np.where(good, slopes, np.nan)


def _filtered(values: Floats, across: Floats, down: Floats) -> Floats:
    """Sums over 3 x 3 cells, weighted along rows and columns; outside is nothing."""
    return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, across, down, borderType=cv2.BORDER_CONSTANT))


def slope_deg(elevation: ArrayLike, cell: float) -> Floats32:
    """Inclination (rows, cols) of the terrain, degrees; NaN unknown."""
    gx, gy = gradient(elevation, cell)
    return np.asarray(np.degrees(np.arctan(np.hypot(gx, gy))), np.float32)


def hillshade(elevation: ArrayLike, cell: float, turned: float = 0.0) -> Bytes:
    """Shaded relief (rows, cols), 1 (facing away) to 255 (facing the light), 0 unknown: GDAL's form, in light from the
    upper left, as on maps, 45 degrees above the horizon.

    ``turned``: azimuth of y on the map that is shown, radians clockwise from its top; elsewhere relief would look
    inverted, lit from below.
    """
    gx, gy = gradient(elevation, cell)
    azimuth, altitude = math.radians(315.0) - turned, math.radians(45.0)  # azimuth clockwise from y
    light = np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude)
    facing = (light[2] - gx * light[0] - gy * light[1]) / np.sqrt(1.0 + gx * gx + gy * gy)
    shade = 1.0 + 254.0 * np.maximum(facing, 0.0)
    return np.where(np.isfinite(shade), np.rint(shade), 0.0).astype(np.uint8)
