"""Back-projection errors of landmarks and their least-squares minimum over the six extrinsics.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2, Eq. 4 (projection), Eq. 6 (the sum that is minimised),
Eq. 7 and 8 (column and row error). ``t`` in Eq. 4 is the *translation*: ``x_cam = R X + t``; the camera's position is
``-R^T t``.

Everything here is batched over independent problems (leading axis ``b``), so that the many small problems of the robust
start and the one large problem of the final adjustment share one solver. A step is a left perturbation
``R <- exp(w) R, t <- exp(w) t + v`` with ``xi = (v, w)``, hence ``d x_cam / d xi = [I | -[x_cam]x]``.

Landmarks are not exact: a stereo landmark is uncertain along its ray. Its own error is carried into the image
(``S = sigma^2 I + g g^T`` with ``g = d(u, v)/dX s``, ``s`` one standard deviation along the ray), which to first order
is the same as estimating the landmark along with the pose. An error that all disparities *share* does not average out
(0.1 pixel is what a good calibration leaves in the toe-in of two cameras; it stretches a path by 0.4 % at 25 pixels of
disparity); it is a seventh unknown, ``bias``, with a prior: where the motion shows it, it is corrected, and where not,
the covariance contains it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.geometry.geometry import Camera, RigidTransform
from rille.stages.odometry.resection import pnp_kernel as kernel

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

NEAREST = 1e-6
"""Depth, metres, below which a landmark counts as behind the camera."""
HUBER = 2.5
"""Huber's bound in standard deviations: 4 % of Gaussian errors in two dimensions lie beyond it."""


@dataclass(frozen=True)
class Observations:
    """Where landmarks were seen, in a batch of problems.

    ``landmarks`` (b, n, 3) m; ``per_pixel`` (b, n, 3) m/pixel, how they move with their disparity; ``sigma`` (b, n)
    pixels, of the disparity; ``pixels`` (b, n, 2) column, row; ``pixel_sigma`` of those; ``bias_sigma`` pixels, prior
    of the error that all disparities share.
    """

    landmarks: Floats
    per_pixel: Floats
    sigma: Floats
    pixels: Floats
    camera: Camera
    pixel_sigma: float
    bias_sigma: float

    def take(self, batch: NDArray[np.intp]) -> Observations:
        """Problems of ``k`` observations each, chosen by an index array (b, k), out of a batch of one."""
        return replace(
            self,
            landmarks=self.landmarks[0][batch],
            per_pixel=self.per_pixel[0][batch],
            sigma=self.sigma[0][batch],
            pixels=self.pixels[0][batch],
        )

    @property
    def prior(self) -> float:
        """Information of the bias; below a ten thousandth of a pixel it is held."""
        return 1.0 / max(self.bias_sigma, 1e-4) ** 2


@dataclass(frozen=True)
class Poses:
    """A batch of T_cam_local: rotation (b, 3, 3) and translation (b, 3) m; and the bias (b,) of disparities, pixels."""

    R: Floats
    t: Floats
    bias: Floats

    @staticmethod
    def of(T_cam_local: RigidTransform) -> Poses:
        """The batch of one pose without bias."""
        return Poses(T_cam_local.rotation[None], T_cam_local.translation[None], np.zeros(1))

    def at(self, i: int) -> Poses:
        """The batch of one that holds pose ``i``."""
        return Poses(self.R[i : i + 1], self.t[i : i + 1], self.bias[i : i + 1])

    def moved(self, step: Floats) -> Poses:
        """After steps (b, 7): ``v``, ``w``, and that of the bias."""
        turn = exponential(step[:, 3:6])
        t = np.einsum("bij,bj->bi", turn, self.t) + step[:, :3]
        return Poses(turn @ self.R, t, self.bias + step[:, 6])


@dataclass(frozen=True)
class Errors:
    """Back-projection errors at poses.

    ``pixels`` (b, n, 2) raw, ``white`` (b, n, 2) whitened, ``norm`` (b, n) their Mahalanobis length (infinite behind
    the camera), and what the derivatives need: camera coordinates ``x`` (b, n, 3), ``projection`` (b, n, 2, 3)
    derivative of the image by them, ``per_pixel`` (b, n, 2) that by the landmark's disparity.
    """

    pixels: Floats
    white: Floats
    norm: Floats
    x: Floats
    projection: Floats
    per_pixel: Floats


def exponential(w: Floats) -> Floats:
    """Rotation matrices (b, 3, 3) of rotation vectors (b, 3), radians (Rodrigues)."""
    angle = np.sqrt((w * w).sum(-1))
    safe = np.where(angle < 1e-9, 1.0, angle)
    a = np.where(angle < 1e-9, 1.0, np.sin(safe) / safe)[:, None, None]
    b = np.where(angle < 1e-9, 0.5, (1.0 - np.cos(safe)) / safe**2)[:, None, None]
    k = cross_matrix(w)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def cross_matrix(v: Floats) -> Floats:
    """[v]x (..., 3, 3) of vectors (..., 3)."""
    z = np.zeros(v.shape[:-1])
    x, y, w = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([z, -w, y], -1), np.stack([w, z, -x], -1), np.stack([-y, x, z], -1)], -2)


