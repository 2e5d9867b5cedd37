"""One frame's pose out of the trajectory, so that results which depend on it change only if this pose does.

Its covariance is without errors of the calibration where a plane gives the vertical. A wrong focal length lifts the
camera on its way and tilts the ground that it sees alike; the world's vertical follows the ground: no height is off.

The adjustment to a place seen again moves all poses, most of them by less than a map shows. If no part of an elevation
model would move by more than a quarter of a cell, its pose and covariance stay those of the chain: so the model, and
world tiles of such models alone, are those of the run without that place.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from rille.stages.core.declare import Bundle, Facts, NoParams, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.facts.terrain import DemFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.pose_arrays import COVARIANCE, GROUND_PLANE, POSES, REFERENCE_PLANE


def greatest_move(before: RigidTransform, after: RigidTransform, local: DemFacts) -> float:
    """Cells by which the farthest corner of an elevation model moves in the world with its camera's pose."""
    lattice, T_local_left = Lattice.from_dict(local["lattice"]), RigidTransform.from_matrix(local["T_frame_left"])
    x0, x1, y0, y1 = lattice.bounds
    corners = T_local_left.inverse().apply(list(product((x0, x1), (y0, y1), local["z_range"])))
    return float(np.linalg.norm(after.apply(corners) - before.apply(corners), axis=1).max() / lattice.cell)


@stage(
    "pose",
    outputs=[
        replace(POSES, frame="world", nodata=""),
        replace(COVARIANCE, frame="world", nodata=""),
    ],
)
def pose_stage(
    params: NoParams,
    trajectory: Bundle[TrajectoryFacts],
    chained: Bundle[TrajectoryFacts] | None = None,
    local: Bundle[DemFacts] | None = None,
    *,
    row: int,
) -> Bundle[Facts]:
    """Pose of one left frame in the world frame."""
    if not np.isfinite(trajectory["poses"][row]).all():
        raise DegenerateError("RIL-711", f"row {row} of the trajectory has no pose", remedy="choose other frames")
    used = trajectory
    if chained is not None and local is not None:
        before, after = (RigidTransform.from_matrix(one["poses"][row]) for one in (chained, trajectory))
        # A model may lie a quarter of a cell off its adjusted place.
        used = chained if greatest_move(before, after, local.meta) <= 0.25 else trajectory
    own = used.meta["verticals"][int(used["piece"][row])] in (GROUND_PLANE, REFERENCE_PLANE)
    arrays = {"poses": used["poses"], "covariance": used["own_covariance" if own else "covariance"]}
    return Bundle({name: array[row : row + 1].copy() for name, array in arrays.items()}, {})
