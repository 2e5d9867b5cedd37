"""Validation of displacements: consistency, reasons against a match, isolated patches (paper, 4.3.1 and 4.3.3)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.numeric.windows import window_count, window_room

FAILED_PX = np.float32(1e9)
"""Back-matching error where there is nothing to match back from."""

CHANCE_SIZE_FACTOR = 16
"""Times the size of an isolated patch: none of chance is as large (measured on blurred noise: up to 8 times)."""

CROWD_SIDE_PX = 9
"""Pixels: side of the neighbourhood in which matches support each other, about that of the features."""

NO_PATCH = -32768
"""Displacement of pixels that are in no patch."""


def agree(own: Any, other: Any, own_valid: AnyArray, other_valid: AnyArray, limit: float) -> NDArray[np.bool_]:
    """Usable pixels whose whole displacement is undone by the other map within ``limit`` pixels (4.3.3).

    ``own, other``: maps, ``u`` and ``v`` int16.
    """
    agreeing = np.zeros(own.u.shape, bool)
    _agree(own, other, own_valid, other_valid, np.float32(limit * limit), agreeing)
    return agreeing


@njit(cache=True, nogil=True)
def _agree(own, other, own_valid, other_valid, most, agreeing):  # type: ignore[no-untyped-def]
    rows, cols = agreeing.shape
    brows, bcols = np.uint64(other_valid.shape[0]), np.uint64(other_valid.shape[1])
    for y in range(rows):
        for x in range(cols):
            # Unsigned: what is negative lies beyond every column.
            i, j = np.uint64(x + np.int64(own.u[y, x])), np.uint64(y + np.int64(own.v[y, x]))
            if own_valid[y, x] and i < bcols and j < brows and other_valid[j, i]:
                du, dv = np.int64(own.u[y, x]) + other.u[j, i], np.int64(own.v[y, x]) + other.v[j, i]
                agreeing[y, x] = du * du + dv * dv <= most


@njit(cache=True, nogil=True)
def backmatch(u, v, right, right_valid, error):  # type: ignore[no-untyped-def]
    """Distance |l - l'| of each left pixel after matching to the right and back (4.3.3), pixels.

    ``error`` comes as FAILED_PX and stays so outside the right image and on its masked pixels. The right map, columns
    and rows of displacement, is read at the nearest pixel.
    """
    ru, rv = right
    last_x, last_y, half = np.float32(ru.shape[1] - 1), np.float32(ru.shape[0] - 1), np.float32(0.5)
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
            if not (xr >= 0 and xr <= last_x and yr >= 0 and yr <= last_y):
                continue
            # A half and truncation round to the nearest pixel, since neither is negative here.
            i, j = np.int64(xr + half), np.int64(yr + half)
            if right_valid[j, i]:
                du, dv = u[y, x] + ru[j, i], v[y, x] + rv[j, i]
                error[y, x] = min(np.sqrt(du * du + dv * dv), FAILED_PX)


@njit(cache=True, nogil=True)
def lands(u, v, keep, right_valid):  # type: ignore[no-untyped-def]
    """Pixels (bool) of ``keep`` whose displacement ends on a usable pixel of the right image."""
    landing, half = np.zeros(keep.shape, np.bool_), np.float32(0.5)
    rows, cols = right_valid.shape
    for y in range(u.shape[0]):
        for x in range(u.shape[1]):
            # Half a pixel beyond the outermost centres is still on the image.
            xr, yr = np.float32(x) + u[y, x] + half, np.float32(y) + v[y, x] + half
            if keep[y, x] and 0 < xr < cols and 0 < yr < rows:
                landing[y, x] = right_valid[np.int64(yr), np.int64(xr)] != 0
    return landing


def lonely(keep: AnyArray, share: float) -> NDArray[np.bool_]:
    """Pixels of ``keep`` around which (:data:`CROWD_SIDE_PX`, clipped at the border) less than ``share`` is kept."""
    if share <= 0:
        return np.zeros(keep.shape, dtype=bool)
    return np.asarray(keep & (window_count(keep, CROWD_SIDE_PX) < share * window_room(keep.shape, CROWD_SIDE_PX)))


def isolated(u: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """Pixels of ``keep`` in patches of fewer than ``size``; where most of the rest lies in small ones, those too.

    Patches hang together along rows and columns where column displacements differ by at most one pixel. Images that
    have nothing to do with each other match by chance in patches up to some hundred pixels. Of a pair that shows one
    scene nearly everything lies in patches of thousands: there small ones are believed.

    Parameters
    ----------
    u : (row, col) int16 column displacements, pixels.
    """
    if size <= 1:
        return np.zeros(keep.shape, dtype=bool)
    # In a small image patches of CHANCE_SIZE_FACTOR times the size may not fit: an eighth of it is enough.
    suspect = _in_small_patches(u, keep, max(size, min(CHANCE_SIZE_FACTOR * size, keep.size // 8)))
    # The smaller patches are among these, and most matches are not.
    small = _in_small_patches(u, suspect, size)
    all_of_them = np.count_nonzero(keep)
    rest, large = all_of_them - np.count_nonzero(small), all_of_them - np.count_nonzero(suspect)
    return suspect if large < 0.5 * rest else small


def _in_small_patches(u: AnyArray, keep: AnyArray, size: int) -> NDArray[np.bool_]:
    """Pixels of ``keep`` that are in a patch of fewer than ``size``."""
    plane = np.where(keep, u, np.int16(NO_PATCH))
    cv2.filterSpeckles(plane, NO_PATCH, size - 1, 1)
    return np.asarray(keep & (plane == NO_PATCH))
