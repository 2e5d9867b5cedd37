"""Measures held against the limits of a vehicle, cell by cell: class, reasons, probability, and a raster of each.

For a measure V with limit L, bias b and spread d per metre of the elevations' standard deviation s, and k ``sigmas``:

    load   = (V + max(0, k d - b) s) / L         hazardous above 1; V carries the bias already, so k d - b more is added
    excess = (V - b s - L) / (d s')              s' = s above the limit, else s widened by what unknown ground may hide

A cell's class follows from its greatest load, ``p_hazard = F(greatest excess)`` from its greatest excess: all measures
look at one ground, so they err together. F is Student's t, since matching errs grossly now and then, steeper about the
limit (:data:`LIFT`). With ``k d >= b``, which is enforced, more noise is never safer.

The measures on blocks are judged on blocks. Then strips of rows are worked on, so that a strip's lines stay in the
cache: the blocks' load and excess are spread over the cells, each measure on cells is held against its limit, and all
rasters are written.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats32
from rille.stages.hazard.measures import MEASURES, HazardInput, Measure
from rille.stages.numeric.line import copy_line

Bits = NDArray[np.uint16]

SAFE, CAUTION, HAZARDOUS, UNKNOWN = 0, 1, 2, 3
"""Classes of ``risk``."""

UNKNOWN_BIT, FILLED_BIT, DOUBT_BIT, UNSEEN_BIT = 1 << 7, 1 << 8, 1 << 9, 1 << 10

WHOLE = 0.999
"""Share of a window from which it counts as wholly known."""

HIDDEN = 0.5
"""Steps of the vehicle by which unknown ground widens the doubt of a measure, where all of the wheel's window, or of
the ground below the vehicle, is unknown: the measure does not hold what is hidden there."""

STRIP = 1536
"""Columns of cells that are worked on at a time: long lines are read ahead of their use, and all stay in the cache."""

STEPS, FARTHEST = 64, 16.0
"""Table of F: steps a unit of excess, and where it ends."""

FREEDOM = 3.0
"""Degrees of freedom of Student's t."""

LIFT = (-0.4, 0.6, 0.8)
"""Excess from which and width over which t is raised, and by how much: a measure found at its limit is more often above
it than below, since a matcher smooths relief away more often than it makes some. Fitted with the noise of
:mod:`rille.stages.hazard.measures`; F stays a rising function."""

NONE = 2.0**-44
"""Excess, in steps of the table, below which a negative one counts as 0: 16 plus it is 16 in 64 bits."""

LEAST = np.float32(1e-12)
"""Smallest standard deviation of a measure, as a share of its limit: the excess of exact elevations is then finite."""


class Rules(NamedTuple):
    """Thresholds of the classes: parameters of ``risk``."""

    sigmas: float
    caution: float
    max_p: float
    min_known: float


class Limit(NamedTuple):
    """One measure's limit, bias and spread as above; ``added`` standard deviations of its load; its bit; and ``noise``:
    the index of its noise (:attr:`ClassifiedBlocks.noise`), after which comes the index of its doubt."""

    limit: np.float32
    bias: np.float32
    spread: np.float32
    added: np.float32
    bit: np.uint16
    noise: np.int64


class ClassifiedBlocks(NamedTuple):
    """Arrays (row, col) of blocks, float32 and uint16.

    ``load`` and ``excess``: greatest ones of the measures on blocks; ``over``: bits of those above their limits;
    ``flags``: bits whatever the class. ``noise`` (4, row, col): standard deviation and doubt, metres, in the wheel's
    window, then below the vehicle; ``share``: known share of the wheel's window; ``bands``: rasters of the measures.
    """

    load: Floats32
    excess: Floats32
    over: Bits
    flags: Bits
    noise: Floats32
    share: Floats32
    bands: tuple[Floats32, ...]


