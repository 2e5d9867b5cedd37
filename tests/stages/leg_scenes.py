"""A small map, a rover on it and its cameras."""

from __future__ import annotations

import math

import numpy as np

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.risk import SAFE
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.local_planner.clearance import Footing, Hazards
from rille.stages.planning.local_planner.ground import LocalPlannerParams
from rille.stages.planning.local_planner.look import FieldOfView

ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.10, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
LATTICE = Lattice.snap((-0.4, 0.4, -0.2, 1.0), 0.01)
START, GOAL = (0.0, 0.0), (0.0, 0.8)
AT = (*START, 0.0)
X, Y = LATTICE.xy()[..., 0], LATTICE.xy()[..., 1]
P = LocalPlannerParams()


def cameras() -> FieldOfView:
    """Two of 83 degrees, 0.18 m above the ground and 0.1 m apart, which see it from 0.14 m before the middle on."""
    camera = Camera(180.0, 180.0, 159.5, 119.5, 320, 240)
    rig = Rig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    c, s = math.cos(math.radians(32.0)), math.sin(math.radians(32.0))
    down = np.array([[1.0, 0.0, 0.0], [0.0, -s, c], [0.0, -c, -s]])
    return FieldOfView.of(rig, RigidTransform(down, np.array([-0.05, 0.05, 0.18])))


CAMERAS = cameras()


def ground(*changes: tuple[np.ndarray, int]) -> Footing:
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    for where, kind in changes:
        risk[where] = kind
    return Footing.of(Hazards(risk), LATTICE, ROVER)
