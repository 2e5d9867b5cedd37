"""Measures held against the limits of a vehicle, cell by cell: class, reasons, probability, and bands to look at.

What is on blocks is judged there first. Then each row of cells is worked on as lines: load and excess of the blocks
spread over it, those of the three measures of its own added, and all bands written, in one pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from rille.stages.hazard.hazards import BITS, FREEDOM, HIDDEN, LIFT, MEASURES, Measured, limits, noise_factors
from rille.stages.hazard.vehicle import Vehicle

Floats32 = NDArray[np.float32]

SAFE, CAUTION, HAZARDOUS, UNKNOWN = 0, 1, 2, 3
"""Classes of ``risk``."""

UNKNOWN_BIT, FILLED_BIT, DOUBT_BIT, UNSEEN_BIT = 1 << 7, 1 << 8, 1 << 9, 1 << 10

WHOLE = 0.999
"""Share of a window from which it counts as wholly known."""

FINE = ("inclination", "range", "step")
"""Measures on the cells; the others are on blocks."""

STRIP = 1536
"""Columns of cells that are worked on at a time: long lines are read ahead of their use, and all stay in the cache."""

STEPS, FARTHEST = 64, 16.0
"""Table of the distribution: steps a unit, and where it ends."""

NONE = 2.0**-44
"""Of a step: the sum of it and 16 in 64 bits is 16."""

LEAST = np.float32(1e-12)
"""Of a limit; standard deviation of a measure of exact elevations, so that none is divided by."""


@dataclass(frozen=True)
class Rules:
    """From what on a cell is what: parameters of ``risk``."""

    sigmas: float
    caution: float
    max_p: float
    min_known: float


def classify(
    measured: Measured,
    closed: Floats32,
    filled: NDArray[np.uint8],
    vehicle: Vehicle,
    window: float,
    cell: float,
    rules: Rules,
) -> dict[str, NDArray]:
    """Classes and bands (row, col) of :func:`rille.stages.hazard.risk.risk_map`; ``measured`` is used up.

    Parameters
    ----------
    closed, filled : (row, col) elevation with holes closed, metres, and 1 where it was closed.
    window, cell : metres, sides of the wheel's window and of a cell.
    """
    facts = _facts(vehicle, window, cell, rules.sigmas)
    gap, patchy = np.float32(vehicle.max_step) * (1.0 - np.minimum(measured.share, 1.0)), measured.unstood
    doubt = _with(measured.noise, np.float32(HIDDEN[0]) * gap)
    below = _with(measured.noise_under, np.float32(HIDDEN[1] * vehicle.max_step) * patchy)
    shape, coarse = closed.shape, measured.noise.shape
    blocks = np.empty((9, *coarse), np.float32)
    load, excess = blocks[0], blocks[1]
    load[:], excess[:] = 0.0, -FARTHEST
    blocks[2], blocks[3], blocks[4], blocks[5] = measured.noise, doubt, measured.share, measured.blocks["roughness"]
    for k, name in ((6, "slope"), (7, "tilt")):
        np.arctan(measured.blocks[name], out=blocks[k])
    np.subtract(np.float32(vehicle.clearance), measured.blocks["rise"], out=blocks[8])
    bits = np.zeros((2, *coarse), np.uint16)
    for name, values in measured.blocks.items():
        noise = (measured.noise, doubt) if name == "roughness" else (measured.noise_under, below)
        _hold_all(values, facts[name], *noise, load, excess, bits[0])
    bits[1] = np.where((measured.share < WHOLE) | (patchy > 0), UNSEEN_BIT, 0)
    risk, reason = np.empty(shape, np.uint8), np.empty(shape, np.uint16)
    inclination, roughness, slope, tilt, clearance, p = (np.empty(shape, np.float32) for _ in range(6))
    marks = np.array([rules.caution, rules.max_p, rules.min_known], np.float32)
    _classify(
        np.stack([facts[name] for name in FINE]), np.float32(1.0 / measured.extent), measured.range, measured.step,
        closed, filled, blocks, bits, measured.stride, marks, _table(), risk, reason,
        inclination, roughness, slope, tilt, clearance, p,
    )  # fmt: skip
    np.arctan(inclination, out=inclination)
    return {
        "risk": risk,
        "reason": reason,
        "inclination": inclination,
        "height_range": measured.range,
        "step": measured.step,
        "roughness": roughness,
        "slope": slope,
        "tilt": tilt,
        "clearance": clearance,
        "p_hazard": p,
    }


def _facts(vehicle: Vehicle, window: float, cell: float, sigmas: float) -> dict[str, Floats32]:
    """Of each measure limit, bias, spread, standard deviations added beyond the bias, and bit."""
    limit, noise = limits(vehicle), noise_factors(vehicle, window, cell)
    return {
        name: np.array(
            [limit[name], *noise[name], max(0.0, sigmas * noise[name][1] - noise[name][0]), BITS[name]], np.float32
        )
        for name in MEASURES
    }


def _with(noise: Floats32, hidden: NDArray[np.floating]) -> Floats32:
    """Noise widened by what may be hidden; mostly there is nothing."""
    out = noise.copy()
    np.hypot(noise, hidden, out=out, where=hidden > 0)
    return out


@cache
def _table() -> Floats32:
    t = np.arange(-FARTHEST * STEPS, FARTHEST * STEPS + 1) / STEPS
    start, width, lift = LIFT
    found = scipy.special.stdtr(FREEDOM, t + lift * np.clip((t - start) / width, 0.0, 1.0))
    found[0], found[-1] = 0.0, 1.0
    return np.asarray(found, dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _hold(v, facts, noise, doubt, load, excess, bits):  # type: ignore[no-untyped-def]
    """One row of one measure against its limit: load, standardised excess and bits of the worst so far."""
    limit, bias, spread, added, bit = facts[0], facts[1], facts[2], facts[3], np.uint16(facts[4])
    scale, least, none, one = np.float32(1.0) / limit, LEAST * limit, np.uint16(0), np.float32(1.0)
    # three loops of few arrays each, which the compiler then takes several cells at a time
    n = v.shape[0]
    for c in range(n):
        here = (v[c] + added * noise[c]) * scale
        load[c] = here if here > load[c] else load[c]
    for c in range(n):
        bits[c] |= bit if (v[c] + added * noise[c]) * scale > one else none
    for c in range(n):
        s, wide = noise[c], doubt[c]
        over = v[c] - bias * s - limit
        s = s if over > np.float32(0.0) else wide
        t = over / (spread * s + least)
        excess[c] = t if t > excess[c] else excess[c]


@njit(cache=True, nogil=True)
def _hold_all(values, facts, noise, doubt, load, excess, bits):  # type: ignore[no-untyped-def]
    for r in range(values.shape[0]):
        _hold(values[r], facts, noise[r], doubt[r], load[r], excess[r], bits[r])


# Lines are read and written in place, from a column that is not signed: to make them arrays of their own takes a tenth
# of the work on them, and a signed index would be looked at for whether it counts from the end.


@njit(cache=True, nogil=True, error_model="numpy")
def _classify(  # type: ignore[no-untyped-def]
    facts, per_metre, height_range, step, closed, filled, blocks, bits, n, marks, table,
    risk, reason, inclination, roughness, slope, tilt, clearance, p,
):  # fmt: skip
    """Cells of each block of ``n`` x ``n``, by strips of whole blocks; ``bits`` (2, row, col) of the blocks' own
    hazards, and of any class."""
    rows, cols = risk.shape
    width = n * max(1, STRIP // n)
    wide = np.empty((blocks.shape[0], width), dtype=np.float32)
    own = np.empty((2, width), dtype=np.uint16)
    load, excess = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    place = np.empty(width, dtype=np.int32)
    for top in range(0, rows, n):
        for left in range(0, cols, width):
            size, of = np.uint64(min(width, cols - left)), slice(left // n, left // n + width // n)
            for k in range(blocks.shape[0]):
                _spread(blocks[k, top // n, of], n, wide[k])
            for k in range(2):
                _spread(bits[k, top // n, of], n, own[k])
            for row in range(top, min(top + n, rows)):
                r, at = np.uint64(row), np.uint64(left)
                _load(facts, per_metre, height_range, step, wide, r, at, size, load)
                _excess(facts, per_metre, height_range, step, wide, r, at, size, excess)
                _look_up(excess, table, place, r, at, size, p)
                some = _decide(load, p, closed, wide, marks, r, at, size, risk)
                _explain(risk, filled, own, r, at, size, reason)
                if some & 1:
                    _blame(risk, facts, per_metre, height_range, step, wide, own, excess, r, at, size, reason)
                _incline(risk, height_range, per_metre, r, at, size, inclination)
                if some & 2:
                    for band in (height_range, step, p):
                        _blank(risk, r, at, size, band)
                _put(risk, wide, np.uint64(5), some & 2, r, at, size, roughness)
                _put(risk, wide, np.uint64(6), some & 2, r, at, size, slope)
                _put(risk, wide, np.uint64(7), some & 2, r, at, size, tilt)
                _put(risk, wide, np.uint64(8), some & 2, r, at, size, clearance)


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


# Loops below write one array each: with more, the compiler would have to compare too many of them for overlaps before
# it may take several cells at a time.


@njit(cache=True, nogil=True)
def _load(facts, per_metre, height_range, step, wide, r, left, size, out):  # type: ignore[no-untyped-def]
    """Greatest load of the blocks' and of the three measures."""
    one = np.float32(1.0)
    p, q, s = one / facts[0, 0], one / facts[1, 0], one / facts[2, 0]
    u, v, w = facts[0, 3], facts[1, 3], facts[2, 3]
    for c in range(size):
        ranged, stepped, noise, most = height_range[r, left + c], step[r, left + c], wide[2, c], wide[0, c]
        a, b = (ranged * per_metre + u * noise) * p, (ranged + v * noise) * q
        d = (stepped + w * noise) * s
        most = a if a > most else most
        most = b if b > most else most
        out[c] = d if d > most else most


