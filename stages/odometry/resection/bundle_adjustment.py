"""Least squares of one segment or some: poses, depths of landmarks, and what all disparities share.

Huber's weights, Levenberg-Marquardt. A landmark has one unknown (along its ray), so that its elimination (Schur's
complement) is a division, and the system has the size of the poses (Triggs, McLauchlan, Hartley, Fitzgibbon 2000,
doi:10.1007/3-540-44480-7_21). The result is never worse than its start by the same cost: where no step lowers it, the
start is returned. The inverse of the same reduced system is the covariance of the poses (:func:`posterior`).

Another error that disparities share, a tilt, shows over the whole sequence only: :func:`tilt_of` is the
contribution of one segment (:mod:`rille.stages.odometry.resection.common_tilt`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Params
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.projection import NEAREST, Pinhole, linearise, perturbed, project, rotated, to_camera
from rille.stages.numeric.robust import huber_cost, huber_weight
from rille.stages.odometry.resection.pnp import HUBER, bias_information

FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e8


class RefineParams(Params):
    """Parameters of the joint refinement."""

    enabled: bool = Field(
        default=True,
        description="adjust poses and landmark depths of a segment jointly; needs resect.landmarks = disparity",
    )
    window: int = Field(
        default=1,
        ge=0,
        description="number of successive segments adjusted together, of which the last is kept; 0: the whole "
        "sequence at once",
    )
    iterations: int = Field(default=20, ge=1, description="limit of Levenberg-Marquardt iterations; 5 are usual")
    pixel_sigma: float = Field(default=0.2, gt=0, description="standard deviation [pixels] of a tracked position")
    bias_sigma: float = Field(
        default=0.1,
        ge=0,
        description="prior standard deviation [pixels] of an error common to all disparities (toe-in of the rig)",
    )
    tilt_sigma_deg: float = Field(
        default=0.3,
        ge=0,
        description="prior standard deviation [degrees] of a pitch of the right camera that is really a shift of its "
        "principal point; 0.3: 0.5 % of the focal length, as in rig.prior_principal; 0: do not estimate "
        "it",
    )
    tilt_significance: float = Field(
        default=4.0,
        ge=0,
        description="standard deviations (from the scatter of segments) from which on an estimated tilt of the "
        "disparities is removed",
    )


@dataclass(frozen=True)
class SegmentTracks:
    """Measurements of one segment.

    ``position``, ``along`` (n, 3) of the landmarks in the local frame, and how they move with their disparity, m and
    m/pixel; ``sigma`` (n,) of it, pixels. ``pixels`` (frame, n, 2) of the frames behind the key, ``seen`` (frame, n)
    whether they count. ``tilt`` (n,) pixels of disparity a radian of pitch that stands for a principal point's row.
    """

    position: Floats
    along: Floats
    sigma: Floats
    pixels: Floats
    seen: Bools
    camera: Camera
    tilt: Floats

    def without_tilt(self, tilt: float) -> SegmentTracks:
        """Correct the landmarks for disparities that are tilted by ``tilt`` radians."""
        return replace(self, position=self.position + (tilt * self.tilt)[:, None] * self.along)


@dataclass(frozen=True)
class SegmentState:
    """``R`` (frame, 3, 3), ``t`` (frame, 3) of T_cam_local behind the key; ``depth`` (n,) corrections, pixels."""

    R: Floats
    t: Floats
    depth: Floats

    def moved(self, pose: Floats, depth: Floats) -> SegmentState:
        """Apply steps (frame, 6) of the poses, ``v, w`` as in :mod:`rille.stages.odometry.resection.pnp`, and (n,)."""
        return SegmentState(*perturbed(self.R, self.t, pose), self.depth + depth)


class _Tracks(NamedTuple):
    """Tracks of a segment for the compiled loops: landmarks, where they were seen, and the poses of the frames."""

    position: Any
    along: Any
    pixels: Any
    seen: Any
    camera: Any
    sigma: Any
    R: Any
    t: Any
    shift: Any


def _tracks(views: SegmentTracks, state: SegmentState, bias: float, sigma: float) -> _Tracks:
    camera = Pinhole.of(views.camera)
    given = (views.position, views.along, views.pixels, views.seen, camera, float(sigma))
    return _Tracks(*given, state.R, state.t, state.depth + bias)


@njit(cache=True, nogil=True)
def _observe(data, f, n, j):  # type: ignore[no-untyped-def]
    """Fill ``j`` (2, 8), pixels, for landmark ``n`` in frame ``f`` (see :func:`linearise`); whether it was seen."""
    if not data.seen[f, n]:
        return False
    x = to_camera(data.R[f], data.t[f], data.position[n], data.along[n], data.shift[n])
    if not x[2] > NEAREST:
        return False
    linearise(data.camera, x, rotated(data.R[f], data.along[n]), data.pixels[f, n], j)
    return True


@njit(cache=True, nogil=True)
def _track_cost(data):  # type: ignore[no-untyped-def]
    """Huber's cost of the tracks."""
    j = np.empty((2, 8))
    total = 0.0
    for f in range(len(data.R)):
        for n in range(len(data.position)):
            if _observe(data, f, n, j):
                total += huber_cost(np.sqrt(j[0, 7] ** 2 + j[1, 7] ** 2) / data.sigma, HUBER)
    return total


