"""Hierarchical feature vector matching: dense two-dimensional disparities of any two images (paper, 4.3).

Nothing is rectified and no calibration is used. ``match`` works on plain arrays; see :class:`HfvmParams` for the
presets. Modules, in the order of the dataflow: ``hierarchy`` (coarse to fine), ``search`` (one level, fast), ``paper``
(one level, to the letter), ``epipolar`` (soft band), ``plane`` (pre-alignment), ``subpixel``, ``consistency``
(back-matching, filling), ``refine``, ``uncertainty``; ``start`` (disparities known beforehand). Preset ``accurate``:
``paths`` and ``compact`` (propagation along paths), ``relief`` (sub-pixel), ``guided`` (filling).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages import pyramid
from stages.declare import AnyArray, Array, Bundle, Inputs, Stage
from stages.hfvm import (
    accurate,
    consistency,
    guided,
    hierarchy,
    plane,
    refine,
    relief,
    resample,
    rowwise,
    start,
    uncertainty,
)
from stages.hfvm.params import HfvmParams
from stages.pyramid import Pyramid, PyramidParams
from stages.validity import Mask, Validity, counts, mark, matched

__all__ = ["STAGE", "Disparity", "HfvmParams", "match", "match_pyramids"]

Map = NDArray[np.float32]

Tell = Callable[[float, str], None]
"""Called with the share of the work done, 0..1, and what comes next in words."""

COARSE_SHARE, FINE_SHARE = 0.15, 0.65
"""Share of the time when the coarse levels are done, and when all whole-pixel maps are; a level costs four times the
one above."""


@dataclass(frozen=True)
class Disparity:
    """Disparity vectors of the left image, right minus left: ``x_right = x_left + column_disparity``.

    All arrays are (row, col) of the left image. ``column_disparity, row_disparity``: float32 pixels, NaN undefined;
    interpolated ones included. ``validity``: bits of :class:`~stages.validity.Validity`. ``backmatch_error``: float32
    pixels, NaN where the match leaves the right image. ``distance``: float32 mean feature distance at the whole-pixel
    match (byte steps; preset ``paper``: Eq. 1, grey levels), NaN where back-matching failed by far. ``disparity_std``:
    float32 pixels, standard deviation of the column disparity (see :mod:`~stages.hfvm.uncertainty`), NaN where not
    ``MATCHED``. ``aligned``: whether the right image was pre-aligned by a plane.
    """

    column_disparity: Map
    row_disparity: Map
    validity: Mask
    backmatch_error: Map
    distance: Map
    disparity_std: Map
    aligned: bool


def match(
    left: AnyArray,
    right: AnyArray,
    params: HfvmParams | None = None,
    *,
    left_valid: AnyArray | None = None,
    right_valid: AnyArray | None = None,
    prior: tuple[AnyArray, AnyArray] | None = None,
    tell: Tell | None = None,
) -> Disparity:
    """Dense disparity vectors from ``left`` to ``right``, searched in two dimensions.

    Parameters
    ----------
    left, right : (row, col) grey images, uint8, uint16 or floating point 0..255; sizes may differ.
    params : matcher's parameters; None: preset ``default``.
    left_valid, right_valid : (row, col), not zero where usable; None: everywhere.
    prior : column and row disparities of the left image, pixels, NaN undefined, to start from (see
        :mod:`stages.hfvm.start`); None: nothing is known.
    tell : told of the progress.

    Raises
    ------
    InputError
        An image is not grey or empty, or a mask or the prior has another shape.

    Notes
    -----
    Kolesnik, Paar, Bauer, Ulm (1999), section 4.3. Images without texture or overlap give no error: nothing is
    ``MATCHED``, and the other bits say why.
    """
    levels = PyramidParams()
    a, b = pyramid.build(left, levels, left_valid), pyramid.build(right, levels, right_valid)
    return match_pyramids(a, b, params or HfvmParams(), start.check(prior, left.shape), tell)


def match_pyramids(
    left: Pyramid,
    right: Pyramid,
    params: HfvmParams,
    prior: start.Prior | None = None,
    tell: Tell | None = None,
) -> Disparity:
    """As :func:`match`, of two image pyramids."""
    tell = tell or (lambda share, step: None)
    if params.finest and min(left.levels, right.levels) > params.finest:
        return _enlarged(left, right, params, prior, tell)
    tell(0.0, "features")
    pair = accurate.extend(hierarchy.prepare(left, right, params), left, right, params)
    coarse = start.impose(pair, params, hierarchy.run(pair, params, params.plane_level), prior)
    alignment = plane.find(pair, coarse, params) if params.preset != "paper" else None
    if alignment is not None:
        tell(COARSE_SHARE, "alignment")
        warped = plane.align(right, alignment, left.images[0].shape, PyramidParams(levels=left.levels))
        pair = accurate.extend(hierarchy.prepare(left, warped, params), left, warped, params)
        moved = start.align(prior, alignment)
        coarse = hierarchy.run(pair, params, params.plane_level, near_sign=coarse.near_sign)
        coarse = start.impose(pair, params, coarse, moved)
    state = _descend(pair, params, coarse, tell)
    tell(FINE_SHARE, "sub-pixel and refinement")
    return _finish(left, right, pair, state, params, alignment)


def _descend(pair: hierarchy.Prepared, params: HfvmParams, state: hierarchy.State, tell: Tell) -> hierarchy.State:
    """Match the levels below ``state``."""
    for level in range(state.level - 1, -1, -1):
        tell(COARSE_SHARE + (FINE_SHARE - COARSE_SHARE) * 0.25 ** (level + 1), f"level {level}")
        state = hierarchy.run(pair, params, level, state)
    return state


def _enlarged(left: Pyramid, right: Pyramid, params: HfvmParams, prior: start.Prior | None, tell: Tell) -> Disparity:
    """Matched at half the resolution; displacements, twice as great, stand for 2 x 2 pixels each."""
    half = params.model_copy(
        update={"finest": 0, "speckle": max(params.speckle // 4, 1), "fill_reach": params.fill_reach // 2}
    )
    left_half, right_half = (Pyramid(p.images[1:], p.valid[1:]) for p in (left, right))
    coarse_prior = None if prior is None else start.Prior(0.5 * prior.u[::2, ::2], 0.5 * prior.v[::2, ::2])
    found = match_pyramids(left_half, right_half, half, coarse_prior, tell)
    shape = left.images[0].shape
    u, v, error, distance = (np.empty(shape, np.float32) for _ in range(4))
    validity = np.empty(shape, np.uint8)
    maps = (found.column_disparity, found.row_disparity, found.validity, found.backmatch_error, found.distance)
    resample.enlarge(*maps, left.valid[0], right.images[0].shape, u, v, validity, error, distance)
    std = 2.0 * found.disparity_std.repeat(2, axis=0)[: shape[0]].repeat(2, axis=1)[:, : shape[1]]
    std = np.where(matched(validity), std, np.float32(np.nan)).astype(np.float32)
    return Disparity(u, v, validity, error, distance, std, found.aligned)


def _finish(
    left: Pyramid,
    right: Pyramid,
    pair: hierarchy.Prepared,
    state: hierarchy.State,
    params: HfvmParams,
    alignment: plane.Matrix | None,
) -> Disparity:
    """Sub-pixel, validity, refinement and filling at level 0."""
    forward, error = _fine(pair, state, params)
    validity = _reasons(pair, forward, error, params)
    u, v = forward.u, forward.v
    if alignment is not None:
        u, v = plane.compose(alignment, u, v)
    keep = validity == 0
    if params.preset != "paper":
        mean_u, mean_v = np.empty_like(u), np.empty_like(v)
        rowwise.local_mean(u, v, keep, hierarchy.SUM_RADIUS, mean_u, mean_v)
        u, v = mean_u, mean_v
    rest: AnyArray | None = None
    image = right.images[0]
    if params.refine:
        image = refine.level_contrast(left.images[0], right.images[0], u, v, keep)
        u, v, rest = refine.refine(left.images[0], image, right.valid[0], u, v, keep, params)
        alike = refine.correlation(rest, pair.deviation[0], keep)
        mark(validity, keep & (alike < params.correlation), Validity.OVER_THRESHOLD)
    if params.relief_steps:
        u, v = relief.fit(left.images[0], image, right.valid[0], u, v, validity == 0, params)
    mark(validity, keep & ~consistency.lands(u, v, keep, right.valid[0]), Validity.OUT_OF_IMAGE)
    keep = validity == 0
    gone = consistency.unsupported(forward.u, forward.v, keep, params.speckle)
    # Lonely matches are too uncertain to count as measured, but still the best guess where they are.
    lonely = consistency.lonely(keep & ~gone, params.crowd)
    mark(validity, gone | lonely, Validity.SPECKLE)
    interpolated = lonely.astype(np.uint8)
    consistency.fill_rows(u, v, keep & ~gone, params.fill_reach, state.near_sign or -1.0, interpolated)
    keep &= ~gone & ~lonely
    std = uncertainty.standard_deviation(left.images[0], rest, u, keep, params)
    unsure = keep & (std > params.greatest_std) if params.greatest_std is not None else np.zeros_like(keep)
    mark(validity, unsure, Validity.OVER_THRESHOLD)
    interpolated[unsure], std[unsure] = 1, np.nan
    keep &= ~unsure
    mark(validity, keep, Validity.MATCHED)
    interpolated[left.valid[0] == 0] = 0
    if params.guided_fill:
        u, v = guided.median(u, v, keep, interpolated, left.images[0])
    validity |= interpolated * np.uint8(Validity.INTERPOLATED)
    nothing = ~(keep | (interpolated != 0))
    u[nothing] = v[nothing] = np.nan
    error[error >= consistency.FAILED] = np.nan
    distance = np.where(forward.distance < 0, np.float32(np.nan), forward.distance)
    return Disparity(u, v, validity, error, distance, std, alignment is not None)


def _fine(pair: hierarchy.Prepared, state: hierarchy.State, params: HfvmParams) -> tuple[hierarchy.Fine, Map]:
    """Sub-pixel left map, and its sub-pixel back-matching error."""
    # Sub-pixel work pays only where the whole-pixel maps nearly agree.
    reach = params.backmatch + 1.0
    near = hierarchy.integer_error(state.left, state.right, pair.right_valid[0]) <= reach
    near_right = hierarchy.integer_error(state.right, state.left, pair.left_valid[0]) <= reach
    forward = pair.solver.fine(0, state.left, near)
    backward = pair.solver.reverse().fine(0, state.right, near_right)
    error = np.empty(forward.u.shape, np.float32)
    consistency.backmatch(forward.u, forward.v, backward.u, backward.v, pair.right_valid[0], error)
    return forward, error


def _reasons(pair: hierarchy.Prepared, fine: hierarchy.Fine, error: AnyArray, params: HfvmParams) -> Mask:
    """Bits that speak against each pixel, none where it is consistent."""
    bits = np.zeros(error.shape, np.uint8)
    outside = (error >= consistency.FAILED) | (pair.left_valid[0] == 0)
    mark(bits, outside, Validity.OUT_OF_IMAGE)
    mark(bits, fine.distance > params.threshold, Validity.OVER_THRESHOLD)
    mark(bits, pair.deviation[0] < params.texture, Validity.NO_TEXTURE)
    mark(bits, ~outside & (error > params.backmatch), Validity.BACKMATCH_FAILED)
    return bits


def _run(params: HfvmParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    found = match_pyramids(Pyramid.from_bundle(inputs["left"]), Pyramid.from_bundle(inputs["right"]), params)
    arrays: dict[str, AnyArray] = {
        "column_disparity": found.column_disparity,
        "row_disparity": found.row_disparity,
        "validity": found.validity,
        "backmatch_error": found.backmatch_error,
        "distance": found.distance,
        "disparity_std": found.disparity_std,
    }
    usable = int(np.count_nonzero(Pyramid.from_bundle(inputs["left"]).valid[0]))
    bits = counts(found.validity)
    ok = matched(found.validity)
    meta = {
        "preset": params.preset,
        "aligned": found.aligned,
        "usable": usable,
        "match_rate": bits["matched"] / usable if usable else None,
        "counts": bits,
        "median_column_disparity": float(np.median(found.column_disparity[ok])) if ok.any() else None,
        "median_row_disparity": float(np.median(found.row_disparity[ok])) if ok.any() else None,
        "median_disparity_std": float(np.median(found.disparity_std[ok])) if ok.any() else None,
    }
    return Bundle(arrays, meta)


_GRID = ("row", "col")
STAGE = Stage(
    name="hfvm",
    version=2,
    summary="dense two-dimensional disparities of a stereo pair by hierarchical feature vector matching",
    params=HfvmParams,
    inputs=("left", "right"),
    outputs=(
        Array(
            "column_disparity", _GRID, "float32", "px", "column in the right image minus column", "nan", "left image"
        ),
        Array("row_disparity", _GRID, "float32", "px", "row in the right image minus row", "nan", "left image"),
        Array("validity", _GRID, "uint8", "1", "bit mask, see stages.validity", "", "left image"),
        Array("backmatch_error", _GRID, "float32", "px", "error of matching there and back", "nan", "left image"),
        Array("distance", _GRID, "float32", "1", "least feature distance", "nan", "left image"),
        Array(
            "disparity_std", _GRID, "float32", "px", "standard deviation of the column disparity", "nan", "left image"
        ),
    ),
    requires=("numpy", "numba", "opencv-python-headless"),
    run=_run,
)
