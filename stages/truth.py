"""True camera poses of a sequence as an artifact, so that whatever is judged by them follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stages.declare import Array, Bundle, Inputs, NoParams, Stage


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    poses = np.array(args["poses"], dtype=np.float64).reshape(-1, 3, 4)
    return Bundle({"poses": poses}, {"frames": args.get("frames"), "source": args.get("source", "")})


STAGE = Stage(
    name="truth",
    version=1,
    summary="true poses of the left camera, for assessment only",
    params=NoParams,
    inputs=(),
    outputs=(
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", frame="truth"),
    ),
    requires=("numpy",),
    run=_run,
)
