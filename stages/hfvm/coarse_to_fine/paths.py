"""Propagation along paths: each pixel chooses among a few candidate displacements (preset ``accurate``).

A pixel's candidates are its own displacement and those a pixel beside it, those of near and farther pixels, and those
handed down from the coarser level (paper, 4.3.4): a short list, not a range of disparities. Along six directions (eight
but for those within a row) each candidate gathers the least cost of getting there from the border of the image,
smoothness included; the candidate of least total wins. So evidence travels over weak texture as far as it must, and
stops at depth edges, where smoothness is truncated, the sooner the greater the grey step.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins. One step of a direction is
vector code (:mod:`rille.stages.hfvm.coarse_to_fine.path_simd`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.coarse_to_fine import path_simd
from rille.stages.hfvm.coarse_to_fine.path_simd import MOST, NONE
from rille.stages.hfvm.level.features import Words, distance
from rille.stages.hfvm.level.propagation import columns, pack, pack_map, rows_of, unpack

UNIT = 4
"""Cost of a byte step of Table 1's features, so that weaker ones can be weighed as integers."""

OUTSIDE = 8000
"""Cost of a candidate that leads out of the other image: about that of unlike pixels, so that neighbours decide."""

OWN = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))
"""Rows and columns added to a pixel's own displacement."""

AROUND = ((0, -1), (0, 1), (-1, 0), (1, 0), (-3, -3), (-3, 3), (3, -3), (3, 3), (0, -8), (0, 8), (-8, 0), (8, 0))
"""Rows and columns from a pixel to those whose displacements it tries: beside it, beyond an edge, beyond a gap; at the
image's border the nearest pixel inside stands for one outside."""

ABOVE = tuple((j, i) for j in (-1, 0, 1) for i in (-1, 0, 1))
"""Rows and columns from the pixel of the coarser level above to those whose doubled displacements are tried."""


class LevelView(NamedTuple):
    """One image at one level (row, col): both feature sets (uint64) and grey values (float32)."""

    words: Words
    compact: Words
    grey: AnyArray


class Candidates(NamedTuple):
    """Candidates of each pixel (row, col, :data:`MOST`) int16: columns and rows of displacement, and matching cost."""

    u: AnyArray
    v: AnyArray
    cost: AnyArray


class Weights(NamedTuple):
    """Costs in quarters of a byte step; ``grey`` in grey levels.

    ``compact``: a byte step of the compact features. ``small``: a pixel of difference to the pixel before. ``large``:
    the most that any difference costs; at a step of ``grey`` grey levels between both pixels half of it.
    """

    compact: int
    small: int
    large: int
    grey: float


def propagate(
    left: LevelView,
    right: LevelView,
    start: tuple[AnyArray, AnyArray],
    up: tuple[AnyArray, AnyArray] | None,
    band: tuple[AnyArray, float],
    weights: Weights,
    rounds: int,
) -> tuple[AnyArray, AnyArray]:
    """Improved integer map.

    Parameters
    ----------
    left, right : images of one level.
    start : columns and rows of displacement (row, col) int16 to start from.
    up : the same of the level above, whose doubled values are candidates too, or None.
    band : epipolar line of each pixel (row, col, 3), and byte steps per pixel off it; lines are not read where they
        are 0.
    """
    shape = start[0].shape
    maps = np.empty(shape, np.int32)
    pack_map(*start, maps)
    above = np.empty((0, 0), np.int32) if up is None else _doubled(*up)
    found = Candidates(*(np.empty((*shape, MOST), np.int16) for _ in range(3)))
    total = np.empty((*shape, MOST), np.int32)
    for _ in range(rounds):
        _gather(left, right, weights.compact, maps, above, band, found)
        total[:] = 0
        # Three directions each; the two within a row are left out to save time.
        for backward in (False, True):
            _sweep(found, left.grey, weights, backward, total)
        _choose(found, total, maps)
    u, v = np.empty(shape, np.int16), np.empty(shape, np.int16)
    unpack(maps, u, v)
    return u, v


def _doubled(u: AnyArray, v: AnyArray) -> AnyArray:
    """Packed doubled displacements."""
    packed = np.empty(u.shape, np.int32)
    pack_map((2 * u).astype(np.int16), (2 * v).astype(np.int16), packed)
    return packed


