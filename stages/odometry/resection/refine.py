"""Joint refinement of a segment: all its poses and the depths of its landmarks at once (bundle adjustment).

Resection poses each frame by itself, with landmarks as the key pair's disparity has them. Here the landmarks' depths
are unknowns, too, each held by its disparity: a point that four frames see from four places says more of its depth than
its disparity alone. The disparity of the basic pair at the segment's end is no second measurement: it shares its
errors with the first and gains little. What all disparities share is one unknown of a window of segments, since one rig
made them. A task adjusts one window and gives the poses of its last segment.

The poses' covariances are those of this adjustment, by the same rules as the resection's
(:mod:`rille.stages.odometry.resection.resect`): the errors that are found set the scale, what the stated ones leave
beyond them is shared by all segments.

Another error that they share, a tilt, shows over the whole sequence only: each task gives the contribution of its
segment (:mod:`rille.stages.odometry.resection.common_tilt`). If the tilt is significant, landmarks are judged and all
segments adjusted once more without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.core.errors import ConfigError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import RefineFacts, ResectFacts, TiltFacts, TrackFacts
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.epipolar import standing
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens
from rille.stages.geometry.pose_arrays import COVARIANCE, POSES, SHARED
from rille.stages.geometry.projection import NEAREST
from rille.stages.numeric.robust import huber_weight
from rille.stages.odometry.resection.bundle_adjustment import (
    RefineParams,
    SegmentState,
    SegmentTracks,
    adjust,
    normal,
    posterior,
    scatter,
    tilt_of,
)
from rille.stages.odometry.resection.intrinsics import SegmentCameras, contribution
from rille.stages.odometry.resection.landmarks import Landmarks
from rille.stages.odometry.resection.pnp import HUBER, Observations, Poses, back_projection, norms
from rille.stages.odometry.resection.resect import MINIMUM, SOURCES, ResectParams, coordinates, root, scatter_of_blocks


class SegmentStart(NamedTuple):
    """Measurements of a segment, where its adjustment starts, which of its frames have a pose, and which points it has
    of the track."""

    views: SegmentTracks
    state: SegmentState
    frames: list[int]
    which: NDArray[np.intp]


def views_of(track: Bundle, resection: Bundle, landmarks: Landmarks, rig: Rig) -> SegmentStart | None:
    """Measurements and start of a segment, and which of its frames are posed; None: fewer than one behind the key.

    ``landmarks`` are those of all points of the track, in the local frame.
    """
    poses = np.asarray(resection["poses"])
    frames = [j for j in range(1, len(poses)) if np.isfinite(poses[j]).all()]
    tracked = np.asarray(track["points"], dtype=np.float64)
    inlier = (np.asarray(resection["inlier"]) != 0) & np.isfinite(tracked).all(-1)
    which = (
        np.flatnonzero(np.isfinite(landmarks.position).all(1) & inlier[:, frames].any(1))
        if frames
        else np.zeros(0, np.intp)
    )
    if not len(which):
        return None
    known, pixels = landmarks.take(which), np.ascontiguousarray(np.swapaxes(tracked[which][:, frames], 0, 1))
    T = [RigidTransform.from_matrix(poses[j]).inverse() for j in frames]
    state = SegmentState(np.array([p.rotation for p in T]), np.array([p.translation for p in T]), np.zeros(len(which)))
    seen = np.ascontiguousarray(inlier[which][:, frames].T)
    tilt = _tilt_pattern(known.position, _key_pose(resection), rig)
    # An exact disparity would have infinite information.
    held = np.maximum(known.sigma, 1e-3)
    views = SegmentTracks(known.position, known.per_pixel, held, pixels, seen, rig.left, tilt)
    return _determined(SegmentStart(views, state, frames, which))


def _key_pose(resection: Bundle) -> RigidTransform:
    return RigidTransform.from_matrix(np.asarray(resection["poses"])[0])


def _determined(one: SegmentStart) -> SegmentStart | None:
    """The segment without the frames that too few landmarks see to determine a pose; None if no frame is left."""
    enough = one.views.seen.sum(1) >= MINIMUM
    views = replace(one.views, pixels=one.views.pixels[enough], seen=one.views.seen[enough])
    state = SegmentState(one.state.R[enough], one.state.t[enough], one.state.depth)
    return SegmentStart(views, state, np.array(one.frames)[enough].tolist(), one.which) if enough.any() else None


def _in_front(one: SegmentStart, state: SegmentState, bias: float) -> SegmentStart | None:
    """The segment in its adjusted state; a landmark behind a camera agrees with no pose, and has no image there."""
    x = one.views.position + (state.depth + bias)[:, None] * one.views.along
    z = np.einsum("fj,nj->fn", state.R[:, 2], x) + state.t[:, 2:]
    return _determined(one._replace(views=replace(one.views, seen=one.views.seen & (z >= NEAREST)), state=state))


def _tilt_pattern(position: Floats, T_local_key: RigidTransform, rig: Rig) -> Floats:
    """Pixels (n,) along its line that a landmark's right image moves for a radian across it: ``f x y``."""
    x, y, z = rig.T_right_left.apply(T_local_key.inverse().apply(position)).T
    focal = rig.right.fy if standing(rig) else rig.right.fx
    return np.asarray(np.where(z > 0, focal * x * y / np.where(z > 0, z, 1.0) ** 2, 0.0))


