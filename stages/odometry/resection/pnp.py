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
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.geometry.geometry import Camera, RigidTransform, cross_matrix
from rille.stages.geometry.projection import NEAREST, Pinhole, linearise, perturbed, project, rotated, to_camera
from rille.stages.numeric.robust import huber_cost, huber_weight

UNKNOWNS = 7
"""Translation, rotation, and the error that all disparities share."""
HUBER = 2.5
"""Huber's bound in standard deviations: 4 % of Gaussian errors in two dimensions lie beyond it."""


@dataclass(frozen=True)
class Observations:
    """Observed landmarks of a batch of b problems with n landmarks each.

    Attributes
    ----------
    landmarks : (b, n, 3) in the local frame, m.
    per_pixel : (b, n, 3) motion of a landmark for a change of its disparity by a pixel, m/pixel.
    sigma : (b, n) standard deviation of the disparity, pixels.
    pixels : (b, n, 2) observed column and row.
    camera : intrinsics.
    pixel_sigma : standard deviation of ``pixels``, pixels.
    bias_sigma : prior standard deviation of the error that all disparities share, pixels.
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


def bias_information(sigma: float) -> float:
    """Information of a prior on the bias, 1/pixel^2; below a ten thousandth of a pixel the bias is held."""
    # A sigma of 0 asks for no bias: held by a large number, the matrices keep their size.
    return 1.0 / max(sigma, 1e-4) ** 2


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
        """Apply steps (b, 7): ``v``, ``w`` and the step of the bias."""
        return Poses(*perturbed(self.R, self.t, step[:, :6]), self.bias + step[:, 6])


@dataclass(frozen=True)
class Errors:
    """Back-projection errors of n landmarks at b poses, and the parts of their derivatives.

    Attributes
    ----------
    pixels : (b, n, 2) column and row error, computed minus observed, pixels.
    white : (b, n, 2) the same whitened by the covariance S (see the module), dimensionless.
    norm : (b, n) length of ``white``, a Mahalanobis distance; infinite behind the camera.
    x : (b, n, 3) landmarks in the camera frame, m.
    projection : (b, n, 2, 3) derivative of the projected pixel by ``x``, pixels / m.
    per_pixel : (b, n, 2) derivative of the projected pixel by the landmark's disparity, pixels / pixel.
    """

    pixels: Floats
    white: Floats
    norm: Floats
    x: Floats
    projection: Floats
    per_pixel: Floats


def back_projection(obs: Observations, poses: Poses) -> Errors:
    """Eq. 7 and 8 at each pose; observations of a batch of one serve any number of poses."""
    landmarks = obs.landmarks + poses.bias[:, None, None] * obs.per_pixel
    x = np.einsum("bij,bnj->bni", poses.R, landmarks) + poses.t[:, None]
    image, projection, behind = project(obs.camera, x)
    pixels = image - obs.pixels
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
    # S has sigma^2 across g and sigma^2 + |g|^2 along it: its root is the same with roots.
    shrink = 1.0 / sigma - 1.0 / np.sqrt(sigma**2 + length2)
    along = np.einsum("bni,bnik->bnk", unit, a)
    return np.asarray(a / sigma - (shrink[..., None] * unit)[..., None] * along[..., None, :])


def normal_matrix(obs: Observations, errors: Errors, active: Bools) -> tuple[Floats, Floats, Floats]:
    """Weighted normal matrix (b, 7, 7), gradient (b, 7) and weights (b, n) of Huber's cost, without the prior."""
    # An infinite length times a weight of 0 would be NaN.
    usable = active & np.isfinite(errors.norm)
    weight = np.where(usable, huber_weight(np.where(usable, errors.norm, 1.0), HUBER), 0.0)
    jacobian = derivatives(obs, errors)
    weighted = jacobian * weight[..., None, None]
    normal = np.einsum("bnik,bnil->bkl", weighted, jacobian)
    return normal, np.einsum("bnik,bni->bk", weighted, errors.white), weight