@njit(cache=True, nogil=True)
def _track_normal(data, out):  # type: ignore[no-untyped-def]
    """Add the tracks' part of the normal equations to ``out``, as :func:`normal` gives them.

    The sums run in the order of frames and landmarks. A shift of one depth and that of all depths move a pixel alike,
    so the last row of ``B`` collects what the depths' own diagonal does, and the shared unknown's part follows.
    """
    A, B, d, ga, gd = out
    j, last = np.empty((2, 8)), len(A) - 1
    for f in range(len(data.R)):
        at = 6 * f
        for n in range(len(data.position)):
            if not _observe(data, f, n, j):
                continue
            r = np.sqrt(j[0, 7] ** 2 + j[1, 7] ** 2) / data.sigma
            weight = huber_weight(r, HUBER) / (data.sigma * data.sigma)
            for i in range(6):
                p, q = weight * j[0, i], weight * j[1, i]
                for k in range(i + 1):
                    # The lower half only; it is mirrored at the end.
                    A[at + i, at + k] += p * j[0, k] + q * j[1, k]
                B[at + i, n] += p * j[0, 6] + q * j[1, 6]
                ga[at + i] += p * j[0, 7] + q * j[1, 7]
            square = weight * (j[0, 6] * j[0, 6] + j[1, 6] * j[1, 6])
            slope = weight * (j[0, 6] * j[0, 7] + j[1, 6] * j[1, 7])
            d[n] += square
            gd[n] += slope
            B[last, n] += square
            ga[last] += slope
    for n in range(len(data.position)):
        A[last, last] += B[last, n]
        for i in range(last):
            A[last, i] += B[i, n]
    for i in range(last + 1):
        for k in range(i):
            A[k, i] = A[i, k]


def cost_of(views: SegmentTracks, state: SegmentState, bias: float, sigma: float) -> float:
    """Huber's cost of a segment with its depths' priors (that of the bias is the window's)."""
    total = 0.5 * float(((state.depth / views.sigma) ** 2).sum())
    return total + float(_track_cost(_tracks(views, state, bias, sigma)))


