"""Coarse levels of a pair, step by step: brightness, alignment by a plane or keypoints, focus.

Focus: where one image shows less detail, distances of features and residuals of the refinement measure the blur instead
of the displacement. At the finest level the sharper image is then blurred by a Gaussian to the same detail.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.geometry.projection import product
from rille.stages.geometry.scale import other_size
from rille.stages.hfvm import plane
from rille.stages.hfvm.brightness import MIN_LOG_RATIO, greatest, guess, levelled, ratio_of_matches
from rille.stages.hfvm.image import Image, thinned
from rille.stages.hfvm.level import FREE_BAND, PyramidPair, State, descend, sample, textured
from rille.stages.hfvm.native.problem import Map

COARSE_LEVEL = 2
"""Level whose matches decide on brightness, alignment by a plane, and turned views."""


class ImageDifference(NamedTuple):
    """How the right image differs from the left one: whether it was ``aligned`` by a plane, and ``blur``, pixels: the
    standard deviation of the Gaussian that it is blurred by beside the left one; negative: the left one is."""

    aligned: bool = False
    blur: float = 0.0

    @property
    def blurred(self) -> tuple[str, str]:
        """Side of the blurred image, and that of the sharper one; meaningless without blur."""
        return ("right", "left") if self.blur > 0 else ("left", "right")

    def doubled(self) -> ImageDifference:
        """The same of images of twice the resolution."""
        return self._replace(blur=2 * self.blur)


@dataclass(frozen=True)
class Coarse:
    """A pair of images and its matches at a coarse level, ``state``.

    ``images``: the images as they are matched: the right one in the left one's brightness, divided by ``ratio``, and
    aligned by the homography ``alignment`` (None: neither). ``given``: the right one as it came. ``blur``: of the left
    and the right image at the finest level, pixels (:func:`focus`).
    """

    images: PyramidPair
    state: State
    given: Image
    ratio: Floats | None = None
    alignment: plane.Matrix | None = None
    blur: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def right(self) -> Image:
        """The right image in the left one's brightness, before it is aligned."""
        return levelled(self.given, self.ratio)

    @cached_property
    def scale(self) -> float:
        """Size of things in the right image over their size in the left one; 1 where it is not aligned."""
        return 1.0 if self.alignment is None else plane.scale(self.alignment, self.images.left.shapes[0])

    @property
    def unlike(self) -> ImageDifference:
        """How the right image differs, for the user: without blur that follows from the scale."""
        left, right = (0.0, 0.0) if unlike_scale(self.scale) else self.blur
        return ImageDifference(self.alignment is not None, left - right)

    @property
    def share(self) -> float:
        """Share of consistent pixels among the left image's pixels with texture; among those in the right image's view,
        where it is aligned."""
        left, level = self.images.left, self.state.level
        told = textured(left.layers[level], self.images.params)
        if self.alignment is not None:
            rows, cols = (slice(m := plane.margin(left.shapes[0]) >> level, m + n) for n in told.shape)
            told &= self.images.right.layers[level].valid[rows, cols] != 0
        return float(np.mean(self.state.left_ok[told])) if told.any() else 0.0

    def with_threads(self, threads: int) -> Coarse:
        """The same, matched further by so many threads."""
        return replace(self, images=replace(self.images, threads=threads))

    def seen(self) -> Coarse:
        """The same with the right image as it is matched."""
        right = self.right if self.alignment is None else plane.aligned(self.right, self.alignment, self.images.left)
        return replace(self, images=replace(self.images, right=right))

    def anew(self, registered: bool = False, **changed: Any) -> Coarse:
        """Coarse levels of the images with another ``ratio`` or ``alignment``, which puts them on each other if
        ``registered``."""
        other = replace(self, **changed).seen()
        above = registration(other.images) if registered else None
        return replace(other, state=descend(other.images, COARSE_LEVEL, above, other.state.near_sign))


