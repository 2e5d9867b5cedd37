"""Limits of the figures of a sequence, by subject, and the finding that a figure beyond one is.

FAIL: a reconstruction is useless or impossible. WARN: it gets worse, or the input is probably a mistake.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from rille.stages.calibration.doubt import MAX_REPEATED_SHARE
from rille.stages.geometry.epipolar import MAX_IMAGE_TURN_DEG

Level = Literal["OK", "WARN", "FAIL"]

MAX_SPEED = 60.0
"""m/s: largest speed between most records of a sensor; no vehicle with stereo cameras is faster."""


@dataclass(frozen=True)
class Limit:
    """Code and remedy of a finding if a figure of a subject is below ``least`` or above ``most``."""

    code: str
    figure: str
    subject: str
    remedy: str = ""
    least: float = -math.inf
    most: float = math.inf
    level: ClassVar[Level] = "WARN"


class Fault(Limit):
    """A limit beyond which a reconstruction is useless or impossible."""

    level = "FAIL"


LIMITS = (
    # Outside of these limits another unit of length is likelier than such a rig.
    Limit("RIL-641", "baseline, m", "rig", least=0.01, most=5.0, remedy="is the baseline in metres?"),
    Fault("RIL-643", "steps back", "times", most=0, remedy="correct the times"),
    Limit("RIL-644", "gaps", "times", most=0, remedy="are frames missing there, or was the clock set forward?"),
    Limit("RIL-645", "without", "truth", most=0, remedy="frames without truth are left out of the accuracy"),
    Fault("RIL-646", "degrees off", "attitude", most=2.0, remedy="check T_body_left, the axes and degrees or radians"),
    Limit("RIL-647", "without", "attitude", most=0, remedy="the other frames are matched without it"),
    Fault("RIL-977", "m/s", "odometry", most=MAX_SPEED, remedy="check its unit, and the unit of the times"),
    Limit(
        "RIL-978", "length over the truth's", "odometry", least=0.8, most=1.25, remedy="check its unit and T_body_left"
    ),
    Limit("RIL-988", "without", "odometry", most=0, remedy="the other frames are predicted without it"),
    Fault("RIL-989", "m/s", "positions", most=MAX_SPEED, remedy="check their unit, and the unit of the times"),
    # Fewer do not determine a rotation.
    Limit("RIL-990", "rows", "positions", least=3, remedy="is time_offset right, and the clock the images'?"),
    Limit("RIL-991", "lengths over sigma", "positions", least=1.0, remedy="they say nothing of so short a way"),
    Limit("RIL-648", "known", "up", least=1, remedy="the ground is levelled by its own plane"),
    Limit("RIL-650", "blank", "images", most=0, remedy="left ones get no pose, right ones no depth: take them anew"),
    Limit("RIL-668", "lost", "images", most=0, remedy="it gets no pose; its neighbours are joined across it"),
    Fault("RIL-670", "unusable", "images", most=0, remedy="mend, convert or remove what is wrong"),
    Fault("RIL-671", "left and right are one", "images", most=0, remedy="give the right camera's images"),
    Limit("RIL-677", "grey", "images", most=0),
    Limit("RIL-672", "repeated", "images", most=0, remedy="was a frame copied, or did the camera hang?"),
    # A white sky is less than this; more means clipped ground.
    Limit("RIL-651", "clipped", "exposure", most=0.2, remedy="such areas cannot be matched; mask them or expose anew"),
    # The matcher removes the mean, but not the noise.
    Limit(
        "RIL-652", "change", "exposure", most=1.5, remedy="it is levelled, but black and white is lost: fix exposure"
    ),
    Limit("RIL-755", "faint", "exposure", most=0),
    Limit("RIL-653", "right over left", "exposure", least=1 / 1.5, most=1.5, remedy="give both one exposure and depth"),
    Limit("RIL-654", "blurred", "sharpness", most=0, remedy="leave them out, or expect a weak pose there"),
    Limit("RIL-655", "right over left", "sharpness", least=0.7, most=1 / 0.7, remedy="out of focus, or a dirty lens?"),
    Fault("RIL-669", "whole pairs", "matching", least=1),
    Fault(
        "RIL-907",
        "borne out",
        "matching",
        least=0.1,
        remedy="are the maps of these left images, of this scale (SGBM's is 16) and sign, and their "
        "rows in order (PFM has the lowest first)?",
    ),
    Fault(
        "RIL-656",
        "matched",
        "matching",
        least=0.02,
        remedy="do both images show one scene, taken at one time, sharp, and neither mirrored?",
    ),
    Limit("RIL-657", "matched", "matching", least=0.3, remedy="little texture, little overlap, or strong compression"),
    Limit("RIL-658", "baselines away", "matching", most=200, remedy="depth is a guess there; is the baseline right?"),
    Fault(
        "RIL-659",
        "beyond",
        "sides",
        most=0.5,
        remedy="left and right, or their calibrations, are swapped, the images are mirrored or upside down, the "
        "baseline has the wrong sign, its transformation leads from right to left, or the scene repeats (bricks, "
        "tiles); or all of it is far (sky), and an angle between the cameras is off",
    ),
    Limit("RIL-660", "beyond", "sides", most=0.1, remedy="the calibration's toe-in or principal points are wrong"),
    Limit("RIL-773", "unlike", "sides", most=0, remedy="look at both images: torn, exchanged, or of another frame?"),
    Limit("RIL-681", "misread", "distortion", most=0),
    Limit("RIL-679", "above", "ground", most=0),
    Limit("RIL-661", "known", "epipolar", least=1, remedy="see the matching"),
    Fault("RIL-673", "turned, degrees", "epipolar", most=MAX_IMAGE_TURN_DEG, remedy="turn one camera's images back"),
    Fault(
        "RIL-662",
        "adjusted, px",
        "epipolar",
        most=5.0,
        remedy="wrong calibration file, transforms inverted (T_BS), or lens distortion left in",
    ),
    Limit(
        "RIL-663", "adjusted, px", "epipolar", most=1.0, remedy="is lens distortion left in, or the wrong file given?"
    ),
    Limit(
        "RIL-664",
        "residual or row offset",  # px, half px
        "epipolar",
        most=1.0,
        remedy="are the images rectified already (images.rectified)? Else the calibration is off: reconstruct "
        "repairs what the images tell, `rille calibrate` the rest",
    ),
    Limit(
        "RIL-712",
        "repeated",
        "repetition",
        most=MAX_REPEATED_SHARE,
        remedy="matches may be off by a period: view along the rows, or from nearer",
    ),
    Fault("RIL-665", "contradictions", "simultaneous", most=0, remedy="pair the images anew"),
    # tracking needs most of a left image to be in the next one
    Fault(
        "RIL-666", "overlap", "motion", least=0.1, remedy="the trajectory breaks there; add frames between, or split it"
    ),
    Limit("RIL-667", "overlap", "motion", least=0.4, remedy="take every frame, or expect weak poses there"),
    Limit(
        "RIL-715",
        "largest motion, px",
        "motion",
        least=0.5,
        remedy="if the camera moved, take frames farther apart; what moves along with it hides its motion: switch "
        "off a projector of dots, mask its own body",
    ),
)
"""Limits of the figures of each subject, the most severe first."""


@dataclass(frozen=True)
class Finding:
    """One line of ``rille check``: figures of ``subject`` in words, a remedy, and a ``code`` if it is not OK."""

    code: str
    text: str
    subject: str
    level: Level = "OK"
    remedy: str = ""

    def __str__(self) -> str:
        code = f"{self.code}: " if self.code else ""
        return f"{self.level:4s}  {self.subject:12s}  {code}{self.text}" + (f": {self.remedy}" if self.remedy else "")


def judge(subject: str, text: str, figures: Mapping[str, float] | None = None) -> Finding:
    """Finding of the first limit that a figure of the subject, by name, exceeds; else an OK one."""
    for limit in LIMITS:
        figure = (figures or {}).get(limit.figure) if limit.subject == subject else None
        if figure is not None and not limit.least <= figure <= limit.most:
            return Finding(limit.code, text, subject, limit.level, limit.remedy)
    return Finding("", text, subject)
