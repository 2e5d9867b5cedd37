"""Coarse levels of a pair: prior disparities, brightness, alignment by a plane or keypoints, unlike focus.

Known disparities replace those of the coarse levels at the level on which pre-alignment is decided (2), so that they
serve that decision too, and are refined from there on like any other match. A search of one pixel at each level below
corrects an error of 3 px at full resolution, propagation from better neighbours a greater one. Where nothing is known
beforehand, the result of the coarse levels stays; it costs a tenth of the whole.

Brightness: where texture is weak, matches follow the gradient of brightness, and if this gradient differs between the
images, they are wrong. The logarithm of the ratio, left over right (vignetting, exposure), is a polynomial in the
coordinates of the right image. It is fitted to the grey values of matches of a coarse level. Before there are matches,
it is guessed from the grey values of each image as a whole, since both show nearly the same scene; the guess is used
only if it gives more matches.

Focus: where one image shows less detail, distances of features and residuals of the refinement measure the blur and not
the displacement. The finest level then sees the sharper image through a Gaussian that leaves it as much.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import InputError
from rille.stages.geometry.projection import product
from rille.stages.geometry.scale import other_size
from rille.stages.hfvm import epipolar, plane
from rille.stages.hfvm.image import Grey, Image, Shape, Window, thinned
from rille.stages.hfvm.level import FREE_BAND, PyramidPair, State, descend, sample, textured
from rille.stages.hfvm.native.problem import Map
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy


@dataclass(frozen=True)
class PriorDisparities:
    """Column and row displacements (row, col) of level 0, float32 pixels, NaN unknown."""

    u: AnyArray
    v: AnyArray

    def halved(self) -> PriorDisparities:
        """The prior at half the resolution."""
        return PriorDisparities(0.5 * self.u[::2, ::2], 0.5 * self.v[::2, ::2])


def known_beforehand(prior: tuple[AnyArray, AnyArray] | None, shape: tuple[int, ...]) -> PriorDisparities | None:
    """Prior of two arrays; what is not finite or absurdly great counts as unknown.

    Raises
    ------
    InputError
        An array has not the left image's shape.
    """
    if prior is None:
        return None
    u, v = (np.asarray(a, dtype=np.float32) for a in prior)
    if u.shape != shape or v.shape != shape:
        raise InputError(
            "RIL-348",
            f"prior disparities {u.shape} and {v.shape} and the left image {shape} differ",
            remedy="give disparities of the left image, one a pixel",
        )
    return _bounded(u, v)


def _bounded(u: AnyArray, v: AnyArray) -> PriorDisparities:
    # Displacements of a level are 16-bit and doubled from level to level. NaN is not less, and so unknown as well.
    known = np.maximum(np.abs(u), np.abs(v)) < 16000
    return PriorDisparities(np.where(known, u, np.float32(np.nan)), np.where(known, v, np.float32(np.nan)))


def impose(images: PyramidPair, state: State, prior: PriorDisparities | None) -> State:
    """State of the same level with the prior's displacements in both directions where they are known.

    At level 0 (images too small for coarser ones) the whole range has been searched, and nothing is imposed.
    """
    if prior is None or state.level == 0:
        return state
    u, v, known = _coarse(prior, state.level, state.left.u.shape)
    left = _overlay(state.left, u, v, known)
    near = (state.near_sign or -1.0) * np.asarray(v if state.upright else u, np.float64)
    ru, rv, hit = _reverse(u, v, known, state.right.u.shape, near)
    right = _overlay(state.right, ru, rv, hit)
    masks = [image.layers[state.level].valid != 0 for image in (images.left, images.right)]
    left_ok, right_ok = (state.left_ok | known) & masks[0], (state.right_ok | hit) & masks[1]
    return replace(state, left=left, right=right, left_ok=left_ok, right_ok=right_ok)


def _coarse(
    prior: PriorDisparities, level: int, shape: tuple[int, ...]
) -> tuple[AnyArray, AnyArray, NDArray[np.bool_]]:
    """Displacements of a level: medians of the known ones of each block, whole pixels of that level."""
    side = 2**level
    maps = []
    for a in (prior.u, prior.v):
        padded = np.full((shape[0] * side, shape[1] * side), np.nan, np.float32)
        padded[: a.shape[0], : a.shape[1]] = a
        blocks = padded.reshape(shape[0], side, shape[1], side).swapaxes(1, 2).reshape(*shape, side * side)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # blocks without any are NaN, as they should be
            # No means: of a block across a depth edge they lie on neither surface.
            maps.append(np.nanmedian(blocks, axis=2) / side)
    known = np.isfinite(maps[0]) & np.isfinite(maps[1])
    u, v = (np.rint(np.where(known, a, 0.0)).astype(np.int16) for a in maps)
    return u, v, known


def _reverse(
    u: AnyArray, v: AnyArray, known: NDArray[np.bool_], shape: tuple[int, ...], near: AnyArray
) -> tuple[AnyArray, AnyArray, NDArray[np.bool_]]:
    """Displacements of the right image: each left one at its far end; of several the nearest thing's, by ``near``."""
    y, x = np.nonzero(known)
    # From far to near, since of several that meet at a pixel the last one stays: the one that hides the others.
    order = np.argsort(near[y, x], kind="stable")
    y, x = y[order], x[order]
    xr, yr = x + u[y, x].astype(np.intp), y + v[y, x].astype(np.intp)
    inside = (xr >= 0) & (xr < shape[1]) & (yr >= 0) & (yr < shape[0])
    y, x, yr, xr = y[inside], x[inside], yr[inside], xr[inside]
    ru, rv, hit = np.zeros(shape, np.int16), np.zeros(shape, np.int16), np.zeros(shape, bool)
    ru[yr, xr], rv[yr, xr], hit[yr, xr] = -u[y, x], -v[y, x], True
    return ru, rv, hit


