"""Propagation along paths: each pixel chooses among a few candidate displacements (preset ``accurate``).

A pixel's candidates are its own displacement and those a pixel beside it, those of near and farther pixels, and those
handed down from the coarser level (paper, 4.3.4): a short list, not a range of disparities. Along eight directions each
candidate gathers the least cost of getting there from the border of the image, smoothness included; the candidate of
least total wins. So evidence travels over weak texture as far as it must, and stops at depth edges, where smoothness is
truncated, the sooner the greater the grey step.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins. The vector code of both
steps is in :mod:`rille.stages.hfvm.coarse_to_fine.path_simd`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.coarse_to_fine import path_simd
from rille.stages.hfvm.coarse_to_fine.path_simd import MOST, NONE, UNIT
from rille.stages.hfvm.level.features import Words
from rille.stages.hfvm.level.propagation import pack_map, unpack

OFFSETS = np.array(
    [[0, -1], [0, 1], [-1, 0], [1, 0], [-3, -3], [-3, 3], [3, -3], [3, 3], [0, -8], [0, 8], [-8, 0], [8, 0]], np.int64
)
"""Rows and columns from a pixel to those whose displacements it tries: beside it, beyond an edge, beyond a gap; at the
image's border the nearest pixel inside stands for one outside."""

UP = 9
"""Pixels of the coarser level whose doubled displacements are tried: the one above and those around it."""


@dataclass(frozen=True)
class LevelView:
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
    left: LevelView,
    right: LevelView,
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
    shape = start[0].shape
    maps = np.empty(shape, np.int32)
    pack_map(*start, maps)
    above = maps if up is None else _doubled(*up)
    places = np.empty(len(OFFSETS) + UP, np.int64)
    cu, cv, cost = (np.empty((*shape, MOST), np.int16) for _ in range(3))
    total = np.empty((*shape, MOST), np.int32)
    for _ in range(rounds):
        _gather(
            left.words, right.words, left.compact, right.compact, weights.compact, maps, above, up is not None, OFFSETS,
            lines, mu, places, cu, cv, cost
        )  # fmt: skip
        total[:] = 0
        for backward in (False, True):
            _sweep(cu, cv, cost, left.grey, weights.small, weights.large, weights.grey, backward, total)
        _choose(cu, cv, cost, total, maps)
    u, v = np.empty(shape, np.int16), np.empty(shape, np.int16)
    unpack(maps, u, v)
    return u, v


def _doubled(u: AnyArray, v: AnyArray) -> AnyArray:
    """Packed doubled displacements."""
    packed = np.empty(u.shape, np.int32)
    pack_map((2 * u).astype(np.int16), (2 * v).astype(np.int16), packed)
    return packed


@njit(cache=True, nogil=True)
def _gather(  # type: ignore[no-untyped-def]
    left, right, near, right_near, share, maps, above, has_above, offsets, lines, mu, places, cu, cv, cost
):
    """Candidates of every pixel, and what each costs by itself: feature distances and distance from its line."""
    rows, cols = left.shape
    rrows, rcols = right.shape
    crows, ccols = above.shape
    others = len(offsets)
    words, right_words, compact, right_compact = (
        left.reshape(-1), right.reshape(-1), near.reshape(-1), right_near.reshape(-1)
    )  # fmt: skip
    packed, coarse = maps.reshape(-1), above.reshape(-1)
    a = b = c = np.float32(0.0)
    for y in range(rows):
        for x in range(cols):
            at = y * cols + x
            for k in range(others):
                j, i = y + offsets[k, 0], x + offsets[k, 1]
                places[k] = min(max(j, 0), rows - 1) * cols + min(max(i, 0), cols - 1)
            for k in range(UP):
                j, i = y // 2 + k // 3 - 1, x // 2 + k % 3 - 1
                place = min(max(j, 0), crows - 1) * ccols + min(max(i, 0), ccols - 1)
                places[others + k] = place if has_above else at
            if mu > 0:
                a, b, c = lines[y, x, 0], lines[y, x, 1], lines[y, x, 2]
            path_simd.gather(
                words, right_words, compact, right_compact, share, rrows, rcols, x, y, at, packed, coarse, places,
                a, b, c, (UNIT + share) * mu, cu[y, x], cv[y, x], cost[y, x]
            )  # fmt: skip


@njit(cache=True, nogil=True)
def _sweep(cu, cv, cost, grey, small, large, half, backward, total):  # type: ignore[no-untyped-def]
    """Add four directions: from the left, upper left, above and upper right; ``backward``: their opposites."""
    rows, cols = grey.shape
    # The border before an image counts as a pixel without candidates: nothing is gathered there.
    before = np.zeros((4, cols, MOST), np.int16)
    after = np.zeros((4, cols, MOST), np.int16)
    us, vs, costs, totals = cu.reshape(-1), cv.reshape(-1), cost.reshape(-1), total.reshape(-1)
    s = -1 if backward else 1
    for row in range(rows):
        y = rows - 1 - row if backward else row
        for col in range(cols):
            x = cols - 1 - col if backward else col
            at = (y * cols + x) * MOST
            for d in range(4):
                j = y if d == 0 else y - s
                i = x - s if d == 0 else x + s * (d - 2)
                if j < 0 or j >= rows or i < 0 or i >= cols:
                    for k in range(MOST):
                        after[d, x, k] = cost[y, x, k]
                        totals[at + k] += cost[y, x, k]
                    continue
                path = after[0, i] if d == 0 else before[d, i]
                change = abs(grey[y, x] - grey[j, i])
                far = np.int64(max(np.float32(large) / (np.float32(1.0) + change / np.float32(half)), 2 * small))
                there = (j * cols + i) * MOST
                path_simd.step(us, vs, costs, path, there, after[d, x], 0, totals, at, small, far)
        before, after = after, before


@njit(cache=True, nogil=True)
def _choose(cu, cv, cost, total, maps):  # type: ignore[no-untyped-def]
    """Packed displacement of least total; the first of equal ones."""
    rows, cols = maps.shape
    for y in range(rows):
        for x in range(cols):
            best = 0
            for k in range(1, MOST):
                if cost[y, x, k] != NONE and total[y, x, k] < total[y, x, best]:
                    best = k
            maps[y, x] = (np.int32(cv[y, x, best]) << np.int32(16)) | (np.int32(cu[y, x, best]) & np.int32(0xFFFF))
