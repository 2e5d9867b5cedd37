"""Affinities of the image between two frames, from the displacements of nearby points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats

NEIGHBOURS = 12
"""Number of tracks that an affinity is fitted to: four times the three that it needs, and still local."""
PULL = 5.0
"""Spread [pixels] of the neighbours below which they do not determine a change of shape."""


def known(points: Floats) -> Bools:
    """Which points (n, k) are not NaN."""
    return np.asarray(np.isfinite(points).all(axis=1))


def known_median(values: NDArray[Any], known: NDArray[Any]) -> NDArray[Any]:
    """Median (n,) of the values (n, k) that are not NaN, of which there are ``known`` (n,); NaN where there are none.

    NumPy's own takes twenty times as long on many short rows.
    """
    # NaN is sorted to the end, so the first ``known`` of a row are its values.
    ordered, row = np.sort(values, axis=-1), np.arange(len(values))
    low, high = ordered[row, np.maximum(known - 1, 0) // 2], ordered[row, known // 2]
    return np.asarray(np.where(known > 0, (low + high) * values.dtype.type(0.5), values.dtype.type(np.nan)))


def fit_affinity(origin: Floats, moved: Floats, use: Bools, at: Floats) -> tuple[Floats, Floats]:
    """Affinity (n, 2, 2) and displacement (n, 2) at points ``at`` (n, 2) from the nearest pairs ``origin -> moved``.

    Least squares, reweighted by Cauchy's weights of one pixel, so that a neighbour on another surface counts little. A
    weak pull towards the rotation and scale that all pairs share keeps neighbours on a line from inventing a change of
    shape. Too few pairs: no change.
    """
    n = len(at)
    identity, nothing = np.tile(np.eye(2), (n, 1, 1)), np.zeros((n, 2))
    p, q = origin[use], moved[use]
    # Six numbers need three pairs; with fewer than twice that, a wrong pair is not seen.
    if len(p) < 6 or n == 0:
        return identity, nothing
    common = common_similarity(p, q)
    affinity, shift = identity, nothing
    _fit_all(
        np.ascontiguousarray(p, dtype=np.float64),
        np.ascontiguousarray(q - p, dtype=np.float64),
        common,
        # A point that is lost gets an affinity like any other, which nobody reads.
        np.nan_to_num(at),
        affinity,
        shift,
    )
    return affinity, shift


@njit(cache=True, nogil=True)
def _fit_all(origin, moved_by, common, at, affinity, displacement):  # type: ignore[no-untyped-def]
    """:func:`fit_affinity` of every point ``at``; the nearest are taken in the order of distance, then of number."""
    count = min(NEIGHBOURS, len(origin))
    who, far = np.empty(count, np.int64), np.empty(count)
    offset, shift, weight = np.empty((count, 3)), np.empty((count, 2)), np.empty(count)
    normal, right = np.empty((3, 3)), np.empty((3, 2))
    offset[:, 2] = 1.0
    for n in range(len(at)):
        _nearest(origin, at[n, 0], at[n, 1], who, far)
        for k in range(count):
            x, y = origin[who[k], 0] - at[n, 0], origin[who[k], 1] - at[n, 1]
            offset[k, 0], offset[k, 1] = x, y
            # What the common similarity leaves: the pull below is then towards it, not towards no change.
            shift[k, 0] = moved_by[who[k], 0] - (common[0, 0] - 1.0) * x - common[0, 1] * y
            shift[k, 1] = moved_by[who[k], 1] - common[1, 0] * x - (common[1, 1] - 1.0) * y
            weight[k] = 1.0
        # A fixed number of rounds: the result then never hangs on a rounding that decides whether one more is done.
        for _ in range(4):
            normal[:], right[:] = 0.0, 0.0
            total = 0.0
            for k in range(count):
                total += weight[k]
                for i in range(3):
                    a = weight[k] * offset[k, i]
                    for j in range(3):
                        normal[i, j] += a * offset[k, j]
                    right[i, 0] += a * shift[k, 0]
                    right[i, 1] += a * shift[k, 1]
            # In proportion to the weights, so that the pull is that of a spread in pixels whatever the neighbours'
            # weights.
            normal[0, 0] += PULL**2 * total
            normal[1, 1] += PULL**2 * total
            # All weights may have become small: the shift must stay solvable.
            normal[2, 2] += 1e-6
            solve_3(normal, right)
            for k in range(count):
                square = 0.0
                for i in range(2):
                    fitted = right[0, i] * offset[k, 0] + right[1, i] * offset[k, 1] + right[2, i]
                    square += (shift[k, i] - fitted) ** 2
                # Cauchy's weight of a residual in units of one pixel.
                weight[k] = 1.0 / (1.0 + square)
        for i in range(2):
            affinity[n, i, 0], affinity[n, i, 1] = common[i, 0] + right[0, i], common[i, 1] + right[1, i]
            displacement[n, i] = right[2, i]


@njit(cache=True, nogil=True)
def _nearest(points, x, y, who, far):  # type: ignore[no-untyped-def]
    """Numbers and squared distances of the points nearest to (x, y), nearest first, by insertion."""
    count = len(who)
    far[:] = np.inf
    who[:] = 0
    for m in range(len(points)):
        d = (points[m, 0] - x) ** 2 + (points[m, 1] - y) ** 2
        # Of equal distances the lower number, which came first, stays.
        if d >= far[count - 1]:
            continue
        k = count - 1
        while k > 0 and far[k - 1] > d:
            far[k], who[k] = far[k - 1], who[k - 1]
            k -= 1
        far[k], who[k] = d, m


@njit(cache=True, nogil=True)
def solve_3(a, b):  # type: ignore[no-untyped-def]
    """Solve a x = b (3, 2) in place for a symmetric positive matrix."""
    for i in range(3):
        for j in range(i + 1, 3):
            f = a[j, i] / a[i, i]
            for k in range(i, 3):
                a[j, k] -= f * a[i, k]
            b[j, 0] -= f * b[i, 0]
            b[j, 1] -= f * b[i, 1]
    for i in range(2, -1, -1):
        for c in range(2):
            for k in range(i + 1, 3):
                b[i, c] -= a[i, k] * b[k, c]
            b[i, c] /= a[i, i]


def common_similarity(origin: Floats, moved: Floats) -> Floats:
    """Rotation and scale (2, 2) in the image that pairs (n, 2) share.

    The mean turn and the median stretch of the lines between pairs, all lines counting alike.
    """
    # Lines between pairs half the list apart, as complex numbers: a quotient is a turn and a stretch.
    p, q = ((a - np.roll(a, len(a) // 2, axis=0)) @ np.array([1.0, 1.0j]) for a in (origin, moved))
    long = (np.abs(p) > 0) & (np.abs(q) > 0)
    ratio = q[long] / p[long]
    # A mean of unit vectors, since angles have no mean across half a turn; outliers are few and of length 1.
    mean = (ratio / np.abs(ratio)).sum()
    if np.abs(mean) == 0:
        return np.eye(2)
    turn = np.median(np.abs(ratio)) * mean / np.abs(mean)
    return np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
