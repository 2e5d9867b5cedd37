"""Facts of the stages that check and repair the calibration."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts


class CalibrationFacts(Facts):
    """``rig`` (its ``to_dict``) that is computed with, and whether it was ``changed``."""

    rig: dict[str, Any]
    changed: bool


class OrientationFacts(Facts):
    """Matches of one pair against the given rig; too few ``matches`` give ``words`` on that alone."""

    pair: int
    matches: int
    words: NotRequired[str]
    row_offset: NotRequired[float]
    """Median distance from the epipolar line, px, along rows."""
    roll_deg: NotRequired[float]
    """Turn of the right camera that the matches ask for."""
    residual_before_px: NotRequired[float]
    residual_after_px: NotRequired[float]
    """RMS of inliers, and with the right camera turned as they ask for."""
    turn_deg: NotRequired[float]
    """Of the right image in its plane against the given rig, clockwise as one sees it."""
    repeated: NotRequired[float]
    """Share of the matches that look as well elsewhere on their epipolar lines."""


class RigFacts(CalibrationFacts):
    """The rig to be used; without a pair that can be used, the facts that there always are and ``warnings`` alone."""

    given: dict[str, Any]
    source: str
    parameters: NotRequired[list[dict[str, Any]]]
    """Name, value, asked, sigma, unit, observed, freed, why; in mode ``fixed`` what would be changed."""
    per_pair: NotRequired[list[dict[str, Any]]]
    """Pair, values and sigma by name, degrees, of what is observed."""
    residual_before_px: NotRequired[float]
    residual_after_px: NotRequired[float]
    """RMS of inliers."""
    matches: NotRequired[int]
    suspects: NotRequired[list[int]]
    """Pairs whose rows the rig does not explain."""
    repeats: NotRequired[str]
    """What the images show repeats, so that matches may be off by a period."""
    misread: NotRequired[str]
    """By which reading of the lenses' coefficients the matches fit better."""
    knocked: NotRequired[str]
    """A rig that one calibration does not describe."""


class SwapFacts(Facts):
    """Whether left and right are exchanged: shares of the matches that fit the rig either way, or once turned back."""

    frame: int
    swapped: bool
    as_given: NotRequired[float]
    as_turned: NotRequired[float]
    exchanged: NotRequired[float]


class SynchronyFacts(Facts):
    """Right frames that are of the time of left ones."""

    rows: list[float]
    """Spread of the rows of each pair, px."""
    partners: list[list[int]]
    """Left and right frame number, of pairs whose images are not of one time."""
