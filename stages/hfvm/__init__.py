"""Hierarchical feature vector matching: dense two-dimensional disparities of any two images (paper, 4.3).

Nothing is rectified and no calibration is used. ``match`` works on plain arrays; see :class:`HfvmParams` for the two
presets. Modules, in the order of the dataflow: ``hierarchy`` (coarse to fine), ``search`` (one level, fast), ``paper``
(one level, to the letter), ``epipolar`` (soft band), ``plane`` (pre-alignment), ``subpixel``, ``consistency``
(back-matching, filling), ``refine``. Preset ``accurate``: ``paths`` and ``compact`` (propagation along paths),
``relief`` (sub-pixel), ``guided`` (filling).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages import pyramid
from stages.declare import AnyArray, Array, Bundle, Inputs, Stage
from stages.hfvm import accurate, consistency, guided, hierarchy, plane, refine, relief, resample, rowwise
from stages.hfvm.params import HfvmParams
from stages.pyramid import Pyramid, PyramidParams
from stages.validity import Mask, Validity, counts, mark, matched

__all__ = ["STAGE", "Disparity", "HfvmParams", "match", "match_pyramids"]

Map = NDArray[np.float32]


@dataclass(frozen=True)
class Disparity:
    """Disparity vectors of the left image, right minus left: ``x_right = x_left + column_disparity``.

    All arrays are (row, col) of the left image. ``column_disparity, row_disparity``: float32 pixels, NaN undefined;
    interpolated ones included. ``validity``: bits of :class:`~stages.validity.Validity`. ``backmatch_error``: float32
    pixels, NaN where the match leaves the right image. ``distance``: float32 mean feature distance at the whole-pixel
    match (byte steps; preset ``paper``: Eq. 1, grey levels), NaN where back-matching failed by far. ``aligned``:
    whether the right image was pre-aligned by a plane.
    """

    column_disparity: Map
    row_disparity: Map
    validity: Mask
    backmatch_error: Map
    distance: Map
    aligned: bool


def match(
    left: AnyArray,
    right: AnyArray,
    params: HfvmParams | None = None,
    *,
    left_valid: AnyArray | None = None,
    right_valid: AnyArray | None = None,
) -> Disparity:
    """Dense disparity vectors from ``left`` to ``right``, searched in two dimensions.

    Parameters
    ----------
    left, right : (row, col) grey images, uint8, uint16 or floating point 0..255; sizes may differ.
    params : matcher's parameters; None: preset ``default``.
    left_valid, right_valid : (row, col), not zero where usable; None: everywhere.

    Raises
    ------
    InputError
        An image is not grey or empty, or a mask has another shape.

    Notes
    -----
    Kolesnik, Paar, Bauer, Ulm (1999), section 4.3. Images without texture or overlap give no error: nothing is
    ``MATCHED``, and the other bits say why.
    """
    levels = PyramidParams()
    return match_pyramids(
        pyramid.build(left, levels, left_valid), pyramid.build(right, levels, right_valid), params or HfvmParams()
    )


def match_pyramids(left: Pyramid, right: Pyramid, params: HfvmParams) -> Disparity:
    """As :func:`match`, of two image pyramids."""
    if params.finest and min(left.levels, right.levels) > params.finest:
        return _enlarged(left, right, params)
    pair = accurate.extend(hierarchy.prepare(left, right, params), left, right, params)
    if params.preset == "paper":
        return _finish(left, right, pair, hierarchy.run(pair, params, 0), params, None)
    coarse = hierarchy.run(pair, params, params.plane_level)
    alignment = plane.find(pair, coarse, params)
    if alignment is None:
        state = hierarchy.run(pair, params, 0, coarse) if coarse.level > 0 else coarse
        return _finish(left, right, pair, state, params, None)
    warped = plane.align(right, alignment, left.images[0].shape, PyramidParams(levels=left.levels))
    pair = accurate.extend(hierarchy.prepare(left, warped, params), left, warped, params)
    state = hierarchy.run(pair, params, 0, near_sign=coarse.near_sign)
    return _finish(left, right, pair, state, params, alignment)


def _enlarged(left: Pyramid, right: Pyramid, params: HfvmParams) -> Disparity:
    """Matched at half the resolution; displacements, twice as great, stand for 2 x 2 pixels each."""
    half = params.model_copy(
        update={"finest": 0, "speckle": max(params.speckle // 4, 1), "fill_reach": params.fill_reach // 2}
    )
    left_half, right_half = (Pyramid(p.images[1:], p.valid[1:]) for p in (left, right))
    found = match_pyramids(left_half, right_half, half)
    shape = left.images[0].shape
    u, v, error, distance = (np.empty(shape, np.float32) for _ in range(4))
    validity = np.empty(shape, np.uint8)
    maps = (found.column_disparity, found.row_disparity, found.validity, found.backmatch_error, found.distance)
    resample.enlarge(*maps, left.valid[0], right.images[0].shape, u, v, validity, error, distance)
    return Disparity(u, v, validity, error, distance, found.aligned)


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
    if params.refine:
        u, v, rest = refine.refine(left.images[0], right.images[0], right.valid[0], u, v, keep, params)
        alike = refine.correlation(rest, pair.deviation[0], keep)
        mark(validity, keep & (alike < params.correlation), Validity.OVER_THRESHOLD)
    if params.relief_steps:
        u, v = relief.fit(left.images[0], right.images[0], right.valid[0], u, v, validity == 0, params)
    mark(validity, keep & ~consistency.lands(u, v, keep, right.valid[0]), Validity.OUT_OF_IMAGE)
    keep = validity == 0
    gone = consistency.isolated(forward.u, forward.v, keep, params.speckle)
    # Lonely matches are too uncertain to count as measured, but still the best guess where they are.
    lonely = consistency.lonely(keep & ~gone, params.crowd)
    mark(validity, gone | lonely, Validity.SPECKLE)
    interpolated = lonely.astype(np.uint8)
    consistency.fill_rows(u, v, keep & ~gone, params.fill_reach, state.near_sign or -1.0, interpolated)
    keep &= ~gone & ~lonely
    mark(validity, keep, Validity.MATCHED)
    interpolated[left.valid[0] == 0] = 0
    if params.guided_fill:
        u, v = guided.median(u, v, keep, interpolated, left.images[0])
    validity |= interpolated * np.uint8(Validity.INTERPOLATED)
    nothing = ~(keep | (interpolated != 0))
    u[nothing] = v[nothing] = np.nan
    error[error >= consistency.FAILED] = np.nan
    distance = np.where(forward.distance < 0, np.float32(np.nan), forward.distance)
    return Disparity(u, v, validity, error, distance, alignment is not None)


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
    }
    return Bundle(arrays, meta)


_GRID = ("row", "col")
STAGE = Stage(
    name="hfvm",
    version=1,
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
    ),
    requires=("numpy", "numba", "opencv-python-headless"),
    run=_run,
)
