"""The matcher on one page: the paper's steps (4.3) and ours, each preset as lists of steps; half the resolution."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.core.validity import Validity
from rille.stages.hfvm import coarse, finest, level
from rille.stages.hfvm.coarse import ImageDifference
from rille.stages.hfvm.image import as_matched, whole
from rille.stages.hfvm.image import tiles as cut
from rille.stages.hfvm.level import PyramidPair, Recipe
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import Pyramid

DEFAULT = Recipe(
    (level.search, level.propagate, level.median),
    (level.edges,),
    rounds=(2, 2),
    refinement=(finest.check, finest.refine, finest.landing, finest.speckles),
)
FAST = replace(DEFAULT, half=True)
ACCURATE = Recipe(
    (level.search, level.propagate, level.paths, level.median),
    (level.edges,),
    rounds=(4, 4),
    refinement=(finest.check, finest.refine, finest.smooth, finest.landing, finest.speckles),
)
RECIPES: Mapping[str, Recipe] = {"default": DEFAULT, "fast": FAST, "accurate": ACCURATE}

WHOLE = ("paper",)
"""Presets with a method of their own, see :mod:`rille.stages.hfvm.paper`."""


def local(params: HfvmParams) -> bool:
    """Whether all steps look at the surroundings of a pixel alone; paths and the relief reach over whole images."""
    if params.preset in WHOLE:
        return False
    recipe = RECIPES[params.preset]
    return not {level.paths, finest.smooth} & {*params.kept(recipe.every), *params.kept(recipe.refinement)}


def halves(params: HfvmParams, *levels: int) -> bool:
    """Whether images with so many levels are matched at half their resolution."""
    return RECIPES[params.preset].half and min(levels) > 1


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
    double = partial(cv2.resize, dsize=None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    big = {name: double(arrays[name])[:rows, :cols] for name in rest}
    u, v, inside = np.empty(valid.shape, np.float32), np.empty(valid.shape, np.float32), np.empty(valid.shape, bool)
    _doubled((arrays["column_disparity"], arrays["row_disparity"]), first, right, (u, v), inside)
    bits = big["validity"]
    gone = (valid == 0) | (~inside & (bits & Validity.MATCHED != 0))
    unmatched = bits & ~np.uint8(Validity.MATCHED | Validity.INTERPOLATED) | np.uint8(Validity.OUT_OF_IMAGE)
    np.copyto(bits, unmatched, where=gone)
    for a in (big["backmatch_error"], big["disparity_std"]):
        a *= 2
    for a in (u, v, big["disparity_std"]):
        np.copyto(a, np.float32(np.nan), where=gone)
    return {"column_disparity": u, "row_disparity": v, **big}


@kernel
def _doubled(small, first, right, big, inside):  # type: ignore[no-untyped-def]
    """Displacements twice as large, along their slopes, and whether they end in the right image."""
    (rows, cols), half = inside.shape, np.float32(0.5)
    for k in range(2):
        along, down = _slopes(small[k]), _slopes(small[k].T).T
        for y in range(rows):
            # From the middle of the four pixels half a pixel to either side.
            here, out, below = small[k][y // 2], big[k][y], half if y % 2 else -half
            for x in range(cols):
                beside = half if x % 2 else -half
                out[x] = 2 * here[x // 2] + down[y // 2, x // 2] * below + along[y // 2, x // 2] * beside
    u, v = big
    for y in range(rows):
        for x in range(cols):
            xr, yr = np.float32(x + first[0]) + u[y, x], np.float32(y + first[1]) + v[y, x]
            inside[y, x] = (xr >= 0) & (xr <= right[1] - 1) & (yr >= 0) & (yr <= right[0] - 1)


@kernel
def _slopes(a):  # type: ignore[no-untyped-def]
    """Slopes (row, col) of displacements along their rows, where alike on both sides, within a pixel; else 0."""
    out = np.zeros(a.shape, np.float32)
    for y in range(a.shape[0]):
        for x in range(1, a.shape[1] - 1):
            before, after = a[y, x] - a[y, x - 1], a[y, x + 1] - a[y, x]
            out[y, x] = np.float32(0.5) * (before + after) if abs(before - after) <= 1 else np.float32(0.0)
    return out


Tell = Callable[[float, str], None]
"""Progress callback: takes the share of the work done, 0..1, and the name of the next part."""


def silent(share: float, step: str) -> None:
    """Report no progress."""


class MatchOptions(NamedTuple):
    """Options of a match besides its parameters: progress callback ``tell``; ``side`` of a tile, pixels (None: whole
    images); number of ``threads``, which changes no bit of the result."""

    tell: Tell = silent
    side: int | None = None
    threads: int = 1


Arrays = dict[str, AnyArray]


def match(left: Pyramid, right: Pyramid, params: HfvmParams, options: MatchOptions) -> tuple[Arrays, ImageDifference]:
    """Dense displacements from the left image to the right one (4.3), step by step.

    Arrays of :class:`rille.stages.hfvm.stage.StereoMatches` by name, and how the right image differs.
    """
    if halves(params, left.levels, right.levels):
        half, unlike = match(left.above(1), right.above(1), halved(params), options)
        return doubled(half, left.valid[0], right.shape, (0, 0)), unlike.doubled()
    options.tell(0.0, "coarse levels")
    pyramids = as_matched(left, params), as_matched(right, params)
    images = PyramidPair(*pyramids, params, RECIPES[params.preset], options.threads)
    pair = coarse.match_coarse_levels(images)  # 4.3.1 features; 4.3.4 hierarchy; brightness, alignment
    options.tell(0.15, "fine levels")
    side = options.side if local(params) and images.levels > 1 else None
    windows = [whole(left.shape)] if side is None else cut(left.shape, side)
    # Threads take a window each, or both directions of the only one.
    pair = pair.with_threads(options.threads if len(windows) == 1 else 1)
    fine = {w: partial(finest.match_finest_level, pair, w) for w in windows}  # 4.3.4, 4.3.2, 4.3.3
    matches = finest.put_together(fine, left.shape, options.threads)
    options.tell(0.9, "filling")
    ending = finest.fit_lines_and_planes(pair, matches)
    final = {w: partial(finest.interpolate_undefined, pair, w, matches, ending) for w in windows}  # 4.3.4
    return finest.put_together(final, left.shape, options.threads), pair.unlike
