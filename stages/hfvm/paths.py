"""Propagation along paths: each pixel chooses among a few candidate displacements (preset ``accurate``).

A pixel's candidates are its own displacement and those a pixel beside it, those of near and farther pixels, and those
handed down from the coarser level (paper, 4.3.4): a short list, not a range of disparities. Along eight directions each
candidate gathers the least cost of getting there from the border of the image, smoothness included; the candidate of
least total wins. So evidence travels over weak texture as far as it must, and stops at depth edges, where smoothness is
truncated, the sooner the greater the grey step.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from stages.declare import AnyArray
from stages.features import Words, distance

MOST = 16
"""Candidates a pixel; further ones are left out."""

STEPS = np.array([[0, 0], [0, -1], [0, 1], [-1, 0], [1, 0]], np.int64)
"""Rows and columns added to a pixel's own displacement."""

OFFSETS = np.array(
    [[0, -1], [0, 1], [-1, 0], [1, 0], [-3, -3], [-3, 3], [3, -3], [3, 3], [0, -8], [0, 8], [-8, 0], [8, 0]], np.int64
)
"""Rows and columns from a pixel to those whose displacements it tries: beside it, beyond an edge, beyond a gap."""

UNIT = 4
"""Cost of a byte step of Table 1's features, so that weaker ones can be weighed as integers."""

OUTSIDE = 8000
"""Cost of a candidate that leads out of the other image: about that of unlike pixels, so that neighbours decide."""

NONE = 1 << 28
"""Cost where there is no candidate."""


@dataclass(frozen=True)
class View:
    """What is known of one image at one level: both feature sets, grey values (float32)."""

    words: Words
    compact: Words
    grey: AnyArray


@dataclass(frozen=True)
class Weights:
    """Costs in quarters of a byte step; ``grey`` in grey levels.

    ``compact``: a byte step of the compact features. ``small``: a pixel of difference to the pixel before. ``large``:
    the most that any difference costs; at a step of ``grey`` grey levels between both pixels half of it.
    """

    compact: int
    small: int
    large: int
    grey: float


def propagate(
    left: View,
    right: View,
    start: tuple[AnyArray, AnyArray],
    up: tuple[AnyArray, AnyArray] | None,
    lines: AnyArray,
    mu: float,
    weights: Weights,
    rounds: int,
) -> tuple[AnyArray, AnyArray]:
    """Improved integer map.

    Parameters
    ----------
    left, right : images of one level.
    start : columns and rows of displacement (row, col) int16 to start from.
    up : the same of the level above, whose doubled values are candidates too, or None.
    lines : (row, col, 3) epipolar line of each pixel, not read where ``mu`` is 0.
    mu : byte steps per pixel off the line.
    """
    u, v = start
    shape = (*u.shape, MOST)
    nothing = np.zeros((0, 0), np.int16)
    up_u, up_v = up or (nothing, nothing)
    cu, cv, cost = np.empty(shape, np.int16), np.empty(shape, np.int16), np.empty(shape, np.int32)
    for _ in range(rounds):
        _gather(
            left.words, right.words, left.compact, right.compact, weights.compact, u, v, up_u, up_v, STEPS, OFFSETS,
            lines, mu, cu, cv, cost
        )  # fmt: skip
        total = np.zeros(shape, np.int32)
        for backward in (False, True):
            _sweep(cu, cv, cost, left.grey, weights.small, weights.large, weights.grey, backward, total)
        u, v = np.empty_like(u), np.empty_like(v)
        _choose(cu, cv, cost, total, u, v)
    return u, v


