"""Whether to believe disparities that another program made, pixel by pixel.

They are checked against the images. Columns are the other program's. A pixel counts as matched if it passes the
matcher's own checks: feature distance, the way back, correlation of the windows, size of its patch
(:mod:`~rille.stages.hfvm.finest`). The way back is matched in the right image itself, at the finest level, from the map
as the right camera sees it: where a depth edge lies too far out, or a hidden pixel has its neighbour's disparity, the
right image leads elsewhere. In SGBM's maps without its own checks .105 of the pixels with truth of Middlebury's chosen
half are off by 2 px, .111 of the judged half; .021 and .017 are off and count as matched. With the map itself for the
way back .040 and .035 did.

A map of disparities says nothing of rows; the images do. How far refinement would move a column is part of the standard
deviation: 65 and 89 % of the matched pixels of the chosen half err by at most one and two of it, 61 and 86 % of the
judged half; without this part 60 and 86, 56 and 82. 2026-11-26."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray, Bundle, Memory, stage
from rille.stages.core.validity import Validity, matched
from rille.stages.facts.matching import DisparityFacts
from rille.stages.hfvm import finest, matcher, refinement
from rille.stages.hfvm.brightness import MIN_LOG_RATIO, greatest, levelled, ratio_of_matches
from rille.stages.hfvm.coarse import ImageDifference
from rille.stages.hfvm.finest import Ending, FinestWork, lands
from rille.stages.hfvm.image import Shape, as_matched
from rille.stages.hfvm.level import FREE_BAND, NEAR_SIGN, PyramidPair, State, one_way
from rille.stages.hfvm.map_reading import better_reading
from rille.stages.hfvm.native.problem import Map
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import OUTPUTS, facts
from rille.stages.imaging.pyramid import Pyramid

MIN_BORNE_OUT = 0.1
"""Share of the known pixels of a map that the images bear out, below which it is read otherwise; of a map of the
matcher's quality it is 0.8."""


def of_right_image(left: Pyramid, right: Pyramid, column: AnyArray, params: HfvmParams, own: float) -> bool:
    """Whether a map, of which the images bear out a share as the left one's, is the right image's, as they see it."""
    # Of five of Middlebury's pairs .14 to .52 of the right image's map are borne out, .45 to .90 of the left one's.
    if own >= 0.6:
        return False
    moved, hit = _reverse(-column, np.isfinite(column), left.shape, -NEAR_SIGN)
    moved[~hit] = np.nan
    return borne_out(check(left, right, moved, params), moved) > max(MIN_BORNE_OUT, 1.3 * own)


def borne_out(arrays: dict[str, AnyArray], column: AnyArray) -> float:
    """Share of the known pixels of a map that :func:`check` counts as matched; 1: none is known."""
    known = int(np.count_nonzero(np.isfinite(column)))
    return int(np.count_nonzero(matched(arrays["validity"]))) / known if known else 1.0


def check(left: Pyramid, right: Pyramid, column: AnyArray, params: HfvmParams) -> dict[str, AnyArray]:
    """Arrays of :class:`~rille.stages.hfvm.stage.StereoMatches` of given column displacements (row, col), NaN unknown.

    ``params``: thresholds of the checks; those of preset ``paper`` have other units, and the default's are taken.
    """
    params = HfvmParams() if params.preset in matcher.WHOLE else params
    # Displacements of a level are 16-bit and doubled from level to level. NaN is not less, and so unknown as well.
    known = np.abs(column) < 16000
    u = np.where(known, column, 0.0).astype(np.float32)
    zeros = np.zeros_like(u)
    there = Map(np.rint(u).astype(np.int16), np.zeros(u.shape, np.int16))
    a, b = as_matched(left, params), as_matched(right, params)
    inside = lands(np.rint(u), zeros, known, right.valid[0])
    ratio = ratio_of_matches(a, b, State(0, there, there, inside, inside, FREE_BAND, NEAR_SIGN))
    if ratio is not None and greatest(ratio) > MIN_LOG_RATIO:
        b = levelled(b, ratio)
    images, left_layer, right_layer = PyramidPair(a, b, params, matcher.DEFAULT), a.layers[0], b.layers[0]
    work = FinestWork(
        left_layer, right_layer, right_layer, there, _way_back(images, np.where(known, u, np.float32(np.nan))), images
    )
    fine = finest.check(work, replace(finest.subpixel(work), u=u))
    fine = replace(fine, validity=fine.against(~known, Validity.OVER_THRESHOLD))
    fine = finest.refine(work, fine)
    # Scaled as the noise will be.
    moved = ((fine.u - u) / np.float32(refinement.NOISE_FACTOR)) ** 2
    fine = replace(fine, u=u, noise=fine.noise + moved)
    results = asdict(finest.speckles(work, finest.landing(work, fine)))
    lines = finest.fitted_lines(results, (left_layer.shape, right_layer.shape))
    return finest.complete(results, left_layer.valid, left_layer.window, params, Ending(left_layer.shape, f=lines))


