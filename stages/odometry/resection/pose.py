"""One frame's pose out of the trajectory: what stands on it is recomputed only where this pose has changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rille.stages.core.declare import Bundle, Facts, NoParams, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry.pose_arrays import COVARIANCE, POSES


@stage(
    "pose",
    version=2,
    outputs=[
        replace(POSES, frame="world", nodata=""),
        replace(COVARIANCE, frame="world", nodata="", optional=True),
    ],
)
def pose_stage(params: NoParams, trajectory: Bundle[TrajectoryFacts], *, row: int) -> Bundle[Facts]:
    """Pose of one left frame in the world frame."""
    if not np.isfinite(trajectory["poses"][row]).all():
        raise DegenerateError("RIL-711", f"row {row} of the trajectory has no pose", remedy="choose other frames")
    kept = [name for name in ("poses", "covariance") if name in trajectory.arrays]
    return Bundle({name: np.asarray(trajectory[name])[row : row + 1].copy() for name in kept}, {})
