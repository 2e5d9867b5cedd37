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

from stages.line import copy_line

Floats32 = NDArray[np.float32]

BAND = 64
"""Rows worked on at a time: with the window's own, both extremes stay in a cache of 1.25 MB to widths of 1500 cells."""


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
    """The highest values are written first, and the lowest ones taken from them.

    Rows enter at the end of a band, and each pass goes on as far as it can: ``done`` rows of the band. What is whole
    leaves at the top, and the rest moves up, so that no row is worked on twice.
    """
    rows, cols = z.shape
    added = more + 2 * steps
    reach = side + 2 * diagonal + added
    high, spare = _room(cols, reach)
    low = np.empty_like(high)
    inner, outer = _passes(side, diagonal), _passes(more, steps)
    k = inner.shape[0]
    done = np.zeros(k + outer.shape[0] + 1, dtype=np.int64)
    after, top = np.zeros_like(done), 0
    while top < rows:
        after[0] = done[0] + min(BAND, rows + 2 * reach - top - done[0])
        for sign, buffer in ((1.0, high), (-1.0, low)):
            first = top - reach
            _fill(z, np.float32(sign), first + done[0], first + after[0], 2 * reach, buffer[done[0] :])
            _all_along(buffer[done[0] : after[0]], spare, 2 * side + 1)
            _advance(buffer, spare, inner, done[: k + 1], after[: k + 1])
            low_row, end = max(done[k], added - top), min(after[k], rows + added - top)
            at = top - added
            if end > low_row:
                _emit(buffer[low_row:], 2 * reach - side, sign > 0, small[at + low_row : at + end])
            _all_along(buffer[done[k] : after[k]], spare, 2 * more + 1)
            _advance(buffer, spare, outer, done[k:], after[k:])
            _emit(buffer, 2 * reach - side - more, sign > 0, large[top : top + after[-1]])
            for i in range(after[-1], after[0]):
                copy_line(buffer[i], buffer[i - after[-1]])
        top += after[-1]
        done[:] = after - after[-1]


@njit(cache=True, nogil=True)
def _all_along(buffer, spare, n):  # type: ignore[no-untyped-def]
    for i in range(buffer.shape[0]):
        _along(buffer[i], spare, n)


@njit(cache=True, nogil=True)
def _advance(buffer, spare, passes, done, after):  # type: ignore[no-untyped-def]
    """Each pass over the rows that the one before has done and it has not."""
    for k in range(passes.shape[0]):
        n, w, slant = passes[k]
        after[k + 1] = done[k + 1] + _pass(buffer[done[k + 1] :], after[k] - done[k + 1], spare, n, w, slant)


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
        inside = 0 <= first + i < rows
        line[: left if inside else line.shape[0]] = -np.inf
        if inside:
            _load(z[first + i], f, line[left : left + cols])
            line[left + cols :] = -np.inf
    return last - first


@njit(cache=True, nogil=True)
def _widen(buffer, n, spare, side, diagonal):  # type: ignore[no-untyped-def]
    """Maximum over the square and both diagonals, of ``n`` rows; returns how many are whole.

    Results move up by ``side + 2 diagonal`` rows and to the left by ``side`` columns.
    """
    _all_along(buffer[:n], spare, 2 * side + 1)
    for k, w, slant in _passes(side, diagonal):
        n = _pass(buffer, n, spare, k, w, slant)
    return n


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
            twos = n <= 9
            out[m, 0], out[m, 1], out[m, 2] = n, 0 if twos else w, slant
            m += 1
            w = n if twos else w + min(3 * w, n - w)
    return out[:m]


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
def _along(line, spare, n):  # type: ignore[no-untyped-def]
    """Maximum of c .. c + n - 1 in place; the last n - 1 values are of what is left. Windows of w make one of up to 4 w
    at once."""
    w, swaps = 1, 0
    a, b = line, spare
    while w < n:
        s1, s2, s3 = min(w, n - w), min(2 * w, n - w), min(3 * w, n - w)
        _most4(a, a[s1:], a[s2:], a[s3:], b)
        for c in range(line.shape[0] - s3, line.shape[0]):
            b[c] = a[c]
        a, b = b, a
        w, swaps = w + s3, swaps + 1
    if swaps % 2 == 1:
        copy_line(spare, line)


@njit(cache=True, nogil=True)
def _most4(p, q, s, t, out):  # type: ignore[no-untyped-def]
    """The greatest of four lines, as far as the last one goes."""
    for c in range(t.shape[0]):
        a, b, d, e = p[c], q[c], s[c], t[c]
        a = a if a > b else b
        d = d if d > e else e
        out[c] = a if a > d else d


@njit(cache=True, nogil=True)
def _most6(o, p, q, s, t, u, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        a, b, d, e, f, g = o[c], p[c], q[c], s[c], t[c], u[c]
        a = a if a > b else b
        d = d if d > e else e
        f = f if f > g else g
        a = a if a > d else d
        out[c] = a if a > f else f


@njit(cache=True, nogil=True)
def _most2(p, q, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = p[c] if p[c] > q[c] else q[c]


@njit(cache=True, nogil=True)
def _pass(buffer, rows, spare, n, w, slant):  # type: ignore[no-untyped-def]
    """One of :func:`_passes` over ``rows`` rows, in place; returns how many rows are whole."""
    if w == 0:
        return _down_by_twos(buffer, rows, spare, n, slant)
    cols = buffer.shape[1]
    s1, s2, s3 = min(w, n - w), min(2 * w, n - w), min(3 * w, n - w)
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
    return max(rows - s3, 0)


@njit(cache=True, nogil=True)
def _down_by_twos(buffer, rows, spare, n, slant):  # type: ignore[no-untyped-def]
    """The same for an odd window of 3 to 9: of rows i and i + 1 it shares rows i + 1 .. i + n - 1."""
    cols = buffer.shape[1]
    far = n * slant
    first, last = max(0, -far), min(cols, cols - far)
    shared = spare[: last - first]
    for i in range(0, rows - n + 1, 2):
        _share(buffer[i : i + n], n, first, last, slant, shared)
        _raise(buffer[i, first:last], shared)
        if i + n < rows:
            _most2(shared, buffer[i + n, first + far : last + far], buffer[i + 1, first + slant : last + slant])
    return max(rows - n + 1, 0)


@njit(cache=True, nogil=True)
def _share(buffer, n, first, last, slant, out):  # type: ignore[no-untyped-def]
    """The greatest of rows 1 .. n - 1, ``slant`` columns to the right a row."""
    p, q = _slanted(buffer, 1, first, last, slant), _slanted(buffer, 2, first, last, slant)
    if n == 3:
        _most2(p, q, out)
        return
    s, t = _slanted(buffer, 3, first, last, slant), _slanted(buffer, 4, first, last, slant)
    if n == 5:
        _most4(p, q, s, t, out)
        return
    u, v = _slanted(buffer, 5, first, last, slant), _slanted(buffer, 6, first, last, slant)
    _most6(p, q, s, t, u, v, out)
    if n == 9:
        _raise3(out, _slanted(buffer, 7, first, last, slant), _slanted(buffer, 8, first, last, slant))


@njit(cache=True, nogil=True, inline="always")
def _slanted(buffer, k, first, last, slant):  # type: ignore[no-untyped-def]
    return buffer[k, first + k * slant : last + k * slant]


@njit(cache=True, nogil=True)
def _raise3(line, p, q):  # type: ignore[no-untyped-def]
    """The greatest of three lines in place of the first."""
    for c in range(line.shape[0]):
        a, b, d = line[c], p[c], q[c]
        a = a if a > b else b
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
