"""Relief: sub-pixel displacements of all matches at once, piecewise smooth and along epipolar lines.

Windows trade noise against relief, and each solves for a row displacement that the geometry of the rig already knows.
Here the displacements (u, v) of all matched pixels minimise

    sum w (r - g . (du, dv))^2  +  k (distance from the epipolar line)^2  +  stiffness sum s |second difference|^2

with r the difference of the left image and the right one warped by the last step, free of its robust local mean; g the
warped gradient, both of the cubic spline through the pixels, which keeps detail that a local cubic kernel blurs; w
falling with r and s with the second difference found, so that neither a wrong pixel nor an edge drags its neighbours
along. Stiffness starts weak and tolerant of bends: from the first, it would take the errors that windows make beside
edges for relief. The lines are fitted to the matches themselves (:mod:`rille.stages.hfvm.epipolar`); k gives way
where they do not lie on lines. Solved by a fixed number of Gauss-Seidel sweeps in reading order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.geometry.spline import slopes, weights
from rille.stages.hfvm import epipolar
from rille.stages.hfvm.lucas_kanade import MAX_CORRECTION_PX, SplineImages
from rille.stages.hfvm.windows import thinned
from rille.stages.numeric.relaxation import OVERRELAXATION
from rille.stages.numeric.windows import window_sum

MEAN_SIDE_PX = 9
"""Pixels: window of the local mean; brightness varies more slowly."""

HALVING_RESIDUAL_GREY = 10.0
"""Grey levels: residual that halves a pixel's weight, well above camera noise."""

LINE_STIFFNESS = 1000.0
"""Squared grey levels for a pixel off the line: more than the strongest texture says."""

TRUSTED_SPREAD_PX = 0.05
"""Pixels: median distance from the lines up to which they are trusted fully; beyond it by its inverse square."""

MAX_FIT_MATCHES = 4000

BEND_STIFFNESS = 2000.0
"""Cost, squared grey levels, of a bend of one pixel; larger: smoother, small relief lost."""

MAX_BEND_PX = 0.05
"""Second difference, pixels, beyond which the stiffness gives way to an edge."""


RELIEF_STEPS = 4
"""Four steps instead of seven: the median error of the judged half is .165 px instead of .160."""


