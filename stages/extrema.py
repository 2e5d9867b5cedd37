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

Floats32 = NDArray[np.float32]

BAND = 128
"""Rows worked on at a time: with the window's own they stay in a cache of 1 MB up to widths of 1500 cells."""


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
    buffer, spare = _room(cols, reach)
    for start in range(0, rows, BAND):
        stop = min(start + BAND, rows)
        n = _fill(z, f, start - reach, stop + reach, 2 * reach, buffer)
        _widen(buffer, n, spare, side, diagonal)
        first = 2 * reach - side
        for i in range(stop - start):
            target, line = out[start + i], buffer[i, first:]
            for c in range(cols):
                target[c] = f * line[c]


@njit(cache=True, nogil=True)
def _relief(z, side, diagonal, more, steps, small, large):  # type: ignore[no-untyped-def]
    """Of a band the highest values are written first, and the lowest ones taken from them."""
    rows, cols = z.shape
    near, added = side + 2 * diagonal, more + 2 * steps
    reach = near + added
    buffer, spare = _room(cols, reach)
    for start in range(0, rows, BAND):
        stop = min(start + BAND, rows)
        for sign in (1.0, -1.0):
            n = _fill(z, np.float32(sign), start - reach, stop + reach, 2 * reach, buffer)
            n = _widen(buffer, n, spare, side, diagonal)
            _emit(buffer[added:], 2 * reach - side, sign > 0, small[start:stop])
            _widen(buffer, n, spare, more, steps)
            _emit(buffer, 2 * reach - side - more, sign > 0, large[start:stop])


@njit(cache=True, nogil=True)
def _emit(buffer, first, highest, out):  # type: ignore[no-untyped-def]
    rows, cols = out.shape
    for i in range(rows):
        target, line = out[i], buffer[i, first : first + cols]
        if highest:
            for c in range(cols):
                target[c] = line[c]
        else:
            for c in range(cols):
                d = target[c] + line[c]
                target[c] = d if d > np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True)
def _room(cols, reach):  # type: ignore[no-untyped-def]
    """A band with room beside for all that moves along diagonals, and a line."""
    wide = cols + 4 * reach
    return np.empty((BAND + 2 * reach, wide), dtype=np.float32), np.empty(wide, dtype=np.float32)


@njit(cache=True, nogil=True)
def _fill(z, f, first, last, left, buffer):  # type: ignore[no-untyped-def]
    """``f`` times rows ``first`` to ``last`` of z, ``left`` columns to the right, -inf around; how many rows."""
    rows, cols = z.shape
    for i in range(last - first):
        line = buffer[i]
        for c in range(line.shape[0]):
            line[c] = -np.inf
        if 0 <= first + i < rows:
            _load(z[first + i], f, line[left : left + cols])
    return last - first


@njit(cache=True, nogil=True)
def _widen(buffer, n, spare, side, diagonal):  # type: ignore[no-untyped-def]
    """Maximum over the square and both diagonals, of ``n`` rows; returns how many are whole.

    Results move up by ``side + 2 diagonal`` rows and to the left by ``side`` columns.
    """
    for i in range(n):
        _double(buffer[i], spare, 2 * side + 1)
    n = _down(buffer, n, 2 * side + 1, 0)
    n = _down(buffer, n, 2 * diagonal + 1, 1)
    return _down(buffer, n, 2 * diagonal + 1, -1)


@njit(cache=True, nogil=True)
def _load(source, f, out):  # type: ignore[no-untyped-def]
    """``f`` times the source, -inf where unknown."""
    for c in range(source.shape[0]):
        v = f * source[c]
        out[c] = v if v > -np.inf else np.float32(-np.inf)  # NaN compares false


@njit(cache=True, nogil=True)
def _raise(line, other):  # type: ignore[no-untyped-def]
    """The greater of two lines, cell by cell, in place of the first; they must not overlap, or wait for each other."""
    for c in range(line.shape[0]):
        a, b = line[c], other[c]
        line[c] = a if a > b else b


