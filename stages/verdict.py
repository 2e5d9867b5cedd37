"""Measures held against the limits of a vehicle, cell by cell: class, reasons, probability, and bands to look at.

What is on blocks is judged there first. Then each row of cells is worked on as lines: load and excess of the blocks
spread over it, those of the three measures of its own added, and all bands written, in one pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from stages.hazards import BITS, FREEDOM, HIDDEN, LIFT, MEASURES, Measured, limits, noise_factors
from stages.vehicle import Vehicle

Floats32 = NDArray[np.float32]

SAFE, CAUTION, HAZARDOUS, UNKNOWN = 0, 1, 2, 3
"""Classes of ``risk``."""

UNKNOWN_BIT, FILLED_BIT, DOUBT_BIT, UNSEEN_BIT = 1 << 7, 1 << 8, 1 << 9, 1 << 10

WHOLE = 0.999
"""Share of a window from which it counts as wholly known."""

FINE = ("inclination", "range", "step")
"""Measures on the cells; the others are on blocks."""

BAND, STRIP = 16, 384
"""Rows of blocks, and columns of cells, that are worked on at a time: lines of all bands stay in a cache of 48 kB."""

STEPS, FARTHEST = 64, 16.0
"""Table of the distribution: steps a unit, and where it ends."""

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
    """Classes and bands (row, col) of :func:`stages.risk.risk_map`; ``measured`` is used up.

    Parameters
    ----------
    closed, filled : (row, col) elevation with holes closed, metres, and 1 where it was closed.
    window, cell : metres, sides of the wheel's window and of a cell.
    """
    facts = _facts(vehicle, window, cell, rules.sigmas)
    gap, patchy = np.float32(vehicle.max_step) * (1.0 - np.minimum(measured.share, 1.0)), measured.unstood
    doubt = np.hypot(measured.noise, np.float32(HIDDEN[0]) * gap).astype(np.float32)
    below = np.hypot(measured.noise_under, np.float32(HIDDEN[1] * vehicle.max_step) * patchy).astype(np.float32)
    shape, coarse = closed.shape, measured.noise.shape
    load, excess = np.zeros(coarse, np.float32), np.full(coarse, -FARTHEST, np.float32)
    bits = np.zeros(coarse, np.uint16)
    for name, values in measured.blocks.items():
        noise = (measured.noise, doubt) if name == "roughness" else (measured.noise_under, below)
        _hold_all(values, facts[name], *noise, load, excess, bits)
    blocks = np.stack(
        [
            load, excess, measured.noise, doubt, measured.share, measured.unstood, measured.blocks["roughness"],
            np.arctan(measured.blocks["slope"]), np.arctan(measured.blocks["tilt"]),
            np.float32(vehicle.clearance) - measured.blocks["rise"],
        ]
    )  # fmt: skip
    risk, reason = np.empty(shape, np.uint8), np.empty(shape, np.uint16)
    bands = [np.empty(shape, np.float32) for _ in range(6)]
    marks = np.array([rules.caution, rules.max_p, rules.min_known, WHOLE], np.float32)
    fine, table, n = np.stack([facts[name] for name in FINE]), _table(), measured.stride
    at = (np.arange(shape[1]) // n).astype(np.uint32)
    inclination, roughness, slope, tilt, clearance, p = bands
    for first in range(0, shape[0], n * BAND):
        rows, of = slice(first, first + n * BAND), slice(first // n, first // n + BAND)
        _classify(
            fine, np.float32(1.0 / measured.extent), measured.range[rows], measured.step[rows], closed[rows],
            filled[rows], np.ascontiguousarray(blocks[:, of]), bits[of], at, n, marks, table, risk[rows], reason[rows],
            *(band[rows] for band in bands),
        )  # fmt: skip
        np.arctan(inclination[rows], out=inclination[rows])
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


@njit(cache=True, nogil=True)
def _classify(  # type: ignore[no-untyped-def]
    facts, per_metre, height_range, step, closed, filled, blocks, bits0, at, n, marks, table,
    risk, reason, inclination, roughness, slope, tilt, clearance, p,
):  # fmt: skip
    """Rows of cells, of which the first one is the first of a row of blocks; ``at`` is the block of each column."""
    rows, cols = risk.shape
    width = min(cols, STRIP)
    wide = np.empty((blocks.shape[0], width), dtype=np.float32)
    before, bits = np.empty(width, dtype=np.uint16), np.empty(width, dtype=np.uint16)
    load, excess = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    for top in range(0, rows, n):
        for left in range(0, cols, width):
            right = min(left + width, cols)
            m = right - left
            for k in range(blocks.shape[0]):
                _spread(blocks[k, top // n], at[left:right], wide[k])
            _spread(bits0[top // n], at[left:right], before)
            for r in range(top, min(top + n, rows)):
                for c in range(m):
                    load[c], excess[c], bits[c] = wide[0, c], wide[1, c], before[c]
                inclined, ranged, stepped = inclination[r, left:right], height_range[r, left:right], step[r, left:right]
                kind, chance = risk[r, left:right], p[r, left:right]
                for c in range(m):
                    inclined[c] = ranged[c] * per_metre
                _hold(inclined, facts[0], wide[2], wide[3], load, excess, bits)
                _hold(ranged, facts[1], wide[2], wide[3], load, excess, bits)
                _hold(stepped, facts[2], wide[2], wide[3], load, excess, bits)
                _look_up(excess, table, chance)
                _decide(
                    load, excess, bits, chance, closed[r, left:right], filled[r, left:right], wide[4], wide[5], marks,
                    kind, reason[r, left:right],
                )  # fmt: skip
                _blank(kind, inclined)
                _blank(kind, ranged)
                _blank(kind, stepped)
                _blank(kind, chance)
                _put(kind, wide[6], roughness[r, left:right])
                _put(kind, wide[7], slope[r, left:right])
                _put(kind, wide[8], tilt[r, left:right])
                _put(kind, wide[9], clearance[r, left:right])


@njit(cache=True, nogil=True)
def _spread(blocks, at, out):  # type: ignore[no-untyped-def]
    for c in range(at.shape[0]):
        out[c] = blocks[at[c]]


@njit(cache=True, nogil=True)
def _look_up(excess, table, p):  # type: ignore[no-untyped-def]
    for c in range(p.shape[0]):
        least = excess[c] if excess[c] > -FARTHEST else -FARTHEST
        t = least if least < FARTHEST else FARTHEST
        p[c] = table[np.uint32((t + FARTHEST) * STEPS)]


@njit(cache=True, nogil=True)
def _decide(load, excess, bits, p, closed, filled, share, unstood, marks, risk, reason):  # type: ignore[no-untyped-def]
    caution, max_p, min_known, whole = marks[0], marks[1], marks[2], marks[3]
    one, zero, none = np.float32(1.0), np.float32(0.0), np.uint16(0)
    for c in range(risk.shape[0]):
        known = closed[c] == closed[c]
        hazardous = known & (load[c] > one)
        unknown = (not known) | ((share[c] < min_known) & (not hazardous))
        near = (load[c] > caution) | (p[c] > max_p)
        kind = np.uint8(HAZARDOUS) if hazardous else (np.uint8(CAUTION) if near else np.uint8(SAFE))
        risk[c] = np.uint8(UNKNOWN) if unknown else kind
    for c in range(risk.shape[0]):
        hazardous, unknown = risk[c] == HAZARDOUS, risk[c] == UNKNOWN
        why = bits[c] if hazardous else none
        why |= np.uint16(DOUBT_BIT) if hazardous & (excess[c] <= zero) else none
        why |= np.uint16(UNKNOWN_BIT) if unknown else none
        why |= np.uint16(FILLED_BIT) if filled[c] == 1 else none
        why |= np.uint16(UNSEEN_BIT) if (share[c] < whole) | (unstood[c] > zero) else none
        reason[c] = why


@njit(cache=True, nogil=True)
def _blank(risk, values):  # type: ignore[no-untyped-def]
    for c in range(values.shape[0]):
        values[c] = np.float32(np.nan) if risk[c] == UNKNOWN else values[c]


@njit(cache=True, nogil=True)
def _put(risk, values, out):  # type: ignore[no-untyped-def]
    for c in range(out.shape[0]):
        out[c] = np.float32(np.nan) if risk[c] == UNKNOWN else values[c]
