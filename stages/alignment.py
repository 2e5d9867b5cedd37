"""Sub-pixel alignment of templates under a local affinity (refinement of tracked positions, section 5.2.1).

Feature vectors find *which* pixel corresponds; where in the pixel is better told by the grey values themselves, once the
template is drawn in the perspective of the searched frame. Affine Lucas-Kanade with gain and offset, inverse
compositional: Baker and Matthews (2004), doi:10.1023/B:VISI.0000011205.11775.fd. The affinity that the neighbouring
tracks suggest is a prior, so that weak texture keeps to it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HALF = 5
"""Half the template's side: 11 x 11 pixels hold enough texture and still look plane."""
STEPS = 15
"""Steps before a template is given up; five are usual."""
SETTLED = 0.01
"""Pixels: a last step below this is a tenth of the error that remains."""
UNKNOWNS = 8
"""Shift (2), affinity (4), offset, gain."""


def align(
    a: F32, b: F32, points: F64, start: F64, affinity: F64, *, noise: float, spread: float, reach: float
) -> tuple[F64, F64, F64]:
    """Align templates around points of ``a`` in ``b``.

    Parameters
    ----------
    a, b : (rows, cols) grey values.
    points, start : (n, 2) column, row in a, and where they are expected in b; NaN is passed through.
    affinity : (n, 2, 2) expected derivative of b's coordinates by a's.
    noise : grey levels, standard deviation of a difference.
    spread : standard deviation of an element of the affinity around the expected one.
    reach : pixels; a result farther than this from ``start`` is refused.

    Returns
    -------
    position (n, 2) in b, NaN refused; affinity (n, 2, 2); error (n,) rms grey difference over the template.
    """
    position, error = np.full(points.shape, np.nan), np.full(len(points), np.nan)
    found = np.ascontiguousarray(affinity, dtype=np.float64).copy()
    for array in (points, start):
        if array.dtype != np.float64:
            raise TypeError("points are float64")
    ridge = (noise / spread) ** 2
    _align_all(
        np.ascontiguousarray(a), np.ascontiguousarray(b), np.ascontiguousarray(points), np.ascontiguousarray(start),
        found, ridge, reach, position, error,
    )
    return position, found, error


@njit(cache=True, nogil=True)
def _align_all(
    a: F32, b: F32, points: F64, start: F64, affinity: F64, ridge: float, reach: float, position: F64, error: F64
) -> None:
    for n in range(points.shape[0]):
        _align(a, b, points[n], start[n], affinity[n], ridge, reach, position, error, n)