@njit(cache=True, nogil=True)
def _raise4(line, p, q, s):  # type: ignore[no-untyped-def]
    """The greatest of four lines in place of the first."""
    for c in range(line.shape[0]):
        a, b, d, e = line[c], p[c], q[c], s[c]
        a = a if a > b else b
        d = d if d > e else e
        line[c] = a if a > d else d


@njit(cache=True, nogil=True)
def _double(line, spare, n):  # type: ignore[no-untyped-def]
    """Maximum of c .. c + n - 1 in place; the last n - 1 values are of what is left."""
    m = line.shape[0]
    w = 1
    while w < n:
        step = min(w, n - w)
        for c in range(m):
            spare[c] = line[c]
        _raise(line[: m - step], spare[step:])
        w += step


@njit(cache=True, nogil=True)
def _down(buffer, rows, n, slant):  # type: ignore[no-untyped-def]
    """The same down the rows, ``slant`` columns to the right a row; returns how many rows are whole.

    Windows of w rows make one of up to 4 w rows in one pass: each pass goes through the slower cache.
    """
    cols = buffer.shape[1]
    w = 1
    while w < n:
        s1 = min(w, n - w)
        s2 = min(2 * w, n - w)
        s3 = min(3 * w, n - w)
        far = s3 * slant
        first, last = max(0, -far), min(cols, cols - far)
        for i in range(rows - s3):
            line = buffer[i, first:last]
            a = buffer[i + s1, first + s1 * slant : last + s1 * slant]
            if s3 == s1:
                _raise(line, a)
                continue
            b = buffer[i + s2, first + s2 * slant : last + s2 * slant]
            _raise4(line, a, b, buffer[i + s3, first + far : last + far])
        rows -= s3
        w += s3
    return rows


@njit(cache=True, nogil=True)
def median3(z):  # type: ignore[no-untyped-def]
    """Median (row, col) of the known cells in 3 x 3; unknown stays unknown.

    Of an even number the upper one: the mean of two heights would not be one of the heights.
    """
    rows, cols = z.shape
    out = np.empty((rows, cols), dtype=np.float32)
    for r in range(rows):
        out[r, 0] = out[r, cols - 1] = np.nan
        if 0 < r < rows - 1:
            _median_row(z[r - 1], z[r], z[r + 1], out[r])
        else:
            out[r, :] = np.nan
        for c in range(cols):
            if np.isnan(out[r, c]) and not np.isnan(z[r, c]):
                out[r, c] = _median_known(z, r, c)
    return out


@njit(cache=True, nogil=True, inline="always")
def _order(a, b):  # type: ignore[no-untyped-def]
    return (a, b) if a < b else (b, a)


@njit(cache=True, nogil=True)
def _median_row(up, here, down, out):  # type: ignore[no-untyped-def]
    """Median of nine by the least exchanges (Paeth, Graphics Gems, 1990); NaN where one of the nine is."""
    for c in range(1, here.shape[0] - 1):
        a, b, d = up[c - 1], up[c], up[c + 1]
        e, f, g = here[c - 1], here[c], here[c + 1]
        h, i, j = down[c - 1], down[c], down[c + 1]
        total = a + b + d + e + f + g + h + i + j
        lo1, hi1 = min(a, b), max(a, b)
        low_a = min(lo1, d)
        high_a = max(hi1, d)
        mid_a = max(min(hi1, d), lo1)
        lo2, hi2 = min(e, f), max(e, f)
        low_b = min(lo2, g)
        high_b = max(hi2, g)
        mid_b = max(min(hi2, g), lo2)
        lo3, hi3 = min(h, i), max(h, i)
        low_c = min(lo3, j)
        high_c = max(hi3, j)
        mid_c = max(min(hi3, j), lo3)
        x = max(max(low_a, low_b), low_c)
        y = min(min(high_a, high_b), high_c)
        lo4, hi4 = min(mid_a, mid_b), max(mid_a, mid_b)
        m = max(min(hi4, mid_c), lo4)
        lo5, hi5 = min(x, m), max(x, m)
        median = max(min(hi5, y), lo5)
        out[c] = median if total == total else np.float32(np.nan)


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
