"""Masks of one bit a cell, 64 cells in a word: what is near a mask is found by shifting whole words.

A canvas has the mask's rows and columns with a border around; all of the border is set, or none of it. Bit k of word w
is column 64 w + k.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Words = NDArray[np.uint64]

WORD = 64
LITTLE = sys.byteorder == "little"


@dataclass(frozen=True)
class Canvas:
    """``words`` (row, word) with ``border`` rows above and below, and as many columns or a few more on either side."""

    words: Words
    border: int
    rows: int
    cols: int

    @staticmethod
    def of(mask: Mask, border: int, outside: bool = False) -> Canvas:
        """A mask (row, col) on a canvas."""
        rows, cols = mask.shape
        margin = -(-border // WORD)
        n = 2 * margin - (-cols // WORD)
        room = np.full((rows + 2 * border, 8 * n), 255 if outside else 0, dtype=np.uint8)
        bits = np.packbits(mask, axis=1, bitorder="little")
        if outside and cols % 8:
            bits[:, -1] |= np.uint8(255 << cols % 8 & 255)
        room[border : border + rows, 8 * margin : 8 * margin + bits.shape[1]] = bits
        words = room.view(np.uint64)
        return Canvas(words if LITTLE else words.byteswap(), border, rows, cols)

    def mask(self) -> Mask:
        """The mask (row, col) inside the border."""
        inside = self.words[self.border : self.border + self.rows]
        octets = (inside if LITTLE else inside.byteswap()).view(np.uint8)
        first = 8 * -(-self.border // WORD)
        bits = np.unpackbits(octets[:, first:], axis=1, bitorder="little", count=self.cols)
        return bits.view(np.bool_)

    def copy(self) -> Canvas:
        """The same in memory of its own."""
        return Canvas(self.words.copy(), self.border, self.rows, self.cols)

    def spread(self, n: int, dr: int, dc: int) -> None:
        """Set what lies up to ``n`` steps of (row, col) before or behind a set cell."""
        for sign in (1, -1):
            left, w = n, 1  # what is set within w - 1 steps has been
            while left > 0:
                k = min(w, left)
                _shift(self.words, self.words, sign * k * dr, sign * k * dc)
                left, w = left - k, w + k

    def join(self, other: Canvas) -> None:
        """Set what is set on a canvas with the same border."""
        np.bitwise_or(self.words, other.words, out=self.words)

    def add(self, other: Canvas, dr: int, dc: int) -> None:
        """Set what lies (row, col) from a set cell of a canvas with the same border; nothing comes from beyond it."""
        _shift(other.words, self.words, dr, dc)


def codes(canvases: Sequence[Canvas], bits: Sequence[int]) -> NDArray[np.uint8]:
    """Sum (row, col) of the bits of those of four canvases with the same border whose cell is not set."""
    one = canvases[0]
    out = np.empty((one.rows, one.cols), dtype=np.uint8)
    first = -(-one.border // WORD)
    _codes(*(canvas.words for canvas in canvases), np.array(bits, dtype=np.uint8), one.border, first, out)
    return out


@njit(cache=True, nogil=True)
def _codes(p, q, s, t, bits, border, first, out):  # type: ignore[no-untyped-def]
    rows, cols = out.shape
    one, none, most = np.uint64(1), np.uint64(0), np.uint8(bits.sum())
    for r in range(rows):
        for w in range(-(-cols // WORD)):
            a, b = ~p[r + border, first + w], ~q[r + border, first + w]
            d, e = ~s[r + border, first + w], ~t[r + border, first + w]
            line = out[r, w * WORD : min(w * WORD + WORD, cols)]
            if a & b & d & e == ~none or a | b | d | e == none:
                line[:] = most if a else np.uint8(0)
                continue
            for k in range(line.shape[0]):
                n = np.uint64(k)
                x = np.uint8(a >> n & one) * bits[0] | np.uint8(b >> n & one) * bits[1]
                y = np.uint8(d >> n & one) * bits[2] | np.uint8(e >> n & one) * bits[3]
                line[k] = np.uint8(x | y)


@njit(cache=True, nogil=True)
def _shift(source, out, dr, dc):  # type: ignore[no-untyped-def]
    """``out |= source`` moved by (dr, dc); they may be one: rows are taken in an order that reads each before it
    changes."""
    rows, n = source.shape
    line = np.empty(n, dtype=np.uint64)
    for i in range(rows):
        r = rows - 1 - i if dr > 0 else i
        if not 0 <= r - dr < rows:
            continue
        for c in range(n):
            line[c] = source[r - dr, c]
        _shift_line(line, out[r], dc)


@njit(cache=True, nogil=True)
def _shift_line(line, out, dc):  # type: ignore[no-untyped-def]
    n = line.shape[0]
    whole, bits = abs(dc) // WORD, np.uint64(abs(dc) % WORD)
    rest = np.uint64(WORD) - bits
    m = n - whole
    if m <= 0:
        return
    if dc >= 0:
        target, source = out[whole:], line[:m]
        for c in range(m):
            target[c] |= source[c] << bits
        for c in range(1, m if bits else 0):
            target[c] |= source[c - 1] >> rest
    else:
        target, source = out[:m], line[whole:]
        for c in range(m):
            target[c] |= source[c] >> bits
        for c in range(m - 1 if bits else 0):
            target[c] |= source[c + 1] << rest
