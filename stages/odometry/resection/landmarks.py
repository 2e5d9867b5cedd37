"""3-D coordinates of interest points of the key frame, triangulated from its disparity.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2: "the 3D coordinates of the Interest Points on Frame N are
calculated from the DEM and the calibration matrix of Frame N". Triangulating the matched point itself skips an
interpolation and is more exact. Coordinates are those of the local frame, with their uncertainty along the ray,
``sigma_Z = sigma_d / |dp_r/dZ|`` (the familiar ``Z^2 / (f B) sigma_d`` of a parallel rig).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.odometry.displacements import known

MAX_DISPARITY_STEP_PX = 1.0
"""Pixels: neighbours whose disparities differ by more lie on two surfaces; also the bound of back-matching (4.3.3)."""
TEMPLATE_HALF_PX = 5
"""Half the side of a template, pixels (see stages.odometry.affine_lk): what its relief is taken over."""


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of a basic pair, with the derivative and the standard deviation of their coordinates.

    Attributes
    ----------
    position : (n, 3) in the local frame, m; NaN if a landmark has no coordinates.
    per_pixel : (n, 3) motion along the ray, away from the camera, for a change of the disparity by a pixel, m/pixel.
    sigma : (n,) standard deviation of the disparity, pixels.
    lost : number of landmarks without coordinates, by reason.
    """

    position: Floats
    per_pixel: Floats
    sigma: Floats
    lost: dict[str, int]

    def summary(self) -> str:
        """The counts in words."""
        return ", ".join(f"{count} {reason}" for reason, count in self.lost.items() if count) or "none lost"

    def take(self, which: NDArray[np.intp]) -> Landmarks:
        """Some of them."""
        return Landmarks(self.position[which], self.per_pixel[which], self.sigma[which], self.lost)


class SegmentPoints(NamedTuple):
    """Points of a segment: where they are in its frames, their landmarks, and the key frame's camera.

    ``tracks`` (n, frames, 2) column, row, NaN lost, key frame first; ``landmarks`` of the same n points in the local
    frame, NaN none; ``T_local_key`` pose of the key frame.
    """

    tracks: Floats32
    landmarks: Landmarks
    camera: Camera
    T_local_key: RigidTransform

    def known(self) -> Bools:
        """Which points (n, frames) have coordinates and were found."""
        coordinates = np.asarray(np.isfinite(self.landmarks.position).all(1))
        return np.asarray(np.isfinite(self.tracks).all(2)) & coordinates[:, None]


def landmarks_of(
    points: Floats,
    disparity: Bundle,
    rig: Rig,
    T_local_left: RigidTransform,
    *,
    disparity_sigma: float,
    max_depth_ratio: float,
) -> Landmarks:
    """Landmarks of points (n, 2) column, row of the left key image; ``disparity`` is that of its pair.

    A point needs four matched (not filled) neighbours on one surface, rays that meet within a pixel in front of both
    cameras, no relief of two surfaces under its template, and a distance whose standard deviation is below
    ``max_depth_ratio`` of it. ``disparity_sigma``: pixels, of a disparity without relief.
    """
    offset, matched = matches_at(points, disparity)
    right = points + offset
    depth = _triangulate(rig.left.rays(points), right, rig)
    miss = np.sqrt(((_right_image(rig.left.rays(points), depth, rig)[0] - right) ** 2).sum(-1))
    meets = matched & (depth > 0) & (miss <= MAX_DISPARITY_STEP_PX)
    sigma = np.hypot(disparity_sigma, relief(points, disparity))
    smooth = meets & np.isfinite(sigma)
    landmarks = triangulated(points, right, rig, T_local_left, sigma)
    spread = np.linalg.norm(landmarks.per_pixel, axis=1) * sigma
    # Beyond, depth is no longer normal though disparity is, and first-order covariances are wrong.
    near = smooth & (spread <= max_depth_ratio * np.where(smooth, depth, 0.0))
    lost = {
        "without a consistent stereo match": int((~matched).sum()),
        "whose rays do not meet": int((matched & ~meets).sum()),
        "on a depth edge or the border of what was matched": int((meets & ~smooth).sum()),
        "too far for the baseline": int((smooth & ~near).sum()),
    }
    position, per_pixel = (np.where(near[:, None], a, np.nan) for a in (landmarks.position, landmarks.per_pixel))
    return Landmarks(position, per_pixel, np.where(near, sigma, np.nan), lost)


def triangulated(points: Floats, right: Floats, rig: Rig, T_local_left: RigidTransform, sigma: Floats) -> Landmarks:
    """Landmarks of matches (n, 2) in both images; NaN where the rays do not meet in front of the cameras."""
    rays = rig.left.rays(points)
    depth = _triangulate(rays, right, rig)
    depth[~(depth > 0)] = np.nan
    _, slope = _right_image(rays, depth, rig)
    per_pixel = 1.0 / np.sqrt((slope**2).sum(-1))
    along = per_pixel[:, None] * (rays @ T_local_left.rotation.T)
    return Landmarks(T_local_left.apply(rays * depth[:, None]), along, sigma, {})


