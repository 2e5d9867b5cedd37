"""True camera poses of a sequence as an artifact, so that whatever is judged by them follows from them.

A frame without truth (``None``) has a pose of NaN and is named in the facts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.facts.evaluation import TruthFacts


@stage(
    "truth",
    version=2,
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "pose [R | t] of the left camera", "nan", "truth"),
    ],
)
def truth_stage(
    params: NoParams, *, poses: Sequence[Sequence[float] | None], frames: Sequence[int] | None = None, source: str = ""
) -> Bundle[TruthFacts]:
    """True poses of the left camera, for assessment only."""
    gap = [float("nan")] * 12
    known = np.array([gap if pose is None else pose for pose in poses], dtype=np.float64).reshape(-1, 3, 4)
    gaps = [k if frames is None else frames[k] for k, pose in enumerate(poses) if pose is None]
    numbers = None if frames is None else list(frames)
    return Bundle({"poses": known}, {"frames": numbers, "source": source, "without_truth": gaps})
