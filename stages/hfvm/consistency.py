"""Median, back-matching, isolated patches, interpolation of undefined disparities (paper, 4.3.3 and 4.3.4)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.declare import AnyArray
from stages.windows import window_sum

Map = NDArray[np.float32]

FAILED = np.float32(1e9)
"""Back-matching error where there is nothing to match back from."""

CHANCE = 16
"""Times the size of an isolated patch: none of chance is as large (measured on blurred noise: up to 8 times)."""


CROWD = 9
"""Pixels: side of the neighbourhood in which matches support each other, about that of the features."""


def median(u: AnyArray, size: int) -> AnyArray:
    """Plain median of ``size`` x ``size`` pixels (3 or 5; 1 = none) of an int16 map, its edge repeated."""
    if size == 1:
        return u
    return np.asarray(cv2.medianBlur(u, size))


@njit(cache=True, nogil=True)
def integer_error(au, av, bu, bv, b_valid, error, ox=0, oy=0):  # type: ignore[no-untyped-def]
    """As :func:`backmatch`, of integer maps; only pixels that land in the window of ``b`` are written.

    ``ox, oy``: where the first pixel of ``a`` lies in the window of ``b``.
    """
    rows, cols = au.shape
    brows, bcols = bu.shape
    for y in range(rows):
        for x in range(cols):
            i, j = x + ox + np.int64(au[y, x]), y + oy + np.int64(av[y, x])
            if i >= 0 and i < bcols and j >= 0 and j < brows and b_valid[j, i]:
                du, dv = np.int64(au[y, x]) + bu[j, i], np.int64(av[y, x]) + bv[j, i]
                error[y, x] = np.sqrt(np.float32(du * du + dv * dv))


@njit(cache=True, nogil=True)
def backmatch(lu, lv, ru, rv, right_valid, error, x0, y0, rx0, ry0, rrows, rcols):  # type: ignore[no-untyped-def]
    """Distance |l - l'| of each left pixel after matching to the right and back (4.3.3), pixels; FAILED outside
    the right image and on its masked pixels.

    The right map is read bilinearly where its four pixels agree within a pixel, else at the nearest one. ``x0, y0`` and
    ``rx0, ry0``: first column and row of the left and the right window; ``rrows, rcols``: size of the right image. Only
    pixels are written whose four right pixels lie in the right window.
    """
    rows, cols = lu.shape
    wrows, wcols = ru.shape
    for y in range(rows):
        for x in range(cols):
            xr = np.float32(x + x0) + lu[y, x]
            yr = np.float32(y + y0) + lv[y, x]
            if not (xr >= 0 and xr <= rcols - 1 and yr >= 0 and yr <= rrows - 1):
                continue
            i, j = int(xr), int(yr)
            i1, j1 = min(i + 1, rcols - 1) - rx0, min(j + 1, rrows - 1) - ry0
            fx, fy = xr - np.float32(i), yr - np.float32(j)
            i, j = i - rx0, j - ry0
            if i < 0 or j < 0 or i1 >= wcols or j1 >= wrows:
                continue
            i2, j2 = int(xr + np.float32(0.5)) - rx0, int(yr + np.float32(0.5)) - ry0
            if not right_valid[j2, i2]:
                continue
            a, b, c, d = ru[j, i], ru[j, i1], ru[j1, i], ru[j1, i1]
            p, q, r, s = rv[j, i], rv[j, i1], rv[j1, i], rv[j1, i1]
            one = np.float32(1.0)
            if (
                max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) <= one
                and max(max(p, q), max(r, s)) - min(min(p, q), min(r, s)) <= one
            ):
                u = (a * (one - fx) + b * fx) * (one - fy) + (c * (one - fx) + d * fx) * fy
                v = (p * (one - fx) + q * fx) * (one - fy) + (r * (one - fx) + s * fx) * fy
            else:
                u, v = ru[j2, i2], rv[j2, i2]
            du, dv = lu[y, x] + u, lv[y, x] + v
            e = np.sqrt(du * du + dv * dv)
            if e < FAILED:
                error[y, x] = e


@njit(cache=True, nogil=True)
def lands(u, v, keep, right_valid, found, x0, y0, rx0, ry0, rrows, rcols):  # type: ignore[no-untyped-def]
    """Mark in ``found`` (bool) pixels of ``keep`` whose displacement ends on a usable pixel of the right image.

    Windows as in :func:`backmatch`; the right one must hold every end that lies in the image.
    """
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            xr, yr = x + x0 + np.float64(u[y, x]), y + y0 + np.float64(v[y, x])
            # half a pixel beyond the outermost centres is still on the image
            if keep[y, x] and -0.5 < xr < rcols - 0.5 and -0.5 < yr < rrows - 0.5:
                found[y, x] = right_valid[np.int64(np.rint(yr)) - ry0, np.int64(np.rint(xr)) - rx0] != 0


@njit(cache=True, nogil=True)
def _eighths(plane, keep, gone, coded):  # type: ignore[no-untyped-def]
    """Eighths of a pixel as int16, -32768 where there is no value."""
    for y in range(keep.shape[0]):
        for x in range(keep.shape[1]):
            use = keep[y, x] and not gone[y, x]
            coded[y, x] = np.int16(np.rint(8.0 * plane[y, x])) if use else np.int16(-32768)


def isolated(u: AnyArray, v: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """Pixels of ``keep`` in patches of fewer than ``size`` pixels whose neighbours differ by at most one pixel.

    ``u, v``: (row, col) float32 or int16 map, pixels.
    """
    if size <= 1:
        return np.zeros(keep.shape, dtype=bool)
    gone = np.zeros(keep.shape, dtype=bool)
    for plane in (u, v):
        coded = np.empty(keep.shape, np.int16)
        _eighths(plane, keep, gone, coded)
        cv2.filterSpeckles(coded, -32768, size - 1, 8)
        gone = keep & (coded == -32768)
    return gone


def lonely(keep: AnyArray, share: float) -> NDArray[np.bool_]:
    """Pixels of ``keep`` in whose neighbourhood (CROWD x CROWD, clipped at the border) less than ``share`` is kept."""
    if share <= 0:
        return np.zeros(keep.shape, dtype=bool)
    around = window_sum(keep.astype(np.float32), CROWD)
    room = window_sum(np.ones(keep.shape, np.float32), CROWD)
    return np.asarray(keep & (around < share * room))


def unsupported(u: AnyArray, v: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """As :func:`isolated`; where most of what remains lies in patches that are still small, those too.

    Images that have nothing to do with each other match by chance in patches up to some hundred pixels. Of a pair that
    shows one scene nearly everything lies in patches of thousands: there small ones are believed.
    """
    gone = isolated(u, v, keep, size)
    if size <= 1:
        return gone
    rest = keep & ~gone
    small = isolated(u, v, rest, min(CHANCE * size, keep.size // 8))
    return gone | small if np.count_nonzero(small) > 0.5 * np.count_nonzero(rest) else gone


@njit(cache=True, nogil=True)
def fill_rows(u, v, keep, reach, near_sign, filled):  # type: ignore[no-untyped-def]
    """Interpolate undefined disparities along rows, in place; ``filled`` gets 1 where it happened.

    A gap between values that agree within two pixels is a failed match and gets the line between them; another gap is
    an occlusion and gets its background: the side of lesser ``near_sign * u`` (-1: near things lie left in the right
    image). No value travels farther than ``reach`` pixels.
    """
    rows, cols = u.shape
    for y in range(rows):
        x = 0
        while x < cols:
            if keep[y, x]:
                x += 1
                continue
            start = x
            while x < cols and not keep[y, x]:
                x += 1
            a, b = start - 1, x
            for i in range(start, x):
                from_a = a >= 0 and i - a <= reach
                from_b = b < cols and b - i <= reach
                if not from_a and not from_b:
                    continue
                if from_a and from_b:
                    if abs(u[y, a] - u[y, b]) <= 2 and abs(v[y, a] - v[y, b]) <= 2:
                        t = np.float32(i - a) / np.float32(b - a)
                        u[y, i] = u[y, a] + t * (u[y, b] - u[y, a])
                        v[y, i] = v[y, a] + t * (v[y, b] - v[y, a])
                        filled[y, i] = 1
                        continue
                    from_a = near_sign * u[y, a] <= near_sign * u[y, b]
                s = a if from_a else b
                u[y, i], v[y, i] = u[y, s], v[y, s]
                filled[y, i] = 1
