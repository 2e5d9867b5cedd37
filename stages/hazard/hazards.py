"""Seven measures of hazard, each in metres or as a gradient, each against its own limit of a vehicle; none is blended.

============ ================================================================== ================
measure      what                                                               limit
============ ================================================================== ================
inclination  highest minus lowest height in the wheel's window, over its extent tan max_slope
range        highest minus lowest height there ("elevated area" of the paper)   clearance
step         the same within a wheel's radius: what a wheel meets as an edge    max_step
roughness    RMS deviation at a quarter of a wheel, in the wheel's window       max_roughness
slope        plane of the footprint, by the ground beneath the wheels           tan max_slope
tilt         the same, by where the wheels stand, at the worst heading          tan max_slope
rise         of the ground under the belly over the plane of the wheels         clearance
============ ================================================================== ================

The first three are the paper's (section 4.6), by running extrema over octagons (:mod:`rille.stages.numeric.extrema`);
the last three put the vehicle down at every place and heading (:mod:`rille.stages.hazard.placement`). RMS deviation is
``sqrt(mean((z(x + d) - z(x))^2) / 2)`` over both axes: the standard deviation of ground without slope, and little of a
slope's (Shepard et al. 2001, doi:10.1029/2000JE001429).

**Rising relief is never safer.** Every measure is a rising function of differences of heights, ``max(0, hi - lo)`` with
``hi`` and ``lo`` highest, lowest or median heights of parts of the window, or ``\\|z_i - z_j\\|``. Say that of any two
cells of a window the higher one is raised at least as much as the lower one (a rock grows on level ground; what stands
above all around it is raised). Then the order of heights stays, so the same cells are picked, and none of these
differences shrinks. A least-squares plane has no such property: a rock that grows uphill or downhill of its centre
turns it level. So no measure is a fit.

**Noise.** Extrema of n noisy heights lie beyond the true ones, all the farther the flatter the ground. With ``s`` the
RMS standard deviation of the heights in the wheel's window, a measure V has the bias ``bias * s`` and the standard
deviation ``spread * s`` (:data:`NOISE`). The estimate is ``V - bias s``, hazardous where ``V - bias s + k spread s``
exceeds the limit; with ``k spread >= bias``, which is enforced, more noise is never safer either.

``p_hazard`` is the probability that the exact measure exceeds its limit, ``F((V - bias s - limit) / (spread s))``, of
the worst measure: all of them look at one ground, so they err together. F has wider tails than the normal distribution
(Student's t), since matching errs grossly now and then, and is steeper about the limit (:data:`LIFT`). Unknown ground
in a window hides what would raise a measure, so up to the limit it widens the doubt (:data:`HIDDEN`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.hazard.block_statistics import reduce_to_blocks
from rille.stages.hazard.placement import place, stride
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import median3, relief
from rille.stages.numeric.windows import window_sum

Floats32 = NDArray[np.float32]

MEASURES = ("inclination", "range", "step", "roughness", "slope", "tilt", "rise")
BITS = {name: 1 << k for k, name in enumerate(MEASURES)}
WHEEL_BITS = np.uint16(BITS["inclination"] | BITS["range"] | BITS["step"] | BITS["roughness"])
"""Hazards to a wheel on the cell; the other ones are to the vehicle with its middle there."""

NOISE = {
    "inclination": (0.1, 0.95),
    "range": (0.05, 0.8),
    "step": (0.05, 0.9),
    "roughness": (0.0, 0.3),
    "slope": (0.3, 2.0),
    "tilt": (0.0, 2.5),
    "rise": (0.3, 2.5),
}
"""Bias and spread of each measure's heights over the RMS standard deviation of the elevations that it looks at, found
on simulated pairs (``benchmarks/hazards.py``). Elevations of a matcher err together over some cells, so the bias is far
below that of as many independent ones; the last three look at places far apart, which err less alike."""

HIDDEN = (0.5, 0.5)
"""Steps of the vehicle by which unknown ground widens the doubt of a measure, where all of the wheel's window, or of
the ground below the vehicle, is unknown: what is hidden there is not in the measures."""

FINE = 5
"""Cells along a wheel's radius from which single ones are taken for wrong: three of them are then no stone to it."""

FREEDOM = 3.0
"""Degrees of freedom of Student's t."""

