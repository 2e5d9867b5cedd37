"""Resection: poses of the frames of a segment from landmarks whose 3-D coordinates are known (section 5.2.2).

The landmarks are points of the segment's key frame, triangulated in its stereo pair
(:mod:`rille.stages.odometry.resection.landmarks`); each other frame is posed by itself
(:mod:`rille.stages.odometry.resection.robust_pose`). A pose is refused where the landmarks that contradict it agree
with another one. Then all poses and the landmarks' depths are adjusted jointly
(:mod:`rille.stages.odometry.resection.bundle_adjustment`). An error of the calibration shows over the whole sequence
only: each segment gives its contribution, and how its poses change with it
(:mod:`rille.stages.odometry.resection.intrinsics`). If the disparities of a pair depart from the landmarks', the rig
was knocked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import ResectFacts, TrackFacts
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry import epipolar
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens
from rille.stages.geometry.pose_arrays import BY_INTRINSICS, COVARIANCE, POSES, SHARED
from rille.stages.geometry.scale import right_pixels
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy
from rille.stages.odometry.resection.bundle_adjustment import PosedTracks, SegmentAdjustment, adjust, pose_errors
from rille.stages.odometry.resection.calibration_errors import NUMBERS, SegmentCameras, contribution, turn_deg
from rille.stages.odometry.resection.landmarks import SegmentPoints, landmarks_of, matches_at
from rille.stages.odometry.resection.robust_pose import (
    MIN_LANDMARKS,
    SHARED_SOURCES,
    Resection,
    ResectParams,
    resect,
    total_covariance,
)
from rille.stages.odometry.resection.two_motions import CONTRADICTION, AmbiguousError, moving_by_themselves
from rille.stages.odometry.resection.zoom import refuse_zoom

MIN_JUMP_PX = 1.0
"""Median departure [pixels of the coarser image] of a basic pair's disparities from the pair's before from which on the
rig was knocked; of sound rigs it stays below 0.2."""


@dataclass(frozen=True)
class SegmentPoses:
    """Poses of a segment's frames; see the stage's outputs. A lost frame has NaN, and its fact ``lost`` says why."""

    poses: Floats
    covariance: Floats
    shared: Floats
    by_intrinsics: Floats
    inlier: Bytes
    landmarks: Floats
    facts: list[dict[str, Any]]

    @staticmethod
    def unposed(points: SegmentPoints) -> SegmentPoses:
        """Poses of which none is known."""
        count, frames = points.tracks.shape[:2]
        return SegmentPoses(
            np.full((frames, 3, 4), np.nan),
            np.full((frames, 6, 6), np.nan),
            np.full((frames, 6, SHARED_SOURCES), np.nan),
            np.zeros((frames, 6, len(NUMBERS))),
            np.zeros((count, frames), np.uint8),
            points.landmarks.position.copy(),
            [],
        )


def resect_segment(points: SegmentPoints, frames: Sequence[int], params: ResectParams) -> SegmentPoses:
    """Poses of the frames of a segment, the key frame's given. A frame that cannot be posed is lost, the others go on.

    ``frames`` are the frame numbers, for messages and seeds.
    """
    out = SegmentPoses.unposed(points)
    known = points.known()
    key = points.T_local_key
    out.poses[0], out.covariance[0], out.shared[0] = key.matrix34, 0.0, 0.0
    out.inlier[known[:, 0], 0] = 1
    count = int(known[:, 0].sum())
    out.facts.append({"frame": frames[0], "landmarks": count, "inliers": count, "rms_px": 0.0})
    last, block_scatters = key, list[float]()
    doubt: AmbiguousError | None = None
    trusted = np.ones(len(known), bool)

    def posed_by(use: NDArray[np.intp], j: int) -> Resection:
        pixels, landmarks = points.tracks[use, j].astype(np.float64), points.landmarks.take(use)
        bound = CONTRADICTION * params.threshold

        def without_zoom(agreeing: int) -> None:
            refuse_zoom(landmarks.position, pixels, points.camera, agreeing, bound, frames[j])

        try:
            posed = resect(landmarks, pixels, points.camera, [last], params, frames[j])
        except DegenerateError:
            # Where no pose is found a zoom is the cause rather than what is said of its landmarks.
            without_zoom(0)
            raise
        without_zoom(int((posed.residual <= bound).sum()))
        return posed

    for j in range(1, len(frames)):
        # What once moved by itself is no landmark: seen longer than others, or standing for a while, it might prevail.
        use = np.flatnonzero(known[:, j] & trusted)
        facts: dict[str, Any] = {"frame": frames[j], "landmarks": int(use.size), "inliers": 0, "rms_px": None}
        out.facts.append(facts)
        try:
            # A doubt holds for later frames, too: they see fewer of the landmarks that distinguished the motions.
            if doubt:
                raise doubt
            posed = posed_by(use, j)
            others = moving_by_themselves(points, j, trusted, posed, params, frames[j])
            if others.size:
                trusted[others] = False
                use = np.flatnonzero(known[:, j] & trusted)
                posed = posed_by(use, j)
            # 0.3: share of the landmarks; of a street 0.9 agree, by night and beside a mirror 0.6; of a crowd all over
            # the image 0.2 may, with any pose.
            if (agreeing := int(posed.inlier.sum())) < 0.3 * use.size:
                text = f"only {agreeing} of {use.size} landmarks agree with one pose: most move, or are mistracked"
                raise DegenerateError("RIL-751", text, remedy="mask what moves by itself, or what repeats")
        except DegenerateError as error:
            facts["lost"] = error.message.removeprefix(f"frame {frames[j]}: ")
            facts |= common_bias(points, use, 0, params, frames[j]) if j == 1 else {}
            if isinstance(error, AmbiguousError) and not doubt:
                facts["contradiction"] = f"frame {frames[j]} shows {facts['lost']}: {error.remedy}"
                doubt = AmbiguousError(error.code, f"two motions since frame {frames[j]}")
            continue
        last = posed.T_local_left
        out.poses[j], out.covariance[j], out.shared[j] = last.matrix34, posed.covariance, posed.shared
        out.inlier[use, j] = posed.inlier
        facts |= {"inliers": agreeing, "rms_px": posed.rms_px}
        facts |= common_bias(points, use, agreeing, params, frames[j]) if j == 1 else {}
        facts |= {} if trusted.all() else {"moving": int((known[:, j] & ~trusted).sum())}
        block_scatters.append(posed.block_scatter)
    out.covariance[:] = total_covariance(out.covariance, out.shared, block_scatters)
    return out


def common_bias(
    points: SegmentPoints, use: NDArray[np.intp], agreeing: int, params: ResectParams, frame: int
) -> dict[str, float]:
    """Error of all disparities, px, with which most landmarks agree with one pose of the second frame, if as calibrated
    few do, ``agreeing`` of those in ``use``.

    A rig that is turned aside looks like a zoom, or like two motions.
    """
    # 0.5: of the landmarks; of a rig that is turned by 0.5 degrees 0.9 agree then, by 1.5 degrees 0.6.
    if agreeing >= 0.5 * use.size:
        return {}
    # 30.0 px: the calibration's own prior is not believed.
    pixels, free = points.tracks[use, 1].astype(np.float64), params.model_copy(update={"bias_sigma": 30.0})
    try:
        posed = resect(points.landmarks.take(use), pixels, points.camera, [points.T_local_key], free, frame)
    except DegenerateError:
        return {}
    return {"bias_px": posed.bias} if posed.inlier.sum() >= 0.5 * use.size else {}


def adjust_segment(
    points: SegmentPoints, segment: SegmentPoses, cameras: SegmentCameras, params: ResectParams
) -> dict[str, Any]:
    """Adjust the poses of a segment jointly with its landmarks, in place; return its part in errors of the calibration.

    A frame that keeps too few landmarks keeps the pose of its resection. None: no frame is adjusted.
    """
    start = PosedTracks.of(points, segment.poses, segment.inlier)
    end = start and start.adjusted(adjust(start.tracks, start.state, params).state)
    if end is None:
        return {}
    problem = SegmentAdjustment(end.tracks, params)
    errors, part = pose_errors(problem, end.state), contribution(problem, end.state, cameras)
    segment.covariance[end.frames], segment.shared[end.frames] = errors.covariance, errors.shared
    segment.by_intrinsics[end.frames] = part.by_error
    segment.landmarks[end.points] = end.landmarks()
    segment.inlier[:] = 0
    segment.inlier[end.points, 0] = end.tracks.seen.any(0)
    segment.inlier[np.ix_(end.points, end.frames)] = end.tracks.seen.T
    for f, row in enumerate(end.frames):
        segment.poses[row] = RigidTransform(end.state.R[f], end.state.t[f]).inverse().matrix34
        off = problem.errors(end.state, f).pixels[end.tracks.seen[f]]
        segment.facts[row] |= {"inliers": len(off), "rms_px": float(np.sqrt((off**2).mean()))}
    return {
        "information": (part.information / errors.excess).tolist(),
        "pull": (part.pull / errors.excess).tolist(),
        "turn_deg": turn_deg(end.state, cameras.T_local_key),
        "yaw": [one / errors.excess for one in part.yaw],
        "read_out": [one / errors.excess for one in part.read_out],
        "bias_px": end.state.bias,
    }


class ResectInputs(NamedTuple):
    """Tracks of a segment; vertical, rig and disparity of its basic pair; disparity and rig of the pair at its end."""

    track: Bundle[TrackFacts]
    level: Bundle[GroundFacts]
    rig: Bundle[CalibrationFacts]
    disparity: Bundle
    after: Bundle | None = None
    rig_after: Bundle[CalibrationFacts] | None = None


def jump_of(departs: Floats, grows: Floats) -> tuple[Floats, Floats]:
    """Jump (2,) of the disparities from one basic pair to the next, px, by their departures (point, 2); and the error
    (2,) of all disparities, px, by which landmarks are at wrong distances.

    A rig that was wrong from the start puts landmarks at wrong distances: their disparities then depart by as much as
    they grow, (point,), as a share. A jump is the departure of landmarks that keep their disparity, and of most others.
    """
    line = np.stack([np.ones(len(grows)), grows], axis=1)
    kept, grown = irls(line, departs, lambda off: cauchy(off, MIN_JUMP_PX), 1e-6 * np.eye(2))
    return min(np.median(departs, axis=0), kept, key=np.linalg.norm), grown


def of_pair_behind(tracks: Floats32, segment: SegmentPoses, inputs: ResectInputs) -> dict[str, Any]:
    """Facts of the basic pair at the segment's end where it contradicts the segment's own: the rig has moved, or a part
    of one image is displaced.

    The jump is in pixels of the coarser image. A turn of a camera to the side shows in no row of one pair, but all its
    disparities jump by as much; a part of them does in an image that is torn. A turn of both pairs alike is none: the
    disparities of both are compared with the landmarks as they were adjusted.

    Parameters
    ----------
    tracks : (point, frame, 2) pixels of the left images.
    """
    if inputs.after is None or inputs.rig_after is None or not np.isfinite(segment.poses[[0, -1]]).all():
        return {}
    before, then = (Rig.from_dict(bundle.meta["rig"]) for bundle in (inputs.rig, inputs.rig_after))
    unit = right_pixels(then)
    use, off, depth = segment.inlier[:, -1] != 0, [], []
    side, axes = int(epipolar.standing(then)), epipolar.turn_axes(then)[:2, :2]
    for row, rig, pair in ((0, before, inputs.disparity), (-1, then, inputs.after)):
        disparity, matched, _ = matches_at(tracks[:, row].astype(np.float64), pair, unit)
        at = RigidTransform.from_matrix(segment.poses[row]).inverse().apply(segment.landmarks)
        right = rig.right.project(rig.T_right_left.apply(at))
        depth.append(at[:, 2])
        use &= matched
        error = (disparity - (right - rig.left.project(at))) @ axes
        # A turn of the camera moves what is aside farther than what is in the middle.
        error[:, side] /= 1.0 + (rig.right.rays(right)[:, :2] @ axes)[:, side] ** 2
        off.append(error @ axes.T)
    if use.sum() < MIN_LANDMARKS:
        return {}
    departs = (off[1][use] - off[0][use]) / unit
    # Of disparities beyond those at infinity, whatever the angles of the cameras.
    grows = depth[0][use] / depth[1][use] - 1.0
    jump, grown = jump_of(departs, grows)
    torn = float((np.linalg.norm(departs - np.median(departs, axis=0), axis=1) > 2 * MIN_JUMP_PX).mean())
    # 0.2: of the disparities, from which on a part of one image is displaced; of sound pairs 0.02 depart, by night 0.1.
    # 0.25: of the landmarks; fewer are left of a wide turn, at the rim of the view, where disparities are worst.
    if torn > 0.2 and use.sum() >= 0.25 * len(use):
        return {"torn": torn}
    if np.linalg.norm(jump) <= MIN_JUMP_PX:
        return {"distance_px": float(grown @ epipolar.farther(then)) * unit}
    line = (
        f"the rig moved at pair {segment.facts[-1]['frame']}: its disparities depart by {jump[0]:+.1f} px in the column"
        f", {jump[1]:+.1f} px in the row from those of pair {segment.facts[0]['frame']}"
    )
    remedy = f"calibrate anew from there on, or compute what follows by itself (--frames {segment.facts[-1]['frame']}:)"
    return {"knocked": line, "jump": jump.tolist(), "warnings": [f"{line}: {remedy}"]}


@stage(
    "resect",
    outputs=[
        replace(POSES, frame="local"),
        replace(COVARIANCE, frame="local"),
        replace(SHARED, frame="local"),
        replace(BY_INTRINSICS, frame="local"),
        Array("inlier", ("point", "frame"), "uint8", "1", "landmark agrees with the pose", nodata="0"),
        Array("landmarks", ("point", "xyz"), "float64", "m", "coordinates of the landmarks", "nan", "local"),
    ],
)
def resect_stage(
    params: ResectParams,
    inputs: ResectInputs,
    *,
    lenses: Mapping[str, Any] | None = None,
    refused: str | None = None,
) -> Bundle[ResectFacts]:
    """Poses of a segment's frames in the local frame of its basic pair."""
    rig = Rig.from_dict(inputs.rig.meta["rig"])
    T_local_key = RigidTransform.from_matrix(inputs.level.meta["T_local_left"])
    frames, tracks = inputs.track.meta["frames"], np.asarray(inputs.track["points"])
    key_points = tracks[:, 0].astype(np.float64)
    landmarks = landmarks_of(key_points, inputs.disparity, rig, T_local_key, params.disparity_sigma)
    if refused is not None:
        # The rig was knocked: its disparities give no pose, so only the key frame keeps its tracks.
        tracks = np.where(np.arange(len(frames))[:, None] == 0, tracks, np.float32(np.nan))
    points = SegmentPoints(tracks, landmarks, rig.left, T_local_key)
    segment = resect_segment(points, frames, params)
    for fact in segment.facts[1:] if refused is not None else ():
        fact["lost"] = refused
    meta: ResectFacts = {"per_frame": segment.facts, "intrinsics": {}}
    if params.joint:
        opened = {side: Lens.from_dict(lens) for side, lens in (lenses or {}).items()}
        meta["intrinsics"] = adjust_segment(points, segment, SegmentCameras(rig, opened, T_local_key), params)
    meta |= of_pair_behind(tracks, segment, inputs)  # type: ignore[typeddict-item]
    for line in [fact["contradiction"] for fact in segment.facts if "contradiction" in fact]:
        meta["contradiction"], meta["warnings"] = line, [line]
    return Bundle({name: value for name, value in vars(segment).items() if name != "facts"}, meta)