def norms(obs: Observations, poses: Poses) -> Floats:
    """Mahalanobis lengths (b, n) of the errors, as :func:`back_projection` has them, and nothing else."""
    out = np.empty((len(poses.t), obs.landmarks.shape[1]))
    _norms(_problems(obs), _pose_arrays(poses), out)
    return out


def levenberg_marquardt(
    obs: Observations, start: Poses, active: Bools, iterations: int, tolerance: float = 1e-10
) -> tuple[Poses, int]:
    """Minimise Eq. 6 (robust, weighted) from ``start`` over the active (b, n) observations; also most iterations done.

    Each problem converges when its step promises to lower its cost by no more than ``tolerance`` of it. The damping is
    Marquardt's (scaled by the diagonal), which also holds a singular problem still instead of letting it fly off.
    """
    poses = _pose_arrays(start)
    done = _minimise(_problems(obs), np.ascontiguousarray(active), iterations, tolerance, poses)
    return Poses(*poses), int(done)


class _Problems(NamedTuple):
    """:class:`Observations` for the compiled loops."""

    landmarks: Any
    per_pixel: Any
    sigma: Any
    pixels: Any
    camera: Any
    pixel_sigma: Any
    prior: Any


class _Pose(NamedTuple):
    """One pose of :class:`Poses` for the compiled loops."""

    R: Any
    t: Any
    bias: Any


def _problems(obs: Observations) -> _Problems:
    arrays = (obs.landmarks, obs.per_pixel, obs.sigma, obs.pixels)
    landmarks, per_pixel, sigma, pixels = (np.ascontiguousarray(a, dtype=np.float64) for a in arrays)
    camera = Pinhole.of(obs.camera)
    return _Problems(
        landmarks, per_pixel, sigma, pixels, camera, float(obs.pixel_sigma), bias_information(obs.bias_sigma)
    )


def _pose_arrays(poses: Poses) -> tuple[Floats, Floats, Floats]:
    """Copies that may be written to."""
    R, t, bias = (np.array(a, dtype=np.float64, order="C") for a in (poses.R, poses.t, poses.bias))
    return R, t, bias


# Compiled loops. One problem's arithmetic does not depend on the others in its batch, and sums run in the order of the
# landmarks, so that results do not depend on how problems are grouped. ``o, n``: problem and landmark.


@njit(cache=True, nogil=True)
def _in_camera(data, o, n, pose):  # type: ignore[no-untyped-def]
    """Camera coordinates of a landmark, and of what it moves by a pixel of disparity; three numbers each."""
    along = data.per_pixel[o, n]
    return to_camera(pose.R, pose.t, data.landmarks[o, n], along, pose.bias), rotated(pose.R, along)


@njit(cache=True, nogil=True)
def _observe(data, o, n, pose, j):  # type: ignore[no-untyped-def]
    """Fill ``j`` (2, 8) with whitened Jacobian (2, 7) and error (2) of a landmark; its length, infinite if behind."""
    x, along = _in_camera(data, o, n, pose)
    if not x[2] >= NEAREST:
        return np.inf
    linearise(data.camera, x, along, data.pixels[o, n], j)
    gu, gv, sigma, sigma_d = j[0, 6], j[1, 6], data.pixel_sigma, data.sigma[o, n]
    length2 = (gu * gu + gv * gv) * sigma_d * sigma_d
    if length2 > 0.0:
        # S^-1/2: along g divide by the longer standard deviation
        size = np.sqrt(gu * gu + gv * gv)
        eu, ev = gu / size, gv / size
        shrink = 1.0 / sigma - 1.0 / np.sqrt(sigma * sigma + length2)
        for k in range(8):
            lost = shrink * (eu * j[0, k] + ev * j[1, k])
            j[0, k], j[1, k] = j[0, k] / sigma - eu * lost, j[1, k] / sigma - ev * lost
    else:
        for k in range(8):
            j[0, k], j[1, k] = j[0, k] / sigma, j[1, k] / sigma
    return np.sqrt(j[0, 7] ** 2 + j[1, 7] ** 2)