LIFT = (-0.4, 0.6, 0.8)
"""From where and over what width t rises, and by how much: what is found at a limit is more often above it than below,
since a matcher smooths and hides relief more often than it makes some. Found with :data:`NOISE`; F stays a rising
function."""


@dataclass(frozen=True)
class Measured:
    """Measures, raw, with the bias of noise, NaN-free; gradients dimensionless, the rest metres, float32.

    ``step`` and ``range`` on the cells; ``blocks`` by name on blocks of ``stride`` cells. ``extent``: metres over which
    the range is an inclination. ``noise`` and ``noise_under``: RMS standard deviation, m, in the wheel's window and
    below the vehicle; ``share``: known share of the wheel's window; ``unstood``: share of headings with a wheel on the
    unknown; all four on blocks.
    """

    step: Floats32
    range: Floats32
    blocks: dict[str, Floats32]
    noise: Floats32
    noise_under: Floats32
    share: Floats32
    unstood: Floats32
    stride: int
    extent: float


def window_reach(side: float, cell: float) -> int:
    """Cells from the middle of a window to its border, the nearest number, halves rounded down; at least one."""
    return max(1, math.ceil(side / (2.0 * cell) - 0.5 - 1e-6))


def measure(
    surface: Floats32,
    closed: Floats32,
    elevation_std: Floats32,
    cell: float,
    vehicle: Vehicle,
    window: float,
) -> Measured:
    """All measures of an elevation model.

    Parameters
    ----------
    surface : (row, col) float32, metres, NaN unknown.
    closed : the same with small holes closed. A closed cell counts as known and with its noise, but heights between
        other heights prove no relief (and a rim that is raised would raise them over lower ground).
    elevation_std : (row, col) float32 of ``closed``, metres, 0 where it is not known.
    cell : side of a cell, metres.
    window : metres, side of the wheel's window.
    """
    surface = median3(surface) if FINE * cell <= 0.5 * vehicle.wheel_diameter else surface
    reach, near = window_reach(window, cell), window_reach(0.5 * window, cell)
    step, height_range = relief(surface, near, reach)
    n = stride(vehicle, cell)
    lag = max(1, round(0.25 * vehicle.wheel_diameter / cell))
    blocks = reduce_to_blocks(surface, closed, elevation_std, n, lag)
    around = 2 * round(reach / n) + 1
    sums = (blocks.count, blocks.variance, blocks.pairs, blocks.deviation)
    # running sums of what is not below zero may end below it by rounding
    count, square, number, deviation = (np.maximum(window_sum(a, around), 0.0) for a in sums)
    places = place(blocks.high, blocks.low, vehicle, n * cell, blocks.count > n * n - 0.5)
    wide = 2 * round((vehicle.half_length + vehicle.half_width) / (2.0 * n * cell)) + 1
    under = np.sqrt(
        np.maximum(window_sum(blocks.variance, wide), 0.0) / np.maximum(window_sum(blocks.count, wide), 1.0)
    )
    values = {
        "roughness": np.sqrt(0.5 * deviation / np.maximum(number, 1.0)).astype(np.float32),
        "slope": places.slope,
        "tilt": places.tilt,
        "rise": places.rise,
    }
    noise = np.sqrt(square / np.maximum(count, 1.0)).astype(np.float32)
    share = (count / float((around * n) ** 2)).astype(np.float32)
    found = noise, under.astype(np.float32), share, places.unstood
    return Measured(step, height_range, values, *found, n, 2 * reach * cell)


def limits(vehicle: Vehicle) -> dict[str, float]:
    """Limit of each measure, gradients or metres."""
    steepest = math.tan(math.radians(vehicle.max_slope_deg))
    return {
        "inclination": steepest,
        "range": vehicle.clearance,
        "step": vehicle.max_step,
        "roughness": vehicle.max_roughness,
        "slope": steepest,
        "tilt": steepest,
        "rise": vehicle.clearance,
    }


def noise_factors(vehicle: Vehicle, window: float, cell: float) -> dict[str, tuple[float, float]]:
    """Bias and spread of each measure in its own unit, per metre of the elevations' standard deviation."""
    extent = 2 * window_reach(window, cell) * cell
    across = min(vehicle.track, vehicle.wheel_base)
    unit = {"inclination": 1.0 / extent, "slope": 1.0 / across, "tilt": 1.0 / across}
    return {name: (bias * unit.get(name, 1.0), spread * unit.get(name, 1.0)) for name, (bias, spread) in NOISE.items()}
