"""3-D coordinates of interest points of the key frame, triangulated from its disparity.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2: "the 3D coordinates of the Interest Points on Frame N are
calculated from the DEM and the calibration matrix of Frame N". Triangulating the matched point itself skips an
interpolation and is more exact. Coordinates are those of the local frame, with their uncertainty along the ray,
``sigma_Z = sigma_d / |dp_r/dZ|`` (the familiar ``Z^2 / (f B) sigma_d`` of a parallel rig).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Bundle
from rille.stages.core.validity import matched as is_matched
from rille.stages.geometry.epipolar import inverse_depth, line_distances
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.scale import right_pixels
from rille.stages.numeric.least_squares import irls
from rille.stages.odometry.affine_lk import HALF
from rille.stages.odometry.displacements import windows_at

MAX_DISPARITY_STEP_PX = 1.0
"""Pixels: neighbours whose disparities differ by more than those of one plane lie on two surfaces; also the bound of
back-matching (4.3.3)."""
MAX_RELATIVE_SIGMA = 0.2
"""Largest standard deviation of a landmark's distance over the distance; beyond, depth is no longer normal though
disparity is, and first-order covariances are wrong."""


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of a basic pair, with the derivative and the standard deviation of their coordinates.

    Attributes
    ----------
    position : (n, 3) in the local frame, m; NaN if a landmark has no coordinates.
    per_pixel : (n, 3) motion along the ray, away from the camera, for a change of the disparity by a pixel, m/pixel.
    sigma : (n,) standard deviation of the disparity, pixels.
    inverse_parallax : (n,) 1 over the parallax, which is the disparity's difference from that of a point at infinity,
        1/pixel; 0 moves landmarks in proportion to pixels.
    lost : number of landmarks without coordinates, by reason.
    """

    position: Floats
    per_pixel: Floats
    sigma: Floats
    inverse_parallax: Floats
    lost: dict[str, int] = field(default_factory=dict)

    def summary(self) -> str:
        """The counts in words."""
        return (
            ", ".join(f"{count} {reason}" for reason, count in self.lost.items() if count) or "no others were tracked"
        )

    def take(self, which: NDArray[np.intp]) -> Landmarks:
        """The chosen landmarks."""
        arrays = self.position[which], self.per_pixel[which], self.sigma[which], self.inverse_parallax[which]
        return Landmarks(*arrays, self.lost)

    def moved(self, pixels: Floats | float) -> Landmarks:
        """Landmarks whose disparities are larger by ``pixels``, of all or (n,).

        Disparities are linear in inverse depths, not in depths: a depth that is linear in the disparity makes errors of
        disparities smaller where the whole scene is nearer, so an adjustment would pull scenes of one depth towards the
        camera, and shorten the path. Farther than ten times as far nothing is moved: infinity lies there.
        """
        farther = 1.0 / np.maximum(1.0 - self.inverse_parallax * pixels, 0.1)
        return replace(
            self,
            position=self.position + (pixels * farther)[:, None] * self.per_pixel,
            per_pixel=self.per_pixel * farther[:, None] ** 2,
            inverse_parallax=self.inverse_parallax * farther,
        )


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
    points: Floats, disparity: Bundle, rig: Rig, T_local_left: RigidTransform, disparity_sigma: float
) -> Landmarks:
    """Landmarks of points (n, 2) column, row of the left key image; ``disparity`` is that of its pair.

    A point needs four matched (not filled) neighbours on one surface, rays that meet within a pixel in front of the
    camera, no relief of two surfaces under its template, and a distance whose standard deviation is below
    :data:`MAX_RELATIVE_SIGMA` of it. ``disparity_sigma``: pixels, of a disparity without relief.
    """
    # A match is as exact as the coarser pixels let it be: of the left image where the right one has finer ones.
    unit = right_pixels(rig)
    offset, matched, relief = matches_at(points, disparity, unit)
    right = points + offset
    sigma = np.hypot(unit * disparity_sigma, relief)
    landmarks = triangulated(points, right, rig, T_local_left, sigma)
    depth = T_local_left.inverse().apply(landmarks.position)[:, 2]
    off = line_distances(rig, points, right)
    meets = matched & (depth > 0) & (np.abs(off) <= unit * MAX_DISPARITY_STEP_PX)
    smooth = meets & np.isfinite(sigma)
    spread = np.linalg.norm(landmarks.per_pixel, axis=1) * sigma
    near = smooth & (spread <= MAX_RELATIVE_SIGMA * np.where(smooth, depth, 0.0))
    lost = {
        "without a consistent stereo match": int((~matched).sum()),
        "whose rays do not meet": int((matched & ~meets).sum()),
        "on a depth edge or the border of what was matched": int((meets & ~smooth).sum()),
        "too far for the baseline": int((smooth & ~near).sum()),
    }
    position, per_pixel = (np.where(near[:, None], a, np.nan) for a in (landmarks.position, landmarks.per_pixel))
    return replace(landmarks, position=position, per_pixel=per_pixel, sigma=np.where(near, sigma, np.nan), lost=lost)


