"""The merge of one strip of cells, cell by cell: what the models say there is gathered, weighed and averaged.

Memory beyond the given arrays is a few numbers a model. Sums run over the models in the order given, in double
precision, so equal input gives equal bits wherever a strip begins.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.numeric.robust import MAD_TO_SIGMA, TUKEY_BISQUARE, bisquare

PLANES = 5
"""Maps that :func:`merge_cells` fills."""


class Stack(NamedTuple):
    """Models (n, rows, cols) float32, NaN undefined: elevations, their standard deviations, residuals, grey values.

    ``gain`` (n,) of the grey values; ``centre`` (n, 2) and ``pose`` (n, 3, 3): where each camera stands, m, and the
    covariance of its height and its rotations about x and y.
    """

    z: Floats32
    sigma: Floats32
    residual: Floats32
    ortho: Floats32
    gain: Floats
    centre: Floats
    pose: Floats


class Rule(NamedTuple):
    """``scale`` of the residuals, pixels; ``sharpness``: exponent of the grey values' weights; ``alike``: correlation
    of two models' errors; ``worst``: greatest standard deviation but for the poses, m."""

    scale: float
    sharpness: float
    alike: float
    worst: float


class CellMaps(NamedTuple):
    """``maps`` (5, rows, cols) float32: elevation, its standard deviation, spread, grey value and the standard
    deviation of unrelated errors alone; ``used``: number of models that count; ``best`` index of the one of greatest
    weight, -1 none."""

    maps: Floats32
    used: NDArray[np.integer[Any]]
    best: NDArray[np.int64]


@njit(cache=True, nogil=True)
def merge_cells(stack, x, y, rule, filled):  # type: ignore[no-untyped-def]
    """Merge a stack of models; weights and equations are those of :mod:`rille.stages.terrain.merge`.

    ``x`` (cols,), ``y`` (rows,) of the cells, m. Fills the maps of a :class:`CellMaps`.
    """
    z, sigma, residual, _, _, centre, pose = stack
    scale, worst = rule.scale, rule.worst
    out, count, best = filled
    n, rows, cols = z.shape
    h, s, w, d, p = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    which, order = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for r in range(rows):
        for c in range(cols):
            m = 0
            for k in range(n):
                if not (math.isfinite(z[k, r, c]) and sigma[k, r, c] > 0.0 and residual[k, r, c] >= 0.0):
                    continue
                step = float(sigma[k, r, c])
                misfit = float(residual[k, r, c]) / scale
                weight = 1.0 / (step * step * (1.0 + misfit * misfit))
                if weight > 0.0 and weight < math.inf:
                    h[m], s[m], w[m], which[m] = z[k, r, c], step, weight, k
                    p[m] = _swing(pose[k], x[c] - centre[k, 0], y[r] - centre[k, 1])
                    m += 1
            if m == 0:
                _forget(r, c, out, count, best)
                continue
            # Of two models that contradict each other none is the outlier.
            if m >= 3:
                _agree(h, s, w, d, order, m)
            _average((h, s, w, which), m, stack, rule, (r, c), filled)
            # The limit is on the models' own errors, so it is asked before the poses' part is added.
            if out[1, r, c] > worst:
                _forget(r, c, out, count, best)
            else:
                placed = _placed(w, p, m)
                out[1, r, c] = math.sqrt(out[1, r, c] ** 2 + placed * placed)


@njit(cache=True, nogil=True)
def _forget(r, c, out, count, best):  # type: ignore[no-untyped-def]
    """Nothing is known of a cell."""
    count[r, c] = 0
    best[r, c] = -1
    for i in range(PLANES):
        out[i, r, c] = math.nan


@njit(cache=True, nogil=True)
def _placed(w, p, m):  # type: ignore[no-untyped-def]
    """Standard deviation by the poses: they drift together, so that their errors do not average out."""
    total = 0.0
    found = 0.0
    for i in range(m):
        total += w[i]
        found += w[i] * p[i]
    return found / total


@njit(cache=True, nogil=True)
def _swing(cov, dx, dy):  # type: ignore[no-untyped-def]
    """Standard deviation of the elevation at dx, dy from the camera by ``cov`` of (height, rotation about x, y)."""
    tilt = dy * dy * cov[1, 1] + dx * dx * cov[2, 2] - 2.0 * dx * dy * cov[1, 2]
    return math.sqrt(max(0.0, cov[0, 0] + tilt + 2.0 * (dy * cov[0, 1] - dx * cov[0, 2])))


@njit(cache=True, nogil=True)
def _median(values, weight, order, m, alike):  # type: ignore[no-untyped-def]
    """Lower weighted median of ``m`` values: the least that half of the weight does not exceed; ``alike``: of ones."""
    for i in range(m):
        j = i
        while j > 0 and values[order[j - 1]] > values[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i
    total = 0.0
    for i in range(m):
        total += 1.0 if alike else weight[order[i]]
    running = 0.0
    for i in range(m):
        running += 1.0 if alike else weight[order[i]]
        if running >= 0.5 * total:
            return values[order[i]]
    return values[order[m - 1]]


@njit(cache=True, nogil=True)
def _agree(h, s, w, d, order, m):  # type: ignore[no-untyped-def]
    """Multiply the weights by Tukey's biweight about the weighted median."""
    centre = _median(h, w, order, m, False)
    for i in range(m):
        d[i] = abs(h[i] - centre)
    typical = MAD_TO_SIGMA * _median(d, w, order, m, True)
    for i in range(m):
        # At least its own standard deviation: models that agree by chance must not shut out a third.
        w[i] *= bisquare(d[i] / (TUKEY_BISQUARE * max(typical, s[i])))


# Inlined: to count the references of its arrays once a cell would take 15 % of the merge.
@njit(cache=True, nogil=True, inline="always")
def _average(models, m, stack, rule, at, filled):  # type: ignore[no-untyped-def]
    """Weighted means of the ``m`` models that a cell has; ``models``: elevations, their standard deviations, weights
    and indices in the stack."""
    h, s, w, which = models
    ortho, gain = stack.ortho, stack.gain
    sharpness, alike = rule.sharpness, rule.alike
    r, c = at
    out, count, best = filled
    total = 0.0
    top = 0.0
    used = 0
    for i in range(m):
        total += w[i]
        if w[i] > 0.0:
            used += 1
        if w[i] > top:
            top = w[i]
            best[r, c] = which[i]
    count[r, c] = used
    mean = 0.0
    variance = 0.0
    together = 0.0
    grey = 0.0
    greys = 0.0
    for i in range(m):
        if w[i] > 0.0:
            share = w[i] / total
            mean += share * h[i]
            variance += (share * s[i]) ** 2
            together += share * s[i]
            value = ortho[which[i], r, c]
            if math.isfinite(value):
                sharp = (w[i] / top) ** sharpness
                grey += sharp * min(gain[which[i]] * value, 255.0)
                greys += sharp
    spread = 0.0
    for i in range(m):
        if w[i] > 0.0:
            spread += w[i] / total * (h[i] - mean) ** 2
    out[0, r, c] = mean
    # Unrelated errors (alike = 0) average out; errors of one cause (alike = 1) add up as if there were one model.
    out[1, r, c] = math.sqrt(variance + alike * (together * together - variance))
    out[2, r, c] = math.sqrt(spread)
    out[3, r, c] = grey / greys if greys > 0.0 else math.nan
    out[4, r, c] = math.sqrt(variance)
