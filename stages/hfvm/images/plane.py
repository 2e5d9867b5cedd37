"""Pre-alignment of the right image by the homography of the dominant plane, fitted to coarse matches.

Feature vectors compare upright windows. On ground seen obliquely the disparity changes by half a pixel from row to row,
and a 13-pixel kernel shears by several pixels: the matcher then finds plateaus instead of a slope. So the images are
first matched coarsely as they are; where one plane (and with it roll, row offset and toe-in) explains most of those
matches and distorts windows noticeably, the right image is resampled by its homography and matching starts anew. Only
matches say how: no calibration is used, and displacements are given in the original images.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.geometry.cubic import cubic
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.window import Shape, Window, bounded, whole
from rille.stages.hfvm.level.epipolar import residuals, typical, weighted_normal

Matrix = NDArray[np.float64]

ITERATIONS = 15

LEAST_MATCHES = 60

MOST_DISTORTION = 3.0
"""Beyond this the plane is no ground but a bad fit; views turned by 180 degrees have 2, and more if scaled."""

TOLERANCE = 1.0
"""Pixels of the coarse level: a match within twice this belongs to the plane; at this distance it has a quarter of the
weight."""

MARGIN = 1.0 / 16.0
"""Share of the width added around the aligned image, for what stands out of the plane."""


def find(
    x: AnyArray, y: AnyArray, u: AnyArray, v: AnyArray, level: int, shapes: Sequence[Shape], params: HfvmParams
) -> Matrix | None:
    """Homography from aligned pixels to right image pixels (level 0), or None where alignment would not help.

    Parameters
    ----------
    x, y, u, v : (n,) columns, rows and displacements of matches of a level, pixels.
    shapes : of the left image's levels.
    """
    found = fit_points(x, y, u, v, shapes[level], TOLERANCE)
    if found is None or found[1] < params.plane_share:
        return None
    h = to_level_0(found[0], level)
    shear = distortion(h, (shapes[0][0], shapes[0][1]))
    return h if params.plane_distortion <= shear < MOST_DISTORTION else None


@register_jitable
def mapped(h, x, y):  # type: ignore[no-untyped-def]
    """Column and row to which a homography maps a place, both to be divided by the third number, which is positive on
    this side of the horizon."""
    return (
        h[0, 0] * x + h[0, 1] * y + h[0, 2],
        h[1, 0] * x + h[1, 1] * y + h[1, 2],
        h[2, 0] * x + h[2, 1] * y + h[2, 2],
    )


def source(h: Matrix, window: Window, shape: Shape) -> Window:
    """Window of an image of ``shape`` that :func:`warp` reads for a window of its result."""
    y, x = np.meshgrid([window.y0, window.y1 - 1], [window.x0, window.x1 - 1], indexing="ij")
    p, q, w = mapped(h, x, y)
    if (w <= 1e-3).any():  # the horizon crosses it: a quadrangle does not hold it
        return whole(shape)
    p, q = p / w, q / w
    # Near the horizon ends run off to numbers that no index holds.
    top, bottom, first, last = (int(np.clip(a, -4, 1 << 30)) for a in (q.min(), q.max(), p.min(), p.max()))
    # Four pixels hold the cubic kernel, which reads two beyond its own, and what truncation takes off.
    return bounded(top, bottom, first, last, shape, 4)


def compose(
    h: Matrix, u: AnyArray, v: AnyArray, left_shape: Shape = (), x0: int = 0, y0: int = 0
) -> tuple[AnyArray, AnyArray]:
    """Displacements to the original right image of displacements to the aligned one (margin included).

    ``x0, y0``: first column and row of a window of the left image, which has ``left_shape``.
    """
    out_u, out_v = np.empty(u.shape, np.float32), np.empty(v.shape, np.float32)
    _compose(h @ translation(-margin(left_shape or u.shape)), u, v, out_u, out_v, x0, y0)
    return out_u, out_v


@njit(cache=True, nogil=True)
def _compose(g, u, v, out_u, out_v, x0, y0):  # type: ignore[no-untyped-def]
    for row in range(u.shape[0]):
        y = np.float64(row + y0)
        a, b, c = g[0, 1] * y + g[0, 2], g[1, 1] * y + g[1, 2], g[2, 1] * y + g[2, 2]
        for col in range(u.shape[1]):
            # In double precision: the difference of two columns must keep their fractions.
            x = np.float64(col + x0)
            p, dv = x + u[row, col], np.float64(v[row, col])
            w = 1.0 / (g[2, 0] * p + g[2, 1] * dv + c)
            out_u[row, col] = (g[0, 0] * p + g[0, 1] * dv + a) * w - x
            out_v[row, col] = (g[1, 0] * p + g[1, 1] * dv + b) * w - y


def decompose(h: Matrix, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Displacements (row, col) of a whole left image to the aligned right image: the inverse of :func:`compose`."""
    g = np.linalg.inv(h @ translation(-margin(u.shape)))
    y, x = np.indices(u.shape, dtype=np.float64)
    p, q, w = mapped(g, x + u, y + v)
    # Points beyond the horizon would come back mirrored.
    w = np.where(w > 0, w, np.nan)
    return (p / w - x).astype(np.float32), (q / w - y).astype(np.float32)


