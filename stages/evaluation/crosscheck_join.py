"""One trajectory of the crosscheck's windows, joined by the frames that they share.

Every window is metric by the baseline, so that a rotation and a translation join two of them; a scale would hide errors
that the crosscheck is to show. Where windows share no frame with a pose in both, the chain breaks: each piece has its
own frame of reference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.facts.evaluation import JoinFacts, WindowFacts
from rille.stages.geometry.geometry import orthonormal
from rille.stages.geometry.rigid import alignment, by_frame, compose, posed


def join(frames: Sequence[int], parts: Sequence[tuple[Sequence[int], Floats]]) -> tuple[Floats, NDArray[np.int16]]:
    """Poses of windows chained in order, and their pieces.

    Parameters
    ----------
    frames : all frame numbers.
    parts : frame numbers and poses (frame, 3, 4) T_window_left of each window, NaN where a frame has none.

    Returns
    -------
    poses : (frames, 3, 4) T_piece_left; over the shared frames one window fades into the other, so that their
        difference does not look like a jump.
    piece : (frames,) number of the piece, -1 where there is no pose.
    """
    poses, piece = np.full((len(frames), 3, 4), np.nan), np.full(len(frames), -1, np.int16)
    number = -1
    for numbers, part in parts:
        local = by_frame(part, numbers, frames)
        there = posed(local)
        if not there.any():
            continue
        # Shared with the current piece; frames of earlier ones do not join, since that chain is broken.
        shared = there & (piece == number) & (number >= 0)
        if shared.any():
            # Orientations weigh like positions: over the few metres that windows share they determine the turn better.
            local = compose(alignment(local[shared], poses[shared], 1.0), local)
            local[shared] = _fade(poses[shared], local[shared])
        else:
            number += 1
        poses[there], piece[there] = local[there], number
    return poses, piece


def _fade(earlier: Floats, later: Floats) -> Floats:
    """Poses (n, 3, 4) that change gradually from the earlier to the later ones, which differ little."""
    n = len(earlier)
    share = (np.arange(1, n + 1) / (n + 1))[:, None, None]
    out = (1.0 - share) * earlier + share * later
    for pose in out:
        # A weighted mean of rotations is nearly a rotation: take the nearest one.
        pose[:, :3] = orthonormal(pose[:, :3])
    return np.asarray(out)


@stage(
    "crosscheck_join",
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", "nan", "piece"),
        Array("piece", ("frame",), "int16", "1", "unbroken piece that the frame belongs to", "-1"),
        Array("line_distance", ("frame",), "float64", "px", "median of the matches from their epipolar lines", "nan"),
    ],
)
def crosscheck_join_stage(
    params: NoParams, windows: Sequence[Bundle[WindowFacts]], *, frames: Sequence[int]
) -> Bundle[JoinFacts]:
    """Windows of the crosscheck to one trajectory."""
    chained, piece = join(frames, [(b.meta["frames"], np.asarray(b["poses"])) for b in windows])
    # Equal in all windows that have the frame.
    line = np.full(len(frames), np.nan)
    for b in windows:
        line = np.fmax(line, by_frame(np.asarray(b["line_distance"]), b.meta["frames"], frames))
    pieces = [[f for f, p in zip(frames, piece, strict=True) if p == k] for k in range(int(piece.max(initial=-1)) + 1)]
    longest = int(np.argmax([len(one) for one in pieces])) if pieces else -1
    meta: JoinFacts = {
        "frames": list(frames),
        "main": longest,
        "pieces": pieces,
        "reasons": [b.meta["reason"] for b in windows if b.meta["reason"]],
    }
    return Bundle({"poses": chained, "piece": piece, "line_distance": line}, meta)
