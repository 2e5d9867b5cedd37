"""Joint refinement of a segment: all its poses and the depths of its landmarks at once (bundle adjustment).

Resection poses each frame by itself, with landmarks as the key pair's disparity has them. Here the landmarks' depths
are unknowns, too, each held by its disparity: a point that four frames see from four places says more of its depth than
its disparity alone. The disparity of the basic pair at the segment's end is no second measurement: it shares its
errors with the first and gains little.

The poses' covariances are those of this adjustment, by the same rules as the resection's
(:mod:`rille.stages.odometry.resection.robust_pose`): the errors that are found set the scale, what the stated ones
leave beyond them is shared by all segments.

An error of the calibration shows over the whole sequence only: each task gives what its segment says of it, and how its
poses change with it (:mod:`rille.stages.odometry.resection.intrinsics`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import RefineFacts, ResectFacts, TrackFacts
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens
from rille.stages.geometry.pose_arrays import BY_INTRINSICS, COVARIANCE, POSES, SHARED
from rille.stages.geometry.projection import NEAREST_M
from rille.stages.odometry.resection.bundle_adjustment import (
    RefineParams,
    SegmentAdjustment,
    SegmentState,
    SegmentTracks,
    adjust,
)
from rille.stages.odometry.resection.intrinsics import (
    PRIORS,
    IntrinsicsPart,
    SegmentCameras,
    contribution,
    turn_deg,
)
from rille.stages.odometry.resection.pnp import Pose, back_projection, bias_information, pose_covariance
from rille.stages.odometry.resection.robust_pose import (
    MIN_LANDMARKS,
    SHARED_SOURCES,
    frame_errors,
    scatter_of_blocks,
)


class SegmentStart(NamedTuple):
    """Measurements of a segment, where its adjustment starts, which of its frames have a pose, and which points it has
    of the track."""

    tracks: SegmentTracks
    state: SegmentState
    frames: NDArray[np.intp]
    points: NDArray[np.intp]

    def determined(self) -> SegmentStart | None:
        """The same without the frames that too few landmarks see to determine a pose; None if no frame is left."""
        enough = self.tracks.seen.sum(1) >= MIN_LANDMARKS
        tracks = replace(self.tracks, pixels=self.tracks.pixels[enough], seen=self.tracks.seen[enough])
        state = self.state._replace(R=self.state.R[enough], t=self.state.t[enough])
        return SegmentStart(tracks, state, self.frames[enough], self.points) if enough.any() else None

    def landmarks(self) -> Floats:
        """Landmarks (n, 3) in this state, m, local frame."""
        return self.tracks.position + (self.state.depth + self.state.bias)[:, None] * self.tracks.along


def segment_start(track: Bundle, resection: Bundle, rig: Rig) -> SegmentStart | None:
    """Measurements and start of a segment; None: fewer than one frame behind the key is posed."""
    poses, tracked = np.asarray(resection["poses"]), np.asarray(track["points"], dtype=np.float64)
    frames = 1 + np.flatnonzero(np.isfinite(poses[1:]).all((1, 2)))
    inlier = (np.asarray(resection["inlier"]) != 0) & np.isfinite(tracked).all(-1)
    landmarks = np.asarray(resection["landmarks"])
    points = np.flatnonzero(np.isfinite(landmarks).all(1) & inlier[:, frames].any(1))
    if not len(points):
        return None
    pixels = np.ascontiguousarray(np.swapaxes(tracked[points][:, frames], 0, 1))
    T = [RigidTransform.from_matrix(poses[j]).inverse() for j in frames]
    state = SegmentState(np.array([p.rotation for p in T]), np.array([p.translation for p in T]), np.zeros(len(points)))
    seen = np.ascontiguousarray(inlier[points][:, frames].T)
    # An exact disparity would have infinite information.
    sigma = np.maximum(np.asarray(resection["disparity_sigma"])[points], 1e-3)
    along = np.asarray(resection["per_pixel"])[points]
    tracks = SegmentTracks(landmarks[points], along, sigma, pixels, seen, rig.left)
    return SegmentStart(tracks, state, frames, points).determined()


def _in_front(start: SegmentStart, state: SegmentState) -> SegmentStart | None:
    """The segment in its adjusted state; a landmark behind a camera agrees with no pose, and has no image there."""
    moved = start._replace(state=state)
    z = np.einsum("fj,nj->fn", state.R[:, 2], moved.landmarks()) + state.t[:, 2:]
    return moved._replace(tracks=replace(start.tracks, seen=start.tracks.seen & (z >= NEAREST_M))).determined()


class PoseErrors(NamedTuple):
    """Covariances (frame, 6, 6) of adjusted poses, roots (frame, 6, 7) of the part that all segments share, and the
    variance of the errors of tracks over the one stated, correlation between neighbours included; at least 1."""

    covariance: Floats
    shared: Floats
    excess: float


def pose_errors(tracks: SegmentTracks, state: SegmentState, params: RefineParams) -> PoseErrors:
    """Errors of the poses of an adjusted segment.

    Of position (m) and rotation vector (rad) of T_local_left, as in
    :mod:`rille.stages.odometry.resection.robust_pose`.
    """
    problem, prior = SegmentAdjustment(tracks, params), bias_information(params.bias_sigma)
    matrix, _ = problem.measured(state).without_depths()
    factor = problem.scatter(state)
    measured, stated = pose_covariance(matrix / factor, prior), pose_covariance(matrix / max(factor, 1.0), prior)
    count = len(state.R)
    covariance, shared, together = np.empty((count, 6, 6)), np.empty((count, 6, SHARED_SOURCES)), list[float]()
    for f in range(count):
        seen = tracks.seen[f]
        depth = float(np.median(tracks.position[seen] @ state.R[f, 2] + state.t[f, 2]))
        covariance[f], shared[f] = frame_errors(measured, stated, state.R[f], depth, f)
        errors = back_projection(problem.observations(f), Pose(state.R[f], state.t[f], state.bias))
        weight = problem.weights(errors, f)[seen]
        together.append(scatter_of_blocks(tracks.pixels[f][seen], errors.error[seen], weight, tracks.camera))
    correlation = max(1.0, float(np.mean(together)))
    covariance = covariance * correlation + shared @ np.swapaxes(shared, 1, 2)
    return PoseErrors(covariance, shared, max(factor, 1.0) * correlation)


class RefineInputs(NamedTuple):
    """Tracks and resection of a segment; vertical and rig of its basic pair."""

    track: Bundle[TrackFacts]
    resection: Bundle[ResectFacts]
    level: Bundle[GroundFacts]
    rig: Bundle[CalibrationFacts]


@stage(
    "refine",
    version=8,
    outputs=[
        replace(POSES, frame="local"),
        replace(COVARIANCE, frame="local"),
        replace(SHARED, frame="local"),
        replace(BY_INTRINSICS, frame="local"),
        Array("landmarks", ("point", "xyz"), "float64", "m", "landmarks after the adjustment", "nan", "local"),
        Array("inlier", ("point", "frame"), "uint8", "1", "landmark agrees with the pose", nodata="0"),
    ],
)
def refine_stage(
    params: RefineParams, inputs: RefineInputs, *, lenses: Mapping[str, Any] | None = None
) -> Bundle[RefineFacts]:
    """Poses of a segment adjusted jointly with its landmarks."""
    rig = Rig.from_dict(inputs.rig.meta["rig"])
    T_local_key = RigidTransform.from_matrix(inputs.level.meta["T_local_left"])
    # A frame that keeps too few landmarks keeps the pose of its resection.
    names = ("poses", "covariance", "shared", "landmarks", "inlier")
    out = {name: np.array(inputs.resection[name]) for name in names}
    out["by_intrinsics"] = np.zeros((len(out["poses"]), 6, len(PRIORS)))
    meta: RefineFacts = {"adjustment": {}, "intrinsics": {}, "per_frame": []}
    start = segment_start(inputs.track, inputs.resection, rig)
    if start is not None:
        minimum = adjust(start.tracks, start.state, params)
        costs = {"cost_before": minimum.before, "cost_after": minimum.after}
        meta["adjustment"] = {"bias_px": minimum.state.bias, **costs}
        opened = {side: Lens.from_dict(lens) for side, lens in (lenses or {}).items()}
        cameras = SegmentCameras(rig, opened, T_local_key)
        if (end := _in_front(start, minimum.state)) is not None:
            errors = pose_errors(end.tracks, end.state, params)
            part = contribution(end.tracks, end.state, cameras, params)
            _replace(out, end, errors, part)
            meta["intrinsics"] = {
                "information": (part.information / errors.excess).tolist(),
                "pull": (part.pull / errors.excess).tolist(),
                "turn_deg": turn_deg(end.state, T_local_key),
                "yaw": [one / errors.excess for one in part.yaw],
            }
            meta["per_frame"] = _per_frame(end, params, inputs.track.meta["frames"])
    return Bundle(out, meta)


def _replace(out: Mapping[str, Any], end: SegmentStart, errors: PoseErrors, part: IntrinsicsPart) -> None:
    """Write an adjusted segment over its resection."""
    for row, R, t in zip(end.frames, end.state.R, end.state.t, strict=True):
        out["poses"][row] = RigidTransform(R, t).inverse().matrix34
    out["covariance"][end.frames], out["shared"][end.frames] = errors.covariance, errors.shared
    out["by_intrinsics"][end.frames] = part.by_error
    out["landmarks"][end.points] = end.landmarks()
    out["inlier"][:] = 0
    out["inlier"][end.points, 0] = end.tracks.seen.any(0)
    out["inlier"][np.ix_(end.points, end.frames)] = end.tracks.seen.T


def _per_frame(end: SegmentStart, params: RefineParams, numbers: list[int]) -> list[dict[str, Any]]:
    """Number, inliers and RMS back-projection error [pixels] of each adjusted frame."""
    problem, rows = SegmentAdjustment(end.tracks, params), []
    for f, row in enumerate(end.frames):
        off = problem.errors(end.state, f).pixels[end.tracks.seen[f]]
        rms = float(np.sqrt((off**2).mean()))
        rows.append({"frame": int(numbers[row]), "inliers": len(off), "rms_px": rms})
    return rows
