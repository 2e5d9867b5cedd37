"""Refinement of elevations on the surface, until both images agree there.

Locus reads each cell from the disparity around one pixel. Here the elevations Z of all solved cells minimise together

    sum a (L(p_l) - R(p_r) - m)^2  +  stiffness sum s |second difference of Z|^2

with p_l and p_r the cell's projections, m the local mean of the difference, a the share of a pixel that the cell is
(a cell smaller than a pixel brings no more than that) and s falling with the second difference found, so that no edge
drags its neighbours along. It is object-space matching (Helava 1988;
Wrobel 1987, facets stereo vision): no image is the master, the geometry is the calibrated one, and smoothness is that
of the terrain and not of its perspective picture. A fixed number of Gauss-Newton steps, each solved by a fixed number
of sweeps (:mod:`rille.stages.numeric.relaxation`).
"""

from __future__ import annotations

import math

import numpy as np

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.relaxation import bend_weights, relax
from rille.stages.numeric.windows import window_sum32
from rille.stages.terrain.locus.views import OrthoPair, SurfaceViews, look

BEND_STIFFNESS = 2000.0
"""Squared grey levels for a bend of a pixel of disparity: strong against noise, weak against texture; the error is flat
from 1000 to 4000."""
MAX_BEND_PX = 0.05
"""Second difference [pixels of disparity] beyond which stiffness gives way to an edge."""

MEAN_SIDE_CELLS = 15
"""Side [cells] of the window of the local mean; brightness varies more slowly. Over 31 cells RMS errors are 2 to 3 %
smaller, but small stones are lower: paths over four beds cross 70 instead of 29 cells that are truly hazardous."""


def refine(views: SurfaceViews, lattice: Lattice, elevation: Floats32, steps: int) -> tuple[Floats32, OrthoPair]:
    """Elevations at which both images agree best, and the views of the images there.

    Parameters
    ----------
    elevation : (rows, cols) metres, NaN undefined; such cells stay so.
    steps : Gauss-Newton steps.

    Returns
    -------
    elevation (rows, cols), and :func:`rille.stages.terrain.locus.views.look` at it, the right image with
    the left one's contrast.
    """
    z, seen = elevation, look(views, lattice, elevation)
    # From the first look, for all steps: an exposure does not change with the elevations.
    gain = _gain(seen)
    _level(seen, gain)
    for _ in range(steps):
        keep = np.isfinite(seen.scale)
        weight, rest = _misfit(seen, keep)
        slope = np.where(keep, seen.slope(), np.float32(0.0))
        bends = bend_weights(z, seen.scale, MAX_BEND_PX, BEND_STIFFNESS)
        moved = relax(z, weight * slope * slope, weight * slope * rest, bends, keep, sweeps=20)
        # About the start, not the last step: many small steps could otherwise wander to another likeness. Beyond a
        # pixel of disparity the images match at another place.
        reach = 1.0 / seen.scale
        z = np.where(keep, np.clip(moved, elevation - reach, elevation + reach), elevation)
        seen = look(views, lattice, z)
        _level(seen, gain)
    return z, seen


def _gain(seen: OrthoPair) -> float:
    """Factor that gives the right image the left one's contrast, from the gradients along the lattice's axes."""
    left, right = (
        sum(float(np.nansum(np.square(np.diff(image, axis=axis)), dtype=np.float64)) for axis in (0, 1))
        for image in (seen.left, seen.right)
    )
    return math.sqrt(left / right) if min(left, right) > 0 else 1.0


def _level(seen: OrthoPair, gain: float) -> None:
    """Scale grey values and slopes of the right image, in place."""
    for values in (seen.right, seen.right_slope):
        values *= np.float32(gain)


def _misfit(seen: OrthoPair, keep: Bools) -> tuple[Floats32, Floats32]:
    """Weight of each cell's equation, and difference of both images without its local mean; zero where not kept."""
    none = np.float32(0.0)
    rest = np.where(keep, seen.left - seen.right, none)
    mean = window_sum32(rest, MEAN_SIDE_CELLS) / np.maximum(window_sum32(keep, MEAN_SIDE_CELLS), np.float32(1.0))
    # A cell smaller than a pixel brings no more than its share of the pixel.
    return np.where(keep, np.fmin(seen.area, 1.0), none), np.where(keep, rest - mean, none)