def _per_frame(given: _Given, of: SegmentOut) -> list[dict[str, Any]]:
    """Number, inliers and RMS back-projection error [pixels] of each posed frame behind the key."""
    frames, rows = given.track.meta["frames"], []
    points = np.asarray(given.track["points"], dtype=np.float64)
    for j in range(1, len(of.poses)):
        seen = of.inlier[:, j] != 0
        if np.isfinite(of.poses[j]).all() and seen.any():
            at = RigidTransform.from_matrix(of.poses[j]).inverse().apply(of.landmarks[seen])
            off = given.rig.left.project(at) - points[seen, j]
            rms = float(np.sqrt((off**2).sum(1).mean()))
            rows.append({"frame": int(frames[j]), "inliers": int(seen.sum()), "rms_px": rms})
    return rows


def parts(refined: Bundle) -> list[tuple[Floats, NDArray[np.uint8]]]:
    """Landmarks (point, 3), m, local frame, and inliers (point, frame) of each segment of an artifact of this stage."""
    ends = np.cumsum(refined.meta["points"])[:-1]
    segments = (np.split(np.asarray(refined[name]), ends) for name in ("landmarks", "inlier"))
    return [(at, inlier[:, :n]) for at, inlier, n in zip(*segments, refined.meta["frames"], strict=True)]


@dataclass(frozen=True)
class SegmentOut:
    """Result for one segment.

    Of its frames: ``poses`` (frame, 3, 4), ``covariance`` (frame, 6, 6), ``shared`` (frame, 6, 7). Of its points:
    ``landmarks`` (point, 3) m, and ``inlier`` (point, frame), whether they agree with the pose.
    """

    poses: Floats
    covariance: Floats
    shared: Floats
    landmarks: Floats
    inlier: NDArray[np.uint8]

    @staticmethod
    def of(resection: Bundle) -> SegmentOut:
        """Take the result of the resection."""
        poses, covariance, shared, landmarks = (
            np.array(resection[n], dtype=np.float64) for n in ("poses", "covariance", "shared", "landmarks")
        )
        return SegmentOut(poses, covariance, shared, landmarks, np.array(resection["inlier"]))


@dataclass(frozen=True)
class _Given:
    """What :func:`views_of` wants of a segment."""

    track: Bundle
    resection: Bundle
    landmarks: Landmarks
    rig: Rig


def _anew(given: _Given, poses: Floats, tilt: float, resect: ResectParams) -> SegmentStart | None:
    """A segment without the tilt, its landmarks judged once more by poses: the tilt had made good ones inconsistent."""
    tracked = np.isfinite(np.asarray(given.track["points"])).all(-1)
    # All tracks stand trial again, not only those that agreed under the tilt.
    resection: Bundle = Bundle({"poses": poses, "inlier": tracked.astype(np.uint8)}, {})
    one = views_of(given.track, resection, given.landmarks, given.rig)
    if one is None:
        return None
    views, most = one.views.without_tilt(tilt), resect.threshold / resect.pixel_sigma
    for f in range(len(one.frames)):
        views.seen[f] &= norms(_frame(views, f, resect.pixel_sigma), _pose(one.state, f, 0.0))[0] <= most
    return _determined(one._replace(views=views))


