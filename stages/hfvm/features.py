"""Feature vectors of the matcher (paper, 4.3.1, Table 1).

Eight features a pixel: high-pass and band-pass convolutions in both directions, local variance, and a Gaussian.
``planes`` is the table to the letter, in floating point. ``pack`` is the fast form: the signed square root of each
feature (it tames strong edges, measured worth .01 of bad pixels), weighted and rounded to one byte, eight bytes to one
64-bit word, so that a sum of absolute differences (the paper's cheaper form of Eq. 1) is a single instruction.
The variance enters as its square root, in grey levels like the other seven.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.numeric.line import copy_line

Words = NDArray[np.uint64]
Planes = NDArray[np.float32]

HIGH_PASS = (2, 1, 0, -1, -2)
BAND_PASS = (1, 0, -1, 0, 1, 0, -1)
WIDE_BAND_PASS = (2, 1, 0, -1, -2, -1, 0, 1, 2, 1, 0, -1, -2)
GAUSSIAN = ((0, 1, 2, 1, 0), (1, 3, 5, 3, 1), (2, 5, 8, 5, 2), (1, 3, 5, 3, 1), (0, 1, 2, 1, 0))
NORMALISATIONS = (4.0, 4.0, 2.0, 2.0, 8.0, 8.0, 1.0, 56.0)
"""Divisors n of Table 1, features 0 to 7 (the variance is a mean already)."""

PAPER_WEIGHTS = (2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 10.0, 4.0)
"""Weights w of Table 1."""

RADIUS_PX = 6
"""Pixels: reach of the widest kernel; images are completed by repeating their edge."""

VARIANCE_RADIUS_PX = 2
"""Pixels; the paper gives no window for the variance, 5 x 5 is our choice."""

STEPS_PER_UNIT = 2.0
"""Byte steps per weighted unit: with the default weights of 4 the strongest edges just fill a byte."""


def planes(image: ArrayLike) -> Planes:
    """Features of Table 1, each divided by its normalisation.

    Parameters
    ----------
    image : (..., row, col) grey 0..255; leading dimensions are a batch.

    Returns
    -------
    (8, ..., row, col) float32, grey levels; plane 6 is the standard deviation.
    """
    a = np.asarray(image, dtype=np.float32)
    n = NORMALISATIONS
    rows = [_convolve(a, k, -1) for k in (HIGH_PASS, BAND_PASS, WIDE_BAND_PASS)]
    cols = [_convolve(a, k, -2) for k in (HIGH_PASS, BAND_PASS, WIDE_BAND_PASS)]
    # From the middle of the range: the difference of squares below then loses fewer digits.
    centred = a - np.float32(128.0)
    box = (1,) * (2 * VARIANCE_RADIUS_PX + 1)
    mean = _convolve(_convolve(centred, box, -1), box, -2) / np.float32(len(box) ** 2)
    square = _convolve(_convolve(centred * centred, box, -1), box, -2) / np.float32(len(box) ** 2)
    # Rounding may leave the variance of a flat window below zero.
    deviation = np.sqrt(np.maximum(square - mean * mean, 0))
    smooth = _shift_sum(a, GAUSSIAN)
    responses = [rows[0], cols[0], rows[1], cols[1], rows[2], cols[2], deviation, smooth]
    return np.stack([f / np.float32(d) for f, d in zip(responses, n, strict=True)]).astype(np.float32)


def _convolve(a: AnyArray, kernel: tuple[int, ...], axis: int) -> AnyArray:
    grid = np.array(kernel)[None, :] if axis == -1 else np.array(kernel)[:, None]
    return _shift_sum(a, grid)


def _shift_sum(a: AnyArray, kernel: Any) -> AnyArray:
    # Turned around, since the table's are convolutions; the signs of the derivatives hang on it.
    k = np.asarray(kernel, dtype=np.float32)[::-1, ::-1]
    ry, rx = k.shape[0] // 2, k.shape[1] // 2
    padded = np.pad(a, [(0, 0)] * (a.ndim - 2) + [(ry, ry), (rx, rx)], mode="edge")
    total = np.zeros_like(a)
    for y, x in zip(*np.nonzero(k), strict=True):
        total += k[y, x] * padded[..., y : y + a.shape[-2], x : x + a.shape[-1]]
    return total


def pack(image: AnyArray, weights: tuple[float, ...]) -> tuple[Words, Planes]:
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
    image = np.ascontiguousarray(image, dtype=np.float32)
    words, deviation = np.empty(image.shape, np.uint64), np.empty(image.shape, np.float32)
    _pack_all(image, np.asarray(weights, np.float32) * np.float32(STEPS_PER_UNIT), words, deviation)
    return words, deviation


BAND_ROWS = 64
"""Rows that are completed at their edges together."""


@njit(cache=True, nogil=True)
def _pack_all(image, scale, words, deviation):  # type: ignore[no-untyped-def]
    """Features of a whole image, completed by repeating its edge."""
    rows, cols = image.shape
    room = np.empty((BAND_ROWS + 2 * RADIUS_PX, cols + 2 * RADIUS_PX), np.float32)
    for start in range(0, rows, BAND_ROWS):
        size = min(BAND_ROWS, rows - start) + 2 * RADIUS_PX
        for j in range(size):
            row, out = image[min(max(start + j - RADIUS_PX, 0), rows - 1)], room[j]
            out[:RADIUS_PX], out[RADIUS_PX + cols :] = row[0], row[cols - 1]
            copy_line(row, out[RADIUS_PX:])
        pack_rows(room[:size], start, scale, words, deviation)


@njit(cache=True, nogil=True)
def _byte(value, scale):  # type: ignore[no-untyped-def]
    root = np.sqrt(abs(value)) * scale
    if value < 0:
        root = -root
    # 128 stands for zero, so that the sign fits into a byte; the half more makes truncation round.
    return np.uint64(min(max(root + np.float32(128.5), np.float32(0.0)), np.float32(255.0)))


@njit(cache=True, nogil=True)
def pack_rows(a, start, scale, words, deviation):  # type: ignore[no-untyped-def]
    """Table 1 by sums of fixed order, for rows from ``start`` on, RADIUS_PX more of which ``a`` holds on every side.

    No fast maths: bytes must not depend on the CPU.
    """
    rows, cols = a.shape[0] - 2 * RADIUS_PX, words.shape[1]
    width = cols + 2 * RADIUS_PX
    sums = np.empty(width, np.float32)
    squares = np.empty(width, np.float32)
    two, three, five, eight = np.float32(2.0), np.float32(3.0), np.float32(5.0), np.float32(8.0)
    for y in range(rows):
        r = a[y : y + 2 * RADIUS_PX + 1]
        row_words, sigma = words[start + y], deviation[start + y]
        for x in range(width):
            s = np.float32(0.0)
            q = np.float32(0.0)
            for k in range(RADIUS_PX - VARIANCE_RADIUS_PX, RADIUS_PX + VARIANCE_RADIUS_PX + 1):
                # From the middle of the range: ``f6`` subtracts two squares that would otherwise agree in most digits.
                c = r[k, x] - np.float32(128.0)
                s += c
                q += c * c
            sums[x] = s
            squares[x] = q
        for x in range(cols):
            m = x + RADIUS_PX
            f0 = (two * (r[6, m + 2] - r[6, m - 2]) + (r[6, m + 1] - r[6, m - 1])) * np.float32(0.25)
            f1 = (two * (r[8, m] - r[4, m]) + (r[7, m] - r[5, m])) * np.float32(0.25)
            f2 = ((r[6, m + 3] - r[6, m - 3]) - (r[6, m + 1] - r[6, m - 1])) * np.float32(0.5)
            f3 = ((r[9, m] - r[3, m]) - (r[7, m] - r[5, m])) * np.float32(0.5)
            f4 = (
                two * (r[6, m + 6] - r[6, m - 6])
                + (r[6, m + 5] - r[6, m - 5])
                - (r[6, m + 3] - r[6, m - 3])
                - two * (r[6, m + 2] - r[6, m - 2])
                - (r[6, m + 1] - r[6, m - 1])
            ) * np.float32(0.125)
            f5 = (
                two * (r[12, m] - r[0, m])
                + (r[11, m] - r[1, m])
                - (r[9, m] - r[3, m])
                - two * (r[8, m] - r[4, m])
                - (r[7, m] - r[5, m])
            ) * np.float32(0.125)
            s = sums[m - 2] + sums[m - 1] + sums[m] + sums[m + 1] + sums[m + 2]
            q = squares[m - 2] + squares[m - 1] + squares[m] + squares[m + 1] + squares[m + 2]
            s *= np.float32(0.04)
            # Rounding may leave the variance of a flat window below zero.
            f6 = np.sqrt(max(q * np.float32(0.04) - s * s, np.float32(0.0)))
            f7 = (
                eight * r[6, m]
                + five * (r[6, m - 1] + r[6, m + 1] + r[5, m] + r[7, m])
                + three * (r[5, m - 1] + r[5, m + 1] + r[7, m - 1] + r[7, m + 1])
                + two * (r[6, m - 2] + r[6, m + 2] + r[4, m] + r[8, m])
                + (r[4, m - 1] + r[4, m + 1] + r[8, m - 1] + r[8, m + 1])
                + (r[5, m - 2] + r[5, m + 2] + r[7, m - 2] + r[7, m + 2])
            ) / np.float32(56.0)
            sigma[x] = f6
            row_words[x] = (
                _byte(f0, scale[0])
                | (_byte(f1, scale[1]) << np.uint64(8))
                | (_byte(f2, scale[2]) << np.uint64(16))
                | (_byte(f3, scale[3]) << np.uint64(24))
                | (_byte(f4, scale[4]) << np.uint64(32))
                | (_byte(f5, scale[5]) << np.uint64(40))
                | (_byte(f6, scale[6]) << np.uint64(48))
                | (_byte(f7, scale[7]) << np.uint64(56))
            )


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
    words = np.empty(image.shape, np.uint64)
    _compact(cv2.copyMakeBorder(np.asarray(image, np.float32), 1, 1, 1, 1, cv2.BORDER_REPLICATE), words)
    return words


@njit(cache=True, nogil=True)
def _compact(framed, words):  # type: ignore[no-untyped-def]
    """Words of an image that has a frame of one pixel."""
    # 128 stands for no step, so that the sign fits into a byte; the half more makes truncation round.
    middle, top = np.float32(128.5), np.float32(255.0)
    for y in range(words.shape[0]):
        for x in range(words.shape[1]):
            word = np.uint64(0)
            for k in range(len(NEIGHBOURS)):
                step = framed[y + 1 + NEIGHBOURS[k][0], x + 1 + NEIGHBOURS[k][1]] - framed[y + 1, x + 1]
                root = COMPACT_STEPS * np.sqrt(abs(step))
                byte = min(max(middle + (root if step > 0 else -root), np.float32(0.0)), top)
                word |= np.uint64(byte) << np.uint64(8 * k)
            words[y, x] = word
