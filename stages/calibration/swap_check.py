"""Whether left and right of one pair are exchanged: matches of their features under the rig as given, and exchanged.

With parallel cameras exchanged images lie beyond infinity; with cameras turned inward they need not, but their rows
then depart the wrong way towards the corners. A match therefore fits the rig if it lies near its epipolar line *and*
in front of the cameras.
"""

from __future__ import annotations

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import SwapFacts
from rille.stages.geometry.epipolar import exchanged, fits
from rille.stages.geometry.geometry import Rig
from rille.stages.imaging.features import matched_points

LEAST = 50
"""Matches, below which nothing is said."""
TOLERANCE_PX = 2.0
"""Distance from its line up to which a match fits. Of two images of a street that are one frame apart .22 to .32 of the
matches fit so, of simultaneous ones .95 to .98; on a desert up to .08, and .99."""


@stage("swap_check")
def swap_check_stage(params: NoParams, left: Bundle, right: Bundle, *, frame: int, rig: Rig) -> Bundle[SwapFacts]:
    """Whether left and right of a pair are exchanged, by their features."""
    a, b = matched_points(left, right)
    facts: SwapFacts = {"frame": frame, "matches": len(a), "swapped": False}
    if len(a) >= LEAST:
        given, other = fits(rig, a, b, TOLERANCE_PX), fits(rig, b, a, TOLERANCE_PX)
        facts |= {"as_given": given, "exchanged": other, "swapped": exchanged(given, other)}
    return Bundle({}, facts)
