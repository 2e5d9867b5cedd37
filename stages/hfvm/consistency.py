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
def integer_error(au, av, bu, bv, b_valid, error):  # type: ignore[no-untyped-def]
    """As :func:`backmatch`, of integer maps."""
    rows, cols = au.shape
    brows, bcols = bu.shape
    for y in range(rows):
        for x in range(cols):
            i, j = x + np.int64(au[y, x]), y + np.int64(av[y, x])
            e = FAILED
            if i >= 0 and i < bcols and j >= 0 and j < brows and b_valid[j, i]:
                du, dv = np.int64(au[y, x]) + bu[j, i], np.int64(av[y, x]) + bv[j, i]
                e = np.sqrt(np.float32(du * du + dv * dv))
            error[y, x] = e


@njit(cache=True, nogil=True)
def backmatch(lu, lv, ru, rv, right_valid, error):  # type: ignore[no-untyped-def]
    """Distance |l - l'| of each left pixel after matching to the right and back (4.3.3), pixels; FAILED outside
    the right image and on its masked pixels.

    The right map is read bilinearly where its four pixels agree within a pixel, else at the nearest one.
    """
    rows, cols = lu.shape
    rrows, rcols = ru.shape
    for y in range(rows):
        for x in range(cols):
            error[y, x] = FAILED
            xr = np.float32(x) + lu[y, x]
            yr = np.float32(y) + lv[y, x]
            if not (xr >= 0 and xr <= rcols - 1 and yr >= 0 and yr <= rrows - 1):
                continue
            if not right_valid[int(yr + np.float32(0.5)), int(xr + np.float32(0.5))]:
                continue
            i, j = int(xr), int(yr)
            i1, j1 = min(i + 1, rcols - 1), min(j + 1, rrows - 1)
            fx, fy = xr - np.float32(i), yr - np.float32(j)
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
                i, j = int(xr + np.float32(0.5)), int(yr + np.float32(0.5))
                u, v = ru[j, i], rv[j, i]
            du, dv = lu[y, x] + u, lv[y, x] + v
            e = np.sqrt(du * du + dv * dv)
            if e < FAILED:
                error[y, x] = e


def lands(u: AnyArray, v: AnyArray, keep: AnyArray, right_valid: AnyArray) -> NDArray[np.bool_]:
    """Pixels of ``keep`` whose displacement ends on a usable pixel inside the right image."""
    found = np.zeros(keep.shape, dtype=bool)
    _lands(u, v, keep, right_valid, found)
    return found


@njit(cache=True, nogil=True)
def _lands(u, v, keep, right_valid, found):  # type: ignore[no-untyped-def]
    rows, cols = right_valid.shape
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            xr, yr = x + np.float64(u[y, x]), y + np.float64(v[y, x])
            # half a pixel beyond the outermost centres is still on the image
            if keep[y, x] and -0.5 < xr < cols - 0.5 and -0.5 < yr < rows - 0.5:
                found[y, x] = right_valid[np.int64(np.rint(yr)), np.int64(np.rint(xr))] != 0


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
