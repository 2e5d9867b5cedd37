"""Measures of hazard, the rows of :data:`MEASURES`; each is compared with its own limit of the vehicle.

To add a measure, write its kernel, ``(HazardInput) -> array``, and add its row: classification, reasons, raster,
messages and the probability of a hazard loop over the table. Inputs are an elevation model with its standard deviations
and the vehicle; outputs are metres or gradients, float32 without NaN. The first three measures are those of the paper
(section 4.6), by running extrema over octagons (:mod:`rille.stages.numeric.extrema`); the last three place the vehicle
at every position and heading (:mod:`rille.stages.hazard.placement`). Roughness is the RMS deviation
``sqrt(mean((z(x + d) - z(x))^2) / 2)`` over both axes: on level ground the standard deviation of the heights, and it
increases little with slope (Shepard et al. 2001, doi:10.1029/2000JE001429).

**Greater relief is never safer.** Every measure is a rising function of differences of heights, ``max(0, hi - lo)``
with ``hi`` and ``lo`` highest, lowest or median heights of parts of the window, or ``\\|z_i - z_j\\|``. Suppose that of
any two cells of a window the higher one is raised at least as much as the lower one (a rock grows on level ground; the
highest part is raised). Then the order of the heights stays, the same cells are selected, and none of these differences
decreases. A least-squares plane has no such property: a rock that grows uphill or downhill of its centre levels the
plane. So no measure is a fit.

**Noise.** Extrema of n noisy heights lie beyond the true ones, most on flat ground. With ``s`` the RMS standard
deviation of the heights of a measure V, V has the bias ``bias * s`` and the standard deviation ``spread * s``. The
factors were fitted to simulated pairs, seeds 101 to 106, on 21 November 2026 (``benchmarks/hazards.py``). They are far
below those of independent heights, because errors of a matcher correlate over some cells; the last three measures
compare distant places, whose errors correlate less.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.hazard.block_statistics import Blocks, reduce_to_blocks
from rille.stages.hazard.placement import Places, place, stride
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import median3, relief
from rille.stages.numeric.windows import window_sum

MIN_FINE_CELLS = 5
"""Fewest cells along a wheel's radius for a 3 x 3 median: up to three wrong cells are too small for a stone there."""


class HazardInput:
    """An elevation model and a vehicle; derived arrays are computed once, when first used.

    Parameters
    ----------
    surface : (row, col) float32, metres, NaN unknown.
    closed : the same with small holes closed. A closed cell counts as known, with its noise, but its interpolated
        height adds no relief.
    std : (row, col) float32 of ``closed``, metres, 0 where unknown.
    cell : side of a cell, metres.
    window : side of the wheel's window, metres.
    """

    def __init__(
        self, surface: Floats32, closed: Floats32, std: Floats32, cell: float, vehicle: Vehicle, window: float
    ) -> None:
        # In coarser models a single cell may be the top of a stone.
        fine = MIN_FINE_CELLS * cell <= 0.5 * vehicle.wheel_diameter * (1.0 + 1e-6)
        self.surface = median3(surface) if fine else surface
        self.closed, self.std, self.cell, self.vehicle = closed, std, cell, vehicle
        self.reach, self.near = window_reach(window, cell), window_reach(0.5 * window, cell)
        self.stride = stride(vehicle, cell)

    @property
    def extent(self) -> float:
        """Metres across the wheel's window, in whole cells."""
        return 2 * self.reach * self.cell

    @cached_property
    def relief(self) -> tuple[Floats32, Floats32]:
        """Highest minus lowest height (row, col), metres, within a wheel's radius and in its window."""
        return relief(self.surface, self.near, self.reach)

    @cached_property
    def blocks(self) -> Blocks:
        """Extremes and sums of blocks of ``stride`` x ``stride`` cells; ``lag`` is a quarter of a wheel."""
        lag = max(1, round(0.25 * self.vehicle.wheel_diameter / self.cell))
        return reduce_to_blocks(self.surface, self.closed, self.std, self.stride, lag)

    @cached_property
    def places(self) -> Places:
        """The vehicle placed with its centre on every block."""
        # 0.5: counts are floating-point sums.
        whole = self.blocks.known > self.stride**2 - 0.5
        return place(self.blocks.high, self.blocks.low, self.vehicle, self.stride * self.cell, whole)

    @property
    def side(self) -> int:
        """Blocks across the wheel's window, an odd number."""
        return 2 * round(self.reach / self.stride) + 1

    def window_noise(self) -> Floats32:
        """RMS standard deviation (row, col) of the blocks' heights in the wheel's window, metres."""
        return _rms(self.blocks.variance, self.blocks.known, self.side)

    def footprint_noise(self) -> Floats32:
        """RMS standard deviation (row, col) of the blocks' heights below the vehicle, metres."""
        # Mean of half length and half width, since the window serves all headings.
        half = self.vehicle.half_length + self.vehicle.half_width
        return _rms(self.blocks.variance, self.blocks.known, 2 * round(half / (2.0 * self.stride * self.cell)) + 1)

    def known_share(self) -> Floats32:
        """Share (row, col) of each block's wheel window that is known."""
        count = np.maximum(window_sum(self.blocks.known, self.side), 0.0)
        return (count / float((self.side * self.stride) ** 2)).astype(np.float32)