def registration(images: PyramidPair) -> State:
    """State above the top level in which the aligned right image lies on the left one."""
    level, by = images.levels, plane.margin(images.left.shapes[0]) >> images.levels
    a, b = (tuple((n + 1) // 2 for n in image.shapes[level - 1]) for image in (images.left, images.right))
    left, right = Map(*np.full((2, *a), by, np.int16)), Map(*np.full((2, *b), -by, np.int16))
    return State(level, left, right, np.ones(a, bool), np.ones(b, bool), FREE_BAND, 0.0)


def even(coarse: Coarse) -> Coarse:
    """Correct the right image's brightness to the left one's, first by a guess where little matches."""
    left = coarse.images.left
    # 0.85: share of consistent pixels from which on brightness is not guessed.
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
        # 0.95: a few consistent pixels change in any case.
        if tried.share < 0.95 * coarse.share:
            break
        coarse = tried
    return coarse


def align(coarse: Coarse) -> Coarse:
    """Align the right image by the dominant plane, where one explains the matches."""
    # 0.8: share of consistent pixels below which a plane of fewer matches counts.
    few = coarse.share < 0.8
    h = plane.find(sample(coarse.images, coarse.state), coarse.state.level, coarse.images.left.shapes, few)
    return coarse if h is None else coarse.anew(alignment=h)


def turn(coarse: Coarse) -> Coarse:
    """Align the right image by keypoints, where hardly a pixel matches and more do so afterwards."""
    left, given = coarse.images.left, coarse.given
    unlike = coarse.alignment is None and other_size(left.shapes[0], given.shapes[0])
    # 0.6: share of consistent pixels up to which the images may be turned, or far apart: by chance up to .23 are
    # consistent, with preset ``accurate``, which smooths more, up to .46; pairs of usual rigs have .8 and more.
    few = unlike or coarse.share <= 0.6
    h = plane.find_turn(left, given) if few else None
    if h is None:
        return coarse
    # Brightness can be compared only once the images are upright.
    upright = replace(coarse, state=replace(coarse.state, near_sign=0.0), ratio=None)
    # Registered: one image may show a part of the other, where a search of the top level would match by chance.
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
    # 4000: places that determine the energies of texture to a few per cent.
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
    """Determine the ``blur`` that reduces the sharper image to the detail of the other one; none if both are alike.

    Detail is the energy of fine texture over that of coarser texture, at the matches, in the original images, since
    interpolation blurs the aligned one. Between images of unlike scale the blur follows from the scale.
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
    # Wrong matches have other detail, mostly less than the left pixel has. Right ones have the same coarse texture,
    # which blur does not change.
    alike = np.abs(a[2] - b[2]) < 0.3 * np.minimum(np.abs(a[2]), np.abs(b[2]))
    # 1000: places of which chance leaves the ratio of detail above 0.85; of 600 it does not.
    if np.count_nonzero(alike) < 1000:
        return coarse
    found = detail(*a[:2]), detail(*b[:2])
    side, less = int(found[1] > found[0]), min(found)

    def more(blur: float) -> float:
        return detail(*bands(blur, side, (0.7, 1.4, 2.8))) - less

    # 0.85: cameras of one kind have 0.93 and more, as have images blurred by 0.8 pixels. Beyond 4 pixels hardly any
    # pixel matches.
    if less >= 0.85 * max(found) or more(4.0) >= 0:
        return coarse
    blur = scipy.optimize.brentq(more, 0.0, 4.0, xtol=0.01)
    return replace(coarse, blur=(0.0, blur) if side else (blur, 0.0))


def match_coarse_levels(images: PyramidPair) -> Coarse:
    """The coarse levels of two images as they are, down to level 1 or, of small images, to the top."""
    coarse = Coarse(images, descend(images, COARSE_LEVEL), images.right)
    for step in images.params.kept((even, align, turn)):
        coarse = step(coarse)
    return focus(replace(coarse, state=descend(coarse.images, 1, coarse.state, coarse.state.near_sign)))
