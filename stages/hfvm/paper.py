"""Preset ``paper``: section 4.3 to the letter, for comparison.

Eq. 1 to 3 on floating-point features, one search centre, no epipolar band, no propagation, no smoothness, no alignment;
fractions of a pixel by linear interpolation, evened by a look-up table (4.3.2). Displacements of a textured scene are
spread evenly between whole pixels; offsets found by linear interpolation are not. The cumulative distribution of found
offsets maps them to even ones; it is learnt once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.validity import Validity, mark
from rille.stages.hfvm.finest import FAILED_PX, Ending, backmatch, complete
from rille.stages.hfvm.image import planes as table_1
from rille.stages.hfvm.image import whole
from rille.stages.hfvm.level import agree, fill_rows
from rille.stages.hfvm.native.problem import Map
from rille.stages.hfvm.native.reference import linear
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import Pyramid

_HALF = (0.0, 0.0587, 0.1219, 0.1889, 0.2573, 0.3222, 0.3799, 0.4265, 0.5)
DEFAULT_TABLE: tuple[float, ...] = (*(-v for v in _HALF[:0:-1]), *_HALF)
"""Even offset at each sixteenth of the found one; learnt on noise of spectrum 1 / f^1.3, displaced by all fractions."""


def even(offsets: ArrayLike, table: tuple[float, ...] = DEFAULT_TABLE) -> NDArray[np.float32]:
    """Offsets mapped by a table, linear between its knots."""
    knots = np.linspace(-0.5, 0.5, len(table))
    return np.asarray(np.interp(np.asarray(offsets), knots, np.asarray(table)), dtype=np.float32)


class IntegerMatches(NamedTuple):
    """Displacements of one direction (row, col), int16; least distance, float32, -1 outside; and offsets of fractions
    of a pixel, columns and rows (row, col, 2)."""

    u: AnyArray
    v: AnyArray
    distance: AnyArray
    offset: AnyArray


class Around(NamedTuple):
    """Where is searched: displacements (row, col) int16, and how many columns and rows to either side of them."""

    u: AnyArray
    v: AnyArray
    columns: int
    rows: int


def match(left: Pyramid, right: Pyramid, params: HfvmParams, tell: Callable[[float, str], None]) -> dict[str, AnyArray]:
    """Arrays of :class:`rille.stages.hfvm.stage.StereoMatches`."""
    above: list[Map] = []
    levels = min(left.levels, right.levels)
    for n in range(levels - 1, -1, -1):
        tell(1.0 - 0.25 ** (levels - n), f"level {n}")
        images = left.filled[n], right.filled[n]
        valid = left.valid[n], right.valid[n]
        # 4.3.1: feature vectors, whose distance is Eq. 1
        planes = [table_1(image) for image in images]
        vectors = [weighted(plane, params.weights) for plane in planes]
        # 4.3.4: both directions, median-filtered
        ways = [
            _one_way(vectors[k], vectors[1 - k], _double(above[k], images[k].shape) if above else None, params)
            for k in (0, 1)
        ]
        maps = [Map(cv2.medianBlur(way.u, 3), cv2.medianBlur(way.v, 3)) for way in ways]
        if n == 0:
            break
        # 4.3.3: what matching back does not confirm is interpolated, and handed down
        above = []
        for k in (0, 1):
            ok = agree(maps[k], maps[1 - k], valid[k], valid[1 - k], params.backmatch)
            ok &= (ways[k].distance >= 0) & (ways[k].distance <= params.threshold)
            u, v = maps[k].u.astype(np.float32), maps[k].v.astype(np.float32)
            fill_rows(u, v, ok, params.fill_reach, -1.0 if k == 0 else 1.0, np.zeros(u.shape, np.uint8))
            above.append(Map(*(np.rint(a).astype(np.int16) for a in (u, v))))
    return _finish(vectors, maps, valid, planes[0][6], params)


def _finish(
    vectors: list[AnyArray], maps: list[Map], valid: tuple[AnyArray, AnyArray], deviation: AnyArray, params: HfvmParams
) -> dict[str, AnyArray]:
    """4.3.2 and 4.3.3 at the finest level: fractions of a pixel, back-matching, interpolation."""
    fine = []
    for k in (0, 1):
        there = _search(vectors[k], vectors[1 - k], maps[k], (0, 0))
        offset = even(there.offset)
        fine.append((maps[k].u + offset[..., 0], maps[k].v + offset[..., 1], there.distance))
    u, v, distance = fine[0]
    error, validity = np.full(u.shape, FAILED_PX, np.float32), np.zeros(u.shape, np.uint8)
    backmatch(u, v, fine[1][:2], valid[1], error)
    outside = (error >= FAILED_PX) | (valid[0] == 0)
    mark(validity, outside, Validity.OUT_OF_IMAGE)
    mark(validity, ~outside & (error > params.backmatch), Validity.BACKMATCH_FAILED)
    mark(validity, distance > params.threshold, Validity.OVER_THRESHOLD)
    mark(validity, deviation < params.texture, Validity.NO_TEXTURE)
    arrays: dict[str, AnyArray] = {
        "u": u,
        "v": v,
        "validity": validity,
        "error": error,
        "distance": distance,
        "noise": np.zeros_like(error),
    }
    shape: tuple[int, int] = u.shape
    return complete(arrays, valid[0], whole(shape), params, Ending(-1.0, None, None, None, shape))


def _one_way(a: AnyArray, b: AnyArray, centre: Map | None, params: HfvmParams) -> IntegerMatches:
    """Displacements from one image to the other: at the top around none, in a large area (4.3.4)."""
    if centre is not None:
        return _search(a, b, centre, (params.search_columns, params.search_rows))
    rows, cols = np.maximum(a.shape[:2], b.shape[:2])
    reach = int(np.ceil(params.top_columns * cols)), int(np.ceil(params.top_rows * rows))
    nothing = np.zeros(a.shape[:2], np.int16)
    return _search(a, b, Map(nothing, nothing), reach)


def _search(a: AnyArray, b: AnyArray, centre: Map, reach: tuple[int, int]) -> IntegerMatches:
    shape = a.shape[:2]
    u, v = np.empty(shape, np.int16), np.empty(shape, np.int16)
    matches = IntegerMatches(u, v, np.empty(shape, np.float32), np.empty((*shape, 2), np.float32))
    search(a, b, Around(centre.u, centre.v, *reach), matches)
    return matches


def _double(up: Map, shape: tuple[int, ...]) -> Map:
    """Prediction for the level below: doubled values, each for its 2 x 2 pixels."""
    # Repeated, not interpolated: means of two depths at an edge are depths that nothing has.
    big = ((2 * a).repeat(2, axis=0)[: shape[0]].repeat(2, axis=1)[:, : shape[1]] for a in (up.u, up.v))
    return Map(*(np.ascontiguousarray(a) for a in big))


def weighted(planes: AnyArray, weights: tuple[float, ...]) -> AnyArray:
    """Feature planes (8, row, col) as (row, col, 8) float32 vectors whose Euclidean distance is Eq. 1, grey levels."""
    w = np.asarray(weights, dtype=np.float32)
    # Weights of length one, so that distances are grey levels and the threshold keeps its meaning.
    w = w / np.sqrt(np.sum(w * w))
    return np.ascontiguousarray(np.moveaxis(planes * w[:, None, None], 0, -1), dtype=np.float32)


@njit(cache=True, nogil=True)
def _eq1(f, g):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for k in range(f.shape[0]):
        d = f[k] - g[k]
        total += d * d
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def search(left, right, around, out):  # type: ignore[no-untyped-def]
    """Best match of every pixel in the search area around its centre (Eq. 2, Eq. 3).

    ``left, right``: vectors (row, col, 8) of the images. ``out`` (:class:`IntegerMatches`): distance by Eq. 1, -1 where
    nothing lies inside; linear sub-pixel offsets by 4.3.2, 0 at the border of the image. Of equal distances the first
    in row, column order wins.
    """
    rows, cols = left.shape[:2]
    rrows, rcols = right.shape[:2]
    for y in range(rows):
        for x in range(cols):
            cu, cv = np.int64(around.u[y, x]), np.int64(around.v[y, x])
            best = np.float32(-1.0)
            bu, bv = cu, cv
            # The area is cut at the border, instead of each candidate clamped to it: none then comes up twice.
            for v in range(max(cv - around.rows, -y), min(cv + around.rows, rrows - 1 - y) + 1):
                for u in range(max(cu - around.columns, -x), min(cu + around.columns, rcols - 1 - x) + 1):
                    d = _eq1(left[y, x], right[y + v, x + u])
                    # -1 is nothing so far, as no distance is negative.
                    if best < 0 or d < best:
                        best = d
                        bu, bv = np.int64(u), np.int64(v)
            out.u[y, x], out.v[y, x], out.distance[y, x] = bu, bv, best
            out.offset[y, x, 0], out.offset[y, x, 1] = 0.0, 0.0
            xr, yr = x + bu, y + bv
            if best < 0:
                continue
            if xr > 0 and xr < rcols - 1:
                out.offset[y, x, 0] = linear(
                    _eq1(left[y, x], right[yr, xr - 1]), best, _eq1(left[y, x], right[yr, xr + 1])
                )
            if yr > 0 and yr < rrows - 1:
                out.offset[y, x, 1] = linear(
                    _eq1(left[y, x], right[yr - 1, xr]), best, _eq1(left[y, x], right[yr + 1, xr])
                )
