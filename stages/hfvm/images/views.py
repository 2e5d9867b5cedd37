"""Images as the matcher sees them: grey values, masks and features of a window at any level of a pyramid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.images import denoise, plane
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.window import Raster, Shape, Window, cut, tiles, whole
from rille.stages.hfvm.level import compact, features, paper
from rille.stages.hfvm.level.window_pair import WindowPair
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid

STRIP = 256
"""Rows whose features are computed at once where many are wanted: their room is small beside the result."""


class View(Protocol):
    """One image."""

    @property
    def shapes(self) -> Sequence[Shape]:
        """Rows and columns of each level."""

    @property
    def blank(self) -> float:
        """Grey level where no level is valid."""

    @property
    def removed_noise(self) -> float:
        """Noise of level 0 before it was denoised, standard deviation in grey levels; 0 where it was not denoised."""

    def grey(self, level: int, window: Window) -> AnyArray:
        """Grey values, float32, 0 where masked."""

    def valid(self, level: int, window: Window) -> AnyArray:
        """Mask, uint8, 1 = usable."""

    def filled(self, level: int, window: Window) -> AnyArray:
        """As ``grey``; masked pixels carry the grey of the next valid level above
        (:attr:`rille.stages.imaging.pyramid.Pyramid.filled`)."""


@dataclass(frozen=True)
class Plain:
    """A pyramid of rasters. ``noise``: standard deviation of level 0, grey levels; ``blank``: see :class:`Aligned`."""

    images: Sequence[Raster]
    masks: Sequence[Raster]
    blank: float
    noise: float = 0.0

    @staticmethod
    def of(pyramid: Pyramid) -> Plain:
        """View of a pyramid in memory."""
        return Plain.open(pyramid.images, pyramid.valid, pyramid.noise)

    @staticmethod
    def open(images: Sequence[Raster], masks: Sequence[Raster], noise: float) -> Plain:
        """View of levels that are read by window."""
        top = whole(images[-1].shape)
        return Plain(images, masks, mean_grey(cut(images[-1], top), cut(masks[-1], top)), noise)

    def halved(self) -> Plain:
        """The view without its finest level."""
        # Noise halves from level to level, unlike texture.
        return Plain(self.images[1:], self.masks[1:], self.blank, 0.5 * self.noise)

    def quiet(self, params: HfvmParams) -> View:
        """The view denoised where it is noisy, else itself."""
        return Denoised(self) if self.noise >= params.denoise_from else self

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Rows and columns of each level."""
        return tuple(image.shape for image in self.images)

    @property
    def removed_noise(self) -> float:
        """None."""
        return 0.0

    def grey(self, level: int, window: Window) -> AnyArray:
        """Grey values, 0 where masked."""
        return cut(self.images[level], window)

    def valid(self, level: int, window: Window) -> AnyArray:
        """Mask."""
        return cut(self.masks[level], window)

    def filled(self, level: int, window: Window) -> AnyArray:
        """Grey values, those of masked pixels from above."""
        return fill(self, level, window)


@dataclass(frozen=True)
class Changed:
    """What a view with other grey values has in common with the ``view`` that it is of."""

    view: View

    @property
    def shapes(self) -> Sequence[Shape]:
        """Rows and columns of each level."""
        return self.view.shapes

    @property
    def blank(self) -> float:
        """Grey level where no level is valid."""
        return self.view.blank

    def valid(self, level: int, window: Window) -> AnyArray:
        """Mask."""
        return self.view.valid(level, window)


@dataclass(frozen=True)
class Denoised(Changed):
    """A noisy view, each level denoised by the noise that halving has left (:mod:`rille.stages.hfvm.images.denoise`).

    With a binomial kernel on the finest level alone bad-2 of five noisy pairs was 2 % and the median error 5 % larger.
    """

    view: Plain

    @property
    def removed_noise(self) -> float:
        """Noise of the view before."""
        return self.view.noise

    def grey(self, level: int, window: Window) -> AnyArray:
        """Grey values, 0 where masked."""
        return np.where(self.valid(level, window) != 0, self.filled(level, window), np.float32(0.0))

    def filled(self, level: int, window: Window) -> AnyArray:
        """Grey values, those of masked pixels from above."""
        outer = window.grow(1, 1, self.shapes[level])
        rows, cols = window.inside(outer)
        # The image's edge is repeated; other sides of the window have their neighbours.
        spare = [(1 - s.start, 1 - (n - s.stop)) for s, n in zip((rows, cols), outer.shape, strict=True)]
        padded = np.pad(self.view.filled(level, outer), spare, mode="edge")
        return denoise.lee(padded, self.view.noise * 0.5**level)


