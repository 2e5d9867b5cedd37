"""Resection: pose of each frame of a segment from landmarks whose 3-D coordinates are known (section 5.2.2).

The landmarks are points of the segment's key frame, triangulated in its stereo pair
(:mod:`rille.stages.odometry.resection.landmarks`); each other frame is posed by itself
(:mod:`rille.stages.odometry.resection.robust_pose`). A pose is refused where the landmarks that contradict it agree
with another one, and a pair whose disparities depart from the landmarks' shows that the rig was knocked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import ResectFacts, TrackFacts
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.pose_arrays import COVARIANCE, POSES, SHARED
from rille.stages.odometry.resection.landmarks import SegmentPoints, landmarks_of, matches_at
from rille.stages.odometry.resection.robust_pose import (
    MIN_LANDMARKS,
    MORE_POINTS,
    SHARED_SOURCES,
    Resection,
    ResectParams,
    enough,
    resect,
)
from rille.stages.odometry.resection.two_motions import AmbiguousError, moving_by_themselves

MIN_JUMP_PX = 1.0
"""Median departure [pixels] of a basic pair's disparities from the pair's before from which on the rig was knocked;
of sound rigs it stays below 0.2."""


@dataclass(frozen=True)
class SegmentPoses:
    """Poses of a segment's frames; see the stage's outputs. A lost frame has NaN, and its fact ``lost`` says why."""

    poses: Floats
    covariance: Floats
    shared: Floats
    inlier: Bytes
    facts: list[dict[str, Any]]

    @staticmethod
    def unposed(points: int, frames: int) -> SegmentPoses:
        """Nothing is known of any frame."""
        return SegmentPoses(
            np.full((frames, 3, 4), np.nan),
            np.full((frames, 6, 6), np.nan),
            np.full((frames, 6, SHARED_SOURCES), np.nan),
            np.zeros((points, frames), np.uint8),
            [],
        )


def resect_segment(points: SegmentPoints, frames: Sequence[int], params: ResectParams) -> SegmentPoses:
    """Poses of the frames of a segment, the key frame's given. A frame that cannot be posed is lost, the others go on.

    ``frames`` are the frame numbers, for messages and seeds.
    """
    out = SegmentPoses.unposed(*points.tracks.shape[:2])
    known = points.known()
    key = points.T_local_key
    out.poses[0], out.covariance[0], out.shared[0] = key.matrix34, 0.0, 0.0
    out.inlier[known[:, 0], 0] = 1
    count = int(known[:, 0].sum())
    out.facts.append({"frame": frames[0], "landmarks": count, "inliers": count, "rms_px": 0.0})
    last, together = key, list[float]()
    doubt: AmbiguousError | None = None
    trusted = np.ones(len(known), bool)
    for j in range(1, len(frames)):
        # What once moved by itself is no landmark: seen longer than others, or standing for a while, it might prevail.
        use = np.flatnonzero(known[:, j] & trusted)
        facts: dict[str, Any] = {"frame": frames[j], "landmarks": int(use.size), "inliers": 0, "rms_px": None}
        out.facts.append(facts)
        try:
            # What is in doubt stays so: later frames see fewer of the landmarks that told the motions apart.
            if doubt:
                raise doubt
            posed = _resect_frame(points, j, use, last, params, frames[j])
            others = moving_by_themselves(points, j, trusted, posed, params, frames[j])
            if others.size:
                trusted[others] = False
                use = np.flatnonzero(known[:, j] & trusted)
                posed = _resect_frame(points, j, use, last, params, frames[j])
        except DegenerateError as error:
            facts["lost"] = error.message.removeprefix(f"frame {frames[j]}: ")
            if isinstance(error, AmbiguousError) and not doubt:
                facts["contradiction"] = f"frame {frames[j]} shows {facts['lost']}: {error.remedy}"
                doubt = AmbiguousError(error.code, f"two motions since frame {frames[j]}")
            continue
        last = posed.T_local_left
        out.poses[j], out.covariance[j], out.shared[j] = last.matrix34, posed.covariance, posed.shared
        out.inlier[use, j] = posed.inlier
        facts |= {"inliers": int(posed.inlier.sum()), "rms_px": posed.rms_px}
        facts |= {} if trusted.all() else {"moving": int((known[:, j] & ~trusted).sum())}
        together.append(posed.together)
    # One frame's figure scatters by a fifth, a segment's frames share their landmarks.
    out.covariance[:] *= max(1.0, float(np.mean(together))) if together else 1.0
    out.covariance[:] += out.shared @ np.swapaxes(out.shared, 1, 2)
    return out


def _resect_frame(
    points: SegmentPoints,
    j: int,
    use: NDArray[np.intp],
    last: RigidTransform,
    params: ResectParams,
    frame: int,
) -> Resection:
    """Pose of the frame in place ``j`` of a segment behind pose ``last``, by the points that are used."""
    enough(
        use.size,
        f"frame {frame}: too few landmarks: {use.size} of {len(points.tracks)} tracked points have coordinates and were"
        f" found ({points.landmarks.summary()})",
        MORE_POINTS,
    )
    pixels = points.tracks[use, j].astype(np.float64)
    return resect(points.landmarks.take(use), pixels, points.camera, [last], params, frame)


def knocked(points: SegmentPoints, segment: SegmentPoses, after: Bundle, rig: Rig) -> tuple[str, list[float]] | None:
    """A line and a jump, px, where the basic pair at the segment's end contradicts the landmarks: the rig has moved.

    A turn of a camera to the side shows in no row of one pair, but all its disparities jump by as much.

    Parameters
    ----------
    after, rig : disparity and rig of that pair.
    """
    pose = segment.poses[-1]
    disparity, matched = matches_at(points.tracks[:, -1].astype(np.float64), after)
    use = matched & (segment.inlier[:, -1] != 0)
    if not np.isfinite(pose).all() or use.sum() < MIN_LANDMARKS:
        return None
    at = RigidTransform.from_matrix(pose).inverse().apply(points.landmarks.position[use])
    expected = rig.right.project(rig.T_right_left.apply(at)) - rig.left.project(at)
    jump = np.median(disparity[use] - expected, axis=0)
    if np.linalg.norm(jump) <= MIN_JUMP_PX:
        return None
    line = (
        f"the rig moved at pair {segment.facts[-1]['frame']}: its disparities depart by {jump[0]:+.1f} px in the column"
        f", {jump[1]:+.1f} px in the row from those of pair {segment.facts[0]['frame']}"
    )
    return line, jump.tolist()


class ResectInputs(NamedTuple):
    """Tracks of a segment; vertical, rig and disparity of its basic pair; disparity and rig of the pair at its end."""

    track: Bundle[TrackFacts]
    level: Bundle[GroundFacts]
    rig: Bundle[CalibrationFacts]
    disparity: Bundle
    after: Bundle | None = None
    rig_after: Bundle[CalibrationFacts] | None = None


@stage(
    "resect",
    version=4,
    outputs=[
        replace(POSES, frame="local"),
        replace(COVARIANCE, frame="local"),
        replace(SHARED, frame="local"),
        Array("inlier", ("point", "frame"), "uint8", "1", "landmark agrees with the pose", nodata="0"),
        Array("landmarks", ("point", "xyz"), "float64", "m", "coordinates of the landmarks", "nan", "local"),
        Array("per_pixel", ("point", "xyz"), "float64", "m/px", "their motion with the disparity", "nan", "local"),
        Array("disparity_sigma", ("point",), "float64", "px", "standard deviation of their disparity", "nan"),
    ],
)
def resect_stage(params: ResectParams, inputs: ResectInputs, *, refused: str | None = None) -> Bundle[ResectFacts]:
    """Poses of a segment's frames in the local frame of its basic pair."""
    rig = Rig.from_dict(inputs.rig.meta["rig"])
    T_local_key = RigidTransform.from_matrix(inputs.level.meta["T_local_left"])
    frames, tracks = inputs.track.meta["frames"], np.asarray(inputs.track["points"])
    key_points = tracks[:, 0].astype(np.float64)
    landmarks = landmarks_of(key_points, inputs.disparity, rig, T_local_key, params.disparity_sigma)
    if refused is not None:
        # Of a rig that was knocked: what it measures is worth no pose.
        tracks = np.where(np.arange(len(frames))[:, None] == 0, tracks, np.float32(np.nan))
    points = SegmentPoints(tracks, landmarks, rig.left, T_local_key)
    segment = resect_segment(points, frames, params)
    for fact in segment.facts[1:] if refused is not None else ():
        fact["lost"] = refused
    meta: ResectFacts = {"per_frame": segment.facts}
    if inputs.after is not None and inputs.rig_after is not None:
        jumped = knocked(points, segment, inputs.after, Rig.from_dict(inputs.rig_after.meta["rig"]))
        if jumped is not None:
            meta["knocked"], meta["jump"] = jumped
            meta["warnings"] = [f"{jumped[0]}: calibrate anew from there on"]
    for line in [fact["contradiction"] for fact in segment.facts if "contradiction" in fact]:
        meta["contradiction"], meta["warnings"] = line, [line]
    arrays = {name: getattr(segment, name) for name in ("poses", "covariance", "shared", "inlier")}
    arrays |= {"landmarks": landmarks.position, "per_pixel": landmarks.per_pixel, "disparity_sigma": landmarks.sigma}
    return Bundle(arrays, meta)
