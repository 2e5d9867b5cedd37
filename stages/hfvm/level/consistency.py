"""Median, back-matching, isolated patches, interpolation of undefined disparities (paper, 4.3.3 and 4.3.4)."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.validity import Validity
from rille.stages.numeric.windows import window_count

Map = NDArray[np.float32]

FAILED = np.float32(1e9)
"""Back-matching error where there is nothing to match back from."""

OUT_OF_IMAGE, BACKMATCH_FAILED = np.uint8(Validity.OUT_OF_IMAGE), np.uint8(Validity.BACKMATCH_FAILED)
MATCHED, INTERPOLATED = np.uint8(Validity.MATCHED), np.uint8(Validity.INTERPOLATED)
OVER_THRESHOLD, NO_TEXTURE = np.uint8(Validity.OVER_THRESHOLD), np.uint8(Validity.NO_TEXTURE)

CHANCE = 16
"""Times the size of an isolated patch: none of chance is as large (measured on blurred noise: up to 8 times)."""


CROWD = 9
"""Pixels: side of the neighbourhood in which matches support each other, about that of the features."""


SUPPORT, SUPPORT_CONSISTENT, SUPPORT_TEXTURED = 25, 0.9, 0.3
"""Pixels: side of the neighbourhood that bears out a pixel without texture, and least shares of it that are consistent
and that are matches. Chosen with five pairs (motorcycle, Baby1, Cloth1, Lampshade1, Midd1): of what is borne out 98 to
100 % are within 2 px, of all that is consistent without texture 14 to 100 %."""


def median(u: AnyArray, size: int) -> AnyArray:
    """Plain median of ``size`` x ``size`` pixels (3 or 5; 1 = none) of an int16 map, its edge repeated."""
    if size == 1:
        return u
    return np.asarray(cv2.medianBlur(u, size))


@njit(cache=True, nogil=True)
def agree(own, other, own_valid, other_valid, limit, found, offset):  # type: ignore[no-untyped-def]
    """Mark in ``found`` pixels of ``own_valid`` whose integer displacement is undone by the other map within ``limit``.

    ``own, other``: columns and rows of displacement of both maps. ``offset``: column and row at which the first pixel
    of the own window lies in the other one; only pixels that land in it are looked at.
    """
    (au, av), (bu, bv), (ox, oy) = own, other, offset
    rows, cols = au.shape
    brows, bcols = bu.shape
    most = np.float32(limit) * np.float32(limit)
    for y in range(rows):
        for x in range(cols):
            i, j = x + ox + np.int64(au[y, x]), y + oy + np.int64(av[y, x])
            if own_valid[y, x] and i >= 0 and i < bcols and j >= 0 and j < brows and other_valid[j, i]:
                du, dv = np.int64(au[y, x]) + bu[j, i], np.int64(av[y, x]) + bv[j, i]
                found[y, x] = du * du + dv * dv <= most


@njit(cache=True, nogil=True)
def backmatch(left, right, right_valid, error, place):  # type: ignore[no-untyped-def]
    """Distance |l - l'| of each left pixel after matching to the right and back (4.3.3), pixels.

    ``error`` comes as FAILED and stays so outside the right image and on its masked pixels. The right map is read at
    the nearest pixel. ``left, right``: columns and rows of displacement of both windows, which lie at ``place``
    (:class:`~rille.stages.hfvm.level.window_pair.WindowPair`).
    """
    (lu, lv), (ru, rv) = left, right
    x0, y0, rx0, ry0, rrows, rcols = place
    rows, cols = lu.shape
    wrows, wcols = ru.shape
    half, nil = np.float32(0.5), np.float32(0.0)
    last_x, last_y = np.float32(rcols - 1), np.float32(rrows - 1)
    for y in range(rows):
        for x in range(cols):
            xr = np.float32(x + x0) + lu[y, x]
            yr = np.float32(y + y0) + lv[y, x]
            if not (xr >= nil and xr <= last_x and yr >= nil and yr <= last_y):
                continue
            # A half and truncation round to the nearest pixel, since neither is negative here.
            i, j = np.int64(xr + half) - rx0, np.int64(yr + half) - ry0
            if i < 0 or j < 0 or i >= wcols or j >= wrows or not right_valid[j, i]:
                continue
            du, dv = lu[y, x] + ru[j, i], lv[y, x] + rv[j, i]
            e = np.sqrt(du * du + dv * dv)
            if e < FAILED:
                error[y, x] = e


@njit(cache=True, nogil=True)
def reasons(distance, deviation, valid, error, limits, bits):  # type: ignore[no-untyped-def]
    """Bits of :class:`~rille.stages.core.validity.Validity` that speak against each pixel, 0 where it is consistent.

    ``limits``: largest distance, least deviation, largest back-matching error, float32.
    """
    threshold, texture, backmatch = limits
    nil = np.uint8(0)
    for y in range(bits.shape[0]):
        d, local, usable, e, found = distance[y], deviation[y], valid[y], error[y], bits[y]
        for x in range(bits.shape[1]):
            # A masked pixel is no part of the image, so it counts as outside.
            outside = (e[x] >= FAILED) | (usable[x] == 0)
            bit = OUT_OF_IMAGE if outside else BACKMATCH_FAILED if e[x] > backmatch else nil
            bit |= OVER_THRESHOLD if d[x] > threshold else nil
            found[x] = bit | (NO_TEXTURE if local[x] < texture else nil)


@njit(cache=True, nogil=True)
def lands(u, v, keep, right_valid, found, place):  # type: ignore[no-untyped-def]
    """Mark in ``found`` (bool) pixels of ``keep`` whose displacement ends on a usable pixel of the right image.

    The right window must hold every end that lies in the image.
    """
    x0, y0, rx0, ry0, rrows, rcols = place
    half, nil = np.float32(0.5), np.float32(0.0)
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            # half a pixel beyond the outermost centres is still on the image
            xr, yr = np.float32(x + x0) + u[y, x] + half, np.float32(y + y0) + v[y, x] + half
            if keep[y, x] and nil < xr < np.float32(rcols) and nil < yr < np.float32(rrows):
                # Unsigned indices need no check for counting from the end.
                found[y, x] = right_valid[np.uint64(np.int64(yr) - ry0), np.uint64(np.int64(xr) - rx0)] != 0


def patches(u: AnyArray, v: AnyArray, keep: AnyArray) -> NDArray[np.int32]:
    """Size in pixels of the patch of ``keep`` that each pixel belongs to, 0 outside.

    Patches hang together along rows and columns where both displacements differ by at most one pixel. Room: 4 bytes a
    pixel and 8 a run of pixels.
    """
    sizes, parent, count = np.empty(keep.shape, np.int32), *np.empty((2, keep.size), np.int32)
    _patches(u, v, keep, sizes, parent, count)
    return sizes


@njit(cache=True, nogil=True)
def _root(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        # Each look halves the way for the next one.
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _patches(u, v, keep, label, parent, count):  # type: ignore[no-untyped-def]
    """Runs of a row are numbered, those of two rows that touch united, pixels counted, numbers replaced by sizes."""
    rows, cols = keep.shape
    n = 0
    for y in range(rows):
        above = max(y - 1, 0)
        own, other = -1, -1
        for x in range(cols):
            if not keep[y, x]:
                label[y, x] = own = -1
                continue
            if own < 0 or abs(u[y, x] - u[y, x - 1]) > 1 or abs(v[y, x] - v[y, x - 1]) > 1:
                own, other = n, -1
                parent[n], count[n] = n, 0
                n += 1
            label[y, x] = own
            count[own] += 1
            # A run is united with each one above it once, not at every pixel that they share.
            if y == 0 or label[above, x] == other or label[above, x] < 0:
                continue
            if abs(u[y, x] - u[above, x]) <= 1 and abs(v[y, x] - v[above, x]) <= 1:
                other = label[above, x]
                a, b = _root(parent, own), _root(parent, other)
                # The lesser number becomes the root: the loops below need parents before their children.
                parent[max(a, b)] = min(a, b)
    for i in range(n - 1, -1, -1):
        if parent[i] != i:
            count[parent[i]] += count[i]
    for i in range(n):
        count[i] = count[parent[i]]
    for y in range(rows):
        for x in range(cols):
            label[y, x] = count[label[y, x]] if label[y, x] >= 0 else 0


def lonely(keep: AnyArray, share: float) -> NDArray[np.bool_]:
    """Pixels of ``keep`` in whose neighbourhood (CROWD x CROWD, clipped at the border) less than ``share`` is kept."""
    if share <= 0:
        return np.zeros(keep.shape, dtype=bool)
    around, room = (window_count(a, CROWD) for a in (keep, np.ones_like(keep)))
    return np.asarray(keep & (around < share * room))


def supported(blank: AnyArray, keep: AnyArray) -> NDArray[np.bool_]:
    """Pixels of ``blank`` whose wide neighbourhood (SUPPORT x SUPPORT, clipped at the border) bears them out.

    ``blank``: consistent, but without texture. Nearly all pixels around are consistent, too, and enough of them are
    matches (``keep``). Among failures, as on a wall without any texture, consistent pixels are chance.
    """
    # A single index is found many times faster than two.
    y, x = np.divmod(np.flatnonzero(blank), blank.shape[1])
    found = np.zeros(blank.shape, bool)
    if y.size:
        # At the few pixels that are asked for: a third of the time of shares everywhere.
        consistent, textured = (window_count(a, SUPPORT)[y, x] for a in (keep | blank, keep))
        tall, wide = (
            np.minimum(at + SUPPORT // 2 + 1, n) - np.maximum(at - SUPPORT // 2, 0)
            for at, n in zip((y, x), blank.shape, strict=True)
        )
        room = tall * wide
        found[y, x] = (consistent >= SUPPORT_CONSISTENT * room) & (textured >= SUPPORT_TEXTURED * room)
    return found


def unsupported(u: AnyArray, v: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """Pixels of ``keep`` in patches of fewer than ``size``; where most of the rest lies in small ones, those too.

    Images that have nothing to do with each other match by chance in patches up to some hundred pixels. Of a pair that
    shows one scene nearly everything lies in patches of thousands: there small ones are believed.
    """
    if size <= 1:
        return np.zeros(keep.shape, dtype=bool)
    sizes = patches(u, v, keep)
    rest = np.count_nonzero(sizes >= size)
    # In a small image patches of CHANCE times the size may not fit: an eighth of it is enough.
    wanted = max(size, min(CHANCE * size, keep.size // 8))
    chance = np.count_nonzero(sizes >= wanted) < 0.5 * rest
    return np.asarray(keep & (sizes < (wanted if chance else size)))


@njit(cache=True, nogil=True)
def conclude(validity, keep, interpolated, u, v, error, distance):  # type: ignore[no-untyped-def]
    """Mark matched and interpolated pixels in ``validity``, and put NaN where nothing is known, in place."""
    nan, nil = np.float32(np.nan), np.uint8(0)
    for y in range(validity.shape[0]):
        bits, own, filled, a, b, e, d = validity[y], keep[y], interpolated[y], u[y], v[y], error[y], distance[y]
        for x in range(validity.shape[1]):
            known = own[x] | (filled[x] != 0)
            bits[x] |= (MATCHED if own[x] else nil) | (INTERPOLATED if filled[x] else nil)
            a[x] = a[x] if known else nan
            b[x] = b[x] if known else nan
            # FAILED and -1 are for kernels, which compare; what is published says NaN.
            e[x] = nan if e[x] >= FAILED else e[x]
            d[x] = nan if d[x] < 0 else d[x]


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
                # Bounded, so that a tile knows how far beside it values may come from.
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
                    # An occlusion shows the background: measured .01 to .02 better (bad-2) than smooth diffusion.
                    from_a = near_sign * u[y, a] <= near_sign * u[y, b]
                s = a if from_a else b
                u[y, i], v[y, i] = u[y, s], v[y, s]
                filled[y, i] = 1
