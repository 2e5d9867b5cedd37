"""Projection of points by a pinhole camera, with its derivatives (paper, Eq. 4, 7 and 8).

With ``x = R X + t`` in the camera frame and the left perturbation ``R <- exp(w) R, t <- exp(w) t + v``,
``dx/d(v, w) = [I | -[x]_x]``; the pixel is ``(fx x/z + cx, fy y/z + cy)``.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba.extending import register_jitable

from rille.stages.core.arrays import Floats
from rille.stages.core.kernel import kernel
from rille.stages.geometry.geometry import Camera

NEAREST_M = 1e-6
"""Depth [m] below which a point counts as behind the camera."""


class Pinhole(NamedTuple):
    """Focal lengths and principal point, pixels, for kernels."""

    fx: float
    fy: float
    cx: float
    cy: float

    @staticmethod
    def of(camera: Camera) -> Pinhole:
        """Take the intrinsics of a camera."""
        return Pinhole(float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))


def perturbed(R: Floats, t: Floats, step: Floats) -> tuple[Floats, Floats]:
    """Poses (n, 3, 3), (n, 3) after left perturbations (n, 6) ``v``, ``w``."""
    turn = np.array([cv2.Rodrigues(w)[0] for w in step[:, 3:]])
    return turn @ R, np.einsum("nij,nj->ni", turn, t) + step[:, :3]


@kernel
def rotated(R, v):  # type: ignore[no-untyped-def]
    """``R v`` as three numbers."""
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@register_jitable
def product(m, x, y):  # type: ignore[no-untyped-def]
    """``M (x, y, 1)`` as three numbers: for a homography the homogeneous point that it maps x, y to, with a positive
    third number on this side of the horizon; for a fundamental matrix the line ``a x' + b y' + c = 0`` of x, y."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2],
        m[1, 0] * x + m[1, 1] * y + m[1, 2],
        m[2, 0] * x + m[2, 1] * y + m[2, 2],
    )


@kernel
def linearise(camera, x, along, pixel, j):  # type: ignore[no-untyped-def]
    """Fill ``j`` (2, 8): derivatives of a projection by ``v`` and ``w`` (6), by a shift ``along``; and its error.

    ``x``, ``along``: three numbers each in the camera frame; ``pixel`` (2): the measured point.
    """
    z, w = x[2], along[2]
    u, v = x[0] / z, x[1] / z
    kx, ky = camera.fx / z, camera.fy / z
    j[0, 0], j[0, 1], j[0, 2] = kx, 0.0, -kx * u
    j[1, 0], j[1, 1], j[1, 2] = 0.0, ky, -ky * v
    j[0, 3], j[0, 4], j[0, 5] = -kx * u * x[1], kx * (z + u * x[0]), -kx * x[1]
    j[1, 3], j[1, 4], j[1, 5] = -ky * (z + v * x[1]), ky * v * x[0], ky * x[0]
    j[0, 6], j[1, 6] = kx * (along[0] - u * w), ky * (along[1] - v * w)
    j[0, 7], j[1, 7] = camera.fx * u + camera.cx - pixel[0], camera.fy * v + camera.cy - pixel[1]
