"""Relative orientation of one stereo pair from its own correspondences (paper, section 5.2.2).

The right camera's rotation and the direction of the baseline are adjusted to the disparity with the baseline's length
held fixed, as far as the images of this one pair observe them (:mod:`rille.stages.calibration.parameter_selection`).
Dense matches are thinned first, for neighbours share their windows and so their errors; the thinned ones go on to the
stage ``rig``, which decides for the sequence.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rille.stages.calibration.parameter_selection import Decision, RelativeParams, decide
from rille.stages.calibration.relative_orientation import MIN_MATCHES, RIG, PointPairs, rms
from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, stage
from rille.stages.core.validity import matched_back
from rille.stages.facts.calibration import OrientationFacts
from rille.stages.geometry.epipolar import corrected, distances, standing
from rille.stages.geometry.geometry import Rig


class OrientationParams(RelativeParams):
    """Parameters of the stage ``orientation``."""

    samples: int = Field(
        1500,
        ge=100,
        le=100_000,
        description="number of image cells; the best match of each is used; 1500: cells of some 20 pixels, whose "
        "errors are nearly independent",
    )


def thin(column: ArrayLike, row: ArrayLike, usable: Bools, quality: ArrayLike, samples: int) -> tuple[Floats, Floats]:
    """The best match of each square cell of the left image: points (n, 2), column and row, left and right.

    Parameters
    ----------
    column, row : (rows, cols) disparity, right minus left, pixels.
    usable : (rows, cols) pixels with a measured disparity.
    quality : (rows, cols) error of matching there and back, pixels; the least counts as best, NaN as worst.
    samples : number of cells.
    """
    side = max(1, round(math.sqrt(usable.size / samples)))
    r, c = _best_of_cells(usable, np.asarray(quality), side)
    left = np.stack([c, r], axis=-1).astype(np.float64)
    return left, left + np.stack([np.asarray(column)[r, c], np.asarray(row)[r, c]], axis=-1).astype(np.float64)


def _best_of_cells(usable: Bools, quality: Floats, side: int) -> tuple[Floats, Floats]:
    """Row and column of the usable pixel of least error in each cell that has one, the first of equals; in order."""
    known = np.where(np.isnan(quality), np.finfo(np.float32).max, quality)
    rest = [(0, -n % side) for n in usable.shape]
    error = np.pad(np.where(usable, known, np.inf), rest, constant_values=np.inf)
    down, across = (n // side for n in error.shape)
    cells = error.reshape(down, side, across, side).swapaxes(1, 2).reshape(down, across, -1)
    y, x = np.nonzero(np.isfinite(cells.min(-1)))
    r, c = np.divmod(cells.argmin(-1)[y, x], side)
    return y * side + r, x * side + c


def orient(rig: Rig, matches: PointPairs, params: RelativeParams) -> tuple[dict[str, AnyArray], dict[str, Any]]:
    """Residuals before and after, and facts of one pair's orientation; see the stage's outputs.

    Returns
    -------
    arrays : ``residual_before``, ``residual_after`` (pixels), ``weight`` (n,) float32.
    facts : ``matches``; ``parameters``, one mapping a parameter (name, value, asked, sigma, unit, observed, freed,
        why); ``row_offset`` (pixels) and ``roll_deg`` by which the images contradict the given rig; ``words``;
        ``residual_before_px``, ``residual_after_px`` (RMS of inliers).
    """
    count = len(matches.left)
    before, _ = distances(rig, np.zeros(RIG), matches.left, matches.right)
    if count < MIN_MATCHES:
        words = f"not checked: {count} matches are fewer than {MIN_MATCHES}"
        weight = np.zeros(count)
        return _arrays(before, before, weight), {"matches": count, "parameters": [], "words": words}
    decision = decide(rig, [matches], params)
    weight = decision.fit.weights[0]
    after, _ = distances(corrected(rig, decision.correction), np.zeros(RIG), matches.left, matches.right)
    inlier = weight > 0
    facts = {
        "matches": count,
        "parameters": [p.to_dict() for p in decision.parameters],
        "row_offset": float(np.median(before[inlier])),
        "roll_deg": math.degrees(decision.parameters[2].asked),
        "words": misalignment(rig, float(np.median(before[inlier])), decision),
        "residual_before_px": rms(before, weight),
        "residual_after_px": rms(after, weight),
    }
    return _arrays(before, after, weight), facts


def misalignment(rig: Rig, offset: float, decision: Decision) -> str:
    """Describe in words how the right image departs from the given rig: offset across lines (pixels) and freed
    parameters."""
    # The offset tells already of the angle that makes it.
    if standing(rig):
        lines, where, told = "columns", "far right" if offset > 0 else "far left", "yaw"
    else:
        lines, where, told = "rows", "low" if offset > 0 else "high", "pitch"
    parts = [f"{lines} of the right image lie {abs(offset):.2f} px too {where}"]
    for p in decision.parameters:
        degrees = math.degrees(p.value)
        # Positive roll turns x (right) to y (down), which is clockwise as one sees the image.
        if p.freed and p.name == "roll":
            parts.append(f"it is turned by {abs(degrees):.2f} degrees {'' if degrees > 0 else 'anti'}clockwise")
        elif p.freed and p.name != told:
            parts.append(f"{p.name.replace('_', ' ')} is off by {degrees:+.2f} degrees")
    return ", ".join(parts)


def _arrays(before: Floats, after: Floats, weight: Floats) -> dict[str, AnyArray]:
    named = {"residual_before": before, "residual_after": after, "weight": weight}
    return {name: values.astype(np.float32) for name, values in named.items()}


_MATCH = ("match",)


@stage(
    "orientation",
    outputs=[
        Array("left", ("match", "axis"), "float32", "px", "column and row in the left image", "", "left image"),
        Array("right", ("match", "axis"), "float32", "px", "column and row in the right image", "", "right image"),
        Array("residual_before", _MATCH, "float32", "px", "signed distance from the epipolar line, given rig"),
        Array("residual_after", _MATCH, "float32", "px", "the same, rig adjusted to this pair"),
        Array("weight", _MATCH, "float32", "1", "robust weight in the adjustment, 0 = outlier"),
    ],
)
def orientation_stage(params: OrientationParams, disparity: Bundle, *, rig: Rig, pair: int) -> Bundle[OrientationFacts]:
    """Relative orientation of the right camera from one pair's disparity."""
    # On planes of textureless regions row displacements were set, not measured.
    usable = matched_back(np.asarray(disparity["validity"]), np.asarray(disparity["backmatch_error"]))
    rig.check(usable.shape)
    left, right = thin(
        disparity["column_disparity"], disparity["row_disparity"], usable, disparity["backmatch_error"], params.samples
    )
    # what the stage rig will read, to the last bit
    points = {"left": left.astype(np.float32), "right": right.astype(np.float32)}
    matches = PointPairs(pair, points["left"].astype(np.float64), points["right"].astype(np.float64))
    arrays, facts = orient(rig, matches, params)
    return Bundle(points | arrays, cast(OrientationFacts, {"pair": pair} | facts))
