"""A drive against the truth: stands of the wheels, error of the position, length of the path.

Each placement of the simulation (a few millimetres apart), however the drive ended, is judged against the vehicle's
limits: a belly that strikes, a tilt beyond ``max_slope_deg``, a wheel on an edge above ``max_step``. Positions or paths
that a failed drive does not have are left out. Positions are compared after making the first pose equal, as in
:mod:`rille.stages.evaluation.accuracy`. The shortest path is the planner's on the exact elevations, with its margin for
uncertainty; if that leaves none, it is the shortest one within the limits alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.evaluation.accuracy import pose_rows, trajectory_accuracy
from rille.stages.facts.evaluation import DriveCheckFacts, Metric, metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry.geometry import way_length


def judged(drive: Bundle, row: int) -> dict[str, Floats]:
    """Select the placements of a drive up to the image of this row (-1: the last one)."""
    # Placements after the last image were driven, but no estimate knows of them.
    end = int(np.asarray(drive["frame_at"])[row]) + 1
    return {name: np.asarray(drive[name])[:end] for name in ("trail", "tilt", "clearance", "step")}


def placements(parts: Sequence[Mapping[str, Floats]], vehicle: Mapping[str, Any]) -> dict[str, Metric]:
    """Violations by the true placements of all legs; each part has ``trail``, ``tilt``, ``clearance`` and ``step``."""
    tilt, clearance, step = (np.concatenate([p[name] for p in parts]) for name in ("tilt", "clearance", "step"))
    struck, edges = int((clearance < 0).sum()), int((step > vehicle["max_step"]).sum())
    tilted = int((tilt > math.radians(vehicle["max_slope_deg"])).sum())
    length = sum(way_length(p["trail"][:, :, 3]) for p in parts)
    truly = "by the true placement of the wheels on the exact ground"
    return {
        "placements": metric(len(tilt), "placements", "of the vehicle along its true way that were judged"),
        "clearance_violations": metric(struck, "placements", f"belly strikes the ground, {truly}"),
        "tilt_violations": metric(tilted, "placements", f"tilt beyond max_slope_deg, {truly}"),
        "step_violations": metric(edges, "placements", f"a wheel on an edge above max_step, {truly}"),
        "least_clearance": metric(float(clearance.min()), "m", f"under the belly, {truly}"),
        "greatest_tilt": metric(math.degrees(tilt.max()), "deg", truly),
        "greatest_step": metric(float(step.max()), "m", f"under a wheel, {truly}"),
        "path_length": metric(length, "m", "true path of the vehicle, seen from above"),
    }


def localisation(estimate: Floats, truth: Floats, length: float) -> tuple[Floats, dict[str, Metric]]:
    """Error (frame,) m of the poses (frame, 3, 4), NaN for frames without one; and metrics of the last one."""
    positions, _ = trajectory_accuracy(estimate, truth)
    error = np.linalg.norm(positions["position"] - positions["position_truth"], axis=1)
    # A drive that ends because tracking is lost has no pose at its last image.
    known = error[np.isfinite(error)]
    last = float(known[-1]) if len(known) else math.nan
    how = "of the last position that is known, after making the first poses equal"
    return error, {
        "localisation_error": metric(last, "m", how),
        "localisation_share": metric(last / length if length > 0 else None, "1", f"{how}, over the length driven"),
        "greatest_error": metric(float(np.fmax.reduce(error)), "m", "of any position, after making the first equal"),
    }


@stage(
    "drive_check",
    outputs=[
        Array("error", ("frame",), "float64", "m", "distance of the estimated from the true position", "nan"),
        Array("way", ("position", "xyz"), "float64", "m", "true position of the vehicle on the ground", frame="truth"),
    ],
)
def drive_check_stage(
    params: NoParams,
    drives: Sequence[Bundle],
    trajectory: Bundle[TrajectoryFacts] | None = None,
    best: Bundle | None = None,
    *,
    rows: Sequence[int],
    vehicle: Mapping[str, Any],
    truth: Sequence[Sequence[float]] = (),
) -> Bundle[DriveCheckFacts]:
    """A drive against the truth: placements, localisation, length."""
    parts = [judged(drive, row) for drive, row in zip(drives, rows, strict=True)]
    figures, error = placements(parts, vehicle), np.zeros(0)
    facts: DriveCheckFacts = {"metrics": figures, "path_exists": None, "with_margin": None}
    if trajectory is not None:
        estimate = np.asarray(trajectory["poses"])
        error, located = localisation(estimate, pose_rows(truth), figures["path_length"]["value"])
        figures |= located
    if best is not None:
        shortest, margin = best.meta["shortest_m"], best.meta["shortest_margin_m"]
        room = "with the vehicle's margin" if margin else "within its limits, but without its margin"
        how = f"from start to goal over the risk map of the exact elevations, {room}"
        figures["shortest_length"] = metric(shortest, "m", how)
        facts["path_exists"] = shortest is not None
        facts["with_margin"] = bool(shortest is not None and margin > 0)
    T = np.concatenate([p["trail"] for p in parts])
    return Bundle({"error": error, "way": T[:, :, 3].copy()}, facts)
