"""The merge of one strip of cells, cell by cell: what the models say there is gathered, weighed and averaged.

Memory beyond the given arrays is a few numbers a model. Sums run over the models in the order given, in double
precision, so equal input gives equal bits wherever a strip begins.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.numeric.robust import MAD_TO_SIGMA, TUKEY_BISQUARE, bisquare

RESIDUAL_SCALE_PX = 0.1
"""Residual that halves a model's weight: the error of a good disparity."""
ORTHO_WEIGHT_EXPONENT = 8
"""Of the ortho image's weights: the best image, but without a visible seam."""


class Stack(NamedTuple):
    """Models (n, rows, cols) float32, NaN undefined: elevations, their standard deviations, residuals, grey values.

    ``pair`` (n,) numbers of the models; ``gain`` (n,) of the grey values; ``centre`` (n, 2) and ``pose`` (n, 3, 3):
    where each camera stands, m, and the covariance of its height and its rotations about x and y.
    """

    z: Floats32
    sigma: Floats32
    residual: Floats32
    ortho: Floats32
    pair: NDArray[np.int64]
    gain: Floats
    centre: Floats
    pose: Floats


class Merged(NamedTuple):
    """Maps (rows, cols) of merged cells.

    ``elevation``, ``elevation_std`` and ``relief_std`` (of the weighted mean, see
    :mod:`rille.stages.terrain.merge`), ``spread`` (standard deviation of the models about it; 0 for one model) in
    metres, NaN undefined; ``count`` of models; ``source`` pair of the greatest weight, -1 none; ``ortho`` grey value.
    """

    elevation: Floats32
    elevation_std: Floats32
    spread: Floats32
    count: NDArray[np.uint16]  # type: ignore[assignment]  # in place of a tuple's own count
    source: NDArray[np.int32]
    ortho: Floats32
    relief_std: Floats32


class _Cell(NamedTuple):
    """What the models that know a cell say of it (n,): elevation, standard deviations of its own and of the pose, m,
    weight, grey value, and the model's index in the stack."""

    z: Floats
    sigma: Floats
    pose: Floats
    weight: Floats
    grey: Floats
    model: NDArray[np.int64]


@njit(cache=True, nogil=True)
def merge_cells(stack, x, y, alike, worst, out):  # type: ignore[no-untyped-def]
    """Merge a stack of models; weights and equations are those of :mod:`rille.stages.terrain.merge`.

    ``x`` (cols,), ``y`` (rows,) of the cells, m; ``alike``: correlation of two models' errors; ``worst``: greatest
    standard deviation but for the poses, m; ``out``: the :class:`Merged` to fill, NaN, 0 and -1 before.
    """
    count, rows, cols = stack.z.shape
    floats = np.empty((5, count))
    cell = _Cell(floats[0], floats[1], floats[2], floats[3], floats[4], np.empty(count, np.int64))
    apart, order = np.empty(count), np.empty(count, np.int64)
    for r in range(rows):
        for c in range(cols):
            known = _gather(stack, r, c, (x[c], y[r]), cell)
            # Of two models that contradict each other none is the outlier.
            if known >= 3:
                _reweigh(cell, apart, order, known)
            if known:
                _average(cell, known, alike, worst, (r, c), stack.pair, out)


@njit(cache=True, nogil=True)
def _gather(stack, r, c, place, cell):  # type: ignore[no-untyped-def]
    """Number of models that know a cell at ``place`` (x, y), m, which are put into ``cell``."""
    n = 0
    for k in range(stack.z.shape[0]):
        z, sigma = stack.z[k, r, c], float(stack.sigma[k, r, c])
        residual = float(stack.residual[k, r, c]) / RESIDUAL_SCALE_PX
        if not (math.isfinite(z) and sigma > 0.0 and residual >= 0.0):
            continue
        weight = 1.0 / (sigma * sigma * (1.0 + residual * residual))
        if weight > 0.0 and weight < math.inf:
            cell.z[n], cell.sigma[n], cell.weight[n], cell.model[n] = z, sigma, weight, k
            cell.grey[n] = min(stack.gain[k] * stack.ortho[k, r, c], 255.0)
            cell.pose[n] = _swing(stack.pose[k], place[0] - stack.centre[k, 0], place[1] - stack.centre[k, 1])
            n += 1
    return n


