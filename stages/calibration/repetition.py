"""Whether what the images show repeats, as rows of plants or bricks do, so that matches may be off by a period.

Such matches contradict a right calibration, or lie beyond infinity, without anything being wrong with the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import RepetitionFacts
from rille.stages.hfvm.given import MAX_REPEATED_SHARE, lines, repeated


@stage("repetition")
def repetition_stage(
    params: NoParams, left: Sequence[Bundle], right: Sequence[Bundle], orientations: Sequence[Bundle]
) -> Bundle[RepetitionFacts]:
    """Share of the matches of some pairs that look as well elsewhere on their epipolar lines, mean over the pairs."""
    shares = []
    for a, b, found in zip(left, right, orientations, strict=True):
        places = (np.asarray(found["left"], np.float64), np.asarray(found["right"], np.float64))
        # A fundamental matrix has seven freedoms.
        f = lines(places) if len(places[0]) > 7 else None
        shares.append(repeated(a["image"], b["image"], places, f))
    share = float(np.mean(shares)) if shares else 0.0
    facts: RepetitionFacts = {"repeated": share}
    if share > MAX_REPEATED_SHARE:
        line = (
            f"{share:.0%} of the matches look as well elsewhere on their epipolar lines: on a pattern that repeats "
            "(rows of plants, bricks, tiles) they may be off by a period, and with them rig, depths and poses"
        )
        facts["contradiction"], facts["warnings"] = line, [line]
    return Bundle({}, facts)
