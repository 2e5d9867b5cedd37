"""Tilt that all disparities share, estimated from the contributions of all adjusted segments.

A right image whose rows lie too low may have been turned (pitch), or have its principal point there; epipolar lines
hardly tell the two apart, and a rig that is repaired takes the turn. The wrong choice tilts disparities: by ``f x y`` a
radian, nothing along both axes of the image and most in its corners, which bends the path to one side. Where one camera
stands above the other, it is columns and yaw. Tracks see depth once more, by parallax, so all segments together measure
the tilt (:func:`rille.stages.odometry.resection.bundle_adjustment.tilt_of`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import RefineFacts, TiltFacts
from rille.stages.geometry.epipolar import standing
from rille.stages.geometry.geometry import Rig
from rille.stages.numeric.robust import huber_weight, mad_sigma
from rille.stages.odometry.resection import intrinsics


def common_tilt(parts: Floats, prior_sigma: float) -> tuple[float, float]:
    """Tilt that all disparities share and its standard deviation, radians.

    The segments' own values scatter by more than their errors, for their landmarks are few and near each other; the
    scatter decides. Infinite deviation: fewer than three segments.

    Parameters
    ----------
    parts : (segment, 2) information and pull of the tilt.
    prior_sigma : radians.
    """
    # Rounding leaves a segment that tells nothing with no or negative information.
    parts = parts[parts[:, 0] > 0]
    if len(parts) < 3:
        return 0.0, float("inf")
    claimed, value = parts[:, 0], parts[:, 1] / parts[:, 0]
    information = claimed
    for _ in range(5):  # of a segment that is far off, no more than of one at two deviations
        tilt = float((information * value).sum() / information.sum())
        off = np.abs(value - tilt) * np.sqrt(claimed)
        # At least what the segments claim: few of them may agree by chance.
        spread = max(1.0, mad_sigma(off, 0.0))
        information = claimed * huber_weight(off, 2.0 * spread)
    total = float(information.sum()) / spread**2
    prior = prior_sigma**-2.0
    # Mean of Gaussians: the prior's is 0.
    return tilt * total / (total + prior), (total + prior) ** -0.5


def _words(tilt: float, sigma: float, rig: Rig) -> str:
    angle, focal, lines = ("yaw", rig.right.fx, "columns") if standing(rig) else ("pitch", rig.right.fy, "rows")
    return (
        f"the tracks contradict the disparities: {math.degrees(abs(tilt)):.2f} +- {math.degrees(sigma):.2f} degrees of"
        f" {angle} stand for a principal point that is {abs(tilt) * focal:.1f} {lines} off; undone in the trajectory,"
        " not in elevations: calibrate anew"
    )


@stage("common_tilt")
def common_tilt_stage(
    params: NoParams,
    segments: Sequence[Bundle[RefineFacts]],
    rig: Bundle[CalibrationFacts],
    *,
    sigma_deg: float,
    significance: float,
) -> Bundle[TiltFacts]:
    """Tilt and intrinsics that the disparities of all segments share."""
    told = [pair for segment in segments for pair in segment.meta["tilt"]]
    tilt, sigma = common_tilt(np.array(told).reshape(-1, 2), math.radians(sigma_deg))
    if not math.isfinite(sigma):
        return Bundle({}, {"undone": False})
    undone = abs(tilt) > significance * sigma
    used = Rig.from_dict(rig.meta["rig"])
    facts: TiltFacts = {"tilt_rad": tilt, "sigma_rad": sigma, "undone": undone}
    lines = [_words(tilt, sigma, used)] if undone else []
    parts = np.array([one for segment in segments for one in segment.meta["intrinsics"]])
    # No prior: a file holds any number.
    errors = [common_tilt(parts[:, k], 1.0) for k in range(len(intrinsics.NAMES))]
    facts["intrinsics"] = dict(zip(intrinsics.NAMES, errors, strict=True))
    if line := intrinsics.contradiction(errors, used.left.fx):
        lines, facts["contradiction"] = [line, *lines], line
    if lines:
        facts["warnings"] = lines
    return Bundle({}, facts)
