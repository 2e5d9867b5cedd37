"""The finest level, step by step: fractions of a pixel, validity, refinement, isolated patches, planes, filling.

Each step takes what is known of every pixel and returns more of it. All work on a window of the left image, and on
windows of the right image that hold what the left one's matches reach.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.validity import Validity, mark
from rille.stages.geometry import spline
from rille.stages.geometry.scale import effective
from rille.stages.hfvm import epipolar, fill, lucas_kanade, plane, relief, textureless, uncertainty
from rille.stages.hfvm.image import Image, Layer
from rille.stages.hfvm.level import MAX_FIT_MATCHES, Map
from rille.stages.hfvm.lucas_kanade import local_mean
from rille.stages.hfvm.native.problem import LevelPair
from rille.stages.hfvm.native.solver import solver
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.validation import FAILED_PX, backmatch, isolated, lands, lonely
from rille.stages.hfvm.windows import Shape, Window, thinned
from rille.stages.numeric.windows import window_count, window_room

Results = Mapping[str, AnyArray]

SUPPORT_SIDE_PX = 25
"""Pixels: side of the neighbourhood that bears out a pixel without texture. Chosen, as the shares below, with five
pairs (motorcycle, Baby1, Cloth1, Lampshade1, Midd1): of what is borne out 98 to 100 % are within 2 px, of all that is
consistent without texture 14 to 100 %."""

MIN_CONSISTENT_SHARE = 0.9
"""Least share of that neighbourhood that is consistent."""

MIN_MATCHED_SHARE = 0.3
"""Least share of that neighbourhood that is matched."""


@dataclass(frozen=True)
class FinestWork:
    """Windows of both images at the finest level, and their matches.

    ``b``: the right image as it was matched, ``right``: as it is; two names of one unless ``alignment``, the homography
    from the one to the other, is given. ``left, back``: whole displacements of the left window in that of ``b``, and
    the reverse. ``shape``: of the left image. ``noise``: that the images had before they were denoised.
    """

    a: Layer
    b: Layer
    right: Layer
    left: Map
    back: Map
    params: HfvmParams
    alignment: plane.Matrix | None
    noise: tuple[float, float]
    shape: Shape

    def to_right(self, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Displacements in the window of the right image, of those in the window of ``b``."""
        if self.alignment is None:
            return u, v
        a, b, c = self.a.window, self.b.window, self.right.window
        u, v = (d + np.float32(to - at) for d, to, at in ((u, b.x0, a.x0), (v, b.y0, a.y0)))
        u, v = plane.compose(self.alignment, u, v, self.shape, a.x0, a.y0)
        return u - np.float32(c.x0 - a.x0), v - np.float32(c.y0 - a.y0)

    def from_right(self, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """The reverse of :meth:`to_right`."""
        if self.alignment is None:
            return u, v
        a, b, c = self.a.window, self.b.window, self.right.window
        u, v = (d + np.float32(to - at) for d, to, at in ((u, c.x0, a.x0), (v, c.y0, a.y0)))
        u, v = plane.decompose(self.alignment, u, v, self.shape, a.x0, a.y0)
        return u - np.float32(b.x0 - a.x0), v - np.float32(b.y0 - a.y0)

    def images(self) -> lucas_kanade.SplineImages:
        """What refinement compares."""
        return lucas_kanade.SplineImages(self.a.grey, spline.coefficients(self.right.grey), self.right.valid)


@dataclass(frozen=True)
class Fine:
    """What is known of each pixel, (row, col): displacements to ``b``, float32 pixels; bits that speak against it
    (:class:`~rille.stages.core.validity.Validity`); back-matching error, pixels; feature distance, -1 outside; and the
    variance of the column displacement that noise makes, squared pixels."""

    u: AnyArray
    v: AnyArray
    validity: AnyArray
    error: AnyArray
    distance: AnyArray
    noise: AnyArray

    @property
    def keep(self) -> NDArray[np.bool_]:
        """Pixels that nothing speaks against."""
        return np.asarray(self.validity == 0)

    def against(self, where: NDArray[np.bool_], bit: Validity) -> AnyArray:
        """Validity with one more bit where ``where``."""
        validity = self.validity.copy()
        mark(validity, where, bit)
        return validity


Step = Callable[[FinestWork, Fine], Fine]


def subpixel(work: FinestWork) -> Fine:
    """Fractions of a pixel from distances summed over 5 x 5 pixels, and means of like neighbours (4.3.2)."""
    pair = LevelPair(work.a.words, work.b.words, epipolar.NO_BAND, 0.0)
    u, v, distance = solver.sums(pair, work.left.u, work.left.v, np.ones(work.left.u.shape, np.uint8))
    u, v = local_mean(u, v, np.ones(u.shape, bool), 2, 2)
    zeros = np.zeros(u.shape, np.float32)
    return Fine(u, v, np.zeros(u.shape, np.uint8), zeros, distance, zeros)


def check(work: FinestWork, fine: Fine) -> Fine:
    """Reasons against each pixel: matching back (4.3.3), distance, texture."""
    p = work.params
    # Back from the right whole displacements suffice.
    u, v = (a.astype(np.float32) for a in (work.back.u, work.back.v))
    back = local_mean(u, v, np.ones(u.shape, bool), 2, 2)
    error = np.full(fine.u.shape, FAILED_PX, np.float32)
    backmatch(fine.u, fine.v, back, work.b.valid, error)
    validity = np.zeros(fine.u.shape, np.uint8)
    # A masked pixel is no part of the image, so it counts as outside.
    outside = (error >= FAILED_PX) | (work.a.valid == 0)
    mark(validity, outside, Validity.OUT_OF_IMAGE)
    mark(validity, ~outside & (error > p.backmatch), Validity.BACKMATCH_FAILED)
    mark(validity, fine.distance > p.threshold, Validity.OVER_THRESHOLD)
    mark(validity, work.a.deviation < p.texture, Validity.NO_TEXTURE)
    return replace(fine, error=error, validity=validity)


def refine(work: FinestWork, fine: Fine) -> Fine:
    """Displacements without the perspective bias, by mean-free Lucas-Kanade steps; what does not correlate goes."""
    keep = fine.keep
    # An image that a plane has aligned is sheared, and takes a step more.
    steps = 1 if work.alignment is None else 2
    u, v, rest, per_noise = lucas_kanade.refine(work.images(), work.to_right, (fine.u, fine.v), keep, steps)
    removed = work.noise[0] ** 2, work.noise[1] ** 2
    alike, variance = lucas_kanade.surroundings(rest, work.a.deviation, keep, removed)
    # Denoising takes means of nine pixels: it divides the residuals' variance by as many; no match is placed better.
    noise = per_noise * (variance * np.float32(9) if any(removed) else variance)
    validity = fine.against(keep & (alike < work.params.correlation), Validity.OVER_THRESHOLD)
    return replace(fine, u=u, v=v, noise=noise, validity=validity)


def smooth(work: FinestWork, fine: Fine) -> Fine:
    """A piecewise smooth relief fitted to all matches along their epipolar lines."""
    u, v = work.from_right(*relief.fit(work.images(), *work.to_right(fine.u, fine.v), fine.keep))
    return replace(fine, u=u, v=v)


def landing(work: FinestWork, fine: Fine) -> Fine:
    """Reasons against pixels whose match is not in the right image."""
    there = lands(*work.to_right(fine.u, fine.v), fine.keep, work.right.valid)
    return replace(fine, validity=fine.against(fine.keep & ~there, Validity.OUT_OF_IMAGE))


def speckles(work: FinestWork, fine: Fine) -> Fine:
    """Reasons against pixels in small isolated patches, most of which are errors."""
    small = isolated(work.left.u, fine.keep, work.params.speckle)
    return replace(fine, validity=fine.against(small, Validity.SPECKLE))


def blanks(work: FinestWork, fine: Fine) -> Fine:
    """Pixels without texture count as matched where nearly all around are consistent, and enough of them are matches.

    Among failures, as on a wall without any texture, consistent pixels are chance.
    """
    keep, blank = fine.keep, fine.validity == Validity.NO_TEXTURE
    room = window_room(keep.shape, SUPPORT_SIDE_PX)
    around = window_count(keep | blank, SUPPORT_SIDE_PX), window_count(keep, SUPPORT_SIDE_PX)
    blank &= (around[0] >= MIN_CONSISTENT_SHARE * room) & (around[1] >= MIN_MATCHED_SHARE * room)
    noise = np.where(blank, np.float32((uncertainty.BLANK_STD_PX / uncertainty.NOISE_FACTOR) ** 2), fine.noise)
    return replace(fine, validity=np.where(blank, np.uint8(0), fine.validity), noise=noise)


def lines(results: Results, shapes: tuple[Shape, Shape]) -> epipolar.Matrix | None:
    """Fundamental matrix of the refined matches (``u, v, validity``) of a whole image; None: they follow no lines."""
    y, x = thinned(results["validity"] == 0, MAX_FIT_MATCHES)
    fitted = epipolar.fit_points(x, y, results["u"][y, x], results["v"][y, x], *shapes)
    # Negated, so that NaN is refused as well.
    if fitted is None or not fitted[1] <= epipolar.SHARP_SPREAD_PX:
        return None
    return epipolar.oriented(fitted[0], shapes[0])


def planes(images: tuple[Image, Image], results: Results, f: epipolar.Matrix, near_sign: float) -> textureless.Planes:
    """Planes of the left image's textureless regions: what no window tells, a whole region does."""
    left, right = (image.layers[textureless.REGION_LEVEL] for image in images)
    rows, cols = left.shape
    unmatched = np.ones((2 * rows, 2 * cols), bool)
    unmatched[: results["u"].shape[0], : results["u"].shape[1]] = results["validity"] != 0
    none = (unmatched[::2, ::2] & unmatched[::2, 1::2]) & (unmatched[1::2, ::2] & unmatched[1::2, 1::2])
    y, x = thinned(results["validity"] == 0, MAX_FIT_MATCHES)
    along = epipolar.along_line(epipolar.lines_at(f, x, y), results["u"][y, x], results["v"][y, x])
    return textureless.find(left, right, f, none, along, -near_sign)


@dataclass(frozen=True)
class Ending:
    """What the whole image tells a window for its last steps: the sign of depth (see ``level.State``), the
    homography that the right image was aligned by, epipolar lines of the matches, and planes without texture."""

    near_sign: float
    alignment: plane.Matrix | None
    f: epipolar.Matrix | None
    planes: textureless.Planes | None
    shape: Shape


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
        # What was found about another displacement does not apply.
        error[on_plane], distance[on_plane], validity[on_plane] = FAILED_PX, -1.0, 0
    beside, matches = region < 0, keep | on_plane
    # Matches with too few agreeing neighbours are too uncertain to count as measured, but remain the best guess.
    alone = lonely(matches, params.min_support)
    mark(validity, alone, Validity.SPECKLE)
    filled = (alone | beside).astype(np.uint8)
    fill.rows(u, v, matches | beside, params.fill_reach, ending.near_sign or -1.0, filled)
    matches &= ~alone
    std = uncertainty.standard_deviation(results["noise"], u, keep & ~alone)
    std[on_plane & matches] = plane_std[on_plane & matches]
    # A masked pixel is no part of the image, so it is not filled either.
    filled[(valid == 0) | matches] = 0
    if ending.f is not None:
        # A filled pixel has its neighbour's depth, not its row: between turned cameras rows change along a row.
        v = epipolar.settled(epipolar.moved(ending.f, *2 * ((window.x0, window.y0),)), u, v, filled)
    if ending.alignment is not None:
        u, v = plane.compose(ending.alignment, u, v, ending.shape, window.x0, window.y0)
        # Found in pixels of the aligned image, as displacements were.
        std = std * np.float32(effective(plane.scale(ending.alignment, ending.shape)))
    mark(validity, matches, Validity.MATCHED)
    mark(validity, filled != 0, Validity.INTERPOLATED)
    unknown = ~matches & (filled == 0)
    # FAILED_PX and -1 are for comparisons; what is published says NaN.
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
