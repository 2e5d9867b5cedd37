"""Sub-pixel alignment of templates under a local affinity (refinement of tracked positions, section 5.2.1).

Feature vectors find *which* pixel corresponds; where in the pixel is better told by the grey values themselves, once
the template is drawn in the perspective of the searched frame. Affine Lucas-Kanade with gain and offset, inverse
compositional: Baker and Matthews (2004), doi:10.1023/B:VISI.0000011205.11775.fd. The affinity that the neighbouring
tracks suggest is a prior, so that weak texture keeps to it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stages.cubic import cubic
from stages.line import copy_line

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HALF = 5
"""Half the template's side: 11 x 11 pixels hold enough texture and still look plane."""
SIDE = 2 * HALF + 1
STEPS = 15
"""Steps before a template is given up; five are usual."""
SETTLED = 0.01
"""Pixels: a last step below this is a tenth of the error that remains."""
UNKNOWNS = 8
"""Shift (2), affinity (4), offset, gain."""


def align(
    a: F32, b: F32, points: F64, start: F64, affinity: F64, *, noise: float, spread: float, reach: float
) -> tuple[F64, F64]:
    """Align templates around points of ``a`` in ``b``.

    Parameters
    ----------
    a, b : (rows, cols) grey values.
    points, start : (n, 2) column, row in a, and where they are expected in b; NaN stays NaN.
    affinity : (n, 2, 2) expected derivative of b's coordinates by a's.
    noise : grey levels, standard deviation of a difference.
    spread : standard deviation of an element of the affinity around the expected one.
    reach : pixels; a result farther than this from ``start`` is refused.

    Returns
    -------
    position : (n, 2) column, row in b; NaN where it leaves the image, does not settle or is refused.
    error : (n,) rms grey difference over the template before the last step; NaN likewise.
    """
    position, error = np.full(points.shape, np.nan), np.full(len(points), np.nan)
    _align_all(
        np.ascontiguousarray(a, dtype=np.float32),
        np.ascontiguousarray(b, dtype=np.float32),
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(start, dtype=np.float64),
        np.ascontiguousarray(affinity, dtype=np.float64),
        (noise / spread) ** 2,
        float(reach),
        position,
        error,
    )
    return position, error


@njit(cache=True, nogil=True)
def _align_all(a, b, points, start, affinity, ridge, reach, position, error):  # type: ignore[no-untyped-def]
    patch, template = np.empty((SIDE + 2) ** 2), np.empty(SIDE * SIDE)
    descent = np.empty((SIDE * SIDE, UNKNOWNS))
    gram, normal, step = np.empty((UNKNOWNS, UNKNOWNS)), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    for n in range(points.shape[0]):
        if not _descent(a, points[n, 0], points[n, 1], patch, template, descent):
            continue
        _gram(descent, ridge, gram)
        m = affinity[n].copy()
        x, y = start[n, 0], start[n, 1]
        for _ in range(STEPS):
            square = _right_side(b, x, y, m, template, descent, step)
            _prior(affinity[n], m, ridge, step)
            for k in range(UNKNOWNS):
                copy_line(gram[k], normal[k])
            if not _solve(normal, step):
                break
            dx, dy = _compose(m, step)
            x -= dx
            y -= dy
            if not (abs(x - start[n, 0]) <= reach and abs(y - start[n, 1]) <= reach):
                break
            if abs(dx) < SETTLED and abs(dy) < SETTLED:
                position[n, 0], position[n, 1] = x, y
                error[n] = np.sqrt(square / (SIDE * SIDE))
                break


@njit(cache=True, nogil=True)
def _descent(a, x0, y0, patch, template, descent):  # type: ignore[no-untyped-def]
    """Template and derivatives of its grey values by the unknowns; False where it leaves the image."""
    wide = SIDE + 2
    total = 0.0
    on_grid = x0 == np.floor(x0) and y0 == np.floor(y0)
    if on_grid and _holds(a, x0 - HALF - 1, y0 - HALF - 1) and _holds(a, x0 + HALF + 1, y0 + HALF + 1):
        for i in range(wide * wide):
            patch[i] = a[int(y0) + i // wide - HALF - 1, int(x0) + i % wide - HALF - 1]
            total += patch[i]
    else:
        for i in range(wide * wide):
            patch[i] = _grey(a, x0 + i % wide - HALF - 1, y0 + i // wide - HALF - 1)
            total += patch[i]
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
        descent[i, 7] = template[i] - mean / (SIDE * SIDE)
    return total == total


@njit(cache=True, nogil=True)
def _right_side(b, x0, y0, m, template, descent, out):  # type: ignore[no-untyped-def]
    """Differences of the warped image to the template, projected on the derivatives; returns their sum of squares."""
    out[:] = 0.0
    square = 0.0
    for i in range(SIDE * SIDE):
        x, y = i % SIDE - HALF, i // SIDE - HALF
        grey = _grey(b, x0 + m[0, 0] * x + m[0, 1] * y, y0 + m[1, 0] * x + m[1, 1] * y)
        d = grey - template[i]
        square += d * d
        for k in range(UNKNOWNS):
            out[k] += descent[i, k] * d
    return square


@njit(cache=True, nogil=True)
def _prior(expected, m, ridge, out):  # type: ignore[no-untyped-def]
    """Pull towards the expected affinity: how far ``expected^-1 m`` is from the identity."""
    det = expected[0, 0] * expected[1, 1] - expected[0, 1] * expected[1, 0]
    for j in range(2):
        first = (expected[1, 1] * m[0, j] - expected[0, 1] * m[1, j]) / det
        second = (expected[0, 0] * m[1, j] - expected[1, 0] * m[0, j]) / det
        out[2 + j] += ridge * (first - (1.0 - j))
        out[4 + j] += ridge * (second - j)


@njit(cache=True, nogil=True)
def _gram(descent, ridge, out):  # type: ignore[no-untyped-def]
    out[:] = 0.0
    for i in range(SIDE * SIDE):
        row = descent[i]
        for j in range(UNKNOWNS):
            for k in range(UNKNOWNS):
                out[j, k] += row[j] * row[k]
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
def _solve(a, b):  # type: ignore[no-untyped-def]
    """Solve a x = b in place for a symmetric positive matrix (Gauss); False where it is singular."""
    n = b.shape[0]
    for i in range(n):
        if not a[i, i] > 1e-9:
            return False
        for j in range(i + 1, n):
            f = a[j, i] / a[i, i]
            for k in range(i, n):
                a[j, k] -= f * a[i, k]
            b[j] -= f * b[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    return True


@njit(cache=True, nogil=True)
def _grey(image, x, y):  # type: ignore[no-untyped-def]
    """Grey value between pixels by cubic convolution; NaN outside."""
    if not _holds(image, x, y):
        return np.float32(np.nan)
    return cubic(image, x, y)


@njit(cache=True, nogil=True, inline="always")
def _holds(image, x, y):  # type: ignore[no-untyped-def]
    """Whether all that cubic interpolation reads lies in the image."""
    return 1.0 <= x < image.shape[1] - 2.0 and 1.0 <= y < image.shape[0] - 2.0
