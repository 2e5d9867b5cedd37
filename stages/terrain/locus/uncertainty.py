"""Standard deviation of elevations that were refined by both images.

It is a sum of variances. With s the pixels of disparity a metre of elevation,

    (s sigma_Z)^2 = FLOOR_PX^2 + STEP_FACTOR t^2 / min(A, 1) + REST_FACTOR r^2 / I + (SHADE_FACTOR N / g)^2
                    + MOVE_FACTOR m^2 / A + HOLE_VARIANCE_PX2 u + (DIFFERENCE_FACTOR d)^2,

times 2 - v where the ground turns away from the left camera, v < 1.

t: the step of Z from cell to cell (RMS of 3 x 3 cells), A: the pixels that a cell covers, so that t / sqrt(A) is the
step from pixel to pixel; since a position that is wrong by a part of a cell, or of a pixel where cells are finer, is an
elevation that is wrong by as much of its step. r: the remaining difference of both images (RMS of 5 x 5 cells), I: the
sum of the squared gradients there, so that r^2 / I is what least squares expects of such differences. N: the
differences of the whole pair (robust), g: the grey value. In a shadow the gradients are those of noise, so the grey
value stands for the contrast. m: how far the refinement moved the cells (RMS of 5 x 5 cells): the difference between
the elevations by the disparity and by the images, which errs the more the fewer pixels those cells cover. u: the
unknown share of 7 x 7 cells; a matching window beside hidden ground is the mean of two surfaces. d: the difference of
both directions of matching (RMS of 5 x 5 cells), :data:`ONE_SIDED_DIFFERENCE_PX` where none of them has both; 0 where
there was one direction.

v: the area in the image of 5 x 5 sloping cells over that of level ground there; 0 is seen edge-on, less cannot be seen,
and what is below locus.least_facing is left out (:func:`rille.stages.terrain.locus.views.edge_on`).
Where v is small a matching window covers more ground, some of which hides other ground.

The factors are those of a fit by non-negative least squares to the squared errors of pairs of the simulator (both
directions, preset ``accurate``, seeds 2 and 3, 22 November 2026), rounded; HOLE_VARIANCE_PX2, without which cells of
one direction look too certain beside hidden ground, was chosen on 27 November 2026 with figures of the seeds 1 to 6 at
hand: 72 % of their errors are below one and 93 % below two standard deviations where one direction was matched, 77 and
95 % with both. REST_FACTOR and MOVE_FACTOR were chosen on 30 November 2026, with the derivatives of
:mod:`rille.stages.terrain.locus.views`, on the seeds 1 to 3, rendered sand and a facade: 75, 70 and 65 % are below
one, 96, 93 and 88 % below two. The disparity's own standard deviation brings nothing besides.
``benchmarks/surest.py`` prints such shares. v was chosen on 28 November 2026 with three rougher beds, seeds 2 to 4, in
whose errors the ratio to the standard deviation rose from 1.5 where v is 1 to 2 where it is 0.1. A was brought in on 29
November 2026: of eight beds at focal lengths of 300 to 1200 px (seeds 1 to 3, one direction) the share below one
standard deviation was 55 to 87 % without it, 50 to 65 % in the smallest cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.numeric.robust import mad_sigma
from rille.stages.numeric.windows import window_room, window_sum32
from rille.stages.terrain.locus.refinement import MEAN_SIDE_CELLS
from rille.stages.terrain.locus.views import OrthoPair

FLOOR_PX = 0.03
"""Pixels of disparity."""
STEP_FACTOR = 0.2
"""Of the squared step: a position is uncertain by 0.45 cells or pixels."""
REST_FACTOR = 0.3
"""Of r^2 / I."""
MOVE_FACTOR = 0.3
"""Of m^2 / A."""
SHADE_FACTOR = 1.9
"""Of noise over grey value: what is left of the ground's contrast in the dark."""
MIN_AREA_PX = 0.1
"""Squared pixels: least A of the term of m; below it all cells of the window lie in one pixel."""
HOLE_VARIANCE_PX2 = 0.12
"""Squared pixels of disparity where all ground around is unknown."""
DIFFERENCE_FACTOR = 0.87
ONE_SIDED_DIFFERENCE_PX = 0.2
"""Pixels of disparity: difference of both directions where only one of them gave an elevation."""
STEP_SIDE_CELLS = 3
"""Side of the window of t."""
NEAR_SIDE_CELLS = 5
"""Side of the windows of most others."""
HOLE_SIDE_CELLS = 7
"""Side of the window of u."""


