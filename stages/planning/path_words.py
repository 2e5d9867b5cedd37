"""A path that was found, or why there is none: its facts, and hazards in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import MEASURES
from rille.stages.hazard.risk import DOUBT_BIT, HAZARDOUS, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.path_ground import Maps
from rille.stages.planning.row_graph import Ints


@dataclass(frozen=True)
class Route:
    """A path and how it was found.

    ``cells`` (vertex, 2) of the lattice and ``xyz`` (vertex, 3) metres, z the mean height under a wheel, both empty
    where there is none; ``planner`` that gave it, ``ground`` one of :data:`GROUNDS`. ``span``: farthest and nearest row
    that are free somewhere. ``reason`` why there is no path, and ``blocking_row``, the first one that cannot be entered
    by rows, None where there is a path; ``ended_by``: why a path goes no farther, None where there is none.
    """

    cells: Ints
    xyz: Floats
    planner: str
    ground: str
    span: tuple[int, int]
    reason: str = ""
    blocking_row: int | None = None
    ended_by: str | None = None


GOAL = "the goal"
WORST = {
    "max_inclination": ("inclination", np.nanmax),
    "max_tilt": ("tilt", np.nanmax),
    "least_clearance": ("clearance", np.nanmin),
    "max_p_hazard": ("p_hazard", np.nanmax),
}
"""Facts of a path by the map that they are the worst of."""
ENDS = ("the edge of the map", "unknown ground", "ground too uncertain to be called safe", "a hazard")
"""What a path does not go beyond."""


def ending(route: Route, maps: Maps, lattice: Lattice, vehicle: Vehicle, p_certain: float) -> str:
    """The one of :data:`ENDS` that holds most of the cells beyond a path's end: as wide as the vehicle and its margin,
    and as far ahead of its middle. Ground above the probability ``p_certain`` is uncertain, as is a hazard that
    standard deviations alone make one."""
    far, wide = (
        math.ceil((half + vehicle.margin) / lattice.cell) for half in (vehicle.half_length, vehicle.half_width)
    )
    row, col = np.meshgrid(np.arange(1, far + 2), np.arange(-wide, wide + 1))
    at = route.cells[-1] + np.stack([-row, col], axis=-1)
    inside = ((at >= 0) & (at < lattice.shape)).all(axis=-1)
    here = tuple(at[inside].T)
    risk, chance = maps["risk"][here], maps["p_hazard"][here] if "p_hazard" in maps else np.zeros(len(here[0]))
    proven = (risk == HAZARDOUS) & (maps["reason"][here] & DOUBT_BIT == 0)
    uncertain = ((risk == HAZARDOUS) & ~proven) | ((risk < HAZARDOUS) & (chance > p_certain))
    counts = [np.count_nonzero(kind) for kind in (~inside, risk == UNKNOWN, uncertain, proven)]
    return ENDS[int(np.argmax(counts))]


def describe(route: Route, maps: Maps, lattice: Lattice, vehicle: Vehicle) -> dict[str, Any]:
    """Facts of a route: length, climb, and the worst that it meets."""
    xyz, row = route.xyz, route.blocking_row
    meta: dict[str, Any] = {
        "found": len(xyz) > 0,
        "planner": route.planner,
        "ground": route.ground,
        "reason": route.reason if len(xyz) else _why(route.reason, maps, vehicle),
        "blocking_row": row,
        "blocking_y": None if row is None else (lattice.j0 - row) * lattice.cell,
        "ended_by": route.ended_by,
    }
    if len(xyz) == 0:
        others = ("length_m", "climb_m", "start", "target", "left_out_m")
        return meta | dict.fromkeys((*WORST, *others))
    at = tuple(route.cells.T)
    steps, ends = np.diff(xyz, axis=0), route.cells[[0, -1], 0]
    worst = {name: float(of(maps[band][at])) if band in maps else None for name, (band, of) in WORST.items()}
    return (
        meta
        | worst
        | {
            "length_m": float(np.sqrt((steps**2).sum(axis=1)).sum()),
            "climb_m": float(np.maximum(steps[:, 2], 0.0).sum()),
            # Rows with known ground before the start and beyond the target.
            "left_out_m": [float(rows) * lattice.cell for rows in (route.span[1] - ends[0], ends[1] - route.span[0])],
            "start": [float(v) for v in xyz[0]],
            "target": [float(v) for v in xyz[-1]],
        }
    )


def _why(reason: str, maps: Maps, vehicle: Vehicle) -> str:
    """Why there is no path; where hazards leave nothing to drive on, the limit that does the most."""
    risk = maps["risk"]
    judged = int((risk != UNKNOWN).sum())
    # Where something is free, the search's own reason says more than a count of hazards.
    if judged == 0 or (risk[risk != UNKNOWN] < HAZARDOUS).any():
        return reason
    counts = [int(((maps["reason"] & m.bit) > 0).sum()) for m in MEASURES]
    most, count = max(zip(MEASURES, counts, strict=True), key=lambda pair: pair[1])
    return (
        f"all {judged} known cells are hazardous, {100 * count / judged:.0f} % of them by {most.words}: "
        f"is vehicle.{most.limit} {getattr(vehicle, most.limit):g} at the scale of the sequence?"
    )


def hazard_words(maps: Maps, at: tuple[int, int], vehicle: Vehicle) -> str:
    """The measures over their limits at a cell, with both figures."""
    parts = []
    for m in MEASURES:
        if not int(maps["reason"][at]) & m.bit:
            continue
        limit = getattr(vehicle, m.limit)
        if m.band not in maps:
            parts.append(f"{m.words} over vehicle.{m.limit}")
            continue
        value, unit = float(maps[m.band][at]), "deg" if m.in_degrees else "m"
        value = limit - value if m.left else math.degrees(value) if m.in_degrees else value
        # Below the limit by itself: the figure alone would seem to say that the ground is permitted.
        doubt = "" if value > limit else " plus risk.sigmas standard deviations"
        parts.append(f"{m.words} {value:.3g} {unit}{doubt}, vehicle.{m.limit} {limit:g}")
    return "; ".join(parts)
