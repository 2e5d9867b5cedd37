"""Both images seen through the elevations: grey values of each cell in the left and the right image.

A cell with foot F, normal N and elevation Z is the point P = F + Z N; its projections p_l and p_r are read from the
cubic splines through the images' pixels, so that detail is kept. With the terrain right, both show the same.

Reading the coefficients of the splines is a loop of its own; with them in planes of a buffer, one behind the other,
several cells are computed side by side, each in its own *lane*.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.geometry.spline import coefficients, slopes, weights
from rille.stages.geometry.surface import Surface

BLOCK_ROWS = 32  # rows of cells in one call, so that a large surface's feet stay small in memory

LANES = 32
"""Cells that are looked at together."""
TAPS = 16
"""Coefficients that a value depends on, each of a cell in a plane of its own."""
VALUE, ALONG_X, ALONG_Y = (k * LANES for k in range(3))
"""Planes of what is read of a spline: value and gradient."""


class Views(NamedTuple):
    """Projections (3, 4) from the frame of the surface to pixels, splines of both images, the left camera's centre."""

    left: Floats
    right: Floats
    splines: tuple[Floats32, Floats32]
    centre: Floats


class OrthoPair(NamedTuple):
    """What both images show of each cell (rows, cols) float32; NaN where it is unknown or not inside both images.

    ``left``, ``right``: grey values; ``left_slope``, ``right_slope``: how they change with the elevation, per metre;
    ``scale``: disparity a metre of elevation, pixels; ``area``: pixels of the left image that the cell covers.
    """

    left: Floats32
    right: Floats32
    left_slope: Floats32
    scale: Floats32
    area: Floats32
    right_slope: Floats32


def views(left: Floats, right: Floats, left_image: Floats32, right_image: Floats32, centre: Floats) -> Views:
    """Views of two images (row, col), grey values; ``centre`` of the left camera in the frame of the surface, m."""
    splines = coefficients(left_image), coefficients(right_image)
    return Views(left, right, splines, np.asarray(centre, np.float64))


def look(views: Views, surface: Surface, elevation: Floats | Floats32, room: OrthoPair | None = None) -> OrthoPair:
    """What both images show at the elevations of the cells.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN unknown.
    room : an earlier look that is no longer needed: its arrays are used again.
    """
    out = room or OrthoPair(*np.empty((len(OrthoPair._fields), surface.rows, surface.cols), np.float32))
    for array in out:
        array.fill(np.nan)
    z, cols = np.ascontiguousarray(elevation), np.arange(surface.cols)
    for start in range(0, surface.rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, surface.rows)
        # A row beyond either end, so that every cell has a neighbour below or above to measure its size with.
        first, last = max(0, start - 1), min(surface.rows, stop + 1)
        feet, normals = surface.block(np.arange(first, last), cols)
        _look((feet, normals), z, first, (start, stop), views, out)
    return out


LEFT_AT, RIGHT_AT, FOOT, NORMAL, Z, BESIDE, BELOW, SEEN, WAYS = (k * LANES for k in (0, 2, 4, 7, 10, 11, 14, 17, 18))
"""Planes of a buffer of lanes, a cell in each: x and y in the left and in the right image, a pixel or more from the
edge; the cell's foot, normal and elevation, the steps to its neighbours' feet (3 each); whether both images show it;
the disparity, and for each image how a pixel moves with the elevation (2 each), and the pixels that the cell covers."""
DISPARITY, LEFT_WAY, RIGHT_WAY, AREA = WAYS, WAYS + LANES, WAYS + 3 * LANES, WAYS + 5 * LANES
LANE_PLANES = 24

NOT_NEGATIVE = 0x7FFFFFFF
"""Mask of an index: the compiler then knows that none counts from the end, and need not ask at each use."""


