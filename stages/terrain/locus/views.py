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
import scipy
from numba import njit

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.geometry.surface import Surface

BLOCK_ROWS = 64  # rows of cells in one call, so that a large surface's feet stay small in memory

LANES = 32
"""Cells that are looked at together."""
SPLINE = 16
"""Coefficients that a value depends on."""
LEFT_AT, RIGHT_AT, LEFT_VALUE, RIGHT_VALUE, WEIGHTS, SLOPES = (k * LANES for k in (0, 2, 4, 7, 10, 18))
"""Planes: x and y in the left and in the right image, a pixel or more from the edge; value and gradient (x, y) of the
left and of the right spline; weights of four coefficients along x, along y, and their derivatives likewise."""
SPLINE_PLANES = 26


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
    splines = [scipy.ndimage.spline_filter(image, 3, np.float32, mode="mirror") for image in (left_image, right_image)]
    return Views(left, right, (splines[0], splines[1]), np.asarray(centre, np.float64))


def look(views: Views, surface: Surface, elevation: Floats | Floats32) -> OrthoPair:
    """What both images show at the elevations of the cells.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN unknown.
    """
    out = OrthoPair(*np.full((len(OrthoPair._fields), surface.rows, surface.cols), np.nan, np.float32))
    z, cols = np.ascontiguousarray(elevation, np.float64), np.arange(surface.cols)
    for start in range(0, surface.rows, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, surface.rows)
        # A row beyond either end, so that every cell has a neighbour below or above to measure its size with.
        first, last = max(0, start - 1), min(surface.rows, stop + 1)
        feet, normals = surface.block(np.arange(first, last), cols)
        _look((feet, normals), z, first, (start, stop), views, out)
    return out


FOOT, NORMAL, Z, BESIDE, BELOW = (k * LANES for k in (SPLINE_PLANES, *(SPLINE_PLANES + k for k in (3, 6, 7, 10))))
SEEN, WAYS = ((SPLINE_PLANES + k) * LANES for k in (13, 14))
"""Planes of a buffer of lanes, a cell in each: its foot, normal and elevation, the steps to its neighbours' feet (3
each); whether both images show it; the disparity, and for each image how a pixel moves with the elevation (2 each), and
the pixels that the cell covers."""
DISPARITY, LEFT_WAY, RIGHT_WAY, AREA = WAYS, WAYS + LANES, WAYS + 3 * LANES, WAYS + 5 * LANES
LANE_PLANES = SPLINE_PLANES + 20


@njit(cache=True, nogil=True, error_model="numpy")
def _look(block, z, first, span, views, out):  # type: ignore[no-untyped-def]
    """Rows of ``span``; feet and normals of the block begin at row ``first``."""
    feet, normals = block
    left_spline, right_spline = views.splines
    lanes, taps, cells = np.zeros(LANE_PLANES * LANES), np.zeros(SPLINE * LANES, np.float32), np.zeros(LANES, np.int64)
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
                read(n, left_spline, right_spline, lanes, taps)
                _write(n, cells, lanes, rows > 1 and cols > 1, flat)
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
def _write(n, cells, lanes, wide, out):  # type: ignore[no-untyped-def]
    """What :func:`look` gives of each lane; ``wide``: cells have neighbours, so that their size is known."""
    for m in range(n):
        if lanes[SEEN + m] > 0.0:
            i, left, right = cells[m], LEFT_VALUE + m, RIGHT_VALUE + m
            out.left[i], out.right[i] = lanes[left], lanes[right]
            gx, gy = lanes[left + LANES], lanes[left + 2 * LANES]
            out.left_slope[i] = gx * lanes[LEFT_WAY + m] + gy * lanes[LEFT_WAY + LANES + m]
            gx, gy = lanes[right + LANES], lanes[right + 2 * LANES]
            out.right_slope[i] = gx * lanes[RIGHT_WAY + m] + gy * lanes[RIGHT_WAY + LANES + m]
            out.scale[i], out.area[i] = lanes[DISPARITY + m], lanes[AREA + m] if wide else 1.0


@njit(cache=True, nogil=True)
def read(n, left, right, lanes, taps):  # type: ignore[no-untyped-def]
    """Value and gradient of both splines at ``n`` lanes; ``taps``: room for their coefficients."""
    for side in range(2):
        spline = right if side else left
        at = RIGHT_AT if side else LEFT_AT
        for m in range(n):
            c, r = int(lanes[at + m]) - 1, int(lanes[at + LANES + m]) - 1
            for k in range(4):
                for i in range(4):
                    taps[(4 * k + i) * LANES + m] = spline[r + k, c + i]
        if side:
            _weights(n, lanes, RIGHT_AT)
            _sum(n, lanes, taps, RIGHT_VALUE)
        else:
            _weights(n, lanes, LEFT_AT)
            _sum(n, lanes, taps, LEFT_VALUE)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _weights(n, lanes, at):  # type: ignore[no-untyped-def]
    for axis in range(2):
        w, s = WEIGHTS + 4 * axis * LANES, SLOPES + 4 * axis * LANES
        for m in range(n):
            t = lanes[at + axis * LANES + m]
            t = t - int(t)
            q = 1.0 - t
            lanes[w + m], lanes[w + 3 * LANES + m] = q * q * q / 6.0, t * t * t / 6.0
            lanes[w + LANES + m] = (4.0 - 3.0 * t * t * (2.0 - t)) / 6.0
            lanes[w + 2 * LANES + m] = (4.0 - 3.0 * q * q * (2.0 - q)) / 6.0
            lanes[s + m], lanes[s + 3 * LANES + m] = -0.5 * q * q, 0.5 * t * t
            lanes[s + LANES + m], lanes[s + 2 * LANES + m] = 0.5 * t * (3.0 * t - 4.0), -0.5 * q * (3.0 * q - 4.0)


@njit(cache=True, nogil=True, inline="always")
def _sum(n, lanes, taps, value):  # type: ignore[no-untyped-def]
    """Sums over the coefficients: along each row, then over the rows."""
    for m in range(n):
        lanes[value + m] = lanes[value + LANES + m] = lanes[value + 2 * LANES + m] = 0.0
    for k in range(4):
        tap = 4 * k * LANES
        for m in range(n):
            c0, c1, c2, c3 = (
                taps[tap + m],
                taps[tap + LANES + m],
                taps[tap + 2 * LANES + m],
                taps[tap + 3 * LANES + m],
            )
            w0, w1 = lanes[WEIGHTS + m], lanes[WEIGHTS + LANES + m]
            w2, w3 = lanes[WEIGHTS + 2 * LANES + m], lanes[WEIGHTS + 3 * LANES + m]
            across = w0 * c0 + w1 * c1 + w2 * c2 + w3 * c3
            w0, w1 = lanes[SLOPES + m], lanes[SLOPES + LANES + m]
            w2, w3 = lanes[SLOPES + 2 * LANES + m], lanes[SLOPES + 3 * LANES + m]
            along = w0 * c0 + w1 * c1 + w2 * c2 + w3 * c3
            w, s = lanes[WEIGHTS + (4 + k) * LANES + m], lanes[SLOPES + (4 + k) * LANES + m]
            lanes[value + m] += w * across
            lanes[value + LANES + m] += w * along
            lanes[value + 2 * LANES + m] += s * across
