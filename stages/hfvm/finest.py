"""The finest level of a pair and the steps after it, window by window: the whole image, or tiles with a halo.

::

    coarse levels (whole) -> fine (each window) -> ending (lines and planes of the whole) -> final (each window)

The steps of a window: sub-pixel displacements, validation (4.3.1, 4.3.3), refinement, isolated patches; then planes and
filling. Each takes the arrays of the step before. They work on a window of the left image and on the window of the
right image that its matches reach. All but a thousandth of the pixels are within .01 px of the result of the pair
matched in one window: patches and propagation that reach beyond the halo are cut off by tiles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.core.validity import Validity, mark
from rille.stages.geometry import spline
from rille.stages.geometry.scale import effective
from rille.stages.hfvm import epipolar, plane, refinement, textureless
from rille.stages.hfvm.coarse import Coarse
from rille.stages.hfvm.image import Image, Layer, Shape, Window, thinned, whole
from rille.stages.hfvm.level import (
    MAX_FIT_MATCHES,
    NEAR_SIGN,
    Band,
    PyramidPair,
    State,
    fill_rows,
    hand_down,
    match_level,
)
from rille.stages.hfvm.native.problem import LevelPair, Map
from rille.stages.hfvm.native.solver import solver
from rille.stages.hfvm.native.threads import side_by_side
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.refinement import local_mean
from rille.stages.numeric.windows import window_count, window_room

FAILED_PX = np.float32(1e9)
"""Back-matching error of pixels whose match is not a usable pixel of the right image."""

CROWD_SIDE_PX = 9
"""Pixels: side of the neighbourhood in which matches support each other, about that of a feature window."""

NO_PATCH = -32768
"""Displacement of pixels that are in no patch."""


@kernel
def backmatch(u, v, right, right_valid, error):  # type: ignore[no-untyped-def]
    """Distance |l - l'| of each left pixel after matching to the right and back (4.3.3), pixels.

    ``error`` comes as FAILED_PX and stays so outside the right image and on its masked pixels. The right map, columns
    and rows of displacement, is read at the nearest pixel.
    """
    ru, rv = right
    last_x, last_y, half = np.float32(ru.shape[1] - 1), np.float32(ru.shape[0] - 1), np.float32(0.5)
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
            if not (xr >= 0 and xr <= last_x and yr >= 0 and yr <= last_y):
                continue
            # A half and truncation round to the nearest pixel, since neither is negative here.
            i, j = np.int64(xr + half), np.int64(yr + half)
            if right_valid[j, i]:
                du, dv = u[y, x] + ru[j, i], v[y, x] + rv[j, i]
                error[y, x] = min(np.sqrt(du * du + dv * dv), FAILED_PX)


def nearest(a: AnyArray, there: Map) -> AnyArray:
    """Values (row, col) of ``a`` at the pixels nearest to where displacements lead; of its border beyond it."""
    y, x = np.indices(there.u.shape, np.float32)
    return np.asarray(cv2.remap(a, x + there.u, y + there.v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE))


@kernel
def lands(u, v, keep, right_valid):  # type: ignore[no-untyped-def]
    """Pixels (bool) of ``keep`` whose displacement ends on a usable pixel of the right image."""
    landing, half = np.zeros(keep.shape, np.bool_), np.float32(0.5)
    rows, cols = right_valid.shape
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            # Half a pixel beyond the outermost centres is still on the image.
            xr, yr = np.float32(x) + u[y, x] + half, np.float32(y) + v[y, x] + half
            if keep[y, x] and 0 < xr < cols and 0 < yr < rows:
                landing[y, x] = right_valid[np.int64(yr), np.int64(xr)] != 0
    return landing


def lonely(keep: AnyArray, share: float) -> NDArray[np.bool_]:
    """Pixels of ``keep`` around which (:data:`CROWD_SIDE_PX`, clipped at the border) less than ``share`` is kept."""
    if share <= 0:
        return np.zeros(keep.shape, dtype=bool)
    return np.asarray(keep & (window_count(keep, CROWD_SIDE_PX) < share * window_room(keep.shape, CROWD_SIDE_PX)))


def isolated(u: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """Pixels of ``keep`` in patches of fewer than ``size`` pixels; if most pixels lie in small patches, all of those.

    Pixels of a patch are connected along rows and columns by column displacements that differ by at most one pixel.
    Unrelated images match by chance in patches of up to some hundred pixels. In a pair of one scene nearly all matches
    lie in patches of thousands, and small patches are kept.

    Parameters
    ----------
    u : (row, col) int16 column displacements, pixels.
    """
    if size <= 1:
        return np.zeros(keep.shape, dtype=bool)
    # 16 times the size: no patch of chance is as large (measured on blurred noise: up to 8 times). A small image may
    # not hold such a patch: an eighth of it is enough.
    suspect = _in_small_patches(u, keep, max(size, min(16 * size, keep.size // 8)))
    # The smaller patches are among these, and most matches are not.
    small = _in_small_patches(u, suspect, size)
    all_of_them = np.count_nonzero(keep)
    rest, large = all_of_them - np.count_nonzero(small), all_of_them - np.count_nonzero(suspect)
    return suspect if large < 0.5 * rest else small


def _in_small_patches(u: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """Pixels of ``keep`` that are in a patch of fewer than ``size``."""
    plane = np.where(keep, u, np.int16(NO_PATCH))
    cv2.filterSpeckles(plane, NO_PATCH, size - 1, 1)
    return np.asarray(keep & (plane == NO_PATCH))


Results = Mapping[str, AnyArray]


@dataclass(frozen=True)
class FinestWork:
    """Windows of both images at the finest level, and their matches.

    ``b``: the right image as it was matched, ``right``: as it came; the same image unless ``alignment``, the homography
    from the one to the other, is given. ``left, back``: integer displacements from the left window to that of ``b``,
    and back. ``images``: the images of the windows. ``upright``: see :class:`rille.stages.hfvm.level.State`; ``blur``:
    :func:`rille.stages.hfvm.coarse.focus`.
    """

    a: Layer
    b: Layer
    right: Layer
    left: Map
    back: Map
    images: PyramidPair
    alignment: plane.Matrix | None = None
    upright: bool = False
    blur: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def alike(self) -> FinestWork:
        """The same with the sharper image blurred to the detail of the other one."""
        left, right = self.blur
        return replace(self, a=self.a.blurred(left), b=self.b.blurred(right), right=self.right.blurred(right))

    def to_right(self, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Displacements to the window of the right image, from displacements to the window of ``b``."""
        return self._carried(u, v, self.b, self.right)

    def from_right(self, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """The reverse of :meth:`to_right`."""
        return self._carried(u, v, self.right, self.b)

    def _carried(self, u: AnyArray, v: AnyArray, start: Layer, end: Layer) -> tuple[AnyArray, AnyArray]:
        if self.alignment is None:
            return u, v
        a, b, c, h = self.a.window, start.window, end.window, plane.to_original(self.alignment, self.a.shape)
        u, v = (d + np.float32(to - at) for d, to, at in ((u, b.x0, a.x0), (v, b.y0, a.y0)))
        u, v = plane.carried(h if end is self.right else np.linalg.inv(h), u, v, a.x0, a.y0)
        return u - np.float32(c.x0 - a.x0), v - np.float32(c.y0 - a.y0)

    def compared(self) -> refinement.SplineImages:
        """The images that refinement compares."""
        return refinement.SplineImages(self.a.grey, spline.coefficients(self.right.grey), self.right.valid)


@dataclass(frozen=True)
class Fine:
    """Result of the steps so far, (row, col): displacements to ``b``, float32 pixels; ``validity``, reasons to reject a
    pixel (:class:`~rille.stages.core.validity.Validity`); back-matching error, pixels; feature distance, -1 outside;
    ``noise``, the variance of the column displacement (of the row's on upright lines) by noise, squared pixels;
    ``likeness``, correlation of the residuals of neighbours."""

    u: AnyArray
    v: AnyArray
    validity: AnyArray
    error: AnyArray
    distance: AnyArray
    noise: AnyArray
    likeness: AnyArray

    @property
    def keep(self) -> NDArray[np.bool_]:
        """Pixels that no step has rejected."""
        return np.asarray(self.validity == 0)

    def against(self, where: NDArray[np.bool_], bit: Validity) -> AnyArray:
        """Validity with ``bit`` set where ``where``."""
        validity = self.validity.copy()
        mark(validity, where, bit)
        return validity


def subpixel(work: FinestWork) -> Fine:
    """Sub-pixel displacements from distances summed over 5 x 5 pixels, averaged over like neighbours (4.3.2)."""
    everywhere = np.ones(work.left.u.shape, np.uint8)
    u, v, distance = solver.sums(LevelPair(work.a.words, work.b.words), *work.left, everywhere)
    u, v = local_mean(u, v, np.ones(u.shape, bool), 2, 2)
    zeros = np.zeros(u.shape, np.float32)
    return Fine(u, v, np.zeros(u.shape, np.uint8), zeros, distance, zeros, zeros)


def reasons(
    there: Map, back: Map, distance: AnyArray, layers: tuple[Layer, Layer], params: HfvmParams, deviation: AnyArray
) -> tuple[AnyArray, AnyArray]:
    """Back-matching errors (4.3.3), pixels, and validity: reasons to reject by that error, distance, or texture.

    ``there, back``: displacements of the ``layers``, (row, col) float32; ``deviation``: of the left one.
    """
    error = np.full(distance.shape, FAILED_PX, np.float32)
    backmatch(there.u, there.v, back, layers[1].valid, error)
    validity = np.zeros(error.shape, np.uint8)
    # A masked pixel is no part of the image, so it counts as outside.
    outside = (error >= FAILED_PX) | (layers[0].valid == 0)
    mark(validity, outside, Validity.OUT_OF_IMAGE)
    mark(validity, ~outside & (error > params.backmatch), Validity.BACKMATCH_FAILED)
    mark(validity, distance > params.threshold, Validity.OVER_THRESHOLD)
    mark(validity, deviation < params.texture, Validity.NO_TEXTURE)
    return error, validity


def check(work: FinestWork, fine: Fine) -> Fine:
    """Reject pixels by back-matching (4.3.3), feature distance, and texture."""
    # Integer displacements suffice for the way back.
    u, v = (a.astype(np.float32) for a in work.back)
    back = Map(*local_mean(u, v, np.ones(u.shape, bool), 2, 2))
    found = Map(fine.u, fine.v), back, fine.distance, (work.a, work.b), work.images.params, work.a.deviation
    error, validity = reasons(*found)
    return replace(fine, error=error, validity=validity)


def refine(work: FinestWork, fine: Fine) -> Fine:
    """Remove the perspective bias by mean-free Lucas-Kanade steps, and reject pixels that do not correlate."""
    keep, work = fine.keep, work.alike
    # An image that a plane has aligned is sheared, and takes a step more.
    how = 1 if work.alignment is None else 2, work.upright
    u, v, rest, per_noise, likeness = refinement.refine(work.compared(), work.to_right, (fine.u, fine.v), keep, *how)
    removed = work.images.left.noise**2, work.images.right.noise**2
    deviations = work.a.deviation, nearest(work.b.deviation, Map(u, v))
    alike, variance = refinement.surroundings(rest, deviations, keep, removed)
    # Denoising averages nine pixels and divides the variance of the residuals by as many; matches are no more exact for
    # that. Blurring removes the noise of one image of the two.
    hidden = (9.0 if any(removed) else 1.0) * (2.0 if any(work.blur) else 1.0)
    noise = per_noise * (variance * np.float32(hidden))
    validity = fine.against(keep & (alike < work.images.params.correlation), Validity.OVER_THRESHOLD)
    return replace(fine, u=u, v=v, noise=noise, likeness=likeness, validity=validity)


def smooth(work: FinestWork, fine: Fine) -> Fine:
    """Fit a piecewise smooth relief to all matches along their epipolar lines."""
    work = work.alike
    u, v = work.from_right(*refinement.fit_relief(work.compared(), *work.to_right(fine.u, fine.v), fine.keep))
    return replace(fine, u=u, v=v)


def landing(work: FinestWork, fine: Fine) -> Fine:
    """Reject pixels whose match is not in the right image."""
    there = lands(*work.to_right(fine.u, fine.v), fine.keep, work.right.valid)
    return replace(fine, validity=fine.against(fine.keep & ~there, Validity.OUT_OF_IMAGE))


def speckles(work: FinestWork, fine: Fine) -> Fine:
    """Reject pixels in small isolated patches, most of which are errors."""
    small = isolated(work.left.v if work.upright else work.left.u, fine.keep, work.images.params.speckle)
    return replace(fine, validity=fine.against(small, Validity.SPECKLE))


def fitted_lines(results: Results, shapes: tuple[Shape, Shape]) -> epipolar.Matrix | None:
    """Fundamental matrix of the refined matches (``u, v, validity``) of a whole image; None if they fit none."""
    y, x = thinned(results["validity"] == 0, MAX_FIT_MATCHES)
    fitted = epipolar.fit_points(x, y, results["u"][y, x], results["v"][y, x], *shapes)
    # Negated, so that NaN is refused as well.
    if fitted is None or not fitted[1] <= epipolar.SHARP_SPREAD_PX:
        return None
    return epipolar.oriented(fitted[0], shapes[0])


@dataclass(frozen=True)
class Ending:
    """Results of the whole left image, of ``shape``, for the last steps of its windows: the sign of depth (see
    ``level.State``), the homography by which the right image was aligned, the fundamental matrix of the matches, planes
    of textureless regions, and whether epipolar lines are ``upright``."""

    shape: Shape
    near_sign: float = NEAR_SIGN
    alignment: plane.Matrix | None = None
    f: epipolar.Matrix | None = None
    planes: textureless.Planes | None = None
    upright: bool = False


def complete(
    results: Results, valid: AnyArray, window: Window, params: HfvmParams, ending: Ending
) -> dict[str, AnyArray]:
    """Arrays of :class:`~rille.stages.hfvm.stage.StereoMatches` of a window: matched and filled, standard deviations.

    Parameters
    ----------
    results : arrays of :class:`Fine` by name, displacements in the whole image.
    valid : (row, col) mask of the left image.
    """
    u, v, validity, error, distance = (results[name].copy() for name in ("u", "v", "validity", "error", "distance"))
    keep = validity == 0
    region, on_plane = np.zeros(keep.shape, np.int8), np.zeros(keep.shape, bool)
    plane_std = np.zeros(keep.shape, np.float32)
    if ending.planes is not None and ending.planes.terms:
        region, plane_u, plane_v, plane_std = ending.planes.cut(window)
        # A pixel of the level above is usable if most of its four are.
        region[(valid == 0) | keep] = 0
        u, v = np.where(region != 0, plane_u, u), np.where(region != 0, plane_v, v)
        on_plane = region > 0
        # Error, distance and validity of the former displacement do not apply.
        error[on_plane], distance[on_plane], validity[on_plane] = FAILED_PX, -1.0, 0
    beside, matches = region < 0, keep | on_plane
    # Matches with few matched neighbours are too uncertain to count as measured, but are kept as filled values.
    alone = lonely(matches, params.min_support)
    mark(validity, alone, Validity.SPECKLE)
    filled = (alone | beside).astype(np.uint8)
    along, across, known, done = u, v, matches | beside, filled
    if ending.upright:
        # Row displacements show depth: fill the transposed maps.
        along, across, known, done = v.T, u.T, known.T, done.T
    fill_rows(along, across, known, params.fill_reach, ending.near_sign or -1.0, done)
    if ending.f is not None:
        f = epipolar.moved(ending.f, *2 * ((window.x0, window.y0),))
        # A filled pixel takes its neighbour's depth but its own epipolar line: on turned rigs rows change along a row.
        across[:] = epipolar.settled(epipolar.transposed(f) if ending.upright else f, along, across, done)
    matches &= ~alone
    disparity = v if ending.upright else u
    std = refinement.standard_deviation(results["noise"], results["likeness"], disparity, keep & ~alone)
    std[on_plane & matches] = plane_std[on_plane & matches]
    # A masked pixel is no part of the image, so it is not filled either.
    filled[valid == 0] = 0
    if ending.alignment is not None:
        u, v = plane.carried(plane.to_original(ending.alignment, ending.shape), u, v, window.x0, window.y0)
        # From pixels of the aligned image to pixels of the right one.
        std = std * np.float32(effective(plane.scale(ending.alignment, ending.shape)))
    mark(validity, matches, Validity.MATCHED)
    mark(validity, filled != 0, Validity.INTERPOLATED)
    unknown = ~matches & (filled == 0)
    # FAILED_PX and -1 serve comparisons; the results have NaN.
    for array, none in ((u, unknown), (v, unknown), (error, error >= FAILED_PX), (distance, distance < 0)):
        np.copyto(array, np.float32(np.nan), where=none)
    return {
        "column_disparity": u,
        "row_disparity": v,
        "validity": validity,
        "backmatch_error": error,
        "distance": distance,
        "disparity_std": std,
    }


Call = Callable[[], dict[str, AnyArray]]

HALO_PX = 64
"""Pixels around a tile: 48 that a displacement depends on (rounds, edges, features, sums, refinement), and room for
patches of 40 pixels."""

TARGET_MARGIN_PX = 40
"""Pixels around the places in the right image that the predictions of a tile lead to: search, rounds, features."""


def match_finest_level(pair: Coarse, window: Window) -> dict[str, AnyArray]:
    """Arrays of :class:`~rille.stages.hfvm.finest.Fine` of a window of the left image; displacements to the whole
    matched image."""
    images, shape = pair.images, pair.images.left.shapes[0]
    outer = window.grow(HALO_PX, HALO_PX, shape)
    state, target = _around(pair, outer)
    a, b = images.left.cut(outer), images.right.cut(target)
    # 1.1: pixels of blur from which features lose more by it than by blurring the sharper image.
    if max(pair.blur) >= 1.1:
        a, b = (Image((k.layers[0].blurred(s),), k.noise) for k, s in zip((a, b), pair.blur, strict=True))
    if state.level > 0:
        state = match_level(replace(images, left=a, right=b), 0, state)  # 4.3.4: search, propagate, check, band
    left, right = a.layers[0], b.layers[0]
    work = FinestWork(
        left, right, right, state.left, state.right, images, pair.alignment, pair.state.upright, pair.blur
    )
    if pair.alignment is not None:
        work = replace(work, right=pair.right.layers[0].cut(_landing(work, pair.right.shapes[0])))
    result = subpixel(work)  # 4.3.2
    for step in images.params.kept(images.recipe.refinement):  # 4.3.3 back-matching, refinement, validation
        result = step(work, result)
    arrays = dict(vars(result))
    arrays["u"] = arrays["u"] + np.float32(target.x0 - outer.x0)
    arrays["v"] = arrays["v"] + np.float32(target.y0 - outer.y0)
    return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


def _around(pair: Coarse, outer: Window) -> tuple[State, Window]:
    """State of level 1 around a window of level 0, in pixels of it, and the window of the matched image."""
    state, params, shape = pair.state, pair.images.params, pair.images.right.shapes[0]
    if outer == whole(pair.images.left.shapes[0]):
        return state, whole(shape)
    above = outer.parent()
    own = Map(*(a[above.slices] for a in hand_down(state, params)))
    (x0, x1), (y0, y1) = ((2 * int(a.min()), 2 * int(a.max())) for a in own)
    target = Window(outer.y0 + y0, outer.y1 + y1, outer.x0 + x0, outer.x1 + x1)
    target = target.grow(TARGET_MARGIN_PX, TARGET_MARGIN_PX, shape)
    other = (a[target.parent().slices] for a in hand_down(state.reverse(), params))
    steps = (outer.x0 - target.x0) // 2, (outer.y0 - target.y0) // 2
    left = Map(*(a + np.int16(step) for a, step in zip(own, steps, strict=True)))
    right = Map(*(a - np.int16(step) for a, step in zip(other, steps, strict=True)))
    f = epipolar.moved(state.band.f, (outer.x0, outer.y0), (target.x0, target.y0))
    ok = np.ones(left.u.shape, bool), np.ones(right.u.shape, bool)
    return State(1, left, right, *ok, Band(f, state.band.mu), state.near_sign), target


def _landing(work: FinestWork, shape: Shape) -> Window:
    """Window of the right image, as it is and of ``shape``, that the matches of a window lead to."""
    a = work.a.window
    if a == whole(work.a.shape):
        return whole(shape)
    u, v = work.to_right(work.left.u.astype(np.float32), work.left.v.astype(np.float32))
    y, x = np.arange(a.y0, a.y1)[:, None] + v, np.arange(a.x0, a.x1) + u
    # ``work.right`` still is the window of the aligned image, and ``to_right`` counts from its corner.
    x, y = x - a.x0 + work.right.window.x0, y - a.y0 + work.right.window.y0
    ends = Window(*(int(n) for n in (np.nanmin(y), np.nanmax(y) + 1, np.nanmin(x), np.nanmax(x) + 1)))
    return ends.grow(TARGET_MARGIN_PX, TARGET_MARGIN_PX, shape)


def fit_lines_and_planes(pair: Coarse, matches: Mapping[str, AnyArray]) -> Ending:
    """Epipolar lines of the matches of the whole image, and planes of its textureless regions."""
    images, sign, shapes = pair.images, pair.state.near_sign, (pair.images.left.shapes[0], pair.images.right.shapes[0])
    # Without a band row displacements are free, and no line may set them.
    free = images.params.band == 0 or images.levels <= textureless.REGION_LEVEL
    f, planes = None if free else fitted_lines(matches, shapes), None
    if f is not None and "planes" not in images.params.without:
        planes = textureless.find((images.left, images.right), matches, f, sign)
    return Ending(shapes[0], sign, pair.alignment, f, planes, pair.state.upright)


def around(pair: Coarse, window: Window) -> Window:
    """Window whose arrays :func:`interpolate_undefined` needs."""
    reach = pair.images.params.fill_reach
    down, aside = (reach, 0) if pair.state.upright else (0, reach)
    # 16: pixels around a window that its filling and standard deviations depend on, besides the reach along lines.
    return window.grow(16 + down, 16 + aside, pair.images.left.shapes[0])


def interpolate_undefined(
    pair: Coarse, window: Window, matches: Mapping[str, AnyArray], ending: Ending
) -> dict[str, AnyArray]:
    """Arrays of the disparities of a window, from the matches of the window around it, or of the image."""
    outer, params = around(pair, window), pair.images.params
    if matches["u"].shape != outer.shape:
        matches = {name: array[outer.slices] for name, array in matches.items()}
    arrays = complete(matches, pair.images.left.layers[0].cut(outer).valid, outer, params, ending)
    return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


def put_together(calls: Mapping[Window, Call], shape: Shape, threads: int) -> dict[str, AnyArray]:
    """Arrays of an image of ``shape``, put together from the results of ``calls``, one a window, in ``threads``."""
    parts = side_by_side(list(calls.values()), threads)
    if len(parts) == 1:
        return parts[0]
    total: dict[str, AnyArray] = {}
    for window, arrays in zip(calls, parts, strict=True):
        for name, values in arrays.items():
            total.setdefault(name, np.empty(shape, values.dtype))[window.slices] = values
    return total
