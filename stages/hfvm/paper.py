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
from numpy.typing import ArrayLike, NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.hfvm.finest import Ending, complete, reasons
from rille.stages.hfvm.image import DEVIATION, as_given
from rille.stages.hfvm.image import planes as table_1
from rille.stages.hfvm.level import FREE_BAND, NEAR_SIGN, State, agree, hand_down
from rille.stages.hfvm.native.problem import Map
from rille.stages.hfvm.native.reference import linear
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging.pyramid import Pyramid

_HALF = (0.0, 0.0587, 0.1219, 0.1889, 0.2573, 0.3222, 0.3799, 0.4265, 0.5)
DEFAULT_TABLE: tuple[float, ...] = (*(-v for v in _HALF[:0:-1]), *_HALF)
"""Even offset at each sixteenth of the found one; learnt on noise of spectrum 1 / f^1.3, displaced by all fractions."""


def equalized(offsets: ArrayLike, table: tuple[float, ...] = DEFAULT_TABLE) -> NDArray[np.float32]:
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


def match(left: Pyramid, right: Pyramid, params: HfvmParams, tell: Callable[[float, str], None]) -> dict[str, AnyArray]:
    """Arrays of :class:`rille.stages.hfvm.stage.StereoMatches`."""
    images = [as_given(pyramid, params.weights) for pyramid in (left, right)]
    above: tuple[Map | None, Map | None] = None, None
    for n in reversed(range(min(left.levels, right.levels))):
        tell(1.0 - 0.25 ** (min(left.levels, right.levels) - n), f"level {n}")
        layers = [image.layers[n] for image in images]
        # 4.3.1: feature vectors, whose distance is Eq. 1
        planes = [table_1(layer.grey) for layer in layers]
        vectors = [weighted(plane, params.weights) for plane in planes]
        # 4.3.4: both directions, median-filtered
        ways = [_one_way(vectors[k], vectors[1 - k], above[k], params) for k in (0, 1)]
        maps = [Map(cv2.medianBlur(way.u, 3), cv2.medianBlur(way.v, 3)) for way in ways]
        if n == 0:
            break
        # 4.3.3: pixels that fail back-matching are interpolated, and handed down
        ok = [agree(maps[k], maps[1 - k], layers[k].valid, layers[1 - k].valid, params.backmatch) for k in (0, 1)]
        ok = [o & (way.distance >= 0) & (way.distance <= params.threshold) for o, way in zip(ok, ways, strict=True)]
        state = State(n, maps[0], maps[1], ok[0], ok[1], FREE_BAND, NEAR_SIGN)
        above = hand_down(state, params), hand_down(state.reverse(), params)
    # 4.3.2 and 4.3.3 at the finest level: fractions of a pixel, back-matching, interpolation
    ways = [search(vectors[k], vectors[1 - k], maps[k], (0, 0)) for k in (0, 1)]
    fine = [Map(*(whole + equalized(way.offset[..., i]) for i, whole in enumerate(way[:2]))) for way in ways]
    error, validity = reasons(fine[0], fine[1], ways[0].distance, (layers[0], layers[1]), params, planes[0][DEVIATION])
    arrays = {"u": fine[0].u, "v": fine[0].v, "validity": validity, "error": error, "distance": ways[0].distance}
    arrays["noise"] = arrays["likeness"] = np.zeros_like(error)
    return complete(arrays, layers[0].valid, layers[0].window, params, Ending(left.shape))


def _one_way(a: AnyArray, b: AnyArray, above: Map | None, params: HfvmParams) -> IntegerMatches:
    """Displacements from one image to the other: at the top around none, in a large area (4.3.4)."""
    rows, cols = np.maximum(a.shape[:2], b.shape[:2])
    nothing = np.zeros(a.shape[:2], np.int16)
    centre, reach = (
        Map(nothing, nothing),
        (int(np.ceil(params.top_columns * cols)), int(np.ceil(params.top_rows * rows))),
    )
    if above is not None:
        # Doubled values, each for its 2 x 2 pixels. Means of two depths at an edge would be depths that nothing has.
        doubled = ((2 * up).repeat(2, axis=0)[: a.shape[0]].repeat(2, axis=1)[:, : a.shape[1]] for up in above)
        centre, reach = Map(*map(np.ascontiguousarray, doubled)), (params.search_columns, 1)
    found: IntegerMatches = search(a, b, centre, reach)
    return found


def weighted(planes: AnyArray, weights: tuple[float, ...]) -> AnyArray:
    """Feature planes (8, row, col) as (row, col, 8) float32 vectors whose Euclidean distance is Eq. 1, grey levels."""
    w = np.asarray(weights, dtype=np.float32)
    # Weights of length one, so that distances are grey levels and the threshold keeps its meaning.
    w = w / np.sqrt(np.sum(w * w))
    return np.ascontiguousarray(np.moveaxis(planes * w[:, None, None], 0, -1), dtype=np.float32)


@kernel
def _eq1(f, g):  # type: ignore[no-untyped-def]
    total = np.float32(0.0)
    for k in range(f.shape[0]):
        d = f[k] - g[k]
        total += d * d
    return np.sqrt(total)


@kernel
def search(left, right, centre, reach):  # type: ignore[no-untyped-def]
    """Best match (:class:`IntegerMatches`) of every pixel in the search area around its centre (Eq. 2, Eq. 3).

    ``left, right``: vectors (row, col, 8) of the images. ``centre`` (:class:`Map`); ``reach``: columns and rows to
    either side. Distance by Eq. 1, -1 where nothing lies inside; linear sub-pixel offsets by 4.3.2, 0 at the border of
    the image. Of equal distances the first in row, column order wins.
    """
    rows, cols = left.shape[:2]
    out_u, out_v = np.empty((rows, cols), np.int16), np.empty((rows, cols), np.int16)
    distance, offset = np.empty((rows, cols), np.float32), np.zeros((rows, cols, 2), np.float32)
    rrows, rcols = right.shape[:2]
    for y in range(rows):
        for x in range(cols):
            cu, cv = np.int64(centre.u[y, x]), np.int64(centre.v[y, x])
            best = np.float32(-1.0)
            bu, bv = cu, cv
            # The area is cut at the border, instead of each candidate clamped to it: none then comes up twice.
            for v in range(max(cv - reach[1], -y), min(cv + reach[1], rrows - 1 - y) + 1):
                for u in range(max(cu - reach[0], -x), min(cu + reach[0], rcols - 1 - x) + 1):
                    d = _eq1(left[y, x], right[y + v, x + u])
                    # -1 is nothing so far, as no distance is negative.
                    if best < 0 or d < best:
                        best = d
                        bu, bv = np.int64(u), np.int64(v)
            out_u[y, x], out_v[y, x], distance[y, x] = bu, bv, best
            xr, yr = x + bu, y + bv
            if best < 0:
                continue
            if xr > 0 and xr < rcols - 1:
                offset[y, x, 0] = linear(_eq1(left[y, x], right[yr, xr - 1]), best, _eq1(left[y, x], right[yr, xr + 1]))
            if yr > 0 and yr < rrows - 1:
                offset[y, x, 1] = linear(_eq1(left[y, x], right[yr - 1, xr]), best, _eq1(left[y, x], right[yr + 1, xr]))
    return IntegerMatches(out_u, out_v, distance, offset)
