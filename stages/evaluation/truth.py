"""True camera poses of a sequence as an artifact, so that whatever is judged by them follows from them.

A frame without truth (``None``) has a pose of NaN.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.facts.evaluation import TruthFacts


@stage(
    "truth",
    version=3,
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", "nan", "truth"),
    ],
)
def truth_stage(
    params: NoParams, *, poses: Sequence[Sequence[float] | None], frames: Sequence[int]
) -> Bundle[TruthFacts]:
    """True poses of the left camera in these frames, for assessment only."""
    known = np.array([pose or [np.nan] * 12 for pose in poses], dtype=np.float64).reshape(-1, 3, 4)
    return Bundle({"poses": known}, {"frames": list(frames)})
