"""Our trajectory beside the crosscheck's, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export.view import RunView, by_frame
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle
from rille.stages.evaluation.agreement import carried
from rille.stages.geometry.rigid import posed


@dataclass(frozen=True)
class CrosscheckComparison:
    """Our trajectory and the crosscheck's, one row for each chosen frame, NaN where either has no pose.

    ``poses`` (frame, 3, 4): the crosscheck's left cameras in our world, NaN where ours is in another piece.
    ``registered`` (frame,): whether the crosscheck has a pose, in any piece. ``distance`` m, ``angle`` rad:
    disagreement of the poses; ``step_distance``, ``step_angle``: of the motion since the frame before.
    ``error_crosscheck`` m: its distance from the truth, first poses equal. ``flagged``: the pose may be wrong.
    """

    poses: Floats
    registered: NDArray[np.bool_]
    distance: Floats
    angle: Floats
    step_distance: Floats
    step_angle: Floats
    flagged: NDArray[np.bool_]
    error_crosscheck: Floats
    meta: Mapping[str, Any]


def compare(view: RunView, agreement: Bundle) -> CrosscheckComparison:
    """The comparison by an artifact of stage ``agreement``."""
    return CrosscheckComparison(
        poses=crosscheck_poses(view, agreement),
        registered=posed(by_frame(view, agreement, "poses")),
        flagged=np.nan_to_num(by_frame(view, agreement, "flagged")) > 0,
        error_crosscheck=_error(view, view.bundle(view.products.crosscheck_accuracy)),
        meta=agreement.meta,
        **{name: by_frame(view, agreement, name) for name in ("distance", "angle", "step_distance", "step_angle")},
    )


def crosscheck_poses(view: RunView, agreement: Bundle) -> Floats:
    """Poses (frame, 3, 4) of the crosscheck's left cameras in our world, NaN where ours is in another piece."""
    poses, trajectory = by_frame(view, agreement, "poses"), view.bundle(view.products.trajectory)
    if trajectory is not None:  # other pieces, with the lost frames after them, have their own frames of reference
        piece = np.nan_to_num(by_frame(view, trajectory, "piece"), nan=-1).astype(np.int64)
        poses[carried(piece) != trajectory.meta["main"]] = np.nan
    return poses


def _error(view: RunView, accuracy: Bundle | None) -> Floats:
    """Distance (frame,) from the truth, m, first poses equal."""
    if accuracy is None:
        return np.full(len(view.frames), np.nan)
    ours, true = (by_frame(view, accuracy, name) for name in ("position", "position_truth"))
    return np.asarray(np.linalg.norm(ours - true, axis=1))
