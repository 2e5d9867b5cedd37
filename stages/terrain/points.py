"""Points of a stereo pair: every matched pixel as a point in space, with the standard deviation along its ray.

A left pixel's ray m (depth 1 along the axis) meets the surface at X = m / rho. The inverse depth rho is linear in the
disparity (:func:`~rille.stages.geometry.epipolar.inverse_depth`), so with s the standard deviation of the disparity,

    sigma_along = |X| (|d rho / d disparity| s) / rho
    sigma_across = |X| / (f sqrt(12))

where sigma_across is that of a point that lies anywhere within its pixel: the ray itself is exact. The covariance of
a point is sigma_along^2 n n^T + sigma_across^2 (I - n n^T), with n the direction of its ray. Errors of the pose and of
the rig are not in it. No ground, frame of the world or lattice is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.core.declare import AnyArray, Bundle
from rille.stages.core.errors import InputError
from rille.stages.core.validity import matched
from rille.stages.geometry.epipolar import inverse_depth
from rille.stages.geometry.geometry import Rig

MIN_DEPTH_SIGMAS = 3.0
"""An inverse depth less than so many of its standard deviations above 0 may be that of an infinitely far point; one as
many below 0 is a wrong match."""

MAX_CUBES = 1_000_000
"""Cubes to either side of the origin."""


@dataclass(frozen=True)
class PairPoints:
    """Points in the left camera's frame.

    Parameters
    ----------
    position : (n, 3) float64 x, y, z, m.
    sigma_along, sigma_across : (n,) float32 standard deviations along and across the ray of the left camera, m.
    pixel : (n, 2) int32 column and row in the left image.
    """

    position: Floats
    sigma_along: Floats32
    sigma_across: Floats32
    pixel: NDArray[np.int32]

    def __getitem__(self, which: AnyArray) -> PairPoints:
        return PairPoints(self.position[which], self.sigma_along[which], self.sigma_across[which], self.pixel[which])


def points(disparity: Bundle, rig: Rig, every: int = 1) -> PairPoints:
    """Points of the matched pixels of a pair, row by row.

    Parameters
    ----------
    disparity : result of stage ``hfvm``; interpolated pixels are no measurements and give no point.
    every : take each n-th row and column alone.
    """
    thin = np.s_[::every, ::every]
    std = np.asarray(disparity["disparity_std"])[thin]
    use = matched(np.asarray(disparity["validity"])[thin]) & np.isfinite(std)
    row, column = np.nonzero(use)
    pixel = np.stack([column, row], axis=1) * every
    shift = np.stack([np.asarray(disparity[n])[thin][use] for n in ("column_disparity", "row_disparity")], axis=1)
    rho, per_pixel = inverse_depth(rig, pixel.astype(np.float64), shift.astype(np.float64))
    sigma = per_pixel * std[use]
    near = rho > MIN_DEPTH_SIGMAS * sigma
    pixel, rho, sigma = pixel[near], rho[near], sigma[near]
    position = rig.left.rays(pixel.astype(np.float64)) / rho[:, None]
    away = np.linalg.norm(position, axis=1)
    focal = min(rig.left.fx, rig.left.fy)
    return PairPoints(
        position,
        (away * sigma / rho).astype(np.float32),
        (away / (focal * np.sqrt(12.0))).astype(np.float32),
        pixel.astype(np.int32),
    )


def colours(pixel: NDArray[np.integer], image: Bundle) -> Bytes:
    """Red, green and blue (n, 3) of pixels (n, 2), column and row, of an image; thrice its grey where it is grey."""
    column, row = pixel.T
    if "colour" in image.arrays:
        return np.asarray(np.asarray(image["colour"])[row, column])
    grey = np.asarray(image["image"])
    grey = grey[row, column] / (257.0 if grey.dtype == np.uint16 else 1.0)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[:, None], 3, axis=1)


def cubes(position: Floats, side: float) -> NDArray[np.int64]:
    """Numbers (n,) of the cubes that points lie in, of a grid of cubes of ``side`` m with a corner at the origin.

    Raises
    ------
    InputError
        The points reach farther than a million cubes.
    """
    cube = np.floor(position / side)
    if cube.size and np.abs(cube).max() >= MAX_CUBES:
        raise InputError(
            "RIL-619",
            f"points lie more than {MAX_CUBES} voxels of {side:g} m from the origin",
            remedy="give larger ones with --voxel",
        )
    whole = cube.astype(np.int64) + MAX_CUBES
    return np.asarray((whole[:, 0] * 2 * MAX_CUBES + whole[:, 1]) * 2 * MAX_CUBES + whole[:, 2])


def one_a_cube(cube: NDArray[np.int64], sigma: Floats32) -> NDArray[np.intp]:
    """Indices, ascending, of the most certain point of each cube."""
    order = np.lexsort((sigma, cube))
    return np.sort(order[np.unique(cube[order], return_index=True)[1]])
