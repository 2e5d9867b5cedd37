"""Trajectory against the crosscheck's: how far apart two independent answers are, frame by frame.

The crosscheck's poses are laid on ours by one rotation and translation, without scale (each unbroken piece by its
own); what remains is the disagreement. It does not say who is wrong, but where the two part, one of them is. What both
share, the given calibration, it cannot judge: a wrong baseline stretches both alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, Params, stage
from rille.stages.evaluation.accuracy import angles_between, by_frame
from rille.stages.evaluation.accuracy_parts import angle, metric, posed, relative_error, rms, square
from rille.stages.evaluation.pose_alignment import align, moved, spread
from rille.stages.facts.evaluation import AgreementFacts, JoinFacts, Metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.numeric.robust import mad_sigma

ORIENTATION_SHARE = 0.1
"""Positions decide the alignment, as in an absolute trajectory error; orientations only where positions cannot."""

REST = 10.0
"""Ratio of the spread of positions to the error of a step below which a camera counts as at rest: its positions then
determine no rotation."""

MIN_RATIO = 2.0
"""Of the median, below which no frame is flagged."""

MIN_ANGLE_DEG = 0.05
"""Rotation difference below which no frame is flagged: one pixel at a focal length of 1100."""

REASONS: Mapping[str, tuple[int, str]] = {
    "distance": (1, "position"),
    "angle": (2, "rotation"),
    "step_distance": (4, "motion since the frame before"),
    "step_angle": (8, "rotation since the frame before"),
}
"""Disagreements by array: bit of ``flagged``, and the reason in words."""


class AgreementParams(Params):
    """When a frame is flagged."""

    threshold: float = Field(
        5.0, gt=0, description="robust standard deviations above the median from which on a frame is flagged"
    )


def compare(ours: Floats, theirs: Floats, piece: NDArray[np.integer[Any]]) -> tuple[dict[str, Floats], dict[str, Any]]:
    """Disagreement of two trajectories.

    Parameters
    ----------
    ours : (frame, 3, 4) T_world_left, m; NaN where a frame has no pose.
    theirs : (frame, 3, 4) T_piece_left of the same frames.
    piece : (frame,) piece that a frame of ``theirs`` belongs to, -1 where it has none.

    Returns
    -------
    Arrays ``poses`` (frame, 3, 4): theirs in the world; ``distance`` m, ``angle`` rad of each frame; ``step_distance``
    m, ``step_angle`` rad of the motion since the frame before. NaN where not both have poses, or a piece shares fewer
    than two frames with us. Facts: ``scale_ratio``, the scale that would fit theirs to ours best (None for a camera
    at rest, whose orientations alone align it), and ``rmse_scaled_m`` with it.
    """
    n = len(ours)
    arrays = {name: np.full(n, np.nan) for name in REASONS} | {"poses": np.full((n, 3, 4), np.nan)}
    there, cross, square, left = posed(ours), 0.0, 0.0, []
    for number in range(int(piece.max(initial=-1)) + 1):
        rows = np.flatnonzero(there & (piece == number))
        if len(rows) < 2:
            continue
        _steps(arrays, ours, theirs, rows)
        rests = _at_rest(ours[rows], arrays["step_distance"][rows])
        # A camera at rest: its positions are noise, and would turn the alignment to any side.
        laid = moved(theirs, *align(theirs[rows], ours[rows], math.inf if rests else ORIENTATION_SHARE))
        arrays["poses"][piece == number] = laid[piece == number]
        arrays["distance"][rows] = np.linalg.norm(laid[rows, :, 3] - ours[rows, :, 3], axis=1)
        arrays["angle"][rows] = angles_between(laid[rows], ours[rows])
        a, b = (p[rows, :, 3] - p[rows, :, 3].mean(axis=0) for p in (laid, ours))
        if not rests:
            cross, square = cross + float(np.sum(a * b)), square + float(np.sum(a * a))
            left.append((a, b))
    # Least squares of b = s a over all pieces at once, for one rig has one scale.
    scale = cross / square if square > 0 and cross > 0 else None
    rest = np.concatenate([b - scale * a for a, b in left]) if scale is not None else None
    return arrays, {"scale_ratio": scale, "rmse_scaled_m": None if rest is None else rms(rest)}


def _at_rest(poses: Floats, step_distance: Floats) -> bool:
    """Whether all positions lie within what the two trajectories differ by from step to step."""
    known = step_distance[np.isfinite(step_distance)]
    return bool(known.size and spread(poses) < REST * np.sqrt(np.mean(known**2)))


def _steps(arrays: dict[str, Floats], ours: Floats, laid: Floats, rows: NDArray[np.intp]) -> None:
    """Disagreement of the motions from frame to frame, in place; in the frame before, so free of the alignment."""
    # Frames whose neighbour before is in the piece as well: a step over a gap is no motion between frames.
    second = rows[1:][np.diff(rows) == 1]
    E = relative_error(square(laid), square(ours), second - 1, second)
    arrays["step_distance"][second] = np.linalg.norm(E[:, :3, 3], axis=1)
    arrays["step_angle"][second] = angle(E)


def flag(arrays: Mapping[str, Floats], params: AgreementParams) -> tuple[Bytes, dict[str, float | None]]:
    """Bits of :data:`REASONS` for each frame that stands out, and the limit of each disagreement (None: no values).

    The limit is the median plus ``threshold`` robust standard deviations, at least two medians, and for
    rotations at least :data:`MIN_ANGLE_DEG`.
    """
    flags = np.zeros(len(arrays["distance"]), np.uint8)
    limits: dict[str, float | None] = {}
    for name, (bit, _) in REASONS.items():
        values = arrays[name][np.isfinite(arrays[name])]
        if values.size == 0:
            limits[name] = None
            continue
        median = float(np.median(values))
        sigma = mad_sigma(values)
        # Where both agree to rounding, the robust deviation is nearly 0 and every frame would stand out.
        least = math.radians(MIN_ANGLE_DEG) if "angle" in name else 1e-9  # rounding is no reason
        limit = max(median + params.threshold * sigma, MIN_RATIO * median, least)
        limits[name] = limit
        with np.errstate(invalid="ignore"):
            flags[arrays[name] > limit] |= np.uint8(bit)
    return flags, limits


def carried(piece: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """Piece (frame,) that each frame counts to: a lost one (-1) to that of the posed one before it, or to the first."""
    posed = np.flatnonzero(piece >= 0)
    if not posed.size:
        return piece
    return piece[posed[np.maximum(np.searchsorted(posed, np.arange(len(piece)), side="right") - 1, 0)]]


def unbroken(theirs: NDArray[np.int64], ours: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pieces (frame,) that are unbroken in both trajectories, -1 where the other program has none.

    A frame that we lost counts to our piece before it, so that the other program's pose of it is shown.
    """
    both = np.stack([theirs, carried(ours)])
    known = theirs >= 0
    piece = np.full(len(theirs), -1, dtype=np.int64)
    # A piece is a pair of piece numbers, ours and theirs, counted anew.
    piece[known] = np.unique(both[:, known], axis=1, return_inverse=True)[1].reshape(-1)
    return piece