def back_projection(obs: Observations, poses: Poses) -> Errors:
    """Eq. 7 and 8 at each pose; observations of a batch of one serve any number of poses."""
    camera = obs.camera
    landmarks = obs.landmarks + poses.bias[:, None, None] * obs.per_pixel
    x = np.einsum("bij,bnj->bni", poses.R, landmarks) + poses.t[:, None]
    behind = x[..., 2] < NEAREST
    z = np.where(behind, 1.0, x[..., 2])
    u, v = x[..., 0] / z, x[..., 1] / z
    pixels = np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], -1) - obs.pixels
    projection = np.zeros((*z.shape, 2, 3))
    projection[..., 0, 0], projection[..., 0, 2] = camera.fx / z, -camera.fx * u / z
    projection[..., 1, 1], projection[..., 1, 2] = camera.fy / z, -camera.fy * v / z
    turned = np.einsum("bij,bnj->bni", poses.R, np.broadcast_to(obs.per_pixel, x.shape))
    per_pixel = np.einsum("bnij,bnj->bni", projection, turned)
    white = _whiten(pixels[..., None], per_pixel * obs.sigma[..., None], obs.pixel_sigma)[..., 0]
    norm = np.where(behind, np.inf, np.sqrt((white * white).sum(-1)))
    return Errors(pixels, white, norm, x, projection, per_pixel)


def derivatives(obs: Observations, errors: Errors) -> Floats:
    """Whitened Jacobian (b, n, 2, 7) of the errors by ``xi`` and the bias."""
    turn = np.einsum("bnij,bnjk->bnik", errors.projection, -cross_matrix(errors.x))
    jacobian = np.concatenate([errors.projection, turn, errors.per_pixel[..., None]], -1)
    return _whiten(jacobian, errors.per_pixel * obs.sigma[..., None], obs.pixel_sigma)


def _whiten(a: Floats, g: Floats, sigma: float) -> Floats:
    """``S^-1/2 a`` of (b, n, 2, k) with ``S = sigma^2 I + g g^T``: along g divide by the longer standard deviation."""
    length2 = (g * g).sum(-1)
    unit = g / np.sqrt(np.where(length2 > 0, length2, 1.0))[..., None]
    shrink = 1.0 / sigma - 1.0 / np.sqrt(sigma**2 + length2)
    along = np.einsum("bni,bnik->bnk", unit, a)
    return np.asarray(a / sigma - (shrink[..., None] * unit)[..., None] * along[..., None, :])


def normal_matrix(obs: Observations, errors: Errors, active: Bools) -> tuple[Floats, Floats, Floats]:
    """Weighted normal matrix (b, 7, 7), gradient (b, 7) and weights (b, n) of Huber's cost, without the prior."""
    usable = active & np.isfinite(errors.norm)
    weight = np.where(usable, HUBER / np.maximum(np.where(usable, errors.norm, 1.0), HUBER), 0.0)
    jacobian = derivatives(obs, errors)
    weighted = jacobian * weight[..., None, None]
    normal = np.einsum("bnik,bnil->bkl", weighted, jacobian)
    return normal, np.einsum("bnik,bni->bk", weighted, errors.white), weight


def norms(obs: Observations, poses: Poses) -> Floats:
    """Mahalanobis lengths (b, n) of the errors, as :func:`back_projection` has them, and nothing else."""
    out = np.empty((len(poses.t), obs.landmarks.shape[1]))
    kernel.norms(*_data(obs), *_pose_arrays(poses), out)
    return out


def levenberg_marquardt(
    obs: Observations, start: Poses, active: Bools, iterations: int, tolerance: float = 1e-10
) -> tuple[Poses, int]:
    """Minimise Eq. 6 (robust, weighted) from ``start`` over the active (b, n) observations; also most iterations done.

    Each problem converges when its step promises to lower its cost by no more than ``tolerance`` of it. The damping is
    Marquardt's (scaled by the diagonal), which also holds a singular problem still instead of letting it fly off.
    """
    poses = _pose_arrays(start)
    done = kernel.minimise(*_data(obs), HUBER, obs.prior, np.ascontiguousarray(active), iterations, tolerance, *poses)
    return Poses(*poses), int(done)


def _data(obs: Observations) -> tuple[Any, ...]:
    """What the compiled loops want of observations."""
    camera = obs.camera
    arrays = (obs.landmarks, obs.per_pixel, obs.sigma, obs.pixels)
    return (
        *(np.ascontiguousarray(a, dtype=np.float64) for a in arrays),
        (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)),
        float(obs.pixel_sigma),
        NEAREST,
    )


def _pose_arrays(poses: Poses) -> tuple[Floats, Floats, Floats]:
    """Copies that may be written to."""
    R, t, bias = (np.array(a, dtype=np.float64, order="C") for a in (poses.R, poses.t, poses.bias))
    return R, t, bias
