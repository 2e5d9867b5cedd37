"""Risk map: where a vehicle must not go, by measures against its limits (section 4.6).

Classes, from the least to the greatest risk: *safe*; *caution*, where a measure comes near its limit, or exceeds it
with a probability of more than ``max_p``, as beside unknown ground; *hazard*, where a measure, with ``sigmas`` standard
deviations added, exceeds its limit; and *unknown*, where too little of the window is known, which is never entered. The
measures, their noise and the probability are those of :mod:`rille.stages.hazard.measures`; each that exceeds its limit
has its bit in ``reason``.

Where five cells are at most a wheel's radius, a 3 x 3 median first removes single wrong cells; coarser models keep
every cell, since one cell may then be the top of a stone, or a post.

Guarantees, each tested: no cell gets safer with greater relief (see :mod:`rille.stages.hazard.measures`), with greater
standard deviations, or with a larger ``sigmas``.

Holes. A window is judged by its known part, so unknown ground does not grow; a hazard in that part is one. Small holes
are closed and flagged. Their heights lie within the range of the rim (:mod:`rille.stages.numeric.holes`), so they add
no relief, and their standard deviation is that of a height anywhere in that range.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats32
from rille.stages.core.declare import Bundle, Memory, raster, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.planning import RiskFacts
from rille.stages.geometry.lattice import Lattice, mosaic, union
from rille.stages.hazard.classification import (
    CAUTION,
    DOUBT_BIT,
    FILLED_BIT,
    HAZARDOUS,
    SAFE,
    UNKNOWN,
    UNKNOWN_BIT,
    UNSEEN_BIT,
    RiskParams,
    classify,
)
from rille.stages.hazard.measures import BITS, MEASURES, HazardInput, window_reach
from rille.stages.hazard.vehicle import DEFAULT_VEHICLE, Vehicle
from rille.stages.numeric.holes import close_holes

__all__ = ["CAUTION", "DOUBT_BIT", "HAZARDOUS", "REASONS", "SAFE", "UNKNOWN", "UNKNOWN_BIT", "RiskParams", "risk_map"]


CLASSES = {"safe": SAFE, "caution": CAUTION, "hazardous": HAZARDOUS, "unknown": UNKNOWN}
"""Values of ``risk``."""
NOTHING = {"risk": UNKNOWN, "reason": UNKNOWN_BIT, "filled": 0}
"""Values of the whole-numbered arrays where nothing is known."""

REASONS = BITS | {"unknown": UNKNOWN_BIT, "filled": FILLED_BIT, "uncertain": DOUBT_BIT, "unseen": UNSEEN_BIT}
"""Bits of ``reason``: a measure over its limit; too little known to judge; elevation interpolated; over a limit only
because of sigma; part of the ground in the window or below the vehicle is unknown."""


def risk_map(
    elevation: Floats32,
    elevation_std: Floats32,
    cell: float,
    vehicle: Vehicle = DEFAULT_VEHICLE,
    params: RiskParams | None = None,
) -> dict[str, NDArray[Any]]:
    """Classify every cell of an elevation model.

    Parameters
    ----------
    elevation, elevation_std : (row, col), metres, NaN unknown; infinite values mean unknown ground, and ground of
        unknown standard deviation counts as exact.
    cell : side of a cell, metres.
    vehicle : limits.
    params : parameters; None for the defaults.

    Returns
    -------
    ``risk`` uint8 (0 safe, 1 caution, 2 hazard, 3 unknown), ``reason`` uint16 bits; float32, NaN where unknown:
    ``inclination``, ``slope``, ``tilt`` rad, ``height_range``, ``step``, ``roughness``, ``clearance`` (left under the
    belly) m, ``p_hazard``, ``p_wheel``; ``filled`` uint8, ``elevation`` float32 m (closed).

    Raises
    ------
    DegenerateError
        The vehicle is wider than the map, or longer than from corner to corner.
    """
    p = params or RiskParams()
    check_size(vehicle, elevation.shape, cell)
    window = p.window * vehicle.wheel_diameter
    unknown = np.isinf(elevation) | np.isinf(elevation_std)
    elevation = np.where(unknown, np.nan, elevation).astype(np.float32)
    std = np.where(np.isfinite(elevation_std), elevation_std, 0.0).astype(np.float32)
    gap, side = p.max_hole * vehicle.wheel_diameter / cell, window_cells(window, cell)
    z, s, filled = close_holes(elevation, std, gap, side, p.min_known)
    classes = classify(HazardInput(elevation, z, s, cell, vehicle, window), filled, p)
    return classes | {"filled": filled, "elevation": z}


def check_size(vehicle: Vehicle, shape: tuple[int, ...], cell: float) -> None:
    """Refuse a vehicle that does not fit on the map."""
    if large := too_large(vehicle, shape, cell):
        remedy = "give track, wheel_base and wheel_diameter of [vehicle] in metres at the scale of the sequence"
        raise DegenerateError("RIL-431", large, remedy=remedy)


def too_large(vehicle: Vehicle, shape: tuple[int, ...], cell: float) -> str | None:
    """How much wider or longer than the map a vehicle is; None where it fits."""
    width, side = 2.0 * vehicle.half_width, min(shape) * cell
    if width > side:
        return f"the vehicle is {width:.3g} m wide over its wheels, the map only {side:.3g} m"
    length, diagonal = 2.0 * vehicle.half_length, math.hypot(*shape) * cell
    if length > diagonal:
        return (
            f"the vehicle is {length:.3g} m long over its wheels, the map only {diagonal:.3g} m from corner to corner"
        )
    return None


def window_cells(side: float, cell: float) -> int:
    """Odd number of cells across a window of ``side`` metres, see :func:`rille.stages.hazard.measures.window_reach`."""
    return 2 * window_reach(side, cell) + 1


@stage(
    "risk",
    outputs=[
        raster("risk", "1", "class: 0 safe, 1 caution, 2 hazard, 3 unknown", "uint8", ""),
        raster("reason", "1", "bits: " + ", ".join(f"{bit} {name}" for name, bit in REASONS.items()), "uint16", ""),
        *(raster(m.band, "rad" if m.in_degrees else "m", m.description) for m in MEASURES),
        raster("p_hazard", "1", "probability that a measure exceeds its limit"),
        raster("p_wheel", "1", "probability that a measure of the wheel's window exceeds its limit"),
        raster("filled", "1", "1 where the elevation was interpolated", "uint8", ""),
        raster("elevation", "m", "elevation with small holes closed"),
    ],
    memory=Memory(factor=16.0, lower=("locus.cell_size",)),
)
def risk_stage(
    params: RiskParams, dem: Sequence[Bundle], *, vehicle: Vehicle = DEFAULT_VEHICLE, use: str | None = None
) -> Bundle[RiskFacts]:
    """Safe, caution, hazard and unknown cells by seven measures against a vehicle's limits.

    ``use``: "local" for the map of one pair of a run, which is unknown throughout where the vehicle does not fit on it.
    """
    lattices = [Lattice.from_dict(bundle.meta["lattice"]) for bundle in dem]
    whole = union(lattices)
    z = mosaic([(part, bundle["elevation"]) for part, bundle in zip(lattices, dem, strict=True)], np.nan, whole)
    # Measures compare a cell with the ground around it, so the error that both share does not count.
    names = [next((n for n in ("relief_std", "elevation_std") if n in d.arrays), None) for d in dem]
    stds = [(part, d[name]) for part, d, name in zip(lattices, dem, names, strict=True) if name is not None]
    s = mosaic(stds, np.nan, whole) if stds else np.zeros(whole.shape, dtype=np.float32)
    z, s = z.astype(np.float32), s.astype(np.float32)
    if use == "local" and too_large(vehicle, whole.shape, whole.cell):
        arrays: dict[str, NDArray[Any]] = {
            a.name: np.full(z.shape, NOTHING.get(a.name, np.nan), a.dtype) for a in risk_stage.outputs
        }
        arrays["elevation"] = z
    else:
        arrays = risk_map(z, s, whole.cell, vehicle, params)
    meta: RiskFacts = {
        "lattice": whole.to_dict(),
        "frame": dem[0].meta.get("frame", "local"),
        "vehicle": vehicle.model_dump(mode="json"),
        "shares": {name: float((arrays["risk"] == value).mean()) for name, value in CLASSES.items()},
    }
    return Bundle(arrays, meta)