def fit(images: SplineImages, u: AnyArray, v: AnyArray, keep: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Displacements of the relief that fits best.

    Parameters
    ----------
    u, v : (row, col) float32 displacements to start from, pixels.
    keep : (row, col) bool, pixels to use and to improve; the others are returned as they are.

    Notes
    -----
    A pixel that is led farther than :data:`rille.stages.hfvm.lucas_kanade.MAX_CORRECTION_PX` from where it started
    stays there. Only the way along its line counts: a match that was found rows off its line is on the same thing more
    often than not, and the lines know its row.
    """
    start_u, start_v = u, v
    u, v = np.where(keep, u, np.float32(0)), np.where(keep, v, np.float32(0))
    lines, trust = _lines(u, v, keep, images.spline.shape)
    holds = lines * np.float32(np.sqrt(LINE_STIFFNESS * trust))
    for step in range(RELIEF_STEPS):
        soft = step < RELIEF_STEPS // 2
        stiffness, bend = BEND_STIFFNESS * (0.15 if soft else 1.0), MAX_BEND_PX * (2.0 if soft else 1.0)
        grey = _grey(images, u, v, keep)
        stiff, normal = np.zeros((2, *u.shape), np.float32), np.zeros((5, *u.shape), np.float32)
        _stiffness(u, v, keep, np.float32(bend), np.float32(stiffness), stiff)
        _normal(grey, u, v, holds, keep, stiff, normal)
        u, v = _solve(normal, stiff, u, v)
    if trust > 0:
        start_u, start_v = _feet(lines, trust, start_u, start_v, keep)
    good = keep & (np.hypot(u - start_u, v - start_v) <= MAX_CORRECTION_PX)
    return np.where(good, u, start_u), np.where(good, v, start_v)


def _grey(images: SplineImages, u: AnyArray, v: AnyArray, keep: AnyArray) -> AnyArray:
    """Planes (4, row, col): weight of each pixel, gradient (x, y) of the warped right image, difference of the images
    free of its local mean; weight 0 where a pixel does not take part."""
    planes = np.zeros((4, *u.shape), np.float32)
    _warped(images, u, v, keep, planes)
    known, _, _, rest = planes
    mean, weight = np.zeros_like(rest), known
    # The first mean is of equal weights; what lies across an edge then counts for little, but one weighting does not
    # yet tell it apart.
    for _ in range(3):
        # Windows with less than a tenth of a pixel's weight have no pixel that takes part.
        mean = window_sum(weight * rest, MEAN_SIDE_PX) / np.maximum(window_sum(weight, MEAN_SIDE_PX), 0.1)
        weight = known / (np.float32(1.0) + ((rest - mean) * np.float32(1.0 / HALVING_RESIDUAL_GREY)) ** 2)
    planes[0] = weight
    planes[3] -= mean
    return planes


@njit(cache=True, nogil=True)
def _warped(images, u, v, keep, out):  # type: ignore[no-untyped-def]
    """Planes: 1 where a pixel takes part, gradient (x, y) of the warped right image, left minus right; else zero.

    ``spline``: coefficients of the right image's cubic spline.
    """
    left, spline, right_valid = images.left, images.spline, images.valid
    rows, cols = left.shape
    last_x, last_y, half = spline.shape[1] - 2, spline.shape[0] - 2, np.float32(0.5)
    for y in range(rows):
        for x in range(cols):
            xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
            if not (keep[y, x] and xr >= 1 and xr < last_x and yr >= 1 and yr < last_y):
                continue
            if not right_valid[np.int64(yr + half), np.int64(xr + half)]:
                continue
            i, j = np.int64(xr), np.int64(yr)
            t, s = xr - np.float32(i), yr - np.float32(j)
            wx, wy, dx, dy = weights(t), weights(s), slopes(t), slopes(s)
            value = gx = gy = np.float32(0.0)
            for k in range(4):
                across = along = np.float32(0.0)
                for m in range(4):
                    c = spline[j - 1 + k, i - 1 + m]
                    across += wx[m] * c
                    along += dx[m] * c
                value += wy[k] * across
                gx += wy[k] * along
                gy += dy[k] * across
            out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x] = 1, gx, gy, left[y, x] - value


def _lines(u: AnyArray, v: AnyArray, keep: AnyArray, right_shape: tuple[int, int]) -> tuple[AnyArray, float]:
    """Epipolar lines (row, col, 3) fitted to the matches, and how far to trust them, 0..1; 0 where not determined."""
    y, x = thinned(keep, MAX_FIT_MATCHES)
    fit = epipolar.fit_points(x, y, u[y, x], v[y, x], keep.shape, right_shape)
    if fit is None:
        return np.zeros((*u.shape, 3), np.float32), 0.0
    return epipolar.lines(fit[0], u.shape), min(1.0, (TRUSTED_SPREAD_PX / max(fit[1], 1e-9)) ** 2)


def _off(lines: AnyArray, u: AnyArray, v: AnyArray) -> AnyArray:
    """Signed distance from the line, pixels."""
    return np.asarray(lines[..., 0] * u + lines[..., 1] * v + lines[..., 2])


def _feet(lines: AnyArray, trust: float, u: AnyArray, v: AnyArray, keep: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Kept displacements moved to their lines as far as those are trusted; the others as they are."""
    e = np.where(keep, np.float32(trust) * _off(lines, u, v), np.float32(0))
    return u - e * lines[..., 0], v - e * lines[..., 1]


@njit(cache=True, nogil=True)
def _stiffness(u, v, keep, bend, stiffness, out):  # type: ignore[no-untyped-def]
    """Weight of the second difference at each pixel along its row and column, 0 where a neighbour is unknown."""
    rows, cols = u.shape
    across, down = out
    for y in range(rows):
        for x in range(cols):
            if not keep[y, x]:
                continue
            if x > 0 and x < cols - 1 and keep[y, x - 1] and keep[y, x + 1]:
                d = u[y, x - 1] - u[y, x] + u[y, x + 1] - u[y, x]
                e = v[y, x - 1] - v[y, x] + v[y, x + 1] - v[y, x]
                across[y, x] = stiffness / (np.float32(1.0) + (d * d + e * e) / (bend * bend))
            if y > 0 and y < rows - 1 and keep[y - 1, x] and keep[y + 1, x]:
                d = u[y - 1, x] - u[y, x] + u[y + 1, x] - u[y, x]
                e = v[y - 1, x] - v[y, x] + v[y + 1, x] - v[y, x]
                down[y, x] = stiffness / (np.float32(1.0) + (d * d + e * e) / (bend * bend))


@njit(cache=True, nogil=True)
def _normal(grey, u, v, holds, keep, stiff, out):  # type: ignore[no-untyped-def]
    """What the sweeps need of each pixel's normal equations (m n; n o) (u, v) = (p, q) + what its neighbours want.

    ``out`` (5, row, col): o / det, n / det, m / det, p, q; zero where a pixel stays as it is. ``grey``: of
    :func:`_grey`; ``holds``: lines whose distance is in grey levels.
    """
    rows, cols = u.shape
    four = np.float32(4.0)
    for y in range(rows):
        for x in range(cols):
            if not keep[y, x]:
                continue
            w, gx, gy, rest = grey[0, y, x], grey[1, y, x], grey[2, y, x], grey[3, y, x]
            lx, ly, off = holds[y, x, 0], holds[y, x, 1], holds[y, x, 2]
            a, b, c = w * gx * gx + lx * lx, w * gx * gy + lx * ly, w * gy * gy + ly * ly
            # Of the squared distance from the line only its offset is left: the displacement itself cancels.
            warp = gx * u[y, x] + gy * v[y, x] + rest
            p, q = w * gx * warp - lx * off, w * gy * warp - ly * off
            s = four * (stiff[0, y, x] + stiff[1, y, x])
            s += (stiff[0, y, x - 1] if x > 0 else 0) + (stiff[0, y, x + 1] if x < cols - 1 else 0)
            s += (stiff[1, y - 1, x] if y > 0 else 0) + (stiff[1, y + 1, x] if y < rows - 1 else 0)
            m, o = a + s, c + s
            det = m * o - b * b
            # Else hardly any texture, line or neighbour holds the pixel, and it stays.
            if det > np.float32(1.0):
                out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x], out[4, y, x] = o / det, b / det, m / det, p, q