def mean_grey(image: AnyArray, mask: AnyArray) -> float:
    """Mean of the valid pixels, 0 without any."""
    mask = mask != 0
    return float(image[mask].mean()) if mask.any() else 0.0


def fill(view: View, level: int, window: Window) -> AnyArray:
    """Grey values of a window, those of masked pixels from the next valid level above."""
    image, mask = view.grey(level, window), view.valid(level, window) != 0
    if mask.all():
        return image
    if level + 1 == len(view.shapes):
        return np.where(mask, image, np.float32(view.blank))
    outer = window.parent()
    above = view.filled(level + 1, outer)
    return pyramid.filled_from(above, image, mask, window.y0 - 2 * outer.y0, window.x0 - 2 * outer.x0)


@dataclass(frozen=True)
class Aligned:
    """The right image resampled to the left one's geometry by a plane, a window at a time.

    ``h``: homography from aligned to right pixels (level 0). Levels from ``kept`` on are held in memory, finer ones are
    resampled at each access. ``blank``: grey level of masked pixels that no level covers: the mean of the coarsest.
    """

    right: View
    h: plane.Matrix
    left_shape: Shape
    shapes: Sequence[Shape]
    images: Sequence[AnyArray]
    masks: Sequence[AnyArray]
    kept: int
    blank: float

    @staticmethod
    def of(right: View, h: plane.Matrix, left: View, kept: int, side: int | None) -> Aligned:
        """View whose levels from ``kept`` on are computed here and now, ``side`` pixels of level 0 at a time."""
        bare = Aligned.again(right, h, left, 0.0)
        shapes = bare.shapes
        # The coarsest level in any case: few levels may end above the one that is asked for.
        kept = min(kept, len(shapes) - 1)
        images, masks = ([np.empty(s, k) for s in shapes[kept:]] for k in (np.float32, np.uint8))
        # Tiles begin where a pixel of the top level does: no pixel of any level then lies in two of them.
        step = 2 ** (len(shapes) - 1)
        for window in tiles(shapes[0], None if side is None else -(-side // step) * step):
            part = bare.part(window)
            for n in range(kept, len(shapes)):
                y, x = window.y0 >> n, window.x0 >> n
                rows, cols = part.images[n].shape
                images[n - kept][y : y + rows, x : x + cols] = part.images[n]
                masks[n - kept][y : y + rows, x : x + cols] = part.valid[n]
        blank = mean_grey(images[-1], masks[-1])
        return Aligned(right, h, left.shapes[0], shapes, images, masks, kept, blank)

    @staticmethod
    def again(right: View, h: plane.Matrix, left: View, blank: float) -> Aligned:
        """Return a view that holds no level in memory; ``blank``: see the class."""
        m = plane.margin(left.shapes[0])
        shapes = pyramid_shapes((left.shapes[0][0] + 2 * m, left.shapes[0][1] + 2 * m), len(left.shapes))
        return Aligned(right, h, left.shapes[0], shapes, (), (), len(shapes), blank)

    @property
    def removed_noise(self) -> float:
        """Noise of the right image."""
        return self.right.removed_noise

    def grey(self, level: int, window: Window) -> AnyArray:
        """Grey values, 0 where masked."""
        if level >= self.kept:
            return cut(self.images[level - self.kept], window)
        part, inner = self._around(level, window)
        return cut(part.images[level], inner)

    def valid(self, level: int, window: Window) -> AnyArray:
        """Mask."""
        if level >= self.kept:
            return cut(self.masks[level - self.kept], window)
        part, inner = self._around(level, window)
        return cut(part.valid[level], inner)

    def filled(self, level: int, window: Window) -> AnyArray:
        """Grey values, those of masked pixels from above."""
        if level >= self.kept:
            return fill(self, level, window)
        part, inner = self._around(level, window)
        return fill(Plain(part.images, part.valid, self.blank), level, inner)

    def _around(self, level: int, window: Window) -> tuple[Pyramid, Window]:
        """Pyramid of the surroundings of a window, which start where a pixel of the top level does; and the window."""
        outer = window.align(2 ** (len(self.shapes) - 1 - level), self.shapes[level])
        base = Window(outer.y0 << level, outer.y1 << level, outer.x0 << level, outer.x1 << level)
        part = self.part(base.grow(0, 0, self.shapes[0]))
        rows, cols = window.inside(outer)
        return part, Window(rows.start, rows.stop, cols.start, cols.stop)

    def part(self, window: Window) -> Pyramid:
        """Pyramid of a window of level 0 that starts and ends where a pixel of the top level does."""
        h = self.h @ plane.translation(-plane.margin(self.left_shape))
        image, mask = np.empty(window.shape, np.float32), np.empty(window.shape, np.uint8)
        shape = self.right.shapes[0]
        source = plane.source(h, window, shape)
        grey, valid = self.right.filled(0, source), self.right.valid(0, source)
        plane.warp(grey, valid, h, image, mask, WindowPair(window.x0, window.y0, source.x0, source.y0, *shape))
        return pyramid.halved(image, mask, len(self.shapes))


def pyramid_shapes(shape: Shape, levels: int, min_side: int = pyramid.PyramidParams().min_side) -> list[Shape]:
    """Rows and columns of the levels of :func:`rille.stages.imaging.pyramid.build` for at most so many levels."""
    found = [shape]
    while len(found) < levels and min(found[-1]) >= 2 * min_side:
        found.append(((found[-1][0] + 1) // 2, (found[-1][1] + 1) // 2))
    return found


@dataclass(frozen=True)
class Patch:
    """A window of an image at one level as the solver wants it.

    ``words``: features; ``grey``: filled grey values; ``deviation``: local deviation, grey levels, or None. The window
    may be wider than what was asked for.
    """

    window: Window
    words: AnyArray
    grey: AnyArray
    deviation: AnyArray | None

    @cached_property
    def compact(self) -> AnyArray:
        """Compact features; both directions of a match ask for them."""
        return compact.pack(self.grey)


@dataclass(frozen=True)
class Seen:
    """A view and its features. ``held``: features of whole levels, computed once; None: of each window anew."""

    view: View
    params: HfvmParams
    held: dict[int, Patch] | None = field(default_factory=dict)

    def patch(self, level: int, window: Window, deviation: bool = False) -> Patch:
        """Features of a window of a level."""
        if self.held is None:
            return self._compute(level, window, deviation)
        if level not in self.held:
            # With the deviation, which the finest level's validity asks for: the features are computed but once.
            self.held[level] = self._compute(level, whole(self.view.shapes[level]), True)
        return self.held[level]

    def _compute(self, level: int, window: Window, deviation: bool) -> Patch:
        """In strips of rows where not the whole is held: their room is small beside the features."""
        if self.held is not None or window.shape[0] <= STRIP:
            words, local, grey = self._strip(level, window)
            return Patch(window, words, grey, local)
        parts = [Window(y, min(y + STRIP, window.y1), window.x0, window.x1) for y in range(window.y0, window.y1, STRIP)]
        first = self._strip(level, parts[0])
        words = np.empty((window.shape[0], *first[0].shape[1:]), first[0].dtype)
        room = np.empty(window.shape, np.float32) if deviation else None
        grey = np.empty(window.shape, np.float32)
        for part in parts:
            some, local, image = first if part is parts[0] else self._strip(level, part)
            rows = slice(part.y0 - window.y0, part.y1 - window.y0)
            words[rows], grey[rows] = some, image
            if room is not None:
                room[rows] = local
        return Patch(window, words, grey, room)

    def _strip(self, level: int, window: Window) -> tuple[AnyArray, AnyArray, AnyArray]:
        # Features repeat the edge of what they are given: that may be the image's, but not a window's.
        outer = window.grow(features.RADIUS, features.RADIUS, self.view.shapes[level])
        grey = self.view.filled(level, outer)
        inner = window.inside(outer)
        if self.params.preset == "paper":
            planes = features.planes(grey)[(slice(None), *inner)]
            return paper.weighted(planes, self.params.weights), planes[6], grey[inner]
        words, deviation = features.pack(grey, self.params.weights)
        words, deviation, grey = (np.ascontiguousarray(a[inner]) for a in (words, deviation, grey))
        return words, deviation, grey
