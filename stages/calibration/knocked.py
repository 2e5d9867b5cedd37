"""The rig after a knock that turned the right camera along the epipolar lines, by the jump of its disparities.

The rows of the images show other turns of a camera, this one they do not: all disparities change alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import RigFacts
from rille.stages.geometry import epipolar
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.scale import right_pixels


def turned(rig: Rig, jump: Sequence[float]) -> tuple[Rig, float]:
    """Rig whose disparities of what is far ahead are others by a ``jump`` (column, row), px of the coarser image; and
    the angle, rad, by which its right camera is turned for that."""
    one = np.zeros(5)
    one[epipolar.NAMES.index(epipolar.angle_along(rig))] = 1e-4  # rad, small enough for a derivative
    slope = epipolar.far_shift(rig, epipolar.corrected(rig, one)) / right_pixels(rig)
    share = float(slope @ jump / (slope @ slope))
    return epipolar.corrected(rig, share * one), share * float(one.sum())


@stage("knocked")
def knocked_stage(params: NoParams, rig: Bundle[RigFacts], *, jump: Sequence[float], cause: str) -> Bundle[RigFacts]:
    """The ``rig`` from a knock on, with the line that says of it (``cause``)."""
    used, angle = turned(Rig.from_dict(rig.meta["rig"]), jump)
    degrees = f"{math.degrees(angle):+.3f} degrees"
    line = f"{cause}: from there on all is computed with the right camera turned by {degrees}; calibrate anew"
    warnings = [*rig.meta.get("warnings", ()), line]
    return Bundle({}, {**rig.meta, "rig": used.to_dict(), "changed": True, "knocked": cause, "warnings": warnings})
