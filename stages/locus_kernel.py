"""Kernel of Locus reconstruction (paper, section 4.4): one cell after the other, straight from the disparity.

For a cell with foot F and normal N let P(Z) = F + Z N, p_l and p_r its projections and d the disparity vector. The
paper minimises |g(Z)|, g = p_l(Z) + d(p_l(Z)) - p_r(Z). Here the *sign change* of s(Z) = g(Z) . e is solved, e being
the direction at p_r in which a point moves when it recedes along the left camera's ray (the local epipolar line): the
same solution with a tenth of the evaluations, and more exact, because a minimum is flat and a sign change is not.

s > 0: the surface that the left camera sees behind P is farther than P, so P is in free space; s < 0: P is behind the
surface. A terrain surface is a change from free (above) to behind (below) along the normal. Where the change happens
across a depth jump between two pixels nothing was seen: the cell is occluded there.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]

STEP_PX = 1.0  # search step: disparity is bilinear between pixels, so nothing hides in a shorter one
MARGIN = 2  # steps that the interval handed down from the coarse level is widened by
MAX_STEPS = 4096.0  # of one locus: more than the diagonal of a 12 megapixel image
SOLVED_PX = 1e-3  # |s| of a solution: a hundredth of the disparity's own noise
NEAR = 1e-9  # least projective depth (metres): excludes the camera's own plane


@njit(cache=True, nogil=True)
def _mismatch(z: float, a: Floats, b: Floats, epipole: Floats, dcol: Float32, drow: Float32) -> tuple:
    """Signed mismatch s, its part across the epipolar line, and p_l; NaN where disparity is undefined.

    ``a + z b``: homogeneous projections of P(Z), left in 0..2 and right in 3..5.
    """
    w_left, w_right = a[2] + z * b[2], a[5] + z * b[5]
    if w_left < NEAR or w_right < NEAR:
        return np.nan, np.nan, 0.0, 0.0
    x, y = (a[0] + z * b[0]) / w_left, (a[1] + z * b[1]) / w_left
    c, r = math.floor(x), math.floor(y)
    if c < 0 or r < 0 or c + 1 >= dcol.shape[1] or r + 1 >= dcol.shape[0]:
        return np.nan, np.nan, 0.0, 0.0
    fx, fy = x - c, y - r
    w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    u = w00 * dcol[r, c] + w01 * dcol[r, c + 1] + w10 * dcol[r + 1, c] + w11 * dcol[r + 1, c + 1]
    v = w00 * drow[r, c] + w01 * drow[r, c + 1] + w10 * drow[r + 1, c] + w11 * drow[r + 1, c + 1]
    xr, yr = (a[3] + z * b[3]) / w_right, (a[4] + z * b[4]) / w_right
    gx, gy = x + u - xr, y + v - yr
    # With p_r(t) = (epipole + t m) / w on the ray of p_l, d p_r / d t is parallel to p_r * epipole_2 - epipole_01.
    ex, ey = xr * epipole[2] - epipole[0], yr * epipole[2] - epipole[1]
    norm = math.sqrt(ex * ex + ey * ey)
    if norm == 0.0:
        return np.nan, np.nan, 0.0, 0.0
    return (gx * ex + gy * ey) / norm, (gy * ex - gx * ey) / norm, x, y


@njit(cache=True, nogil=True)
def _clip(a: Floats, b: Floats, sizes: Floats, low: float, high: float) -> tuple:
    """The part of low..high where P(Z) projects into both images; empty (low > high) where there is none."""
    for k in range(2):
        a0, a1, a2 = a[3 * k], a[3 * k + 1], a[3 * k + 2]
        b0, b1, b2 = b[3 * k], b[3 * k + 1], b[3 * k + 2]
        w, h = sizes[2 * k] - 1.0, sizes[2 * k + 1] - 1.0
        for side in range(5):
            if side == 0:
                p, q = a0, b0
            elif side == 1:
                p, q = w * a2 - a0, w * b2 - b0
            elif side == 2:
                p, q = a1, b1
            elif side == 3:
                p, q = h * a2 - a1, h * b2 - b1
            else:
                p, q = a2 - NEAR, b2
            # p + z q >= 0
            if q > 0.0:
                low = max(low, -p / q)
            elif q < 0.0:
                high = min(high, -p / q)
            elif p < 0.0:
                return 1.0, 0.0
    return low, high


@njit(cache=True, nogil=True)
def _speed(z: float, a: Floats, b: Floats) -> float:
    """Greater of the two image speeds |d p / d Z|, pixels per metre."""
    fastest = 0.0
    for k in range(2):
        w = max(a[3 * k + 2] + z * b[3 * k + 2], NEAR)
        x, y = (a[3 * k] + z * b[3 * k]) / w, (a[3 * k + 1] + z * b[3 * k + 1]) / w
        dx, dy = (b[3 * k] - x * b[3 * k + 2]) / w, (b[3 * k + 1] - y * b[3 * k + 2]) / w
        fastest = max(fastest, math.sqrt(dx * dx + dy * dy))
    return fastest


@njit(cache=True, nogil=True)
def _solve(
    z0: float, s0: float, z1: float, s1: float, a: Floats, b: Floats, epipole: Floats, dcol: Float32, drow: Float32
) -> float:
    """Root of s between z0 (s >= 0) and z1 (s < 0) by regula falsi (Illinois); NaN at undefined disparity."""
    z, side = z1, 0
    for _ in range(16):
        z = (z0 * s1 - z1 * s0) / (s1 - s0)
        s = _mismatch(z, a, b, epipole, dcol, drow)[0]
        if math.isnan(s) or abs(s) < SOLVED_PX:
            return z if not math.isnan(s) else np.nan
        if s > 0.0:
            z0, s0 = z, s
            if side == 1:
                s1 *= 0.5
            side = 1
        else:
            z1, s1 = z, s
            if side == -1:
                s0 *= 0.5
            side = -1
    return z


@njit(cache=True, nogil=True)
def _is_jump(x: float, y: float, epipole: Floats, dcol: Float32, drow: Float32, max_jump: float) -> bool:
    """Whether the disparities around pixel (x, y) differ by more than ``max_jump`` (a depth discontinuity)."""
    c, r = math.floor(x), math.floor(y)
    low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
    for i in range(2):
        for j in range(2):
            u, v = dcol[r + i, c + j], drow[r + i, c + j]
            low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
    return (high_u - low_u) ** 2 + (high_v - low_v) ** 2 > max_jump * max_jump


@njit(cache=True, nogil=True)
def _slope(z: float, dz: float, a: Floats, b: Floats, epipole: Floats, dcol: Float32, drow: Float32) -> float:
    """ds/dZ at a solution, pixels per metre: the lesser one-sided slope, so that a jump nearby does not flatter it."""
    up = _mismatch(z + dz, a, b, epipole, dcol, drow)[0] / dz
    down = -_mismatch(z - dz, a, b, epipole, dcol, drow)[0] / dz
    if math.isnan(up):
        up = down
    if math.isnan(down):
        down = up
    return float(min(up, down))


@njit(cache=True, nogil=True)
def _accept(
    z: float,
    dz: float,
    a: Floats,
    b: Floats,
    epipole: Floats,
    dcol: Float32,
    drow: Float32,
    image: Float32,
    limits: Floats,
    out: Floats,
) -> bool:
    """Check a solution; fill ``out`` = elevation, residual, ds/dZ, grey value where it stands."""
    s, across, x, y = _mismatch(z, a, b, epipole, dcol, drow)
    residual = math.sqrt(s * s + across * across)
    if not residual <= limits[0] or _is_jump(x, y, epipole, dcol, drow, limits[1]):
        return False
    slope = _slope(z, dz, a, b, epipole, dcol, drow)
    if not slope > 0.0:
        return False
    c, r = math.floor(x), math.floor(y)
    fx, fy = x - c, y - r
    top = image[r, c] * (1.0 - fx) + image[r, c + 1] * fx
    bottom = image[r + 1, c] * (1.0 - fx) + image[r + 1, c + 1] * fx
    out[0], out[1], out[2], out[3] = z, residual, slope, top * (1.0 - fy) + bottom * fy
    return True


@njit(cache=True, nogil=True)
def _cell(
    span: tuple,
    a: Floats,
    b: Floats,
    epipole: Floats,
    dcol: Float32,
    drow: Float32,
    image: Float32,
    limits: Floats,
    out: Floats,
) -> None:
    """The highest accepted change from free to behind; the search starts in low..high and may leave it.

    Leaves the interval upwards while the point is behind the surface, downwards while it is free.
    ``span`` = low, high, bottom, top; bottom..top is where both images see the normal.
    """
    low, high, bottom, top = span
    steps = math.ceil(max(_speed(bottom, a, b), _speed(top, a, b)) * (top - bottom) / STEP_PX)
    n = int(max(1.0, min(steps, MAX_STEPS)))
    dz = (top - bottom) / n
    k = int(max(0.0, min(float(n), math.ceil((high - bottom) / dz) + MARGIN)))
    last = math.floor((low - bottom) / dz) - MARGIN
    z = bottom + k * dz
    s = _mismatch(z, a, b, epipole, dcol, drow)[0]
    up, s_up = k, s
    while s_up < 0.0 and up < n:
        below = s_up
        up += 1
        s_up = _mismatch(bottom + up * dz, a, b, epipole, dcol, drow)[0]
        if s_up >= 0.0:
            root = _solve(bottom + up * dz, s_up, bottom + (up - 1) * dz, below, a, b, epipole, dcol, drow)
            if _accept(root, dz, a, b, epipole, dcol, drow, image, limits, out):
                return
    while k > 0:
        above = s
        k -= 1
        s = _mismatch(bottom + k * dz, a, b, epipole, dcol, drow)[0]
        if above >= 0.0 and s < 0.0:
            root = _solve(bottom + (k + 1) * dz, above, bottom + k * dz, s, a, b, epipole, dcol, drow)
            if _accept(root, dz, a, b, epipole, dcol, drow, image, limits, out):
                return
        if k <= last and not s >= 0.0:
            return


@njit(cache=True, nogil=True)
def search(
    feet: Floats,
    normals: Floats,
    low: Floats,
    high: Floats,
    z_min: float,
    z_max: float,
    left: Floats,
    right: Floats,
    epipole: Floats,
    sizes: Floats,
    dcol: Float32,
    drow: Float32,
    image: Float32,
    limits: Floats,
    out: Floats,
) -> None:
    """Solve every cell of a block.

    Parameters
    ----------
    feet, normals : (r, c, 3) metres, frame of the surface.
    low, high : (r, c) interval of Z in which the search starts, metres; NaN: the cell is left out.
    z_min, z_max : limits of Z.
    left, right : (3, 4) projections from the frame of the surface to pixels.
    epipole : (3,) homogeneous projection of the left camera's centre into the right image.
    sizes : (4,) width and height of the left, then of the right image.
    dcol, drow : disparity vector (right minus left) on the left image, pixels, NaN where it must not be used.
    image : grey values of the left image.
    limits : (2,) greatest residual and greatest jump in the bilinear cell, pixels.
    out : (r, c, 4) elevation (m), residual (px), ds/dZ (px/m), grey value; to be filled with NaN before.
    """
    a, b = np.empty(6), np.empty(6)
    for i in range(feet.shape[0]):
        for j in range(feet.shape[1]):
            if math.isnan(low[i, j]):
                continue
            for k in range(3):
                pl, pr, nl, nr = left[k, 3], right[k, 3], 0.0, 0.0
                for m in range(3):
                    pl += left[k, m] * feet[i, j, m]
                    pr += right[k, m] * feet[i, j, m]
                    nl += left[k, m] * normals[i, j, m]
                    nr += right[k, m] * normals[i, j, m]
                a[k], a[3 + k], b[k], b[3 + k] = pl, pr, nl, nr
            bottom, top = _clip(a, b, sizes, z_min, z_max)
            if top > bottom:
                span = low[i, j], high[i, j], bottom, top
                _cell(span, a, b, epipole, dcol, drow, image, limits, out[i, j])
