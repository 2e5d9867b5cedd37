"""Compare measures with the limits of a vehicle, cell by cell: class, reasons, probability, and a raster of each.

For a measure V with limit L, bias b and spread d per metre of the elevations' standard deviation s, and k ``sigmas``:

    load   = (V + max(0, k d - b) s) / L         hazardous above 1; V contains the bias b s, so k d - b more is added
    excess = (V - b s - L) / (d s')              s' = s above the limit, else s widened by what unknown ground may hide

A cell's class follows from its greatest load, ``p_hazard = F(greatest excess)`` from its greatest excess, since
measures of the same ground err together. ``p_wheel`` is F of the greatest excess of the measures of the wheel's window:
whether a wheel meets an edge does not depend on how the vehicle would stand there. F is Student's t, because of
occasional gross errors of matching, steeper about the limit (:data:`LIFT`). With ``k d >= b``, which is enforced, more
noise is never safer.

Measures on blocks are compared first. A cell starts with the load and the excess of its block; then each measure on
cells is compared with its limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bytes, Floats32
from rille.stages.core.declare import AnyArray, Params
from rille.stages.hazard.measures import MEASURES, HazardInput, Measure

Bits = NDArray[np.uint16]

SAFE, CAUTION, HAZARDOUS, UNKNOWN = 0, 1, 2, 3
"""Classes of ``risk``."""

UNKNOWN_BIT, FILLED_BIT, DOUBT_BIT, UNSEEN_BIT = 1 << 7, 1 << 8, 1 << 9, 1 << 10


HIDDEN_STEPS = 0.5
"""Standard deviation that entirely unknown ground in the wheel's window, or below the vehicle, adds to a measure, in
units of ``max_step``."""

MAX_EXCESS = 16.0
"""Excess from which on F is 1, and below whose negative it is 0: the tails of Student's t are left out."""

LIFT = 0.8
"""Added to t near and above the limit: a measure at its limit is more often above it than below, since a matcher
smooths relief away more often than it adds some. Fitted, like the excess where it begins, with the noise of
:mod:`rille.stages.hazard.measures`; F remains an increasing function."""


NO_BITS = np.uint16(0)


class RiskParams(Params):
    """Parameters of ``risk``; the limits themselves are the vehicle's.

    Attributes
    ----------
    window : side of the window [wheel diameters] in which terrain is judged; a wheel bridges what is finer.
    sigmas : number of standard deviations added to a measure before it is compared with its limit.
    caution : share of a limit from which a cell is caution ground; 0.75 is the usual reserve.
    max_p : probability of a hazard from which a cell is caution ground.
    min_known : smallest known share of the window; below it a cell is unknown; 0.5 is a straight border.
    max_hole : widest hole [wheel diameters] that is closed; over 0.5 a wheel sinks by 0.07 diameters.
    """

    window: float = Field(1.0, gt=0, le=20)
    sigmas: float = Field(1.25, ge=0, le=10)
    caution: float = Field(0.75, gt=0, le=1)
    max_p: float = Field(0.02, gt=0, lt=0.5)
    min_known: float = Field(0.5, gt=0, le=1)
    max_hole: float = Field(0.5, ge=0, le=1)


class Verdicts(NamedTuple):
    """Arrays (row, col): greatest ``load`` and ``excess`` of the measures, float32, and bits of those ``over`` their
    limits."""

    load: Floats32
    excess: Floats32
    over: Bits


