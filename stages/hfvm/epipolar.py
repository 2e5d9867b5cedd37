"""Soft epipolar band: a fundamental matrix fitted robustly to the consistent matches of one level.

A free two-dimensional search loses accuracy; knowing where matches lie in *any* geometry restores it. The matrix is
only a help to the search: it is estimated anew at every level and never leaves the matcher.

The constraint ``p'^T F p = 0`` is linear in F. Divided by the coefficient of ``y'`` it reads ``y' = y + small`` for a
rig whose baseline lies along the rows, divided by that of ``x'`` likewise for one along the columns; both are fitted as
a maximum a posteriori with a weak prior on the small terms (a few degrees of roll and toe-in), which determines the
terms that a flat scene leaves open. The first one is taken where most matches lie on its lines, else the likelier one.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.kernel import kernel
from rille.stages.geometry.projection import product
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy

Matrix = NDArray[np.float64]

NO_BAND: Matrix = np.zeros((3, 3))

TERM_SIGMAS = np.array([0.2, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.5])
"""Deviations of the eight free terms (x', x'x, x'y, y'x, y'y, x, y, 1) in half image sides."""

SHARP_SPREAD_PX = 0.2
"""Pixels: median distance of sub-pixel matches from their lines in an ideal rig; beyond it the band is softened."""


MIN_NORMAL = np.float32(1e-12)
"""Length below which a normal is none: there is no band."""


def fit_points(
    x: AnyArray, y: AnyArray, u: AnyArray, v: AnyArray, left_shape: tuple[int, ...], right_shape: tuple[int, ...]
) -> tuple[Matrix, float] | None:
    """Fundamental matrix of matches of one level, or None where it is not determined.

    Parameters
    ----------
    x, y, u, v : (n,) columns, rows and displacements, pixels.
    left_shape, right_shape : rows and columns of both images.

    Returns
    -------
    F : (3, 3) float64 with ``(x + u, y + v, 1) F (x, y, 1)^T = 0`` in pixels of this level.
    spread : median distance of the matches from their lines, pixels.
    """
    # 40: five matches for each of the eight unknowns.
    if len(y) < 40:
        return None
    scale = 0.5 * max(left_shape)
    left_mid = (0.5 * (left_shape[1] - 1), 0.5 * (left_shape[0] - 1))
    right_mid = (0.5 * (right_shape[1] - 1), 0.5 * (right_shape[0] - 1))
    p = np.stack([(x - left_mid[0]) / scale, (y - left_mid[1]) / scale])
    q = np.stack([(x + u - right_mid[0]) / scale, (y + v - right_mid[1]) / scale])
    # Deviation of an integer match from its line: half a pixel.
    sigma = 0.5 / scale
    f, cost, spread = _solve(p, q, sigma)
    # 0.05 pixels: median distance of matches from lines along the rows beyond which lines along the columns may be
    # likelier. A plane lies on lines of either kind; relief of less than half a pixel tells them apart.
    if spread * scale > 0.05:
        cols = _solve(p[::-1], q[::-1], sigma)
        if cols[1] < cost:
            f, spread = transposed(cols[0]), cols[2]
    to_left, to_right = (
        np.array([[1 / scale, 0.0, -x / scale], [0.0, 1 / scale, -y / scale], [0, 0, 1.0]])
        for x, y in (left_mid, right_mid)
    )
    return np.asarray(to_right.T @ f @ to_left, dtype=np.float64), spread * scale


def _solve(p: AnyArray, q: AnyArray, sigma: float) -> tuple[Matrix, float, float]:
    """Robust fit (Cauchy weights) of ``y' + g . terms = 0``: matrix in normalised coordinates, cost, spread."""
    x, y, xr, yr = p[0], p[1], q[0], q[1]
    terms = np.stack([xr, xr * x, xr * y, yr * x, yr * y, x, y, np.ones_like(x)])
    prior = np.zeros(8)
    # y' = y: the baseline lies along the rows.
    prior[6] = -1.0
    spread = math.inf

    def weigh(residual: AnyArray) -> AnyArray:
        # Start with the matches' scatter about the prior, and narrow to the error of an integer match.
        nonlocal spread
        middle, first = typical(residual), math.isinf(spread)
        spread = max(sigma, 2.0 * middle if first else min(0.5 * spread, 1.5 * middle + sigma))
        return cauchy(residual, spread) / sigma**2

    # 0.001 deviations: 0.0005 px, since the largest coefficient is about 1. With 0.02 elevations err 1.5 % more.
    g = irls(terms.T, -yr, weigh, np.diag(TERM_SIGMAS**-2.0), prior, rounds=10, tolerance=0.001 * sigma)
    residual = g @ terms + yr
    cost = float(np.sum(np.log1p((residual / sigma) ** 2)) + np.sum(((g - prior) / TERM_SIGMAS) ** 2))
    f = np.array([[g[1], g[2], g[0]], [g[3], g[4], 1.0], [g[5], g[6], g[7]]])
    return f, cost, typical(residual)


def transposed(f: Matrix) -> Matrix:
    """The same constraint in images whose rows and columns are exchanged."""
    return np.asarray(f[[1, 0, 2]][:, [1, 0, 2]])


def typical(residual: AnyArray) -> float:
    """Median magnitude (the upper one of two)."""
    size = np.abs(residual)
    return float(np.partition(size, size.size // 2)[size.size // 2])


def finer(f: Matrix) -> Matrix:
    """The same constraint in pixels of the next finer level (``x_n = (x + 0.5) / 2 - 0.5``)."""
    s = np.array([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
    return np.asarray(s.T @ f @ s, dtype=np.float64)


def near_sign(f: Matrix, u: AnyArray, left_shape: tuple[int, ...], right_shape: tuple[int, ...]) -> float:
    """Sign of the displacement along the rows of near things against far ones: -1 on a usual rig, +1 with images
    swapped.

    On a convergent rig the displacement of far things is not zero; the toe-in shows in the terms ``y'x`` and ``x'y``
    (keystone), which give it for a focal length of about the image width. A vote: only the filling of gaps hangs on it.
    ``u``: column displacements of matches (n,).
    """
    (rows, cols), (right_rows, right_cols) = left_shape, right_shape
    middles = (0.5 * (cols - 1), 0.5 * (rows - 1)), (0.5 * (right_cols - 1), 0.5 * (right_rows - 1))
    g = moved(f, *middles)
    far = -(g[1, 0] + g[0, 1]) / g[1, 2] * float(cols) ** 2 + 0.5 * (right_cols - cols)
    return -1.0 if np.median(u) <= far else 1.0


def lines(f: Matrix, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Epipolar line of every left pixel: unit normal and offset (row, col, 3) with n . displacement + c = 0.

    Zeros where ``f`` is zero.
    """
    y, x = np.indices(shape).reshape(2, -1)
    return np.ascontiguousarray(lines_at(f, x, y).T.reshape(*shape, 3))


def moved(f: Matrix, left: tuple[float, float], right: tuple[float, float]) -> Matrix:
    """The same constraint in coordinates that begin at these columns and rows of the images."""
    to_left, to_right = (np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]]) for x, y in (left, right))
    return np.asarray(to_right.T @ f @ to_left, dtype=np.float64)


@kernel
def row_terms(f, y):  # type: ignore[no-untyped-def]
    """Lines of a row as polynomials of the column: seven float32, see :func:`line`.

    Summed up in double precision, so that on a nearly rectified rig nothing cancels in single precision.
    """
    a, b = f[0, 1] * y + f[0, 2], f[1, 1] * y + f[1, 2]
    c = f[2, 2] + f[2, 1] * y + b * y
    return np.array([a, f[0, 0], b, f[1, 0], c, f[2, 0] + a + f[1, 0] * y, f[0, 0]]).astype(np.float32)


@kernel
def line(terms, x, length):  # type: ignore[no-untyped-def]
    """Normal of ``length`` and offset (a, b, c) of the epipolar line of column ``x``; zeros where there is no band.

    ``|a u + b v + c|`` is ``length`` times the distance of displacement (u, v) from the line. All float32.
    """
    a, b = terms[0] + terms[1] * x, terms[2] + terms[3] * x
    c = terms[4] + x * (terms[5] + x * terms[6])
    scale = length / max(np.sqrt(a * a + b * b), MIN_NORMAL)
    return a * scale, b * scale, c * scale


@register_jitable
def on_line(line, along):  # type: ignore[no-untyped-def]
    """Displacement (column, row) on a line (a, b, c) of unit normal, ``along`` pixels from the shortest one on it."""
    a, b, c = line
    return along * b - c * a, -along * a - c * b


def lines_at(f: Matrix, x: AnyArray, y: AnyArray) -> NDArray[np.float32]:
    """As :func:`lines`, of single pixels (n,): (3, n) float32."""
    a, b, c = product(f, x, y)
    # Without a band all is zero, and 0 / 0 must stay 0.
    scale = 1.0 / np.maximum(np.sqrt(a * a + b * b), 1e-12)
    return np.stack((a * scale, b * scale, (c + a * x + b * y) * scale)).astype(np.float32)


def along_rows(f: Matrix, shape: tuple[int, ...]) -> bool:
    """Whether the lines of an image of ``shape`` run along the rows rather than along the columns."""
    a, b, _ = lines_at(f, np.array([shape[1] // 2]), np.array([shape[0] // 2]))
    return bool(abs(b) >= abs(a))


def oriented(f: Matrix, shape: tuple[int, ...]) -> Matrix:
    """The matrix with the sign by which :func:`on_line` leads to greater columns, or rows on upright lines."""
    a, b, _ = lines_at(f, np.array([shape[1] // 2]), np.array([shape[0] // 2]))
    return f if (b if along_rows(f, shape) else -a) > 0 else -f


@kernel
def settled(f, u, v, wanted):  # type: ignore[no-untyped-def]
    """Row displacements (row, col), those of the ``wanted`` pixels by their column displacements and their lines.

    Only where lines run along the rows rather than along the columns: there an error of the column is not enlarged.
    """
    out = v.copy()
    for y in range(v.shape[0]):
        for x in range(v.shape[1]):
            if wanted[y, x]:
                a, b, c = product(f, x, y)
                if abs(b) > abs(a):
                    out[y, x] = -(a * (x + u[y, x]) + c) / b - y
    return out
