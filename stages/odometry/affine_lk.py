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
SETTLED_PX = 0.01
"""Step below which a template has converged: a tenth of the error that remains."""
UNKNOWNS = 8
"""Shift (2), affinity (4), offset, gain."""
MIN_TEXTURE = 1e-9
"""Sum of squared differences [grey levels] in each direction, below which a template has none: it is rounding."""


class Templates(NamedTuple):
    """``points`` (n, 2) column, row in a; ``start`` (n, 2) where they are expected in b, NaN stays NaN; ``affinity``
    (n, 2, 2) expected derivative of b's coordinates by a's."""

    points: Floats
    start: Floats
    affinity: Floats


def align(
    a: Floats32,
    b: Floats32,
    templates: Templates,
    *,
    noise: float,
    spread: float,
    reach: float,
    settled: float = SETTLED_PX,
) -> Floats:
    """Positions (n, 2) column, row in ``b`` of the templates around points of ``a``.

    NaN where one leaves the image, does not converge or is refused.

    Parameters
    ----------
    a, b : (rows, cols) grey values.
    noise : grey levels, standard deviation of a difference.
    spread : standard deviation of an element of the affinity around the expected one.
    reach : pixels; a result farther than this from ``start`` is refused.
    settled : step [pixels] below which a template has converged.
    """
    out = np.full(templates.points.shape, np.nan)
    _align_all(
        np.ascontiguousarray(a, dtype=np.float32),
        np.ascontiguousarray(b, dtype=np.float32),
        Templates(*(np.ascontiguousarray(v, dtype=np.float64) for v in templates)),
        # Weight of the prior in squared grey levels: variance of a grey difference over that of an element of the
        # affinity.
        (noise / spread) ** 2,
        float(reach),
        settled,
        out,
    )
    return out


@njit(cache=True, nogil=True)
def _align_all(a, b, templates, ridge, reach, settled, out):  # type: ignore[no-untyped-def]
    patch, template = np.empty((SIDE + 2) ** 2), np.empty(SIDE * SIDE)
    descent, grey = np.empty((UNKNOWNS, SIDE * SIDE)), np.empty(SIDE * SIDE)
    for n in range(len(templates.points)):
        point, start, expected = templates.points[n], templates.start[n], templates.affinity[n]
        if not _descent(a, point[0], point[1], patch, template, descent):
            continue
        gram = np.dot(descent, descent.T)
        # The template is flat, or has one direction only.
        if not gram[0, 0] * gram[1, 1] - gram[0, 1] ** 2 > MIN_TEXTURE * (gram[0, 0] + gram[1, 1]):
            continue
        for k in range(UNKNOWNS):
            gram[k, k] += 1e-9 + (ridge if 2 <= k < 6 else 0.0)
        # Inverse compositional: derivatives are those of the template, so one inverse serves all steps.
        inverse, unexpected = np.linalg.inv(gram), _inverse(expected)
        # Steps are composed into the copy; the prior pulls towards what was given.
        affinity, at = expected.copy(), start.copy()
        for _ in range(STEPS):
            if not _warp(b, at[0], at[1], affinity, grey):
                break
            grey -= template
            right = np.dot(descent, grey)
            # Added, not subtracted: a step is composed inversely, so what the affinity has too much counts like a grey
            # difference.
            right[2:6] += ridge * (_product(unexpected, affinity) - np.eye(2)).ravel()
            step = np.dot(inverse, right)
            affinity = _product(affinity, _inverse(np.eye(2) + step[2:6].reshape(2, 2)))
            dx = affinity[0, 0] * step[0] + affinity[0, 1] * step[1]
            dy = affinity[1, 0] * step[0] + affinity[1, 1] * step[1]
            at[0], at[1] = at[0] - dx, at[1] - dy
            # Negated so that NaN, of a singular system, is refused as well.
            if not (abs(at[0] - start[0]) <= reach and abs(at[1] - start[1]) <= reach):
                break
            if max(abs(dx), abs(dy)) < settled:
                out[n] = at
                break


@njit(cache=True, nogil=True)
def _product(a, b):  # type: ignore[no-untyped-def]
    """Product (2, 2); of matrices this small a call of BLAS takes longer than their sums."""
    out = np.empty((2, 2))
    for i in range(2):
        for j in range(2):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j]
    return out


@njit(cache=True, nogil=True)
def _inverse(m):  # type: ignore[no-untyped-def]
    """Inverse (2, 2); not finite of a singular matrix."""
    det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    return np.array([[m[1, 1] / det, -m[0, 1] / det], [-m[1, 0] / det, m[0, 0] / det]])


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
        descent[0, i], descent[1, i] = gx, gy
        descent[2, i], descent[3, i], descent[4, i], descent[5, i] = gx * x, gx * y, gy * x, gy * y
        descent[6, i] = 1.0
    for i in range(SIDE * SIDE):
        # Gain about the mean: its derivative is then orthogonal to that of the offset.
        descent[7, i] = template[i] - mean / (SIDE * SIDE)
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


@njit(cache=True, nogil=True, inline="always")
def _holds(image, x, y):  # type: ignore[no-untyped-def]
    """Whether all that cubic interpolation reads lies in the image."""
    return 1.0 <= x < image.shape[1] - 2.0 and 1.0 <= y < image.shape[0] - 2.0