@njit(cache=True, nogil=True, error_model="numpy")
def _excess(facts, per_metre, height_range, step, wide, r, left, size, out):  # type: ignore[no-untyped-def]
    """Greatest standardised excess, likewise."""
    limit0, bias0, spread0, least0 = facts[0, 0], facts[0, 1], facts[0, 2], LEAST * facts[0, 0]
    limit1, bias1, spread1, least1 = facts[1, 0], facts[1, 1], facts[1, 2], LEAST * facts[1, 0]
    limit2, bias2, spread2, least2 = facts[2, 0], facts[2, 1], facts[2, 2], LEAST * facts[2, 0]
    none = np.float32(0.0)
    for c in range(size):
        ranged, stepped = height_range[r, left + c], step[r, left + c]
        s, doubt, most = wide[2, c], wide[3, c], wide[1, c]
        over = ranged * per_metre - bias0 * s - limit0
        t = over / (spread0 * (s if over > none else doubt) + least0)
        most = t if t > most else most
        over = ranged - bias1 * s - limit1
        t = over / (spread1 * (s if over > none else doubt) + least1)
        most = t if t > most else most
        over = stepped - bias2 * s - limit2
        t = over / (spread2 * (s if over > none else doubt) + least2)
        out[c] = t if t > most else most


@njit(cache=True, nogil=True)
def _look_up(excess, table, place, r, left, size, p):  # type: ignore[no-untyped-def]
    """The entry at or below; what is below 0 by no more than :data:`NONE` counts as 0."""
    far, steps, none = np.float32(FARTHEST), np.float32(STEPS), np.float32(-NONE)
    for c in range(size):
        least = excess[c] if excess[c] > -far else -far
        t = (least if least < far else far) * steps
        k = np.int32(t)
        below = (np.float32(k) > t) & (t < none)
        place[c] = k + np.int32(FARTHEST * STEPS) - np.int32(below)
    for c in range(size):
        p[r, left + c] = table[np.uint32(place[c])]


