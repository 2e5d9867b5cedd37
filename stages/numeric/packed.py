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

from rille.stages.core.arrays import Bools, Bytes
from rille.stages.numeric.line import copy_line

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
    def of(mask: Bools, border: int, outside: bool = False) -> Canvas:
        """A mask (row, col) on a canvas."""
        return Canvas._around(np.packbits(mask, axis=1, bitorder="little"), mask.shape, border, outside)

    @staticmethod
    def outside(shape: tuple[int, ...], border: int) -> Canvas:
        """A canvas of (row, col) cells of which none is set, in a border that is."""
        return Canvas._around(np.zeros((shape[0], -(-shape[1] // 8)), dtype=np.uint8), shape, border, True)

    @staticmethod
    def _around(bits: Bytes, shape: tuple[int, ...], border: int, outside: bool) -> Canvas:
        rows, cols = shape
        margin = -(-border // WORD)
        n = 2 * margin - (-cols // WORD)
        room = np.full((rows + 2 * border, 8 * n), 255 if outside else 0, dtype=np.uint8)
        if outside and cols % 8:
            bits[:, -1] |= np.uint8(255 << cols % 8 & 255)
        room[border : border + rows, 8 * margin : 8 * margin + bits.shape[1]] = bits
        words = room.view(np.uint64)
        return Canvas(words if LITTLE else words.byteswap(), border, rows, cols)

    def mask(self) -> Bools:
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
        """Set what lies up to ``n`` steps of (row, col) before or behind a set cell.

        All that is spread on one canvas together may be no more than its border.
        """
        if n > 0:
            words = self.words.reshape(-1)
            _spread(words, np.empty_like(words), n, self._offset(dr, dc))

    def join(self, other: Canvas) -> None:
        """Set what is set on a canvas with the same border."""
        np.bitwise_or(self.words, other.words, out=self.words)

    def add(self, other: Canvas, dr: int, dc: int) -> None:
        """Set what lies (row, col), at most the border, from a set cell of another canvas with the same border."""
        _add(other.words.reshape(-1), self.words.reshape(-1), self._offset(dr, dc))

    def clear_border(self) -> None:
        """Nothing is set outside any more."""
        self.words[: self.border] = 0
        self.words[self.border + self.rows :] = 0
        first = -(-self.border // WORD)
        last = first + self.cols // WORD
        self.words[:, :first] = 0
        self.words[:, last] &= np.uint64((1 << self.cols % WORD) - 1)
        self.words[:, last + 1 :] = 0

    def _offset(self, dr: int, dc: int) -> int:
        """Bits from a cell to the one (row, col) from it, where rows follow each other."""
        return dr * int(self.words.shape[1]) * WORD + dc


def codes(canvases: Sequence[Canvas], bits: Sequence[int]) -> Bytes:
    """Sum (row, col) of the bits of those of four canvases with the same border whose cell is not set."""
    one = canvases[0]
    out = np.empty((one.rows, one.cols), dtype=np.uint8)
    first = -(-one.border // WORD)
    _codes(tuple(canvas.words for canvas in canvases), np.array(bits, dtype=np.uint8), one.border, first, out)
    return out


@njit(cache=True, nogil=True)
def _codes(words, bits, border, first, out):  # type: ignore[no-untyped-def]
    p, q, s, t = words
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


# Rows follow each other, so that a canvas is moved as one line: what leaves a row arrives in the border of the next
# one, and from there nothing gets inside.


@njit(cache=True, nogil=True)
def _spread(words, spare, n, offset):  # type: ignore[no-untyped-def]
    """Ahead by 0 .. n offsets, by doubling; then behind, from what is n behind."""
    a, b = words, spare
    reach, swaps = 0, 0
    while reach < n:
        k = min(reach + 1, n - reach)
        copy_line(a, b)
        _add(a, b, k * offset)
        a, b = b, a
        reach, swaps = reach + k, swaps + 1
    copy_line(a, b)
    _add(a, b, -n * offset)
    if swaps % 2 == 1:
        return
    copy_line(b, a)


@njit(cache=True, nogil=True)
def _add(source, out, offset):  # type: ignore[no-untyped-def]
    """``out |= source`` moved by ``offset`` bits; two arrays."""
    n = source.shape[0]
    whole, bits = offset // WORD, np.uint64(offset % WORD)
    first, last = max(whole, 0), min(n + whole, n)
    if last <= first:
        return
    target, high = out[first:last], source[first - whole : last - whole]
    if not bits:
        for i in range(target.shape[0]):
            target[i] |= high[i]
        return
    rest = np.uint64(WORD) - bits
    target[0] |= high[0] << bits
    if first - whole > 0:
        target[0] |= source[first - whole - 1] >> rest
    below = high[: high.shape[0] - 1]
    target, high = target[1:], high[1:]
    for i in range(target.shape[0]):
        target[i] |= high[i] << bits | below[i] >> rest
    if last < n:
        out[last] |= source[n - 1] >> rest
