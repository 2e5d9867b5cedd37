"""Roots of s in the brackets that the search found, for many cells at once, and which of them stand.

See :mod:`rille.stages.terrain.locus.kernel`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rille.stages.terrain.locus.points import ACROSS, FX, FY, LANES, LINE, PIXEL, S, X, Y, Z, meet, pixels, raise_to

SOLVED_PX = 1e-3  # |s| of a solution: a hundredth of the disparity's own noise
TURNS = 16

STEP, Z0, S0, Z1, S1 = (k * LANES for k in range(13, 18))
"""Planes beside the lines: the search's step, and the bracket: s0 >= 0 at z0, s1 < 0 at z1."""
SIDE, OPEN, ROOT, UPWARDS, DOWNWARDS = (k * LANES for k in range(18, 23))
PLANES = 23


@njit(cache=True, nogil=True, error_model="numpy")
def roots(n, lanes, epipole, seen, room):  # type: ignore[no-untyped-def]
    """Regula falsi (Illinois); NaN at undefined disparity."""
    for m in range(n):
        lanes[SIDE + m], lanes[OPEN + m] = 0.0, 1.0
    for _ in range(TURNS):
        for m in range(n):
            z0, s0, z1, s1 = lanes[Z0 + m], lanes[S0 + m], lanes[Z1 + m], lanes[S1 + m]
            z = (z0 * s1 - z1 * s0) / (s1 - s0)
            lanes[Z + m] = z if lanes[OPEN + m] > 0.0 else lanes[Z + m]
        raise_to(lanes, n, seen.image.shape, room)
        meet(n, epipole, seen, room)
        if not _halve(n, lanes, room):
            break
    for m in range(n):
        lanes[ROOT + m] = lanes[Z + m]


@njit(cache=True, nogil=True, error_model="numpy")
def _halve(n, lanes, room):  # type: ignore[no-untyped-def]
    """Narrow each bracket by the point looked at; how many are not solved yet."""
    left = 0
    for m in range(n):
        s, z = pixels(room, S, m), lanes[Z + m]
        z0, s0, z1, s1, side = lanes[Z0 + m], lanes[S0 + m], lanes[Z1 + m], lanes[S1 + m], lanes[SIDE + m]
        still = (lanes[OPEN + m] > 0.0) & (abs(s) >= SOLVED_PX)
        lanes[OPEN + m] = 1.0 if still else 0.0
        left += 1 if still else 0
        free = s > 0.0
        # Illinois: an end that stays twice counts half, else the chord would creep towards the root from one side.
        lanes[Z0 + m], lanes[S0 + m] = (z if free else z0), (s if free else (s0 * 0.5 if side < 0.0 else s0))
        lanes[Z1 + m], lanes[S1 + m] = (z1 if free else z), ((s1 * 0.5 if side > 0.0 else s1) if free else s)
        lanes[SIDE + m] = 1.0 if free else -1.0
        lanes[Z + m] = z if s == s else np.nan
    return left


@njit(cache=True, nogil=True, error_model="numpy")
def slopes(n, lanes, epipole, seen, room):  # type: ignore[no-untyped-def]
    """One-sided ds/dZ at the roots, pixels per metre; leaves the roots' own points in ``room``."""
    for m in range(n):
        lanes[Z + m] = lanes[ROOT + m] + lanes[STEP + m]
    raise_to(lanes, n, seen.image.shape, room)
    meet(n, epipole, seen, room)
    for m in range(n):
        lanes[UPWARDS + m] = pixels(room, S, m) / lanes[STEP + m]
        lanes[Z + m] = lanes[ROOT + m] - lanes[STEP + m]
    raise_to(lanes, n, seen.image.shape, room)
    meet(n, epipole, seen, room)
    for m in range(n):
        lanes[DOWNWARDS + m] = -pixels(room, S, m) / lanes[STEP + m]
        # The roots themselves once more: their residual and grey value are read from the room of points.
        lanes[Z + m] = lanes[ROOT + m]
    raise_to(lanes, n, seen.image.shape, room)
    meet(n, epipole, seen, room)


@njit(cache=True, nogil=True, error_model="numpy")
def accept(n, found, cells, lanes, seen, room, out):  # type: ignore[no-untyped-def]
    """Write ``out`` of the roots that stand; leave the other lanes in front of ``found``, and return their number.

    ``found``: the search's lane of each; ``cells``: the row of ``out`` of each of those."""
    disparity, std, image, limits = seen
    width, count = image.shape[1], 0
    for m in range(n):
        s, across = pixels(room, S, m), pixels(room, ACROSS, m)
        residual = math.sqrt(s * s + across * across)
        # The lesser slope: beside a jump the other side is steep, and would make the elevation look certain.
        up, down = lanes[UPWARDS + m], lanes[DOWNWARDS + m]
        slope = up if down != down else (down if up != up else min(up, down))
        at = 2 * int(room[PIXEL + m])
        if residual <= limits[0] and slope > 0.0 and not _is_jump(at, at + 2 * width, disparity, limits[1]):
            c, r, fx, fy = int(room[X + m]), int(room[Y + m]), room[FX + m], room[FY + m]
            top = image[r, c] * (1.0 - fx) + image[r, c + 1] * fx
            bottom = image[r + 1, c] * (1.0 - fx) + image[r + 1, c + 1] * fx
            i, own = cells[found[m]], std[int(np.rint(room[Y + m])), int(np.rint(room[X + m]))]
            # sigma_Z = sigma_d / |ds/dZ|
            out[i, 0], out[i, 1], out[i, 2] = lanes[ROOT + m], own / slope, residual
            out[i, 3] = top * (1.0 - fy) + bottom * fy
        else:
            found[count] = found[m]  # count <= m: none is lost
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _is_jump(i, j, disparity, max_jump):  # type: ignore[no-untyped-def]
    """Whether the disparities of a bilinear cell differ by more than ``max_jump`` (a depth discontinuity)."""
    u = _range(disparity[i], disparity[i + 2], disparity[j], disparity[j + 2])
    v = _range(disparity[i + 1], disparity[i + 3], disparity[j + 1], disparity[j + 3])
    return u * u + v * v > max_jump * max_jump


@njit(cache=True, nogil=True, error_model="numpy")
def _range(a, b, c, d):  # type: ignore[no-untyped-def]
    return float(max(max(a, b), max(c, d))) - float(min(min(a, b), min(c, d)))


@njit(cache=True, nogil=True, error_model="numpy")
def gather(chosen, n, source, step, bracket, lanes):  # type: ignore[no-untyped-def]
    """Put the lines, steps and brackets (from plane ``bracket`` on) of ``n`` chosen lanes of the search in a row."""
    for t in range(n):
        m = chosen[t]
        for k in range(LINE):
            lanes[k * LANES + t] = source[k * LANES + m]
        lanes[STEP + t] = source[step + m]
        for k in range(4):
            lanes[Z0 + k * LANES + t] = source[bracket + k * LANES + m]
