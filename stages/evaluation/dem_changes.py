"""Changes between two elevation models of one place: where, by how much, and how certain.

The standard deviation s of a difference combines those of both models and the effect of a remaining shift by a part of
a cell on a slope. It is scaled up if most differences spread more, since most of the ground is unchanged. A change is
a patch of cells that differ in one direction by 2 s, one of them at least by :data:`SURE` s. Its volume is summed over
the patch and the cells around it. The standard deviation of the volume takes the correlation of neighbouring errors
from ground that has not changed; a change whose volume is less than :data:`SURE_VOLUME` times that is not listed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy

from rille.stages.core.arrays import Bools, Floats
from rille.stages.numeric.robust import mad_sigma
from rille.stages.terrain.relief.grid import Grid

SHIFT_CELLS = 0.25
"""Cells: remaining shift between the models."""

SURE, BESIDE, SURE_VOLUME = 4.5, 2.0, 3.5
"""Least standard deviations of one cell of a change, of all its cells, and of its volume."""

FOOT = 2
"""Cells around a patch in which a change tapers off, too little for single cells to show."""

BLOCK = 5
"""Cells: side of the blocks whose means show how far errors of neighbours correlate."""


@dataclass(frozen=True)
class Change:
    """A patch of ground that rose or fell: its centre, its greatest difference of either sign, area and volume.

    The volume is negative if it fell, and has a standard deviation.
    """

    x_m: float
    y_m: float
    cells: int
    greatest_m: float
    area_m2: float
    volume_m3: float
    sigma_m3: float


def standard_deviation(error: Floats, sigma: Floats, slope: Floats, cell: float) -> Floats:
    """Standard deviation (rows, cols), metres, of differences of unchanged ground.

    Parameters
    ----------
    error : (rows, cols) differences, metres, NaN unknown.
    sigma : (rows, cols) standard deviation of the differences as stated by the models; 0 unknown.
    slope : (rows, cols) metres a metre.
    cell : metres.
    """
    # Where no model states a standard deviation: the spread of the differences, because flat cells would have none.
    known = np.where(np.isfinite(sigma) & (sigma > 0), sigma, mad_sigma(error[np.isfinite(error)]))
    expected = np.hypot(known, SHIFT_CELLS * cell * np.nan_to_num(slope))
    usable = np.isfinite(error) & (expected > 0)
    ratio = error[usable] / expected[usable]
    # Never reduced, although errors that two models share cancel in the difference.
    return np.asarray(expected * max(mad_sigma(ratio) if ratio.size else 1.0, 1.0))


def changes(error: Floats, deviation: Floats, grid: Grid) -> list[Change]:
    """Changes, the greatest volume first, by differences and their :func:`standard_deviation`, both (rows, cols).

    ``grid`` says where their cells are.
    """
    ratio = np.divide(error, deviation, out=np.zeros_like(error), where=np.isfinite(error) & (deviation > 0))
    shared = _shared(ratio, np.abs(ratio) < BESIDE)
    found = []
    for sign in (1.0, -1.0):
        label, number = scipy.ndimage.label(sign * ratio > BESIDE)
        for k, (rows, cols) in enumerate(scipy.ndimage.find_objects(label, number), 1):
            up, left = (slice(max(one.start - FOOT, 0), one.stop + FOOT) for one in (rows, cols))
            window = up, left
            patch = label[window] == k
            # Single matches make smaller patches.
            if patch.sum() < 6 or (sign * ratio[window][patch]).max() < SURE:
                continue
            patch = scipy.ndimage.binary_dilation(patch, iterations=FOOT) & np.isfinite(error[window])
            change = _change(error[window], deviation[window] * math.sqrt(shared), patch, grid.part(window))
            if sign * change.volume_m3 > SURE_VOLUME * change.sigma_m3:
                found.append(change)
    return sorted(found, key=lambda change: -abs(change.volume_m3))


def _change(error: Floats, deviation: Floats, patch: Bools, grid: Grid) -> Change:
    """The change of a patch; all arrays are of one window."""
    difference, area = error[patch], grid.cell**2
    x, y = np.abs(difference) @ grid.centres()[patch] / np.abs(difference).sum()
    greatest = float(difference[np.argmax(np.abs(difference))])
    cells, sigma = len(difference), area * float(np.sqrt(np.sum(deviation[patch] ** 2)))
    return Change(float(x), float(y), cells, greatest, cells * area, float(difference.sum()) * area, sigma)


def _shared(ratio: Floats, still: Bools) -> float:
    """Variance of a sum of neighbouring errors over that of as many independent ones; 1 if too few cells are known."""
    rows, cols = (n // BLOCK * BLOCK for n in ratio.shape)
    blocks = [
        a[:rows, :cols].reshape(rows // BLOCK, BLOCK, cols // BLOCK, BLOCK).swapaxes(1, 2).reshape(-1, BLOCK**2)
        for a in (ratio, still & (ratio != 0))
    ]
    whole = blocks[0][blocks[1].all(axis=1)]
    if len(whole) <= BLOCK or whole.var() == 0:
        return 1.0
    return max(1.0, BLOCK**2 * float(whole.mean(axis=1).var() / whole.var()))


def listed(error: Floats, grid: Grid, sigmas: Sequence[Floats | None]) -> tuple[Floats, dict[str, Any]]:
    """Standard deviation (rows, cols), m, of differences on a grid, and a list (JSON-able) of the changes.

    ``sigmas``: standard deviations (rows, cols), m, of the models, as far as they are known.
    """
    stated = np.sqrt(sum((sigma**2 for sigma in sigmas if sigma is not None), np.zeros(error.shape)))
    deviation = standard_deviation(error, stated, np.hypot(*grid.slopes()), grid.cell)
    found, total = changes(error, deviation, grid), {}
    for way, sign in (("rose", 1), ("fell", -1)):
        of = [one for one in found if sign * one.volume_m3 > 0]
        sigma_m3 = math.hypot(*(one.sigma_m3 for one in of))
        total[way] = {"volume_m3": sum(one.volume_m3 for one in of), "sigma_m3": sigma_m3}
    how = (
        f"patches of cells that differ one way by {BESIDE:g} standard deviations, one of them by {SURE:g}, their "
        f"volume by {SURE_VOLUME:g} of its own; standard deviations of both models and of a shift by {SHIFT_CELLS:g} "
        "cells, scaled up where most differences spread more"
    )
    return deviation, {"total": total, "patches": [asdict(one) for one in found], "how": how}
