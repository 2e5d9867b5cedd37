"""Trajectory: the running product of the segments' poses (sections 5.2.2 and 7.4).

Each segment is resected in the local frame of its own basic pair, which was levelled without any knowledge of the
others; only the *relative* poses within it matter here. The world is the local frame of pair 0. With ``k`` the key
frame of a segment and ``i`` another of its frames,

    T_world_left(i) = T_world_left(k) T_local_left(k)^-1 T_local_left(i),

so that ``T_world_local(k) = T_world_left(k) T_local_left(k)^-1`` whatever the levelling of pair k is. The next
segment's key frame is the last frame of this one. Where that frame is lost the trajectory breaks: a new piece begins,
in the local frame of its first basic pair.

If the first pair of a piece has no source of the vertical, the vertical of the first pair that has one is carried back
along the piece. If no pair has one, the frame of the piece is that of its first camera, whose own up is z; the result
says so.

Of each segment's own errors the covariances add up. Of errors that all segments share, as those of the calibration
(:mod:`rille.stages.odometry.resection.intrinsics`), the errors themselves add up: they grow with the length of the way
and not with its root (:mod:`rille.stages.odometry.resection.resect`). The covariance is also given without errors of
the calibration: a plane of ground that they tilt defines the world's vertical, so that they tilt no elevation above it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.core.quantities import spans
from rille.stages.facts.odometry import IntrinsicsFacts, ResectFacts, TrajectoryFacts
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.geometry import RigidTransform, cross_matrix, level_rotation, orthonormal, rotation_exp
from rille.stages.geometry.pose_arrays import COVARIANCE, GROUND_PLANE, NO_VERTICAL, OWN_COVARIANCE, POSES
from rille.stages.odometry.doubtful_motion import doubtful_motion


class ChainLink(NamedTuple):
    """Poses (frames, 3, 4) T_local_left of a segment, key frame first, NaN of a lost frame.

    ``covariance`` (frames, 6, 6), and the root ``shared`` (frames, 6, k) of the part of it that all segments share. The
    root ``calibration`` (frames, 6, c) of that by errors of the calibration is no part of it.
    """

    poses: Floats
    covariance: Floats
    shared: Floats
    calibration: Floats

    @staticmethod
    def of(segment: Bundle, intrinsics: Bundle[IntrinsicsFacts] | None) -> ChainLink:
        """Link of a segment; without ``intrinsics`` it knows nothing of errors of the calibration."""
        poses, covariance, shared = (np.asarray(segment[name]) for name in ("poses", "covariance", "shared"))
        if intrinsics is None:
            return ChainLink(poses, covariance, shared, np.zeros((len(poses), 6, 0)))
        by_error, meta = np.asarray(segment["by_intrinsics"]), intrinsics.meta
        moved = by_error[..., -1] * meta["errors"]["toe-in"][0]
        turns = np.array([rotation_exp(turn) for turn in moved[:, 3:]])
        poses = np.concatenate([turns @ poses[:, :, :3], poses[:, :, 3:] + moved[:, :3, None]], axis=2)
        return ChainLink(poses, covariance, shared, by_error @ np.linalg.cholesky(np.array(meta["covariance"])))


@dataclass(frozen=True)
class Chained:
    """Poses of the frames in order, key frames once.

    ``poses`` (frames, 3, 4) T_world_left, m, NaN of a lost frame; ``covariance`` (frames, 6, 6) of (position m,
    rotation rad) in the world frame, ``own_covariance`` the same without errors of the calibration; ``segment``
    (frames,) that posed the frame (a key frame belongs to the one before it); ``piece`` (frames,) number of the
    unbroken piece, -1 of a lost frame.
    """

    poses: Floats
    covariance: Floats
    own_covariance: Floats
    segment: NDArray[np.int16]
    piece: NDArray[np.int16]

    @staticmethod
    def of(trajectory: Bundle[TrajectoryFacts]) -> Chained:
        """A copy of those of a trajectory."""
        return Chained(**{field.name: np.array(trajectory[field.name]) for field in fields(Chained)})

    @staticmethod
    def unposed(frames: int) -> Chained:
        """Poses of frames that are all lost."""
        covariance, lost = np.full((frames, 6, 6), np.nan), np.full(frames, -1, np.int16)
        return Chained(np.full((frames, 3, 4), np.nan), covariance, covariance.copy(), lost, lost.copy())


def chain(
    segments: Sequence[ChainLink], levels: Sequence[RigidTransform], rows: Sequence[Sequence[int]], frames: int
) -> Chained:
    """Compose the poses of segments into one trajectory.

    Where the last frame of a segment is lost, the next segment begins a new piece in the local frame of its own key.

    Parameters
    ----------
    levels : T_local_left of each segment's key frame by its own level stage.
    rows : of the frames of each segment, key first, in the trajectory, which has so many ``frames``.
    """
    out, shared = Chained.unposed(frames), segments[0].shared.shape[2]
    none = np.zeros((6, 6)), np.zeros((6, shared + segments[0].calibration.shape[2]))
    world, (own, common), broken, piece = levels[0], none, True, -1

    def put(row: int, number: int) -> None:
        without = own + common[:, :shared] @ common[:, :shared].T
        out.poses[row], out.covariance[row], out.own_covariance[row] = world.matrix34, own + common @ common.T, without
        out.segment[row], out.piece[row] = number, piece

    for number, (segment, level, at) in enumerate(zip(segments, levels, rows, strict=True)):
        if broken:
            world, (own, common), piece = level, none, piece + 1
            put(at[0], number)
        # Once a segment: over thousands of products rounding would bend the rotation.
        T_world_local = world @ level.inverse()
        T_world_local = RigidTransform(orthonormal(T_world_local.rotation), T_world_local.translation)
        key, key_own, key_common = world, own, common
        for k in range(1, len(at)):
            if broken := not np.isfinite(segment.poses[k]).all():
                continue
            world = T_world_local @ RigidTransform.from_matrix(segment.poses[k])
            lever, turn = propagation(key, T_world_local, world)
            alone = segment.covariance[k] - segment.shared[k] @ segment.shared[k].T
            # Own errors add as variances; those of one cause go together in all segments, so their roots add first.
            own = lever @ key_own @ lever.T + turn @ alone @ turn.T
            # Rounding makes the two halves of the product differ, and more so from frame to frame.
            own = 0.5 * (own + own.T)
            common = lever @ key_common + turn @ np.hstack([segment.shared[k], segment.calibration[k]])
            put(at[k], number)
    _lose_single_frames(out)
    return out


def _lose_single_frames(found: Chained) -> None:
    """A frame that is a piece by itself is lost like others, unless there is nothing else; pieces count on from 0."""
    count = np.bincount(found.piece[found.piece >= 0])
    kept = np.flatnonzero(count > 1) if (count > 1).any() else np.arange(1)
    there = np.isin(found.piece, kept)
    for value in vars(found).values():
        value[~there] = -1 if value.dtype == np.int16 else np.nan
    found.piece[there] = np.searchsorted(kept, found.piece[there])


def propagation(key: RigidTransform, T_world_local: RigidTransform, world: RigidTransform) -> tuple[Floats, Floats]:
    """Return the Jacobians (6, 6) of a world pose by the error of its key frame, and by its error in the local frame.

    The key's rotation error swings the frame about the key's position (first order): with the lever
    ``r = C_frame - C_key``, ``dC = dC_key + dtheta_key x r + R dC_local`` and ``dtheta = dtheta_key + R dtheta_local``.
    """
    lever = np.eye(6)
    lever[:3, 3:] = -cross_matrix(world.translation - key.translation)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = T_world_local.rotation
    return lever, turn


def world_poses(trajectory: Bundle, piece: int | None = None) -> Floats:
    """Poses (frame, 3, 4) of the piece whose frame is the world, or of another one in its own; NaN elsewhere."""
    wanted = trajectory.meta["main"] if piece is None else piece
    return np.where((np.asarray(trajectory["piece"]) == wanted)[:, None, None], trajectory["poses"], np.nan)


def _level(found: Chained, piece: int, up: Floats) -> None:
    """Turn a piece so that ``up`` (3,) of its frame becomes z; y is ahead of its first camera."""
    rows = np.flatnonzero(found.piece == piece)
    R = found.poses[rows[0], :, :3]
    turn = level_rotation(R.T @ up) @ R.T
    # Position and rotation vector turn alike.
    both = np.kron(np.eye(2), turn)
    found.poses[rows] = turn @ found.poses[rows]
    for covariance in (found.covariance, found.own_covariance):
        covariance[rows] = both @ covariance[rows] @ both.T


def _level_pieces(found: Chained, keys: Sequence[int], levels: Sequence[Bundle]) -> list[str]:
    """Level pieces by the first of their pairs that knows the vertical; the source of each piece's vertical.

    ``keys`` are the rows of the pairs that ``levels`` are of.
    """
    sources = []
    for piece in range(int(found.piece.max()) + 1):
        mine = [(key, level) for key, level in zip(keys, levels, strict=True) if found.piece[key] == piece]
        known = [(key, level.meta) for key, level in mine if level.meta["source"] != NO_VERTICAL]
        if known and known[0][0] != mine[0][0]:
            key, meta = known[0]
            R_local_left = RigidTransform.from_matrix(meta["T_local_left"]).rotation
            _level(found, piece, found.poses[key, :, :3] @ R_local_left[2])
        sources.append(known[0][1]["source"] if known else NO_VERTICAL)
    return sources


def _odd_verticals(
    frames: Sequence[int], found: Chained, keys: Sequence[int], levels: Sequence[Bundle]
) -> Iterator[str]:
    """Lines on pieces whose vertical is that of the ground of their first pair, and not that of the others' ground.

    ``keys`` are the rows of the pairs that ``levels`` are of.
    """
    for piece in range(int(found.piece.max()) + 1):
        tilts = dict[int, float]()
        for key, level in zip(keys, levels, strict=True):
            if found.piece[key] == piece and level.meta["source"] == GROUND_PLANE:
                up = found.poses[key, :, :3] @ RigidTransform.from_matrix(level.meta["T_local_left"]).rotation[2]
                tilts[frames[key]] = math.degrees(math.atan2(math.hypot(up[0], up[1]), up[2]))
        # 5.0 degrees: on a street and in a hall it is at most 2.7, by bad matches 5 to 28.
        odd = [frame for frame, tilt in tilts.items() if tilt > 5.0]
        if odd:
            yield (
                f"by the ground of {len(odd)} of {len(tilts)} pairs, first pair {odd[0]}, the vertical is off by up to "
                f"{max(tilts.values()):.0f} degrees: the ground bends, or is matched badly, and slopes and hazards are "
                "wrong; state world.up or world.pitch_deg, or give an attitude"
            )


def account(frames: list[int], found: Chained, causes: Mapping[int, str], verticals: Sequence[str]) -> dict[str, Any]:
    """Facts of a trajectory, and lines on what it lacks and on its motion.

    Positions, pieces with their ``verticals``, and the ``causes`` of frames that are lost or begin a piece.
    """
    piece = found.piece
    main = int(np.argmax(np.bincount(piece[piece >= 0], minlength=1)))  # the first of the largest
    members = [np.flatnonzero(piece == k) for k in range(int(piece.max()) + 1)]
    begun = [frames[k] for k in (*np.flatnonzero(piece < 0), *(rows[0] for rows in members[1:]))]
    facts = {
        # Facts are JSON, which has no NaN.
        "positions": [[float(v) for v in p[:, 3]] if np.isfinite(p).all() else None for p in found.poses],
        "verticals": list(verticals),
        "pieces": [[frames[k] for k in rows] for rows in members],
        "main": main,
        "causes": {str(frame): causes[frame] for frame in begun if frame in causes},
    }
    motion = doubtful_motion(found.poses[members[main]], found.covariance[members[main]])
    return facts | {"warnings": [*_lost(frames, piece, causes), *_missing(facts, causes), *motion]}


VIEW_MOVES = "; the view moves by "
"""Behind the cause for which a frame is lost, how far its view lies from that of the frame before."""


def _lost(frames: Sequence[int], piece: NDArray[np.int16], causes: Mapping[int, str]) -> Iterator[str]:
    """Lines on frames without a pose: one for those in a row that have one cause, but for figures and how each view
    moves."""
    posed, fates = np.flatnonzero(piece >= 0), list[tuple[int, str, str]]()
    for row in np.flatnonzero(piece < 0).tolist():
        behind = int(np.searchsorted(posed, row))
        sides = posed[behind - 1 : behind + 1] if behind else posed[:0]
        # Bridged: the frames on both sides are of one piece, tracked across.
        bridged = len(sides) == 2 and piece[sides[0]] == piece[sides[1]]
        how = f"bridged from {frames[sides[0]]} to {frames[sides[1]]}" if bridged else "no pose"
        fates.append((row, causes.get(frames[row], "no frame beside it could be posed with it"), how))
    words = [cause.partition(VIEW_MOVES)[0] for _, cause, _ in fates]
    keys = [(row - k, re.sub(r"[0-9.]+", "#", words[k]), how) for k, (row, _, how) in enumerate(fates)]
    for _, group in groupby(zip(keys, words, fates, strict=True), itemgetter(0)):
        (_, cause, (row, whole, how)), *others = group
        if others:
            like = "" if all(other == cause for _, other, _ in others) else ", the first"
            yield f"frames {frames[row]}-{frames[others[-1][2][0]]} lost{like}: {cause}; {how}"
        else:
            yield f"frame {frames[row]} lost: {whole}; {how}"


def _missing(facts: Mapping[str, Any], causes: Mapping[int, str]) -> Iterator[str]:
    """Lines on where a trajectory is broken, and on pieces without a vertical, by the facts of :func:`account`."""
    pieces = facts["pieces"]
    if len(pieces) > 1:
        words = ", ".join(f"piece {k}: frames {spans(piece)}" for k, piece in enumerate(pieces, start=1))
        where = ", ".join(f"before frame {a} ({causes.get(a, 'no motion found')})" for a, *_ in pieces[1:])
        world = f"each in its own frame, the world is that of piece {facts['main'] + 1}, the largest"
        yield f"the trajectory is broken {where}: {words}; {world}"
    for piece, source in zip(pieces, facts["verticals"], strict=True):
        if source == NO_VERTICAL:
            world = f"their world is that of camera {piece[0]}, whose own up is z"
            yield f"nothing tells of the vertical at frames {spans(piece)}: {world}"


def _moved(frames: list[int], steps: Sequence[tuple[float | None, float]]) -> dict[int, str]:
    """How far the view of each frame lies from that of the frame before, in words: radians and share found again."""
    return {
        b: f"{VIEW_MOVES}{math.degrees(turn):.0f} degrees from frame {a}, {share:.0%} of it is found again"
        for (a, b), (turn, share) in zip(pairwise(frames), steps, strict=True)
        if turn is not None
    }


class TrajectoryInputs(NamedTuple):
    """Segments, levels of their key frames, and the segments' errors of the calibration."""

    segments: Sequence[Bundle[ResectFacts]]
    levels: Sequence[Bundle[GroundFacts]]
    intrinsics: Bundle[IntrinsicsFacts] | None = None


