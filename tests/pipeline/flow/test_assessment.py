"""What is judged by truth: the piece of the other program's trajectory that has poses, whichever it is."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.evaluation import accuracy, crosscheck_join


@pytest.mark.parametrize("split", [0, 3, 9])
def test_the_other_program_s_longest_piece_is_judged(split: int) -> None:
    poses = np.tile(np.eye(3, 4), (12, 1, 1))
    poses[:, 2, 3] = np.arange(12.0)
    frames = list(range(12))
    windows = [
        Bundle({"poses": poses[a:b], "line_distance": np.zeros(b - a)}, {"frames": frames[a:b], "reason": ""})
        for a, b in ((0, split), (split, 12))
    ]
    joined = crosscheck_join.crosscheck_join_stage.run(NoParams(), {"frames": frames}, {"windows": windows})
    known = {"truth": poses.reshape(12, 12).tolist(), "frames": frames}
    metrics = accuracy.accuracy_stage.run(NoParams(), known, {"trajectory": joined}).meta["metrics"]
    assert metrics["frames_judged"]["value"] == max(split, 12 - split)
    assert metrics["drift"]["value"] == pytest.approx(0.0, abs=1e-9)
