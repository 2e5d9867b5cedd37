"""Joint adjustment of a segment: all its poses and the depths of its landmarks at once, by least squares.

Resection poses each frame by itself, with landmarks from the key pair's disparity. Here the landmarks' depths are
unknowns, too, each held by its disparity: four views determine the depth of a point better than its disparity alone. An
error that all disparities share is one more unknown. The disparity of the basic pair at the segment's end is no second
measurement: it shares its errors with the first and gains little.

Huber's weights, Levenberg-Marquardt. A landmark has one unknown (along its ray), so that its elimination (Schur's
complement) is a division, and the system has the size of the poses (Triggs, McLauchlan, Hartley, Fitzgibbon 2000,
doi:10.1007/3-540-44480-7_21). The inverse of the same reduced system is the covariance of the poses, by the same rules
as the resection's (:mod:`rille.stages.odometry.resection.robust_pose`): the errors that are found set the scale, what
the stated ones leave beyond them is shared by all segments.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats
from rille.stages.geometry.geometry import Camera, RigidTransform
from rille.stages.geometry.projection import NEAREST_M, perturbed
from rille.stages.geometry.rigid import posed
from rille.stages.numeric.least_squares import Minimum, levenberg_marquardt
from rille.stages.odometry.resection.landmarks import Landmarks, SegmentPoints
from rille.stages.odometry.resection.pnp import (
    Errors,
    Observations,
    Pose,
    PoseCovariances,
    back_projection,
    bias_information,
    huber_costs,
    huber_weights,
)
from rille.stages.odometry.resection.robust_pose import (
    MIN_LANDMARKS,
    SHARED_SOURCES,
    ResectParams,
    correlation,
    frame_errors,
    scatter_of_blocks,
    total_covariance,
)


@dataclass(frozen=True)
class SegmentTracks:
    """Measurements of one segment.

    ``landmarks`` (n) in the local frame; ``pixels`` (frame, n, 2) of them in the frames behind the key, and whether
    they count there, ``seen`` (frame, n).
    """

    landmarks: Landmarks
    pixels: Floats
    seen: Bools
    camera: Camera


class SegmentState(NamedTuple):
    """``R`` (frame, 3, 3), ``t`` (frame, 3) of T_cam_local behind the key; ``disparity`` (n,) corrections of the
    disparities, and the ``bias`` of all, pixels."""

    R: Floats
    t: Floats
    disparity: Floats
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
    params: ResectParams

    def observations(self, f: int) -> Observations:
        """Observations of frame ``f`` by itself, with landmarks from their disparities."""
        tracks = self.tracks
        return Observations(tracks.landmarks, tracks.pixels[f], tracks.camera, self.params.pixel_sigma)

    def errors(self, state: SegmentState, f: int) -> Errors:
        """Back-projection errors of frame ``f``; depths are unknowns, so landmarks have no error of their own."""
        exact = replace(self.tracks.landmarks, sigma=np.zeros(len(state.disparity)))
        return back_projection(
            self.observations(f)._replace(landmarks=exact), Pose(state.R[f], state.t[f], state.disparity + state.bias)
        )

    def weights(self, errors: Errors, f: int) -> Floats:
        """Huber's weights (n,) of frame ``f``; 0 of what is not seen there."""
        return huber_weights(errors.norm, self.tracks.seen[f])

    def normal(self, state: SegmentState) -> SegmentNormal:
        """Normal equations and Huber's cost of the tracks, with the priors of depths and bias.

        Landmarks behind a camera do not count.
        """
        p, n = 6 * len(state.R) + 1, len(state.disparity)
        held = self.tracks.landmarks.sigma**-2.0
        out = SegmentNormal(np.zeros((p, p)), np.zeros((p, n)), held.copy(), np.zeros(p), state.disparity * held, 0.0)
        prior = bias_information(self.params.bias_sigma)
        cost = 0.5 * float((state.disparity**2 * held).sum() + prior * state.bias**2)
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
        out.poses[-1, -1] += prior
        out.pose_gradient[-1] += prior * state.bias
        return out._replace(cost=cost)

    def ahead(self, state: SegmentState, normal: SegmentNormal, damping: float) -> SegmentState:
        """The state after one damped step."""
        poses, depths = normal.poses + damping * np.diag(np.diag(normal.poses)), normal.depths * (1.0 + damping)
        matrix, right = normal._replace(poses=poses, depths=depths).without_depths()
        step = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
        R, t = perturbed(state.R, state.t, step[:-1].reshape(-1, 6))
        disparity = state.disparity - (normal.depth_gradient + normal.between.T @ step) / depths
        return SegmentState(R, t, disparity, state.bias + float(step[-1]))

    def scatter(self, state: SegmentState) -> float:
        """Variance of the errors found over the one expected: weighted squares per degree of freedom.

        Depths add one unknown and one measurement each (their disparity), so that tracks and poses decide the freedom.
        """
        total, measured = float(((state.disparity / self.tracks.landmarks.sigma) ** 2).sum()), 0
        for f in range(len(state.R)):
            errors = self.errors(state, f)
            weight = self.weights(errors, f)
            use = weight > 0
            # Weighted as the cost weighs them: outliers must not set the scale.
            total += float((weight[use] * errors.norm[use] ** 2).sum())
            measured += 2 * int(use.sum())
        return max(total / max(measured - 6 * len(state.R), 1), 1e-12)