@njit(cache=True, nogil=True)
def _gather(  # type: ignore[no-untyped-def]
    left, right, near, right_near, share, u_map, v_map, up_u, up_v, steps, offsets, lines, mu, cu, cv, cost
):
    """Candidates of every pixel, and what each costs by itself: feature distances and distance from its line."""
    rows, cols = left.shape
    rrows, rcols = right.shape
    crows, ccols = up_u.shape
    own, others = len(steps), len(offsets)
    for y in range(rows):
        for x in range(cols):
            n = 0
            for k in range(own + others + 9):
                if n == MOST:
                    break
                if k < own:
                    u, v = np.int64(u_map[y, x]) + steps[k, 1], np.int64(v_map[y, x]) + steps[k, 0]
                elif k < own + others:
                    j, i = y + offsets[k - own, 0], x + offsets[k - own, 1]
                    if j < 0 or j >= rows or i < 0 or i >= cols:
                        continue
                    u, v = np.int64(u_map[j, i]), np.int64(v_map[j, i])
                else:
                    j, i = y // 2 + (k - own - others) // 3 - 1, x // 2 + (k - own - others) % 3 - 1
                    if j < 0 or j >= crows or i < 0 or i >= ccols:
                        continue
                    u, v = 2 * np.int64(up_u[j, i]), 2 * np.int64(up_v[j, i])
                xr, yr = x + u, y + v
                inside = xr >= 0 and xr < rcols and yr >= 0 and yr < rrows
                known = k > 0 and not inside
                for m in range(n):
                    known |= cu[y, x, m] == u and cv[y, x, m] == v
                if known:
                    continue
                c = np.int64(OUTSIDE)
                if inside:
                    c = UNIT * distance(left[y, x], right[yr, xr])
                    c += share * distance(near[y, x], right_near[yr, xr])
                if mu > 0:
                    c += np.int64((UNIT + share) * mu * abs(lines[y, x, 0] * u + lines[y, x, 1] * v + lines[y, x, 2]))
                cu[y, x, n], cv[y, x, n], cost[y, x, n] = u, v, min(c, 2 * OUTSIDE)
                n += 1
            for m in range(n, MOST):
                cu[y, x, m], cv[y, x, m], cost[y, x, m] = 0, 0, NONE


@njit(cache=True, nogil=True)
def _sweep(cu, cv, cost, grey, small, large, half, backward, total):  # type: ignore[no-untyped-def]
    """Add four directions: from the left, upper left, above and upper right; ``backward``: their opposites."""
    rows, cols = grey.shape
    # The border before an image counts as a pixel without candidates: nothing is gathered there.
    before = np.zeros((4, cols, MOST), np.int32)
    after = np.zeros((4, cols, MOST), np.int32)
    low = np.int32(small)
    s = -1 if backward else 1
    for row in range(rows):
        y = rows - 1 - row if backward else row
        for col in range(cols):
            x = cols - 1 - col if backward else col
            for d in range(4):
                j = y if d == 0 else y - s
                i = x - s if d == 0 else x + s * (d - 2)
                here = after[d, x]
                if j < 0 or j >= rows or i < 0 or i >= cols:
                    for k in range(MOST):
                        here[k] = cost[y, x, k]
                        if cost[y, x, k] != NONE:
                            total[y, x, k] += cost[y, x, k]
                    continue
                path = after[0, i] if d == 0 else before[d, i]
                least = path[0]
                for m in range(1, MOST):
                    least = min(least, path[m])
                step = abs(grey[y, x] - grey[j, i])
                far = np.int32(max(np.float32(large) / (np.float32(1.0) + step / np.float32(half)), 2 * low))
                for k in range(MOST):
                    if cost[y, x, k] == NONE:
                        here[k] = NONE
                        continue
                    u, v = np.int32(cu[y, x, k]), np.int32(cv[y, x, k])
                    best = np.int32(least + far)
                    for m in range(MOST):
                        gap = np.int32(abs(np.int32(cu[j, i, m] - u)) + abs(np.int32(cv[j, i, m] - v)))
                        best = min(best, np.int32(path[m] + min(np.int32(low * gap), far)))
                    here[k] = np.int32(cost[y, x, k] + best - least)
                    total[y, x, k] += here[k]
        before, after = after, before


@njit(cache=True, nogil=True)
def _choose(cu, cv, cost, total, out_u, out_v):  # type: ignore[no-untyped-def]
    rows, cols = out_u.shape
    for y in range(rows):
        for x in range(cols):
            best = 0
            for k in range(1, MOST):
                if cost[y, x, k] != NONE and total[y, x, k] < total[y, x, best]:
                    best = k
            out_u[y, x], out_v[y, x] = cu[y, x, best], cv[y, x, best]
