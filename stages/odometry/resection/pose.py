"""One frame's pose out of the trajectory: what stands on it is recomputed only where this pose has changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from rille.stages.core.declare import Bundle, Inputs, NoParams, Stage
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.pose_arrays import COVARIANCE, POSES


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    row, trajectory = int(args["row"]), inputs["trajectory"]
    if not np.isfinite(trajectory["poses"][row]).all():
        raise DegenerateError("RIL-711", f"row {row} of the trajectory has no pose", remedy="choose other frames")
    kept = [name for name in ("poses", "covariance") if name in trajectory.arrays]
    return Bundle({name: np.asarray(trajectory[name])[row : row + 1].copy() for name in kept}, {})


STAGE = Stage(
    name="pose",
    version=2,
    summary="pose of one left frame in the world frame",
    params=NoParams,
    inputs=("trajectory",),
    outputs=(
        replace(POSES, frame="world", nodata=""),
        replace(COVARIANCE, frame="world", nodata="", optional=True),
    ),
    run=_run,
)