def classify(
    terrain: HazardInput, filled: Bytes, params: RiskParams, measures: tuple[Measure, ...] = MEASURES
) -> dict[str, AnyArray]:
    """Classes, reasons and rasters (row, col) of :func:`rille.stages.hazard.risk.risk_map`.

    Parameters
    ----------
    filled : (row, col) 1 where a hole of the elevation model was closed.
    measures : rows of the table, at least one on cells and one on blocks.
    """
    share, patchy, n = terrain.known_share(), terrain.places.unstood, terrain.stride
    values = {m.name: m.kernel(terrain) for m in measures}
    noise = np.stack([terrain.window_noise(), terrain.footprint_noise()])
    # In proportion to the unknown share and to a step, since higher objects show at the rim of the known ground.
    hidden = np.float32(HIDDEN_STEPS * terrain.vehicle.max_step)
    doubt = np.hypot(noise, hidden * np.stack([1.0 - np.minimum(share, 1.0), patchy]))
    flags = np.where((share < 0.999) | (patchy > 0), np.uint16(UNSEEN_BIT), NO_BITS)

    def spread(a: AnyArray) -> AnyArray:
        """Cells (row, col) of blocks."""
        rows, cols = terrain.closed.shape
        return np.asarray(a.repeat(n, axis=0)[:rows].repeat(n, axis=1)[:, :cols])

    nothing = Verdicts(np.zeros_like(share), np.full_like(share, -MAX_EXCESS), np.zeros(share.shape, np.uint16))
    wide = np.stack([spread(a) for a in noise]), np.stack([spread(a) for a in doubt])

    def judged(*, below: bool) -> Verdicts:
        """Verdicts (row, col) of the measures in a wheel's window, or of all ground below the vehicle."""
        on_cells, on_blocks = (
            [(m, values[m.name]) for m in measures if (m.on_blocks, m.below) == (kind, below)] for kind in (False, True)
        )
        blocks = _judged(nothing, terrain, params.sigmas, on_blocks, (noise, doubt))
        return _judged(Verdicts(*(spread(a) for a in blocks)), terrain, params.sigmas, on_cells, wide)

    wheel, body = judged(below=False), judged(below=True)
    load, excess = np.maximum(wheel.load, body.load), np.maximum(wheel.excess, body.excess)
    over, p, p_wheel = wheel.over | body.over, _chance(excess), _chance(wheel.excess)
    # A hazard in the known part of a window is one, however small that part is.
    known = ~np.isnan(terrain.closed)
    hazardous = known & (load > 1)
    unknown = ~(hazardous | (known & (spread(share) >= params.min_known)))
    careful = (load > params.caution) | (p > params.max_p)
    risk = np.select([unknown, hazardous, careful], [UNKNOWN, HAZARDOUS, CAUTION], SAFE).astype(np.uint8)
    reason = spread(flags) | np.where(filled != 0, np.uint16(FILLED_BIT), NO_BITS)
    reason |= np.where(hazardous, over | np.where(excess <= 0, np.uint16(DOUBT_BIT), NO_BITS), NO_BITS)
    reason |= np.where(unknown, np.uint16(UNKNOWN_BIT), NO_BITS)
    out: dict[str, AnyArray] = {"risk": risk, "reason": reason}
    for m in measures:
        band = _band(m, values.pop(m.name), terrain.vehicle.clearance)
        out[m.band] = np.where(unknown, np.float32(np.nan), spread(band) if m.on_blocks else band)
    return out | {name: np.where(unknown, np.float32(np.nan), a) for name, a in (("p_hazard", p), ("p_wheel", p_wheel))}


def _judged(
    before: Verdicts,
    terrain: HazardInput,
    sigmas: float,
    values: Sequence[tuple[Measure, Floats32]],
    spreads: tuple[AnyArray, AnyArray],
) -> Verdicts:
    """Verdicts of more measures against the vehicle's limits, together with those ``before``.

    ``spreads`` (window, row, col): standard deviation, and the same with that of unknown ground, metres, in the wheel's
    window and below the vehicle.
    """
    (load, excess, over), f = before, np.float32
    for m, value in values:
        length, limit = m.length(terrain), f(m.greatest(terrain.vehicle))
        bias, spread = m.bias / length, m.spread / length
        noise, doubt = (maps[int(m.below)] for maps in spreads)
        # A measure already contains the bias of its extrema, so only the rest of the standard deviations is added.
        own = (value + f(max(0.0, sigmas * spread - bias)) * noise) / limit
        above = value - f(bias) * noise - limit
        # Unknown ground can only raise a measure, so it makes no hazard less certain.
        std = np.where(above > 0, noise, doubt)
        load = np.maximum(load, own)
        # The second term keeps the excess of exact elevations finite.
        excess = np.maximum(excess, above / (f(spread) * std + f(1e-12) * limit))
        over = over | np.where(own > 1, np.uint16(m.bit), NO_BITS)
    return Verdicts(load, excess, over)


def _band(m: Measure, values: Floats32, most: float) -> Floats32:
    """A measure in the unit of its raster."""
    if m.left:
        return np.subtract(np.float32(most), values)
    return np.arctan(values, out=values) if m.in_degrees else values


def _chance(excess: Floats32) -> Floats32:
    """F of the greatest excess (row, col): Student's t of three degrees of freedom in closed form."""
    # The lift begins at an excess of -0.4 and is full 0.6 above.
    lift = np.float32(LIFT) * np.clip((excess + np.float32(0.4)) / np.float32(0.6), 0, 1)
    t = (excess + lift) / np.float32(math.sqrt(3.0))
    chance = 0.5 + (np.arctan(t) + t / (1 + t * t)) / np.float32(math.pi)
    return np.where(np.abs(excess) < MAX_EXCESS, chance, excess > 0).astype(np.float32)