@njit(cache=True, nogil=True)
def _align(
    a: F32, b: F32, p: F64, q0: F64, m: F64, ridge: float, reach: float, position: F64, error: F64, n: int
) -> None:
    side = 2 * HALF + 1
    template = np.empty(side * side)
    descent = np.empty((side * side, UNKNOWNS))
    if not _descent(a, p, template, descent):
        return
    normal = _gram(descent)
    for k in range(2, 6):
        normal[k, k] += ridge
    m0 = m.copy()
    x0, y0 = q0[0], q0[1]
    e = np.zeros(4)
    rhs = np.empty(UNKNOWNS)
    for _ in range(STEPS):
        rhs[:] = 0.0
        total = square = 0.0
        for i in range(side * side):
            x, y = i % side - HALF, i // side - HALF
            d = _cubic(b, x0 + m[0, 0] * x + m[0, 1] * y, y0 + m[1, 0] * x + m[1, 1] * y) - template[i]
            square += d * d
            for k in range(UNKNOWNS):
                rhs[k] += descent[i, k] * d
        for k in range(4):
            rhs[2 + k] += ridge * e[k]
        lhs = normal.copy()
        if not _solve(lhs, rhs):
            return
        d00, d01, d10, d11 = 1.0 + rhs[2], rhs[3], rhs[4], 1.0 + rhs[5]
        det = d00 * d11 - d01 * d10
        if not det > 0.1:
            return
        i00, i01, i10, i11 = d11 / det, -d01 / det, -d10 / det, d00 / det
        b00, b01 = m[0, 0] * i00 + m[0, 1] * i10, m[0, 0] * i01 + m[0, 1] * i11
        b10, b11 = m[1, 0] * i00 + m[1, 1] * i10, m[1, 0] * i01 + m[1, 1] * i11
        sx, sy = b00 * rhs[0] + b01 * rhs[1], b10 * rhs[0] + b11 * rhs[1]
        x0 -= sx
        y0 -= sy
        m[0, 0], m[0, 1], m[1, 0], m[1, 1] = b00, b01, b10, b11
        det0 = m0[0, 0] * m0[1, 1] - m0[0, 1] * m0[1, 0]
        e[0] = (m0[1, 1] * b00 - m0[0, 1] * b10) / det0 - 1.0
        e[1] = (m0[1, 1] * b01 - m0[0, 1] * b11) / det0
        e[2] = (m0[0, 0] * b10 - m0[1, 0] * b00) / det0
        e[3] = (m0[0, 0] * b11 - m0[1, 0] * b01) / det0 - 1.0
        if not (abs(x0 - q0[0]) <= reach and abs(y0 - q0[1]) <= reach):
            return
        if abs(sx) < SETTLED and abs(sy) < SETTLED:
            position[n, 0], position[n, 1] = x0, y0
            # what the gain and offset explain is no error
            error[n] = np.sqrt(max(square, 0.0) / (side * side))
            return


@njit(cache=True, nogil=True)
def _gram(d: F64) -> F64:
    out = np.zeros((UNKNOWNS, UNKNOWNS))
    for i in range(d.shape[0]):
        for k in range(UNKNOWNS):
            for l in range(UNKNOWNS):
                out[k, l] += d[i, k] * d[i, l]
    return out


@njit(cache=True, nogil=True)
def _descent(a: F32, p: F64, template: F64, descent: F64) -> bool:
    """Template and derivatives of its grey values by the unknowns; False where it leaves the image."""
    side = 2 * HALF + 1
    mean = 0.0
    for i in range(side * side):
        x, y = i % side - HALF, i // side - HALF
        template[i] = _cubic(a, p[0] + x, p[1] + y)
        mean += template[i]
    mean /= side * side
    if not np.isfinite(mean):
        return False
    for i in range(side * side):
        x, y = i % side - HALF, i // side - HALF
        gx = 0.5 * (_cubic(a, p[0] + x + 1, p[1] + y) - _cubic(a, p[0] + x - 1, p[1] + y))
        gy = 0.5 * (_cubic(a, p[0] + x, p[1] + y + 1) - _cubic(a, p[0] + x, p[1] + y - 1))
        descent[i, 0], descent[i, 1] = gx, gy
        descent[i, 2], descent[i, 3], descent[i, 4], descent[i, 5] = gx * x, gx * y, gy * x, gy * y
        descent[i, 6], descent[i, 7] = 1.0, template[i] - mean
    return np.isfinite(descent.sum())


@njit(cache=True, nogil=True)
def _solve(a: F64, b: F64) -> bool:
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
def _cubic(image: F32, x: float, y: float) -> float:
    """Grey value by cubic convolution (Keys 1981, a = -1/2); NaN outside."""
    if not (1.0 <= x < image.shape[1] - 2.0 and 1.0 <= y < image.shape[0] - 2.0):
        return np.nan
    c, r = int(x), int(y)
    fx, fy = x - c, y - r
    value = 0.0
    for i in range(-1, 3):
        row = 0.0
        for j in range(-1, 3):
            row += _key(fx - j) * image[r + i, c + j]
        value += _key(fy - i) * row
    return value


@njit(cache=True, nogil=True)
def _key(d: float) -> float:
    d = abs(d)
    return (1.5 * d - 2.5) * d * d + 1.0 if d < 1.0 else ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0
