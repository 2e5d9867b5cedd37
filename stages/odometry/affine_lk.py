"""Sub-pixel alignment of templates under a local affinity (refinement of tracked positions, section 5.2.1).

Feature vectors find *which* pixel corresponds. The grey values give the position within the pixel more exactly, once
the template is drawn in the perspective of the searched frame. Affine Lucas-Kanade with gain and offset, inverse
compositional: Baker and Matthews (2004), doi:10.1023/B:VISI.0000011205.11775.fd. The affinity that the neighbouring
tracks suggest is a prior, so that weak texture keeps to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.geometry.cubic import cubic

HALF = 5
"""Half the template's side: 11 x 11 pixels hold enough texture and still look plane."""
SIDE = 2 * HALF + 1
STEPS = 15
"""Most steps before a template is given up; five are usual."""
SETTLED = 0.01
"""Step [pixels] below which a template has converged: a tenth of the error that remains."""
UNKNOWNS = 8
"""Shift (2), affinity (4), offset, gain."""


class Templates(NamedTuple):
    """``points`` (n, 2) column, row in a; ``start`` (n, 2) where they are expected in b, NaN stays NaN; ``affinity``
    (n, 2, 2) expected derivative of b's coordinates by a's."""

    points: Floats
    start: Floats
    affinity: Floats


def align(
    a: Floats32, b: Floats32, templates: Templates, *, noise: float, spread: float, reach: float
) -> tuple[Floats, Floats]:
    """Align templates around points of ``a`` in ``b``.

    Parameters
    ----------
    a, b : (rows, cols) grey values.
    noise : grey levels, standard deviation of a difference.
    spread : standard deviation of an element of the affinity around the expected one.
    reach : pixels; a result farther than this from ``start`` is refused.

    Returns
    -------
    position : (n, 2) column, row in b; NaN where it leaves the image, does not converge or is refused.
    error : (n,) rms grey difference over the template before the last step; NaN likewise.
    """
    points = templates.points
    position, error = np.full(points.shape, np.nan), np.full(len(points), np.nan)
    _align_all(
        np.ascontiguousarray(a, dtype=np.float32),
        np.ascontiguousarray(b, dtype=np.float32),
        Templates(*(np.ascontiguousarray(v, dtype=np.float64) for v in templates)),
        # Weight of the prior in squared grey levels: variance of a grey difference over that of an element of the
        # affinity.
        (noise / spread) ** 2,
        float(reach),
        position,
        error,
    )
    return position, error


@njit(cache=True, nogil=True)
def _align_all(a, b, templates, ridge, reach, position, error):  # type: ignore[no-untyped-def]
    points, start, affinity = templates
    patch, template = np.empty((SIDE + 2) ** 2), np.empty(SIDE * SIDE)
    descent, grey = np.empty((SIDE * SIDE, UNKNOWNS)), np.empty(SIDE * SIDE)
    gram, step = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    for n in range(points.shape[0]):
        if not _descent(a, points[n, 0], points[n, 1], patch, template, descent):
            continue
        _gram(descent, ridge, gram)
        # Inverse compositional: derivatives are those of the template, so one factorisation serves all steps.
        if not _factor(gram):
            continue
        # Steps are composed into the copy; the prior pulls towards what was given.
        m = affinity[n].copy()
        x, y = start[n, 0], start[n, 1]
        for _ in range(STEPS):
            if not _warp(b, x, y, m, grey):
                break
            square = _right_side(grey, template, descent, step)
            _prior(affinity[n], m, ridge, step)
            _solve(gram, step)
            dx, dy = _compose(m, step)
            x -= dx
            y -= dy
            # Negated so that NaN, of a singular system, is refused as well.
            if not (abs(x - start[n, 0]) <= reach and abs(y - start[n, 1]) <= reach):
                break
            if abs(dx) < SETTLED and abs(dy) < SETTLED:
                position[n, 0], position[n, 1] = x, y
                error[n] = np.sqrt(square / (SIDE * SIDE))
                break