def margin(left_shape: tuple[int, ...]) -> int:
    """Pixels added on every side of the aligned image."""
    return int(np.ceil(MARGIN * left_shape[1]))


def translation(by: float) -> Matrix:
    """Homography that adds ``by`` pixels to both coordinates."""
    return np.array([[1.0, 0.0, by], [0.0, 1.0, by], [0.0, 0.0, 1.0]])


def fit_points(
    x: AnyArray, y: AnyArray, u: AnyArray, v: AnyArray, shape: Shape, tolerance: float
) -> tuple[Matrix, float] | None:
    """Homography of the dominant plane, and the share of matches within twice ``tolerance`` of it; None: too few.

    Parameters
    ----------
    x, y, u, v : (n,) columns, rows and displacements of matches of one level, which has ``shape``; pixels.
    tolerance : pixels; a match this far from the plane has a quarter of the weight.

    Returns
    -------
    (3, 3) float64 H with ``(x + u, y + v, 1) ~ H (x, y, 1)``, and the share.
    """
    if len(y) < LEAST_MATCHES:
        return None
    # In half image sides all eight terms are of like size, so that one weak hold suits them all.
    scale = 0.5 * max(shape)
    middle = (0.5 * shape[1] / scale, 0.5 * shape[0] / scale)
    to_unit = np.array([[1 / scale, 0.0, -middle[0]], [0.0, 1 / scale, -middle[1]], [0.0, 0.0, 1.0]])
    p = np.stack([x / scale - middle[0], y / scale - middle[1]])
    d = np.stack([u, v]).astype(np.float64) / scale
    unit, error = _solve(p, d, tolerance / scale)
    return np.linalg.inv(to_unit) @ unit @ to_unit, float(np.mean(error <= 2 * tolerance / scale))


