"""Running extrema over octagons, and medians: what of a window is order, not mean.

The window is a regular octagon rather than a square, since the highest minus the lowest height of a plane over a square
is larger by a factor of 1.41 on the diagonal; over the octagon it is by at most 1.10 (:func:`octagon`), nowhere smaller
than along an axis. An octagon is a square widened along both diagonals, so its running maximum is four running maxima
along lines, each by tripling or more (van Herk's result at about as many comparisons a cell, all of whole rows).

Everything here commutes with any rising function of the heights: where relief is made greater, every difference of two
of these results is (the argument is in :mod:`stages.hazards`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]

BAND, STRIP = 128, 512
"""Rows and columns worked on at a time: with what a window looks at they stay in a cache of 0.5 MB, and as many lines
as make one in a pass in a cache of 32 kB."""


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
    width = _strip(cols)
    buffer, spare = _room(width, reach)
    for start in range(0, rows, BAND):
        stop = min(start + BAND, rows)
        for k in range(-(-cols // width)):
            left = min(k * width, cols - width)
            n = _fill(z, f, start - reach, stop + reach, left - reach, buffer)
            _widen(buffer, n, spare, side, diagonal, 0, 0)
            for i in range(stop - start):
                target, line = out[start + i, left : left + width], buffer[i, reach - side : reach - side + width]
                for c in range(width):
                    target[c] = f * line[c]


@njit(cache=True, nogil=True)
def _relief(z, side, diagonal, more, steps, small, large):  # type: ignore[no-untyped-def]
    """Of a strip the highest values are written first, and the lowest ones taken from them."""
    rows, cols = z.shape
    near, added = side + 2 * diagonal, more + 2 * steps
    reach = near + added
    width = _strip(cols)
    buffer, spare = _room(width, reach)
    for start in range(0, rows, BAND):
        stop = min(start + BAND, rows)
        for k in range(-(-cols // width)):
            left = min(k * width, cols - width)
            for sign in (1.0, -1.0):
                n = _fill(z, np.float32(sign), start - reach, stop + reach, left - reach, buffer)
                n = _widen(buffer, n, spare, side, diagonal, 0, 0)
                _emit(buffer[added:], reach - side, sign > 0, small[start:stop], left, width)
                _widen(buffer, n, spare, more, steps, side, diagonal)
                _emit(buffer, reach - side - more, sign > 0, large[start:stop], left, width)


@njit(cache=True, nogil=True)
def _emit(buffer, first, highest, out, left, width):  # type: ignore[no-untyped-def]
    for i in range(out.shape[0]):
        target, line = out[i, left : left + width], buffer[i, first : first + width]
        if highest:
            for c in range(width):
                target[c] = line[c]
        else:
            for c in range(width):
                d = target[c] + line[c]
                target[c] = d if d > np.float32(0.0) else np.float32(0.0)


@njit(cache=True, nogil=True)
def _strip(cols):  # type: ignore[no-untyped-def]
    """Width of strips of equal width; the last one may overlap the one before, and writes the same there."""
    return -(-cols // -(-cols // STRIP))


@njit(cache=True, nogil=True)
def _room(width, reach):  # type: ignore[no-untyped-def]
    """A band with all that its cells look at, and a line."""
    wide = width + 2 * reach
    return np.empty((BAND + 2 * reach, wide), dtype=np.float32), np.empty(wide, dtype=np.float32)


@njit(cache=True, nogil=True)
def _fill(z, f, first, last, left, buffer):  # type: ignore[no-untyped-def]
    """``f`` times rows ``first`` to ``last`` of z from column ``left`` on, -inf beyond its border; how many rows."""
    rows, cols = z.shape
    wide = buffer.shape[1]
    begin, end = max(-left, 0), min(cols - left, wide)
    for i in range(last - first):
        line = buffer[i]
        inside = 0 <= first + i < rows
        for c in range(begin if inside else wide):
            line[c] = -np.inf
        if inside:
            _load(z[first + i, left + begin : left + end], f, line[begin:end])
            for c in range(end, wide):
                line[c] = -np.inf
    return last - first


@njit(cache=True, nogil=True)
def _widen(buffer, n, spare, side, diagonal, had, slant):  # type: ignore[no-untyped-def]
    """Maximum over the square and both diagonals, of ``n`` rows; returns how many are whole.

    Results move up by ``side + 2 diagonal`` rows and to the left by ``side`` columns. What is there already are maxima
    over an octagon of ``had`` and ``slant``: no line across it is shorter than its sides, so its copies may lie as far
    apart as these are long.
    """
    straight, oblique = 2 * had + 1, 2 * slant + 1
    for i in range(n):
        _along(buffer[i], spare, straight, straight + 2 * side)
    n = _down(buffer, n, straight, straight + 2 * side, 0)
    n = _down(buffer, n, oblique, oblique + 2 * diagonal, 1)
    return _down(buffer, n, oblique, oblique + 2 * diagonal, -1)


@njit(cache=True, nogil=True)
def _load(source, f, out):  # type: ignore[no-untyped-def]
    """``f`` times the source, -inf where unknown."""
    for c in range(source.shape[0]):
        v = f * source[c]
        out[c] = v if v > -np.inf else np.float32(-np.inf)  # NaN compares false


@njit(cache=True, nogil=True)
def _parts(n, w):  # type: ignore[no-untyped-def]
    """Of how many windows of w the next wider one is made, on the way to one of n: each pass goes over all lines."""
    more = -(-n // w)
    return 2 if more == 2 else 3 if more == 3 or 5 < more <= 9 else 5


@njit(cache=True, nogil=True)
def _along(line, spare, w, n):  # type: ignore[no-untyped-def]
    """Maxima of windows of w made such of windows of n, in place; the last n - w values are of what is left."""
    cols = line.shape[0]
    source, target = line, spare
    passes = 0
    while w < n:
        parts, rest = _parts(n, w), n - w
        far = min((parts - 1) * w, rest)
        p, q, s = min(w, rest), min(2 * w, far), min(3 * w, far)
        m = cols - far
        a, b, d, e = source[p : p + m], source[q : q + m], source[s : s + m], source[far:]
        if parts < 5:
            _highest3(source[:m], a, b, target[:m])
        else:
            _highest5(source[:m], a, b, d, e, target[:m])
        for c in range(m, cols):
            target[c] = source[c]
        source, target = target, source
        w += far
        passes += 1
    if passes % 2:
        for c in range(cols):
            line[c] = spare[c]


@njit(cache=True, nogil=True)
def _down(buffer, rows, w, n, slant):  # type: ignore[no-untyped-def]
    """The same down the rows, ``slant`` columns to the right a row; returns how many rows are whole."""
    cols = buffer.shape[1]
    while w < n:
        parts, rest = _parts(n, w), n - w
        far = min((parts - 1) * w, rest)
        p, q, s = min(w, rest), min(2 * w, far), min(3 * w, far)
        first, last = max(0, -far * slant), min(cols, cols - far * slant)
        for i in range(rows - far):
            line = buffer[i, first:last]
            a = buffer[i + p, first + p * slant : last + p * slant]
            b = buffer[i + q, first + q * slant : last + q * slant]
            if parts < 5:
                _raise3(line, a, b)
                continue
            d = buffer[i + s, first + s * slant : last + s * slant]
            _raise5(line, a, b, d, buffer[i + far, first + far * slant : last + far * slant])
        rows -= far
        w += far
    return rows


@njit(cache=True, nogil=True)
def _highest3(p, q, s, out):  # type: ignore[no-untyped-def]
    """The greatest of three lines, cell by cell."""
    for c in range(out.shape[0]):
        a, b, d = p[c], q[c], s[c]
        a = a if a > b else b
        out[c] = a if a > d else d


@njit(cache=True, nogil=True)
def _highest5(p, q, s, t, u, out):  # type: ignore[no-untyped-def]
    """The greatest of five lines."""
    for c in range(out.shape[0]):
        a, b, d, e, f = p[c], q[c], s[c], t[c], u[c]
        a = a if a > b else b
        d = d if d > e else e
        a = a if a > f else f
        out[c] = a if a > d else d


@njit(cache=True, nogil=True)
def _raise3(line, p, q):  # type: ignore[no-untyped-def]
    """The greatest of three lines in place of the first; they must not overlap, or wait for each other."""
    for c in range(line.shape[0]):
        a, b, d = line[c], p[c], q[c]
        a = a if a > b else b
        line[c] = a if a > d else d


@njit(cache=True, nogil=True)
def _raise5(line, p, q, s, t):  # type: ignore[no-untyped-def]
    """The greatest of five lines in place of the first."""
    for c in range(line.shape[0]):
        a, b, d, e, f = line[c], p[c], q[c], s[c], t[c]
        a = a if a > b else b
        d = d if d > e else e
        a = a if a > f else f
        line[c] = a if a > d else d


def median3(surface: Floats32) -> Floats32:
    """Median (row, col) of the known cells in 3 x 3; unknown stays unknown.

    Of an even number the upper one: the mean of two heights would not be one of the heights.
    """
    out = np.empty(surface.shape, dtype=np.float32)
    _median3(surface, out)
    return out


@njit(cache=True, nogil=True)
def _median3(z, out):  # type: ignore[no-untyped-def]
    rows, cols = z.shape
    low, middle = np.empty(cols, dtype=np.float32), np.empty(cols, dtype=np.float32)
    high, total = np.empty(cols, dtype=np.float32), np.empty(cols, dtype=np.float32)
    patchy = np.ones(8 * -(-cols // 8), dtype=np.uint8)
    eight = patchy.view(np.uint64)
    for r in range(rows):
        here, line = z[r], out[r]
        if 0 < r < rows - 1:
            _sort_columns(z[r - 1], here, z[r + 1], low, middle, high, total)
            _median_row(here, low, middle, high, total, line, patchy)
        else:
            patchy[:] = 1
        for k in range(eight.shape[0]):
            if eight[k]:
                for c in range(8 * k, min(8 * k + 8, cols)):
                    if patchy[c]:
                        line[c] = np.nan if np.isnan(here[c]) else _median_known(z, r, c)


@njit(cache=True, nogil=True)
def _sort_columns(up, here, down, low, middle, high, total):  # type: ignore[no-untyped-def]
    """Three heights of each column in order, and their sum, which is not known where one is not."""
    for c in range(here.shape[0]):
        a, b, d = up[c], here[c], down[c]
        lo, hi = min(a, b), max(a, b)
        low[c], high[c] = min(lo, d), max(hi, d)
        middle[c] = max(min(hi, d), lo)
    for c in range(here.shape[0]):
        total[c] = up[c] + here[c] + down[c]


@njit(cache=True, nogil=True)
def _median_row(here, low, middle, high, total, out, patchy):  # type: ignore[no-untyped-def]
    """Median of nine from sorted columns (Paeth, Graphics Gems, 1990), NaN where the cell is unknown; where another of
    the nine is, or does not exist, ``patchy`` is set."""
    n = here.shape[0] - 2
    for c in range(1, n + 1):
        x = max(max(low[c - 1], low[c]), low[c + 1])
        y = min(min(high[c - 1], high[c]), high[c + 1])
        a, b = middle[c - 1], middle[c]
        lo, hi = min(a, b), max(a, b)
        m = max(min(hi, middle[c + 1]), lo)
        lo, hi = min(x, m), max(x, m)
        median = max(min(hi, y), lo)
        out[c] = median if here[c] == here[c] else np.float32(np.nan)
    for c in range(1, n + 1):
        known = total[c - 1] + total[c] + total[c + 1]
        patchy[c] = (known != known) & (here[c] == here[c])
    patchy[0] = patchy[n + 1] = 1


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
