"""Relief: sub-pixel displacements of all matches at once, piecewise smooth and along epipolar lines.

Windows trade noise against relief, and each solves for a row displacement that the geometry of the rig already knows.
Here the displacements (u, v) of all matched pixels minimise

    sum w (r - g . (du, dv))^2  +  k (distance from the epipolar line)^2  +  stiffness sum s |second difference|^2

with r the difference of the left image and the right one warped by the last step, free of its robust local mean; g the
warped gradient, both of the cubic spline through the pixels, which keeps detail that a local cubic kernel blurs; w
falling with r and s with the second difference found, so that neither a wrong pixel nor an edge drags its neighbours
along. Stiffness starts weak and tolerant of bends: from the first, it would take the errors that windows make beside
edges for relief. The lines are fitted to the matches themselves (:mod:`rille.stages.hfvm.level.epipolar`); k gives way
where they do not lie on lines. Solved by a fixed number of Gauss-Seidel sweeps in reading order.
"""

from __future__ import annotations

import numpy as np
import scipy
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.coarse_to_fine.hierarchy import evenly
from rille.stages.hfvm.finish.refine import FARTHEST
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.level import epipolar
from rille.stages.numeric.windows import window_sum

MEAN_SIDE = 9
"""Pixels: window of the local mean; brightness varies more slowly."""
MEAN_ROUNDS = 2
"""Weightings of the mean: what lies across an edge counts for little, and one round does not yet tell it apart."""

LEAST_WEIGHT = 0.1
"""Pixels: least weight of a mean; windows with less have no pixel that takes part."""

RESIDUAL = 10.0
"""Grey levels: residual that halves a pixel's weight, well above camera noise."""

LINE = 1000.0
"""Squared grey levels for a pixel off the line: more than the strongest texture says."""

SHARP = 0.05
"""Pixels: median distance from the lines up to which they are trusted fully; beyond it by its inverse square."""

FIT_SAMPLES = 4000
SWEEPS = 20
OVERSHOOT = 1.7
"""Factor on each Gauss-Seidel step (successive over-relaxation), which stays convergent below 2."""

SOFT_STEPS, SOFT_STIFFNESS, SOFT_BEND = 3, 0.15, 2.0
"""Number of the first, soft steps, and their factors on stiffness and bend."""
FULL_STEPS = 4
"""Steps with full stiffness after them; where there are fewer steps in all, soft ones are left out first."""


def fit(
    left: AnyArray,
    right: AnyArray,
    right_valid: AnyArray,
    u: AnyArray,
    v: AnyArray,
    keep: AnyArray,
    params: HfvmParams,
) -> tuple[AnyArray, AnyArray]:
    """Displacements of the relief that fits best.

    Parameters
    ----------
    left, right : (row, col) float32 grey values.
    right_valid : (row, col) uint8, 1 = usable.
    u, v : (row, col) float32 displacements to start from, pixels.
    keep : (row, col) bool, pixels to use and to improve; the others are returned as they are.

    Notes
    -----
    A pixel that is led farther than :data:`rille.stages.hfvm.finish.refine.FARTHEST` from where it started stays there.
    Only the way along its line counts: a match that was found rows off its line is on the same thing more often than
    not, and the lines know its row.
    """
    start_u, start_v = u, v
    u, v = np.where(keep, u, np.float32(0)), np.where(keep, v, np.float32(0))
    spline = scipy.ndimage.spline_filter(right, 3, np.float32, mode="mirror")
    lines = None
    for step in range(params.relief_steps):
        soft = step < min(SOFT_STEPS, params.relief_steps - FULL_STEPS)
        stiffness = params.relief_stiffness * (SOFT_STIFFNESS if soft else 1.0)
        bend = params.relief_bend * (SOFT_BEND if soft else 1.0)
        a, b, c, p, q = _normal(left, spline, right_valid, u, v, keep)
        lines = _lines(u, v, keep, right.shape)
        if lines is not None:
            _hold_to_lines(*lines, u, v, keep, a, b, c, p, q)
        across, down = np.zeros(u.shape, np.float32), np.zeros(u.shape, np.float32)
        _stiffness(u, v, keep, np.float32(bend), np.float32(stiffness), across, down)
        new_u, new_v = u.copy(), v.copy()
        _solve(a, b, c, p, q, keep, across, down, SWEEPS, np.float32(OVERSHOOT), u, v, new_u, new_v)
        u, v = new_u, new_v
    if lines is not None:
        start_u, start_v = _feet(*lines, start_u, start_v, keep)
    good = keep & (np.hypot(u - start_u, v - start_v) <= FARTHEST)
    return np.where(good, u, start_u), np.where(good, v, start_v)


