"""Trajectory: the running product of the segments' poses (sections 5.2.2 and 7.4).

Each segment is resected in the local frame of its own basic pair, which was levelled without any knowledge of the
others; only the *relative* poses within it matter here. The world is the local frame of pair 0. With ``k`` the key
frame of a segment and ``i`` another of its frames,

    T_world_left(i) = T_world_left(k) T_local_left(k)^-1 T_local_left(i),

so that ``T_world_local(k) = T_world_left(k) T_local_left(k)^-1`` whatever the levelling of pair k is. The next
segment's key frame is the last frame of this one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.declare import Array, Bundle, Inputs, NoParams, Stage
from stages.errors import InputError
from stages.geometry import RigidTransform, orthonormal
from stages.reprojection import cross_matrix

Floats = NDArray[np.float64]


def chain(
    segments: Sequence[tuple[Floats, Floats]], levels: Sequence[RigidTransform]
) -> tuple[Floats, Floats, NDArray[np.int16]]:
    """Compose the poses of segments into one trajectory.

    Parameters
    ----------
    segments : poses (frames, 3, 4) T_local_left and covariances (frames, 6, 6) of each, key frame first; none for a
        sequence of one pair.
    levels : T_local_left of each segment's key frame by its own level stage; of the only pair without segments.

    Returns
    -------
    poses : (all frames, 3, 4) T_world_left, m.
    covariance : (all frames, 6, 6) of (position m, rotation rad) in the world frame.
    segment : (all frames,) the segment that posed the frame; a key frame belongs to the segment before it.

    Raises
    ------
    InputError
        Not one level a segment, or a segment whose key pose is not its level's.
    """
    if len(levels) != max(len(segments), 1):
        raise InputError(f"{len(segments)} segments and {len(levels)} levels do not make a trajectory")
    world, cov = levels[0], np.zeros((6, 6))
    poses, covariances, owner = [world.matrix34], [cov], [0]
    for number, ((local, local_cov), level) in enumerate(zip(segments, levels, strict=False)):
        if np.abs(local[0] - level.matrix34).max() > 1e-9 * max(1.0, float(np.abs(local[0]).max())):
            raise InputError(f"segment {number} was not resected in the local frame of its own basic pair")
        T_world_local = _clean(world @ level.inverse())
        key, key_cov = world, cov
        for pose, pose_cov in zip(local[1:], local_cov[1:], strict=True):
            world = T_world_local @ RigidTransform.from_matrix(pose)
            cov = propagate(key, key_cov, T_world_local, pose_cov, world)
            poses.append(world.matrix34)
            covariances.append(cov)
            owner.append(number)
    return np.array(poses), np.array(covariances), np.array(owner, dtype=np.int16)


def propagate(
    key: RigidTransform, key_cov: Floats, T_world_local: RigidTransform, local_cov: Floats, world: RigidTransform
) -> Floats:
    """Covariance (6, 6) in the world of a frame that was resected against the key frame.

    The key's rotation error swings the frame about the key's position (first order): with the lever
    ``r = C_frame - C_key``, ``dC = dC_key + dtheta_key x r + R dC_local`` and ``dtheta = dtheta_key + R dtheta_local``.
    """
    lever = np.eye(6)
    lever[:3, 3:] = -cross_matrix(world.translation - key.translation)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = T_world_local.rotation
    total = lever @ key_cov @ lever.T + turn @ local_cov @ turn.T
    return np.asarray(0.5 * (total + total.T))


def _clean(T: RigidTransform) -> RigidTransform:
    """Undo what rounding does to the rotation of a long product."""
    return RigidTransform(orthonormal(T.rotation), T.translation)


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    levels = [RigidTransform.from_matrix(b.meta["T_local_left"]) for b in inputs["levels"]]
    segments = [(np.asarray(b["poses"]), np.asarray(b["covariance"])) for b in inputs["segments"]]
    poses, covariance, segment = chain(segments, levels)
    facts: list[dict[str, Any]] = []
    for bundle in inputs["segments"]:
        facts += bundle.meta["per_frame"][1 if facts else 0 :]
    if not facts:
        facts = [{"frame": int(f), "inliers": 0} for f in args["frames"]]
    return Bundle(
        {"poses": poses, "covariance": covariance, "segment": segment},
        {
            "frames": [f["frame"] for f in facts],
            "inliers": [f["inliers"] for f in facts],
            "positions": [[float(v) for v in pose[:, 3]] for pose in poses],
        },
    )


STAGE = Stage(
    name="trajectory",
    version=1,
    summary="poses of all left frames in the world frame",
    params=NoParams,
    inputs=("segments*", "levels*"),
    outputs=(
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", frame="world"),
        Array(
            "covariance",
            ("frame", "parameter", "parameter_b"),
            "float64",
            "m^2, m rad, rad^2",
            "covariance of position and rotation vector",
            frame="world",
        ),
        Array("segment", ("frame",), "int16", "1", "segment that posed the frame"),
    ),
    requires=("numpy",),
    run=_run,
)