@njit(cache=True, nogil=True)
def _gather(left, right, share, maps, above, band, found):  # type: ignore[no-untyped-def]
    """Candidates of every pixel, each once, and what each costs by itself; the first :data:`MOST` of them.

    In this order: the pixel's own displacement, :data:`OWN` steps from it, those of the pixels :data:`AROUND` it, those
    of the coarser level. All but the first must lead into the right image. ``share``: cost of a byte step of compact
    features; ``band``: lines, and byte steps a pixel off them.
    """
    rows, cols = maps.shape
    right_rows, right_cols = right.words.shape
    lines, mu = band
    us = np.empty(len(OWN) + len(AROUND) + len(ABOVE), np.int64)
    vs = np.empty_like(us)
    for y in range(rows):
        for x in range(cols):
            tried = 0
            for j, i in OWN:
                us[tried], vs[tried] = columns(maps[y, x]) + i, rows_of(maps[y, x]) + j
                tried += 1
            for j, i in AROUND:
                near = maps[_inside(y + j, rows), _inside(x + i, cols)]
                us[tried], vs[tried] = columns(near), rows_of(near)
                tried += 1
            if above.size:
                for j, i in ABOVE:
                    far = above[_inside(y // 2 + j, above.shape[0]), _inside(x // 2 + i, above.shape[1])]
                    us[tried], vs[tried] = columns(far), rows_of(far)
                    tried += 1
            count = 0
            for n in range(tried):
                u, v = us[n], vs[n]
                inside = 0 <= x + u < right_cols and 0 <= y + v < right_rows
                # Each once: there is room for few, and equal ones would take it from others.
                known = False
                for k in range(count):
                    known |= (found.u[y, x, k] == u) & (found.v[y, x, k] == v)
                if known or (n > 0 and not inside):
                    continue
                cost = np.int64(OUTSIDE)
                if inside:
                    cost = UNIT * distance(left.words[y, x], right.words[y + v, x + u])
                    cost += share * distance(left.compact[y, x], right.compact[y + v, x + u])
                if mu > 0:
                    a, b, c = np.float64(lines[y, x, 0]), np.float64(lines[y, x, 1]), np.float64(lines[y, x, 2])
                    cost += np.int64((UNIT + share) * mu * abs(a * u + b * v + c))
                # Leaves room below NONE for the greatest step, 10000.
                found.u[y, x, count], found.v[y, x, count], found.cost[y, x, count] = u, v, min(cost, 2 * OUTSIDE)
                count += 1
                if count == MOST:
                    break
            for k in range(count, MOST):
                found.u[y, x, k], found.v[y, x, k], found.cost[y, x, k] = 0, 0, NONE


@njit(cache=True, nogil=True)
def _inside(index, size):  # type: ignore[no-untyped-def]
    return min(max(index, 0), size - 1)


@njit(cache=True, nogil=True)
def _sweep(found, grey, weights, backward, total):  # type: ignore[no-untyped-def]
    """Add three directions: from the upper left, above and the upper right; ``backward``: their opposites."""
    rows, cols = grey.shape
    before = np.zeros((3, cols, MOST), np.int16)
    after = np.zeros((3, cols, MOST), np.int16)
    costs, totals = found.cost.reshape(-1), total.reshape(-1)
    candidates = found.u.reshape(-1), found.v.reshape(-1), costs
    large, half, small = np.float32(weights.large), np.float32(weights.grey), weights.small
    s = -1 if backward else 1
    for row in range(rows):
        y = rows - 1 - row if backward else row
        j = y - s
        for x in range(cols):
            at = (y * cols + x) * MOST
            for d in range(3):
                i = x + s * (d - 1)
                if j < 0 or j >= rows or i < 0 or i >= cols:
                    for k in range(MOST):
                        after[d, x, k] = costs[at + k]
                        totals[at + k] += costs[at + k]
                    continue
                change = abs(grey[y, x] - grey[j, i])
                # Small differences cost less than jumps even where the grey step is greatest.
                far = np.int64(max(large / (np.float32(1.0) + change / half), 2 * small))
                there = (j * cols + i) * MOST
                path_simd.step(candidates, (at, there), before[d, i], after[d, x], totals, (small, far))
        before, after = after, before


@njit(cache=True, nogil=True)
def _choose(found, total, maps):  # type: ignore[no-untyped-def]
    """Packed displacement of least total; the first of equal ones."""
    rows, cols = maps.shape
    for y in range(rows):
        for x in range(cols):
            best = 0
            for k in range(1, MOST):
                # Strictly less: the pixel's own displacement comes first and wins ties.
                if found.cost[y, x, k] != NONE and total[y, x, k] < total[y, x, best]:
                    best = k
            maps[y, x] = pack(np.int64(found.u[y, x, best]), np.int64(found.v[y, x, best]))