def _solve(p: AnyArray, d: AnyArray, tolerance: float) -> tuple[Matrix, AnyArray]:
    """Homography of points (2, n) moved by ``d`` (2, n), robustly, and each point's error.

    ``q = p + d`` with q ~ H p is linear in the eight terms of H - I where H[2, 2] = 1; they are weakly held at zero.
    """
    one, nil, q = np.ones_like(p[0]), np.zeros_like(p[0]), p + d
    terms = np.stack(
        [
            np.stack([p[0], p[1], one, nil, nil, nil, -q[0] * p[0], -q[0] * p[1]]),
            np.stack([nil, nil, nil, p[0], p[1], one, -q[1] * p[0], -q[1] * p[1]]),
        ]
    )
    h, weight, spread = np.zeros(8), one, np.inf
    for _ in range(ITERATIONS):
        halves = [weighted_normal(t, e, weight) for t, e in zip(terms, d, strict=True)]
        normal = halves[0][0] + halves[1][0] + 1e-6 * len(one) * np.eye(8)
        h = np.linalg.solve(normal, halves[0][1] + halves[1][1])
        error = np.hypot(*(residuals(t, e, -h) for t, e in zip(terms, d, strict=True)))
        # Start as wide as the matches scatter about the first fit, and narrow onto the dominant plane.
        spread = max(tolerance, min(1.5 * typical(error), 0.7 * spread))
        # Squared Cauchy weights: other surfaces, off by many pixels, must not drag the plane along.
        weight = 1.0 / (1.0 + (error / spread) ** 2) ** 2
    return np.append(h, 0.0).reshape(3, 3) + np.eye(3), error


def to_level_0(h: Matrix, level: int) -> Matrix:
    """Homography of level ``level`` pixels as one of level 0 pixels."""
    up = finer(level)
    return np.asarray(up @ h @ np.linalg.inv(up), dtype=np.float64)


def finer(level: int) -> Matrix:
    """Homography from pixels of a level to those of level 0, whose centres lie half a pixel inside their corners."""
    k = 2.0**level
    # Pixel x of the level covers k pixels from k x on, whose middle is k x + (k - 1) / 2: at level 1 it is 2x + 0.5.
    return np.array([[k, 0.0, 0.5 * k - 0.5], [0.0, k, 0.5 * k - 0.5], [0.0, 0.0, 1.0]])


def scale(h: Matrix, shape: Shape) -> float:
    """Pixels of the right image that one in the middle of an aligned image is wide and high, in the geometric mean."""
    w = mapped(h, 0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))[2]
    # The determinant of the derivative of a homography.
    return math.sqrt(abs(float(np.linalg.det(h))) / abs(w) ** 3)


def distortion(h: Matrix, shape: tuple[int, int]) -> float:
    """Greatest element of the derivative's departure from the identity, each taken as the median over an image."""
    y, x = np.meshgrid(np.linspace(0, shape[0] - 1, 5), np.linspace(0, shape[1] - 1, 5), indexing="ij")
    p, q, w = mapped(h, x, y)
    # So near the horizon it is no ground but a bad fit, which infinity has refused.
    if (w <= 0.1).any():
        return np.inf
    p, q = p / w, q / w
    parts = [
        (h[0, 0] - p * h[2, 0]) / w - 1,
        (h[0, 1] - p * h[2, 1]) / w,
        (h[1, 0] - q * h[2, 0]) / w,
        (h[1, 1] - q * h[2, 1]) / w - 1,
    ]
    return float(max(np.median(np.abs(d)) for d in parts))


@njit(cache=True, nogil=True)
def warp(image, valid, h, out, out_valid, place):  # type: ignore[no-untyped-def]
    """``out(x, y) = image(H (x, y))``, Catmull-Rom; ``out_valid`` 0 where that is outside or masked.

    ``place`` (:class:`~rille.stages.hfvm.level.window_pair.WindowPair`): where the windows of result and image lie.
    """
    x0, y0, ix0, iy0, height, width = place
    rows, cols = out.shape
    for row in range(rows):
        for col in range(cols):
            y, x = row + y0, col + x0
            out[row, col], out_valid[row, col] = 0.0, 0
            p, q, w = mapped(h, x, y)
            if w <= 1e-6:
                continue
            p, q = p / w, q / w
            # The cubic kernel reads one pixel before and two after.
            if not (p >= 1 and p < width - 2 and q >= 1 and q < height - 2):
                continue
            # The nearest pixel decides: masked ones beside it carry grey from above and do not darken the kernel.
            if valid[int(q + 0.5) - iy0, int(p + 0.5) - ix0]:
                out[row, col] = cubic(image, np.float32(p), np.float32(q), ix0, iy0)
                out_valid[row, col] = 1