@njit(cache=True, nogil=True)
def _decide(load, p, closed, wide, marks, r, left, size, risk):  # type: ignore[no-untyped-def]
    """Classes; returns 1 if some are hazardous, plus 2 if some are unknown."""
    caution, max_p, min_known = marks[0], marks[1], marks[2]
    one = np.float32(1.0)
    for c in range(size):
        known = closed[r, left + c] == closed[r, left + c]
        hazardous = known & (load[c] > one)
        unknown = (not known) | ((wide[4, c] < min_known) & (not hazardous))
        near = (load[c] > caution) | (p[r, left + c] > max_p)
        kind = np.uint8(HAZARDOUS) if hazardous else (np.uint8(CAUTION) if near else np.uint8(SAFE))
        risk[r, left + c] = np.uint8(UNKNOWN) if unknown else kind
    hazards, gaps = np.uint8(0), np.uint8(0)
    for c in range(size):
        hazards |= np.uint8(risk[r, left + c] == HAZARDOUS)
        gaps |= np.uint8(risk[r, left + c] == UNKNOWN)
    return np.int64(hazards) + 2 * np.int64(gaps)


@njit(cache=True, nogil=True)
def _explain(risk, filled, own, r, left, size, reason):  # type: ignore[no-untyped-def]
    """Reasons of cells that are not hazardous."""
    none = np.uint16(0)
    for c in range(size):
        why = own[1, c] | (np.uint16(UNKNOWN_BIT) if risk[r, left + c] == UNKNOWN else none)
        reason[r, left + c] = why | (np.uint16(FILLED_BIT) if filled[r, left + c] == 1 else none)


