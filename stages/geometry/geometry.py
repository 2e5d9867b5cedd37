"""Cameras, rigid transforms and the paper's rotation angles.

Conventions of the whole project:

* pixel centres are at integer coordinates; ``(column, row) = (0, 0)`` is the centre of the top left pixel;
* ``T_dst_src`` maps coordinates: ``x_dst = R x_src + t``;
* camera frames are optical: x right, y down, z forward; world and local frames: x right, y forward, z up;
* lengths are metres and angles radians unless a name says otherwise.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2, Eq. 4 (projection) and Eq. 5 (rotation).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.errors import InputError

Sizes = tuple[tuple[int, int], tuple[int, int]]
"""Width and height of the left and of the right images, pixels; they may differ."""


@dataclass(frozen=True)
class Camera:
    """Ideal pinhole camera (distortion already removed).

    ``fx, fy`` focal lengths and ``cx, cy`` principal point in pixels; ``width, height`` in pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (self.fx > 0 and self.fy > 0 and math.isfinite(self.fx) and math.isfinite(self.fy)):
            raise InputError(
                "RIL-329",
                f"focal length fx={self.fx}, fy={self.fy} px is not positive",
                remedy="give fx and fy in pixels",
            )
        if self.width < 1 or self.height < 1:
            raise InputError(
                "RIL-330", f"image size {self.width} x {self.height} is empty", remedy="check the image size"
            )

    @property
    def matrix(self) -> Floats:
        """3 x 3 calibration matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> Floats:
        """Project points (..., 3) of the camera frame, metres, to (..., 2) column, row; NaN behind the camera."""
        p = np.asarray(points, dtype=np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        return np.stack([self.fx * p[..., 0] / z + self.cx, self.fy * p[..., 1] / z + self.cy], axis=-1)

    def holds(self, pixels: Floats) -> Bools:
        """Which pixels (..., 2) lie within the outermost pixel centres."""
        return np.asarray(((pixels >= 0) & (pixels <= [self.width - 1, self.height - 1])).all(axis=-1))

    def rays(self, pixels: ArrayLike) -> Floats:
        """Directions (..., 3) with z = 1 in the camera frame, of pixels (..., 2) column, row."""
        p = np.asarray(pixels, dtype=np.float64)
        x = (p[..., 0] - self.cx) / self.fx
        y = (p[..., 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> Camera:
        """Inverse of :meth:`to_dict`."""
        return Camera(**d)


@dataclass(frozen=True)
class RigidTransform:
    """``x_dst = rotation @ x_src + translation``; names of variables state the frames (``T_dst_src``)."""

    rotation: Floats
    translation: Floats

    def __post_init__(self) -> None:
        r = np.array(self.rotation, dtype=np.float64)
        t = np.array(self.translation, dtype=np.float64).reshape(-1)
        if r.shape != (3, 3) or t.shape != (3,):
            raise InputError("RIL-331", f"a rigid transform needs 3 x 3 and 3 numbers, not {r.shape} and {t.shape}")
        if not (np.isfinite(r).all() and np.isfinite(t).all()):
            raise InputError("RIL-332", "a rigid transform has a value that is not finite")
        # Large entries first, because their product would overflow; 1e-4: for poses written with five digits.
        if np.abs(r).max() > 2 or np.abs(r @ r.T - np.eye(3)).max() > 1e-4 or np.linalg.det(r) < 0:
            raise InputError(
                "RIL-333",
                "a pose's 3 x 3 part is not a rotation",
                remedy="give rows of [R | t] with R orthonormal and det R = +1",
            )
        # Read-only, since several transforms may share one array.
        r.setflags(write=False)
        t.setflags(write=False)
        object.__setattr__(self, "rotation", r)
        object.__setattr__(self, "translation", t)

    def apply(self, points: ArrayLike) -> Floats:
        """Map points (..., 3) of the source frame to the destination frame."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> RigidTransform:
        """The transform from destination to source."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    @property
    def matrix34(self) -> Floats:
        """3 x 4 matrix [R | t]."""
        return np.hstack([self.rotation, self.translation[:, None]])

    @staticmethod
    def identity() -> RigidTransform:
        """The neutral transform."""
        return RigidTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(m: ArrayLike) -> RigidTransform:
        """Build from 12 numbers [R | t] row by row, or a 3 x 4 or 4 x 4 matrix."""
        a = np.asarray(m, dtype=np.float64)
        a = a.reshape(3, 4) if a.size == 12 else a.reshape(4, 4)[:3]
        return RigidTransform(a[:, :3], a[:, 3])

    def to_list(self) -> list[float]:
        """Twelve numbers, rows of [R | t]."""
        return [float(v) for v in self.matrix34.reshape(-1)]


@dataclass(frozen=True)
class Rig:
    """Two pinhole cameras on one body; ``T_right_left`` maps the left camera frame to the right one, metres."""

    left: Camera
    right: Camera
    T_right_left: RigidTransform

    @property
    def baseline(self) -> float:
        """Distance of the two projection centres, metres."""
        return float(np.linalg.norm(self.T_right_left.translation))

    @property
    def centre(self) -> Floats:
        """Projection centre (3,) of the right camera in the left camera's frame, metres."""
        return np.asarray(-self.T_right_left.rotation.T @ self.T_right_left.translation)

    def check(self, shape: tuple[int, ...] | None = None) -> None:
        """Refuse a rig without a baseline, and a disparity (rows, cols) of another size than the left image's."""
        if not self.baseline > 0:
            remedy = "give T_right_left with a translation in metres"
            raise InputError("RIL-377", "the rig's baseline is 0 m", remedy=remedy)
        expected = self.left.height, self.left.width
        if shape not in (None, expected):
            remedy = "give the camera's width and height as the images have them"
            raise InputError("RIL-376", f"the disparity is {shape}, the left camera's image {expected}", remedy=remedy)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "left": self.left.to_dict(),
            "right": self.right.to_dict(),
            "T_right_left": self.T_right_left.to_list(),
        }

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> Rig:
        """Inverse of :meth:`to_dict`."""
        return Rig(
            Camera.from_dict(d["left"]),
            Camera.from_dict(d["right"]),
            RigidTransform.from_matrix(d["T_right_left"]),
        )


