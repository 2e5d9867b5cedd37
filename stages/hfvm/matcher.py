"""The matcher on one page: the paper's steps (4.3) and ours; each preset's are listed in ``presets``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import coarse, enlarge, start, tiles
from rille.stages.hfvm.image import view
from rille.stages.hfvm.level import Views
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.presets import halved, halves, local, recipe_of
from rille.stages.hfvm.windows import tiles as cut
from rille.stages.hfvm.windows import whole
from rille.stages.imaging.pyramid import Pyramid

Tell = Callable[[float, str], None]
"""Called with the share of the work done, 0..1, and what comes next in words."""


def silent(share: float, step: str) -> None:
    """Tell nothing."""


class How(NamedTuple):
    """How a pair is matched. ``tell``: called with the progress. ``side``: pixels of a tile, None: the whole image.
    ``threads``: that share the work; they change no bit of the result."""

    tell: Tell = silent
    side: int | None = None
    threads: int = 1


@dataclass(frozen=True)
class MatchResult:
    """Arrays of :class:`rille.stages.hfvm.stage.StereoMatches` by name, and whether the right image was aligned."""

    arrays: Mapping[str, AnyArray]
    aligned: bool


def match(
    left: Pyramid, right: Pyramid, params: HfvmParams, prior: start.PriorDisparities | None, how: How
) -> MatchResult:
    """Dense displacements from the left image to the right one (4.3), step by step."""
    recipe = recipe_of(params)
    if halves(recipe, left.levels, right.levels):
        return enlarged(match(left.above(1), right.above(1), halved(params), start.halved(prior), how), left, right)
    how.tell(0.0, "coarse levels")
    images = view(left, params), view(right, params)
    views = Views(*images, params, recipe.steps, how.threads)
    pair = coarse.begin(views, recipe.begin, prior)  # 4.3.1 features; 4.3.4 hierarchy; brightness, alignment
    side = how.side if local(params) and views.levels > 1 else None
    windows = [whole(left.shape)] if side is None else cut(left.shape, side)
    # Threads take a window each, or both directions of the only one.
    pair = pair.with_threads(how.threads if len(windows) == 1 else 1)
    how.tell(0.15, "fine levels")
    fine = {w: partial(tiles.fine, pair, recipe.refinement, w) for w in windows}  # 4.3.4, 4.3.2, 4.3.3
    arrays = tiles.put_together(fine, left.shape, how.threads)
    how.tell(0.9, "filling")
    ending = tiles.ending(pair, arrays, recipe.planes)
    final = {w: partial(tiles.final, pair, w, arrays, ending) for w in windows}  # 4.3.4
    return MatchResult(tiles.put_together(final, left.shape, how.threads), pair.alignment is not None)


def enlarged(result: MatchResult, left: Pyramid, right: Pyramid) -> MatchResult:
    """Results of half the resolution at the full one: each displacement, doubled, for 2 x 2 pixels."""
    return MatchResult(enlarge.doubled(result.arrays, left.valid[0], right.shape, (0, 0)), result.aligned)
