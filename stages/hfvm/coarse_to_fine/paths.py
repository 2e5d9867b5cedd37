"""Propagation along paths: each pixel chooses among a few candidate displacements (preset ``accurate``).

A pixel's candidates are its own displacement and those a pixel beside it, those of near and farther pixels, and those
handed down from the coarser level (paper, 4.3.4): a short list, not a range of disparities. Along six directions (eight
but for those within a row) each candidate gathers the least cost of getting there from the border of the image,
smoothness included; the candidate of least total wins. So evidence travels over weak texture as far as it must, and
stops at depth edges, where smoothness is truncated, the sooner the greater the grey step.

All costs are integers, candidates come in a fixed order and only a strictly lower cost wins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.level.features import Words
from rille.stages.hfvm.native.problem import Pair, PathCosts, pack_map, unpacked
from rille.stages.hfvm.native.solver import solver


class LevelView(NamedTuple):
    """One image at one level (row, col): both feature sets (uint64) and grey values (float32)."""

    words: Words
    compact: Words
    grey: AnyArray


def propagate(
    left: LevelView,
    right: LevelView,
    start: tuple[AnyArray, AnyArray],
    up: tuple[AnyArray, AnyArray] | None,
    band: tuple[AnyArray, float],
    costs: PathCosts,
    rounds: int,
) -> tuple[AnyArray, AnyArray]:
    """Improved integer map.

    Parameters
    ----------
    left, right : images of one level.
    start : columns and rows of displacement (row, col) int16 to start from.
    up : the same of the level above, whose doubled values are candidates too, or None.
    band : fundamental matrix, and byte steps per pixel off a line.
    """
    pair = Pair(left.words, right.words, *band)
    shift = pack_map(*start)
    for _ in range(rounds):
        found = solver.candidates(pair, (left.compact, right.compact), shift, up, costs)
        total = np.zeros(found.cost.shape, np.int32)
        # Three directions each; the two within a row are left out to save time.
        for backward in (False, True):
            solver.sweep(found, left.grey, costs, backward, total)
        solver.choose(found, total, shift)
    return unpacked(shift)