def heading_of(T: RigidTransform) -> float:
    """Angle (rad, to the left of y) of the y axis of a frame, seen from above."""
    return math.atan2(-T.rotation[0, 1], T.rotation[1, 1])


def from_above(T: RigidTransform) -> tuple[float, float, float]:
    """Position x, y (m) and heading (rad, see :func:`heading_of`) of a frame."""
    return float(T.translation[0]), float(T.translation[1]), heading_of(T)


def way_length(points: Floats) -> float:
    """Length (m) of a line through points (n, at least 2), m, seen from above."""
    return float(np.hypot(*np.diff(points[:, :2], axis=0).T).sum())


def cross_matrix(v: Floats) -> Floats:
    """[v]x (..., 3, 3) of vectors (..., 3): ``[v]x u = v x u``."""
    z = np.zeros(v.shape[:-1])
    x, y, w = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([z, -w, y], -1), np.stack([w, z, -x], -1), np.stack([-y, x, z], -1)], -2)


def rotation_exp(w: ArrayLike) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    v = np.asarray(w, dtype=np.float64)
    angle = np.sqrt((v * v).sum(-1))
    # The limits at an angle of 0, without dividing by it.
    safe = np.where(angle < 1e-9, 1.0, angle)
    a = np.where(angle < 1e-9, 1.0, np.sin(safe) / safe)[..., None, None]
    b = np.where(angle < 1e-9, 0.5, (1.0 - np.cos(safe)) / safe**2)[..., None, None]
    k = cross_matrix(v)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def rotation_log(R: Floats) -> Floats:
    """Rotation vectors (..., 3), radians, of rotations (..., 3, 3) below half a turn: inverse of :func:`rotation_exp`.

    The angle is ``atan2(sine, cosine)``, exact near zero, unlike the arc cosine of the trace.
    """
    axis = 0.5 * np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0))
    return np.asarray(axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 1.0)[..., None])


def left_jacobian(w: Floats) -> Floats:
    """Left Jacobian (3, 3) of SO(3): ``exp(w + dw) = exp(J dw) exp(w)`` to first order, ``w`` (3,) radians."""
    angle, k = float(np.linalg.norm(w)), cross_matrix(w)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * k, dtype=np.float64)
    a, b = (1.0 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * k + b * (k @ k), dtype=np.float64)


def orthonormal(matrix: ArrayLike) -> Floats:
    """The nearest rotation to a 3 x 3 matrix (polar decomposition)."""
    # The determinant excludes a reflection.
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)


def level_rotation(up_in_camera: ArrayLike) -> Floats:
    """Rotation R_level_cam of the levelled frame: z up, y ahead, x right.

    Ahead is the horizontal projection of the optical axis. For a camera within 10 degrees of straight down, whose axis
    has no stable heading, it is that of the direction to the image's upper edge (straight up: the lower edge). From 10
    to 30 degrees the two are blended, so that the heading does not jump.

    Parameters
    ----------
    up_in_camera : (3,) direction of "up" in the optical camera frame.
    """
    z = np.asarray(up_in_camera, dtype=np.float64)
    z = z / np.linalg.norm(z)
    # Length of the axis' horizontal projection; the vector to the edge is as long, so that the blending is even.
    aside = float(np.hypot(z[0], z[1]))
    axis = float(np.interp(math.degrees(math.asin(min(aside, 1.0))), (10.0, 30.0), (0.0, 1.0)))
    forward = np.array([0.0, math.copysign((1.0 - axis) * max(aside, 0.1), z[2]), axis])
    y = forward - z * float(z @ forward)
    y = y / float(np.linalg.norm(y))
    return np.array([np.cross(y, z), y, z], dtype=np.float64)
