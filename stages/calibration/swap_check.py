"""Whether left and right of one pair are exchanged: matches of their features under the rig as given, and exchanged."""

from __future__ import annotations

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import SwapFacts
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.sides import exchanged, fits_turned
from rille.stages.imaging.features import matched_points


@stage("swap_check")
def swap_check_stage(params: NoParams, left: Bundle, right: Bundle, *, frame: int, rig: Rig) -> Bundle[SwapFacts]:
    """Whether left and right of a pair are exchanged, by their features."""
    a, b = matched_points(left, right)
    facts: SwapFacts = {"frame": frame, "swapped": False}
    if len(a) >= 50:
        facts["swapped"], facts["as_given"], facts["exchanged"] = exchanged(rig, a, b)
        facts["as_turned"] = fits_turned(rig, a, b)
    return Bundle({}, facts)
