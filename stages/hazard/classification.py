"""Measures compared with the limits of a vehicle, cell by cell: class, reasons, probability, and a raster of each.

For a measure V with limit L, bias b and spread d per metre of the elevations' standard deviation s, and k ``sigmas``:

    load   = (V + max(0, k d - b) s) / L         hazardous above 1; V carries the bias already, so k d - b more is added
    excess = (V - b s - L) / (d s')              s' = s above the limit, else s widened by what unknown ground may hide

A cell's class follows from its greatest load, ``p_hazard = F(greatest excess)`` from its greatest excess: all measures
look at one ground, so they err together. F is Student's t, since matching errs grossly now and then, steeper about the
limit (:data:`LIFT`). With ``k d >= b``, which is enforced, more noise is never safer.

The measures on blocks are judged on blocks. A cell starts with the load and the excess of its block; then each measure
on cells is compared with its limit.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats32
from rille.stages.hazard.measures import MEASURES, HazardInput, Measure

Bits = NDArray[np.uint16]

SAFE, CAUTION, HAZARDOUS, UNKNOWN = 0, 1, 2, 3
"""Classes of ``risk``."""

UNKNOWN_BIT, FILLED_BIT, DOUBT_BIT, UNSEEN_BIT = 1 << 7, 1 << 8, 1 << 9, 1 << 10

MIN_WHOLE_SHARE = 0.999
"""Share of a window from which it counts as wholly known."""

HIDDEN_STEPS = 0.5
"""Steps of the vehicle by which unknown ground widens the doubt of a measure, where all of the wheel's window, or of
the ground below the vehicle, is unknown: the measure does not hold what is hidden there."""

STEPS_PER_EXCESS = 64
"""Steps of the table of F a unit of excess."""

MAX_EXCESS = 16.0
"""Excess where the table of F ends."""

LIFT = 0.8
"""What t is raised by: a measure at its limit is more often above it than below, since a matcher smooths relief away
more often than it makes some. Fitted, as where it begins, with the noise of :mod:`rille.stages.hazard.measures`; F
stays a rising function."""

LIFT_START_EXCESS = -0.4
"""Excess from which t is raised."""

LIFT_WIDTH_EXCESS = 0.6
"""Excess over which the rise of t grows to the whole of it."""

MIN_RELATIVE_STD = 1e-12
"""Smallest standard deviation of a measure, as a share of its limit: the excess of exact elevations is then finite."""

NO_BITS = np.uint16(0)


class Rules(NamedTuple):
    """Thresholds of the classes: parameters of ``risk``."""

    sigmas: float
    caution: float
    max_p: float
    min_known: float


class Limit(NamedTuple):
    """One measure's limit, bias and spread as above; ``added`` standard deviations of its load; its bit; and the index
    of its noise and doubt in those of :class:`ClassifiedBlocks`: 0 wheel's window, 1 below the vehicle."""

    limit: np.float32
    bias: np.float32
    spread: np.float32
    added: np.float32
    bit: np.uint16
    window: int

    @staticmethod
    def of(measure: Measure, terrain: HazardInput, sigmas: float) -> Limit:
        """Limit of a measure for the vehicle of ``terrain``, with ``sigmas`` standard deviations."""
        length, f = measure.length(terrain), np.float32
        bias, spread = measure.bias / length, measure.spread / length
        # A measure already carries the bias of its extrema, so only the rest of the standard deviations is added.
        added = max(0.0, sigmas * spread - bias)
        limit = f(measure.greatest(terrain.vehicle))
        return Limit(limit, f(bias), f(spread), f(added), np.uint16(measure.bit), int(measure.below))


class ClassifiedBlocks(NamedTuple):
    """Arrays (row, col) of blocks, float32 and uint16.

    ``load`` and ``excess``: greatest ones of the measures on blocks; ``over``: bits of those above their limits;
    ``flags``: bits whatever the class. ``noise`` and ``doubt`` (window, row, col): standard deviation, and the same
    widened by what may be hidden, metres, in the wheel's window and below the vehicle; ``share``: known share of the
    wheel's window; ``bands``: rasters of the measures.
    """

    load: Floats32
    excess: Floats32
    over: Bits
    flags: Bits
    noise: Floats32
    doubt: Floats32
    share: Floats32
    bands: tuple[Floats32, ...]