def normal(
    views: SegmentTracks, state: SegmentState, bias: float, sigma: float
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """``A`` (p, p), ``B`` (p, n), ``d`` (n,), gradients (p,) and (n,): p of the poses and the bias, n depths."""
    m, n = len(state.R), len(state.depth)
    # Depths start with the information of their own disparities; the prior of the bias is added once for all segments.
    A, B, d = np.zeros((6 * m + 1, 6 * m + 1)), np.zeros((6 * m + 1, n)), views.sigma**-2.0
    ga, gd = np.zeros(6 * m + 1), state.depth * d
    _track_normal(_tracks(views, state, bias, sigma), (A, B, d, ga, gd))
    return A, B, d, ga, gd


def adjust(
    segments: Sequence[tuple[SegmentTracks, SegmentState]], params: RefineParams
) -> tuple[list[SegmentState], float, float, float]:
    """Minimise the cost of some segments with one bias; states, bias (pixels), cost before and after."""
    prior, sigma = bias_information(params.bias_sigma), params.pixel_sigma
    views, states = [v for v, _ in segments], [s for _, s in segments]
    bias, damping = 0.0, FIRST_DAMPING

    def cost(at: Sequence[SegmentState], b: float) -> float:
        return 0.5 * prior * b * b + sum(cost_of(v, s, b, sigma) for v, s in zip(views, at, strict=True))

    first = now = cost(states, bias)
    for _ in range(params.iterations):
        parts = [normal(v, s, bias, sigma) for v, s in zip(views, states, strict=True)]
        # Normal equations stay as they are while a step is refused: only the damping grows.
        while damping < MOST_DAMPING:
            step_bias, steps = _step(parts, prior, bias, damping)
            ahead = [s.moved(pose, depth) for s, (pose, depth) in zip(states, steps, strict=True)]
            then = cost(ahead, bias + step_bias)
            if then < now:
                break
            # A refused step; an accepted one lowers the damping by as much, so that it follows the cost's curvature.
            damping *= 10.0
        else:
            break
        # Far below what a pose could show, and far above the rounding of a sum of thousands of errors.
        finished = now - then <= 1e-9 * now
        states, bias, now, damping = ahead, bias + step_bias, then, max(0.1 * damping, 1e-12)
        if finished:
            break
    return states, bias, first, now


def _step(
    parts: Sequence[tuple[Floats, Floats, Floats, Floats, Floats]], prior: float, bias: float, damping: float
) -> tuple[float, list[tuple[Floats, Floats]]]:
    """Damped steps: of the bias, and of poses (frame, 6) and depths (n,) of each segment."""
    corner, right, kept = prior * (1.0 + damping), -prior * bias, []
    for A, B, d, ga, gd in parts:
        d = d * (1.0 + damping)
        # Schur's complement: depths are eliminated by a division, since no two of them share a measurement.
        S = _determined(A + damping * np.diag(np.diag(A)) - (B / d) @ B.T)
        r = -(ga - B @ (gd / d))
        solved = np.linalg.solve(S[:-1, :-1], np.column_stack([S[:-1, -1], r[:-1]]))
        # The bias is all that segments share: each one eliminates its poses and leaves one equation for it.
        corner += S[-1, -1] - S[-1, :-1] @ solved[:, 0]
        right += r[-1] - S[-1, :-1] @ solved[:, 1]
        kept.append((solved, B, d, gd))
    common = right / corner
    steps = []
    for solved, B, d, gd in kept:
        pose = np.append(solved[:, 1] - common * solved[:, 0], common)
        steps.append((pose[:-1].reshape(-1, 6), -(gd + B.T @ pose) / d))
    return float(common), steps


def _determined(S: Floats) -> Floats:
    """Normal equations in which an unknown that no measurement touches (all its landmarks are behind) stays as is."""
    S[np.diag_indices_from(S)] += np.diag(S) == 0.0
    return S


def scatter(views: SegmentTracks, state: SegmentState, bias: float, sigma: float) -> float:
    """Variance of the errors found over the one expected: weighted squares of a segment per degree of freedom.

    Depths add one unknown and one measurement each (their disparity), so that tracks and poses decide the freedom.
    """
    x = np.einsum("fij,nj->fni", state.R, views.position + (state.depth + bias)[:, None] * views.along)
    x += state.t[:, None]
    image, _, behind = project(views.camera, x)
    error = (image - views.pixels) / sigma
    use = views.seen & ~behind & np.isfinite(error).all(-1)
    squares = np.where(use, (error**2).sum(-1), 0.0)
    # Huber's weight times the square, as the cost weighs it: outliers must not set the scale.
    total = float((squares * HUBER / np.maximum(np.sqrt(squares), HUBER)).sum())
    total += float(((state.depth / views.sigma) ** 2).sum())
    measured = 2 * int(use.sum())
    return max(total / max(measured - 6 * len(state.R), 1), 1e-12)


def posterior(
    parts: Sequence[tuple[Floats, Floats, Floats, Floats, Floats]],
    factors: Sequence[float],
    params: RefineParams,
) -> list[tuple[Floats, Floats]]:
    """Of the poses of each segment, depths and bias free: covariance (p, p), and error (p,) that windows share.

    The covariance of the whole adjustment is the first plus the square of the second. Windows share the error of the
    bias: what its prior leaves of it where each segment is adjusted alone; all of it where windows overlap, for then
    they measure it with the same tracks.

    Parameters
    ----------
    parts : normal equations of segments with one bias, as :func:`normal` gives them.
    factors : variance of each segment's errors over the expected one.
    """
    prior, kept = bias_information(params.bias_sigma), []
    corner = prior
    for (A, B, d, *_), factor in zip(parts, factors, strict=True):
        S = (A - (B / d) @ B.T) / factor
        scale = np.sqrt(np.maximum(np.diag(S)[:-1], 1e-300))
        # Metres and radians differ by orders of magnitude: with unit diagonal the least eigenvalue means something.
        values, vectors = np.linalg.eigh(S[:-1, :-1] / np.outer(scale, scale))
        inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T / np.outer(scale, scale)
        by_bias = inverse @ S[:-1, -1]
        corner += float(S[-1, -1] - S[-1, :-1] @ by_bias)
        kept.append((inverse, by_bias))
    # Of a window of one the tracks of each segment measure the bias anew; what the prior leaves is the rest that all
    # share.
    common = prior if params.window == 1 else corner
    return [
        (inverse + np.outer(by_bias, by_bias) * (corner - common) / corner**2, -by_bias * math.sqrt(common) / corner)
        for inverse, by_bias in kept
    ]


def tilt_of(views: SegmentTracks, state: SegmentState, bias: float, params: RefineParams) -> tuple[float, float]:
    """Information and pull of the tilt by one segment, its poses, depths and bias free."""
    A, B, d, ga, gd = normal(views, state, bias, params.pixel_sigma)
    prior = bias_information(params.bias_sigma)
    A[-1, -1] += prior
    ga[-1] += prior * bias
    held, g = views.sigma**-2.0, views.tilt
    # A tilt moves depths as their own unknowns do, by g a radian; only tracks tell of it, so the disparities' own part
    # goes.
    by_depth = g * (d - held)
    column = np.append(B @ g, g @ by_depth)
    A = np.column_stack([np.vstack([A, column[:-1]]), column])
    B = np.vstack([B, by_depth])
    S = _determined(A - (B / d) @ B.T)
    S[np.diag_indices_from(S)] *= 1.0 + 1e-9  # landmarks that hardly fix a pose say nothing, and stop nothing
    r = -(np.append(ga, g @ (gd - held * state.depth)) - B @ (gd / d))
    solved = np.linalg.solve(S[:-1, :-1], np.column_stack([S[:-1, -1], r[:-1]]))
    information, pull = S[-1, -1] - S[-1, :-1] @ solved[:, 0], r[-1] - S[-1, :-1] @ solved[:, 1]
    return float(information), float(pull)