@njit(cache=True, nogil=True, error_model="numpy")
def _look(block, z, first, span, views, out):  # type: ignore[no-untyped-def]
    """Rows of ``span``; feet and normals of the block begin at row ``first``."""
    feet, normals = block
    lanes, cells = np.zeros(LANE_PLANES * LANES), np.zeros(LANES, np.int64)
    taps = np.zeros(TAPS * LANES, np.float32)
    left, right = np.zeros(3 * LANES, np.float32), np.zeros(3 * LANES, np.float32)
    rows, cols = feet.shape[:2]
    # Flat views, so that a lane needs one number to write its cell.
    flat = OrthoPair(
        out.left.ravel(), out.right.ravel(), out.left_slope.ravel(), out.scale.ravel(), out.area.ravel(),
        out.right_slope.ravel(),
    )  # fmt: skip
    start, stop = span
    n = 0
    for r in range(start, stop):
        for c in range(cols):
            if np.isfinite(z[r, c]):
                i = r - first
                below, beside = (i + 1 if i + 1 < rows else i - 1), (c + 1 if c + 1 < cols else c - 1)
                for k in range(3):
                    lanes[FOOT + k * LANES + n], lanes[NORMAL + k * LANES + n] = feet[i, c, k], normals[i, c, k]
                    lanes[BELOW + k * LANES + n] = feet[max(below, 0), c, k] - feet[i, c, k]
                    lanes[BESIDE + k * LANES + n] = feet[i, max(beside, 0), k] - feet[i, c, k]
                lanes[Z + n], cells[n] = z[r, c], r * cols + c
                n += 1
            if n == LANES or (n > 0 and r == stop - 1 and c == cols - 1):
                _project(n, views, lanes)
                read(n, views.splines[0], lanes[LEFT_AT:], taps, left)
                read(n, views.splines[1], lanes[RIGHT_AT:], taps, right)
                _write(n, cells, lanes, left, right, rows > 1 and cols > 1, flat)
                n = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _motion(projection, at, way):  # type: ignore[no-untyped-def]
    """Pixels that the projection ``at`` (x, y, depth) of a point moves by when the point moves by ``way``."""
    p0, p1, p2 = projection
    x, y, depth = at
    dx, dy, dz = way
    d0 = p0[0] * dx + p0[1] * dy + p0[2] * dz
    d1 = p1[0] * dx + p1[1] * dy + p1[2] * dz
    d2 = p2[0] * dx + p2[1] * dy + p2[2] * dz
    return (d0 - x * d2) / depth, (d1 - y * d2) / depth


@njit(cache=True, nogil=True, error_model="numpy")
def _project(n, views, lanes):  # type: ignore[no-untyped-def]
    """Where both images show each lane's point, and how that moves."""
    left, right, splines, centre = views
    left_shape, right_shape = splines[0].shape, splines[1].shape
    l0, l1, l2 = _row(left, 0), _row(left, 1), _row(left, 2)
    r0, r1, r2 = _row(right, 0), _row(right, 1), _row(right, 2)
    of_left, of_right = (l0, l1, l2), (r0, r1, r2)
    cx, cy, cz = centre[0], centre[1], centre[2]
    wl, hl, wr, hr = left_shape[1] - 2.0, left_shape[0] - 2.0, right_shape[1] - 2.0, right_shape[0] - 2.0
    for m in range(n):
        nx, ny, nz = lanes[NORMAL + m], lanes[NORMAL + LANES + m], lanes[NORMAL + 2 * LANES + m]
        x = lanes[FOOT + m] + lanes[Z + m] * nx
        y = lanes[FOOT + LANES + m] + lanes[Z + m] * ny
        z = lanes[FOOT + 2 * LANES + m] + lanes[Z + m] * nz
        vx, vy, vz = x - cx, y - cy, z - cz
        toward = vx * nx + vy * ny + vz * nz
        a2, b2 = l2[0] * x + l2[1] * y + l2[2] * z + l2[3], r2[0] * x + r2[1] * y + r2[2] * z + r2[3]
        xl, yl = (l0[0] * x + l0[1] * y + l0[2] * z + l0[3]) / a2, (l1[0] * x + l1[1] * y + l1[2] * z + l1[3]) / a2
        xr, yr = (r0[0] * x + r0[1] * y + r0[2] * z + r0[3]) / b2, (r1[0] * x + r1[1] * y + r1[2] * z + r1[3]) / b2
        seen = (a2 > 0.0) & (b2 > 0.0) & (toward != 0.0)
        # A cubic spline reads from one pixel before to two behind the point.
        seen = seen & (xl >= 1.0) & (yl >= 1.0) & (xl < wl) & (yl < hl)
        seen = seen & (xr >= 1.0) & (yr >= 1.0) & (xr < wr) & (yr < hr)
        lanes[SEEN + m] = 1.0 if seen else 0.0
        lanes[LEFT_AT + m], lanes[LEFT_AT + LANES + m] = xl if seen else 1.0, yl if seen else 1.0
        lanes[RIGHT_AT + m], lanes[RIGHT_AT + LANES + m] = xr if seen else 1.0, yr if seen else 1.0
        # Along the left ray the left image stays: what the right one moves by is disparity.
        left_at, right_at = (xl, yl, a2), (xr, yr, b2)
        u, v = _motion(of_right, right_at, (vx / toward, vy / toward, vz / toward))
        lanes[DISPARITY + m] = math.sqrt(u * u + v * v)
        lanes[LEFT_WAY + m], lanes[LEFT_WAY + LANES + m] = _motion(of_left, left_at, (nx, ny, nz))
        lanes[RIGHT_WAY + m], lanes[RIGHT_WAY + LANES + m] = _motion(of_right, right_at, (nx, ny, nz))
        dx, dy, dz = lanes[BELOW + m], lanes[BELOW + LANES + m], lanes[BELOW + 2 * LANES + m]
        down, across = _motion(of_left, left_at, (dx, dy, dz))
        dx, dy, dz = lanes[BESIDE + m], lanes[BESIDE + LANES + m], lanes[BESIDE + 2 * LANES + m]
        u, v = _motion(of_left, left_at, (dx, dy, dz))
        lanes[AREA + m] = abs(down * v - across * u)