def _frame(views: SegmentTracks, f: int, pixel_sigma: float) -> Observations:
    """One frame of a segment by itself, landmarks as their disparities have them."""
    given = views.position[None], views.along[None], views.sigma[None], views.pixels[f : f + 1]
    return Observations(*given, views.camera, pixel_sigma, 0.0)


def _pose(state: SegmentState, f: int, bias: float) -> Poses:
    return Poses(state.R[f : f + 1], state.t[f : f + 1], np.array([bias]))


def claims(
    segments: Sequence[tuple[SegmentTracks, SegmentState]], bias: float, params: RefineParams
) -> list[tuple[Floats, Floats]]:
    """Covariances (frame, 6, 6) and shared errors (frame, 6, 7) of the poses of segments that were adjusted together.

    Of position (m) and rotation vector (rad) of T_local_left, as in :mod:`rille.stages.odometry.resection.resect`.
    """
    parts = [normal(views, state, bias, params.pixel_sigma) for views, state in segments]
    factors = [scatter(views, state, bias, params.pixel_sigma) for views, state in segments]
    # Twice: by the errors found, and by the larger of those and the ones stated; the difference is what all segments
    # share.
    found, stated = (posterior(parts, scale, params) for scale in (factors, [max(f, 1.0) for f in factors]))
    out = []
    for (views, state), (noise, _), (expected, by_bias) in zip(segments, found, stated, strict=True):
        count = len(state.R)
        covariance, shared, together = np.empty((count, 6, 6)), np.empty((count, 6, SOURCES)), list[float]()
        for f in range(count):
            # A step (v, w) of T_cam_local moves the camera by -R^T v and turns it by -R^T w; signs drop out of a
            # covariance.
            turn, at = np.kron(np.eye(2), state.R[f].T), slice(6 * f, 6 * f + 6)
            covariance[f] = turn @ noise[at, at] @ turn.T
            seen = views.seen[f]
            depth = float(np.median((views.position[seen] @ state.R[f].T + state.t[f])[:, 2]))
            left = turn @ expected[at, at] @ turn.T - covariance[f]
            shared[f] = np.column_stack([root(left, depth), turn @ by_bias[at]])
            errors = back_projection(_frame(views, f, params.pixel_sigma), _pose(state, f, bias))
            weight = huber_weight(errors.norm[0], HUBER)
            together.append(scatter_of_blocks(views.pixels[f][seen], errors.white[0][seen], weight[seen], views.camera))
        covariance *= max(1.0, float(np.mean(together)))
        out.append((covariance + shared @ np.swapaxes(shared, 1, 2), shared))
    return out


def _adjusted(
    found: Sequence[SegmentStart | None], out: Sequence[SegmentOut], params: RefineParams
) -> tuple[dict[str, float], dict[int, SegmentState]]:
    """A window adjusted, ``out`` written to; facts of the adjustment, and the state of each segment.

    A frame that keeps too few landmarks keeps the pose of its resection.
    """
    group = {k: one for k, one in enumerate(found) if one is not None}
    states, bias, before, after = adjust([(one.views, one.state) for one in group.values()], params)
    ended = {k: _in_front(one, state, bias) for (k, one), state in zip(group.items(), states, strict=True)}
    kept = {k: one for k, one in ended.items() if one is not None}
    claimed = claims([(one.views, one.state) for one in kept.values()], bias, params)
    for (k, one), (covariance, shared) in zip(kept.items(), claimed, strict=True):
        for row, R, t in zip(one.frames, one.state.R, one.state.t, strict=True):
            out[k].poses[row] = RigidTransform(R, t).inverse().matrix34
        out[k].covariance[one.frames], out[k].shared[one.frames] = covariance, shared
        views = one.views
        out[k].landmarks[one.which] = views.position + (one.state.depth + bias)[:, None] * views.along
        out[k].inlier[:] = 0
        out[k].inlier[one.which, 0] = views.seen.any(0)
        out[k].inlier[np.ix_(one.which, np.array(one.frames))] = views.seen.T
    facts = {"bias_px": bias, "cost_before": before, "cost_after": after}
    return facts, dict(zip(group, states, strict=True))