@njit(cache=True, nogil=True)
def _square(data, o, n, pose):  # type: ignore[no-untyped-def]
    """Squared length of a landmark's whitened error, infinite if behind: ``e^T (sigma^2 I + g g^T)^-1 e``.

    By Sherman and Morrison, without the derivatives: samples of the robust start need lengths alone.
    """
    (x, y, z), (wx, wy, wz) = _in_camera(data, o, n, pose)
    if not z >= NEAREST:
        return np.inf
    fx, fy, cx, cy = data.camera
    sigma, sigma_d, pixel = data.pixel_sigma, data.sigma[o, n], data.pixels[o, n]
    u, v = x / z, y / z
    gu, gv = sigma_d * fx / z * (wx - u * wz), sigma_d * fy / z * (wy - v * wz)
    eu, ev = fx * u + cx - pixel[0], fy * v + cy - pixel[1]
    mixed = gu * eu + gv * ev
    square = eu * eu + ev * ev - mixed * mixed / (sigma * sigma + gu * gu + gv * gv)
    # Just before the camera both terms are huge, and rounding may leave a negative difference, without a root.
    return max(square, 0.0) / (sigma * sigma)


@njit(cache=True, nogil=True)
def _norms(data, poses, out):  # type: ignore[no-untyped-def]
    """Weighted error lengths ``out`` (b, n) at poses (b); observations of one problem serve all, or of each its own."""
    R, t, bias = poses
    for b in range(len(out)):
        # One set of observations may serve many poses, as hypotheses do.
        o = b if len(data.landmarks) > 1 else 0
        pose = _Pose(R[b], t[b], bias[b])
        for n in range(out.shape[1]):
            out[b, n] = np.sqrt(_square(data, o, n, pose))


@njit(cache=True, nogil=True)
def _cost(data, o, active, pose):  # type: ignore[no-untyped-def]
    """Huber's cost of the active landmarks and of the prior; infinite if one is behind the camera."""
    total = 0.5 * data.prior * pose.bias * pose.bias
    for n in range(len(active)):
        if active[n]:
            total += huber_cost(np.sqrt(_square(data, o, n, pose)), HUBER)
    return total


@njit(cache=True, nogil=True)
def _normal(data, o, active, pose, j, out):  # type: ignore[no-untyped-def]
    """Fill ``out``: weighted normal matrix (7, 7) and gradient (7), with the prior of the bias."""
    normal, gradient = out
    normal[:] = 0.0
    gradient[:] = 0.0
    for n in range(len(active)):
        if not active[n]:
            continue
        r = _observe(data, o, n, pose, j)
        # Behind the camera, as at a poor start: its cost is infinite, but it must not spoil the step.
        if r == np.inf:
            continue
        w = huber_weight(r, HUBER)
        for i in range(UNKNOWNS):
            a, b = w * j[0, i], w * j[1, i]
            for k in range(i, UNKNOWNS):
                normal[i, k] += a * j[0, k] + b * j[1, k]
            gradient[i] += a * j[0, 7] + b * j[1, 7]
    for i in range(UNKNOWNS):
        for k in range(i):
            normal[i, k] = normal[k, i]
    # After the mirroring: the prior concerns the bias alone.
    normal[6, 6] += data.prior
    gradient[6] += data.prior * pose.bias


