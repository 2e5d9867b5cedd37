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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import inlined, kernel
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
Planes = NDArray[np.float32]

HIGH_PASS = (2, 1, 0, -1, -2)
BAND_PASS = (1, 0, -1, 0, 1, 0, -1)
WIDE_BAND_PASS = (2, 1, 0, -1, -2, -1, 0, 1, 2, 1, 0, -1, -2)
GAUSSIAN = ((0, 1, 2, 1, 0), (1, 3, 5, 3, 1), (2, 5, 8, 5, 2), (1, 3, 5, 3, 1), (0, 1, 2, 1, 0))
RADIUS_PX = 6
"""Pixels: reach of the widest kernel; images are completed by repeating their edge."""


def _taps(kernel: Sequence[Sequence[int]], feature: int, norm: int) -> list[tuple[int, int, int, float]]:
    """Number of the feature, rows and columns into the frame, and factor, of the pixels that a kernel adds up."""
    rows, cols = (RADIUS_PX + len(side) // 2 for side in (kernel, kernel[0]))
    # Turned around, since the table's are convolutions; the signs of the derivatives hang on it.
    return [
        (feature, rows - j, cols - i, factor / norm)
        for j, line in enumerate(kernel)
        for i, factor in enumerate(line)
        if factor
    ]


TAPS = np.array(
    [
        tap
        for k, (kernel, norm) in enumerate(((HIGH_PASS, 4), (BAND_PASS, 2), (WIDE_BAND_PASS, 8)))
        for tap in (*_taps([kernel], 2 * k, norm), *_taps([[factor] for factor in kernel], 2 * k + 1, norm))
    ]
    + _taps(GAUSSIAN, 7, 56)
)
"""Table 1, over its divisors n: features 0 to 5, and 7. Feature 6 is the local variance, whose mean needs none."""

DEVIATION = 6
"""Number of the feature that is the local standard deviation."""


def planes(image: AnyArray) -> Planes:
    """Features of Table 1, each divided by its normalisation.

    Parameters
    ----------
    image : (row, col) grey 0..255; completed by repeating its edge.

    Returns
    -------
    (8, row, col) float32, grey levels; plane 6 is the standard deviation.
    """
    framed, out = _framed(image, RADIUS_PX), np.empty((8, *image.shape), np.float32)
    for y in range(len(image)):
        row_of_features(framed[y : y + 2 * RADIUS_PX + 1], TAPS, out[:, y])
    return out


def _framed(image: AnyArray, wide: int) -> AnyArray:
    """The image as float32 in a frame that repeats its edge."""
    a = np.asarray(image, np.float32)
    return np.asarray(cv2.copyMakeBorder(a, wide, wide, wide, wide, cv2.BORDER_REPLICATE))


@kernel
def row_of_features(rows, taps, out):  # type: ignore[no-untyped-def]
    """Features (8, col) of a row, from the 13 ``rows`` around it, whose frame they include."""
    cols, middle = out.shape[1], np.float32(128.0)
    out[:] = np.float32(0.0)
    for t in range(len(taps)):
        target, factor = out[np.int64(taps[t, 0])], np.float32(taps[t, 3])
        source = rows[np.int64(taps[t, 1])][np.int64(taps[t, 2]) :]
        for x in range(cols):
            target[x] += factor * source[x]
    # The paper gives no window for the variance; 5 x 5 pixels are our choice.
    width, size = 5, np.float32(25.0)
    first = RADIUS_PX - width // 2
    sums, squares = np.zeros(cols + width - 1, np.float32), np.zeros(cols + width - 1, np.float32)
    for k in range(first, first + width):
        source = rows[k][first:]
        for x in range(sums.size):
            # From the middle of the range: the difference of squares below then loses fewer digits.
            grey = source[x] - middle
            sums[x] += grey
            squares[x] += grey * grey
    for x in range(cols):
        total, square = np.float32(0.0), np.float32(0.0)
        for k in range(width):
            total += sums[x + k]
            square += squares[x + k]
        # Rounding may leave the variance of a flat window below zero.
        out[DEVIATION, x] = np.sqrt(max(square / size - (total / size) * (total / size), np.float32(0.0)))


def pack(image: AnyArray, weights: tuple[float, ...]) -> tuple[Words, AnyArray]:
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
    words, deviation = np.zeros(image.shape, np.uint64), np.empty(image.shape, np.float32)
    # 2.0: byte steps per weighted unit: with the default weights of 4 the strongest edges just fill a byte.
    scale = np.asarray(weights, np.float32) * np.float32(2.0)
    _pack(_framed(image, RADIUS_PX), TAPS, scale, words, deviation)
    return words, deviation


@kernel
def _pack(framed, taps, scale, words, deviation):  # type: ignore[no-untyped-def]
    features = np.empty((8, words.shape[1]), np.float32)
    for y in range(len(words)):
        row_of_features(framed[y : y + 2 * RADIUS_PX + 1], taps, features)
        line = words[y]
        for k in range(8):
            plane, factor, shift = features[k], scale[k], np.uint64(8 * k)
            for x in range(line.size):
                line[x] |= _byte(plane[x], factor) << shift
        for x in range(line.size):
            deviation[y, x] = features[DEVIATION, x]


@inlined
def _byte(value, scale):  # type: ignore[no-untyped-def]
    root = np.sqrt(abs(value)) * scale
    # 128 stands for zero, so that the sign fits into a byte; the half more makes truncation round.
    byte = np.float32(128.5) + (root if value > np.float32(0.0) else -root)
    return np.uint64(np.int32(min(max(byte, np.float32(0.0)), np.float32(255.0))))


@inlined
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
    words = np.empty(image.shape, np.uint64)
    _compact(_framed(image, 1), words)
    return words


@kernel
def _compact(framed, words):  # type: ignore[no-untyped-def]
    """Words of an image that has a frame of one pixel."""
    for y in range(words.shape[0]):
        for x in range(words.shape[1]):
            word = np.uint64(0)
            for k in range(len(NEIGHBOURS)):
                step = framed[y + 1 + NEIGHBOURS[k][0], x + 1 + NEIGHBOURS[k][1]] - framed[y + 1, x + 1]
                word |= _byte(step, COMPACT_STEPS) << np.uint64(8 * k)
            words[y, x] = word


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
        """A window of the level; this one, with what is computed of it, if it is the same."""
        return self if window == self.window else replace(self, window=window)

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
    out = np.empty(image.shape, np.float32)
    # The variance of nine pixels of white noise reaches 2.5 times its expectation in one of two hundred places; all
    # others are averaged alike. A texture of random dots, which looks like noise, then still matches where it is
    # shifted by a fraction of a pixel: .87 and more of it, with 1 as little as .07. Bad-2 of noisy pairs is alike from
    # 1 to 2.5.
    _lee(np.pad(image, 1, mode="edge"), np.float32(2.5 * noise * noise), out)
    return out


@kernel
def _lee(image, excess, denoised):  # type: ignore[no-untyped-def]
    middle, ninth, nil = np.float32(128.0), np.float32(1.0 / 9.0), np.float32(0.0)
    # Rounding error of the variance of a flat window, squared grey levels.
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
