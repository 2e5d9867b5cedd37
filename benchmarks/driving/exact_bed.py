"""A bed of the closed loop as it is: exact elevations, where the rover begins, and what its cameras could see."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.mockup.params import SceneParams
from rille.datasets.mockup.raycast import HeightField
from rille.datasets.mockup.rover import START, bed_ground
from rille.datasets.mockup.scene import build_scene, height_field
from rille.datasets.mockup.sequence import true_rig
from rille.datasets.mockup.truth_dem import seen_by, true_dem
from rille.pipeline.flow.closed_loop import arena
from rille.stages.geometry.geometry import RigidTransform, from_above, level_rotation
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.wheels import HeightGrid, stand
from rille.stages.terrain.merge import footprint

REACH = 3.0
"""m; ground about the start, all of every bed."""


@dataclass(frozen=True)
class ExactBed:
    """``elevation`` (row, col) float32 m on ``lattice`` of the world frame, which begins at the first left camera, and
    ``points`` (row * col, 3) m the same places on the bed; ``T_world_vehicle`` at the start."""

    sequence: Any
    vehicle: Vehicle
    ground: HeightGrid
    field: HeightField
    lattice: Lattice
    elevation: NDArray[np.float32]
    points: NDArray[np.float64]
    T_world_bed: RigidTransform
    T_world_vehicle: RigidTransform

    @staticmethod
    def of(sequence: Any, config: Any, goal: tuple[float, float]) -> ExactBed:
        """The part of a bed that a drive to a goal maps."""
        mockup, rover = sequence.parameters["mockup"], sequence.parameters["rover"]
        scene = build_scene(mockup.part(SceneParams), pad=(*START[:2], rover.pad))
        ground = bed_ground(scene, config.vehicle, START[:2], REACH)
        found = stand(ground, *START, config.vehicle)
        assert found is not None
        T_bed_left = found.T_ground_vehicle @ sequence.simulation.T_vehicle_left
        T_world_left = RigidTransform(level_rotation(T_bed_left.rotation[2]), np.zeros(3))
        T_world_bed = T_world_left @ T_bed_left.inverse()
        lattice = arena(goal, config.drive.around, config.locus.cell_size)
        field = height_field(scene)
        z, points = true_dem(field, lattice.to_dict(), T_world_bed.inverse())
        T_world_vehicle = T_world_bed @ found.T_ground_vehicle
        return ExactBed(
            sequence, config.vehicle, ground, field, lattice, z, points, T_world_bed, T_world_vehicle
        )  # fmt: skip

    def start(self) -> tuple[tuple[float, float], float]:
        """Where the vehicle begins, m, and its heading, rad."""
        return place_of(self.T_world_vehicle)

    def at(self, place: tuple[float, float], heading: float) -> RigidTransform:
        """T_world_vehicle of the vehicle that stands at a place, m, with a heading, rad, both of the world frame."""
        T_bed_world = self.T_world_bed.inverse()
        x, y, _ = T_bed_world.apply([*place, self.T_world_vehicle.translation[2]])
        ahead = T_bed_world.rotation @ [-math.sin(heading), math.cos(heading), 0.0]
        found = stand(self.ground, float(x), float(y), math.atan2(-ahead[0], ahead[1]), self.vehicle)
        assert found is not None, "beside the bed"
        return self.T_world_bed @ found.T_ground_vehicle

    def under(self, T_world_vehicle: RigidTransform, radius: float) -> NDArray[np.bool_]:
        """Cells (row, col) within ``radius`` metres of the vehicle."""
        xy, middle = self.lattice.xy(), T_world_vehicle.translation
        return np.asarray(np.hypot(xy[..., 0] - middle[0], xy[..., 1] - middle[1]) <= radius)

    def in_view(
        self, T_world_vehicle: RigidTransform, farthest: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Cells (row, col) that both cameras see where a pixel covers at most ``farthest`` m, and what it covers, m."""
        rig = true_rig(self.sequence.parameters["mockup"])
        T_world_left = T_world_vehicle @ self.sequence.simulation.T_vehicle_left
        lattice = self.lattice
        covers = footprint(self.elevation, lattice.xs(), lattice.ys(), T_world_left.translation, 1.0 / rig.left.fx)
        with np.errstate(invalid="ignore"):
            near = np.flatnonzero(np.isfinite(self.elevation) & (covers <= farthest))
        seen = np.zeros(self.elevation.size, bool)
        seen[near] = seen_by(self.field, rig, [self.T_world_bed.inverse() @ T_world_left], self.points[near])
        return seen.reshape(self.elevation.shape), covers


def place_of(T_world_vehicle: RigidTransform) -> tuple[tuple[float, float], float]:
    """x, y (m) and heading (rad) of a pose."""
    x, y, heading = from_above(T_world_vehicle)
    return (x, y), heading