def _normal(
    left: AnyArray, spline: AnyArray, right_valid: AnyArray, u: AnyArray, v: AnyArray, keep: AnyArray
) -> tuple[AnyArray, ...]:
    """Terms a, b, c, p, q of each pixel's normal equations (a b; b c) (du, dv) = (p, q) of the grey values."""
    planes = np.zeros((4, *u.shape), np.float32)
    _warped(left, spline, right_valid, u, v, keep, planes)
    known, gx, gy, rest = planes
    mean, weight = np.zeros_like(rest), known
    for _ in range(MEAN_ROUNDS + 1):
        mean = window_sum(weight * rest, MEAN_SIDE) / np.maximum(window_sum(weight, MEAN_SIDE), LEAST_WEIGHT)
        weight = (known / (1.0 + ((rest - mean) / RESIDUAL) ** 2)).astype(np.float32)
    rest = np.where(known > 0, rest - mean, 0.0).astype(np.float32)
    wx, wy = weight * gx, weight * gy
    return wx * gx, wx * gy, wy * gy, wx * rest, wy * rest


@njit(cache=True, nogil=True)
def _warped(left, spline, right_valid, u, v, keep, out):  # type: ignore[no-untyped-def]
    """Planes: 1 where a pixel takes part, gradient (x, y) of the warped right image, left minus right; else zero.

    ``spline``: coefficients of the right image's cubic spline.
    """
    rows, cols = left.shape
    last_x, last_y, half = spline.shape[1] - 2, spline.shape[0] - 2, np.float32(0.5)
    w, slope = np.empty((2, 4), np.float32), np.empty((2, 4), np.float32)
    for y in range(rows):
        for x in range(cols):
            xr, yr = np.float32(x) + u[y, x], np.float32(y) + v[y, x]
            if not (keep[y, x] and xr >= 1 and xr < last_x and yr >= 1 and yr < last_y):
                continue
            if not right_valid[np.int64(yr + half), np.int64(xr + half)]:
                continue
            i, j = np.int64(xr), np.int64(yr)
            _weights(xr - np.float32(i), w[0], slope[0])
            _weights(yr - np.float32(j), w[1], slope[1])
            value = gx = gy = np.float32(0.0)
            for k in range(4):
                across = along = np.float32(0.0)
                for m in range(4):
                    c = spline[j - 1 + k, i - 1 + m]
                    across += w[0, m] * c
                    along += slope[0, m] * c
                value += w[1, k] * across
                gx += w[1, k] * along
                gy += slope[1, k] * across
            out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x] = 1, gx, gy, left[y, x] - value


@njit(cache=True, nogil=True)
def _weights(t, w, slope):  # type: ignore[no-untyped-def]
    """Weights of the cubic B-spline's coefficients at -1, 0, 1, 2 for a point at ``t``, and their derivatives."""
    half, one, two, three = np.float32(0.5), np.float32(1.0), np.float32(2.0), np.float32(3.0)
    four, six = np.float32(4.0), np.float32(6.0)
    q = one - t
    w[0], w[3] = q * q * q / six, t * t * t / six
    w[1], w[2] = (four - three * t * t * (two - t)) / six, (four - three * q * q * (two - q)) / six
    slope[0], slope[3] = -half * q * q, half * t * t
    slope[1], slope[2] = half * t * (three * t - four), -half * q * (three * q - four)


