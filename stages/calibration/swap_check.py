"""Whether left and right of one pair are exchanged: its coarse matches under the rig as given, and exchanged.

With parallel cameras exchanged images lie beyond infinity; with cameras turned inward they need not, but their rows
then depart the wrong way towards the corners. A match therefore fits the rig if it lies near its epipolar line *and*
in front of the cameras.

Cameras of unlike scale are matched at the levels at which their pixels are about as large, which are other ones for
exchanged images.
"""

from __future__ import annotations

import math

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.core.validity import matched
from rille.stages.facts.calibration import SwapFacts
from rille.stages.geometry.epipolar import exchanged, fits
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.scale import of_rig
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.odometry.motion import MotionParams, coarse_motion

SEARCH = MotionParams(top_columns=0.5, turn_below=0.0)
"""Half of the width to either side, as far as pairs are matched."""
LEAST = 50
"""Coarse matches, below which nothing is said."""


def _matches(left: Pyramid, right: Pyramid, finer: int) -> tuple[Floats, Floats, float]:
    """Columns and rows (n, 2), (n, 2) of coarse matches, level-0 pixels, and the side of a coarse right pixel.

    ``finer``: by how many levels the right image is finer than the left one; negative: coarser.
    """
    down = min(max(-finer, 0), left.levels - 1), min(max(finer, 0), right.levels - 1)
    found = coarse_motion(left.above(down[0]), right.above(down[1]), SEARCH)
    row, col = np.nonzero(matched(found.validity))
    scale = 2.0**found.level
    # Centres of the coarse pixels in those of the level that is matched as the finest.
    first = np.asarray((np.stack([col, row], -1) + 0.5) * scale - 0.5, dtype=np.float64)
    shift = np.stack([found.column_disparity[row, col], found.row_disparity[row, col]], -1)
    second = np.asarray(first + shift, dtype=np.float64)
    one, other = (p if not k else (p + 0.5) * 2.0**k - 0.5 for p, k in zip((first, second), down, strict=True))
    return one, other, scale * 2.0 ** down[1]


@stage("swap_check")
def swap_check_stage(params: NoParams, left: Bundle, right: Bundle, *, frame: int, rig: Rig) -> Bundle[SwapFacts]:
    """Whether left and right of a pair are exchanged."""
    images = Pyramid.from_bundle(left), Pyramid.from_bundle(right)
    finer = round(math.log2(of_rig(rig)[0]))
    given = _matches(*images, finer)
    other = _matches(*images, -finer) if finer else given
    most = max(len(given[0]), len(other[0]))
    facts: SwapFacts = {"frame": frame, "matches": most, "swapped": False}
    if most >= LEAST:
        # The tolerance is one coarse pixel: coarse matches are no more exact. Too few matches fit nothing.
        a, b, scale = given
        as_given = fits(rig, a, b, scale) if len(a) >= LEAST else 0.0
        a, b, scale = other
        other_way = fits(rig, b, a, scale) if len(a) >= LEAST else 0.0
        facts |= {"as_given": as_given, "exchanged": other_way, "swapped": exchanged(as_given, other_way)}
    return Bundle({}, facts)