def triangulated(points: Floats, right: Floats, rig: Rig, T_local_left: RigidTransform, sigma: Floats) -> Landmarks:
    """Landmarks of matches (n, 2) in both images; NaN where the rays do not meet in front of the camera."""
    rays = rig.left.rays(points)
    inverse, slope = inverse_depth(rig, points, right - points)
    depth = 1.0 / np.where(inverse > 0, inverse, np.nan)
    along = (depth**2 * slope)[:, None] * (rays @ T_local_left.rotation.T)
    return Landmarks(T_local_left.apply(rays * depth[:, None]), along, sigma, depth * slope)


def matches_at(points: Floats, disparity: Bundle, unit: float = 1.0) -> tuple[Floats, Bools, Floats]:
    """Disparity vectors (n, 2) by bilinear interpolation, whether the four neighbours are matched and agree, and the
    relief (n,) under the template, see :func:`template_planes`.

    ``unit``: right pixels that :data:`MAX_DISPARITY_STEP_PX` counts in.
    """
    validity = np.asarray(disparity["validity"])
    rows, cols = validity.shape
    inside = np.asarray(((points >= 0) & (points <= [cols - 1, rows - 1])).all(1))
    p = np.where(inside[:, None], points, 0.0)
    # A point on the pixel grid is its own neighbour, whatever the pixels beside it.
    first, last = np.floor(p).astype(np.intp), np.ceil(p).astype(np.intp)
    x4, y4 = (np.stack([first, last])[which, :, k].T for k, which in enumerate(([0, 1, 0, 1], [0, 0, 1, 1])))
    fx, fy = (p - first).T
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    # Bilinear by hand: a point with an unmatched neighbour is refused, where scipy's would mix the neighbour in.
    corners = np.stack([np.asarray(disparity[n])[y4, x4] for n in ("column_disparity", "row_disparity")], -1)
    good = inside & (is_matched(validity[y4, x4]) & np.isfinite(corners).all(-1)).all(1)
    corners = np.where(good[:, None, None], corners, 0.0).astype(np.float64)
    # Between two surfaces an interpolated disparity is that of neither. On one that is steep in disparity, as ground is
    # to low cameras far from each other, or to a right one of finer pixels, neighbours differ by what its plane says.
    slopes, relief = template_planes(points, disparity, unit)
    on_plane = np.stack([x4, y4], -1) @ slopes
    apart = np.minimum(np.ptp(corners, axis=1), np.ptp(corners - on_plane, axis=1))
    return np.einsum("nk,nki->ni", weights, corners), good & (apart <= unit * MAX_DISPARITY_STEP_PX).all(1), relief


def template_planes(points: Floats, disparity: Bundle, unit: float = 1.0) -> tuple[Floats, Floats]:
    """Planes of the disparities under each template: slopes (n, 2, 2) along columns and rows, pixels a pixel, 0 where
    nothing tells them; and the relief, the RMS (n,) of the disparities about them, pixels.

    A template on a rock's edge follows the rock or the ground, not the pixel at its centre; both the stereo match and
    the track are then uncertain by the relief inside the template. It is NaN where it is beyond
    :data:`MAX_DISPARITY_STEP_PX`, since then there are two surfaces, or where less than half of the template is
    matched.
    """
    if not len(points):
        return np.zeros((0, 2, 2)), np.zeros(0)
    names = "column_disparity", "row_disparity", "validity"
    inside, windows = windows_at(points, HALF, *(np.asarray(disparity[name]) for name in names))
    column, row, valid = (window.reshape(len(points), -1) for window in windows)
    values = np.stack([column, row], -1).astype(np.float64)
    use = inside[:, None] & is_matched(valid) & np.isfinite(values).all(-1)
    values[~use] = 0.0
    dy, dx = (o.ravel() for o in np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1])
    # In units of the template, so that all sums are of the same size.
    design = np.stack([np.ones(dx.size), dx / HALF, dy / HALF], -1)
    # Matched pixels on a line leave the slope across open: it is 0 then.
    plane = irls(design[None], values, lambda _: use.astype(np.float64), 1e-9 * np.eye(3), rounds=1)
    rest = np.where(use[..., None], values - design @ plane, 0.0)
    rms = np.sqrt((rest**2).sum((1, 2)) / np.maximum(use.sum(1), 1))
    told = (2 * use.sum(1) > dx.size) & (rms <= unit * MAX_DISPARITY_STEP_PX)
    return plane[:, 1:] / HALF, np.where(told, rms, np.nan)