@njit(cache=True, nogil=True)
def _row(p, k):  # type: ignore[no-untyped-def]
    return p[k, 0], p[k, 1], p[k, 2], p[k, 3]


@njit(cache=True, nogil=True)
def _write(n, cells, lanes, left, right, wide, out):  # type: ignore[no-untyped-def]
    """What :func:`look` gives of each lane; ``wide``: cells have neighbours, so that their size is known."""
    for m in range(n):
        if lanes[SEEN + m] > 0.0:
            i = cells[m]
            out.left[i], out.right[i] = left[VALUE + m], right[VALUE + m]
            gx, gy = left[ALONG_X + m], left[ALONG_Y + m]
            out.left_slope[i] = gx * lanes[LEFT_WAY + m] + gy * lanes[LEFT_WAY + LANES + m]
            gx, gy = right[ALONG_X + m], right[ALONG_Y + m]
            out.right_slope[i] = gx * lanes[RIGHT_WAY + m] + gy * lanes[RIGHT_WAY + LANES + m]
            out.scale[i], out.area[i] = lanes[DISPARITY + m], lanes[AREA + m] if wide else 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def read(n, spline, at, taps, values):  # type: ignore[no-untyped-def]
    """Value and gradient of a spline at ``n`` points, whose x and y are the first two planes of ``at``; ``taps``: room
    for its coefficients, which are read in single precision like everything that is made of them."""
    flat, width = spline.ravel(), spline.shape[1] & NOT_NEGATIVE
    for m in range(n & NOT_NEGATIVE):
        first = ((int(at[LANES + m]) - 1) * width + int(at[m]) - 1) & NOT_NEGATIVE
        for k in range(4):
            for i in range(4):
                taps[(4 * k + i) * LANES + m] = flat[first + k * width + i]
    for m in range(n):
        x, y = np.float32(at[m] - int(at[m])), np.float32(at[LANES + m] - int(at[LANES + m]))
        wx, wy, dx, dy = weights(x), weights(y), slopes(x), slopes(y)
        a = taps[m], taps[LANES + m], taps[2 * LANES + m], taps[3 * LANES + m]
        b = taps[4 * LANES + m], taps[5 * LANES + m], taps[6 * LANES + m], taps[7 * LANES + m]
        c = taps[8 * LANES + m], taps[9 * LANES + m], taps[10 * LANES + m], taps[11 * LANES + m]
        d = taps[12 * LANES + m], taps[13 * LANES + m], taps[14 * LANES + m], taps[15 * LANES + m]
        rows = _sum(wx, a), _sum(wx, b), _sum(wx, c), _sum(wx, d)
        values[VALUE + m], values[ALONG_Y + m] = _sum(wy, rows), _sum(dy, rows)
        values[ALONG_X + m] = _sum(wy, (_sum(dx, a), _sum(dx, b), _sum(dx, c), _sum(dx, d)))


@njit(cache=True, nogil=True)
def _sum(w, c):  # type: ignore[no-untyped-def]
    return w[0] * c[0] + w[1] * c[1] + w[2] * c[2] + w[3] * c[3]