def _metrics(arrays: Mapping[str, Floats], facts: Mapping[str, Any], length: float) -> dict[str, Metric]:
    # NaN where no frame has a value.
    sizes = {n: rms(v[:, None]) if v.size else math.nan for n in REASONS for v in [arrays[n][np.isfinite(arrays[n])]]}
    after, apart = "after one rotation and translation, no scale", "RMS disagreement of"
    return {
        "rmse": metric(sizes["distance"], "m", f"{apart} positions {after}"),
        "rmse_rotation": metric(math.degrees(sizes["angle"]), "deg", f"{apart} orientations {after}"),
        "step_rmse": metric(sizes["step_distance"], "m", f"{apart} the motion between successive frames"),
        "step_rmse_rotation": metric(math.degrees(sizes["step_angle"]), "deg", "the same, rotation"),
        "length": metric(length, "m", "length of our trajectory over the compared frames"),
        "share": metric(100.0 * sizes["distance"] / length if length > 0 else None, "%", "rmse over the length"),
        "scale_ratio": metric(
            facts["scale_ratio"], "1", "scale that would fit the crosscheck to ours best; 1 where both agree"
        ),
        "rmse_scaled": metric(facts["rmse_scaled_m"], "m", f"{apart} positions with that scale"),
    }


@stage(
    "agreement",
    version=2,
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "crosscheck's poses in the world", "nan", "world"),
        Array("position", ("frame", "xyz"), "float64", "m", "position, ours", "nan", "world"),
        Array("position_crosscheck", ("frame", "xyz"), "float64", "m", "position, crosscheck", "nan", "world"),
        Array("distance", ("frame",), "float64", "m", "disagreement in position", "nan"),
        Array("angle", ("frame",), "float64", "rad", "disagreement in rotation", "nan"),
        Array("step_distance", ("frame",), "float64", "m", "disagreement in the motion since the frame before", "nan"),
        Array("step_angle", ("frame",), "float64", "rad", "the same, rotation", "nan"),
        Array("flagged", ("frame",), "uint8", "1", "bits: 1 position, 2 rotation, 4 motion, 8 rotation of a step"),
    ],
)
def agreement_stage(
    params: AgreementParams, trajectory: Bundle[TrajectoryFacts], crosscheck: Bundle[JoinFacts]
) -> Bundle[AgreementFacts]:
    """Trajectory against the crosscheck's."""
    frames, given = trajectory.meta["frames"], crosscheck.meta["frames"]
    ours, theirs = np.asarray(trajectory["poses"]), by_frame(np.asarray(crosscheck["piece_poses"]), given, frames)
    number = dict(zip(given, np.asarray(crosscheck["piece"]).tolist(), strict=True))
    piece = np.array([number.get(f, -1) for f in frames], dtype=np.int64)
    own = np.zeros(len(frames), dtype=np.int64)
    if "piece" in trajectory.arrays:
        own = np.asarray(trajectory["piece"], dtype=np.int64)
        piece = unbroken(piece, own)
    arrays, facts = compare(ours, theirs, piece)
    flags, limits = flag(arrays, params)
    compared = np.isfinite(arrays["distance"])
    # Our pieces lie in frames of their own: from one to the next there is no way.
    there = np.diff(own[compared]) == 0
    length = float(np.linalg.norm(np.diff(ours[compared, :, 3], axis=0), axis=1)[there].sum())
    meta: AgreementFacts = {
        "frames": frames,
        "compared": int(compared.sum()),
        "not_compared": [f for f, ok in zip(frames, compared, strict=True) if not ok],
        "pieces": len(crosscheck.meta["pieces"]),
        "metrics": _metrics(arrays, facts, length),
        "rule": f"disagreement above the median by more than {params.threshold:g} robust standard deviations "
        f"(1.4826 MAD), and above {MIN_RATIO:g} medians; in position, rotation (from "
        f"{MIN_ANGLE_DEG:g}° on), or the motion since the frame before",
        "limits": {n: v if v is None or "angle" not in n else math.degrees(v) for n, v in limits.items()},
        "limits_unit": {n: "deg" if "angle" in n else "m" for n in limits},
        "flagged": [
            {"frame": f, "why": [word for bit, word in REASONS.values() if bits & bit]}
            for f, bits in zip(frames, flags.tolist(), strict=True)
            if bits
        ],
        "scale_ratio": facts["scale_ratio"],
        "rmse_scaled_m": facts["rmse_scaled_m"],
    }
    out: dict[str, AnyArray] = {
        **arrays,
        "position": ours[:, :, 3].copy(),
        "position_crosscheck": arrays["poses"][:, :, 3].copy(),
        "flagged": flags,
    }
    return Bundle(out, meta)
