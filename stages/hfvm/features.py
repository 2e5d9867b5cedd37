"""Feature vectors of the matcher (paper, 4.3.1, Table 1).

Eight features a pixel: high-pass and band-pass convolutions in both directions, local variance, and a Gaussian.
``planes`` is the table to the letter, in floating point. ``pack`` is the fast form: the signed square root of each
feature (it tames strong edges, measured worth .01 of bad pixels), weighted and rounded to one byte, eight bytes to one
64-bit word, so that a sum of absolute differences (the paper's cheaper form of Eq. 1) is a single instruction.
The variance enters as its square root, in grey levels like the other seven.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray

Words = NDArray[np.uint64]
Planes = NDArray[np.float32]

HIGH_PASS = (2, 1, 0, -1, -2)
BAND_PASS = (1, 0, -1, 0, 1, 0, -1)
WIDE_BAND_PASS = (2, 1, 0, -1, -2, -1, 0, 1, 2, 1, 0, -1, -2)
GAUSSIAN = ((0, 1, 2, 1, 0), (1, 3, 5, 3, 1), (2, 5, 8, 5, 2), (1, 3, 5, 3, 1), (0, 1, 2, 1, 0))
PAPER_WEIGHTS = (2.0, 2.0, 3.0, 3.0, 3.0, 3.0, 10.0, 4.0)
"""Weights w of Table 1."""

KERNELS = tuple(
    # Turned around, since the table's are convolutions; the signs of the derivatives hang on it.
    np.ascontiguousarray(np.array(kernel, np.float32)[::-1, ::-1] / np.float32(norm))
    for kernel, norm in (
        ((HIGH_PASS,), 4),
        (np.transpose((HIGH_PASS,)), 4),
        ((BAND_PASS,), 2),
        (np.transpose((BAND_PASS,)), 2),
        ((WIDE_BAND_PASS,), 8),
        (np.transpose((WIDE_BAND_PASS,)), 8),
        (GAUSSIAN, 56),
    )
)
"""Kernels of Table 1 over their divisors n: features 0 to 5, and 7. Feature 6 is the local variance."""

DEVIATION = 6
"""Number of the feature that is the local standard deviation."""

VARIANCE_SIDE_PX = 5
"""Pixels; the paper gives no window for the variance, 5 x 5 is our choice."""

STEPS_PER_UNIT = 2.0
"""Byte steps per weighted unit: with the default weights of 4 the strongest edges just fill a byte."""


def planes(image: AnyArray) -> Planes:
    """Features of Table 1, each divided by its normalisation.

    Parameters
    ----------
    image : (row, col) grey 0..255; completed by repeating its edge.

    Returns
    -------
    (8, row, col) float32, grey levels; plane 6 is the standard deviation.
    """
    a, edge = np.ascontiguousarray(image, np.float32), cv2.BORDER_REPLICATE
    out = np.empty((8, *a.shape), np.float32)
    for kernel, k in zip(KERNELS, (0, 1, 2, 3, 4, 5, 7), strict=True):
        cv2.filter2D(a, -1, kernel, dst=out[k], borderType=edge)
    # From the middle of the range: the difference of squares then loses fewer digits.
    centred, side = a - np.float32(128.0), 2 * (VARIANCE_SIDE_PX,)
    mean, square = (cv2.boxFilter(part, -1, side, borderType=edge) for part in (centred, centred * centred))
    # Rounding may leave the variance of a flat window below zero.
    np.sqrt(np.maximum(square - mean * mean, 0), out=out[DEVIATION])
    return out


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
    table, words = planes(image), np.zeros(image.shape, np.uint64)
    _add_bytes(table, np.asarray(weights, np.float32) * np.float32(STEPS_PER_UNIT), words)
    return words, table[DEVIATION].copy()


@njit(cache=True, nogil=True)
def _add_bytes(table, scale, words):  # type: ignore[no-untyped-def]
    """Write each plane's signed square roots, times its scale, to a byte of the words, which are zero."""
    for y in range(words.shape[0]):
        line = words[y]
        for k in range(len(table)):
            plane, factor, shift = table[k, y], scale[k], np.uint64(8 * k)
            for x in range(line.size):
                line[x] |= _byte(plane[x], factor) << shift


@njit(cache=True, nogil=True, inline="always")
def _byte(value, scale):  # type: ignore[no-untyped-def]
    root = np.sqrt(abs(value)) * scale
    # 128 stands for zero, so that the sign fits into a byte; the half more makes truncation round.
    byte = np.float32(128.5) + (root if value > np.float32(0.0) else -root)
    return np.uint64(np.int32(min(max(byte, np.float32(0.0)), np.float32(255.0))))


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
    for y in range(words.shape[0]):
        for x in range(words.shape[1]):
            word = np.uint64(0)
            for k in range(len(NEIGHBOURS)):
                step = framed[y + 1 + NEIGHBOURS[k][0], x + 1 + NEIGHBOURS[k][1]] - framed[y + 1, x + 1]
                word |= _byte(step, COMPACT_STEPS) << np.uint64(8 * k)
            words[y, x] = word
