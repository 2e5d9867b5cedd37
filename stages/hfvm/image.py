"""Images as the matcher sees them: windows, grey values, masks, and features (4.3.1).

A level is read by windows, so that a tile of a large image reads no more than its surroundings. What changes an image
(denoising, brightness, alignment by a plane) makes an image of other readers. Features are computed when they are asked
for.

Eight features a pixel (Table 1): high-pass and band-pass convolutions in both directions, local variance, and a
Gaussian. ``planes`` is the table to the letter, in floating point. ``pack`` is the fast form: the signed square root of
each feature (it tames strong edges, measured worth .01 of bad pixels), weighted and rounded to one byte, eight bytes to
one 64-bit word, so that a sum of absolute differences (the paper's cheaper form of Eq. 1) is a single instruction. The
variance enters as its square root, in grey levels like the other seven."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.params import HfvmParams, Weights
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Window:
    """Rows ``y0 <= y < y1`` and columns ``x0 <= x < x1`` of an image."""

    y0: int
    y1: int
    x0: int
    x1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the window in an array of the image."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def grow(self, rows: int, columns: int, shape: Shape) -> Window:
        """Wider by so much on every side, within an image of ``shape``: two pixels at least, with even borders, so that
        parents are whole."""
        (y0, y1), (x0, x1) = (
            _bounds(low - by, high + by, size)
            for low, high, by, size in ((self.y0, self.y1, rows, shape[0]), (self.x0, self.x1, columns, shape[1]))
        )
        return Window(y0, y1, x0, x1)

    def parent(self) -> Window:
        """Pixels of the next coarser level that lie above these."""
        # Rounded up: an odd level's last pixel has a parent as well.
        return Window(self.y0 // 2, (self.y1 + 1) // 2, self.x0 // 2, (self.x1 + 1) // 2)

    def child(self, shape: Shape) -> Window:
        """Pixels of the next finer level, of ``shape``, that lie below these."""
        return Window(2 * self.y0, min(2 * self.y1, shape[0]), 2 * self.x0, min(2 * self.x1, shape[1]))

    def inside(self, outer: Window) -> tuple[slice, slice]:
        """Index of this window in an array that shows ``outer``."""
        return (
            slice(self.y0 - outer.y0, self.y1 - outer.y0),
            slice(self.x0 - outer.x0, self.x1 - outer.x0),
        )


def _bounds(low: int, high: int, size: int) -> tuple[int, int]:
    first = max(0, min(low, size - 2)) // 2 * 2
    return first, min((max(high, first + 2) + 1) // 2 * 2, size)


def whole(shape: Shape) -> Window:
    """Window that covers an image of ``shape``."""
    return Window(0, shape[0], 0, shape[1])


def tiles(shape: Shape, side: int) -> list[Window]:
    """Square tiles in reading order, the last ones cut."""
    return [
        Window(y, min(y + side, shape[0]), x, min(x + side, shape[1]))
        for y in range(0, shape[0], side)
        for x in range(0, shape[1], side)
    ]


def thinned(marked: AnyArray, most: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns, in reading order, of ``most`` to twice as many of the pixels that are marked, if there are.

    By multiples of the golden ratio, which spread evenly: whether a pixel is taken hardly depends on the others.
    """
    places = np.flatnonzero(marked)
    step = 1 << max(0, int(np.log2(max(len(places) / most, 1.0))))
    key = places.astype(np.uint32) * np.uint32(2654435769)
    y, x = np.divmod(places[key < (1 << 32) // step], marked.shape[1])
    return y, x


Words = NDArray[np.uint64]

HIGH_PASS = (2, 1, 0, -1, -2)
BAND_PASS = (1, 0, -1, 0, 1, 0, -1)
WIDE_BAND_PASS = (2, 1, 0, -1, -2, -1, 0, 1, 2, 1, 0, -1, -2)
GAUSSIAN = ((0, 1, 2, 1, 0), (1, 3, 5, 3, 1), (2, 5, 8, 5, 2), (1, 3, 5, 3, 1), (0, 1, 2, 1, 0))
DEVIATION = 6
"""Number of the feature that is the local standard deviation."""


def planes(image: AnyArray) -> Iterator[Floats32]:
    """Eight features of Table 1 (row, col), grey levels, divided by its normalisation; 6 is the standard deviation.

    ``image`` (row, col): grey 0..255; completed by repeating its edge.
    """
    grey = np.asarray(image, np.float32)

    def convolved(kernel: AnyArray) -> Floats32:
        # Turned around, since OpenCV's are no convolutions; the signs of the derivatives hang on it.
        return np.asarray(cv2.filter2D(grey, cv2.CV_32F, kernel[::-1, ::-1], borderType=cv2.BORDER_REPLICATE))

    for line, norm in ((HIGH_PASS, 4), (BAND_PASS, 2), (WIDE_BAND_PASS, 8)):
        row = np.array([line]) / norm
        yield convolved(row)
        yield convolved(row.T)
    # The paper gives no window for the variance; 5 x 5 pixels are our choice.
    yield np.sqrt(_moments(grey, 5)[2])
    yield convolved(np.array(GAUSSIAN) / 56)


def _moments(image: AnyArray, side: int) -> tuple[Floats32, Floats32, Floats32]:
    """Grey values (row, col) less 128, and their means and variances over windows of ``side`` pixels.

    From the middle of the range: the difference of squares then loses fewer digits. The image's edge is repeated.
    """
    grey = np.asarray(image, np.float32) - np.float32(128)
    mean, square = (cv2.blur(a, (side, side), borderType=cv2.BORDER_REPLICATE) for a in (grey, grey * grey))
    # Rounding may leave the variance of a flat window below zero.
    return grey, mean, np.maximum(square - mean * mean, np.float32(0))


def pack(image: AnyArray, weights: tuple[float, ...]) -> tuple[Words, Floats32]:
    """Fast features of one image.

    Parameters
    ----------
    image : (row, col) grey 0..255.
    weights : eight weights of the signed square roots.

    Returns
    -------
    words : (row, col) uint64, byte l is feature l: 128 + round(2 w_l sign(f_l) sqrt|f_l|), clipped.
    deviation : (row, col) float32, local standard deviation, grey levels (feature 6).
    """
    words, deviation = np.zeros(image.shape, np.uint64), np.zeros(0, np.float32)
    for k, (plane, weight) in enumerate(zip(planes(image), weights, strict=True)):
        # 2.0: byte steps per weighted unit: with the default weights of 4 the strongest edges just fill a byte.
        _add_byte(plane, np.float32(2.0 * weight), k, words)
        deviation = plane if k == DEVIATION else deviation
    return words, deviation


@njit(cache=True, nogil=True)
def _add_byte(plane, scale, k, words):  # type: ignore[no-untyped-def]
    """Set byte ``k`` of the words (row, col) to the signed square roots of a feature, times ``scale``."""
    zero, top, shift = np.float32(0.0), np.float32(255.0), np.uint64(8 * k)
    for y in range(plane.shape[0]):
        for x in range(plane.shape[1]):
            root = np.sqrt(abs(plane[y, x])) * scale
            # 128 stands for zero, so that the sign fits into a byte; the half more makes truncation round.
            byte = np.float32(128.5) + (root if plane[y, x] > zero else -root)
            words[y, x] |= np.uint64(np.int32(min(max(byte, zero), top))) << shift


@njit(cache=True, nogil=True, inline="always")
def distance(a, b):  # type: ignore[no-untyped-def]
    """Sum of absolute differences of the eight bytes of two words (Eq. 1, absolute form), for numba kernels."""
    one, low, eight = np.uint64(0x0001000100010001), np.uint64(0x00FF00FF00FF00FF), np.uint64(8)
    # Four bytes at a time, each with sixteen bits of room: 256 + p - q, whose ninth bit says whether p >= q.
    even = ((a & low) | (one << eight)) - (b & low)
    odd = (((a >> eight) & low) | (one << eight)) - ((b >> eight) & low)
    even_less, odd_less = one - ((even >> eight) & one), one - ((odd >> eight) & one)
    # Where p < q the lower byte is 256 - |p - q|: its complement and one more.
    even = ((even & low) ^ ((even_less << eight) - even_less)) + even_less
    odd = ((odd & low) ^ ((odd_less << eight) - odd_less)) + odd_less
    return np.int64(((even + odd) * one) >> np.uint64(48))


NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Rows and columns to the neighbour of each byte, lowest byte first."""

COMPACT_STEPS = np.float32(8.0)
"""Byte steps per root of a grey level: the greatest step, 255, just fills a byte."""


def compact(image: AnyArray) -> Words:
    """Compact features of one image: grey steps from a pixel to its eight neighbours.

    The kernels of Table 1 reach six pixels and so carry a foreground's disparity beyond its edge. Where the choice
    among candidates has been narrowed down by them, steps that reach one pixel place the edge. They know nothing of the
    images' brightness.

    Parameters
    ----------
    image : (row, col) float32, grey 0..255; completed by repeating its edge.

    Returns
    -------
    (row, col) uint64, byte k is ``128 + round(8 sign(s) sqrt|s|)`` of the step s to neighbour k, clipped.
    """
    (rows, cols), words = image.shape, np.zeros(image.shape, np.uint64)
    framed = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    for k, (j, i) in enumerate(NEIGHBOURS):
        _add_byte(framed[1 + j : 1 + j + rows, 1 + i : 1 + i + cols] - image, COMPACT_STEPS, k, words)
    return words


Grey = tuple[AnyArray, AnyArray]
"""Grey values (row, col) float32, of masked pixels from the next valid level above, and mask uint8, 1 = usable."""


@dataclass(frozen=True)
class Layer:
    """A level of an image, or a window of it. ``read``: returns grey values of any window; ``shape``: of the level;
    ``blur``: standard deviation of the Gaussian that it was blurred by, pixels."""

    read: Callable[[Window], Grey]
    shape: Shape
    weights: Weights
    window: Window
    blur: float = 0.0

    @staticmethod
    def of(read: Callable[[Window], Grey], shape: Shape, weights: Weights) -> Layer:
        """The whole level."""
        return Layer(read, shape, weights, whole(shape))

    def cut(self, window: Window) -> Layer:
        """A window of the level."""
        return replace(self, window=window)

    def blurred(self, deviation: float) -> Layer:
        """The same blurred by a Gaussian of this ``deviation``, pixels; itself if it already is."""

        def read(window: Window) -> Grey:
            grey, mask = self.read(window)
            return np.asarray(cv2.GaussianBlur(grey, None, deviation)), mask

        return self if deviation == self.blur else replace(self, read=read, blur=deviation)

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
        return pack(self.grey, self.weights)

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
        return compact(self.grey)


@dataclass(frozen=True)
class Image:
    """An image. ``noise``: standard deviation that level 0 had before it was denoised, grey levels; 0 otherwise."""

    layers: tuple[Layer, ...]
    noise: float = 0.0

    @property
    def shapes(self) -> Sequence[Shape]:
        """Rows and columns of each level."""
        return [layer.shape for layer in self.layers]

    def cut(self, window: Window) -> Image:
        """A window of the finest level."""
        return Image((self.layers[0].cut(window),), self.noise)

    def changed(self, change: Callable[[Callable[[Window], Grey], int, Window], Grey], noise: float) -> Image:
        """The image with its windows read by ``change(reader, level, window)``."""
        layers = tuple(replace(layer, read=partial(change, layer.read, n)) for n, layer in enumerate(self.layers))
        return Image(layers, noise)


def _stored(images: Sequence[AnyArray], masks: Sequence[AnyArray], level: int, window: Window) -> Grey:
    """Grey values of a window of a pyramid's level; those of masked pixels from the next valid level above."""
    image, mask = (np.ascontiguousarray(a[level][window.slices]) for a in (images, masks))
    if mask.all():
        return image, mask
    if level + 1 == len(images):
        # The top has no level above: masked pixels take the mean of the usable ones.
        everything = whole(masks[level].shape).slices
        top, usable = images[level][everything], masks[level][everything] != 0
        return np.where(mask, image, top[usable].mean() if usable.any() else np.float32(0.0)), mask
    outer = window.parent()
    above, _ = _stored(images, masks, level + 1, outer)
    return pyramid.filled_from(above, image, mask != 0, window.y0 - 2 * outer.y0, window.x0 - 2 * outer.x0), mask


def as_given(given: Pyramid, weights: Weights) -> Image:
    """Image of a pyramid; its levels and masks are arrays, or rasters read by window."""
    read = partial(_stored, given.images, given.valid)
    return Image(tuple(Layer.of(partial(read, n), m.shape, weights) for n, m in enumerate(given.valid)))


def as_matched(given: Pyramid, params: HfvmParams) -> Image:
    """Image of a pyramid, denoised where it is noisy."""
    image = as_given(given, params.weights)
    # Every level: with a binomial kernel on the finest alone bad-2 of five noisy pairs was 2 % larger, the median 5 %.
    return image.changed(partial(_denoised, given.noise), given.noise) if given.noise >= params.denoise_from else image


def _denoised(noise: float, read: Callable[[Window], Grey], level: int, window: Window) -> Grey:
    grey, mask = read(window)
    return lee(grey, noise * 0.5**level), mask


def lee(image: AnyArray, noise: float) -> Floats32:
    """Denoised grey values (row, col): means where texture is hardly stronger than noise, unchanged elsewhere.

    With mean m and variance s^2 of the 3 x 3 pixels around it and noise of standard deviation n, a grey value a becomes

        m + max(0, 1 - 2.5 n^2 / s^2) (a - m)

    (J.-S. Lee (1980), Digital image enhancement and noise filtering by use of local statistics, IEEE Transactions on
    Pattern Analysis and Machine Intelligence 2, 165-168; there 2.5 is 1.)
    """
    grey, mean, variance = _moments(image, 3)
    # 1e-3: rounding error of the variance of a flat window, squared grey levels.
    variance = np.maximum(variance, np.float32(1e-3))
    # The variance of nine pixels of white noise reaches 2.5 times its expectation in one of two hundred places; all
    # others are averaged alike. A texture of random dots, which looks like noise, then still matches where it is
    # shifted by a fraction of a pixel: .87 and more of it, with 1 as little as .07. Bad-2 of noisy pairs is alike from
    # 1 to 2.5.
    gain = np.maximum(variance - np.float32(2.5 * noise * noise), np.float32(0)) / variance
    return np.asarray(mean + gain * (grey - mean) + np.float32(128))
