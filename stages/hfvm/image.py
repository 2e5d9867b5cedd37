"""Images as the matcher sees them: of each level grey values, mask and features, computed when they are asked for.

A level is read by windows, so that a tile of a large image reads no more than its surroundings. What changes an image
(denoising, brightness, alignment by a plane) makes an image of other readers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import features
from rille.stages.hfvm.params import HfvmParams, Weights
from rille.stages.hfvm.windows import Shape, Window, whole
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid

Grey = tuple[AnyArray, AnyArray]
"""Grey values (row, col) float32, of masked pixels from the next valid level above, and mask uint8, 1 = usable."""

NOISE_VARIANCE_RATIO = 2.5
"""The variance of nine pixels of white noise reaches 2.5 times its expectation in one of two hundred places; all others
are averaged alike. A texture of random dots, which looks like noise, then still matches where it is shifted by a
fraction of a pixel: .87 and more of it, with 1 as little as .07. Bad-2 of noisy pairs is alike from 1 to 2.5."""


@dataclass(frozen=True)
class Layer:
    """A level of an image, or a window of it. ``read``: grey values of any window; ``shape``: of the level."""

    read: Callable[[Window], Grey]
    shape: Shape
    weights: Weights
    window: Window

    @staticmethod
    def of(read: Callable[[Window], Grey], shape: Shape, weights: Weights) -> Layer:
        """The whole level."""
        return Layer(read, shape, weights, whole(shape))

    def cut(self, window: Window) -> Layer:
        """A window of the level."""
        return replace(self, window=window)

    @cached_property
    def _both(self) -> Grey:
        return self.read(self.window)

    @property
    def grey(self) -> AnyArray:
        """Grey values."""
        return self._both[0]

    @property
    def valid(self) -> AnyArray:
        """Mask."""
        return self._both[1]

    @cached_property
    def _features(self) -> tuple[AnyArray, AnyArray]:
        return features.pack(self.grey, self.weights)

    @property
    def words(self) -> AnyArray:
        """Features of Table 1, uint64."""
        return self._features[0]

    @property
    def deviation(self) -> AnyArray:
        """Local standard deviation, grey levels."""
        return self._features[1]

    @cached_property
    def compact(self) -> AnyArray:
        """Compact features, uint64."""
        return features.compact(self.grey)


@dataclass(frozen=True)
class Image:
    """An image. ``noise``: standard deviation that level 0 had before it was denoised, grey levels; 0 otherwise."""

    layers: tuple[Layer, ...]
    noise: float = 0.0

    @property
    def shapes(self) -> Sequence[Shape]:
        """Rows and columns of each level."""
        return [layer.shape for layer in self.layers]

    def above(self, level: int) -> Image:
        """The image from a level on; noise halves from level to level."""
        return Image(self.layers[level:], self.noise * 0.5**level)

    def cut(self, window: Window) -> Image:
        """A window of the finest level."""
        return Image((self.layers[0].cut(window),), self.noise)

    def changed(self, change: Callable[[Callable[[Window], Grey], int, Window], Grey], noise: float) -> Image:
        """The image read by ``change(reader, level, window)``."""
        layers = tuple(replace(layer, read=partial(change, layer.read, n)) for n, layer in enumerate(self.layers))
        return Image(layers, noise)


@dataclass(frozen=True)
class Stored:
    """Levels and masks of a pyramid, arrays or rasters that are read by window."""

    images: Sequence[AnyArray]
    masks: Sequence[AnyArray]

    def read(self, level: int, window: Window) -> Grey:
        """Grey values of a window; those of masked pixels from the next valid level above."""
        image, mask = (np.ascontiguousarray(a[level][window.slices]) for a in (self.images, self.masks))
        if mask.all():
            return image, mask
        if level + 1 == len(self.images):
            # At the top there is no level above: the mean of what is seen.
            everything = whole(self.masks[level].shape).slices
            top, usable = self.images[level][everything], self.masks[level][everything] != 0
            return np.where(mask, image, top[usable].mean() if usable.any() else np.float32(0.0)), mask
        outer = window.parent()
        above, _ = self.read(level + 1, outer)
        return pyramid.filled_from(above, image, mask != 0, window.y0 - 2 * outer.y0, window.x0 - 2 * outer.x0), mask


def view(given: Pyramid, params: HfvmParams) -> Image:
    """Image of a pyramid, denoised where it is noisy."""
    stored = Stored(given.images, given.valid)
    layers = [Layer.of(partial(stored.read, n), m.shape, params.weights) for n, m in enumerate(given.valid)]
    image = Image(tuple(layers))
    # Every level: with a binomial kernel on the finest alone bad-2 of five noisy pairs was 2 % larger, the median 5 %.
    return image.changed(partial(_denoised, given.noise), given.noise) if given.noise >= params.denoise_from else image


def _denoised(noise: float, read: Callable[[Window], Grey], level: int, window: Window) -> Grey:
    grey, mask = read(window)
    return lee(grey, noise * 0.5**level), mask


def lee(image: AnyArray, noise: float) -> Floats32:
    """Denoised grey values (row, col): noise is averaged where texture is hardly stronger, and left elsewhere.

    With mean m and variance s^2 of the 3 x 3 pixels around it and noise of standard deviation n, a grey value a becomes

        m + max(0, 1 - NOISE_VARIANCE_RATIO n^2 / s^2) (a - m)

    (J.-S. Lee (1980), Digital image enhancement and noise filtering by use of local statistics, IEEE Transactions on
    Pattern Analysis and Machine Intelligence 2, 165-168; there NOISE_VARIANCE_RATIO is 1.)
    """
    out = np.empty(image.shape, np.float32)
    _lee(np.pad(image, 1, mode="edge"), np.float32(NOISE_VARIANCE_RATIO * noise * noise), out)
    return out


@njit(cache=True, nogil=True)
def _lee(image, excess, denoised):  # type: ignore[no-untyped-def]
    middle, ninth, nil = np.float32(128.0), np.float32(1.0 / 9.0), np.float32(0.0)
    # What rounding may leave of the variance of a flat window, or take from it, squared grey levels.
    least = np.float32(1e-3)
    sums, squares = np.empty(image.shape[1], np.float32), np.empty(image.shape[1], np.float32)
    for y in range(denoised.shape[0]):
        above, here, below, out = image[y], image[y + 1], image[y + 2], denoised[y]
        for x in range(image.shape[1]):
            # From the middle of the range: the difference of squares below then loses fewer digits.
            a, b, c = above[x] - middle, here[x] - middle, below[x] - middle
            sums[x], squares[x] = a + b + c, a * a + b * b + c * c
        for x in range(denoised.shape[1]):
            mean = (sums[x] + sums[x + 1] + sums[x + 2]) * ninth
            variance = max((squares[x] + squares[x + 1] + squares[x + 2]) * ninth - mean * mean, least)
            gain = max(variance - excess, nil) / variance
            out[x] = (mean + gain * (here[x + 1] - middle - mean)) + middle
