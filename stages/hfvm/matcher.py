"""The matcher on one page: the paper's steps (4.3) and ours, each preset as a list of steps; half the resolution."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.core.validity import Validity
from rille.stages.hfvm import coarse, finest, level
from rille.stages.hfvm.coarse import PriorDisparities
from rille.stages.hfvm.image import as_matched, whole
from rille.stages.hfvm.image import tiles as cut
from rille.stages.hfvm.level import LevelSteps, Views
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import Pyramid


@dataclass(frozen=True)
class Recipe:
    """A preset as a list of steps: of each level, of the start, and of the finest level after fractions of a pixel.

    ``half``: images are matched at half their resolution.
    """

    steps: LevelSteps
    begin: tuple[coarse.Step, ...]
    refinement: tuple[finest.Step, ...]
    planes: bool = True
    half: bool = False

    def less(self, without: tuple[str, ...]) -> Recipe:
        """The recipe without the steps of these names."""

        def kept(steps: tuple) -> tuple:
            return tuple(step for step in steps if step.__name__ not in without)

        steps = LevelSteps(kept(self.steps.every), kept(self.steps.finest), self.steps.rounds)
        refinement = kept(self.refinement)
        return Recipe(steps, kept(self.begin), refinement, self.planes and "planes" not in without, self.half)


DEFAULT = Recipe(
    LevelSteps((level.search, level.propagate, level.median), (level.edges,), rounds=(2, 2)),
    (coarse.even, coarse.known, coarse.align, coarse.turn),
    (finest.check, finest.refine, finest.landing, finest.speckles, finest.blanks),
)
FAST = replace(DEFAULT, planes=False, half=True)
ACCURATE = Recipe(
    LevelSteps((level.search, level.propagate, level.paths, level.median), (level.edges,), rounds=(4, 4)),
    (coarse.even, coarse.known, coarse.align, coarse.turn),
    (finest.check, finest.refine, finest.smooth, finest.landing, finest.speckles, finest.blanks),
)
RECIPES: Mapping[str, Recipe] = {"default": DEFAULT, "fast": FAST, "accurate": ACCURATE}

WHOLE = ("paper",)
"""Presets with a method of their own, see :mod:`rille.stages.hfvm.paper`."""


def recipe_of(params: HfvmParams) -> Recipe:
    """Steps of the preset, but for those that the parameters leave out."""
    return RECIPES.get(params.preset, DEFAULT).less(params.without)


def local(params: HfvmParams) -> bool:
    """Whether all steps look at the surroundings of a pixel alone; paths and the relief reach over whole images."""
    recipe = recipe_of(params)
    reaching = level.paths in recipe.steps.every or finest.smooth in recipe.refinement
    return params.preset not in WHOLE and not reaching


def halves(recipe: Recipe, *levels: int) -> bool:
    """Whether images with so many levels are matched at half their resolution."""
    return recipe.half and min(levels) > 1


def halved(params: HfvmParams) -> HfvmParams:
    """Parameters of a match at half the resolution."""
    # At half the side an area has a quarter of the pixels.
    return params.model_copy(
        update={
            "preset": "default",
            "without": (*params.without, "planes"),
            "speckle": max(params.speckle // 4, 1),
            "fill_reach": params.fill_reach // 2,
        }
    )


def doubled(
    arrays: Mapping[str, AnyArray], valid: AnyArray, right: tuple[int, ...], first: tuple[int, int]
) -> dict[str, AnyArray]:
    """Arrays of a window at full resolution that begins at column and row ``first``; ``right``: the image's shape.

    Both images' pixel centres shift alike, so that nothing is to be added. Slopes, which aligned images have, are
    followed. Where a displacement then leaves the right image, or a pixel is masked, it is undefined.
    """
    rows, cols = valid.shape
    rest = ("validity", "backmatch_error", "distance", "disparity_std")
    big = {name: arrays[name].repeat(2, axis=0)[:rows].repeat(2, axis=1)[:, :cols] for name in rest}
    u, v, inside = np.empty(valid.shape, np.float32), np.empty(valid.shape, np.float32), np.empty(valid.shape, bool)
    _doubled((arrays["column_disparity"], arrays["row_disparity"]), first, right, (u, v), inside)
    bits = big["validity"]
    gone = (valid == 0) | (~inside & (bits & Validity.MATCHED != 0))
    bits[gone] = bits[gone] & ~np.uint8(Validity.MATCHED | Validity.INTERPOLATED)
    bits[gone] |= np.uint8(Validity.OUT_OF_IMAGE)
    for a in (big["backmatch_error"], big["disparity_std"]):
        a *= 2
    for a in (u, v, big["disparity_std"]):
        np.copyto(a, np.float32(np.nan), where=gone)
    return {"column_disparity": u, "row_disparity": v, **big}


@njit(cache=True, nogil=True)
def _doubled(small, first, right, big, inside):  # type: ignore[no-untyped-def]
    """Displacements twice as large, along their slopes, and whether they end in the right image."""
    rows, cols = inside.shape
    u, v = big
    for k in range(2):
        a, out = small[k], big[k]
        for j in range(a.shape[0]):
            for i in range(a.shape[1]):
                along, down = _slope(a, j, i, 0, 1), _slope(a, j, i, 1, 0)
                for y in range(2 * j, min(2 * j + 2, rows)):
                    for x in range(2 * i, min(2 * i + 2, cols)):
                        # From the middle of the four pixels half a pixel to either side.
                        below, beside = np.float32(y - 2 * j - 0.5), np.float32(x - 2 * i - 0.5)
                        out[y, x] = 2 * a[j, i] + down * below + along * beside
    for y in range(rows):
        for x in range(cols):
            xr, yr = np.float32(x + first[0]) + u[y, x], np.float32(y + first[1]) + v[y, x]
            inside[y, x] = (xr >= 0) & (xr <= right[1] - 1) & (yr >= 0) & (yr <= right[0] - 1)


@njit(cache=True, nogil=True)
def _slope(a, y, x, down, along):  # type: ignore[no-untyped-def]
    """Slope of displacements where it is alike on both sides, within a pixel; else 0."""
    if y < down or x < along or y + down >= a.shape[0] or x + along >= a.shape[1]:
        return np.float32(0.0)
    before, after = a[y, x] - a[y - down, x - along], a[y + down, x + along] - a[y, x]
    return np.float32(0.5) * (before + after) if abs(before - after) <= 1 else np.float32(0.0)


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


def match(left: Pyramid, right: Pyramid, params: HfvmParams, prior: PriorDisparities | None, how: How) -> MatchResult:
    """Dense displacements from the left image to the right one (4.3), step by step."""
    recipe = recipe_of(params)
    if halves(recipe, left.levels, right.levels):
        return enlarged(
            match(left.above(1), right.above(1), halved(params), prior and prior.halved(), how), left, right
        )
    how.tell(0.0, "coarse levels")
    images = as_matched(left, params), as_matched(right, params)
    views = Views(*images, params, recipe.steps, how.threads)
    pair = coarse.begin(views, recipe.begin, prior)  # 4.3.1 features; 4.3.4 hierarchy; brightness, alignment
    side = how.side if local(params) and views.levels > 1 else None
    windows = [whole(left.shape)] if side is None else cut(left.shape, side)
    # Threads take a window each, or both directions of the only one.
    pair = pair.with_threads(how.threads if len(windows) == 1 else 1)
    how.tell(0.15, "fine levels")
    fine = {w: partial(finest.fine, pair, recipe.refinement, w) for w in windows}  # 4.3.4, 4.3.2, 4.3.3
    arrays = finest.put_together(fine, left.shape, how.threads)
    how.tell(0.9, "filling")
    ending = finest.ending(pair, arrays, recipe.planes)
    final = {w: partial(finest.final, pair, w, arrays, ending) for w in windows}  # 4.3.4
    return MatchResult(finest.put_together(final, left.shape, how.threads), pair.alignment is not None)


def enlarged(result: MatchResult, left: Pyramid, right: Pyramid) -> MatchResult:
    """Results of half the resolution at the full one: each displacement, doubled, for 2 x 2 pixels."""
    return MatchResult(doubled(result.arrays, left.valid[0], right.shape, (0, 0)), result.aligned)
