"""Parameters of the dense matcher, and its presets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, model_validator

from rille.stages.core.declare import Params
from rille.stages.hfvm.level.features import PAPER_WEIGHTS

Weights = tuple[float, float, float, float, float, float, float, float]

PAPER: Mapping[str, Any] = {
    "weights": PAPER_WEIGHTS,
    "threshold": 15.0,
    "texture": 0.0,
    "speckle": 1,
    "fill_reach": 100000,
    "refine": False,
}
"""What preset ``paper`` sets differently; a value given by the user wins. Preset-only machinery ignores the rest."""

ACCURATE: Mapping[str, Any] = {
    "band": 8.0,
    "search_columns": 1,
    "smoothness": 5,
    "rounds": 4,
    "fine_rounds": None,
    "back_rounds": 4,
    "centres": 5,
    "path_rounds": 3,
    "relief_steps": 7,
    "crowd": 0.5,
    "guided_fill": True,
    "greatest_std": 1.1,
}
"""What preset ``accurate`` sets differently; a value given by the user wins."""


FAST: Mapping[str, Any] = {"finest": 1, "rounds": 2, "fine_rounds": None, "back_rounds": 2}
"""What preset ``fast`` sets differently: half the resolution, less propagation."""

PRESETS: Mapping[str, Mapping[str, Any]] = {"default": {}, "fast": FAST, "accurate": ACCURATE, "paper": PAPER}


class HfvmParams(Params):
    """Parameters of hierarchical feature vector matching.

    ``preset = "paper"`` follows section 4.3 to the letter: floating-point Table 1 features and Eq. 1, one search
    centre, no epipolar band, no propagation, no smoothness, no pre-alignment, sub-pixel by linear interpolation and
    look-up table. ``preset = "accurate"`` adds to the default propagation along paths with compact features, a
    relief fitted to all matches along their epipolar lines, and an edge-keeping median of what was interpolated; it
    takes several times as long.
    """

    preset: Literal["default", "fast", "accurate", "paper"] = Field(
        default="default",
        description="default: the measured recipe; fast: half its resolution; accurate: slower; paper: section 4.3 to "
        "the letter",
    )
    weights: Weights = Field(
        default=(4.0, 4.0, 2.0, 2.0, 0.5, 0.5, 2.0, 1.0),
        description="factors of the eight features (Table 1); measured best on square-root features",
    )
    top_columns: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="share of the image width searched to either side at the top level: any overlap",
    )
    top_rows: float = Field(
        default=0.25, ge=0, le=1, description="the same of the height: roll, toe-in and row offsets"
    )
    search_columns: int = Field(
        default=2, ge=1, le=8, description="pixels to either side of a centre: doubling errs by one, parents by more"
    )
    search_rows: int = Field(default=1, ge=0, le=8, description="pixels; never 0 on a rig that is not rectified")
    band: float = Field(
        default=6.0,
        ge=0,
        description="cost (byte steps) a pixel off the epipolar line; 0 = free two-dimensional search",
    )
    smoothness: int = Field(
        default=4, ge=0, description="byte steps a pixel of difference to each neighbour; kept weak"
    )
    rounds: int = Field(
        default=4, ge=0, le=32, description="propagation rounds a level; they recover what the coarse level lost"
    )
    fine_rounds: int | None = Field(
        default=1,
        ge=0,
        le=32,
        description="the same at the finest level, which costs most, one more at each above; null: as at the others",
    )
    back_rounds: int = Field(
        default=1, ge=0, le=32, description="at most so many at the finest level from right to left, for the check"
    )
    centres: int = Field(
        default=5,
        ge=1,
        le=9,
        description="coarse pixels to search around: the parent, its neighbours along row, column and diagonals",
    )
    finest: Literal[0, 1] = Field(
        default=0, description="pyramid level matched last; 1 = half the resolution, a quarter of the work"
    )
    median: Literal[1, 3, 5] = Field(default=3, description="pixels; side of the median filter of each level, 1 = none")
    threshold: float = Field(
        default=90.0,
        gt=0,
        description="least distance above which a pixel is not matchable: byte steps (paper: grey levels)",
    )
    texture: float = Field(
        default=0.5, ge=0, description="grey levels; least local deviation, just above 8-bit rounding (.29)"
    )
    backmatch: float = Field(
        default=1.0, gt=0, description="pixels; greatest error after matching there and back (4.3.3)"
    )
    speckle: int = Field(
        default=40, ge=1, description="pixels; smaller isolated patches are removed, chance matches are so small"
    )
    fill_reach: int = Field(
        default=120,
        ge=0,
        description="pixels; reach of interpolation along a row, about the widest occlusion of a close stereo rig",
    )
    plane_level: int = Field(
        default=2, ge=1, le=6, description="pyramid level whose matches decide on pre-alignment by a plane"
    )
    plane_distortion: float = Field(
        default=0.2,
        ge=0,
        description="pixels a pixel; pre-align beyond this shear (a 13-tap kernel then errs by a pixel)",
    )
    plane_share: float = Field(
        default=0.6, ge=0, le=1, description="share of the coarse matches that the plane must explain"
    )
    refine: bool = Field(default=True, description="remove the perspective bias by mean-free Lucas-Kanade steps")
    correlation: float = Field(
        default=0.6,
        ge=-1,
        le=1,
        description="least correlation of both images after refinement; below, noise met noise",
    )
    refine_steps: int = Field(
        default=1, ge=1, le=8, description="steps; a second one gains nothing; a pre-aligned image takes two more"
    )
    refine_radius: int = Field(
        default=2, ge=1, le=8, description="pixels; 5 x 5 windows: wider ones smooth relief away"
    )
    refine_noise: float = Field(
        default=8.0, gt=0, description="squared grey levels a pixel; holds windows with weak texture"
    )

    path_rounds: int = Field(
        default=0,
        ge=0,
        le=8,
        description="rounds of propagation along paths a level; a third changes bad-2 by .001, 0 = none",
    )
    path_compact: int = Field(
        default=8,
        ge=0,
        le=64,
        description="quarters: weight of the compact features' byte steps; twice Table 1's, which fatten edges",
    )
    path_small: int = Field(
        default=36,
        ge=1,
        le=1000,
        description="quarters of a byte step: cost of a pixel's difference to the pixel before, a tenth of a match's",
    )
    path_large: int = Field(
        default=240, ge=1, le=10000, description="quarters of a byte step: the most that a difference costs"
    )
    path_grey: float = Field(
        default=10.0, gt=0, description="grey levels: step between two pixels that halves path_large, above noise"
    )
    relief_steps: int = Field(
        default=0, ge=0, le=20, description="steps of fitting a piecewise smooth relief, 0 = none"
    )
    relief_stiffness: float = Field(
        default=2000.0,
        gt=0,
        description="squared grey levels for a bend of a pixel: strong against noise, weak against texture of 5 x 5",
    )
    relief_bend: float = Field(
        default=0.05, gt=0, description="pixels: bend (second difference) beyond which stiffness gives way to an edge"
    )
    crowd: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="least share of matched pixels in 9 x 9 around a matched one; lonely ones are errors by the edge",
    )
    greatest_std: float | None = Field(
        default=None,
        gt=0,
        description="pixels; matches of a greater standard deviation count as not matched; none: any",
    )
    guided_fill: bool = Field(
        default=False, description="edge-keeping median of interpolated pixels, which streak along rows"
    )

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            return {**PRESETS.get(str(values.get("preset")), {}), **values}
        return values