def _overlay(m: Map, u: AnyArray, v: AnyArray, known: NDArray[np.bool_]) -> Map:
    return Map(np.where(known, u, m.u), np.where(known, v, m.v))


MIN_FIT_PIXELS = 100
"""Pixels that a polynomial needs at least."""

MIN_GREY, MAX_GREY = 4.0, 250.0
"""Grey levels between which pixels are used for the ratio."""

MIN_LOG_RATIO = 0.1
"""Logarithm of the ratio that must be reached somewhere in the image for it to be corrected."""


def terms(x: AnyArray, y: AnyArray, level: int, shape: Shape) -> Floats:
    """Terms (7, ...) of the polynomial at pixels of a level of an image of ``shape`` (level 0).

    1, x, y, x^2, xy, y^2 and (x^2 + y^2)^2, in half sides from the middle.
    """
    k = 2.0**level
    # Counted from the image's outer corner, where pixel x of any level has its centre at k (x + 0.5).
    p = ((x + 0.5) * k) / (0.5 * shape[1]) - 1.0
    q = ((y + 0.5) * k) / (0.5 * shape[0]) - 1.0
    p, q = np.broadcast_arrays(p, q)
    return np.stack([np.ones_like(p), p, q, p * p, p * q, q * q, (p * p + q * q) ** 2])


def levelled(image: Image, ratio: Floats | None) -> Image:
    """The image with the ratio corrected; None: the image as it is."""
    if ratio is None:
        return image
    # Noise is multiplied as the middle of the image is.
    return image.changed(partial(_brighter, ratio, image.shapes[0]), image.noise * float(np.exp(ratio[0])))


def _brighter(g: Floats, shape: Shape, read: Callable[[Window], Grey], level: int, window: Window) -> Grey:
    grey, mask = read(window)
    y, x = np.arange(window.y0, window.y1)[:, None], np.arange(window.x0, window.x1)
    p, q = terms(x, 0 * x, level, shape)[1], terms(0 * y, y, level, shape)[2]
    # Horner's form, a row of terms each: seven planes of the whole image would take longer than all else.
    radial = (p * p + q * q).astype(np.float32)
    log = (g[0] + p * (g[1] + g[3] * p)).astype(np.float32) + (q * (g[2] + g[5] * q)).astype(np.float32)
    log += np.float32(g[4]) * (p.astype(np.float32) * q.astype(np.float32)) + np.float32(g[6]) * radial * radial
    return grey * np.exp(log), mask


def guess(left: Image, right: Image, level: int) -> Floats:
    """Ratio of the polynomials that either image's own brightness follows at a level; zeros of dark or tiny images."""
    polynomials = []
    for image in (left, right):
        layer = image.layers[level]
        y, x = np.nonzero((layer.valid != 0) & (layer.grey > MIN_GREY))
        if len(y) < MIN_FIT_PIXELS:
            return np.zeros(7)
        polynomials.append(_fit(terms(x, y, level, image.shapes[0]), np.log(layer.grey[y, x].astype(np.float64))))
    return polynomials[0] - polynomials[1]