class Cells(NamedTuple):
    """Arrays (row, col) of cells: elevation with holes ``closed`` and 1 where it was ``filled``; then the results:
    classes, reasons, probability, rasters of the measures on blocks, and those on cells (NaN where unknown)."""

    closed: Floats32
    filled: Bytes
    risk: Bytes
    reason: Bits
    p: Floats32
    bands: tuple[Floats32, ...]
    fields: tuple[Floats32, ...]


def classify(
    terrain: HazardInput, filled: Bytes, rules: Rules, measures: tuple[Measure, ...] = MEASURES
) -> dict[str, NDArray]:
    """Classes, reasons and rasters (row, col) of :func:`rille.stages.hazard.risk.risk_map`.

    Parameters
    ----------
    filled : (row, col) 1 where a hole of the elevation was closed.
    measures : rows of the table, at least one on cells and one on blocks.
    """
    closed, vehicle, n = terrain.closed, terrain.vehicle, terrain.stride
    values = {m.name: m.kernel(terrain) for m in measures}
    on_cells, on_blocks = ([m for m in measures if m.on_blocks == kind] for kind in (False, True))
    blocks = _judge_blocks(terrain, rules.sigmas, on_blocks, values)
    limits = tuple(Limit.of(m, terrain, rules.sigmas) for m in on_cells)
    fields = tuple(values[m.name] for m in on_cells)
    del terrain, values  # blocks of a large map take as much memory as all rasters together
    shape = closed.shape
    bands = tuple(np.empty(shape, np.float32) for _ in on_blocks)
    risk, reason, p = (np.empty(shape, t) for t in (np.uint8, np.uint16, np.float32))
    cells = Cells(closed, filled, risk, reason, p, bands, fields)
    _classify(limits, blocks, cells, n, rules, _table())
    rasters = {m.name: a for m, a in zip(on_blocks, bands, strict=True)}
    rasters |= {m.name: _band(m, a, vehicle.clearance) for m, a in zip(on_cells, fields, strict=True)}
    return {"risk": risk, "reason": reason} | {m.band: rasters[m.name] for m in measures} | {"p_hazard": p}


def _judge_blocks(
    terrain: HazardInput, sigmas: float, on_blocks: list[Measure], values: dict[str, Floats32]
) -> ClassifiedBlocks:
    """The measures on blocks against their limits, and the noise of all measures."""
    vehicle, share, patchy = terrain.vehicle, terrain.known_share(), terrain.places.unstood
    noise = np.stack([terrain.window_noise(), terrain.footprint_noise()])
    # In proportion to the unknown share, and of a step, since anything higher shows at the rim of the known ground.
    hidden = np.float32(HIDDEN_STEPS * vehicle.max_step) * np.stack([1.0 - np.minimum(share, 1.0), patchy])
    doubt = np.hypot(noise, hidden)
    load, excess = np.zeros_like(share), np.full_like(share, -MAX_EXCESS)
    over = np.zeros(share.shape, np.uint16)
    for m in on_blocks:
        value, limit = values[m.name], Limit.of(m, terrain, sigmas)
        own = (value + limit.added * noise[limit.window]) / limit.limit
        above = value - limit.bias * noise[limit.window] - limit.limit
        # Hidden ground can only raise a measure, so it makes no hazard less certain.
        std = np.where(above > 0, noise[limit.window], doubt[limit.window])
        load = np.maximum(load, own)
        excess = np.maximum(excess, above / (limit.spread * std + np.float32(MIN_RELATIVE_STD) * limit.limit))
        over |= np.where(own > 1, limit.bit, NO_BITS)
    flags = np.where((share < MIN_WHOLE_SHARE) | (patchy > 0), np.uint16(UNSEEN_BIT), NO_BITS)
    bands = tuple(_band(m, values[m.name], vehicle.clearance) for m in on_blocks)
    return ClassifiedBlocks(load, excess, over, flags, noise, doubt, share, bands)