@stage(
    "trajectory",
    outputs=[
        replace(POSES, frame="world"),
        replace(COVARIANCE, frame="world"),
        replace(OWN_COVARIANCE, frame="world"),
        Array("segment", ("frame",), "int16", "1", "segment that posed the frame, -1: lost", "-1"),
        Array("piece", ("frame",), "int16", "1", "unbroken piece, each in its own frame; -1: lost", "-1"),
    ],
)
def trajectory_stage(
    params: NoParams,
    inputs: TrajectoryInputs,
    *,
    frames: list[int],
    lost: Sequence[Mapping[str, Any]] = (),
    steps: Sequence[tuple[float | None, float]] | None = None,
) -> Bundle[TrajectoryFacts]:
    """Poses of all left frames in the world frame."""
    levels = [RigidTransform.from_matrix(b.meta["T_local_left"]) for b in inputs.levels]
    links = [ChainLink.of(b, inputs.intrinsics) for b in inputs.segments]
    parts = [b.meta["per_frame"] for b in inputs.segments]
    if not parts:
        # One pair alone, behind lost frames, if some are.
        gone = {int(one["frame"]) for one in lost}
        links = [ChainLink(levels[0].matrix34[None], np.zeros((1, 6, 6)), *np.zeros((2, 1, 6, 0)))]
        parts = [[{"frame": next(f for f in frames if f not in gone), "inliers": 0}]]
    # A key frame was posed by the segment before.
    facts = [*parts[0][:1], *(fact for part in parts for fact in part[1:])]
    causes = {int(f["frame"]): str(f["cause"]) for f in lost}
    causes |= {int(f["frame"]): str(f["lost"]) for f in facts if "lost" in f}
    if steps is not None:
        through = [f for f in frames if f not in {int(one["frame"]) for one in lost}]
        moved = _moved(through, steps)
        causes = {f: cause + moved.get(f, "") for f, cause in causes.items()}
    row = {frame: k for k, frame in enumerate(frames)}
    rows = [[row[int(f["frame"])] for f in part] for part in parts]
    found = chain(links, levels, rows, len(frames))
    verticals = _level_pieces(found, [at[0] for at in rows], inputs.levels)
    inliers = {int(f["frame"]): int(f["inliers"]) for f in facts}
    odd = list(_odd_verticals(frames, found, [at[0] for at in rows], inputs.levels))
    meta: TrajectoryFacts = {
        "frames": frames,
        "inliers": [inliers.get(f, 0) for f in frames],
        **account(frames, found, causes, verticals),  # type: ignore[typeddict-item]
        "odd_verticals": odd,
    }
    meta["warnings"] += odd
    return Bundle(vars(found), meta)
