"""Place, range, normal and roughness of each pixel of a stereo pair, in the geometry of its left camera.

A plane n . X = 1 seen along the ray m of a pixel has the inverse depth

    rho = n . m,        m = (x, y, 1),

which is linear in the ray. So the n of a pixel is the least-squares solution over the matched pixels of a window, whose
errors are alike there; n / |n| is the surface normal, 1 / |n| its distance from the camera. The roughness is the root
mean square of the window's points' distances from that plane, (n . m - rho) / (rho |n|).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.geometry.geometry import Camera
from rille.stages.numeric.windows import window_sum
from rille.stages.terrain.points import PairPoints

NORMAL_SIDE_PX = 11
"""Pixels: side of the window that a normal is fitted to."""


@dataclass(frozen=True)
class CameraProducts:
    """Rasters (row, col, ...) float32 of the left image in its camera's frame, NaN where nothing is known.

    Parameters
    ----------
    position : (row, col, 3) m.
    distance, sigma : range along the ray and its standard deviation, m.
    normal : (row, col, 3) unit vectors towards the camera.
    roughness : root mean square distance from the plane of the window, m.
    """

    position: Floats32
    distance: Floats32
    sigma: Floats32
    normal: Floats32
    roughness: Floats32


def camera_products(points: PairPoints, camera: Camera) -> CameraProducts:
    """Rasters of a pair's points, of every pixel (``every`` = 1)."""
    shape = camera.height, camera.width
    column, row = points.pixel.T
    position, sigma = np.full((*shape, 3), np.nan, np.float32), np.full(shape, np.nan, np.float32)
    position[row, column], sigma[row, column] = points.position, points.sigma_along
    normal, roughness = _planes(position)
    return CameraProducts(position, np.linalg.norm(position, axis=2).astype(np.float32), sigma, normal, roughness)


def _planes(position: Floats32) -> tuple[Floats32, Floats32]:
    """Normals and roughness, see the module."""
    depth = position[..., 2].astype(np.float64)
    known = np.isfinite(depth)
    rho = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)
    rays = [np.where(known, position[..., k] * rho, 0.0) for k in range(2)]
    # From the window's own middle, so that the squares below keep their digits.
    count = np.maximum(window_sum(known, NORMAL_SIDE_PX), 1.0)
    x, y, r = (window_sum(a, NORMAL_SIDE_PX) / count for a in (*rays, rho))

    def covariance(a: Floats, b: Floats, mean_a: Floats, mean_b: Floats) -> Floats:
        return window_sum(a * b, NORMAL_SIDE_PX) / count - mean_a * mean_b

    xx, yy = covariance(rays[0], rays[0], x, x), covariance(rays[1], rays[1], y, y)
    xy, xr, yr = covariance(rays[0], rays[1], x, y), covariance(rays[0], rho, x, r), covariance(rays[1], rho, y, r)
    rr = covariance(rho, rho, r, r)
    determinant = xx * yy - xy * xy
    full = np.nanmax(determinant, initial=0.0)
    usable = (
        # Rays that lie on a line have no normal: their covariance is far below that of a full window.
        known & (count >= 0.3 * NORMAL_SIDE_PX * NORMAL_SIDE_PX) & (determinant > 1e-6 * full)
    )
    inverse = 1.0 / np.where(usable, determinant, 1.0)
    nx, ny = (xr * yy - yr * xy) * inverse, (yr * xx - xr * xy) * inverse
    n = np.stack([nx, ny, r - nx * x - ny * y], axis=-1)
    length = np.linalg.norm(n, axis=2)
    rest = np.sqrt(np.maximum(rr - nx * xr - ny * yr, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        # The plane's points have n . X = 1 > 0, so n points away from the camera.
        normal, roughness = -n / length[..., None], rest / (r * length)
    normal[~usable], roughness[~usable] = np.nan, np.nan
    return normal.astype(np.float32), roughness.astype(np.float32)