def _solve(normal: AnyArray, stiff: AnyArray, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Displacements after ten Gauss-Seidel sweeps; zeros stand for the neighbours of the border."""
    u, v, across, down = (np.pad(a, 2) for a in (u, v, *stiff))
    _sweep(normal, across, down, u, v)
    return np.ascontiguousarray(u[2:-2, 2:-2]), np.ascontiguousarray(v[2:-2, 2:-2])


@njit(cache=True, nogil=True)
def _sweep(normal, across, down, u, v):  # type: ignore[no-untyped-def]
    """Gauss-Seidel sweeps on ``u, v`` in place; all but ``normal`` have a frame of two pixels.

    A pixel takes part in three second differences of its row and three of its column: as their middle, where it counts
    twice, and as either end. ``su``, ``sv``: the weighted values that they want.
    """
    _, rows, cols = normal.shape
    two, overshoot = np.float32(2.0), np.float32(OVERRELAXATION)
    for _ in range(10):
        for y in range(rows):
            minor_v, cross, minor_u, p, q = normal[0, y], normal[1, y], normal[2, y], normal[3, y], normal[4, y]
            k, k_up, k_own, k_down = across[y + 2], down[y + 1, 2:], down[y + 2, 2:], down[y + 3, 2:]
            uo, u1, u2, u3, u4 = u[y + 2], u[y, 2:], u[y + 1, 2:], u[y + 3, 2:], u[y + 4, 2:]
            vo, v1, v2, v3, v4 = v[y + 2], v[y, 2:], v[y + 1, 2:], v[y + 3, 2:], v[y + 4, 2:]
            for x in range(cols):
                # Zero marks a pixel that stays: elsewhere it is positive.
                if minor_v[x] == 0:
                    continue
                kw, ko, ke, ku, kc, kd = k[x + 1], two * k[x + 2], k[x + 3], k_up[x], two * k_own[x], k_down[x]
                su = p[x] + (kc * (u2[x] + u3[x]) + ku * (two * u2[x] - u1[x]) + kd * (two * u3[x] - u4[x]))
                sv = q[x] + (kc * (v2[x] + v3[x]) + ku * (two * v2[x] - v1[x]) + kd * (two * v3[x] - v4[x]))
                su += ke * (two * uo[x + 3] - uo[x + 4]) + ko * uo[x + 3] - kw * uo[x] + (ko + two * kw) * uo[x + 1]
                sv += ke * (two * vo[x + 3] - vo[x + 4]) + ko * vo[x + 3] - kw * vo[x] + (ko + two * kw) * vo[x + 1]
                uo[x + 2] += overshoot * (minor_v[x] * su - cross[x] * sv - uo[x + 2])
                vo[x + 2] += overshoot * (minor_u[x] * sv - cross[x] * su - vo[x + 2])
