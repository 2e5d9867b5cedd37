"""Least squares of one segment: poses, depths of landmarks, and an error that all its disparities share.

Huber's weights, Levenberg-Marquardt. A landmark has one unknown (along its ray), so that its elimination (Schur's
complement) is a division, and the system has the size of the poses (Triggs, McLauchlan, Hartley, Fitzgibbon 2000,
doi:10.1007/3-540-44480-7_21). The inverse of the same reduced system is the covariance of the poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Params
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.projection import Pinhole, perturbed
from rille.stages.numeric.least_squares import Minimum, levenberg_marquardt
from rille.stages.odometry.resection.pnp import (
    Errors,
    Observations,
    Pose,
    back_projection,
    bias_information,
    huber_costs,
    huber_weights,
)


class RefineParams(Params):
    """Parameters of the joint refinement."""

    enabled: bool = Field(default=True, description="adjust poses and landmark depths of a segment jointly")
    iterations: int = Field(default=20, ge=1, description="limit of Levenberg-Marquardt iterations; 5 are usual")
    pixel_sigma: float = Field(default=0.2, gt=0, description="standard deviation [pixels] of a tracked position")
    bias_sigma: float = Field(
        default=0.1,
        ge=0,
        description="prior standard deviation [pixels] of an error common to all disparities (toe-in of the rig)",
    )


@dataclass(frozen=True)
class SegmentTracks:
    """Measurements of one segment.

    ``position``, ``along`` (n, 3) of the landmarks in the local frame, and how they move with their disparity, m and
    m/pixel; ``sigma`` (n,) of it, pixels. ``pixels`` (frame, n, 2) of the frames behind the key, ``seen`` (frame, n)
    whether they count.
    """

    position: Floats
    along: Floats
    sigma: Floats
    pixels: Floats
    seen: Bools
    camera: Camera


class SegmentState(NamedTuple):
    """``R`` (frame, 3, 3), ``t`` (frame, 3) of T_cam_local behind the key; ``depth`` (n,) corrections of the
    disparities, and the ``bias`` of all, pixels."""

    R: Floats
    t: Floats
    depth: Floats
    bias: float = 0.0


class SegmentNormal(NamedTuple):
    """Normal equations: of the p = 6 frames + 1 unknowns of poses and bias, of the n depths, and between them.

    ``poses`` (p, p), ``between`` (p, n), ``depths`` (n,) the diagonal; ``pose_gradient`` (p,), ``depth_gradient`` (n,);
    ``cost`` that they are of.
    """

    poses: Floats
    between: Floats
    depths: Floats
    pose_gradient: Floats
    depth_gradient: Floats
    cost: float

    def without_depths(self) -> tuple[Floats, Floats]:
        """Matrix (p, p) and right side (p,) of poses and bias alone: depths are eliminated by a division.

        No two depths share a measurement (Schur's complement).
        """
        scaled = self.between / self.depths
        matrix = self.poses - scaled @ self.between.T
        # An unknown that no measurement touches (all its landmarks are behind the camera) stays as it is.
        matrix[np.diag_indices_from(matrix)] += np.diag(matrix) == 0.0
        return matrix, scaled @ self.depth_gradient - self.pose_gradient


@dataclass(frozen=True)
class SegmentAdjustment:
    """A segment as a problem of least squares."""

    tracks: SegmentTracks
    params: RefineParams

    def observations(self, f: int) -> Observations:
        """Frame ``f`` by itself, landmarks as their disparities have them."""
        tracks, camera = self.tracks, Pinhole.of(self.tracks.camera)
        known = tracks.position, tracks.along, tracks.sigma, tracks.pixels[f]
        return Observations(*known, camera, self.params.pixel_sigma)

    def errors(self, state: SegmentState, f: int) -> Errors:
        """Back-projection errors of frame ``f``; depths are unknowns, so landmarks have no error of their own."""
        exact = self.observations(f)._replace(sigma=np.zeros(len(self.tracks.sigma)))
        return back_projection(exact, Pose(state.R[f], state.t[f], state.depth + state.bias))

    def weights(self, errors: Errors, f: int) -> Floats:
        """Huber's weights (n,) of frame ``f``; 0 of what is not seen there."""
        return huber_weights(errors.norm, self.tracks.seen[f])

    def normal(self, state: SegmentState) -> SegmentNormal:
        """Normal equations and Huber's cost of the tracks, with the priors of depths and bias."""
        out = self.measured(state)
        prior = bias_information(self.params.bias_sigma)
        out.poses[-1, -1] += prior
        out.pose_gradient[-1] += prior * state.bias
        return out._replace(cost=out.cost + 0.5 * prior * state.bias**2)

    def measured(self, state: SegmentState) -> SegmentNormal:
        """The same without the prior of the bias; landmarks behind a camera do not count."""
        p, n = 6 * len(state.R) + 1, len(state.depth)
        held = self.tracks.sigma**-2.0
        out = SegmentNormal(np.zeros((p, p)), np.zeros((p, n)), held.copy(), np.zeros(p), state.depth * held, 0.0)
        cost = 0.5 * float((state.depth**2 * held).sum())
        for f in range(len(state.R)):
            errors = self.errors(state, f)
            weight, at = self.weights(errors, f), slice(6 * f, 6 * f + 6)
            cost += huber_costs(errors.norm[self.tracks.seen[f] & np.isfinite(errors.norm)])
            by_pose, by_depth = errors.jacobian[..., :6], errors.jacobian[..., 6]
            weighted = by_pose * weight[:, None, None]
            out.poses[at, at] = np.einsum("nai,nak->ik", weighted, by_pose, optimize=True)
            out.between[at] = np.einsum("nai,na->in", weighted, by_depth)
            out.pose_gradient[at] = np.einsum("nai,na->i", weighted, errors.error)
            square, slope = weight * (by_depth**2).sum(1), weight * (by_depth * errors.error).sum(1)
            out.depths[:] += square
            out.depth_gradient[:] += slope
            # A shift of one depth and that of all depths move a pixel alike.
            out.between[-1] += square
            out.pose_gradient[-1] += slope.sum()
        out.poses[-1] = out.poses[:, -1] = out.between.sum(1)
        return out._replace(cost=cost)

    def ahead(self, state: SegmentState, normal: SegmentNormal, damping: float) -> SegmentState:
        """The state one damped step on."""
        poses, depths = normal.poses + damping * np.diag(np.diag(normal.poses)), normal.depths * (1.0 + damping)
        matrix, right = normal._replace(poses=poses, depths=depths).without_depths()
        step = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
        R, t = perturbed(state.R, state.t, step[:-1].reshape(-1, 6))
        depth = state.depth - (normal.depth_gradient + normal.between.T @ step) / depths
        return SegmentState(R, t, depth, state.bias + float(step[-1]))

    def scatter(self, state: SegmentState) -> float:
        """Variance of the errors found over the one expected: weighted squares per degree of freedom.

        Depths add one unknown and one measurement each (their disparity), so that tracks and poses decide the freedom.
        """
        total, measured = float(((state.depth / self.tracks.sigma) ** 2).sum()), 0
        for f in range(len(state.R)):
            errors = self.errors(state, f)
            weight = self.weights(errors, f)
            use = weight > 0
            # Weighted as the cost weighs them: outliers must not set the scale.
            total += float((weight[use] * errors.norm[use] ** 2).sum())
            measured += 2 * int(use.sum())
        return max(total / max(measured - 6 * len(state.R), 1), 1e-12)


def adjust(tracks: SegmentTracks, start: SegmentState, params: RefineParams) -> Minimum[SegmentState]:
    """The state of least cost; never worse than its start by the same cost."""
    return levenberg_marquardt(SegmentAdjustment(tracks, params), start, params.iterations)
