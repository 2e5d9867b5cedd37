"""Disagreement of the trajectory and the crosscheck's, frame by frame.

The crosscheck's poses are aligned with ours by one rotation and translation, without scale (one for each unbroken
piece); the rest is the disagreement. Where the two disagree, one of them is wrong. Errors of the calibration, which
both share, do not show: a wrong baseline stretches both alike. But a frame whose two images fit the given rig worse
than those of all others is flagged as well, even if its pose is right by the left image alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.facts.evaluation import AgreementFacts, JoinFacts, metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry import rigid
from rille.stages.geometry.rigid import rms
from rille.stages.numeric.robust import mad_sigma

MIN_SIGMAS, MIN_RATIO = 5.0, 2.0
"""Robust standard deviations above the median, and multiple of the median, below which no frame is flagged."""


class Reason(NamedTuple):
    """Reason to flag a frame: its bit of ``flagged``, in words, and the least value that counts."""

    bit: int
    words: str
    least: float


REASONS: Mapping[str, Reason] = {
    "distance": Reason(1, "position", 1e-9),
    "angle": Reason(2, "rotation", math.radians(0.05)),
    "step_distance": Reason(4, "motion since the frame before", 1e-9),
    "step_angle": Reason(8, "rotation since the frame before", math.radians(0.05)),
    "line_distance": Reason(16, "left and right image do not fit the rig", 1.0),
}
"""Reasons by the array (frame,) that they are judged by. Less than 1e-9 m is rounding; 0.05 degrees are a pixel at a
focal length of 1100 pixels."""


def compare(
    ours: Floats, theirs: Floats, piece: NDArray[np.integer[Any]]
) -> tuple[dict[str, Floats], float | None, float | None]:
    """Disagreement of two trajectories, and the scale between them.

    Parameters
    ----------
    ours : (frame, 3, 4) T_world_left, m; NaN where a frame has no pose.
    theirs : (frame, 3, 4) T_piece_left of the same frames.
    piece : (frame,) piece that a frame of ``theirs`` belongs to, -1 where it has none.

    Returns
    -------
    Arrays ``poses`` (frame, 3, 4): theirs in the world; ``distance`` m, ``angle`` rad of each frame; ``step_distance``
    m, ``step_angle`` rad of the motion since the frame before. NaN where not both have poses, or a piece shares fewer
    than two frames with ours. The scale that would fit theirs to ours best (None for a camera at rest, which is aligned
    by orientations alone), and the RMS disagreement of positions with it, m.
    """
    n = len(ours)
    arrays = {name: np.full(n, np.nan) for name in ("distance", "angle", "step_distance", "step_angle")}
    laid, there, centred = np.full((n, 3, 4), np.nan), rigid.posed(ours), [np.zeros((2, 0, 3))]
    for number in range(int(piece.max(initial=-1)) + 1):
        rows = np.flatnonzero(there & (piece == number))
        if len(rows) < 2:
            continue
        # Only frames whose predecessor is in the piece too: a step over a gap is no motion between frames. Errors of
        # motions are in the frame before, and so independent of the alignment.
        second = rows[1:][np.diff(rows) == 1]
        E = rigid.relative_error(*(rigid.motion(poses, second - 1, second) for poses in (theirs, ours)))
        arrays["step_distance"][second] = np.linalg.norm(E[:, :, 3], axis=1)
        arrays["step_angle"][second] = rigid.angle(E)
        rests = at_rest(ours[rows], arrays["step_distance"][second])
        # Positions of a camera at rest are noise, and would turn the alignment at random. Otherwise they decide it, as
        # in an absolute trajectory error.
        share = math.inf if rests else 0.1
        laid[piece == number] = rigid.compose(rigid.alignment(theirs[rows], ours[rows], share), theirs[piece == number])
        if not rests:
            both = np.stack([laid[rows, :, 3], ours[rows, :, 3]])
            centred.append(both - both.mean(axis=1, keepdims=True))
    arrays["distance"] = np.linalg.norm(laid[:, :, 3] - ours[:, :, 3], axis=1)
    arrays["angle"] = rigid.angles_between(laid, ours)
    # Least squares of b = s a over all pieces together, because one rig has one scale.
    a, b = np.concatenate(centred, axis=1)
    cross, square = float((a * b).sum()), float((a * a).sum())
    scale = cross / square if square > 0 and cross > 0 else None
    return arrays | {"poses": laid}, scale, None if scale is None else rms(b - scale * a)


def at_rest(poses: Floats, step_distance: Floats) -> bool:
    """Whether the spread of positions is small against the difference of the two trajectories from step to step."""
    # 10.0: ratio of the spread of positions to the error of a step below which a camera counts as at rest: its
    # positions then determine no rotation.
    return bool(step_distance.size and rigid.spread(poses) < 10.0 * np.sqrt(np.mean(step_distance**2)))


def leads_away(poses: Floats) -> bool:
    """Whether the last position lies farther from the first than by the noise of the steps."""
    steps = np.diff(poses[:, :, 3], axis=0)
    # 2.0 roots of the sum of squared steps: a random walk in three dimensions ends farther off in 0.7 % of cases.
    return bool(np.linalg.norm(steps.sum(axis=0)) > 2.0 * np.linalg.norm(steps))


def expected(covariance: Floats, piece: NDArray[np.integer[Any]]) -> dict[str, float]:
    """Disagreements of two trajectories whose errors both are as large as stated for ours, by the names of their
    arrays.

    Of a frame it is that of the RMS standard deviation; of a motion, that of the mean growth of the variance from frame
    to frame.

    Parameters
    ----------
    covariance : (frame, 6, 6) of (position m, rotation rad), grown from the first frame of its piece; NaN without one.
    piece : (frame,) piece of our trajectory, -1 without a pose.
    """
    out, joined = dict[str, float](), np.diff(piece) == 0
    for name, part in (("distance", slice(3)), ("angle", slice(3, 6))):
        variance = np.trace(covariance[:, part, part], axis1=1, axis2=2)
        for key, values in ((name, variance), (f"step_{name}", np.diff(variance)[joined])):
            known = values[np.isfinite(values)]
            # 2.0: the two errors are independent; those of the calibration, which both share, are not among them.
            out[key] = math.sqrt(2.0 * max(float(known.mean()), 0.0)) if known.size else 0.0
    return out


def flag(arrays: Mapping[str, Floats], sigmas: Mapping[str, float]) -> tuple[Bytes, dict[str, float | None]]:
    """Bits of :data:`REASONS` for each frame that stands out, and the limit of each disagreement (None: no values).

    The limit is the median plus :data:`MIN_SIGMAS` robust standard deviations, at least :data:`MIN_RATIO` medians, at
    least the value from which on the reason counts, and at least :data:`MIN_SIGMAS` of the :func:`expected` ones: of a
    few frames that happen to agree well, the median says little.
    """
    flags = np.zeros(len(arrays["distance"]), np.uint8)
    limits: dict[str, float | None] = dict.fromkeys(REASONS)
    for name, reason in REASONS.items():
        values = arrays[name][np.isfinite(arrays[name])]
        if values.size:
            median = float(np.median(values))
            least = max(reason.least, MIN_SIGMAS * sigmas.get(name, 0.0))
            limit = max(median + MIN_SIGMAS * mad_sigma(values), MIN_RATIO * median, least)
            flags[arrays[name] > limit] |= np.uint8(reason.bit)
            limits[name] = limit
    return flags, limits


def carried(piece: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """Piece (frame,) of each frame; frames without a pose (-1) belong to the piece of the posed frame before, or to the
    first one."""
    posed = np.flatnonzero(piece >= 0)
    if not posed.size:
        return piece
    return piece[posed[np.maximum(np.searchsorted(posed, np.arange(len(piece)), side="right") - 1, 0)]]


def unbroken(theirs: NDArray[np.int64], ours: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pieces (frame,) that are unbroken in both trajectories, -1 where the other program has none.

    A frame without our pose belongs to our piece before it, so that the other program's pose of it is shown.
    """
    # A piece is a pair of piece numbers, ours and theirs, numbered anew.
    pairs = np.stack([theirs, carried(ours)])
    return np.where(theirs >= 0, np.unique(pairs, axis=1, return_inverse=True)[1].reshape(-1), -1)