class Cells(NamedTuple):
    """Arrays (row, col) of cells: elevation with holes ``closed`` and 1 where it was ``filled``; then what is written:
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
    vehicle, closed, n = terrain.vehicle, terrain.closed, terrain.stride
    values = {m.name: m.kernel(terrain) for m in measures}
    limits = {m.name: _limit(m, terrain, rules.sigmas) for m in measures}
    on_cells, on_blocks = ([m for m in measures if m.on_blocks == kind] for kind in (False, True))
    share, patchy = terrain.known_share(), terrain.places.unstood
    noise, below = terrain.window_noise(), terrain.footprint_noise()
    # In proportion to what is unknown; a step, since whatever is higher shows at the rim of what is known.
    gap = np.float32(vehicle.max_step) * (1.0 - np.minimum(share, 1.0))
    doubts = np.float32(HIDDEN) * gap, np.float32(HIDDEN * vehicle.max_step) * patchy
    noises = np.stack([noise, _wider(noise, doubts[0]), below, _wider(below, doubts[1])])
    load, excess = np.zeros_like(noise), np.full_like(noise, -FARTHEST)
    over = np.zeros(noise.shape, np.uint16)
    for m in on_blocks:
        lines = [a.ravel() for a in (values[m.name], *noises[limits[m.name].noise :][:2])]
        _hold(*lines, limits[m.name], load.ravel(), excess.ravel())
        _add_bits(*lines[:2], limits[m.name], over.ravel())
    flags = np.where((share < WHOLE) | (patchy > 0), np.uint16(UNSEEN_BIT), np.uint16(0))
    bands = {m.name: _band(m, values[m.name], vehicle.clearance) for m in on_blocks}
    blocks = ClassifiedBlocks(load, excess, over, flags, noises, share, tuple(bands.values()))
    fields = tuple(values[m.name] for m in on_cells)
    del terrain, values  # blocks of a large map take as much memory as all rasters together
    shape = closed.shape
    wide = tuple(np.empty(shape, np.float32) for _ in bands)
    risk, reason, p = (np.empty(shape, t) for t in (np.uint8, np.uint16, np.float32))
    cells = Cells(closed, filled, risk, reason, p, wide, fields)
    marks = np.array([rules.caution, rules.max_p, rules.min_known], np.float32)
    _classify(tuple(limits[m.name] for m in on_cells), blocks, cells, n, marks, _table())
    rasters = dict(zip(bands, wide, strict=True))
    rasters |= {m.name: _band(m, a, vehicle.clearance) for m, a in zip(on_cells, fields, strict=True)}
    return {"risk": risk, "reason": reason} | {m.band: rasters[m.name] for m in measures} | {"p_hazard": p}


def _limit(m: Measure, terrain: HazardInput, sigmas: float) -> Limit:
    f, bias, spread = np.float32, m.bias / m.length(terrain), m.spread / m.length(terrain)
    # A measure already carries the bias of its extrema: only what the standard deviations exceed it by is added.
    added, noise = max(0.0, sigmas * spread - bias), 2 if m.below else 0
    return Limit(f(m.greatest(terrain.vehicle)), f(bias), f(spread), f(added), np.uint16(m.bit), np.int64(noise))


def _wider(noise: Floats32, hidden: NDArray[np.floating]) -> Floats32:
    """Noise widened by the relief that may be hidden; mostly there is none."""
    out = noise.copy()
    np.hypot(noise, hidden, out=out, where=hidden > 0)
    return out


def _band(m: Measure, values: Floats32, most: float) -> Floats32:
    """A measure in the unit of its raster."""
    if m.left:
        return np.subtract(np.float32(most), values)
    return np.arctan(values, out=values) if m.in_degrees else values


@cache
def _table() -> Floats32:
    t = np.arange(-FARTHEST * STEPS, FARTHEST * STEPS + 1) / STEPS
    start, width, lift = LIFT
    found = scipy.special.stdtr(FREEDOM, t + lift * np.clip((t - start) / width, 0.0, 1.0))
    # Beyond the table's ends the answer is certain, whatever the tails of Student's t.
    found[0], found[-1] = 0.0, 1.0
    return np.asarray(found, dtype=np.float32)


# Each loop below writes one array: with more, the compiler has to test too many of them for overlap before it may take
# several cells at a time. All numbers are float32, since one 64-bit number would widen a whole loop.


@njit(cache=True, nogil=True, error_model="numpy")
def _hold(value, noise, doubt, limit, load, excess):  # type: ignore[no-untyped-def]
    """Raise load and excess of a line to those of one measure (the equations of the module)."""
    scale, least = np.float32(1.0) / limit.limit, LEAST * limit.limit
    for c in range(value.size):
        here = (value[c] + limit.added * noise[c]) * scale
        load[c] = here if here > load[c] else load[c]
    for c in range(value.size):
        over = value[c] - limit.bias * noise[c] - limit.limit
        # What is hidden can only raise a measure, so it makes no hazard less certain.
        s = noise[c] if over > np.float32(0.0) else doubt[c]
        # Of exact elevations s is 0: the excess is then very large, not infinite or NaN.
        t = over / (limit.spread * s + least)
        excess[c] = t if t > excess[c] else excess[c]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_bits(value, noise, limit, bits):  # type: ignore[no-untyped-def]
    """Add one measure's bit where its load is above 1."""
    scale, bit = np.float32(1.0) / limit.limit, limit.bit
    for c in range(value.size):
        bits[c] |= bit if (value[c] + limit.added * noise[c]) * scale > np.float32(1.0) else np.uint16(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _classify(limits, blocks, cells, n, marks, table):  # type: ignore[no-untyped-def]
    """Cells of each block of ``n`` x ``n``, by strips of whole blocks; ``limits`` of ``cells.fields``."""
    rows, cols = cells.risk.shape
    width = n * max(1, STRIP // n)
    load0, excess0, share = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    noise, bands = np.empty((4, width), np.float32), np.empty((len(blocks.bands), width), np.float32)
    over0, flags = np.empty(width, np.uint16), np.empty(width, np.uint16)
    load, excess = np.empty(width, np.float32), np.empty(width, np.float32)
    over, place = np.empty(width, np.uint16), np.empty(width, np.int32)
    for top in range(0, rows, n):
        for left in range(0, cols, width):
            i, of = top // n, slice(left // n, left // n + width // n)
            _spread(blocks.load[i, of], n, load0)
            _spread(blocks.excess[i, of], n, excess0)
            _spread(blocks.share[i, of], n, share)
            _spread(blocks.over[i, of], n, over0)
            _spread(blocks.flags[i, of], n, flags)
            for k in range(4):
                _spread(blocks.noise[k, i, of], n, noise[k])
            for k in range(len(blocks.bands)):
                _spread(blocks.bands[k][i, of], n, bands[k])
            for r in range(top, min(top + n, rows)):
                part = slice(left, min(left + width, cols))
                copy_line(load0, load)
                copy_line(excess0, excess)
                for k in range(len(limits)):
                    s = limits[k].noise
                    _hold(cells.fields[k][r, part], noise[s], noise[s + 1], limits[k], load, excess)
                risk, reason = cells.risk[r, part], cells.reason[r, part]
                _look_up(excess, table, place, cells.p[r, part])
                hazards, gaps = _decide(load, cells.p[r, part], cells.closed[r, part], share, marks, risk)
                _explain(risk, cells.filled[r, part], flags, reason)
                if hazards:
                    copy_line(over0, over)
                    for k in range(len(limits)):
                        _add_bits(cells.fields[k][r, part], noise[limits[k].noise], limits[k], over)
                    _blame(risk, over, excess, reason)
                if gaps:
                    _blank(risk, cells.p[r, part])
                    for k in range(len(limits)):
                        _blank(risk, cells.fields[k][r, part])
                for k in range(len(blocks.bands)):
                    copy_line(bands[k, : risk.size], cells.bands[k][r, part])
                    if gaps:
                        _blank(risk, cells.bands[k][r, part])


@njit(cache=True, nogil=True)
def _spread(blocks, n, out):  # type: ignore[no-untyped-def]
    """Each block ``n`` times."""
    if n == 4:  # of a known number the compiler writes all at once
        for j in range(blocks.shape[0]):
            v = blocks[j]
            out[4 * j], out[4 * j + 1], out[4 * j + 2], out[4 * j + 3] = v, v, v, v
        return
    for j in range(blocks.shape[0]):
        for k in range(n):
            out[n * j + k] = blocks[j]


@njit(cache=True, nogil=True)
def _look_up(excess, table, place, p):  # type: ignore[no-untyped-def]
    """F by the entry at or below; an excess below 0 by no more than :data:`NONE` counts as 0."""
    far, steps, none = np.float32(FARTHEST), np.float32(STEPS), np.float32(-NONE)
    for c in range(p.size):
        least = excess[c] if excess[c] > -far else -far
        t = (least if least < far else far) * steps
        k = np.int32(t)  # towards 0, so a negative number is one entry too high
        below = (np.float32(k) > t) & (t < none)
        place[c] = k + np.int32(FARTHEST * STEPS) - np.int32(below)
    for c in range(p.size):
        p[c] = table[np.uint32(place[c])]


@njit(cache=True, nogil=True)
def _decide(load, p, closed, share, marks, risk):  # type: ignore[no-untyped-def]
    """Classes of a line; whether some are hazardous, and whether some are unknown."""
    caution, max_p, min_known = marks[0], marks[1], marks[2]
    one = np.float32(1.0)
    for c in range(risk.size):
        known = closed[c] == closed[c]
        hazardous = known & (load[c] > one)
        # A hazard that is proven by a part of the window stays one, however little is known.
        unknown = (not known) | ((share[c] < min_known) & (not hazardous))
        near = (load[c] > caution) | (p[c] > max_p)
        kind = np.uint8(HAZARDOUS) if hazardous else (np.uint8(CAUTION) if near else np.uint8(SAFE))
        risk[c] = np.uint8(UNKNOWN) if unknown else kind
    hazards, gaps = np.uint8(0), np.uint8(0)
    for c in range(risk.size):
        hazards |= np.uint8(risk[c] == HAZARDOUS)
        gaps |= np.uint8(risk[c] == UNKNOWN)
    return hazards > 0, gaps > 0


@njit(cache=True, nogil=True)
def _explain(risk, filled, flags, reason):  # type: ignore[no-untyped-def]
    """Reasons of cells that are not hazardous."""
    none = np.uint16(0)
    for c in range(risk.size):
        why = flags[c] | (np.uint16(UNKNOWN_BIT) if risk[c] == UNKNOWN else none)
        reason[c] = why | (np.uint16(FILLED_BIT) if filled[c] == 1 else none)


@njit(cache=True, nogil=True)
def _blame(risk, over, excess, reason):  # type: ignore[no-untyped-def]
    """Add to hazards the measures over their limits, and whether only noise makes them so."""
    none = np.uint16(0)
    for c in range(risk.size):
        why = over[c] | (np.uint16(DOUBT_BIT) if excess[c] <= np.float32(0.0) else none)
        reason[c] |= why if risk[c] == HAZARDOUS else none


@njit(cache=True, nogil=True)
def _blank(risk, band):  # type: ignore[no-untyped-def]
    """NaN where a cell is unknown."""
    for c in range(risk.size):
        band[c] = np.float32(np.nan) if risk[c] == UNKNOWN else band[c]
