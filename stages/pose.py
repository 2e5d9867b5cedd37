"""One frame's pose out of the trajectory: what stands on it is recomputed only where this pose has changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stages.declare import Array, Bundle, Inputs, NoParams, Stage


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    row, trajectory = int(args["row"]), inputs["trajectory"]
    kept = [name for name in ("poses", "covariance") if name in trajectory.arrays]
    return Bundle({name: np.asarray(trajectory[name])[row : row + 1].copy() for name in kept}, {})


STAGE = Stage(
    name="pose",
    version=2,
    summary="pose of one left frame in the world frame",
    params=NoParams,
    inputs=("trajectory",),
    outputs=(
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", frame="world"),
        Array(
            "covariance",
            ("frame", "parameter", "parameter_b"),
            "float64",
            "m^2, m rad, rad^2",
            "covariance of position and rotation vector",
            frame="world",
            optional=True,
        ),
    ),
    requires=("numpy",),
    run=_run,
)
