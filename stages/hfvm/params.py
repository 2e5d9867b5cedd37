"""Parameters of the dense matcher, and its presets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeVar

from pydantic import Field, model_validator

from rille.stages.core.declare import Params

Step = TypeVar("Step")

Weights = tuple[float, float, float, float, float, float, float, float]

PAPER_WEIGHTS: Weights = (2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 10.0, 4.0)
"""Weights w of Table 1."""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "fast": {"rounds": 2},
    # Without min_support 79.5 % of the pixels are matched instead of 78.8, but bad-2 of them is .028 instead of .025.
    "accurate": {"band": 8.0, "search_columns": 1, "smoothness": 5, "min_support": 0.5},
    # Grey levels: distances are Eq. 1's there, no sums of bytes.
    "paper": {"weights": PAPER_WEIGHTS, "threshold": 15.0, "texture": 0.0, "fill_reach": 100000},
}
"""Parameters that a preset sets differently; a value given by the user wins. Its steps: ``matcher.RECIPES``."""


class HfvmParams(Params):
    """Parameters of hierarchical feature vector matching.

    ``preset = "paper"`` follows section 4.3 to the letter: floating-point Table 1 features and Eq. 1, one search
    centre, no epipolar band, no propagation, no smoothness, no pre-alignment, sub-pixel by linear interpolation and
    look-up table. ``preset = "accurate"`` adds to the default propagation along paths with compact features, and a
    relief fitted to all matches along their epipolar lines; it takes several times as long.

    Attributes
    ----------
    preset : set of values: default: the recipe measured best for its time; fast: half the resolution and fewer rounds;
        accurate: smaller errors, several times the time; paper: section 4.3 of the paper to the letter.
    without : steps that are left out: even (brightness), align (by a plane), turn (by keypoints), paths, edges (of
        depth), refine (of fractions), smooth (relief), planes (of regions without texture).
    weights : factors of the eight features in the order of Table 1; a larger one lets its feature decide more; default:
        best measured on square-root features.
    top_columns : share of the image width searched to either side at the coarsest level; larger: finds larger
        disparities, takes longer.
    top_rows : share of the image height searched up and down at the coarsest level; larger: tolerates more roll, toe-in
        and row offset, takes longer.
    search_columns : columns [pixels] searched to either side of each predicted displacement; larger: repairs worse
        predictions, takes longer.
    band : cost [byte steps per pixel] of a displacement off the epipolar line; larger: holds matches closer to the
        line; 0: free two-dimensional search.
    smoothness : cost [byte steps per pixel] of the difference to each neighbour's displacement; larger: fewer outliers,
        depth edges less sharp.
    rounds : propagation rounds per level; more: recover more of the thin objects that the coarser level lost, take
        longer.
    threshold : feature distance [byte steps; preset paper: grey levels] above which a pixel counts as not matchable;
        larger: more matches, more errors.
    denoise_from : noise [grey levels] of an image, as estimated from itself, from which on it is denoised before it is
        matched; larger: fewer images are denoised; images without noise added reach 0.2.
    texture : least standard deviation [grey levels] of the window around a pixel to be matched; larger: fewer matches
        where the image shows little; rounding to 8 bits alone gives 0.29.
    backmatch : largest error [pixels] after matching there and back (section 4.3.3); larger: more matches, more errors.
    speckle : smallest patch of connected matches [pixels] that is kept; larger: removes more chance matches and more
        small objects.
    fill_reach : longest distance [pixels] of interpolation along a row; larger: fills wider gaps; the default is about
        the widest occlusion of a close stereo rig.
    correlation : least correlation of both images' windows after refinement; larger: fewer matches, fewer errors; below
        the default, noise matched noise.
    min_support : least share of matched pixels in the 9 x 9 window around a match; larger: removes more isolated
        matches, which are often errors beside depth edges.
    """

    preset: Literal["default", "fast", "accurate", "paper"] = "default"
    without: tuple[Literal["even", "align", "turn", "paths", "edges", "refine", "smooth", "planes"], ...] = ()
    weights: Weights = (4.0, 4.0, 2.0, 2.0, 0.5, 0.5, 2.0, 1.0)
    top_columns: float = Field(0.5, gt=0, le=1)
    top_rows: float = Field(0.25, ge=0, le=1)
    search_columns: int = Field(2, ge=1, le=8)
    band: float = Field(6.0, ge=0)
    # With 6 bad-2 of three pairs changed by .001 to .002, which proves nothing.
    smoothness: int = Field(4, ge=0)
    # Where rows lie 14 px apart (NASA K10), four rounds match 70.2 % of the pixels, three 69.5.
    rounds: int = Field(4, ge=0, le=32)
    threshold: float = Field(90.0, gt=0)
    denoise_from: float = Field(1.0, gt=0)
    texture: float = Field(0.5, ge=0)
    backmatch: float = Field(1.0, gt=0)
    speckle: int = Field(40, ge=1)
    fill_reach: int = Field(120, ge=0)
    correlation: float = Field(0.6, ge=-1, le=1)
    min_support: float = Field(0.0, ge=0, le=1)

    def kept(self, steps: Iterable[Step]) -> list[Step]:
        """Steps (functions) but for those that are left out by name."""
        return [step for step in steps if getattr(step, "__name__", "") not in self.without]

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            return {**PRESETS.get(str(values.get("preset")), {}), **values}
        return values
