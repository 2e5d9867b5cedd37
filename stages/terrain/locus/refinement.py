"""Elevations refined where they belong: on the surface, by what both images show of it.

Locus reads each cell from the disparity around one pixel. Here the elevations Z of all solved cells minimise together

    sum a w (L(p_l) - R(p_r) - m)^2  +  stiffness sum s |second difference of Z|^2

with p_l and p_r the cell's projections, m the local mean of the difference, a the share of a pixel that the cell is
(a cell smaller than a pixel brings no more than that), w falling with the difference and s with the second difference
found, so that neither a wrong cell nor an edge drags its neighbours along. It is object-space matching (Helava 1988;
Wrobel 1987, facets stereo vision): no image is the master, the geometry is the calibrated one, and smoothness is that
of the terrain and not of its perspective picture. A fixed number of Gauss-Newton steps, each solved by a fixed number
of sweeps (:mod:`rille.stages.numeric.relaxation`).

What remains says how far each cell may be trusted. With sigma_d / |ds/dZ| the standard deviation that the disparity
brings, b the second difference of Z in 7 x 7 cells, t the step of Z from cell to cell there (both RMS) and r the
correlation of both images' ortho gradients in 5 x 5 cells,

    sigma_Z^2 = FLOOR^2 + FACTOR^2 ((sigma_d / |ds/dZ|)^2 + b^2 + t^2) / r^2        (FLOOR in pixels of disparity)

b: a matching window on relief, or beside unknown ground, is the mean of several surfaces. t: a position that is wrong
by a cell is an elevation that is wrong by its step. r: in a shadow noise finds noise to match, smoothly and wrongly;
the noise of two images does not correlate.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.geometry.surface import Surface
from rille.stages.numeric.relaxation import bend_weights, relax
from rille.stages.numeric.windows import window_sum32
from rille.stages.terrain.locus.views import OrthoPair, Views, look

STIFFNESS = 4000.0
"""Squared grey levels for a bend of a pixel of disparity: strong against noise, weak against texture; the error is flat
from 2000 to 16000."""
BEND = 0.05
"""Second difference [pixels of disparity] beyond which stiffness gives way to an edge."""
SWEEPS = 20
FARTHEST = 1.0
"""Largest total change [pixels of disparity] of a cell: beyond it, the images match at another place."""

MEAN_SIDE = 15
"""Side [cells] of the window of the local mean; brightness varies more slowly."""
MEAN_ROUNDS = 1
RESIDUAL = 10.0
"""Difference [grey levels] that halves a cell's weight, well above camera noise."""
LEAST_WEIGHT = 0.1

FACTOR = 0.42
"""Of the parts of the standard deviation."""
FLOOR = 0.1
"""Pixels of disparity: what remains where all is well. With both factors, set on three of the simulator's pairs on
21 November 2026, 70 to 72 % of the errors of all ten are below one and 92 % below two standard deviations, whatever the
matcher's preset (``benchmarks/surest.py``)."""
RELIEF_SIDE, TEXTURE_SIDE = 7, 5
UNKNOWN_BEND = 2.0
"""Pixels of disparity that stand for the bend towards a neighbour that nobody saw."""
LEAST_CORRELATION = 0.02
MIN_POWER = 1e-6
"""Squared grey levels: so that a blank wall is not divided by."""


def refine(views: Views, surface: Surface, elevation: Floats32, steps: int) -> tuple[Floats32, OrthoPair]:
    """Elevations that fit both images best, and what the images show there.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN undefined; such cells stay so.
    steps : Gauss-Newton steps.

    Returns
    -------
    elevation (rows, cols), and what :func:`rille.stages.terrain.locus.views.look` gives for it, the right image with
    the left one's contrast.
    """
    z, seen = elevation, look(views, surface, elevation)
    # From the first look, for all steps: an exposure does not change with the elevations.
    gain = _gain(seen)
    _level(seen, gain)
    for _ in range(steps):
        keep = np.isfinite(seen.scale)
        weight, rest = _misfit(seen, keep)
        slope = np.where(keep, seen.right_slope - seen.left_slope, np.float32(0.0))
        bends = bend_weights(z, seen.scale, BEND, STIFFNESS)
        moved = relax(z, weight * slope * slope, weight * slope * rest, bends, keep, SWEEPS)
        # About the start, not the last step: many small steps could otherwise wander to another likeness.
        reach = FARTHEST / seen.scale
        z = np.where(keep, np.clip(moved, elevation - reach, elevation + reach), elevation)
        seen = look(views, surface, z)
        _level(seen, gain)
    return z, seen


