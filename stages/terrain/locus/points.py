"""Mismatch of disparity and calibration at many points of cells' lines at once, for
:mod:`rille.stages.terrain.locus.kernel`.

Values lie in *planes* of a buffer, one behind the other, whose sizes are constants: so the compiler knows that they do
not overlap, and computes several points side by side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32

NEAR = 1e-9  # least projective depth (metres): excludes the camera's own plane

LANES = 32
"""Cells that are solved together."""
STEPS = 8
"""LineSteps of one cell's search that are looked at together."""
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


class Line(NamedTuple):
    """The line of a cell in one image: its points F + Z N have the homogeneous projections a + Z b."""

    a0: float
    a1: float
    a2: float
    b0: float
    b1: float
    b2: float


class LineSteps(NamedTuple):
    """Points of a line that are looked at together: Z = bottom + (first + way m) dz, m < :data:`STEPS`."""

    bottom: float
    first: float
    way: float
    dz: float


class Observed(NamedTuple):
    """What is read at a pixel of the left image (rows, cols).

    ``disparity`` (2 rows cols,) column and row disparity (right minus left) of each pixel in turn, pixels, NaN where it
    must not be used; ``std`` (rows, cols) its standard deviation, pixels; ``image`` (rows, cols) grey values;
    ``limits`` (2,) greatest residual and greatest jump in the bilinear cell, pixels.
    """

    disparity: Floats32
    std: Floats
    image: Floats32
    limits: Floats


# Functions that take arrays and run once a cell are inlined where they are called: to count the references of their
# arguments takes longer than their work.
@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def line_of(lanes, a, b, m):  # type: ignore[no-untyped-def]
    """The line of lane ``m`` whose terms begin at planes ``a`` and ``b``."""
    return Line(
        lanes[a + m], lanes[a + LANES + m], lanes[a + 2 * LANES + m],
        lanes[b + m], lanes[b + LANES + m], lanes[b + 2 * LANES + m],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def project(line, z):  # type: ignore[no-untyped-def]
    """x, y of the line's point at elevation z, pixels, and its projective depth."""
    w = line.a2 + z * line.b2
    return (line.a0 + z * line.b0) / w, (line.a1 + z * line.b1) / w, w


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _place(left, right, z, shape, room, k):  # type: ignore[no-untyped-def]
    """Point ``k``: p_l and p_r of the lines' point at elevation z, and the bilinear cell of p_l."""
    x, y, w_left = project(left, z)
    xr, yr, w_right = project(right, z)
    rows, cols = shape
    inside = (w_left >= NEAR) & (w_right >= NEAR) & (x >= 0.0) & (y >= 0.0) & (x < cols - 1.0) & (y < rows - 1.0)
    # A point outside reads pixel 0, so that the loop over the disparity needs no branch; its NaN makes s one.
    x, y, xr = x if inside else 0.0, y if inside else 0.0, xr if inside else np.nan
    c, r = np.floor(x), np.floor(y)
    room[X + k], room[Y + k], room[X_RIGHT + k], room[Y_RIGHT + k] = x, y, xr, yr
    room[FX + k], room[FY + k], room[PIXEL + k] = x - c, y - r, r * float(cols) + c


@njit(cache=True, nogil=True, error_model="numpy")
def climb(lanes, m, steps, shape, room):  # type: ignore[no-untyped-def]
    """Project the next steps of lane ``m`` into both images; ``shape`` (rows, cols) of the left one."""
    left, right = line_of(lanes, LEFT_A, LEFT_B, m), line_of(lanes, RIGHT_A, RIGHT_B, m)
    for k in range(STEPS):
        _place(left, right, steps.bottom + (steps.first + steps.way * k) * steps.dz, shape, room, k)


@njit(cache=True, nogil=True, error_model="numpy")
def raise_to(lanes, n, shape, room):  # type: ignore[no-untyped-def]
    """Project the point at elevation :data:`Z` of each of ``n`` lanes."""
    for m in range(n):
        left, right = line_of(lanes, LEFT_A, LEFT_B, m), line_of(lanes, RIGHT_A, RIGHT_B, m)
        _place(left, right, lanes[Z + m], shape, room, m)


@njit(cache=True, nogil=True, error_model="numpy")
def meet(n, epipole, seen, room):  # type: ignore[no-untyped-def]
    """s of ``n`` projected points; NaN where a point is outside an image or disparity is undefined."""
    # To read the disparity at scattered pixels is what vectors cannot do, so it is a loop of its own.
    disparity, width = seen.disparity, seen.image.shape[1]
    for k in range(n):
        i = 2 * int(room[PIXEL + k])
        j = i + 2 * width
        fx, fy = room[FX + k], room[FY + k]
        w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
        room[U + k] = w00 * disparity[i] + w01 * disparity[i + 2] + w10 * disparity[j] + w11 * disparity[j + 2]
        room[V + k] = w00 * disparity[i + 1] + w01 * disparity[i + 3] + w10 * disparity[j + 1] + w11 * disparity[j + 3]
    e0, e1, e2 = epipole[0], epipole[1], epipole[2]
    for k in range(n):
        # g = p_l + d(p_l) - p_r
        xr, yr = room[X_RIGHT + k], room[Y_RIGHT + k]
        gx, gy = room[X + k] + room[U + k] - xr, room[Y + k] + room[V + k] - yr
        # With p_r(t) = (epipole + t m) / w on the ray of p_l, d p_r / d t is parallel to p_r * epipole_2 - epipole_01.
        ex, ey = xr * e2 - e0, yr * e2 - e1
        # s = g . e / |e|: the search asks for its sign alone, so the root and the division are left to ``pixels``.
        power = ex * ex + ey * ey
        s = gx * ex + gy * ey
        room[S + k] = s if power > 0.0 else np.nan
        room[ACROSS + k], room[POWER + k] = gy * ex - gx * ey, power


@njit(cache=True, nogil=True, error_model="numpy")
def pixels(room, plane, k):  # type: ignore[no-untyped-def]
    """:data:`S` or :data:`ACROSS` of point ``k`` in pixels."""
    return room[plane + k] / math.sqrt(room[POWER + k])
