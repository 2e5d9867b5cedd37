"""Masks of one bit a cell, 64 cells in a word: what is near a mask is found by shifting whole words.

A canvas has the mask's rows and columns with a border around; all of the border is set, or none of it. Bit k of word w
is column 64 w + k.
"""

from __future__ import annotations

import sys
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

    def add(self, other: Canvas, dr: int, dc: int) -> None:
        """Set what lies (row, col) from a set cell of a canvas with the same border; nothing comes from beyond it."""
        _shift(other.words, self.words, dr, dc)


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
