"""Pose of one frame: back-projection errors of landmarks and their least-squares minimum over the six extrinsics.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2, Eq. 4 (projection), Eq. 6 (the sum that is minimised),
Eq. 7 and 8 (column and row error). ``t`` in Eq. 4 is the *translation*: ``x_cam = R X + t``; the camera's position is
``-R^T t``. A step is a left perturbation (:mod:`rille.stages.geometry.projection`).

Landmarks are not exact: a stereo landmark is uncertain along its ray. Its own error is carried into the image
(``S = sigma^2 I + g g^T`` with ``g = d(u, v)/dX s``, ``s`` one standard deviation along the ray), which to first order
is the same as estimating the landmark along with the pose. An error that all disparities *share* does not average out
(0.1 pixel is what a good calibration leaves in the toe-in of two cameras; it stretches a path by 0.4 % at 25 pixels of
disparity); it is a seventh unknown, ``bias``, with a prior: where the motion shows it, it is corrected, and where not,
the covariance contains it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.kernel import kernel
from rille.stages.geometry.geometry import Camera, RigidTransform
from rille.stages.geometry.projection import NEAREST_M, Pinhole, linearise, perturbed, rotated
from rille.stages.numeric.robust import huber_weight
from rille.stages.odometry.resection.landmarks import Landmarks

HUBER = 2.5
"""Huber's bound in standard deviations: 4 % of Gaussian errors in two dimensions lie beyond it."""


class Observations(NamedTuple):
    """Landmarks as a camera observes them.

    ``pixels`` (n, 2) column and row; ``pixel_sigma`` their standard deviation, pixels.
    """

    landmarks: Landmarks
    pixels: Floats
    camera: Camera
    pixel_sigma: float


class _Seen(NamedTuple):
    """The same for the kernel, landmarks moved by the bias."""

    position: Floats
    per_pixel: Floats
    sigma: Floats
    pixels: Floats
    camera: Pinhole
    pixel_sigma: float


class Pose(NamedTuple):
    """T_cam_local: rotation (3, 3) and translation (3,) m; and the bias of disparities, pixels: of all, or (n,)."""

    R: Floats
    t: Floats
    bias: Floats | float = 0.0

    @staticmethod
    def of(T_cam_local: RigidTransform) -> Pose:
        """The pose without a bias."""
        return Pose(T_cam_local.rotation, T_cam_local.translation)


class Errors(NamedTuple):
    """Back-projection errors of n landmarks.

    ``jacobian`` (n, 2, 7) by pose and bias, and ``error`` (n, 2), computed minus observed, both whitened by the
    covariance S (see the module); ``norm`` (n,) length of the whitened error, a Mahalanobis distance; ``pixels`` (n,)
    its length in pixels; ``stretch`` (n,) of the error ellipse by the landmark's own error. All three are infinite
    behind the camera, and where a point was not seen.
    """

    jacobian: Floats
    error: Floats
    norm: Floats
    pixels: Floats
    stretch: Floats


def back_projection(obs: Observations, pose: Pose) -> Errors:
    """Eq. 7 and 8 at a pose, linearised."""
    whitened, lengths = np.zeros((len(obs.pixels), 2, 8)), np.empty((len(obs.pixels), 3))
    at = obs.landmarks.moved(pose.bias)
    position, per_pixel, sigma, pixels = (
        np.ascontiguousarray(a, np.float64) for a in (at.position, at.per_pixel, at.sigma, obs.pixels)
    )
    seen = _Seen(position, per_pixel, sigma, pixels, Pinhole.of(obs.camera), obs.pixel_sigma)
    _linearised(seen, pose.R, pose.t, whitened, lengths)
    return Errors(whitened[..., :7], whitened[..., 7], *lengths.T)


@kernel
def _linearised(seen, R, t, whitened, lengths):  # type: ignore[no-untyped-def]
    """Fill ``whitened`` (n, 2, 8): Jacobian and error; ``lengths`` (n, 3): whitened, in pixels, stretch."""
    sigma = seen.pixel_sigma
    for n in range(len(lengths)):
        x, y, z = rotated(R, seen.position[n])
        x, y, z = x + t[0], y + t[1], z + t[2]
        # Also where a coordinate is NaN: not seen, or no landmark.
        if not (z >= NEAREST_M and abs(seen.pixels[n, 0] + seen.pixels[n, 1]) < np.inf):
            lengths[n] = np.inf
            continue
        j = whitened[n]
        linearise(seen.camera, (x, y, z), rotated(R, seen.per_pixel[n]), seen.pixels[n], j)
        lengths[n, 1] = np.hypot(j[0, 7], j[1, 7])
        # S^-1/2: along g divide by the longer standard deviation.
        size = np.hypot(j[0, 6], j[1, 6])
        eu, ev = (j[0, 6] / size, j[1, 6] / size) if size > 0.0 else (1.0, 0.0)
        longer = np.hypot(sigma, size * seen.sigma[n])
        for k in range(8):
            excess = (1.0 / sigma - 1.0 / longer) * (eu * j[0, k] + ev * j[1, k])
            j[0, k], j[1, k] = j[0, k] / sigma - eu * excess, j[1, k] / sigma - ev * excess
        lengths[n, 0], lengths[n, 2] = np.hypot(j[0, 7], j[1, 7]), longer / sigma


