"""Standard deviation of elevations that both directions of matching gave and both images refined.

A sum of variances, each of which can be seen on the ground itself. With s the pixels of disparity a metre of elevation,

    (s sigma_Z)^2 = FLOOR^2 + t^2 / 2 + r^2 / (2 I) + (SHADE N / g)^2 + (APART d)^2 + (MOVED m)^2

t: the step of Z from cell to cell (RMS of 3 x 3 cells), since a position that is wrong by a part of a cell is an
elevation that is wrong by as much of its step. r: what both images still differ by (RMS of 5 x 5 cells), I: the sum of
the squared gradients there, so that r^2 / I is what least squares expects of such differences. N: the differences of
the whole pair (robust), g: the grey value. In a shadow the gradients found are those of noise; what contrast there can
be, brightness says. d: the difference of both directions (RMS of 5 x 5 cells), :data:`ALONE` where none of them has
both. m: how far the refinement moved the cells (RMS of 5 x 5 cells): what the disparity and the ground disagree about,
neither is sure of.

The factors are those of a fit by non-negative least squares to the squared errors of pairs of the simulator's seeds 2
and 3 (preset ``accurate`` of the matcher) on 22 November 2026, rounded. The default seed, which figures are given for,
had no part in it; ``benchmarks/surest.py`` prints the shares of its errors below one and two standard deviations.
"""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.numeric.robust import mad_sigma
from rille.stages.numeric.windows import window_sum
from rille.stages.terrain.locus.views import OrthoPair

FLOOR = 0.03
"""Pixels of disparity."""
STEP = 0.5
"""Of the squared step: a position is uncertain by 0.7 cells."""
REST = 0.5
"""Of r^2 / I."""
SHADE = 1.9
"""Of noise over grey value: what is left of the ground's contrast in the dark."""
APART = 0.87
ALONE = 0.2
"""Pixels of disparity: difference of both directions where only one of them found something."""
MOVED = 1.7
LEAST_GRADIENT = 1.0
"""Squared grey levels a pixel, of each cell: so that a blank wall is not divided by."""
STEP_SIDE, NEAR_SIDE, MEAN_SIDE = 3, 5, 15
"""Cells: sides of the windows of t, of all others, and of the local mean that differences go without."""


def from_both(elevation: Floats32, seen: OrthoPair, moved: Floats, apart: Floats, otherwise: Floats) -> Floats:
    """Standard deviation of each cell, metres, see the module.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN undefined.
    seen : as :func:`rille.stages.terrain.locus.refinement.refine` gives it for these elevations.
    moved : (rows, cols) what the refinement moved each cell by, metres.
    apart : (rows, cols) difference of both directions' elevations, metres, NaN where not both gave one.
    otherwise : (rows, cols) the standard deviation of cells that the images do not show, metres.
    """
    known = np.isfinite(elevation) & np.isfinite(seen.scale)
    if not known.any():
        return otherwise
    scale = np.where(known, seen.scale, 1.0).astype(np.float64)
    rest = np.where(known, seen.left - seen.right, 0.0).astype(np.float64)
    rest = np.where(known, rest - _mean(rest, known, MEAN_SIDE), 0.0)
    # About 0: the local mean is gone already.
    noise = mad_sigma(rest[known], 0.0)
    grey = np.maximum(_mean(np.where(known, seen.left, 0.0), known, NEAR_SIDE), max(noise, 1.0))
    both = known & np.isfinite(apart)
    differ = _mean(np.where(both, np.square(scale * apart), 0.0), both, NEAR_SIDE)
    differ[window_sum(both, NEAR_SIDE) < 1.0] = ALONE**2
    variance = FLOOR**2 + STEP * _mean(_steps(elevation, scale, known), known, STEP_SIDE)
    variance += REST * _mean(np.square(rest), known, NEAR_SIDE) / _gradients(seen, scale, known)
    variance += np.square(SHADE * noise / grey) + APART**2 * differ
    variance += MOVED**2 * _mean(np.where(known, np.square(scale * moved), 0.0), known, NEAR_SIDE)
    # Differences of running sums may fall below zero by their rounding.
    return np.where(known, np.sqrt(np.maximum(variance, FLOOR**2)) / scale, otherwise)


def _gradients(seen: OrthoPair, scale: Floats, known: Bools) -> Floats:
    """Sum of the squared gradients around each cell, squared grey levels a pixel of disparity."""
    slope = np.where(known, seen.right_slope - seen.left_slope, 0.0) / scale
    power = np.square(slope) * np.where(known, np.minimum(seen.area, 1.0), 0.0)
    return np.maximum(window_sum(power, NEAR_SIDE), 0.0) + LEAST_GRADIENT * NEAR_SIDE**2


def _steps(elevation: Floats32, scale: Floats, known: Bools) -> Floats:
    """Squared steps to the four neighbours of each cell, pixels of disparity; 0 where one of them is unknown."""
    z = np.where(known, elevation.astype(np.float64), np.nan)
    out = np.zeros(z.shape)
    across, down = z[1:-1, 2:] - z[1:-1, :-2], z[2:, 1:-1] - z[:-2, 1:-1]
    inner = (slice(1, -1), slice(1, -1))
    steps = np.square(0.5 * scale[inner]) * (across**2 + down**2)
    out[inner] = np.where(np.isfinite(steps) & known[inner], steps, 0.0)
    return out


def _mean(values: Floats, known: Bools, side: int) -> Floats:
    """Mean over the known cells of a window of values that are 0 elsewhere."""
    return window_sum(values, side) / np.maximum(window_sum(known, side), 1.0)