def _way_back(images: PyramidPair, column: AnyArray) -> Map:
    """Displacements of the right image, matched at the finest level near the given ones (row, col), NaN unknown."""
    above = None
    if images.levels > 1:
        right = images.right.layers[1]
        # One of the pixels below each: of a block across a depth edge the mean would lie on neither surface.
        column = column[::2, ::2]
        known = np.isfinite(column)
        u = np.rint(np.where(known, column, 0.0) / 2).astype(np.int16)
        back, hit = _reverse(u, known, right.shape)
        maps = Map(back, np.zeros_like(back)), Map(u, np.zeros_like(u))
        above = State(1, *maps, hit & (right.valid != 0), known, FREE_BAND, -NEAR_SIGN)
    return one_way(images.reverse(), 0, above, -NEAR_SIGN, images.recipe.rounds[1])


def _reverse(
    u: AnyArray, known: NDArray[np.bool_], shape: Shape, near_sign: float = NEAR_SIGN
) -> tuple[AnyArray, NDArray[np.bool_]]:
    """Column displacements of the other image, of ``shape``, and where they are known: each one at its end."""
    y, x = np.nonzero(known)
    # From far to near, since of several that end at a pixel the last one stays: the one that hides the others.
    order = np.argsort(near_sign * u[y, x].astype(np.float64), kind="stable")
    y, x = y[order], x[order]
    end = x + np.rint(u[y, x]).astype(np.intp)
    inside = (end >= 0) & (end < shape[1]) & (y < shape[0])
    y, x, end = y[inside], x[inside], end[inside]
    back, hit = np.zeros(shape, u.dtype), np.zeros(shape, bool)
    back[y, end], hit[y, end] = -u[y, x], True
    return back, hit


@stage("hfvm_given", outputs=OUTPUTS, memory=Memory(fixed=30e6, factor=10.0, result=1.6))
def hfvm_given_stage(params: HfvmParams, left: Bundle, right: Bundle, given: Bundle) -> Bundle[DisparityFacts]:
    """Disparities that another program made, checked against the images of a stereo pair."""
    a, b = Pyramid.from_bundle(left), Pyramid.from_bundle(right)
    arrays = check(a, b, np.asarray(given["column_disparity"]), params)
    if "disparity_std" in given.arrays:
        # Where a map of it says nothing the estimate stays.
        stated = matched(arrays["validity"]) & (given["disparity_std"] > 0)
        arrays["disparity_std"] = np.where(stated, given["disparity_std"], arrays["disparity_std"])
    said = facts(arrays, params, ImageDifference(), int(np.count_nonzero(a.valid[0])))
    column = np.asarray(given["column_disparity"])
    own, doubt = borne_out(arrays, column), "the maps of [disparity]"
    if "damage" in given.meta:
        said["warnings"] = [f"{given.meta['damage']}: its pair has no disparities"]
    elif of_right_image(a, b, column, params, own):
        said["warnings"] = [f"{doubt} are those of the right images: give those of the left ones"]
    elif own < MIN_BORNE_OUT:
        fit = better_reading(a.images[0], b.images[0], column)
        how = (
            f"they fit with {fit}: correct them, or [disparity]" if fit else "are they of these left images, in pixels?"
        )
        said["warnings"] = [f"{doubt} contradict the images: {how}"]
    return Bundle(arrays, said)