@njit(cache=True, nogil=True)
def _blame(risk, facts, per_metre, height_range, step, wide, own, excess, r, left, size, reason):  # type: ignore[no-untyped-def]
    """Add the measures that make a hazard, and whether only noise does."""
    one, zero, none = np.float32(1.0), np.float32(0.0), np.uint16(0)
    p, q, s = one / facts[0, 0], one / facts[1, 0], one / facts[2, 0]
    u, v, w = facts[0, 3], facts[1, 3], facts[2, 3]
    bit0, bit1, bit2 = np.uint16(facts[0, 4]), np.uint16(facts[1, 4]), np.uint16(facts[2, 4])
    for c in range(size):
        ranged, stepped, noise = height_range[r, left + c], step[r, left + c], wide[2, c]
        why = own[0, c] | (bit0 if (ranged * per_metre + u * noise) * p > one else none)
        why |= bit1 if (ranged + v * noise) * q > one else none
        why |= bit2 if (stepped + w * noise) * s > one else none
        why |= np.uint16(DOUBT_BIT) if excess[c] <= zero else none
        reason[r, left + c] |= why if risk[r, left + c] == HAZARDOUS else none


@njit(cache=True, nogil=True)
def _incline(risk, height_range, per_metre, r, left, size, out):  # type: ignore[no-untyped-def]
    for c in range(size):
        v = height_range[r, left + c] * per_metre
        out[r, left + c] = np.float32(np.nan) if risk[r, left + c] == UNKNOWN else v


@njit(cache=True, nogil=True)
def _blank(risk, r, left, size, band):  # type: ignore[no-untyped-def]
    for c in range(size):
        v = band[r, left + c]
        band[r, left + c] = np.float32(np.nan) if risk[r, left + c] == UNKNOWN else v


@njit(cache=True, nogil=True)
def _put(risk, wide, k, gaps, r, left, size, out):  # type: ignore[no-untyped-def]
    if not gaps:
        for c in range(size):
            out[r, left + c] = wide[k, c]
        return
    for c in range(size):
        v = wide[k, c]
        out[r, left + c] = np.float32(np.nan) if risk[r, left + c] == UNKNOWN else v
