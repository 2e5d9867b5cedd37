"""The shortest way that the judge of a drive would let pass: over the exact bed, by the vehicle's hard limits alone.

The planner's own measures (a window of heights, roughness, a tilt at the worst heading, a margin) close ground on which
the vehicle would truly stand well. Here a pose is free where the wheels, put on the exact ground, keep the belly clear
and tilt and step within the limits: by what a drive is judged, without a margin, and over the whole bed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driving.exact_bed import ExactBed
from rille.stages.geometry.geometry import from_above
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.local_planner.ground import SPACING_WHEELS, TOLERANCE_WHEELBASES
from rille.stages.planning.local_planner.route import length_of, pieces, straightened
from rille.stages.planning.local_planner.state_lattice import LatticeGraph, PoseGrid
from rille.stages.planning.wheels import HeightGrid, measured

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass
class Limits:
    """Ground (bed frame) as a vehicle may stand on it; takes the place of
    :class:`rille.stages.planning.local_planner.clearance.Footing`."""

    ground: HeightGrid
    vehicle: Vehicle

    def gaps(self, x: Floats, y: Floats, heading: Floats) -> Mask:
        """Which of these poses, arrays of one shape, keep to the limits."""
        v = self.vehicle
        found = measured(self.ground, x.ravel(), y.ravel(), heading.ravel(), v)
        free = (found.clearance >= 0) & (found.tilt <= math.radians(v.max_slope_deg)) & (found.step <= v.max_step)
        return np.asarray(free.reshape(x.shape))

    def clear(self, x: Floats, y: Floats, heading: Floats) -> bool:
        """Whether all of them do."""
        return bool(self.gaps(x, y, heading).all())


def shortest_within_limits(bed: ExactBed, goal: tuple[float, float]) -> float | None:
    """Length, m, of the shortest way from the start to a goal (world frame) for the planner's grid; None: none."""
    vehicle, ground, T_bed_world = bed.vehicle, bed.ground, bed.T_world_bed.inverse()
    T_bed_vehicle = T_bed_world @ bed.T_world_vehicle
    x, y, heading = from_above(T_bed_vehicle)
    gx, gy, _ = T_bed_world.apply([*goal, bed.T_world_vehicle.translation[2]])
    rows, cols = ground.height.shape
    sides = ground.x0, ground.x0 + ground.cell * (cols - 1), ground.y0 - ground.cell * (rows - 1), ground.y0
    spacing = max(SPACING_WHEELS * vehicle.wheel_diameter, ground.cell)
    grid = PoseGrid.over(Lattice.snap(sides, ground.cell), (x, y), heading, spacing)
    limits = Limits(ground, vehicle)

    def price(free: Any, *pose: Floats) -> tuple[Mask, Floats]:
        return free, np.where(free, 1.0, np.inf)

    graph = LatticeGraph.of(limits, grid, price)  # type: ignore[arg-type]
    px, py = grid.places()
    goals = np.hypot(px - gx, py - gy) <= 0.5 * TOLERANCE_WHEELBASES * vehicle.wheel_base
    cost, move = graph.search(goals, 0.0, 1.0)
    if not np.isfinite(cost[0, grid.origin[0], grid.origin[1]]):
        return None
    way = pieces(graph, graph.follow(move))
    return length_of(straightened(way, heading, limits.clear, ground.cell))