def ratio_of_matches(left: Image, right: Image, state: State) -> Floats | None:
    """Ratio of the grey values of the consistent matches of a level; None where they are too few."""
    y, x = thinned(state.left_ok, 4000)
    p, q = x + state.left.u[y, x].astype(np.int64), y + state.left.v[y, x].astype(np.int64)
    a, b = left.layers[state.level].grey[y, x], right.layers[state.level].grey[q, p]
    # At MIN_GREY one grey level is a quarter of the value, five times the least scatter; at the top values are clipped.
    good = (np.minimum(a, b) > MIN_GREY) & (np.maximum(a, b) < MAX_GREY)
    if np.count_nonzero(good) < MIN_FIT_PIXELS:
        return None
    # Places of the right image, since that is the one to be multiplied.
    basis = terms(p[good], q[good], state.level, right.shapes[0])
    return _fit(basis, np.log(a[good].astype(np.float64) / b[good]))


def _fit(basis: Floats, target: Floats) -> Floats:
    """Factors of the terms, by Cauchy weights; weakly held at zero."""

    def weigh(off: AnyArray) -> AnyArray:
        # 1.5 times the median magnitude is about the standard deviation of normal scatter.
        # 0.05: least scatter of the logarithms of matched grey values.
        return cauchy(off, max(0.05, 1.5 * epipolar.typical(off)))

    # Terms that the matches leave open stay near zero instead of growing outside of them.
    hold = 1e-3 * target.size * np.eye(len(basis))
    return irls(basis.T, target, weigh, hold, np.zeros(len(basis)), rounds=8)


def greatest(ratio: Floats) -> float:
    """Greatest logarithm, either way, in the image."""
    side = np.linspace(0, 1, 9)
    # Nine places from edge to edge of an image of 9 x 9: terms are in half sides, so that any size stands for all.
    return float(np.abs(np.tensordot(ratio, terms(side * 9 - 0.5, (side * 9 - 0.5)[:, None], 0, (9, 9)), 1)).max())


COARSE_LEVEL = 2
"""Level whose matches decide on brightness, alignment by a plane, and turned views."""


class Unlike(NamedTuple):
    """How the right image differs from the left one: whether it was ``aligned`` by a plane, and ``blur``, pixels: the
    standard deviation of the Gaussian that it is blurred by beside the left one; negative: the left one is."""

    aligned: bool = False
    blur: float = 0.0

    def doubled(self) -> Unlike:
        """The same of images of twice the resolution."""
        return self._replace(blur=2 * self.blur)


@dataclass(frozen=True)
class Coarse:
    """A pair of images and its matches at a coarse level, ``state``.

    ``images``: the images as they are matched: the right one in the left one's brightness, divided by ``ratio``, and
    aligned by the homography ``alignment`` (None: neither). ``given``: the right one as it came. ``prior``: disparities
    known beforehand. ``blur``: of the left and the right image in the refinement, pixels (:func:`focus`).
    """

    images: PyramidPair
    state: State
    given: Image
    ratio: Floats | None = None
    alignment: plane.Matrix | None = None
    prior: PriorDisparities | None = None
    blur: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def right(self) -> Image:
        """The right image in the left one's brightness, before it is aligned."""
        return levelled(self.given, self.ratio)

    @cached_property
    def scale(self) -> float:
        """How many times larger the right image shows things than the left one does; 1 where it is not aligned."""
        return 1.0 if self.alignment is None else plane.scale(self.alignment, self.images.left.shapes[0])

    @property
    def unlike(self) -> Unlike:
        """What a user is told of how the right image differs. Blur that follows from the scale is no fault."""
        left, right = (0.0, 0.0) if unlike_scale(self.scale) else self.blur
        return Unlike(self.alignment is not None, left - right)

    @property
    def share(self) -> float:
        """Share of the left image's pixels with texture that are consistent; of those that the right image sees, where
        it is aligned."""
        left, level = self.images.left, self.state.level
        told = textured(left.layers[level], self.images.params)
        if self.alignment is not None:
            rows, cols = (slice(m := plane.margin(left.shapes[0]) >> level, m + n) for n in told.shape)
            told &= self.images.right.layers[level].valid[rows, cols] != 0
        return float(np.mean(self.state.left_ok[told])) if told.any() else 0.0

    def with_threads(self, threads: int) -> Coarse:
        """The same, to be matched on by so many threads."""
        return replace(self, images=replace(self.images, threads=threads))

    def seen(self) -> Coarse:
        """The same with the right image as it is matched."""
        right = self.right if self.alignment is None else plane.aligned(self.right, self.alignment, self.images.left)
        return replace(self, images=replace(self.images, right=right))

    def anew(self, registered: bool = False, **changed: Any) -> Coarse:
        """Coarse levels of the images with another ``ratio`` or ``alignment``; ``registered``: by which they are known
        to lie on each other."""
        other = replace(self, **changed).seen()
        above = registration(other.images) if registered else None
        return replace(other, state=descend(other.images, COARSE_LEVEL, above, other.state.near_sign))