def standard_deviation(elevation: Floats32, seen: OrthoPair, from_disparity: Floats32) -> Floats32:
    """Standard deviation of refined elevations, metres, see the module; the disparity's part where a cell is not seen.

    ``seen``: as :func:`refine` gives it. ``from_disparity``: (rows, cols) the disparity's part, metres.
    """
    known = np.isfinite(elevation) & np.isfinite(seen.scale)
    parts = np.zeros((6, *elevation.shape), np.float32)
    _neighbours(elevation, known, seen, parts)
    sides = (RELIEF_SIDE,) * 3 + (TEXTURE_SIDE,) * 3
    for part, side in zip(parts, sides, strict=True):
        part[...] = window_sum32(part, side)
    bends, steps, count, both, of_left, of_right = parts
    cells = window_sum32(np.ones(elevation.shape, np.float32), RELIEF_SIDE)
    relief = np.maximum(bends / cells + steps / np.maximum(count, 1.0), 0.0)
    # Differences of running sums may fall below zero by their rounding.
    power = np.sqrt(np.maximum(of_left, 0.0) * np.maximum(of_right, 0.0))
    alike = np.clip(both / np.maximum(power, MIN_POWER), LEAST_CORRELATION, 1.0)
    floor = np.where(known, FLOOR / seen.scale, 0.0)
    std = np.sqrt((FACTOR / alike) ** 2 * (np.square(from_disparity) + relief) + floor**2)
    return np.where(known, std, from_disparity).astype(np.float32)


def _gain(seen: OrthoPair) -> float:
    """Factor that gives the right image the left one's contrast, from the gradients along the surface's axes."""
    left, right = (
        sum(float(np.nansum(np.square(np.diff(image, axis=axis)), dtype=np.float64)) for axis in (0, 1))
        for image in (seen.left, seen.right)
    )
    return math.sqrt(left / right) if min(left, right) > 0 else 1.0


def _level(seen: OrthoPair, gain: float) -> None:
    """Scale what the right image shows, in place."""
    for values in (seen.right, seen.right_slope):
        values *= np.float32(gain)


def _misfit(seen: OrthoPair, keep: Bools) -> tuple[Floats32, Floats32]:
    """Weight of each cell's equation, and difference of both images without its local mean; zero where not kept."""
    rest = np.where(keep, seen.left - seen.right, np.float32(0.0))
    weight = misfit = keep.astype(np.float32)
    for _ in range(MEAN_ROUNDS + 1):
        mean = window_sum32(weight * rest, MEAN_SIDE) / np.maximum(window_sum32(weight, MEAN_SIDE), LEAST_WEIGHT)
        misfit = np.where(keep, rest - mean, np.float32(0.0))
        # Cauchy's weight: a highlight or a shadow in one image counts less, but is not forgotten at once.
        weight = keep / (np.float32(1.0) + np.square(misfit / np.float32(RESIDUAL)))
    # A cell smaller than a pixel brings no more than its share of the pixel.
    return np.where(keep, weight * np.fmin(seen.area, 1.0), np.float32(0.0)), misfit


@njit(cache=True, nogil=True)
def _neighbours(z, known, seen, out):  # type: ignore[no-untyped-def]
    """Squared second difference and squared step of each known cell, m^2, and 1; products of the ortho gradients."""
    left, right, scale = seen.left, seen.right, seen.scale
    bend, step, count, texture = out[0], out[1], out[2], out[3:]
    rows, cols = z.shape
    for r in range(rows):
        for c in range(cols):
            if not known[r, c]:
                continue
            total = 0.0
            whole = True
            for i, j in ((0, 1), (1, 0)):
                if r - i < 0 or c - j < 0 or r + i >= rows or c + j >= cols:
                    whole = False
                elif known[r - i, c - j] and known[r + i, c + j]:
                    total += abs(z[r - i, c - j] - 2.0 * z[r, c] + z[r + i, c + j])
                else:
                    whole = False
                    total = UNKNOWN_BEND / scale[r, c]
                    break
            bend[r, c], count[r, c] = total * total, 1.0
            if not whole:
                continue
            for i, j in ((0, 1), (1, 0)):
                dz = 0.5 * (z[r + i, c + j] - z[r - i, c - j])
                a = 0.5 * (left[r + i, c + j] - left[r - i, c - j])
                b = 0.5 * (right[r + i, c + j] - right[r - i, c - j])
                step[r, c] += dz * dz
                texture[0, r, c] += a * b
                texture[1, r, c] += a * a
                texture[2, r, c] += b * b
