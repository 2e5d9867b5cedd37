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
    # Grey levels: distances are Eq. 1's there, no sums of bytes.
    "threshold": 15.0,
    "texture": 0.0,
    # Beyond the noise of any image, which so is never denoised.
    "denoise_from": 1e6,
    "speckle": 1,
    "fill_reach": 100000,
    "depth_edges": False,
    "textureless": False,
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
    # One round instead of three, and four steps instead of seven: two of four savings that took ``accurate``
    # from 34 times SGBM's time to 12.
    "path_rounds": 1,
    "variational_steps": 4,
    # Without this 79.5 % of the pixels are matched instead of 78.8, but bad-2 of the matched is .028 instead of .025.
    "min_support": 0.5,
    "guided_fill": True,
}
"""What preset ``accurate`` sets differently; a value given by the user wins."""


FAST: Mapping[str, Any] = {
    "finest": 1,
    "rounds": 2,
    "fine_rounds": None,
    "back_rounds": 2,
    # At half the resolution regions hold too few windows: none was found on ten pairs.
    "textureless": False,
}
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
        description="set of values: default: the recipe measured best for its time; fast: half the resolution and "
        "fewer rounds; accurate: smaller errors, several times the time; paper: section 4.3 of the paper to the "
        "letter",
    )
    weights: Weights = Field(
        default=(4.0, 4.0, 2.0, 2.0, 0.5, 0.5, 2.0, 1.0),
        description="factors of the eight features in the order of Table 1; a larger one lets its feature decide "
        "more; default: best measured on square-root features",
    )
    top_columns: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="share of the image width searched to either side at the coarsest level; larger: finds larger "
        "disparities, takes longer",
    )
    top_rows: float = Field(
        default=0.25,
        ge=0,
        le=1,
        description="share of the image height searched up and down at the coarsest level; larger: tolerates more "
        "roll, toe-in and row offset, takes longer",
    )
    search_columns: int = Field(
        default=2,
        ge=1,
        le=8,
        description="columns [pixels] searched to either side of each predicted displacement; larger: repairs worse "
        "predictions, takes longer",
    )
    search_rows: int = Field(
        default=1,
        ge=0,
        le=8,
        description="rows [pixels] searched above and below each predicted displacement; larger: takes longer; 0 "
        "only for rectified images",
    )
    band: float = Field(
        default=6.0,
        ge=0,
        description="cost [byte steps per pixel] of a displacement off the epipolar line; larger: holds matches "
        "closer to the line; 0: free two-dimensional search",
    )
    smoothness: int = Field(
        # With 6 bad-2 of three pairs changed by .001 to .002, which proves nothing.
        default=4,
        ge=0,
        description="cost [byte steps per pixel] of the difference to each neighbour's displacement; larger: fewer "
        "outliers, depth edges less sharp",
    )
    rounds: int = Field(
        # Where rows lie 14 px apart (NASA K10), four rounds match 70.2 % of the pixels, three 69.5.
        default=4,
        ge=0,
        le=32,
        description="propagation rounds per level; more: recover more of the thin objects that the coarser level "
        "lost, take longer",
    )
    fine_rounds: int | None = Field(
        # Two rounds instead of one lowered bad-2 of ten pairs by 5 % and made ``default`` slower by a tenth.
        default=2,
        ge=0,
        le=32,
        description="propagation rounds at the finest level, which takes the most time; each coarser level has one "
        "more, at most the value of rounds; null: that value at every level",
    )
    back_rounds: int = Field(
        default=2,
        ge=0,
        le=32,
        description="limit of the propagation rounds from right to left at the finest level; that direction serves "
        "the consistency check only",
    )
    depth_edges: bool = Field(
        default=True,
        description="near a depth edge let pixels choose anew, by small windows, between the displacements on both "
        "sides of it; false: a foreground reaches a few pixels beyond its outline",
    )
    textureless: bool = Field(
        default=True,
        description="in large regions without texture, such as walls, match wide windows that agree on a plane; false: "
        "such regions stay without matches",
    )
    finest: Literal[0, 1] = Field(
        default=0,
        description="pyramid level matched last; 0: full resolution; 1: half the resolution, a quarter of the work",
    )
    median: Literal[1, 3, 5] = Field(
        default=3,
        description="side [pixels] of the median filter of each level; larger: removes more outliers and more thin "
        "objects; 1: no filter",
    )
    threshold: float = Field(
        default=90.0,
        gt=0,
        description="feature distance [byte steps; preset paper: grey levels] above which a pixel counts as not "
        "matchable; larger: more matches, more errors",
    )
    denoise_from: float = Field(
        default=1.0,
        gt=0,
        description="noise [grey levels] of an image, as estimated from itself, from which on it is denoised before it "
        "is matched; larger: fewer images are denoised; images without noise added reach 0.2",
    )
    texture: float = Field(
        default=0.5,
        ge=0,
        description="least standard deviation [grey levels] of the window around a pixel to be matched; larger: "
        "fewer matches where the image shows little; rounding to 8 bits alone gives 0.29",
    )
    backmatch: float = Field(
        default=1.0,
        gt=0,
        description="largest error [pixels] after matching there and back (section 4.3.3); larger: more matches, "
        "more errors",
    )
    speckle: int = Field(
        default=40,
        ge=1,
        description="smallest patch of connected matches [pixels] that is kept; larger: removes more chance matches "
        "and more small objects",
    )
    fill_reach: int = Field(
        default=120,
        ge=0,
        description="longest distance [pixels] of interpolation along a row; larger: fills wider gaps; the default "
        "is about the widest occlusion of a close stereo rig",
    )
    plane_level: int = Field(
        default=2,
        ge=1,
        le=6,
        description="pyramid level whose matches decide on pre-alignment by a plane; larger: coarser and faster",
    )
    plane_distortion: float = Field(
        default=0.2,
        ge=0,
        description="shear or stretch [pixels per pixel] between the images from which on they are pre-aligned by a "
        "plane; larger: fewer pairs are pre-aligned",
    )
    plane_share: float = Field(
        default=0.6,
        ge=0,
        le=1,
        description="least share of the coarse matches that the plane must explain; larger: fewer pairs are "
        "pre-aligned",
    )
    turned: bool = Field(
        default=True,
        description="where hardly a pixel matches, let keypoints tell how the images are turned, scaled or slanted "
        "against each other, and match anew",
    )
    refine: bool = Field(
        default=True,
        description="improve sub-pixel displacements by mean-free Lucas-Kanade steps, which remove the bias that "
        "perspective causes",
    )
    correlation: float = Field(
        default=0.6,
        ge=-1,
        le=1,
        description="least correlation of both images' windows after refinement; larger: fewer matches, fewer "
        "errors; below the default, noise matched noise",
    )
    refine_steps: int = Field(
        default=1,
        ge=1,
        le=8,
        description="Lucas-Kanade steps; more take longer and measured no gain; a pre-aligned image takes one more "
        "than set",
    )
    refine_radius: int = Field(
        default=2,
        ge=1,
        le=8,
        description="radius [pixels] of the Lucas-Kanade windows, 2: 5 x 5; larger: less noise, small relief "
        "smoothed away",
    )
    refine_noise: float = Field(
        default=8.0,
        gt=0,
        description="assumed noise [squared grey levels per pixel]; larger: shorter steps where texture is weak",
    )

    path_rounds: int = Field(
        default=0,
        ge=0,
        le=8,
        description="rounds of propagation along paths per level; more: slower, the third round changes bad-2 by "
        "0.001; 0: none",
    )
    path_compact: int = Field(
        default=8,
        ge=0,
        le=64,
        description="weight of the compact features [quarters of a byte step]; larger: depth edges less fattened; "
        "0: Table 1's features alone",
    )
    path_small: int = Field(
        default=36,
        ge=1,
        le=1000,
        description="cost [quarters of a byte step] per pixel of difference between the displacements of neighbours "
        "on a path; larger: smoother",
    )
    path_large: int = Field(
        default=240,
        ge=1,
        le=10000,
        description="largest cost [quarters of a byte step] of a difference between neighbours on a path, however "
        "large it is; larger: fewer depth steps",
    )
    path_grey: float = Field(
        default=10.0,
        gt=0,
        description="grey-level step between neighbours at which path_large is halved; larger: depth steps follow "
        "image edges less",
    )
    variational_steps: int = Field(
        default=0,
        ge=0,
        le=20,
        description="steps of the variational refinement, which fits a piecewise smooth relief to all matches; more "
        "take longer; 0: none",
    )
    variational_stiffness: float = Field(
        default=2000.0,
        gt=0,
        description="cost [squared grey levels] of a bend of one pixel; larger: smoother, less noise, small relief "
        "lost",
    )
    variational_bend: float = Field(
        default=0.05,
        gt=0,
        description="bend [pixels, second difference] beyond which the stiffness gives way to an edge; larger: "
        "fewer edges are kept",
    )
    min_support: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="least share of matched pixels in the 9 x 9 window around a match; larger: removes more "
        "isolated matches, which are often errors beside depth edges",
    )
    guided_fill: bool = Field(
        default=False,
        description="smooth interpolated pixels by a median that keeps image edges, since interpolation leaves "
        "streaks along rows",
    )

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            return {**PRESETS.get(str(values.get("preset")), {}), **values}
        return values
