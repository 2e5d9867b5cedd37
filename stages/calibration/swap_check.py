"""Whether left and right of one pair are exchanged: its coarse matches under the rig as given, and exchanged.

With parallel cameras exchanged images lie beyond infinity; with cameras turned inward they need not, but their rows
then depart the wrong way towards the corners. A match therefore fits the rig if it lies near its epipolar line *and*
in front of the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.stages.core.declare import Bundle, Inputs, NoParams, Stage
from rille.stages.core.validity import matched
from rille.stages.geometry.epipolar import exchanged, fits
from rille.stages.geometry.geometry import Rig
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.odometry.motion import MotionParams, coarse_motion

SEARCH = MotionParams(top_columns=0.5, turn_below=0.0)
"""Half of the width to either side, as far as pairs are matched."""
LEAST = 50
"""Coarse matches, below which nothing is said."""


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    rig = Rig.from_dict(args["rig"])
    found = coarse_motion(Pyramid.from_bundle(inputs["left"]), Pyramid.from_bundle(inputs["right"]), SEARCH)
    row, col = np.nonzero(matched(found.validity))
    scale = 2.0**found.level
    # Centres of the coarse pixels in those of level 0.
    left = np.asarray((np.stack([col, row], -1) + 0.5) * scale - 0.5, dtype=np.float64)
    shift = np.stack([found.column_disparity[row, col], found.row_disparity[row, col]], -1)
    right = np.asarray(left + shift, dtype=np.float64)
    facts: dict[str, Any] = {"frame": int(args["frame"]), "matches": len(left), "swapped": False}
    if len(left) >= LEAST:
        # The tolerance is one coarse pixel: coarse matches are no more exact.
        given, other_way = fits(rig, left, right, scale), fits(rig, right, left, scale)
        facts |= {"as_given": given, "exchanged": other_way, "swapped": exchanged(given, other_way)}
    return Bundle({}, facts)


STAGE = Stage(
    name="swap_check",
    version=1,
    summary="whether left and right of a pair are exchanged",
    params=NoParams,
    inputs=("left", "right"),
    outputs=(),
    run=_run,
)