def _rms(squares: Floats, count: Floats, side: int) -> Floats32:
    # Running sums of squares may be negative by rounding.
    mean = np.maximum(window_sum(squares, side), 0.0) / np.maximum(window_sum(count, side), 1.0)
    return np.sqrt(mean).astype(np.float32)


def _roughness(terrain: HazardInput) -> Floats32:
    sums = (window_sum(a, terrain.side) for a in (terrain.blocks.deviation, terrain.blocks.pairs))
    deviation, pairs = (np.maximum(a, 0.0) for a in sums)
    return np.sqrt(0.5 * deviation / np.maximum(pairs, 1.0)).astype(np.float32)


def _wheel_distance(terrain: HazardInput) -> float:
    return min(terrain.vehicle.track, terrain.vehicle.wheel_base)


class Measure(NamedTuple):
    """One measure of hazard.

    ``bit`` of ``reason``, which never changes its meaning. ``kernel`` returns metres or gradients, float32 without NaN:
    of cells, or ``on_blocks`` of :attr:`HazardInput.stride` cells. ``limit`` is the parameter of the vehicle; with a
    limit in degrees the measure is a gradient. ``bias`` and ``spread`` are those of heights; divided by ``length``,
    metres, those of the measure. ``below``: it is a measure of all ground below the vehicle, not of the wheel's window,
    and so a hazard to the vehicle's centre, not to a wheel. ``words`` name it in messages, ``band`` and ``description``
    its raster, which holds radians, metres, or with ``left`` the metres that remain to the limit.
    """

    name: str
    bit: int
    kernel: Callable[[HazardInput], Floats32]
    limit: str
    bias: float
    spread: float
    words: str
    band: str
    description: str
    length: Callable[[HazardInput], float] = lambda _: 1.0
    on_blocks: bool = False
    below: bool = False
    left: bool = False

    @property
    def in_degrees(self) -> bool:
        """Whether the limit is an angle and the measure a gradient."""
        return self.limit.endswith("_deg")

    def greatest(self, vehicle: Vehicle) -> float:
        """Limit of a vehicle, a gradient or metres."""
        value = float(getattr(vehicle, self.limit))
        return math.tan(math.radians(value)) if self.in_degrees else value


MEASURES = (
    Measure(
        "inclination", 1 << 0, lambda t: t.relief[1] * np.float32(1.0 / t.extent), "max_slope_deg", 0.1, 0.95,
        "inclination", "inclination", "highest minus lowest height in the wheel's window over its extent",
        length=lambda t: t.extent,
    ),
    Measure(
        "range", 1 << 1, lambda t: t.relief[1], "clearance", 0.05, 0.8, "height range", "height_range",
        "highest minus lowest height in the wheel's window",
    ),
    Measure(
        "step", 1 << 2, lambda t: t.relief[0], "max_step", 0.05, 0.9, "step", "step",
        "highest minus lowest height within a wheel's radius",
    ),
    Measure(
        "roughness", 1 << 3, _roughness, "max_roughness", 0.0, 0.3, "roughness", "roughness",
        "RMS deviation of heights a quarter of a wheel apart", on_blocks=True,
    ),
    Measure(
        "slope", 1 << 4, lambda t: t.places.slope, "max_slope_deg", 0.3, 2.0, "slope of the footprint", "slope",
        "steepest plane of the footprint by the ground beneath the wheels",
        length=_wheel_distance, on_blocks=True, below=True,
    ),
    Measure(
        "tilt", 1 << 5, lambda t: t.places.tilt, "max_slope_deg", 0.0, 2.5, "tilt", "tilt",
        "greatest tilt of the vehicle over headings and three-wheel stands",
        length=_wheel_distance, on_blocks=True, below=True,
    ),
    Measure(
        "rise", 1 << 6, lambda t: t.places.rise, "clearance", 0.3, 2.5, "rise under the belly", "clearance",
        "least height left under the belly, over headings", on_blocks=True, below=True, left=True,
    ),
)  # fmt: skip
"""All measures. Bits 1 << 7 to 1 << 10 of ``reason`` are taken (:mod:`rille.stages.hazard.classification`)."""

BITS = {m.name: m.bit for m in MEASURES}
WHEEL_BITS = np.uint16(sum(m.bit for m in MEASURES if not m.below))
"""Hazards to a wheel on the cell."""
BODY_BITS = np.uint16(sum(m.bit for m in MEASURES if m.below))
"""Hazards to the vehicle with its centre on the cell."""


def window_reach(side: float, cell: float) -> int:
    """Cells from the middle of a window to its border, rounded, halves down; at least one."""
    return max(1, math.ceil(side / (2.0 * cell) - 0.5 - 1e-6))