def _band(m: Measure, values: Floats32, most: float) -> Floats32:
    """A measure in the unit of its raster."""
    if m.left:
        return np.subtract(np.float32(most), values)
    return np.arctan(values, out=values) if m.in_degrees else values


@cache
def _table() -> Floats32:
    """F (entry,) at steps of the excess."""
    t = np.arange(-MAX_EXCESS * STEPS_PER_EXCESS, MAX_EXCESS * STEPS_PER_EXCESS + 1) / STEPS_PER_EXCESS
    raised = np.clip((t - LIFT_START_EXCESS) / LIFT_WIDTH_EXCESS, 0.0, 1.0)
    # Three degrees of freedom.
    chance = scipy.special.stdtr(3.0, t + LIFT * raised)
    # Beyond the ends of the table the probability counts as certain, whatever the tails of Student's t.
    chance[0], chance[-1] = 0.0, 1.0
    return np.asarray(chance, dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _classify(limits, blocks, cells, n, rules, table):  # type: ignore[no-untyped-def]
    """Fill the results of ``cells``, block by block of ``n`` x ``n``; ``limits`` are those of ``cells.fields``."""
    rows, cols = cells.risk.shape
    count = len(limits)
    per_noise, per_doubt = np.empty(count, np.float32), np.empty(count, np.float32)
    for i in range(blocks.load.shape[0]):
        for j in range(blocks.load.shape[1]):
            for k in range(count):
                least, w = np.float32(MIN_RELATIVE_STD) * limits[k].limit, limits[k].window
                per_noise[k] = np.float32(1.0) / (limits[k].spread * blocks.noise[w, i, j] + least)
                per_doubt[k] = np.float32(1.0) / (limits[k].spread * blocks.doubt[w, i, j] + least)
            for r in range(i * n, min(i * n + n, rows)):
                for c in range(j * n, min(j * n + n, cols)):
                    load, excess, over = blocks.load[i, j], blocks.excess[i, j], blocks.over[i, j]
                    for k in range(count):
                        limit, value = limits[k], cells.fields[k][r, c]
                        noise = blocks.noise[limit.window, i, j]
                        own = (value + limit.added * noise) / limit.limit
                        above = value - limit.bias * noise - limit.limit
                        load = max(load, own)
                        excess = max(excess, above * (per_noise[k] if above > 0 else per_doubt[k]))
                        over |= limit.bit if own > 1 else NO_BITS
                    p = table[
                        int(
                            math.floor(min(max(excess, -MAX_EXCESS), MAX_EXCESS) * STEPS_PER_EXCESS)
                            + MAX_EXCESS * STEPS_PER_EXCESS
                        )
                    ]
                    known = not math.isnan(cells.closed[r, c])
                    reason = blocks.flags[i, j]
                    if cells.filled[r, c]:
                        reason |= np.uint16(FILLED_BIT)
                    # A hazard that is proven by a part of the window stays one, however little is known.
                    if known and load > 1:
                        cells.risk[r, c] = HAZARDOUS
                        reason |= over | (np.uint16(DOUBT_BIT) if excess <= 0 else NO_BITS)
                    elif known and blocks.share[i, j] >= rules.min_known:
                        cells.risk[r, c] = CAUTION if load > rules.caution or p > rules.max_p else SAFE
                    else:
                        cells.risk[r, c], p = UNKNOWN, np.float32(np.nan)
                        reason |= np.uint16(UNKNOWN_BIT)
                    cells.reason[r, c], cells.p[r, c] = reason, p
                    unknown = cells.risk[r, c] == UNKNOWN
                    for k in range(len(blocks.bands)):
                        cells.bands[k][r, c] = np.float32(np.nan) if unknown else blocks.bands[k][i, j]
                    for k in range(count if unknown else 0):
                        cells.fields[k][r, c] = np.float32(np.nan)