@stage(
    "agreement",
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "crosscheck's poses in the world", "nan", "world"),
        Array("distance", ("frame",), "float64", "m", "disagreement in position", "nan"),
        Array("angle", ("frame",), "float64", "rad", "disagreement in rotation", "nan"),
        Array("step_distance", ("frame",), "float64", "m", "disagreement in the motion since the frame before", "nan"),
        Array("step_angle", ("frame",), "float64", "rad", "the same, rotation", "nan"),
        Array("line_distance", ("frame",), "float64", "px", "median of the matches from their epipolar lines", "nan"),
        Array("flagged", ("frame",), "uint8", "1", "bits: 1 position, 2 rotation, 4 and 8 those of a step, 16 rig"),
    ],
)
def agreement_stage(
    params: NoParams, trajectory: Bundle[TrajectoryFacts], crosscheck: Bundle[JoinFacts]
) -> Bundle[AgreementFacts]:
    """Trajectory against the crosscheck's."""
    frames, given, ours = trajectory.meta["frames"], crosscheck.meta["frames"], np.asarray(trajectory["poses"])
    theirs, numbers, lines = (
        rigid.by_frame(np.asarray(crosscheck[name]), given, frames) for name in ("poses", "piece", "line_distance")
    )
    own = np.asarray(trajectory["piece"], np.int64)
    piece = unbroken(np.nan_to_num(numbers, nan=-1).astype(np.int64), own)
    arrays, scale, scaled = compare(ours, theirs, piece)
    arrays["line_distance"] = lines
    # Without errors of the calibration, which both share.
    stated = np.asarray(trajectory["own_covariance"], np.float64)
    flags, limits = flag(arrays, expected(stated, own))
    compared = np.isfinite(arrays["distance"])
    # Each of our pieces has its own frame of reference: no path leads from one to the next.
    there = np.diff(own[compared]) == 0
    length = float(np.linalg.norm(np.diff(ours[compared, :, 3], axis=0), axis=1)[there].sum())
    apart = {name: rms(values[np.isfinite(values), None]) for name, values in arrays.items() if name in REASONS}
    share: float | str | None = 100.0 * apart["distance"] / length if length > 0 else None
    moves = leads_away(ours[compared]) or leads_away(arrays["poses"][compared])
    if not moves and at_rest(ours[compared], arrays["step_distance"][np.isfinite(arrays["step_distance"])]):
        share = "the camera was at rest"
    of, after = "RMS disagreement of", "after one rotation and translation, no scale"
    best = "scale that would fit the crosscheck to ours best; 1 where both agree"
    figures = {
        "rmse": metric(apart["distance"], "m", f"{of} positions {after}"),
        "rmse_rotation": metric(math.degrees(apart["angle"]), "deg", f"{of} orientations {after}"),
        "step_rmse": metric(apart["step_distance"], "m", f"{of} the motion between successive frames"),
        "step_rmse_rotation": metric(math.degrees(apart["step_angle"]), "deg", "the same, rotation"),
        "length": metric(length, "m", "length of our trajectory over the compared frames"),
        "share": metric(share, "%", "rmse over the length"),
        "scale_ratio": metric(scale, "1", best),
        "rmse_scaled": metric(scaled, "m", f"{of} positions with that scale"),
    }
    meta: AgreementFacts = {
        "frames": frames,
        "compared": int(compared.sum()),
        "pieces": len(crosscheck.meta["pieces"]),
        "metrics": figures,
        "rule": f"disagreement above the median by more than {MIN_SIGMAS:g} robust standard deviations "
        f"(1.4826 MAD), and above {MIN_RATIO:g} medians; in position, rotation (from "
        f"{math.degrees(REASONS['angle'].least):g}° on), or the "
        f"motion since the frame before, in all of them by more than {MIN_SIGMAS:g} standard deviations as stated; "
        "or matches of left and right as far "
        f"(from {REASONS['line_distance'].least:g} px on) from their epipolar lines",
        "limits": {n: v if v is None or "angle" not in n else math.degrees(v) for n, v in limits.items()},
        "flagged": [
            {"frame": f, "why": [reason.words for reason in REASONS.values() if bits & reason.bit]}
            for f, bits in zip(frames, flags.tolist(), strict=True)
            if bits
        ],
    }
    out: dict[str, AnyArray] = {**arrays, "flagged": flags}
    return Bundle(out, meta)