@njit(cache=True, nogil=True)
def _swing(cov, dx, dy):  # type: ignore[no-untyped-def]
    """Standard deviation of the elevation at dx, dy from the camera by ``cov`` of (height, rotation about x, y)."""
    tilt = dy * dy * cov[1, 1] + dx * dx * cov[2, 2] - 2.0 * dx * dy * cov[1, 2]
    return math.sqrt(max(0.0, cov[0, 0] + tilt + 2.0 * (dy * cov[0, 1] - dx * cov[0, 2])))


@njit(cache=True, nogil=True)
def _reweigh(cell, apart, order, n):  # type: ignore[no-untyped-def]
    """Multiply the weights by Tukey's biweight about the weighted median; ``apart``, ``order``: room for n numbers."""
    centre = _median(cell.z, cell.weight, order, n)
    for i in range(n):
        apart[i] = abs(cell.z[i] - centre)
    typical = MAD_TO_SIGMA * _median(apart, np.ones(n), order, n)
    for i in range(n):
        # At least its own standard deviation: models that agree by chance must not shut out a third.
        cell.weight[i] *= bisquare((cell.z[i] - centre) / (TUKEY_BISQUARE * max(typical, cell.sigma[i])))


@njit(cache=True, nogil=True)
def _median(values, weight, order, n):  # type: ignore[no-untyped-def]
    """Lower weighted median of ``n`` values: the least that half of the weight does not exceed."""
    total = 0.0
    for i in range(n):
        total += weight[i]
        j = i
        while j > 0 and values[order[j - 1]] > values[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i
    running = 0.0
    for i in range(n):
        running += weight[order[i]]
        if running >= 0.5 * total:
            return values[order[i]]
    return values[order[n - 1]]


@njit(cache=True, nogil=True)
def _average(cell, n, alike, worst, at, pair, out):  # type: ignore[no-untyped-def]
    """Weighted means of the ``n`` models that know a cell; nothing where they are too uncertain."""
    total = top = mean = apart = together = placed = grey = greys = spread = 0.0
    used, best = 0, -1
    for i in range(n):
        total += cell.weight[i]
        if cell.weight[i] > 0.0:
            used += 1
        if cell.weight[i] > top:
            top, best = cell.weight[i], cell.model[i]
    for i in range(n):
        share = cell.weight[i] / total
        mean += share * cell.z[i]
        apart += (share * cell.sigma[i]) ** 2
        together += share * cell.sigma[i]
        # Poses drift together, so that their errors do not average out.
        placed += share * cell.pose[i]
        if cell.weight[i] > 0.0 and math.isfinite(cell.grey[i]):
            sharp = (cell.weight[i] / top) ** ORTHO_WEIGHT_EXPONENT
            grey += sharp * cell.grey[i]
            greys += sharp
    for i in range(n):
        spread += cell.weight[i] / total * (cell.z[i] - mean) ** 2
    # Unrelated errors (alike = 0) average out; errors of one cause (alike = 1) add up as if there were one model.
    variance = apart + alike * (together * together - apart)
    # The limit is on the models' own errors, without the poses' part.
    if math.sqrt(variance) <= worst:
        out.elevation[at], out.elevation_std[at] = mean, math.sqrt(variance + placed * placed)
        out.spread[at], out.relief_std[at] = math.sqrt(spread), math.sqrt(apart)
        out.ortho[at] = grey / greys if greys > 0.0 else math.nan
        out.count[at], out.source[at] = used, pair[best]