@njit(cache=True, nogil=True)
def _descent(a, x0, y0, patch, template, descent):  # type: ignore[no-untyped-def]
    """Template and derivatives of its grey values by the unknowns; False where it leaves the image."""
    # One pixel more on every side than the template, for its central differences.
    wide, far = SIDE + 2, HALF + 1
    if not (_holds(a, x0 - far, y0 - far) and _holds(a, x0 + far, y0 + far)):
        return False
    # At whole pixels the interpolating spline is the pixel itself.
    if x0 == np.floor(x0) and y0 == np.floor(y0):
        for i in range(wide * wide):
            patch[i] = a[int(y0) + i // wide - far, int(x0) + i % wide - far]
    else:
        for i in range(wide * wide):
            patch[i] = cubic(a, x0 + i % wide - far, y0 + i // wide - far)
    # Derivatives of the template's grey values g by the warp: shift (gx, gy), affinity (gx x, gx y, gy x, gy y).
    mean = 0.0
    for i in range(SIDE * SIDE):
        x, y = i % SIDE - HALF, i // SIDE - HALF
        at = (i // SIDE + 1) * wide + i % SIDE + 1
        gx, gy = 0.5 * (patch[at + 1] - patch[at - 1]), 0.5 * (patch[at + wide] - patch[at - wide])
        template[i] = patch[at]
        mean += patch[at]
        descent[i, 0], descent[i, 1] = gx, gy
        descent[i, 2], descent[i, 3], descent[i, 4], descent[i, 5] = gx * x, gx * y, gy * x, gy * y
        descent[i, 6] = 1.0
    for i in range(SIDE * SIDE):
        # Gain about the mean: its derivative is then orthogonal to that of the offset.
        descent[i, 7] = template[i] - mean / (SIDE * SIDE)
    return True


@njit(cache=True, nogil=True)
def _warp(b, x0, y0, m, grey):  # type: ignore[no-untyped-def]
    """Grey values under the template; False where one of its corners, and so it, leaves the image."""
    # An affinity makes a parallelogram of the square: inside with its corners inside.
    for j in (-HALF, HALF):
        for i in (-HALF, HALF):
            if not _holds(b, x0 + m[0, 0] * i + m[0, 1] * j, y0 + m[1, 0] * i + m[1, 1] * j):
                return False
    k = 0
    for j in range(-HALF, HALF + 1):
        for i in range(-HALF, HALF + 1):
            grey[k] = cubic(b, x0 + m[0, 0] * i + m[0, 1] * j, y0 + m[1, 0] * i + m[1, 1] * j)
            k += 1
    return True


@njit(cache=True, nogil=True)
def _right_side(grey, template, descent, out):  # type: ignore[no-untyped-def]
    """Differences of grey values to the template, projected on the derivatives; returns their sum of squares."""
    square = o0 = o1 = o2 = o3 = o4 = o5 = o6 = o7 = 0.0
    for i in range(SIDE * SIDE):
        d = grey[i] - template[i]
        r = descent[i]
        square += d * d
        o0, o1, o2, o3 = o0 + r[0] * d, o1 + r[1] * d, o2 + r[2] * d, o3 + r[3] * d
        o4, o5, o6, o7 = o4 + r[4] * d, o5 + r[5] * d, o6 + r[6] * d, o7 + r[7] * d
    out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7] = o0, o1, o2, o3, o4, o5, o6, o7
    return square


@njit(cache=True, nogil=True)
def _prior(expected, m, ridge, out):  # type: ignore[no-untyped-def]
    """Pull towards the expected affinity: how far ``expected^-1 m`` is from the identity."""
    det = expected[0, 0] * expected[1, 1] - expected[0, 1] * expected[1, 0]
    for j in range(2):
        first = (expected[1, 1] * m[0, j] - expected[0, 1] * m[1, j]) / det
        second = (expected[0, 0] * m[1, j] - expected[1, 0] * m[0, j]) / det
        # Added, not subtracted: a step is composed inversely, so what the affinity has too much counts like a grey
        # difference.
        out[2 + j] += ridge * (first - (1.0 - j))
        out[4 + j] += ridge * (second - j)


@njit(cache=True, nogil=True)
def _gram(descent, ridge, out):  # type: ignore[no-untyped-def]
    """Products of the derivatives, summed over the template, with the prior of the affinity."""
    out[:] = 0.0
    for i in range(SIDE * SIDE):
        r = descent[i]
        # Values in registers first: stores to ``out`` might change ``r`` for all that the compiler knows.
        v = (r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7])
        for j in range(UNKNOWNS):
            o, w = out[j], r[j]
            o[0], o[1], o[2], o[3] = o[0] + w * v[0], o[1] + w * v[1], o[2] + w * v[2], o[3] + w * v[3]
            o[4], o[5], o[6], o[7] = o[4] + w * v[4], o[5] + w * v[5], o[6] + w * v[6], o[7] + w * v[7]
    for k in range(2, 6):
        out[k, k] += ridge


@njit(cache=True, nogil=True)
def _compose(m, step):  # type: ignore[no-untyped-def]
    """Compose the affinity with the inverse of a step, in place; returns the shift of the position to subtract."""
    det = (1.0 + step[2]) * (1.0 + step[5]) - step[3] * step[4]
    for i in range(2):
        p, q = m[i, 0], m[i, 1]
        m[i, 0] = (p * (1.0 + step[5]) - q * step[4]) / det
        m[i, 1] = (q * (1.0 + step[2]) - p * step[3]) / det
    return m[0, 0] * step[0] + m[0, 1] * step[1], m[1, 0] * step[0] + m[1, 1] * step[1]


@njit(cache=True, nogil=True)
def _factor(a):  # type: ignore[no-untyped-def]
    """Factors of a symmetric positive matrix in place, by Gauss: multipliers below, pivots' inverses on the diagonal.

    False where it is singular.
    """
    n = a.shape[0]
    for i in range(n):
        # Sums of squared grey differences this small are rounding: the template is flat, or has one direction only.
        if not a[i, i] > 1e-9:
            return False
        a[i, i] = 1.0 / a[i, i]
        for j in range(i + 1, n):
            # No pivoting: the matrix is symmetric and positive, and all templates round alike.
            f = a[j, i] * a[i, i]
            a[j, i] = f
            for k in range(i + 1, n):
                a[j, k] -= f * a[i, k]
    return True


@njit(cache=True, nogil=True)
def _solve(factors, b):  # type: ignore[no-untyped-def]
    """Solve in place by the factors of :func:`_factor`."""
    n = b.shape[0]
    for i in range(n):
        for j in range(i + 1, n):
            b[j] -= factors[j, i] * b[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= factors[i, k] * b[k]
        b[i] *= factors[i, i]


@njit(cache=True, nogil=True, inline="always")
def _holds(image, x, y):  # type: ignore[no-untyped-def]
    """Whether all that cubic interpolation reads lies in the image."""
    return 1.0 <= x < image.shape[1] - 2.0 and 1.0 <= y < image.shape[0] - 2.0
