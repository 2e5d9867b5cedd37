"""True camera poses of a sequence as an artifact, so that whatever is judged by them follows from them.

A frame without truth (``None``) has a pose of NaN and is named in the facts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.stages.core.declare import Array, Bundle, Inputs, NoParams, Stage


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    gap = [float("nan")] * 12
    given = [gap if pose is None else pose for pose in args["poses"]]
    poses = np.array(given, dtype=np.float64).reshape(-1, 3, 4)
    frames = args.get("frames")
    gaps = [k if frames is None else frames[k] for k, pose in enumerate(args["poses"]) if pose is None]
    return Bundle({"poses": poses}, {"frames": frames, "source": args.get("source", ""), "without_truth": gaps})


STAGE = Stage(
    name="truth",
    version=2,
    summary="true poses of the left camera, for assessment only",
    params=NoParams,
    inputs=(),
    outputs=(
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", "nan", "truth"),
    ),
    run=_run,
)
