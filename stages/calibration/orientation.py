"""Matches of one stereo pair for its relative orientation (paper, section 5.2.2), and how well they fit the given rig.

Dense matches are thinned, because neighbours share their windows and so their errors. Stage ``rig`` reads the thinned
matches of all pairs. This stage fits the rotation of the right camera to those of one pair, which shows outliers, and
the residual that no rotation removes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rille.stages.calibration.doubt import lines, repeated
from rille.stages.calibration.parameter_selection import ANGLES, RelativeParams
from rille.stages.calibration.relative_orientation import MIN_MATCHES, RIG, PointPairs, rms, settle
from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Array, Bundle, Params, stage
from rille.stages.core.validity import matched_back
from rille.stages.facts.calibration import OrientationFacts
from rille.stages.geometry.epipolar import NAMES, corrected, image_turn, line_distances
from rille.stages.geometry.geometry import Rig


class OrientationParams(Params):
    """Parameters of the stage ``orientation``.

    Attributes
    ----------
    samples : number of image cells; the best match of each is used; 1500: cells of some 20 pixels, whose errors are
        nearly independent.
    """

    samples: int = Field(1500, ge=100, le=100_000)


def thin(column: ArrayLike, row: ArrayLike, usable: Bools, quality: ArrayLike, samples: int) -> tuple[Floats, Floats]:
    """The best match of each square cell of the left image: points (n, 2), column and row, left and right.

    Parameters
    ----------
    column, row : (rows, cols) disparity, right minus left, pixels.
    usable : (rows, cols) pixels with a measured disparity.
    quality : (rows, cols) back-matching error, pixels; the least is best, NaN worst.
    samples : number of cells.
    """
    side = max(1, round(math.sqrt(usable.size / samples)))
    r, c = _best_of_cells(usable, np.asarray(quality), side)
    left = np.stack([c, r], axis=-1).astype(np.float64)
    return left, left + np.stack([np.asarray(column)[r, c], np.asarray(row)[r, c]], axis=-1).astype(np.float64)


def _best_of_cells(usable: Bools, quality: Floats, side: int) -> tuple[Floats, Floats]:
    """Row and column of the first usable pixel of least error in each cell that has one, in order of the cells."""
    known = np.where(np.isnan(quality), np.finfo(np.float32).max, quality)
    rest = [(0, -n % side) for n in usable.shape]
    error = np.pad(np.where(usable, known, np.inf), rest, constant_values=np.inf)
    down, across = (n // side for n in error.shape)
    cells = error.reshape(down, side, across, side).swapaxes(1, 2).reshape(down, across, -1)
    y, x = np.nonzero(np.isfinite(cells.min(-1)))
    r, c = np.divmod(cells.argmin(-1)[y, x], side)
    return y * side + r, x * side + c


def orient(rig: Rig, matches: PointPairs) -> tuple[Floats, OrientationFacts]:
    """Robust weights (n,) of one pair's matches, 0 for outliers, and the pair's facts."""
    count = len(matches.left)
    facts: OrientationFacts = {"pair": matches.pair, "matches": count}
    if count < MIN_MATCHES:
        facts["words"] = f"not checked: {count} matches are fewer than {MIN_MATCHES}"
        return np.zeros(count), facts
    turns = [k < ANGLES for k in range(RIG)]
    fit = settle(rig, [matches], turns, RelativeParams.model_validate({}).priors(rig))
    before, after = (line_distances(one, matches.left, matches.right) for one in (rig, corrected(rig, fit.x[:RIG])))
    weight = fit.weights[0]
    facts["row_offset"] = float(np.median(before[weight > 0]))
    facts["roll_deg"] = math.degrees(fit.x[NAMES.index("roll")])
    facts["residual_before_px"], facts["residual_after_px"] = rms(before, weight), rms(after, weight)
    facts["turn_deg"] = image_turn(rig, matches.left, matches.right)
    return weight, facts


@stage(
    "orientation",
    outputs=[
        Array("left", ("match", "axis"), "float32", "px", "column and row in the left image", "", "left image"),
        Array("right", ("match", "axis"), "float32", "px", "column and row in the right image", "", "right image"),
        Array("weight", ("match",), "float32", "1", "robust weight in the adjustment, 0 = outlier"),
    ],
)
def orientation_stage(
    params: OrientationParams, disparity: Bundle, left: Bundle, right: Bundle, *, rig: Rig, pair: int
) -> Bundle[OrientationFacts]:
    """Thinned matches of one pair, how well they fit the given rig, and whether its ``left`` and ``right`` images show
    what repeats."""
    # Excludes planes of textureless regions, whose row displacements are set, not measured.
    usable = matched_back(np.asarray(disparity["validity"]), np.asarray(disparity["backmatch_error"]))
    rig.check(usable.shape)
    places = thin(
        disparity["column_disparity"], disparity["row_disparity"], usable, disparity["backmatch_error"], params.samples
    )
    # Rounded to float32, as stage rig reads them.
    points = dict(zip(("left", "right"), (one.astype(np.float32) for one in places), strict=True))
    matches = PointPairs(pair, points["left"].astype(np.float64), points["right"].astype(np.float64))
    weight, facts = orient(rig, matches)
    # A fundamental matrix has seven degrees of freedom.
    f = lines((matches.left, matches.right)) if len(matches.left) > 7 else None
    facts["repeated"] = repeated(left["image"], right["image"], (matches.left, matches.right), f)
    return Bundle(points | {"weight": weight.astype(np.float32)}, facts)
