"""Epipolar distances of matches, corrections of the rig, and the effect of corrections on depth.

A correction of a rig has five parameters, all zero for the rig as given; the length of the baseline is not one of them,
since no image shows it. ``pitch``, ``yaw``, ``roll`` (radians) turn the right camera about the x, y and z axis of its
given frame, its centre held (where the baseline is oblique in its image, about :func:`turn_axes`); ``baseline_across``
and ``baseline_forward`` (radians, to first order) turn that centre about the left camera's, across the baseline in the
image plane and along the optical axis.

The residual is the distance of the right point from the epipolar line of the left one, in pixels of the right image:
the first-order (Sampson) error of a correspondence whose left pixel is exact, as it is in a disparity map of the left
image (Hartley and Zisserman 2004, section 11.4.3). On a usual rig it is the row offset, positive if the right point
lies below the line; on a rig with one camera above the other it is the column offset, positive to the right.
"""

from __future__ import annotations

import math

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import Rig, RigidTransform, cross_matrix, left_jacobian, rotation_exp, rotation_log

NAMES = ("pitch", "yaw", "roll", "baseline_across", "baseline_forward")
"""The five parameters of a correction, in their order in vectors."""

MAX_LINE_DISTANCE_PX = 2.0
"""Distance from its epipolar line up to which a match lies on it: in a street .95 to .98 of the matches of simultaneous
images, .22 to .32 of images one frame apart; in a desert .99, and up to .08."""


def turn_axes(rig: Rig) -> Floats:
    """Axes of pitch, yaw and roll in the right camera's frame, the columns of (3, 3).

    They are those of the camera, unless its image shows the baseline obliquely: there a pitch and a yaw would move it
    across and along its epipolar lines alike, and no row would tell the two apart. There that of pitch lies along it.
    """
    x, y, _ = rig.T_right_left.translation
    angle = math.remainder(math.atan2(y, x), math.pi)
    # 15 degrees to the image's rows or columns: up to there its own axes serve.
    oblique = abs(math.remainder(angle, 0.5 * math.pi)) > math.radians(15.0)
    # 0.5: of the baseline. Where it leads along the view, lines radiate and show all turns.
    if not oblique or math.hypot(x, y) < 0.5 * rig.baseline:
        return np.eye(3)
    return rotation_exp([0.0, 0.0, angle])


def standing(rig: Rig) -> bool:
    """Whether epipolar lines run along the columns of the right image: along the y axis of :func:`turn_axes`."""
    x, y, _ = np.abs(rig.T_right_left.translation @ turn_axes(rig))
    return bool(y > x)


def angle_along(rig: Rig) -> str:
    """Name of the angle that moves the right image along its epipolar lines, and so all disparities."""
    return "pitch" if standing(rig) else "yaw"


def corrected(rig: Rig, correction: Floats) -> Rig:
    """The rig with a correction (5,) applied; the same object for a correction of zeros.

    The length of the baseline is that of ``rig``.
    """
    if not np.any(correction):
        return rig
    # The turn keeps the centre; the translation follows from both.
    rotation = rotation_exp(turn_axes(rig) @ correction[:3]) @ rig.T_right_left.rotation
    centre, _ = _centre(rig, correction)
    return Rig(rig.left, rig.right, RigidTransform(rotation, -rotation @ centre))


def turned_along(rig: Rig, other: Rig) -> float:
    """Angle of :func:`angle_along`, rad, by which the right camera of an ``other`` rig is turned against that of
    ``rig``."""
    turn = rotation_log(other.T_right_left.rotation @ rig.T_right_left.rotation.T) @ turn_axes(rig)
    return float(turn[NAMES.index(angle_along(rig))])


def far_shift(rig: Rig, changed: Rig) -> Floats:
    """Pixels (2,) by which a point far ahead moves in the right image if the rig is ``changed``."""
    far = np.array([0.0, 0.0, 1e3 * rig.baseline])
    before, after = (one.right.project(one.T_right_left.apply(far)) for one in (rig, changed))
    return np.asarray(after - before)


