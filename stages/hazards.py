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

The first three are the paper's (section 4.6), by running extrema over octagons (:mod:`stages.extrema`); the last three
put the vehicle down at every place and heading (:mod:`stages.placement`). RMS deviation is ``sqrt(mean((z(x + d) -
z(x))^2) / 2)`` over both axes: the standard deviation of ground without slope, and little of a slope's (Shepard et al.
2001, doi:10.1029/2000JE001429).

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
(Student's t), since matching errs grossly now and then. Unknown ground in a window hides what would raise a measure, so
up to the limit it widens the doubt (:data:`HIDDEN`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import stdtr

from stages.extrema import median3, running_range
from stages.placement import place, stride
from stages.vehicle import Vehicle
from stages.windows import window_sum

Floats32 = NDArray[np.float32]

MEASURES = ("inclination", "range", "step", "roughness", "slope", "tilt", "rise")
BITS = {name: 1 << k for k, name in enumerate(MEASURES)}

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

FREEDOM = 3.0
"""Degrees of freedom of Student's t."""

STEPS, FARTHEST = 64, 16.0
"""Table of F: steps a unit, and where it ends."""


@dataclass(frozen=True)
class Measured:
    """Measures by name on the cells (inclination, range, step) or on blocks of ``stride`` cells (the others), float32.

    Gradients are dimensionless, the rest metres; raw, with the bias of noise. ``noise``, ``share`` and ``unstood``
    are on blocks: RMS standard deviation, m; known share of the wheel's window; share of headings with a wheel on the
    unknown.
    """

    values: dict[str, Floats32]
    noise: Floats32
    noise_under: Floats32
    share: Floats32
    unstood: Floats32
    stride: int


@dataclass(frozen=True)
class Judged:
    """On the cells (row, col): ``load`` greatest of value + k sigma over its limit, ``p`` probability, ``bits`` of what
    exceeds its limit, ``doubt`` 1 where only because of sigma."""

    load: Floats32
    p: Floats32
    bits: NDArray[np.uint16]
    doubt: NDArray[np.uint8]


def window_reach(side: float, cell: float) -> int:
    """Cells from the middle of a window to its border; at least one."""
    return max(1, int(side / (2.0 * cell) + 1e-6))


def measure(
    elevation: Floats32,
    elevation_std: Floats32,
    cell: float,
    vehicle: Vehicle,
    window: float,
    filled: NDArray[np.uint8] | None = None,
) -> Measured:
    """All measures of an elevation model.

    Parameters
    ----------
    elevation, elevation_std : (row, col) float32, metres, NaN unknown; the latter 0 where it is not known.
    cell : side of a cell, metres.
    window : metres, side of the wheel's window.
    filled : not 0 where the elevation is interpolated: it counts as known and with its noise, but heights between other
        heights prove no relief (and a rim that is raised would raise them over lower ground).
    """
    surface = elevation if filled is None else np.where(filled != 0, np.float32(np.nan), elevation)
    surface = median3(surface) if 3 * cell <= 0.5 * vehicle.wheel_diameter else surface
    reach, near = window_reach(window, cell), window_reach(0.5 * window, cell)
    values = {}
    high, low = running_range(surface, reach)
    values["range"] = _difference(high, low)
    values["inclination"] = values["range"] * np.float32(1.0 / (2 * reach * cell))
    high, low = running_range(surface, near)
    values["step"] = _difference(high, low)
    n = stride(vehicle, cell)
    lag = max(1, round(0.25 * vehicle.wheel_diameter / cell))
    highest, lowest, sums = _blocks(surface, elevation, elevation_std, n, lag)
    around = 2 * round(reach / n) + 1
    count, square, number, deviation = (window_sum(a, around) for a in sums)
    values["roughness"] = np.sqrt(0.5 * deviation / np.maximum(number, 1.0)).astype(np.float32)
    whole = sums[0] > n * n - 0.5
    places = place(highest, lowest, vehicle, n * cell, whole)
    wide = 2 * round((vehicle.half_length + vehicle.half_width) / (2.0 * n * cell)) + 1
    under = np.sqrt(window_sum(sums[1], wide) / np.maximum(window_sum(sums[0], wide), 1.0)).astype(np.float32)
    values |= {"slope": places.slope, "tilt": places.tilt, "rise": places.rise}
    noise = np.sqrt(square / np.maximum(count, 1.0)).astype(np.float32)
    share = (count / float((around * n) ** 2)).astype(np.float32)
    return Measured(values, noise, under, share, places.unstood, n)


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


def judge(measured: Measured, vehicle: Vehicle, window: float, cell: float, sigmas: float) -> Judged:
    """Hold every measure against its limit."""
    limit, noise = limits(vehicle), noise_factors(vehicle, window, cell)
    shape = measured.values["step"].shape
    fine = [
        name for name in MEASURES if measured.values[name].shape == shape and name in ("inclination", "range", "step")
    ]
    blocks = [name for name in MEASURES if name not in fine]
    table = _table()
    facts = {
        name: np.array(
            [limit[name], *noise[name], max(0.0, sigmas * noise[name][1] - noise[name][0]), BITS[name]], np.float32
        )
        for name in MEASURES
    }
    gap, patchy = np.float32(vehicle.max_step) * (1.0 - np.minimum(measured.share, 1.0)), measured.unstood
    doubt = np.hypot(measured.noise, np.float32(HIDDEN[0]) * gap).astype(np.float32)
    below = np.hypot(measured.noise_under, np.float32(HIDDEN[1] * vehicle.max_step) * patchy).astype(np.float32)
    wheel = measured.noise, doubt
    coarse = _judge(
        [measured.values[n] for n in blocks],
        [facts[n] for n in blocks],
        [wheel if n == "roughness" else (measured.noise_under, below) for n in blocks],
    )
    out = Judged(
        np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint16), np.empty(shape, np.uint8)
    )
    _combine(
        np.stack([facts[n] for n in fine]), *(measured.values[n] for n in fine), *coarse, *wheel,
        measured.stride, table, out.load, out.p, out.bits, out.doubt,
    )  # fmt: skip
    return out


def spread_out(blocks: NDArray, n: int, shape: tuple[int, int]) -> NDArray:
    """An array on blocks of n x n cells brought to the cells."""
    return np.repeat(np.repeat(blocks, n, axis=0)[: shape[0]], n, axis=1)[:, : shape[1]]


def _judge(
    values: list[Floats32], facts: list[Floats32], noises: list[tuple[Floats32, Floats32]]
) -> tuple[Floats32, Floats32, NDArray[np.uint16]]:
    """Greatest load, greatest standardised excess and bits of the measures on blocks."""
    shape = values[0].shape
    load, excess = np.zeros(shape, np.float32), np.full(shape, -FARTHEST, np.float32)
    bits = np.zeros(shape, np.uint16)
    least = np.float32(1e-12)
    for v, (limit, bias, spread, added, bit), (noise, doubt) in zip(values, facts, noises, strict=True):
        here = (v + added * noise) / limit
        bits[here > 1.0] |= np.uint16(bit)
        np.maximum(load, here, out=load)
        over = v - bias * noise - limit
        np.maximum(excess, over / (spread * np.where(over > 0, noise, doubt) + least * limit), out=excess)
    return load, excess, bits


def _table() -> Floats32:
    t = np.arange(-FARTHEST * STEPS, FARTHEST * STEPS + 1) / STEPS
    found = stdtr(FREEDOM, t)
    found[0], found[-1] = 0.0, 1.0
    return np.asarray(found, dtype=np.float32)


def _difference(high: Floats32, low: Floats32) -> Floats32:
    """High minus low; 0 where nothing is known."""
    return np.maximum(np.subtract(high, low, out=high), np.float32(0.0), out=high)


@njit(cache=True, nogil=True, inline="always")
def _pair(sums, i, j, k, m, d):  # type: ignore[no-untyped-def]
    square = d * d
    sums[2][i, j] += 1.0
    sums[3][i, j] += square
    sums[2][k, m] += 1.0
    sums[3][k, m] += square


@njit(cache=True, nogil=True)
def _blocks(z, closed, s, n, lag):  # type: ignore[no-untyped-def]
    """Highest and lowest height of n x n cells (NaN where none is known); and sums over them: known cells, squared
    standard deviations, pairs of cells ``lag`` apart along either axis (at both ends), their squared differences."""
    rows, cols = z.shape
    shape = ((rows + n - 1) // n, (cols + n - 1) // n)
    high, low = np.full(shape, np.nan, dtype=np.float32), np.full(shape, np.nan, dtype=np.float32)
    sums = (np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for r in range(rows):
        i = r // n
        down = r + lag < rows
        for j in range(shape[1]):
            for c in range(j * n, min(j * n + n, cols)):
                if closed[r, c] == closed[r, c]:
                    sums[0][i, j] += 1.0
                    sums[1][i, j] += s[r, c] * s[r, c]
                v = z[r, c]
                if v != v:
                    continue
                if not high[i, j] >= v:
                    high[i, j] = v
                if not low[i, j] <= v:
                    low[i, j] = v
                if c + lag < cols:
                    d = z[r, c + lag] - v
                    if d == d:
                        _pair(sums, i, j, i, (c + lag) // n, d)
                if down:
                    d = z[r + lag, c] - v
                    if d == d:
                        _pair(sums, i, j, (r + lag) // n, j, d)
    return high, low, sums


@njit(cache=True, nogil=True)
def _combine(facts, a, b, d, load0, excess0, bits0, noise, doubtful, n, table, load, p, bits, doubt):  # type: ignore[no-untyped-def]
    rows, cols = load.shape
    values = (a, b, d)
    wide, wider = np.empty(cols, dtype=np.float32), np.empty(cols, dtype=np.float32)
    excess = np.empty(cols, dtype=np.float32)
    for r in range(rows):
        i = r // n
        for c in range(cols):
            j = c // n
            wide[c], wider[c] = noise[i, j], doubtful[i, j]
            load[r, c] = load0[i, j]
            excess[c] = excess0[i, j]
            bits[r, c] = bits0[i, j]
        for k in range(3):
            _hold(values[k][r], facts[k], wide, wider, load[r], excess, bits[r])
        for c in range(cols):
            t = min(max(excess[c], -FARTHEST), FARTHEST)
            p[r, c] = table[int((t + FARTHEST) * STEPS)]
            doubt[r, c] = 1 if load[r, c] > 1.0 and excess[c] <= 0.0 else 0


@njit(cache=True, nogil=True)
def _hold(v, facts, noise, doubt, load, excess, bits):  # type: ignore[no-untyped-def]
    """One row of one measure against its limit: facts = limit, bias, spread, added sigmas, bit."""
    limit, bias, spread, added, bit = facts[0], facts[1], facts[2], facts[3], np.uint16(facts[4])
    scale, least, none = np.float32(1.0) / limit, np.float32(1e-12) * limit, np.uint16(0)
    for c in range(v.shape[0]):
        here = (v[c] + added * noise[c]) * scale
        load[c] = here if here > load[c] else load[c]
        bits[c] |= bit if here > np.float32(1.0) else none
        over = v[c] - bias * noise[c] - limit
        t = over / (spread * (noise[c] if over > np.float32(0.0) else doubt[c]) + least)
        excess[c] = t if t > excess[c] else excess[c]