def registration(images: PyramidPair) -> State:
    """State above the top in which the right image, which was aligned, lies on the left one."""
    level, by = images.levels, plane.margin(images.left.shapes[0]) >> images.levels
    a, b = (tuple((n + 1) // 2 for n in image.shapes[level - 1]) for image in (images.left, images.right))
    left, right = Map(*np.full((2, *a), by, np.int16)), Map(*np.full((2, *b), -by, np.int16))
    return State(level, left, right, np.ones(a, bool), np.ones(b, bool), FREE_BAND, 0.0)


def even(coarse: Coarse) -> Coarse:
    """Brightness ratio of both images undone in the right one, first by a guess where little matches."""
    left = coarse.images.left
    # 0.85: share of consistent pixels from which on no other brightness is guessed.
    if coarse.share < 0.85:
        guessed = guess(left, coarse.given, min(COARSE_LEVEL + 2, coarse.images.levels - 1))
        if greatest(guessed) > MIN_LOG_RATIO:
            tried = coarse.anew(ratio=guessed)
            coarse = tried if tried.share > coarse.share else coarse
    for _ in range(2):  # matches correct the ratio, and those of the corrected image once more
        ratio = ratio_of_matches(left, coarse.given, coarse.state)
        before = 0.0 if coarse.ratio is None else coarse.ratio
        if ratio is None or greatest(ratio - before) <= MIN_LOG_RATIO:
            break
        tried = coarse.anew(ratio=ratio)
        # Of the consistent pixels a few change anyway.
        if tried.share < 0.95 * coarse.share:
            break
        coarse = tried
    return coarse


def known(coarse: Coarse) -> Coarse:
    """Disparities known beforehand in the place of those found."""
    prior, h = coarse.prior, coarse.alignment
    if prior is not None and h is not None:
        # Points near the horizon of the plane get displacements greater than the prior's.
        prior = _bounded(*plane.carried(np.linalg.inv(plane.to_original(h, prior.u.shape)), prior.u, prior.v))
    return replace(coarse, state=impose(coarse.images, coarse.state, prior))


def align(coarse: Coarse) -> Coarse:
    """The right image aligned by the dominant plane, where one explains the matches."""
    # 0.8: share of consistent pixels below which a plane need explain fewer of them.
    few = coarse.share < 0.8
    h = plane.find(sample(coarse.images, coarse.state), coarse.state.level, coarse.images.left.shapes, few)
    return coarse if h is None else known(coarse.anew(alignment=h))


def turn(coarse: Coarse) -> Coarse:
    """The right image turned and scaled by keypoints, where hardly a pixel matches and that helps."""
    # A plane may also be fitted to the few matches that chance makes.
    left, given = coarse.images.left, coarse.given
    unlike = coarse.alignment is None and other_size(left.shapes[0], given.shapes[0])
    # 0.6: share of consistent pixels below which the images may be turned, or far apart: chance alone makes up to .23
    # of them so, with preset ``accurate``, which smooths more, up to .46; pairs of usual rigs have .8 and more.
    few = unlike or coarse.share <= 0.6
    h = plane.find_turn(left, given) if few and coarse.prior is None else None
    if h is None:
        return coarse
    # Brightness can be compared only once the images are upright.
    upright = replace(coarse, state=replace(coarse.state, near_sign=0.0), ratio=None)
    # The right image may show a part of the left one, or the other way round: coarse levels would find chance there.
    turned = upright.anew(registered=True, alignment=h)
    # Keypoints lie on objects that stand out; the matches after the turn show the plane better.
    h = plane.refitted(sample(turned.images, turned.state), turned.state.level, left.shapes, h)
    again = turned if h is None else upright.anew(registered=True, alignment=h)
    return max(coarse, turned, again, key=lambda tried: tried.share)


Places = tuple[AnyArray, AnyArray]
"""Rows and columns (n,) of pixels."""


def matched_places(coarse: Coarse) -> tuple[Places, Places]:
    """Pixels of consistent matches with texture, in the left image and in the right one as it came, at the level."""
    state, h = coarse.state, coarse.alignment
    layer, shape = coarse.images.left.layers[state.level], coarse.right.layers[state.level].shape
    # 4000: places that tell the energies of texture to a few per cent.
    y, x = thinned(state.left_ok & textured(layer, coarse.images.params), 4000)
    own = np.eye(3) if h is None else plane.to_original(h, coarse.images.left.shapes[0])
    to_level_0 = plane.finer(state.level)
    ends = np.linalg.inv(to_level_0) @ own @ to_level_0
    p, q, w = product(ends, x + state.left.u[y, x], y + state.left.v[y, x])
    row, col = (np.clip(np.rint(a / w), 0, n - 1).astype(np.int64) for a, n in zip((q, p), shape, strict=True))
    return (y, x), (row, col)


def unlike_scale(scale: float) -> bool:
    """Whether detail differs by the scale more than between cameras of one kind."""
    return abs(math.log(scale)) > 0.15


def focus(coarse: Coarse) -> Coarse:
    """The same with the ``blur`` that leaves the sharper image the detail of the other one; none where both are alike.

    Detail is the energy of fine texture over that of coarser one, at the matches; not in an aligned image, which
    interpolation has blurred. Between images of other scale it follows from the scale.
    """
    level, left, larger = coarse.state.level, coarse.images.left, coarse.scale
    if unlike_scale(larger):
        # A pixel sees its square, whose variance is 1/12.
        blur = math.sqrt((max(larger, 1.0 / larger) ** 2 - 1.0) / 12.0)
        return replace(coarse, blur=(0.0, blur) if larger > 1.0 else (blur, 0.0))
    shown = tuple(zip((left.layers[level].grey, coarse.right.layers[level].grey), matched_places(coarse), strict=True))

    def bands(blur: float, side: int, widths: Sequence[float]) -> list[AnyArray]:
        grey, at = shown[side]
        seen = [cv2.GaussianBlur(grey, None, math.hypot(k, blur / 2**level))[at] for k in widths]
        return [fine - coarser for fine, coarser in pairwise(seen)]

    def detail(fine: AnyArray, coarser: AnyArray) -> float:
        return float(np.sum(np.square(fine[alike]))) / max(float(np.sum(np.square(coarser[alike]))), 1e-9)

    a, b = (bands(0.0, side, (0.7, 1.4, 2.8, 4.0)) for side in (0, 1))
    # Wrong matches show other detail, as a rule less than the place that they were sought for; right ones show the same
    # coarse texture, which a blur leaves.
    alike = np.abs(a[2] - b[2]) < 0.3 * np.minimum(np.abs(a[2]), np.abs(b[2]))
    # 1000: places of which chance leaves the ratio of detail above 0.85; of 600 it does not.
    if np.count_nonzero(alike) < 1000:
        return coarse
    found = detail(*a[:2]), detail(*b[:2])
    side, less = int(found[1] > found[0]), min(found)

    def more(blur: float) -> float:
        return detail(*bands(blur, side, (0.7, 1.4, 2.8))) - less

    # 0.85: cameras of one kind have 0.93 and more, images blurred by 0.8 pixels have as much. Beyond 4 pixels there is
    # little left to match.
    if less >= 0.85 * max(found) or more(4.0) >= 0:
        return coarse
    blur = brentq(more, 0.0, 4.0, xtol=0.01)
    return replace(coarse, blur=(0.0, blur) if side else (blur, 0.0))


def match_coarse_levels(images: PyramidPair, prior: PriorDisparities | None = None) -> Coarse:
    """The coarse levels of two images as they are, down to level 1 or, of small images, to the top."""
    coarse = Coarse(images, descend(images, COARSE_LEVEL), images.right, prior=prior)
    for step in images.params.kept((even, known, align, turn)):
        coarse = step(coarse)
    return focus(replace(coarse, state=descend(coarse.images, 1, coarse.state, coarse.state.near_sign)))
