"""Running extrema over octagons, and medians: what of a window is order, not mean.

The window is a regular octagon rather than a square, since the highest minus the lowest height of a plane over a square
is larger by a factor of 1.41 on the diagonal; over the octagon it is by at most 1.10 (:func:`octagon`), nowhere smaller
than along an axis. An octagon is a square widened along both diagonals, so its running maximum is four running maxima
along lines, each by doubling (van Herk's result at about as many comparisons a cell, all of them of whole rows).

Everything here commutes with any rising function of the heights: where relief is made greater, every difference of two
of these results is (the argument is in :mod:`stages.hazards`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.extrema_lanes import (
    LANES,
    along_five,
    along_nine,
    along_seven,
    along_three,
    five,
    median_row,
    nine,
    raise4,
    seven,
    three,
)
from stages.line import copy_line

Floats32 = NDArray[np.float32]

BAND, STRIP = 32, 768
"""Rows and columns worked on at a time, at most: rows of a window stay in the innermost cache, a band in the next."""

SLACK = 8
"""Columns beside: windows along a diagonal are found for four rows at once, from the same columns of the first one, so
that up to three of the others are not; that happens twice along either diagonal."""


def octagon(reach: int) -> tuple[int, int]:
    """Half side of the square and steps along either diagonal that make an octagon of ``reach`` cells from its middle.

    It extends by exactly ``reach`` along the axes, and by one to 1.10 ``reach`` in every other direction: vertices
    lie at (reach, side).
    """
    diagonal = int(reach / (2.0 + np.sqrt(2.0)))
    return reach - 2 * diagonal, diagonal


def running_range(surface: Floats32, reach: int) -> tuple[Floats32, Floats32]:
    """Highest and lowest value (row, col) within the octagon; unknown (NaN) is left out, -inf and inf where all is."""
    high, low = (np.empty(surface.shape, dtype=np.float32) for _ in range(2))
    _running_max(surface, np.float32(1.0), *octagon(reach), high)
    _running_max(surface, np.float32(-1.0), *octagon(reach), low)
    return high, low


def running_max(surface: Floats32, reach: int) -> Floats32:
    """The highest value alone."""
    high = np.empty(surface.shape, dtype=np.float32)
    _running_max(surface, np.float32(1.0), *octagon(reach), high)
    return high


def relief(surface: Floats32, near: int, reach: int) -> tuple[Floats32, Floats32]:
    """Highest minus lowest value (row, col) within two octagons, ``near`` and ``reach`` >= near.

    It is 0 where all is unknown. The larger octagon is the smaller one widened once more, so it starts from that one's
    extrema.
    """
    side, diagonal = octagon(near)
    more, steps = (b - a for a, b in zip((side, diagonal), octagon(reach), strict=True))
    small, large = (np.empty(surface.shape, dtype=np.float32) for _ in range(2))
    if more < 0 or steps < 0:  # one octagon is not a widening of the other
        for out, of in ((small, near), (large, reach)):
            np.subtract(*running_range(surface, of), out=out)
            np.maximum(out, np.float32(0.0), out=out)
        return small, large
    _relief(surface, side, diagonal, more, steps, small, large)
    return small, large


@njit(cache=True, nogil=True)
def _running_max(z, f, side, diagonal, out):  # type: ignore[no-untyped-def]
    """``f`` times the maximum of ``f`` times z."""
    rows, cols = z.shape
    reach = side + 2 * diagonal
    width, wide, buffer = _room(cols, reach)
    passes = _passes(side, diagonal)
    for left in range(0, cols, width):
        for top in range(0, rows, BAND):
            n = min(BAND, rows - top)
            _fill(z, f, top - reach, n + 2 * reach, left - reach - SLACK, wide, buffer)
            _all_along(buffer, 0, n + 2 * reach, wide, 2 * side + 1)
            whole = n + 2 * reach
            for k in range(passes.shape[0]):
                whole = _pass(buffer, 0, whole, wide, passes[k])
            first = reach + SLACK - side
            for i in range(n):
                line = out[top + i, left : min(left + width, cols)]
                start = i * wide + first
                _times(buffer[start : start + line.shape[0]], f, line)


@njit(cache=True, nogil=True)
def _relief(z, side, diagonal, more, steps, small, large):  # type: ignore[no-untyped-def]
    cols = z.shape[1]
    width, wide, high = _room(cols, side + 2 * diagonal + more + 2 * steps)
    low = np.empty_like(high)
    for left in range(0, cols, width):
        _relief_strip(z, side, diagonal, more, steps, left, min(left + width, cols), wide, high, low, small, large)


@njit(cache=True, nogil=True)
def _relief_strip(z, side, diagonal, more, steps, left, right, wide, high, low, small, large):  # type: ignore[no-untyped-def]
    """The highest values are written first, and the lowest ones taken from them.

    Rows enter at the end of a band, and each pass goes on as far as it can: ``done`` rows of the band. What is whole
    leaves at the top, and the rest moves up, so that no row is worked on twice.
    """
    rows = z.shape[0]
    added = more + 2 * steps
    reach = side + 2 * diagonal + added
    inner, outer = _passes(side, diagonal), _passes(more, steps)
    k = inner.shape[0]
    done = np.zeros(k + outer.shape[0] + 1, dtype=np.int64)
    after, top = np.zeros_like(done), 0
    column, near = left - reach - SLACK, reach + SLACK - side
    while top < rows:
        after[0] = done[0] + min(BAND, rows + 2 * reach - top - done[0])
        for sign, buffer in ((1.0, high), (-1.0, low)):
            new = after[0] - done[0]
            _fill(z, np.float32(sign), top - reach + done[0], new, column, wide, buffer[done[0] * wide :])
            _all_along(buffer, done[0], after[0], wide, 2 * side + 1)
            _advance(buffer, wide, inner, done[: k + 1], after[: k + 1])
            first, end = max(done[k], added - top), min(after[k], rows + added - top)
            if end > first:
                start = top - added + first
                _emit(buffer[first * wide + near :], wide, end - first, sign > 0, small, start, left, right)
            _all_along(buffer, done[k], after[k], wide, 2 * more + 1)
            _advance(buffer, wide, outer, done[k:], after[k:])
            _emit(buffer[near - more :], wide, after[-1], sign > 0, large, top, left, right)
            _move_up(buffer, after[-1] * wide, (after[0] - after[-1]) * wide)
        top += after[-1]
        done[:] = after - after[-1]


@njit(cache=True, nogil=True)
def _room(cols, reach):  # type: ignore[no-untyped-def]
    """Columns of a strip, all of them about as wide; those of a band, with room beside for the window, and a band."""
    width = -(-cols // -(-cols // STRIP))
    wide = -(-(width + 2 * (reach + SLACK)) // LANES) * LANES
    # a line more, since vectors that begin in the last one end there
    return width, wide, np.empty((BAND + 2 * reach + 1) * wide, dtype=np.float32)


@njit(cache=True, nogil=True)
def _fill(z, f, first, n, left, wide, buffer):  # type: ignore[no-untyped-def]
    """``f`` times ``n`` rows of z from row ``first`` and column ``left`` on, -inf around."""
    rows, cols = z.shape
    begin, end = max(left, 0), min(left + wide, cols)
    for i in range(n):
        line = buffer[i * wide : i * wide + wide]
        inside = 0 <= first + i < rows
        line[: begin - left if inside else wide] = -np.inf
        if inside:
            _load(z[first + i, begin:end], f, line[begin - left : end - left])
            line[end - left :] = -np.inf


@njit(cache=True, nogil=True)
def _load(source, f, out):  # type: ignore[no-untyped-def]
    """``f`` times the source, -inf where unknown."""
    for c in range(source.shape[0]):
        v = f * source[c]
        out[c] = v if v > -np.inf else np.float32(-np.inf)  # NaN compares false


@njit(cache=True, nogil=True)
def _times(source, f, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = f * source[c]


@njit(cache=True, nogil=True)
def _emit(buffer, wide, n, highest, out, first, left, right):  # type: ignore[no-untyped-def]
    """``n`` rows of the buffer become those of the result from row ``first`` on, in columns ``left`` to ``right``."""
    for i in range(n):
        target, line = out[first + i, left:right], buffer[i * wide : i * wide + right - left]
        if highest:
            copy_line(line, target)
        else:
            for c in range(target.shape[0]):
                d = target[c] + line[c]
                target[c] = d if d > np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True)
def _move_up(buffer, by, n):  # type: ignore[no-untyped-def]
    """To the start what comes ``by`` cells later."""
    for c in range(0, n if by else 0, max(by, 1)):
        size = min(by, n - c)
        copy_line(buffer[c + by : c + by + size], buffer[c : c + size])


@njit(cache=True, nogil=True)
def _passes(side, diagonal):  # type: ignore[no-untyped-def]
    """Down the rows of a square, and along both diagonals: rows of the window; rows of those that it is made of;
    columns to the right a row.

    Windows of w rows make one of up to 4 w rows in one pass: each pass goes through the slower cache. Windows of up to
    nine rows, which are odd, take one, marked by w = 0.
    """
    out, m = np.empty((99, 3), dtype=np.int64), 0
    for n, slant in ((2 * side + 1, 0), (2 * diagonal + 1, 1), (2 * diagonal + 1, -1)):
        w = 1
        while w < n:
            fours = n <= 9
            out[m, 0], out[m, 1], out[m, 2] = n, 0 if fours else w, slant
            m += 1
            w = n if fours else w + min(3 * w, n - w)
    return out[:m]


@njit(cache=True, nogil=True)
def _advance(buffer, wide, passes, done, after):  # type: ignore[no-untyped-def]
    """Each pass over the rows that the one before has done and it has not."""
    for k in range(passes.shape[0]):
        after[k + 1] = _pass(buffer, done[k + 1], after[k], wide, passes[k])


@njit(cache=True, nogil=True)
def _all_along(buffer, first, last, wide, n):  # type: ignore[no-untyped-def]
    """Maximum of c .. c + n - 1 of some rows, in place; at the ends of rows something else."""
    if n > 9:
        _far_along(buffer, first, last, wide, n)
        return
    for i in range(first, last):
        if n == 9:
            along_nine(buffer, i * wide, wide // LANES)
        elif n == 7:
            along_seven(buffer, i * wide, wide // LANES)
        elif n == 5:
            along_five(buffer, i * wide, wide // LANES)
        elif n == 3:
            along_three(buffer, i * wide, wide // LANES)


@njit(cache=True, nogil=True)
def _far_along(buffer, first, last, wide, n):  # type: ignore[no-untyped-def]
    """The same for any window: those of w make one of up to 4 w at once."""
    w = 1
    while w < n:
        s1, s2, s3 = min(w, n - w), min(2 * w, n - w), min(3 * w, n - w)
        for at in range(first * wide, last * wide, LANES):
            raise4(buffer, at, s1, s2, s3)
        w += s3


@njit(cache=True, nogil=True)
def _pass(buffer, first, last, wide, kind):  # type: ignore[no-untyped-def]
    """One of :func:`_passes` from row ``first`` to ``last``, in place; returns where what is whole ends.

    Results move up by half of the window.
    """
    n, w, slant = kind
    if w == 0:
        return _by_fours(buffer, first, last, wide, n, wide + slant)
    s1, s2, s3 = min(w, n - w), min(2 * w, n - w), min(3 * w, n - w)
    step = wide + slant
    end = max(last - s3, first)
    for at in range(first * wide, end * wide, LANES):
        raise4(buffer, at, s1 * step, s2 * step, s3 * step)
    return end


@njit(cache=True, nogil=True)
def _by_fours(buffer, first, last, wide, n, step):  # type: ignore[no-untyped-def]
    """The same for an odd window of 3 to 9 rows: four windows below each other share all but three of them."""
    i = first
    while i + n + 3 <= last:
        for at in range(i * wide, i * wide + wide, LANES):
            if n == 9:
                nine(buffer, at, step)
            elif n == 7:
                seven(buffer, at, step)
            elif n == 5:
                five(buffer, at, step)
            else:
                three(buffer, at, step)
        i += 4
    while i + n <= last:
        for at in range(i * wide, i * wide + wide, LANES):
            for k in range(1, n):
                raise4(buffer, at, k * step, k * step, k * step)
        i += 1
    return i


def median3(surface: Floats32) -> Floats32:
    """Median (row, col) of the known cells in 3 x 3; unknown stays unknown.

    Of an even number the upper one: the mean of two heights would not be one of the heights.
    """
    out = np.empty(surface.shape, dtype=np.float32)
    _median3(np.ascontiguousarray(surface), out)
    return out


@njit(cache=True, nogil=True)
def _median3(z, out):  # type: ignore[no-untyped-def]
    """Whole vectors from the second column on, the last one from behind; what they cannot tell goes one by one."""
    rows, cols = z.shape
    flat, found = z.reshape(-1), out.reshape(-1)
    vectors = (cols - 2) // LANES
    patchy = np.ones((cols + 2 * LANES + 7) // 8 * 8, dtype=np.uint8)
    eight = patchy.view(np.uint64)
    for r in range(rows):
        here, line = z[r], out[r]
        patchy[:] = 1
        if 0 < r < rows - 1 and vectors:
            last = cols - 1 - LANES
            median_row(flat, r * cols + 1, cols, vectors, found, r * cols + 1, patchy[1:])
            median_row(flat, r * cols + last, cols, 1, found, r * cols + last, patchy[last:])
        for k in range(eight.shape[0]):
            if eight[k]:
                for c in range(8 * k, min(8 * k + 8, cols)):
                    if patchy[c]:
                        line[c] = np.nan if np.isnan(here[c]) else _median_known(z, r, c)


@njit(cache=True, nogil=True)
def _median_known(z, r, c):  # type: ignore[no-untyped-def]
    v = np.empty(9, dtype=np.float32)
    m = 0
    for i in range(max(r - 1, 0), min(r + 2, z.shape[0])):
        for j in range(max(c - 1, 0), min(c + 2, z.shape[1])):
            value = z[i, j]
            if np.isnan(value):
                continue
            k = m
            while k > 0 and v[k - 1] > value:
                v[k] = v[k - 1]
                k -= 1
            v[k] = value
            m += 1
    return v[m // 2]