def _lines(u: AnyArray, v: AnyArray, keep: AnyArray, right_shape: tuple[int, int]) -> tuple[AnyArray, float] | None:
    """Epipolar lines (row, col, 3) fitted to the matches, and how far to trust them, 0..1; None: not determined."""
    found = epipolar.fit(u, v, evenly(keep, FIT_SAMPLES), right_shape)
    if found is None:
        return None
    return epipolar.lines(found[0], u.shape), min(1.0, (SHARP / max(found[1], 1e-9)) ** 2)


def _off(lines: AnyArray, u: AnyArray, v: AnyArray) -> AnyArray:
    """Signed distance from the line, pixels."""
    return np.asarray(lines[..., 0] * u + lines[..., 1] * v + lines[..., 2])


def _hold_to_lines(lines: AnyArray, trust: float, u: AnyArray, v: AnyArray, keep: AnyArray, *terms: AnyArray) -> None:
    """Add the squared distance from the epipolar lines to the normal equations, in place."""
    a, b, c, p, q = terms
    x, y, e = lines[..., 0], lines[..., 1], _off(lines, u, v)
    k = np.where(keep, np.float32(LINE * trust), np.float32(0))
    a += k * x * x
    b += k * x * y
    c += k * y * y
    p -= k * x * e
    q -= k * y * e


def _feet(lines: AnyArray, trust: float, u: AnyArray, v: AnyArray, keep: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Kept displacements moved to their lines as far as those are trusted; the others as they are."""
    e = np.where(keep, np.float32(trust) * _off(lines, u, v), np.float32(0))
    return u - e * lines[..., 0], v - e * lines[..., 1]


@njit(cache=True, nogil=True)
def _stiffness(u, v, keep, bend, stiffness, across, down):  # type: ignore[no-untyped-def]
    """Weight of the second difference at each pixel along its row and column, 0 where a neighbour is unknown."""
    rows, cols = u.shape
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
def _solve(a, b, c, p, q, keep, across, down, sweeps, overshoot, u0, v0, u, v):  # type: ignore[no-untyped-def]
    """Gauss-Seidel sweeps on ``u, v`` in place; the grey values' terms are those at ``u0, v0``.

    A pixel takes part in three second differences of its row and three of its column: as their middle, where it counts
    twice, and as either end. ``s``, ``su``, ``sv``: their weights, and weighted values they want.
    """
    rows, cols = u.shape
    two, four = np.float32(2.0), np.float32(4.0)
    for _ in range(sweeps):
        for y in range(rows):
            for x in range(cols):
                if not keep[y, x]:
                    continue
                s = su = sv = np.float32(0.0)
                k = across[y, x]
                if k > 0:
                    s += four * k
                    su += two * k * (u[y, x - 1] + u[y, x + 1])
                    sv += two * k * (v[y, x - 1] + v[y, x + 1])
                k = down[y, x]
                if k > 0:
                    s += four * k
                    su += two * k * (u[y - 1, x] + u[y + 1, x])
                    sv += two * k * (v[y - 1, x] + v[y + 1, x])
                for side in (-1, 1):
                    i, j = x + side, y + side
                    if i > 0 and i < cols - 1:
                        k = across[y, i]
                        if k > 0:
                            s += k
                            su += k * (two * u[y, i] - u[y, i + side])
                            sv += k * (two * v[y, i] - v[y, i + side])
                    if j > 0 and j < rows - 1:
                        k = down[j, x]
                        if k > 0:
                            s += k
                            su += k * (two * u[j, x] - u[j + side, x])
                            sv += k * (two * v[j, x] - v[j + side, x])
                m, n, o = a[y, x] + s, b[y, x], c[y, x] + s
                right_u = a[y, x] * u0[y, x] + n * v0[y, x] + p[y, x] + su
                right_v = n * u0[y, x] + c[y, x] * v0[y, x] + q[y, x] + sv
                det = m * o - n * n
                if det > np.float32(1.0):
                    u[y, x] += overshoot * ((o * right_u - n * right_v) / det - u[y, x])
                    v[y, x] += overshoot * ((m * right_v - n * right_u) / det - v[y, x])
