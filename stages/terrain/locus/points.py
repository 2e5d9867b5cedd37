"""Mismatch of disparity and calibration at many points of cells' lines at once, for
:mod:`rille.stages.terrain.locus.kernel`.

Values lie in *planes* of a buffer, one behind the other, whose sizes are constants: so the compiler knows that they do
not overlap, and computes several points side by side. What vectors cannot do, reading the disparity, is a loop of its
own; and functions that take arrays are called for many cells, because counting references takes longer than a cell.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

NEAR = 1e-9  # least projective depth (metres): excludes the camera's own plane

LANES = 32
"""Cells that are solved together."""
STEPS = 8
"""Steps of one cell's search that are looked at together."""
POINTS = LANES * STEPS

X, Y, X_RIGHT, Y_RIGHT, FX, FY, PIXEL, U, V, S, ACROSS, POWER = (k * POINTS for k in range(12))
"""Planes of a buffer of points: p_l and p_r, the place of p_l in its bilinear cell, the pixel at that cell's start, the
disparity there, and as :func:`meet` gives them s and its part across the epipolar line, both times a norm whose square
is ``POWER``."""
POINT_PLANES = 12

LEFT_A, RIGHT_A, LEFT_B, RIGHT_B = (3 * k * LANES for k in range(4))
"""Planes of a buffer of lanes that hold each cell's line: its homogeneous projections a + z b, three planes each."""
LINE = 12
"""Number of these planes."""
Z = 12 * LANES
"""Plane of the elevation that is looked at."""


@njit(cache=True, nogil=True, error_model="numpy")
def climb(lanes, lane, bottom, step, way, dz, width, height, room):  # type: ignore[no-untyped-def]
    """Project the points ``bottom + (step + way m) dz``, m < :data:`STEPS`, of one lane's line."""
    a0, a1, a2 = lanes[LEFT_A + lane], lanes[LEFT_A + LANES + lane], lanes[LEFT_A + 2 * LANES + lane]
    a3, a4, a5 = lanes[RIGHT_A + lane], lanes[RIGHT_A + LANES + lane], lanes[RIGHT_A + 2 * LANES + lane]
    b0, b1, b2 = lanes[LEFT_B + lane], lanes[LEFT_B + LANES + lane], lanes[LEFT_B + 2 * LANES + lane]
    b3, b4, b5 = lanes[RIGHT_B + lane], lanes[RIGHT_B + LANES + lane], lanes[RIGHT_B + 2 * LANES + lane]
    w, right, lower = float(width), width - 1.0, height - 1.0
    for m in range(STEPS):
        z = bottom + (step + way * m) * dz
        w_left, w_right = a2 + z * b2, a5 + z * b5
        x, y = (a0 + z * b0) / w_left, (a1 + z * b1) / w_left
        xr, yr = (a3 + z * b3) / w_right, (a4 + z * b4) / w_right
        inside = (w_left >= NEAR) & (w_right >= NEAR) & (x >= 0.0) & (y >= 0.0) & (x < right) & (y < lower)
        x, y, xr = x if inside else 0.0, y if inside else 0.0, xr if inside else np.nan
        c, r = np.floor(x), np.floor(y)
        room[X + m], room[Y + m], room[X_RIGHT + m], room[Y_RIGHT + m] = x, y, xr, yr
        room[FX + m], room[FY + m], room[PIXEL + m] = x - c, y - r, r * w + c


@njit(cache=True, nogil=True, error_model="numpy")
def project(lanes, n, width, height, room):  # type: ignore[no-untyped-def]
    """Project the point at elevation :data:`Z` of each of ``n`` lanes."""
    w, right, lower = float(width), width - 1.0, height - 1.0
    for m in range(n):
        z = lanes[Z + m]
        w_left = lanes[LEFT_A + 2 * LANES + m] + z * lanes[LEFT_B + 2 * LANES + m]
        w_right = lanes[RIGHT_A + 2 * LANES + m] + z * lanes[RIGHT_B + 2 * LANES + m]
        x = (lanes[LEFT_A + m] + z * lanes[LEFT_B + m]) / w_left
        y = (lanes[LEFT_A + LANES + m] + z * lanes[LEFT_B + LANES + m]) / w_left
        xr = (lanes[RIGHT_A + m] + z * lanes[RIGHT_B + m]) / w_right
        yr = (lanes[RIGHT_A + LANES + m] + z * lanes[RIGHT_B + LANES + m]) / w_right
        inside = (w_left >= NEAR) & (w_right >= NEAR) & (x >= 0.0) & (y >= 0.0) & (x < right) & (y < lower)
        x, y, xr = x if inside else 0.0, y if inside else 0.0, xr if inside else np.nan
        c, r = np.floor(x), np.floor(y)
        room[X + m], room[Y + m], room[X_RIGHT + m], room[Y_RIGHT + m] = x, y, xr, yr
        room[FX + m], room[FY + m], room[PIXEL + m] = x - c, y - r, r * w + c


@njit(cache=True, nogil=True, error_model="numpy")
def meet(n, epipole, width, disparity, room):  # type: ignore[no-untyped-def]
    """Mismatch at ``n`` projected points; NaN where a point is outside an image or disparity is undefined.

    ``disparity``: column and row of each pixel in turn, NaN where it must not be used.
    """
    for k in range(n):
        i = 2 * int(room[PIXEL + k])
        j = i + 2 * width
        fx, fy = room[FX + k], room[FY + k]
        w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
        room[U + k] = w00 * disparity[i] + w01 * disparity[i + 2] + w10 * disparity[j] + w11 * disparity[j + 2]
        room[V + k] = w00 * disparity[i + 1] + w01 * disparity[i + 3] + w10 * disparity[j + 1] + w11 * disparity[j + 3]
    e0, e1, e2 = epipole[0], epipole[1], epipole[2]
    for k in range(n):
        xr, yr = room[X_RIGHT + k], room[Y_RIGHT + k]
        gx, gy = room[X + k] + room[U + k] - xr, room[Y + k] + room[V + k] - yr
        # With p_r(t) = (epipole + t m) / w on the ray of p_l, d p_r / d t is parallel to p_r * epipole_2 - epipole_01.
        ex, ey = xr * e2 - e0, yr * e2 - e1
        power = ex * ex + ey * ey
        s = gx * ex + gy * ey
        room[S + k] = s if power > 0.0 else np.nan
        room[ACROSS + k], room[POWER + k] = gy * ex - gx * ey, power


@njit(cache=True, nogil=True, error_model="numpy")
def pixels(room, plane, k):  # type: ignore[no-untyped-def]
    """:data:`S` or :data:`ACROSS` of point ``k`` in pixels."""
    return room[plane + k] / math.sqrt(room[POWER + k])