def matches_at(points: Floats, disparity: Bundle) -> tuple[Floats, Bools]:
    """Disparity vectors (n, 2) by bilinear interpolation, and whether the four neighbours are matched and agree."""
    column, row = (np.asarray(disparity[name]) for name in ("column_disparity", "row_disparity"))
    rows, cols = column.shape
    there = known(points)
    p = np.where(there[:, None], points, 0.0)
    inside = there & (p >= 0).all(1) & (p[:, 0] <= cols - 1) & (p[:, 1] <= rows - 1)
    x = np.clip(np.floor(p[:, 0]), 0, cols - 2).astype(np.intp)
    y = np.clip(np.floor(p[:, 1]), 0, rows - 2).astype(np.intp)
    fx, fy = p[:, 0] - x, p[:, 1] - y
    # Bilinear by hand: scipy's would mix what is not matched into its neighbours, where here the whole point is
    # refused.
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    y4, x4 = y[:, None] + np.array([0, 0, 1, 1]), x[:, None] + np.array([0, 1, 0, 1])
    corners = np.stack([column[y4, x4], row[y4, x4]], -1).astype(np.float64)
    # A corner of weight 0 (the point is on the pixel grid) may be anything.
    needed = weights > 1e-9
    matched = (np.asarray(disparity["validity"])[y4, x4] & np.uint8(Validity.MATCHED)) != 0
    good = (matched & np.isfinite(corners).all(-1)) | ~needed
    corners = np.where(needed[..., None] & good[..., None], corners, np.nan)
    ok = inside & good.all(1)
    corners[~ok] = 0.0
    # Between two surfaces an interpolated disparity is that of neither.
    apart = np.nanmax(corners, axis=1) - np.nanmin(corners, axis=1)
    value = np.einsum("nk,nki->ni", weights, np.where(np.isfinite(corners), corners, 0.0))
    return value, ok & (apart <= MAX_DISPARITY_STEP_PX).all(1)


def relief(points: Floats, disparity: Bundle) -> Floats:
    """Relief under each template: RMS (n,) of the disparities about their plane, pixels.

    A template on a rock's edge follows the rock or the ground, not the pixel at its centre; both the stereo match and
    the track are then uncertain by the relief inside the template. NaN where that is beyond
    :data:`MAX_DISPARITY_STEP_PX`, since then there are two surfaces, or where less than half of the template is
    matched.
    """
    side = 2 * TEMPLATE_HALF_PX + 1
    first = np.floor(np.where(known(points)[:, None], points, -1e6) + 0.5).astype(np.intp) - TEMPLATE_HALF_PX
    rows, cols = np.shape(disparity["validity"])
    if min(rows, cols) < side:
        return np.full(len(points), np.nan)
    # No template leaves the image.
    inside = np.asarray((first >= 0).all(1) & (first <= [cols - side, rows - side]).all(1))
    x, y = np.where(inside[:, None], first, 0).T
    column, row, valid = (
        sliding_window_view(np.asarray(disparity[name]), (side, side))[y, x].reshape(-1, side**2)
        for name in ("column_disparity", "row_disparity", "validity")
    )
    values = np.stack([column, row], -1).astype(np.float64)
    use = inside[:, None] & ((valid & np.uint8(Validity.MATCHED)) != 0) & np.isfinite(values).all(-1)
    values[~use] = 0.0
    dy, dx = (
        o.ravel() for o in np.mgrid[-TEMPLATE_HALF_PX : TEMPLATE_HALF_PX + 1, -TEMPLATE_HALF_PX : TEMPLATE_HALF_PX + 1]
    )
    # In units of the template, so that all sums are of the same size.
    design = np.stack([np.ones(dx.size), dx / TEMPLATE_HALF_PX, dy / TEMPLATE_HALF_PX], -1)
    products = (design[:, :, None] * design[:, None, :]).reshape(-1, 9)
    normal = (use @ products).reshape(-1, 3, 3)
    # Matched pixels on a line leave the slope across open: it is 0 then.
    right = design.T @ values
    plane = np.linalg.solve(normal + 1e-9 * np.eye(3), right)
    # Of a least-squares fit: the squares of the values less those of the plane.
    squares = np.maximum((values**2).sum((1, 2)) - (right * plane).sum((1, 2)), 0.0)
    rms = np.sqrt(squares / np.maximum(use.sum(1), 1))
    return np.where((2 * use.sum(1) > dx.size) & (rms <= MAX_DISPARITY_STEP_PX), rms, np.nan)


def _triangulate(rays: Floats, right: Floats, rig: Rig) -> Floats:
    """Depth (n,) in the left camera, m, of least distance in the right image; NaN where the rays do not meet."""
    a = rays @ rig.T_right_left.rotation.T
    t = rig.T_right_left.translation
    xy = rig.right.rays(right)[:, :2]
    # (Z a + t) x (x, y, 1) = 0, two linear equations in Z; then Gauss-Newton on the pixel distance itself.
    left_side = a[:, :2] - xy * a[:, 2:]
    right_side = xy * t[2] - t[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (left_side * right_side).sum(-1) / (left_side**2).sum(-1)
        # The linear solution minimises no distance in the image; from there two steps reach rounding.
        for _ in range(2):
            p, slope = _right_image(rays, depth, rig)
            depth = depth + ((right - p) * slope).sum(-1) / (slope**2).sum(-1)
    return np.where(np.isfinite(depth), depth, np.nan)


def _right_image(rays: Floats, depth: Floats, rig: Rig) -> tuple[Floats, Floats]:
    """Right image (n, 2) of points at a depth on left rays, pixels, and its derivative, pixels/m."""
    a = rays @ rig.T_right_left.rotation.T
    x = depth[:, None] * a + rig.T_right_left.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(x[:, 2] > 0, x[:, 2], np.nan)[:, None]
        focal = np.array([rig.right.fx, rig.right.fy])
        # Along the ray only: by one parameter, depth, not by the three of a point.
        slope = focal * (a[:, :2] * z - x[:, :2] * a[:, 2:]) / z**2
    return rig.right.project(x), slope
