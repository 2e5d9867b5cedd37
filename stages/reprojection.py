"""Back-projection errors of landmarks and their least-squares minimum over the six extrinsics.

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2, Eq. 4 (projection), Eq. 6 (the sum that is minimised),
Eq. 7 and 8 (column and row error). ``t`` in Eq. 4 is the *translation*: ``x_cam = R X + t``; the camera's position is
``-R^T t``.

Everything here is batched over independent problems (leading axis ``b``), so that the many small problems of the robust
start and the one large problem of the final adjustment share one solver. A step is a left perturbation
``R <- exp(w) R, t <- exp(w) t + v`` with ``xi = (v, w)``, hence ``d x_cam / d xi = [I | -[x_cam]x]``.

Landmarks are not exact: a stereo landmark is uncertain along its ray. Its error is carried into the image
(``S = sigma^2 I + g g^T`` with ``g = d(u, v)/dX s``, ``s`` one standard deviation along the ray), which to first order
is the same as estimating the landmark along with the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stages.geometry import Camera

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

NEAREST = 1e-6
"""Depth, metres, below which a landmark counts as behind the camera."""
HUBER = 2.5
"""Huber's bound in standard deviations: 4 % of Gaussian errors in two dimensions lie beyond it."""


@dataclass(frozen=True)
class Observations:
    """Landmarks (b, n, 3) m with their one-sigma vectors (b, n, 3) m, and where they were seen (b, n, 2) pixels."""

    landmarks: Floats
    sigmas: Floats
    pixels: Floats
    camera: Camera
    pixel_sigma: float

    def take(self, batch: NDArray[np.intp]) -> Observations:
        """Problems of ``k`` observations each, chosen by an index array (b, k), out of a batch of one."""
        return Observations(
            self.landmarks[0][batch], self.sigmas[0][batch], self.pixels[0][batch], self.camera, self.pixel_sigma
        )


@dataclass(frozen=True)
class Poses:
    """A batch of T_cam_local: rotation (b, 3, 3) and translation (b, 3) m."""

    R: Floats
    t: Floats

    def at(self, i: int) -> Poses:
        """The batch of one that holds pose ``i``."""
        return Poses(self.R[i : i + 1], self.t[i : i + 1])


@dataclass(frozen=True)
class Errors:
    """Back-projection errors at poses.

    ``pixels`` (b, n, 2) raw, ``white`` (b, n, 2) whitened, ``norm`` (b, n) their Mahalanobis length (infinite behind
    the camera), and what the derivatives need: camera coordinates ``x`` (b, n, 3), ``projection`` (b, n, 2, 3)
    derivative of the image by them, ``along`` (b, n, 2) image of the landmark's standard deviation.
    """

    pixels: Floats
    white: Floats
    norm: Floats
    x: Floats
    projection: Floats
    along: Floats


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
    camera, count = obs.camera, (len(poses.t), *obs.landmarks.shape[1:])
    x = np.einsum("bij,bnj->bni", poses.R, np.broadcast_to(obs.landmarks, count)) + poses.t[:, None]
    behind = x[..., 2] < NEAREST
    z = np.where(behind, 1.0, x[..., 2])
    u, v = x[..., 0] / z, x[..., 1] / z
    pixels = np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], -1) - obs.pixels
    projection = np.zeros((*z.shape, 2, 3))
    projection[..., 0, 0], projection[..., 0, 2] = camera.fx / z, -camera.fx * u / z
    projection[..., 1, 1], projection[..., 1, 2] = camera.fy / z, -camera.fy * v / z
    turned = np.einsum("bij,bnj->bni", poses.R, np.broadcast_to(obs.sigmas, count))
    along = np.einsum("bnij,bnj->bni", projection, turned)
    white = _whiten(pixels[..., None], along, obs.pixel_sigma)[..., 0]
    norm = np.where(behind, np.inf, np.sqrt((white * white).sum(-1)))
    return Errors(pixels, white, norm, x, projection, along)


