"""Disparities that another program made, checked against the images: which to believe, and how far.

Columns are the other program's. A pixel counts as matched if it passes the matcher's own checks: feature distance, the
way back, correlation of the windows, size of its patch (:mod:`~rille.stages.hfvm.finest`). The way back is matched in
the right image itself, at the finest level, from the map as the right camera sees it: where a depth edge lies too far
out, or a hidden pixel has its neighbour's disparity, the right image leads elsewhere. In SGBM's maps without its own
checks .105 of the pixels with truth of Middlebury's chosen half are off by 2 px, .111 of the judged half; .021 and .017
are off and count as matched. With the map itself for the way back .040 and .035 did.

A map of disparities says nothing of rows; the images do. How far refinement would move a column is part of the standard
deviation: 65 and 89 % of the matched pixels of the chosen half err by at most one and two of it, 61 and 86 % of the
judged half; without this part 60 and 86, 56 and 82. 2026-11-26.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from rille.stages.core.declare import AnyArray, Bundle, Memory, stage
from rille.stages.core.validity import Validity, matched
from rille.stages.facts.matching import DisparityFacts
from rille.stages.hfvm import brightness, finest, presets, start, uncertainty
from rille.stages.hfvm.finest import Ending, FinestWork
from rille.stages.hfvm.image import view
from rille.stages.hfvm.level import FREE_BAND, Map, State, Views, one_way
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import OUTPUTS, facts
from rille.stages.hfvm.validation import lands
from rille.stages.hfvm.windows import Shape, whole
from rille.stages.imaging.pyramid import Pyramid

NEAR_SIGN = -1.0
"""Between parallel cameras nearer things have lesser column displacements (see ``level.State``)."""


def check(left: Pyramid, right: Pyramid, given: start.PriorDisparities, params: HfvmParams) -> dict[str, AnyArray]:
    """Arrays of :class:`~rille.stages.hfvm.stage.StereoMatches` of given displacements, of which columns are kept.

    ``params``: thresholds of the checks; those of preset ``paper`` have other units, and the default's are taken.
    """
    params = HfvmParams() if params.preset in presets.WHOLE else params
    known = np.isfinite(given.u)
    u, zeros = np.where(known, given.u, np.float32(0.0)), np.zeros_like(given.u)
    there = Map(np.rint(u).astype(np.int16), np.zeros(u.shape, np.int16))
    a, b = view(left, params), view(right, params)
    inside = lands(np.rint(u), zeros, known, right.valid[0])
    ratio = brightness.matched(a, b, State(0, there, there, inside, inside, FREE_BAND, NEAR_SIGN))
    if ratio is not None and brightness.greatest(ratio) > brightness.MIN_LOG_RATIO:
        b = brightness.levelled(b, ratio)
    back = _way_back(Views(a, b, params, presets.recipe_of(params).steps), given)
    left_layer, right_layer = a.layers[0], b.layers[0]
    work = FinestWork(
        left_layer, right_layer, right_layer, there, back, params, None, (a.noise, b.noise), left_layer.shape
    )
    fine = finest.check(work, replace(finest.subpixel(work), u=u))
    fine = replace(fine, validity=fine.against(~known, Validity.OVER_THRESHOLD))
    fine = finest.refine(work, fine)
    # Scaled as the noise will be.
    moved = ((fine.u - u) / np.float32(uncertainty.NOISE_FACTOR)) ** 2
    fine = replace(fine, u=u, noise=fine.noise + moved)
    for step in (finest.landing, finest.speckles, finest.blanks):
        fine = step(work, fine)
    results = asdict(fine)
    ending = Ending(
        NEAR_SIGN, None, finest.lines(results, (left_layer.shape, right_layer.shape)), None, left_layer.shape
    )
    return finest.complete(results, left_layer.valid, whole(left_layer.shape), params, ending)


def _way_back(views: Views, given: start.PriorDisparities) -> Map:
    """Displacements of the right image, matched at the finest level near the given ones."""
    above = None
    if views.levels > 1:
        left, right = (_nothing(image.shapes[1]) for image in (views.left, views.right))
        unknown = np.zeros(left.u.shape, bool), np.zeros(right.u.shape, bool)
        above = start.impose(views, State(1, left, right, *unknown, FREE_BAND, NEAR_SIGN), given).reverse()
    return one_way(views.reverse(), 0, above, -NEAR_SIGN, views.steps.rounds[1])


def _nothing(shape: Shape) -> Map:
    """No displacement anywhere."""
    return Map(np.zeros(shape, np.int16), np.zeros(shape, np.int16))


@stage("hfvm_given", outputs=OUTPUTS, memory=Memory(fixed=30e6, factor=10.0, result=1.6))
def hfvm_given_stage(params: HfvmParams, left: Bundle, right: Bundle, given: Bundle) -> Bundle[DisparityFacts]:
    """Disparities that another program made, checked against the images of a stereo pair."""
    a, b = Pyramid.from_bundle(left), Pyramid.from_bundle(right)
    column = np.asarray(given["column_disparity"])
    prior = start.check((column, np.zeros_like(column)), a.shape)
    assert prior is not None
    arrays = check(a, b, prior, params)
    if "disparity_std" in given.arrays:
        # Where a map of it says nothing the estimate stays.
        stated = matched(arrays["validity"]) & (given["disparity_std"] > 0)
        arrays["disparity_std"] = np.where(stated, given["disparity_std"], arrays["disparity_std"])
    return Bundle(arrays, facts(arrays, params, False, int(np.count_nonzero(a.valid[0]))))
