"""Compiled loops of :mod:`rille.stages.calibration.relative_orientation`: weights and normal equations of one pair,
sums in the matches' order."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def weigh(constant, design, x, block, blocks, last, least, tukey, weights, normal, pull):  # type: ignore[no-untyped-def]
    """One pair's normal equations about ``x`` of residuals ``constant + design @ x``; returns the scale, pixels.

    Parameters
    ----------
    constant, design : (n,), (n, m); ``x`` (m,).
    block : (n,) block of the image, below ``blocks``, whose mean shows how far neighbours' errors go together.
    last, least : pixels; greatest and least scale.
    tukey : scales at which a residual counts no more.
    weights, normal, pull : (n,), (m, m), (m,) results.
    """
    count, unknowns = design.shape
    rest = np.empty(count)
    for n in range(count):
        total = constant[n]
        for k in range(unknowns):
            total += design[n, k] * x[k]
        rest[n] = total
    noise = max(least, min(last, 1.4826 * np.median(np.abs(rest))))
    number, sums = np.zeros(blocks), np.zeros(blocks)
    for n in range(count):
        off = rest[n] / (tukey * noise)
        w = max(0.0, 1.0 - off * off)
        weights[n] = w * w
        number[block[n]] += weights[n]
        sums[block[n]] += weights[n] * rest[n]
    together, used = 0.0, 0
    for k in range(blocks):
        if number[k] >= 5.0:
            together += sums[k] ** 2 / number[k]
            used += 1
    spread = max(1.0, together / used / noise**2) if used else 1.0
    normal[:], pull[:] = 0.0, 0.0
    for n in range(count):
        information = weights[n] / (noise**2 * spread)
        if information == 0.0:
            continue
        for i in range(unknowns):
            a = information * design[n, i]
            pull[i] -= a * constant[n]
            for k in range(i + 1):
                normal[i, k] += a * design[n, k]
    for i in range(unknowns):
        for k in range(i):
            normal[k, i] = normal[i, k]
    return noise