def farther(rig: Rig) -> Floats:
    """Direction (2,), column and row, in which a point far ahead moves in the right image as its distance grows; zeros
    where the baseline leads along the view."""
    along = -rig.T_right_left.translation[:2]
    return np.asarray(along / max(float(np.linalg.norm(along)), 1e-9 * rig.baseline))


def line_distances(rig: Rig, left: Floats, right: Floats) -> Floats:
    """Signed distances (n,) of right points from the epipolar lines of left ones, (n, 2) column and row, pixels."""
    essential = rig.T_right_left.rotation @ cross_matrix(_centre(rig, np.zeros(len(NAMES)))[0])
    line = _homogeneous(left) @ (np.linalg.inv(rig.right.matrix).T @ essential @ np.linalg.inv(rig.left.matrix)).T
    return np.asarray((_homogeneous(right) * line).sum(axis=1) / _length(line))


def _homogeneous(points: Floats) -> Floats:
    return np.column_stack([points, np.ones(len(points))])


def _length(line: Floats) -> Floats:
    """Signed lengths (n,) of the normals of lines (n, 3), which so point down the image, or right if it is steep."""
    down = np.where(np.abs(line[:, 0]) > np.abs(line[:, 1]), line[:, 0], line[:, 1])
    return np.copysign(np.hypot(line[:, 0], line[:, 1]), down)