def adjust(tracks: SegmentTracks, start: SegmentState, params: ResectParams) -> Minimum[SegmentState]:
    """The state of least cost; its cost never exceeds that of the start."""
    # About 5 steps suffice.
    return levenberg_marquardt(SegmentAdjustment(tracks, params), start, 20)


class PosedTracks(NamedTuple):
    """Measurements of a segment and its state; which of its frames have a pose, and which of its points are used."""

    tracks: SegmentTracks
    state: SegmentState
    frames: NDArray[np.intp]
    points: NDArray[np.intp]

    @staticmethod
    def of(points: SegmentPoints, poses: Floats, inlier: Bytes) -> PosedTracks | None:
        """A segment's points that agree with the poses (frame, 3, 4) of its frames; None: no frame is posed.

        ``inlier`` (n, frame): those that agree, 1.
        """
        frames = 1 + np.flatnonzero(posed(poses[1:]))
        rows = np.flatnonzero(inlier[:, frames].any(1))
        if not len(rows):
            return None
        landmarks = points.landmarks.take(rows)
        # An exact disparity would have infinite information.
        landmarks = replace(landmarks, sigma=np.maximum(landmarks.sigma, 1e-3))
        pixels = np.swapaxes(points.tracks[rows][:, frames], 0, 1).astype(np.float64)
        T = [RigidTransform.from_matrix(poses[j]).inverse() for j in frames]
        state = SegmentState(
            np.array([p.rotation for p in T]), np.array([p.translation for p in T]), np.zeros(len(rows))
        )
        tracks = SegmentTracks(landmarks, pixels, inlier[np.ix_(rows, frames)].T != 0, points.camera)
        return PosedTracks(tracks, state, frames, rows)._determined()

    def adjusted(self, state: SegmentState) -> PosedTracks | None:
        """The segment in this state; a landmark behind a camera agrees with no pose, and has no image there."""
        moved = self._replace(state=state)
        z = np.einsum("fj,nj->fn", state.R[:, 2], moved.landmarks()) + state.t[:, 2:]
        return moved._replace(tracks=replace(self.tracks, seen=self.tracks.seen & (z >= NEAREST_M)))._determined()

    def _determined(self) -> PosedTracks | None:
        """The same without frames that see too few landmarks for a pose; None if no frame is left."""
        enough = self.tracks.seen.sum(1) >= MIN_LANDMARKS
        tracks = replace(self.tracks, pixels=self.tracks.pixels[enough], seen=self.tracks.seen[enough])
        state = self.state._replace(R=self.state.R[enough], t=self.state.t[enough])
        return PosedTracks(tracks, state, self.frames[enough], self.points) if enough.any() else None

    def landmarks(self) -> Floats:
        """Landmarks (n, 3) in this state, m, local frame."""
        return self.tracks.landmarks.moved(self.state.disparity + self.state.bias).position


class PoseErrors(NamedTuple):
    """Covariances (frame, 6, 6) of adjusted poses, roots (frame, 6, 7) of the part that all segments share, and the
    variance of the errors of tracks over the one stated, correlation between neighbours included; at least 1."""

    covariance: Floats
    shared: Floats
    excess: float


def pose_errors(problem: SegmentAdjustment, state: SegmentState) -> PoseErrors:
    """Errors of the poses of an adjusted segment, of position (m) and rotation vector (rad) of T_local_left."""
    tracks, factor, count = problem.tracks, problem.scatter(state), len(state.R)
    matrix, _ = problem.normal(state).without_depths()
    poses = PoseCovariances.of(matrix, problem.params.bias_sigma, factor)
    own, shared, block_scatters = np.empty((count, 6, 6)), np.empty((count, 6, SHARED_SOURCES)), list[float]()
    for f in range(count):
        seen = tracks.seen[f]
        depth = float(np.median(tracks.landmarks.position[seen] @ state.R[f, 2] + state.t[f, 2]))
        own[f], shared[f] = frame_errors(poses, state.R[f], depth, f)
        errors = back_projection(problem.observations(f), Pose(state.R[f], state.t[f], state.bias))
        weight = problem.weights(errors, f)[seen]
        block_scatters.append(scatter_of_blocks(tracks.pixels[f][seen], errors.error[seen], weight, tracks.camera))
    return PoseErrors(
        total_covariance(own, shared, block_scatters), shared, max(factor, 1.0) * correlation(block_scatters)
    )