def standard_deviation(
    elevation: Floats32,
    seen: OrthoPair,
    turned: Floats32,
    moved: Floats32,
    apart: Floats32 | None,
    otherwise: Floats32,
) -> Floats32:
    """Standard deviation of each cell, metres, see the module.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN undefined.
    seen : as :func:`rille.stages.terrain.locus.refinement.refine` gives it for these elevations.
    turned : (rows, cols) v, see :func:`rille.stages.terrain.locus.views.facing`.
    moved : (rows, cols) what the refinement moved each cell by, metres.
    apart : (rows, cols) difference of both directions' elevations, metres, NaN where not both gave one; None: there was
        one direction.
    otherwise : (rows, cols) the standard deviation of cells that the images do not show, metres.
    """
    known = np.isfinite(elevation) & np.isfinite(seen.scale)
    if not known.any():
        return otherwise
    none, near = np.float32(0.0), _count(known, NEAR_SIDE_CELLS)
    scale = np.where(known, seen.scale, np.float32(1.0))
    rest = np.where(known, seen.left - seen.right, none)
    rest = np.where(known, rest - _mean(rest, MEAN_SIDE_CELLS, _count(known, MEAN_SIDE_CELLS)), none)
    # About 0: the local mean is gone already. Every fourth cell, some ten thousand, says as much as all.
    noise = mad_sigma(rest[known][::4], 0.0)
    moves = np.where(known, np.square(scale * moved), none)
    grey = np.maximum(_mean(np.where(known, seen.left, none), NEAR_SIDE_CELLS, near), max(noise, 1.0))
    variance = FLOOR_PX**2 + REST_FACTOR * _mean(np.square(rest), NEAR_SIDE_CELLS, near) / _gradients(
        seen, scale, known
    )
    area = np.where(known, seen.area, np.float32(1.0))
    variance += np.square(SHADE_FACTOR * noise / grey)
    variance += MOVE_FACTOR * _mean(moves, NEAR_SIDE_CELLS, near) / np.maximum(area, np.float32(MIN_AREA_PX))
    steps = _mean(_steps(elevation, scale, known), STEP_SIDE_CELLS, _count(known, STEP_SIDE_CELLS))
    variance += STEP_FACTOR * steps / np.minimum(area, np.float32(1.0))
    variance += HOLE_VARIANCE_PX2 * (1.0 - _mean(known, HOLE_SIDE_CELLS, window_room(known.shape, HOLE_SIDE_CELLS)))
    if apart is not None:
        both = known & np.isfinite(apart)
        differ = _mean(np.where(both, np.square(scale * apart), none), NEAR_SIDE_CELLS, _count(both, NEAR_SIDE_CELLS))
        variance += DIFFERENCE_FACTOR**2 * np.where(
            window_sum32(both, NEAR_SIDE_CELLS) < 1.0, np.float32(ONE_SIDED_DIFFERENCE_PX**2), differ
        )
    variance *= 1.0 + np.clip(1.0 - turned, 0.0, 1.0)
    # Differences of running sums may fall below zero by their rounding.
    std = np.sqrt(np.maximum(variance, FLOOR_PX**2)) / scale
    return np.where(known, std, otherwise).astype(np.float32)


def _count(known: Bools, side: int) -> Floats32:
    """Number of known cells of each window, at least 1."""
    return np.maximum(window_sum32(known, side), np.float32(1.0))


def _mean(values: Floats32 | Bools, side: int, count: NDArray[Any]) -> Floats32:
    """Mean over a window of ``count`` cells of values that are 0 elsewhere."""
    return np.asarray(window_sum32(values, side) / count, np.float32)


def _gradients(seen: OrthoPair, scale: Floats32, known: Bools) -> Floats32:
    """Sum of the squared gradients around each cell, squared grey levels a pixel of disparity."""
    slope = seen.slope() / scale
    power = np.where(known, np.square(slope) * np.minimum(seen.area, 1.0), np.float32(0.0))
    # One squared grey level a pixel, of each cell: so that a blank wall is not divided by.
    return np.maximum(window_sum32(power, NEAR_SIDE_CELLS), np.float32(0.0)) + np.float32(NEAR_SIDE_CELLS**2)


def _steps(elevation: Floats32, scale: Floats32, known: Bools) -> Floats32:
    """Squared steps to the four neighbours of each cell, pixels of disparity; 0 where one of them is unknown."""
    z = np.where(known, elevation, np.float32(np.nan))
    out = np.zeros(z.shape, np.float32)
    across, down = z[1:-1, 2:] - z[1:-1, :-2], z[2:, 1:-1] - z[:-2, 1:-1]
    inner = (slice(1, -1), slice(1, -1))
    steps = np.square(0.5 * scale[inner]) * (across**2 + down**2)
    out[inner] = np.where(np.isfinite(steps) & known[inner], steps, 0.0)
    return out