def distances(rig: Rig, correction: Floats, left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Signed distances (n,) from the epipolar lines of the corrected rig, pixels, and their derivatives (n, 7).

    The derivatives are those by the correction, pixels per radian, and by column and row of the right point, which are
    the unit normals of the lines.

    Parameters
    ----------
    correction : (5,) radians.
    left, right : (n, 2) column and row of corresponding points.
    """
    centre, swings = _centre(rig, correction)
    axes = turn_axes(rig)
    rotation = rotation_exp(axes @ correction[:3]) @ rig.T_right_left.rotation
    # A line of the image with matrix K is K^-T times the normal R (c x ray) of the epipolar plane.
    to_line, to_ray = np.linalg.inv(rig.right.matrix).T, np.linalg.inv(rig.left.matrix)
    # Not at 0: for large corrections, which the fit reaches, turns do not commute.
    turns = left_jacobian(axes @ correction[:3]) @ axes
    upright = rotation @ cross_matrix(centre)
    to_slopes = [to_line @ cross_matrix(turns[:, i]) @ upright @ to_ray for i in range(3)]
    to_slopes += [to_line @ rotation @ cross_matrix(swings[:, i]) @ to_ray for i in range(2)]
    p, q = _homogeneous(left), _homogeneous(right)
    line, *turned = (p @ matrix.T for matrix in (to_line @ upright @ to_ray, *to_slopes))
    length = _length(line)[:, None]
    normal, distance = line[:, :2] / length, (q * line).sum(axis=1) / length[:, 0]
    # Quotient rule: the length of the line's normal changes too.
    slopes = [((q * t).sum(axis=1) - (normal * t[:, :2]).sum(axis=1) * distance) / length[:, 0] for t in turned]
    return distance, np.column_stack([*slopes, normal])


def inverse_depth(rig: Rig, pixels: Floats, disparity: Floats) -> tuple[Floats, Floats]:
    """Inverse depth 1/Z (n,) along the left camera's axis, 1/m, and its change per pixel of disparity (n,).

    With p_r ~ Z m + epipole, m = K_r R r, the offset from the epipole is linear in 1/Z; the part of the disparity
    across the epipolar line does not depend on depth and is left out.
    """
    to_right = rig.right.matrix @ rig.T_right_left.rotation
    epipole = rig.right.matrix @ rig.T_right_left.translation
    m = rig.left.rays(pixels) @ to_right.T
    p = pixels + disparity
    # Direction of the epipolar line at p; homogeneous coordinates allow an epipole at infinity.
    along = p * epipole[2] - epipole[:2]
    offset = p * m[:, 2:] - m[:, :2]
    # At the epipole itself there is no line.
    length2 = np.maximum((along**2).sum(-1), 1e-300)
    rho = -(offset * along).sum(-1) / length2
    # p_r = (m + rho epipole) / (m_z + rho epipole_z) moves by |along| / (m_z + rho epipole_z) a unit of rho.
    return rho, np.abs(m[:, 2] + rho * epipole[2]) / np.sqrt(length2)


def depth_sensitivity(rig: Rig, left: Floats, right: Floats) -> Floats:
    """Matrix ``G`` (5, 5): a correction ``c`` (5,) changes depth by ``sqrt(c^T G c)`` (relative RMS).

    Points are weighted by the precision of their depth, so that near ones decide, as they do in navigation. At a mean
    disparity of 27 px and a focal length of 707 px a yaw of the right camera by 0.01 degrees makes 0.45 %.
    """
    rho, per_pixel = inverse_depth(rig, left, right - left)
    slopes = np.empty((len(left), 5))
    for i in range(5):
        # Central differences over a microradian.
        step = 1e-6 * np.eye(5)[i]
        ahead, _ = inverse_depth(corrected(rig, step), left, right - left)
        behind, _ = inverse_depth(corrected(rig, -step), left, right - left)
        slopes[:, i] = (ahead - behind) / (2 * step[i])
    # In pixels of disparity, whose errors are the same near and far.
    scaled = slopes / per_pixel[:, None]
    weighted = np.einsum("ni,nj->ij", scaled, scaled)
    total = float(np.sum((np.maximum(rho, 0.0) / per_pixel) ** 2))
    return np.asarray(weighted / max(total, 1e-12), dtype=np.float64)


def beyond_infinity(rig: Rig, left: Floats, right: Floats) -> Floats:
    """Distances (n,) of points beyond infinity, pixels of disparity; negative for points in front of the cameras."""
    rho, per_pixel = inverse_depth(rig, left, right - left)
    return np.asarray(-rho / per_pixel, dtype=np.float64)


MAX_IMAGE_TURN_DEG = 45.0
"""Turn of the right image against the rig [degrees] above which the image was turned, not the camera."""


def image_turn(rig: Rig, left: Floats, right: Floats) -> float:
    """Degrees by which the right image is turned in its plane, clockwise in the image, against the rig.

    ``left``, ``right``: (n, 2) matches, column and row. Depth and lens change the angle little.
    """
    seen = [points - np.median(points, axis=0) for points in (left, right)]
    here, there = (points @ (1.0, 1.0j) for points in seen)
    (cosine, _, _), (sine, _, _), _ = rig.T_right_left.rotation
    return float(np.degrees(np.angle((here.conj() * there).sum() * complex(cosine, -sine))))


def _centre(rig: Rig, correction: Floats) -> tuple[Floats, Floats]:
    """Right camera's centre (3,) in the left frame, metres, and its derivatives (3, 2) by the two turns."""
    unit = rig.centre / np.linalg.norm(rig.centre)
    # In the left camera's frame, whose image may show the baseline along another axis than the right one's.
    axis = np.eye(3)[0 if abs(unit[1]) >= math.cos(math.radians(45.0)) else 1]
    across = axis - unit * float(unit @ axis)
    across /= np.linalg.norm(across)
    forward = np.cross(unit, across)
    if forward[2] < 0:
        forward = -forward
    swing = unit + correction[3] * across + correction[4] * forward
    length = float(np.linalg.norm(swing))
    direction = swing / length
    tangent = (np.eye(3) - np.outer(direction, direction)) / length
    return rig.baseline * direction, rig.baseline * tangent @ np.column_stack([across, forward])