def derivatives(errors: Errors, pixel_sigma: float) -> Floats:
    """Whitened Jacobian (b, n, 2, 6) of the errors by ``xi``."""
    turn = np.einsum("bnij,bnjk->bnik", errors.projection, -cross_matrix(errors.x))
    return _whiten(np.concatenate([errors.projection, turn], -1), errors.along, pixel_sigma)


def _whiten(a: Floats, g: Floats, sigma: float) -> Floats:
    """``S^-1/2 a`` of (b, n, 2, k) with ``S = sigma^2 I + g g^T``: along g divide by the longer standard deviation."""
    length2 = (g * g).sum(-1)
    unit = g / np.sqrt(np.where(length2 > 0, length2, 1.0))[..., None]
    shrink = 1.0 / sigma - 1.0 / np.sqrt(sigma**2 + length2)
    along = np.einsum("bni,bnik->bnk", unit, a)
    return np.asarray(a / sigma - (shrink[..., None] * unit)[..., None] * along[..., None, :])


def robust_cost(norm: Floats, active: Bools) -> Floats:
    """Huber's cost (b,) of Mahalanobis norms (b, n) over the active ones; infinite if one is behind the camera."""
    cost = np.where(norm <= HUBER, 0.5 * norm**2, HUBER * norm - 0.5 * HUBER**2)
    return np.asarray(np.where(active, cost, 0.0).sum(-1))


def normal_matrix(obs: Observations, errors: Errors, active: Bools) -> tuple[Floats, Floats, Floats]:
    """Weighted normal matrix (b, 6, 6), gradient (b, 6) and weights (b, n) of Huber's cost."""
    usable = active & np.isfinite(errors.norm)
    weight = np.where(usable, HUBER / np.maximum(np.where(usable, errors.norm, 1.0), HUBER), 0.0)
    jacobian = derivatives(errors, obs.pixel_sigma)
    weighted = jacobian * weight[..., None, None]
    normal = np.einsum("bnik,bnil->bkl", weighted, jacobian)
    return normal, np.einsum("bnik,bni->bk", weighted, errors.white), weight


def levenberg_marquardt(
    obs: Observations, start: Poses, active: Bools, iterations: int, tolerance: float = 1e-10
) -> tuple[Poses, int]:
    """Minimise Eq. 6 (robust, weighted) from ``start`` over the active (b, n) observations; also iterations done.

    Converged when no problem's step promises to lower its cost by more than ``tolerance`` of it. The damping is
    Marquardt's (scaled by the diagonal), which also holds a singular problem still instead of letting it fly off.
    """
    poses, damping = start, np.full(len(start.t), 1e-4)
    errors = back_projection(obs, poses)
    cost = robust_cost(errors.norm, active)
    done = 0
    for _ in range(iterations):
        done += 1
        normal, gradient, _ = normal_matrix(obs, errors, active)
        step = _damped_step(normal, gradient, damping)
        turn = exponential(step[:, 3:])
        trial = Poses(turn @ poses.R, np.einsum("bij,bj->bi", turn, poses.t) + step[:, :3])
        new = back_projection(obs, trial)
        new_cost = robust_cost(new.norm, active)
        better = new_cost < cost
        poses, errors = _choose(better, trial, poses), _choose(better, new, errors)
        promised = -0.5 * (gradient * step).sum(-1)
        finished = promised <= tolerance * np.where(np.isfinite(cost), cost, 0.0) + 1e-20
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, np.maximum(damping * 0.1, 1e-12), damping * 10.0)
        if finished.all():
            break
    return poses, done


def _damped_step(normal: Floats, gradient: Floats, damping: Floats) -> Floats:
    diagonal = np.einsum("bkk->bk", normal)
    floor = 1e-12 * diagonal.max(-1, keepdims=True) + 1e-300
    lhs = normal + (damping[:, None] * diagonal + floor)[..., None] * np.eye(6)
    return np.asarray(-np.linalg.solve(lhs, gradient[..., None])[..., 0])


Batch = TypeVar("Batch", Poses, Errors)


def _choose(first: Bools, a: Batch, b: Batch) -> Batch:
    """Problem by problem, ``a`` where ``first``, else ``b``."""
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)]
    return type(a)(*(np.where(first.reshape(-1, *[1] * (p.ndim - 1)), p, q) for p, q in pairs))
