"""The usual way: OpenCV's rectification and matching, points gridded, slope and roughness blended to one number."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.hazard.risk import HAZARDOUS, SAFE, UNKNOWN
from rille.stages.numeric.windows import window_sum

from .scenes import CELL, Scene

RANGE, BLOCK = 256, 5
"""Disparities searched, and the side of SGBM's window, pixels."""
NO_LENS = np.zeros(5)
THRESHOLD = 0.5
"""Of the blend, as in grid maps' traversability filters."""


def elevations(scene: Scene) -> NDArray[np.float32]:
    """Median height (row, col), metres, of the points in each cell; NaN where there is none."""
    left, right, rig = *scene.images, scene.rig
    size = left.shape[::-1]
    T = rig.T_right_left
    R1, R2, P1, P2, Q, _, _ = cv2.stereoRectify(
        rig.left.matrix, NO_LENS, rig.right.matrix, NO_LENS, size, T.rotation, T.translation[:, None], alpha=0
    )
    images = []
    for image, camera, R, P in ((left, rig.left, R1, P1), (right, rig.right, R2, P2)):
        maps = cv2.initUndistortRectifyMap(camera.matrix, NO_LENS, R, P, size, cv2.CV_32FC1)
        images.append(cv2.remap(image, *maps, cv2.INTER_LINEAR))
    smooth = {"P1": 8 * BLOCK**2, "P2": 32 * BLOCK**2, "disp12MaxDiff": 1, "uniquenessRatio": 10}
    matcher = cv2.StereoSGBM.create(
        0, RANGE, BLOCK, **smooth, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH
    )
    disparity = matcher.compute(*images).astype(np.float32) / 16.0
    points = cv2.reprojectImageTo3D(disparity, Q)
    good = (disparity > 0) & np.isfinite(points).all(axis=-1) & (points[..., 2] > 0)
    found = scene.T_local_left.apply(points[good].astype(np.float64) @ R1)
    low, high = scene.z_range
    return _gridded(found[(found[:, 2] >= low) & (found[:, 2] <= high)], scene)


def _gridded(points: NDArray[np.float64], scene: Scene) -> NDArray[np.float32]:
    at = np.rint(scene.lattice.index(points[:, :2])).astype(np.int64)
    inside = ((at >= 0) & (at < scene.lattice.shape)).all(axis=1)
    cell, z = at[inside, 0] * scene.lattice.cols + at[inside, 1], points[inside, 2]
    order = np.lexsort((z, cell))
    cell, z = cell[order], z[order]
    first = np.flatnonzero(np.r_[True, cell[1:] != cell[:-1]])
    count = np.diff(np.r_[first, len(cell)])
    out = np.full(scene.lattice.rows * scene.lattice.cols, np.nan, dtype=np.float32)
    out[cell[first]] = z[first + count // 2]
    return out.reshape(scene.lattice.shape)


def blend(scene: Scene) -> dict[str, Any]:
    """Classes (row, col): hazardous where the mean of slope, roughness and step over their limits exceeds a half."""
    z, vehicle = elevations(scene), scene.vehicle
    size = 2 * round(0.5 * vehicle.wheel_base / CELL) + 1
    slope, residual = _planes(z, size)
    near = np.ones((2 * round(0.5 * vehicle.wheel_diameter / CELL) + 1,) * 2, np.uint8)
    high, low = (
        sign * cv2.dilate(np.where(np.isnan(z), -np.inf, sign * z), near, borderType=cv2.BORDER_REPLICATE)
        for sign in (1, -1)
    )
    parts = (
        np.degrees(np.arctan(slope)) / vehicle.max_slope_deg,
        residual / vehicle.max_roughness,
        (high - low) / vehicle.max_step,
    )
    value = sum(np.clip(part, 0.0, 1.0) for part in parts) / 3.0
    risk = np.where(value > THRESHOLD, np.uint8(HAZARDOUS), np.uint8(SAFE))
    risk[np.isnan(z) | ~np.isfinite(value)] = UNKNOWN
    return {"risk": risk}


def _planes(height: NDArray[np.float32], n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradient, and RMS residual in metres, of the plane through the known cells of each n x n window."""
    known = ~np.isnan(height)
    z = np.where(known, height.astype(np.float64) - np.nanmean(height), 0.0)
    y, x = (axis - axis.mean() for axis in np.indices(z.shape, dtype=np.float64))
    count = window_sum(known, n)
    one = np.maximum(count, 1.0)

    def mean(values: NDArray[Any]) -> NDArray[np.float64]:
        return window_sum(np.where(known, values, 0.0), n) / one

    mx, my, mz = mean(x), mean(y), mean(z)
    xx, yy, xy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    xz, yz, zz = mean(x * z) - mx * mz, mean(y * z) - my * mz, mean(z * z) - mz * mz
    det = xx * yy - xy * xy
    det = np.where((count > 2.5) & (det * one * one > 0.1), det, np.nan)  # else the cells lie on one line
    b, c = (xz * yy - yz * xy) / det, (yz * xx - xz * xy) / det
    return np.hypot(b, c) / CELL, np.sqrt(np.maximum(zz - b * xz - c * yz, 0.0))
