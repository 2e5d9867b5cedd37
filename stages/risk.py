"""Risk map: where a vehicle must not go, from minimum and maximum heights in a window (section 4.6).

The window's side is the wheel's diameter ``D``: a wheel bridges what is finer and meets what is coarser window by
window. With ``R(n)`` the highest minus the lowest elevation in an ``n x n`` window and ``E(n) = (n - 1) cell`` its
extent:

* inclination = atan(min(R(D) / E(D), \\|gradient of the plane fitted in the window\\|)). Both are exact on ground
  that slopes along an axis. The range errs upwards on diagonals (to sqrt(2)) and by noise, the plane at edges (to 1.5),
  so the smaller one is nearer to the truth. The range of a partly known window errs downwards: there the plane decides;
* step = R(D / 2): what rises within a wheel's radius stands before the wheel as an edge. It is the paper's "elevated
  area", and it grows with every bump, whatever the slope beside it;
* roughness = standard deviation from that plane.

Hazardous is what exceeds the vehicle's limit of any of them; every cause has its bit in ``reason``. Unknown is a class
of its own and never safe.

Noise. The largest of many noisy cells lies above the true surface, so ranges of flat ground grow with the window. Where
three cells are at most a wheel's radius, a 3 x 3 median first removes single wrong cells and leaves 0.41 of white
noise; coarser models keep every cell, since one cell may then be a post. The extrema are then taken of ``z - k sigma``
and ``z + k sigma``. Noise alone lifts the largest of a window by 1.2 sigma (a few hundred cells after the median) to
1.5 sigma (nine cells); k = 0.5 takes off less than half of it, so that what error remains is on the side of hazards.
Cells with sigma above a quarter of ``max_step`` are unknown: noise alone then adds at most half a step to flat ground.

Holes. A window is judged on what is known of it, so unknown does not grow; a step that is proven by a part is a step.
Small holes are closed with a flag (:mod:`stages.holes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from stages.declare import Array, Bundle, Inputs, Memory, Params, Stage
from stages.holes import close_holes
from stages.lattice import Lattice, mosaic, union
from stages.vehicle import DEFAULT_VEHICLE, Vehicle
from stages.windows import fit_planes, running_max, running_min, window_sum

Floats32 = NDArray[np.float32]

SAFE, HAZARDOUS, UNKNOWN = 0, 1, 2
"""Classes of ``risk``."""

INCLINATION_BIT, STEP_BIT, ROUGHNESS_BIT, UNKNOWN_BIT, FILLED_BIT = 1, 2, 4, 8, 16
"""Bits of ``reason``: limits exceeded, too little known to judge, elevation interpolated."""

REASONS = {"inclination": 1, "step": 2, "roughness": 4, "unknown": 8, "filled": 16}


class RiskParams(Params):
    """Parameters of ``risk``; the limits themselves are the vehicle's."""

    window: float = Field(
        default=1.0, gt=0, le=20, description="wheel diameters; side of the window, since a wheel bridges what is finer"
    )
    noise_sigmas: float = Field(
        default=0.5, ge=0, le=5, description="standard deviations taken off an extremum, under half of what noise adds"
    )
    max_std: float = Field(
        default=0.25,
        gt=0,
        description="share of max_step; a less certain elevation cannot tell a step, so it is unknown",
    )
    min_known: float = Field(
        default=0.5, gt=0, le=1, description="share of the window that must be known; 0.5 is a straight border"
    )
    max_hole: float = Field(
        default=0.5, ge=0, le=1, description="wheel diameters; gap closed, over which a wheel sinks by 0.07 diameters"
    )


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
    elevation, elevation_std : (row, col) float32, metres, NaN unknown.
    cell : side of a cell, metres.
    vehicle : limits.
    params : parameters; None for the defaults.

    Returns
    -------
    ``risk`` uint8 (0 safe, 1 hazardous, 2 unknown), ``reason`` uint8 bits, ``inclination`` float32 rad, ``step`` and
    ``roughness`` float32 m (NaN where the window is not judged), ``filled`` uint8, ``elevation`` float32 m (closed).
    """
    p = params or RiskParams()
    n, n_step = (
        window_cells(p.window * vehicle.wheel_diameter, cell),
        window_cells(0.5 * p.window * vehicle.wheel_diameter, cell),
    )
    certain = np.isfinite(elevation) & ~(elevation_std > p.max_std * vehicle.max_step)
    z = np.where(certain, elevation, np.float32(np.nan)).astype(np.float32)
    s = np.where(certain & np.isfinite(elevation_std), elevation_std, np.float32(0)).astype(np.float32)
    z, s, filled = close_holes(z, s, p.max_hole * vehicle.wheel_diameter / cell, n, p.min_known)
    known = ~np.isnan(z)
    surface = _median3(z) if 3 * cell <= 0.5 * vehicle.wheel_diameter else z
    measures = _measures(surface, np.float32(p.noise_sigmas) * s, n, n_step, cell)
    judged = known & (window_sum(known, n) >= p.min_known * n * n)

    reason = np.zeros(z.shape, dtype=np.uint8)
    limits = (math.radians(vehicle.max_slope_deg), vehicle.max_step, vehicle.max_roughness)
    bits = (INCLINATION_BIT, STEP_BIT, ROUGHNESS_BIT)
    for (name, measure), limit, bit in zip(measures.items(), limits, bits, strict=True):
        # A part of a window proves a step; a plane through a part proves nothing.
        sound = known if name == "step" else judged
        reason[sound & (measure > limit)] |= bit
    hazardous = reason != 0
    unknown = ~known | (~judged & ~hazardous)
    reason[unknown] |= UNKNOWN_BIT
    reason[filled == 1] |= FILLED_BIT
    risk = np.full(z.shape, SAFE, dtype=np.uint8)
    risk[hazardous] = HAZARDOUS
    risk[unknown] = UNKNOWN
    shown = {k: np.where(risk != UNKNOWN, v, np.nan).astype(np.float32) for k, v in measures.items()}
    return {"risk": risk, "reason": reason, **shown, "filled": filled, "elevation": z}


def window_cells(side: float, cell: float) -> int:
    """Odd number of cells, at least three, that a window of ``side`` metres covers."""
    return 2 * max(1, int(side / (2.0 * cell) + 1e-6)) + 1


def _measures(surface: Floats32, shift: Floats32, n: int, n_step: int, cell: float) -> dict[str, NDArray[np.float64]]:
    """Inclination (rad), step and roughness (m) of every window; where nothing is known they mean nothing."""
    low, high = surface + shift, surface - shift
    planes = fit_planes(surface, n, cell)
    rise = _range(high, low, n) / ((n - 1) * cell)
    complete = window_sum(~np.isnan(surface), n) > n * n - 0.5
    return {
        "inclination": np.arctan(np.where(complete, np.fmin(rise, planes.slope), planes.slope)),
        "step": _range(high, low, n_step),
        "roughness": planes.residual,
    }


def _range(high: Floats32, low: Floats32, n: int) -> NDArray[np.float64]:
    difference = running_max(high, n).astype(np.float64) - running_min(low, n)
    return np.where(np.isfinite(difference), np.maximum(difference, 0.0), 0.0)


@njit(cache=True, nogil=True)
def _median3(z):  # type: ignore[no-untyped-def]
    """Median of the known cells in 3 x 3; unknown stays unknown."""
    rows, cols = z.shape
    out = np.full((rows, cols), np.nan, dtype=np.float32)
    v = np.empty(9, dtype=np.float32)
    for r in range(rows):
        for c in range(cols):
            if np.isnan(z[r, c]):
                continue
            m = 0
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, cols)):
                    value = z[i, j]
                    if np.isnan(value):
                        continue
                    k = m
                    while k > 0 and v[k - 1] > value:
                        v[k] = v[k - 1]
                        k -= 1
                    v[k] = value
                    m += 1
            out[r, c] = v[m // 2] if m % 2 else np.float32(0.5) * (v[m // 2 - 1] + v[m // 2])
    return out


def _run(params: RiskParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    dems: list[Bundle] = inputs["dem"]
    lattices = [Lattice.from_dict(dem.meta["lattice"]) for dem in dems]
    whole = union(lattices)
    z = mosaic([(part, dem["elevation"]) for part, dem in zip(lattices, dems, strict=True)], np.nan, whole)
    stds = [(part, d["elevation_std"]) for part, d in zip(lattices, dems, strict=True) if "elevation_std" in d.arrays]
    s = mosaic(stds, np.nan, whole) if stds else np.zeros(whole.shape, dtype=np.float32)
    vehicle = Vehicle.model_validate(args["vehicle"]) if "vehicle" in args else DEFAULT_VEHICLE
    arrays = risk_map(z.astype(np.float32), s.astype(np.float32), whole.cell, vehicle, params)
    side = params.window * vehicle.wheel_diameter
    meta = {
        "lattice": whole.to_dict(),
        "frame": dems[0].meta.get("frame", "local"),
        "vehicle": vehicle.model_dump(mode="json"),
        "window_cells": window_cells(side, whole.cell),
        "step_window_cells": window_cells(0.5 * side, whole.cell),
        "shares": _shares(arrays),
    }
    return Bundle(arrays, meta)


def _shares(arrays: Mapping[str, NDArray[Any]]) -> dict[str, float | None]:
    """Shares of all cells, and of the judged ones, by class and cause."""
    risk, reason = arrays["risk"], arrays["reason"]
    judged = int((risk != UNKNOWN).sum())
    shares: dict[str, float | None] = {
        name: float((risk == value).mean()) for name, value in (("safe", 0), ("hazardous", 1), ("unknown", 2))
    }
    shares["filled"] = float(arrays["filled"].mean())
    for name in ("hazardous", "inclination", "step", "roughness"):
        hit = risk == HAZARDOUS if name == "hazardous" else (reason & REASONS[name]).astype(bool) & (risk == HAZARDOUS)
        shares[f"{name}_of_judged"] = float(hit.sum()) / judged if judged else None
    return shares


STAGE = Stage(
    name="risk",
    version=1,
    summary="hazardous, safe and unknown cells by inclination, step and roughness against a vehicle's limits",
    params=RiskParams,
    inputs=("dem*",),
    outputs=(
        Array("risk", ("row", "col"), "uint8", "1", "class: 0 safe, 1 hazardous, 2 unknown"),
        Array("reason", ("row", "col"), "uint8", "1", "bits: 1 inclination, 2 step, 4 roughness, 8 unknown, 16 filled"),
        Array("inclination", ("row", "col"), "float32", "rad", "local inclination in the wheel's window", "nan"),
        Array("step", ("row", "col"), "float32", "m", "height range within a wheel's radius", "nan"),
        Array("roughness", ("row", "col"), "float32", "m", "standard deviation from the window's plane", "nan"),
        Array("filled", ("row", "col"), "uint8", "1", "1 where the elevation was interpolated"),
        Array("elevation", ("row", "col"), "float32", "m", "elevation with small holes closed", "nan"),
    ),
    requires=("numpy", "numba"),
    run=_run,
    memory=Memory(factor=12.0, lower=("locus.cell_size",)),
)
