"""One frame's pose out of the trajectory: what stands on it is recomputed only where this pose has changed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stages.declare import Array, Bundle, Inputs, NoParams, Stage


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    row = int(args["row"])
    return Bundle({"poses": np.asarray(inputs["trajectory"]["poses"])[row : row + 1].copy()}, {})


STAGE = Stage(
    name="pose",
    version=1,
    summary="pose of one left frame in the world frame",
    params=NoParams,
    inputs=("trajectory",),
    outputs=(
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", frame="world"),
    ),
    requires=("numpy",),
    run=_run,
)
