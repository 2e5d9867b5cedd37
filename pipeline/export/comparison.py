"""Our trajectory beside the crosscheck's, frame by frame, for the report and for exported files."""

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
    disagreement of the poses; ``step_distance``, ``step_angle``: of the motion since the frame before. ``error``,
    ``error_crosscheck`` m: distances from the truth, first poses equal. ``flagged``: the pose may be wrong.
    """

    frames: tuple[int, ...]
    poses: Floats
    registered: NDArray[np.bool_]
    distance: Floats
    angle: Floats
    step_distance: Floats
    step_angle: Floats
    flagged: NDArray[np.bool_]
    error: Floats
    error_crosscheck: Floats
    meta: Mapping[str, Any]

    def columns(self) -> dict[str, list[Any]]:
        """Columns of ``agreement.csv`` after the positions; distances from the truth if there is one."""
        why = {int(flag["frame"]): "; ".join(flag["why"]) for flag in self.meta.get("flagged") or ()}
        errors = {"error_m": self.error, "crosscheck_error_m": self.error_crosscheck}
        return {
            "disagreement_m": self.distance.tolist(),
            "disagreement_deg": np.degrees(self.angle).tolist(),
            "step_disagreement_m": self.step_distance.tolist(),
            "step_disagreement_deg": np.degrees(self.step_angle).tolist(),
            "flagged": self.flagged.astype(np.int64).tolist(),
            "flagged_for": [why.get(frame, "") for frame in self.frames],
            **{name: values.tolist() for name, values in errors.items() if np.isfinite(values).any()},
        }


def compare(view: RunView, agreement: Bundle) -> CrosscheckComparison:
    """The comparison by an artifact of stage ``agreement``."""
    poses = by_frame(view, agreement, "poses")
    registered = posed(poses)
    trajectory = view.bundle(view.products.trajectory)
    if trajectory is not None:  # other pieces, with the lost frames after them, have their own frames of reference
        piece = np.nan_to_num(by_frame(view, trajectory, "piece"), nan=-1).astype(np.int64)
        poses[carried(piece) != trajectory.meta["main"]] = np.nan
    return CrosscheckComparison(
        frames=view.frames,
        poses=poses,
        registered=registered,
        flagged=np.nan_to_num(by_frame(view, agreement, "flagged")) > 0,
        error=_error(view, view.bundle(view.products.accuracy)),
        error_crosscheck=_error(view, view.bundle(view.products.crosscheck_accuracy)),
        meta=agreement.meta,
        **{name: by_frame(view, agreement, name) for name in ("distance", "angle", "step_distance", "step_angle")},
    )


def _error(view: RunView, accuracy: Bundle | None) -> Floats:
    """Distance (frame,) from the truth, m, first poses equal."""
    if accuracy is None or "position_truth" not in accuracy.arrays:
        return np.full(len(view.frames), np.nan)
    ours, true = (by_frame(view, accuracy, name) for name in ("position", "position_truth"))
    return np.asarray(np.linalg.norm(ours - true, axis=1))
