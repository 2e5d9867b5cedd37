"""A planned path against the risk map of the exact elevations: hazardous cells that it crosses, and its length."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bytes, Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.evaluation import Metric, MetricsFacts, metric
from rille.stages.geometry.geometry import way_length
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.rigid import lengths_along
from rille.stages.hazard.risk import HAZARDOUS, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.grid8 import search
from rille.stages.planning.path_ground import COST_UNIT_M, Maps, PathMaps, PathParams, cell_of
from rille.stages.planning.row_graph import UNREACHED


def crossed_cells(path: Floats, lattice: Lattice) -> NDArray[np.int64]:
    """Cells (n, 2) row, column, each once, that a polyline (vertex, x y ...), m, crosses; it may leave the lattice.

    The line is sampled at a quarter of a cell, so that it misses no more than a cell's corner.
    """
    along = lengths_along(path[:, :2])
    at = np.linspace(0.0, along[-1], 1 + math.ceil(4.0 * along[-1] / lattice.cell))
    points = np.stack([np.interp(at, along, axis) for axis in path[:, :2].T], axis=1)
    return np.unique(np.rint(lattice.index(points)).astype(np.int64), axis=0)


def path_check(path: Floats, risk: Bytes, lattice: Lattice) -> dict[str, Metric]:
    """Metrics by name.

    Parameters
    ----------
    path : (vertex, xyz) float64, metres, in the frame of the lattice; empty where no path was found.
    risk : (row, col) classes from the exact elevations, on ``lattice``.
    """
    truth = "in the risk map of the exact elevations, same vehicle"
    share = metric(float((risk == HAZARDOUS).mean()), "1", f"hazardous share of all cells {truth}")
    if len(path) == 0:
        return {"hazardous_share": share}
    cells = crossed_cells(path, lattice)
    # Cells outside the exact map count as unknown, like its holes.
    kinds = lattice.values(risk, cells, UNKNOWN)
    return {
        "hazard_cells": metric(int((kinds == HAZARDOUS).sum()), "cells", f"crossed cells that are hazardous {truth}"),
        "unknown_cells": metric(int((kinds == UNKNOWN).sum()), "cells", f"crossed cells that are unknown {truth}"),
        "crossed_cells": metric(len(cells), "cells", "cells that the path crosses"),
        "path_length": metric(float(lengths_along(path)[-1]), "m", "length of the path, climbs included"),
        "hazardous_share": share,
    }


def shortest(path: Floats, maps: Maps, lattice: Lattice, vehicle: Vehicle) -> dict[str, Metric]:
    """Length of the shortest path between the same ends over the exact map, and how much longer the path is, in plan.

    The shortest path consists of steps to the eight neighbours, as the path itself does; its cost is its length. It
    keeps the vehicle's margin from hazards, unless that leaves no path.

    Parameters
    ----------
    path : (vertex, xyz) float64, metres, in the frame of the lattice; empty where no path was found.
    maps : arrays (row, col) of stage ``risk`` from the exact elevations.
    """
    room, best = "keeping the margin", _shortest(path, maps, lattice, vehicle) if len(path) else None
    if len(path) and best is None:
        room = "within the limits, but without the margin"
        best = _shortest(path, maps, lattice, vehicle.model_copy(update={"margin": 0.0}))
    how = f"shortest way between the path's ends over the risk map of the exact elevations, {room}, seen from above"
    if best is None:
        why = "none leads from one end of the path to the other" if len(path) else "no path was found"
        return {"length_ratio": metric(why, "1", how)}
    length = way_length(path[:, :2])
    ratio = length / best if best > 0 else None
    return {
        "shortest_length": metric(best, "m", how),
        "length_ratio": metric(ratio, "1", f"length of the path over that of the {how}"),
    }


def _shortest(path: Floats, maps: Maps, lattice: Lattice, vehicle: Vehicle) -> float | None:
    ground = PathMaps(maps, lattice, vehicle, PathParams(p_certain_hazard=1.0))
    first, last = (cell_of(lattice, point[:2]) for point in (path[0], path[-1]))
    ways, level = ground.ways("middle"), np.zeros(lattice.shape, np.int64)
    if not all(0 <= r < ways.shape[0] and 0 <= c < ways.shape[1] and ways[r, c] for r, c in (first, last)):
        return None
    # No heights and no tolls: the cost is the length alone.
    cost, _ = search(ground.terrain("middle", 1.0, 0.0)._replace(height=level, toll=level), first, last)
    return float(cost[last]) * COST_UNIT_M if cost[last] < UNREACHED else None


@stage("path_check")
def path_check_stage(params: NoParams, path: Bundle, risk: Bundle) -> Bundle[MetricsFacts]:
    """Planned path against the risk map of the exact elevations."""
    lattice = Lattice.from_dict(risk.meta["lattice"])
    vertices, maps = np.asarray(path["path"]), {name: np.asarray(risk[name]) for name in risk.arrays}
    figures = path_check(vertices, maps["risk"], lattice)
    figures |= shortest(vertices, maps, lattice, Vehicle.model_validate(risk.meta["vehicle"]))
    return Bundle({}, {"metrics": figures})
