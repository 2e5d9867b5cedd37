"""Windows of the crosscheck to one trajectory, by the frames that they share.

Every window is metric by its baseline, so that a rotation and a translation join two of them; a change of scale would
hide what the crosscheck is to show. Where windows share no frame with a pose in both, the chain breaks: each piece
keeps a frame of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.evaluation.accuracy import angles_between
from rille.stages.evaluation.accuracy_parts import posed, rms
from rille.stages.evaluation.pose_alignment import align, moved
from rille.stages.facts.evaluation import JoinFacts, WindowFacts
from rille.stages.geometry.geometry import orthonormal

ORIENTATION_SHARE = 1.0
"""Orientations weigh like positions: over the few metres that windows share they are the better compass."""


def join(
    frames: Sequence[int], parts: Sequence[tuple[Sequence[int], Floats]]
) -> tuple[Floats, NDArray[np.int16], list[dict[str, Any]]]:
    """Chain windows in order.

    Parameters
    ----------
    frames : all frame numbers.
    parts : frame numbers and poses (frame, 3, 4) T_window_left of each window, NaN where a frame has none.

    Returns
    -------
    poses : (frames, 3, 4) T_piece_left; over the shared frames one window fades into the other, so that what they
        differ by does not look like a jump.
    piece : (frames,) number of the piece, -1 where there is no pose.
    ties : a row for each join: its ``frames``, and how far the shared poses differ afterwards (``rms_m``,
        ``rms_deg``).
    """
    row = {frame: k for k, frame in enumerate(frames)}
    poses, piece = np.full((len(frames), 3, 4), np.nan), np.full(len(frames), -1, np.int16)
    ties: list[dict[str, Any]] = []
    number = -1
    for numbers, local in parts:
        rows, there = np.array([row[f] for f in numbers], dtype=np.intp), posed(local)
        if not there.any():
            continue
        # Shared with the piece at hand; frames of an earlier one tie nothing, for that chain is broken.
        shared = there & (piece[rows] == number) & (number >= 0)
        if shared.any():
            rotation, translation = align(local[shared], poses[rows[shared]], ORIENTATION_SHARE)
            local = moved(local, rotation, translation)
            ties.append(
                _tie([f for f, both in zip(numbers, shared, strict=True) if both], local[shared], poses[rows[shared]])
            )
            local[shared] = _fade(poses[rows[shared]], local[shared])
        else:
            number += 1
        poses[rows[there]], piece[rows[there]] = local[there], number
    return poses, piece, ties


def _fade(earlier: Floats, later: Floats) -> Floats:
    """Poses (n, 3, 4) that go over from the earlier to the later ones; they differ by little."""
    n = len(earlier)
    share = (np.arange(1, n + 1) / (n + 1))[:, None, None]
    out = (1.0 - share) * earlier + share * later
    for pose in out:
        # A weighted mean of rotations is none, but nearly: the nearest one is taken.
        pose[:, :3] = orthonormal(pose[:, :3])
    return np.asarray(out)


def _tie(frames: list[int], a: Floats, b: Floats) -> dict[str, Any]:
    shift, turn = a[:, :, 3] - b[:, :, 3], angles_between(a, b)
    return {
        "frames": frames,
        "rms_m": rms(shift),
        "rms_deg": float(np.degrees(np.sqrt(np.mean(turn**2)))),
    }


_POSES = ("frame", "row", "col")


_OF_A_WINDOW: tuple[Literal["frames", "registered", "points", "reason"], ...]
_OF_A_WINDOW = ("frames", "registered", "points", "reason")


@stage(
    "crosscheck_join",
    outputs=[
        Array("poses", _POSES, "float64", "m", "pose [R | t] of the left camera, longest piece", "nan", "crosscheck"),
        Array("piece_poses", _POSES, "float64", "m", "the same of all pieces", "nan", "crosscheck piece"),
        Array("piece", ("frame",), "int16", "1", "unbroken piece that the frame belongs to", "-1"),
    ],
)
def crosscheck_join_stage(
    params: NoParams, windows: Sequence[Bundle[WindowFacts]], *, frames: Sequence[int]
) -> Bundle[JoinFacts]:
    """Windows of the crosscheck to one trajectory."""
    parts = [(list(b.meta["frames"]), np.asarray(b["poses"])) for b in windows]
    chained, piece, ties = join(frames, parts)
    lengths = np.bincount(piece[piece >= 0])
    longest = int(lengths.argmax()) if lengths.size else -1
    poses = np.where((piece == longest)[:, None, None] & (longest >= 0), chained, np.nan)
    meta: JoinFacts = {
        "frames": list(frames),
        "registered": int((piece >= 0).sum()),
        "unregistered": [f for f, p in zip(frames, piece, strict=True) if p < 0],
        "longest": longest,
        "pieces": [[f for f, p in zip(frames, piece, strict=True) if p == k] for k in range(len(lengths))],
        "ties": ties,
        "points": sum(b.meta["points"] for b in windows),
        "windows": [{k: b.meta[k] for k in _OF_A_WINDOW} for b in windows],
        "positions": [None if not np.isfinite(p).all() else [float(v) for v in p[:, 3]] for p in poses],
    }
    return Bundle({"poses": poses, "piece_poses": chained, "piece": piece}, meta)