@njit(cache=True, nogil=True)
def _step(normal, gradient, damping, lower, step):  # type: ignore[no-untyped-def]
    """Damped step by Cholesky's factors; False where the matrix is not positive."""
    most = 0.0
    for i in range(UNKNOWNS):
        most = max(most, normal[i, i])
    # Damping scales with the diagonal, which is 0 for an unknown that no landmark determines.
    floor = 1e-12 * most + 1e-300
    for i in range(UNKNOWNS):
        for k in range(i + 1):
            total = normal[i, k]
            if i == k:
                total += damping * normal[i, i] + floor
            for m in range(k):
                total -= lower[i, m] * lower[k, m]
            if i == k:
                if not total > 0.0:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, k] = total / lower[k, k]
    for i in range(UNKNOWNS):
        total = -gradient[i]
        for m in range(i):
            total -= lower[i, m] * step[m]
        step[i] = total / lower[i, i]
    for i in range(UNKNOWNS - 1, -1, -1):
        total = step[i]
        for m in range(i + 1, UNKNOWNS):
            total -= lower[m, i] * step[m]
        step[i] = total / lower[i, i]
    return True


@njit(cache=True, nogil=True)
def _moved(R, t, step, out_R, out_t):  # type: ignore[no-untyped-def]
    """Pose after a left perturbation: ``R <- exp(w) R, t <- exp(w) t + v``."""
    x, y, z = step[3], step[4], step[5]
    angle2 = x * x + y * y + z * z
    angle = np.sqrt(angle2)
    # The limits of sin(x) / x and (1 - cos(x)) / x^2, where both would be 0 / 0.
    a, b = (1.0, 0.5) if angle < 1e-9 else (np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2)
    turn = np.empty((3, 3))
    turn[0, 0], turn[0, 1], turn[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    turn[1, 0], turn[1, 1], turn[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    turn[2, 0], turn[2, 1], turn[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for i in range(3):
        for k in range(3):
            out_R[i, k] = turn[i, 0] * R[0, k] + turn[i, 1] * R[1, k] + turn[i, 2] * R[2, k]
        out_t[i] = turn[i, 0] * t[0] + turn[i, 1] * t[1] + turn[i, 2] * t[2] + step[i]


@njit(cache=True, nogil=True)
def _minimise(data, active, iterations, tolerance, poses):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt of each problem, ``poses`` (b) in place; the greatest number of iterations that one took."""
    R, t, bias = poses
    j, normal = np.empty((2, UNKNOWNS + 1)), np.empty((UNKNOWNS, UNKNOWNS))
    lower, gradient, step = np.zeros((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    new_R, new_t = np.empty((3, 3)), np.empty(3)
    most = 0
    for b in range(len(R)):
        o = b if len(data.landmarks) > 1 else 0
        damping = 1e-4
        cost = _cost(data, o, active[b], _Pose(R[b], t[b], bias[b]))
        for done in range(iterations):
            most = max(most, done + 1)
            _normal(data, o, active[b], _Pose(R[b], t[b], bias[b]), j, (normal, gradient))
            if not _step(normal, gradient, damping, lower, step):
                # Not positive: enough damping makes any such matrix so.
                damping *= 10.0
                continue
            _moved(R[b], t[b], step, new_R, new_t)
            new_bias = bias[b] + step[6]
            new_cost = _cost(data, o, active[b], _Pose(new_R, new_t, new_bias))
            # Decrease by the quadratic model, g^T H^-1 g / 2, taken before the step may be refused.
            promised = 0.0
            for k in range(UNKNOWNS):
                promised -= 0.5 * gradient[k] * step[k]
            # Also of a refused step: where less than this is to be gained, a smaller one gains nothing either.
            finished = promised <= tolerance * (cost if cost < np.inf else 0.0) + 1e-20
            if new_cost < cost:
                # Entry by entry: numba compiles the words of an error of shapes for each assignment of an array.
                for i in range(3):
                    t[b, i] = new_t[i]
                    for k in range(3):
                        R[b, i, k] = new_R[i, k]
                bias[b] = new_bias
                cost = new_cost
                damping = max(damping * 0.1, 1e-12)
            else:
                damping *= 10.0
            if finished:
                break
    return most