class Normal(NamedTuple):
    """Weighted normal matrix (7, 7), gradient (7,), weights (n,), 0 of what is not active, and the cost they are of."""

    matrix: Floats
    gradient: Floats
    weight: Floats
    cost: float


def huber_weights(norm: Floats, active: Bools) -> Floats:
    """Huber's weights of whitened errors of this length: 0 of those behind the camera, or not active."""
    usable = np.isfinite(norm) & active
    return np.where(usable, huber_weight(np.where(usable, norm, 1.0), HUBER), 0.0)


def huber_costs(norm: Floats) -> float:
    """Sum of Huber's costs: a parabola, beyond the bound its tangent."""
    within = np.minimum(norm, HUBER)
    return float((within * (norm - 0.5 * within)).sum())


def bias_information(sigma: float) -> float:
    """Information of a prior on the bias, 1/pixel^2; below a ten thousandth of a pixel the bias is held."""
    # A sigma of 0 asks for no bias: held by a large number, the matrices keep their size.
    return 1.0 / max(sigma, 1e-4) ** 2


@dataclass(frozen=True)
class PoseAdjustment:
    """Eq. 6, robust and weighted, over the active (n,) landmarks: a problem of least squares."""

    obs: Observations
    active: Bools
    bias_sigma: float

    def normal(self, pose: Pose) -> Normal:
        """Normal equations with the prior of the bias; the cost is infinite where a landmark is behind the camera."""
        errors, prior, bias = back_projection(self.obs, pose), bias_information(self.bias_sigma), float(pose.bias)
        weight = huber_weights(errors.norm, self.active)
        jacobian = errors.jacobian.reshape(-1, 7)
        weighted = (jacobian * np.repeat(weight, 2)[:, None]).T
        matrix, gradient = weighted @ jacobian, weighted @ errors.error.ravel()
        matrix[6, 6] += prior
        gradient[6] += prior * bias
        return Normal(matrix, gradient, weight, huber_costs(errors.norm[self.active]) + 0.5 * prior * bias**2)

    def ahead(self, pose: Pose, normal: Normal, damping: float) -> Pose:
        """The pose after one damped step."""
        diagonal = np.diag(normal.matrix)
        # Damping scales with the diagonal, which is 0 for an unknown that no landmark determines.
        damped = normal.matrix + np.diag(damping * diagonal + 1e-12 * diagonal.max() + 1e-300)
        step = np.asarray(np.linalg.solve(damped, -normal.gradient), dtype=np.float64)
        R, t = perturbed(pose.R[None], pose.t[None], step[None, :6])
        return Pose(R[0], t[0], float(pose.bias) + float(step[6]))


class PoseCovariance(NamedTuple):
    """Errors (p,) of poses by the measurements, a covariance (p, p); by one standard deviation of the bias (p,)."""

    noise: Floats
    by_bias: Floats
    condition: float


class PoseCovariances(NamedTuple):
    """Errors of poses by the errors found, ``measured``, and by the larger of those and the stated ones, ``stated``."""

    measured: PoseCovariance
    stated: PoseCovariance

    @staticmethod
    def of(normal: Floats, bias_sigma: float, factor: float) -> PoseCovariances:
        """By the normal matrix (p + 1, p + 1), the prior of the bias in it, and the variance of the errors found over
        the stated one."""
        prior, matrix = bias_information(bias_sigma), normal.copy()
        matrix[-1, -1] -= prior  # which stays as it is, however large the errors are
        return PoseCovariances(*(pose_covariance(matrix / by, prior) for by in (factor, max(factor, 1.0))))


def pose_covariance(normal: Floats, prior: float) -> PoseCovariance:
    """Invert the normal matrix (p + 1, p + 1) of poses and bias, to which the prior of the bias is added.

    Both parts together are the covariance of the adjustment; ``condition`` is that of its matrix with unit diagonal.
    """
    full = normal.copy()
    full[-1, -1] += prior
    # Metres and radians differ by orders of magnitude: with unit diagonal the least eigenvalue means something.
    scale = np.sqrt(np.maximum(np.diag(full), 1e-300))
    values, vectors = np.linalg.eigh(full / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T / np.outer(scale, scale)
    by_bias = math.sqrt(prior) * inverse[:-1, -1]
    noise = inverse[:-1, :-1] - np.outer(by_bias, by_bias)
    return PoseCovariance(noise, by_bias, float(values[-1] / max(values[0], 1e-300)))