@stage(
    "refine",
    version=4,
    outputs=[
        replace(POSES, long_name="poses of a segment, of several one after the other", frame="local"),
        replace(COVARIANCE, frame="local"),
        replace(SHARED, frame="local"),
        Array("landmarks", ("point", "xyz"), "float64", "m", "landmarks after the adjustment", "nan", "local"),
        Array("inlier", ("point", "frame"), "uint8", "1", "landmark agrees with the pose", nodata="0"),
    ],
)
def refine_stage(
    params: RefineParams,
    tracks: Sequence[Bundle[TrackFacts]],
    resections: Sequence[Bundle[ResectFacts]],
    levels: Sequence[Bundle[GroundFacts]],
    disparities: Sequence[Bundle],
    rigs: Sequence[Bundle[CalibrationFacts]],
    tilt: Bundle[TiltFacts] | None = None,
    *,
    resect: ResectParams,
    pairs: Sequence[int],
    lenses: Mapping[str, Any] | None = None,
) -> Bundle[RefineFacts]:
    """Poses of a segment adjusted jointly with its landmarks."""
    if resect.landmarks != "disparity":
        raise ConfigError(
            "RIL-416",
            "refine needs landmarks of the disparity",
            remedy="set resect.landmarks=disparity or refine.enabled=false",
        )
    disparity = dict(zip(pairs, disparities, strict=True))
    rig_of = {k: Rig.from_dict(b.meta["rig"]) for k, b in zip(pairs, rigs, strict=True)}
    given: list[_Given] = []
    out: list[SegmentOut] = []
    for track, resection, level in zip(tracks, resections, levels, strict=True):
        key = track.meta["frames"][0]
        rig, T = rig_of[key], RigidTransform.from_matrix(level.meta["T_local_left"])
        points = np.asarray(track["points"])[:, 0].astype(np.float64)
        landmarks = coordinates(points, rig, T, resect, disparity=disparity[key])
        given.append(_Given(track, resection, landmarks, rig))
        out.append(SegmentOut.of(resection))
    kept = slice(0, None) if params.window == 0 else slice(-1, None)
    found = [views_of(g.track, g.resection, g.landmarks, g.rig) for g in given]
    facts, states = _adjusted(found, out, params)
    shared: dict[str, Any] = {}
    if tilt is not None:
        angle = tilt.meta["tilt_rad"]
        again = [
            None if one is None else one._replace(views=one.views.without_tilt(angle), state=states[k])
            for k, one in enumerate(found)
        ]
        _adjusted(again, out, params)
        judged = [_anew(one, new.poses, angle, resect) for one, new in zip(given, out, strict=True)]
        facts, _ = _adjusted(judged, out, params)
    elif params.tilt_sigma_deg > 0:
        of = [(given[k], one.views, states[k]) for k, one in list(enumerate(found))[kept] if one is not None]
        told = [tilt_of(views, state, facts["bias_px"], params) for _, views, state in of]
        shared["tilt"] = [list(pair) for pair in told if np.isfinite(pair).all()]
        lenses = {side: Lens.from_dict(lens) for side, lens in (lenses or {}).items()}
        cameras = [SegmentCameras(one.rig, lenses, _key_pose(one.resection)) for one, _, _ in of]
        shared["intrinsics"] = [contribution(*one[1:], at, params) for one, at in zip(of, cameras, strict=True)]
    per_frame = [item for one, of in zip(given[kept], out[kept], strict=True) for item in _per_frame(one, of)]
    meta: RefineFacts = {
        "frames": [len(one.poses) for one in out[kept]],
        "points": [len(one.landmarks) for one in out[kept]],
        "adjustment": facts,
        "per_frame": per_frame,
        **shared,  # type: ignore[typeddict-item]
    }
    names = ("poses", "covariance", "shared", "landmarks")
    arrays = {name: np.concatenate([getattr(one, name) for one in out[kept]]) for name in names}
    most = max(meta["frames"])
    arrays["inlier"] = np.concatenate([np.pad(o.inlier, ((0, 0), (0, most - len(o.poses)))) for o in out[kept]])
    return Bundle(arrays, meta)
