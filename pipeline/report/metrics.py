"""Key figures of a run by name: value, unit, how it was obtained, against which truth, and how complete."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from rille.pipeline.export.view import RunView
from rille.pipeline.report import delivery, tables
from rille.pipeline.report.gather import Scene
from rille.stages.evaluation.trajectory_error import STEPS

Metric = dict[str, Any]
Rows = list[dict[str, Any]]

LABELS: Mapping[str, str] = {
    "drift": "Drift at the end",
    "final_error": "Position error at the end",
    "final_rotation_error": "Rotation error at the end",
    "position_rmse": "Position error, RMS, positions only",
    "position_median": "The same, median",
    "position_max": "The same, largest",
    "position_drift": "Drift, positions only, after the fit",
    "time_offset": "Offset in time of the truth",
    "time_offset_range": "The same, determined to",
    "frames_judged": "Frames with pose and truth",
    "path_length": "True length of the drive",
    "ate_rmse": "Absolute trajectory error, best fit",
    "ate_first_frame_rmse": "Absolute trajectory error, first pose equal",
    "ate_first_frame_max": "Largest position error",
    "rpe_translation_rmse": "Relative error, translation",
    "rpe_translation_median": "Relative error, translation, median",
    "rpe_translation_max": "Relative error, translation, largest",
    "rpe_rotation_rmse": "Relative error, rotation",
    "displacement_x_rmse": "Error of displacement in x",
    "displacement_y_rmse": "Error of displacement in y",
    "displacement_z_rmse": "Error of displacement in z",
    "kitti_translation": "KITTI translation error",
    "kitti_rotation": "KITTI rotation error",
    "sections_translation": "Relative error over 10-80 % of the path",
    "sections_rotation": "The same, rotation",
    "scale_error": "Scale",
    "direction_error": "Direction of the motion in the camera",
    "rotation_bias": "Rotation, the same in every frame",
    "scatter": "Motion of a frame, what remains",
    "nees": "Squared error over the claimed one (NEES)",
    "least_clearance": "Room under the belly, least",
    "frames": "Frames to be posed",
    "frames_missing": "Frames without a pose in the world",
    "frames_without_truth": "Frames without truth",
    "rmse": "Elevation error, RMS",
    "nmad": "Elevation error, robust deviation (NMAD)",
    "p95": "Elevation error, 95 %",
    "bias": "Elevation error, mean",
    "completeness": "Completeness",
    "unseen": "Cells that not both cameras see",
    "tilt": "Vertical off by",
    "hazard_cells": "Hazardous cells crossed",
    "unknown_cells": "Unknown cells crossed",
    "crossed_cells": "Cells crossed",
    "hazardous_share": "Truly hazardous cells",
    **{f"rpe_{n}_translation_rmse": f"Relative error over {n} frames, translation" for n in STEPS},
    **{f"rpe_{n}_rotation_rmse": f"Relative error over {n} frames, rotation" for n in STEPS},
}
"""Words for the names that the assessing stages use."""

AGREEMENT: Mapping[str, str] = {
    "rmse": "Disagreement of position, RMS",
    "share": "Disagreement of position over the length",
    "rmse_rotation": "Disagreement of rotation, RMS",
    "step_rmse": "Disagreement of the motion between frames, RMS",
    "step_rmse_rotation": "The same, rotation",
    "length": "Length of our trajectory where both have poses",
    "rmse_scaled": "Disagreement of position with a free scale, RMS",
}
"""Words for the figures of the comparison with the other program."""

PATH = (
    ("path_climb", "climb_m", "Climb of the path", "m", "sum of its rises"),
    ("path_inclination", "max_inclination", "Steepest ground on the path", "deg", "local inclination, largest"),
    ("path_tilt", "max_tilt", "Greatest tilt on the path", "deg", "of the vehicle, at the worst heading"),
    (
        "path_clearance",
        "least_clearance",
        "Room under the belly on the path, least",
        "m",
        "left under the belly of a vehicle whose ground clearance is stated, at the worst heading",
    ),
    (
        "path_p_hazard",
        "max_p_hazard",
        "Greatest hazard probability on the path",
        "1",
        "probability that a measure exceeds its limit, largest of the path's cells",
    ),
)
"""Figures of the path where it has them: name, fact of the artifact (angles in radians), label, unit and how."""

SHORTEST = "Shortest path on the exact map"

KEY = frozenset(
    {
        "drive_clearance_violations",
        "drive_tilt_violations",
        "drive_step_violations",
        "drive_localisation_error",
        "drive_localisation_share",
        "drive_path_length",
        "drive_shortest_length",
        "trajectory_drift",
        "trajectory_ate_rmse",
        "trajectory_position_rmse",
        "trajectory_position_median",
        "trajectory_position_max",
        "trajectory_position_drift",
        "trajectory_time_offset",
        "trajectory_rpe_translation_rmse",
        "trajectory_rpe_rotation_rmse",
        "trajectory_kitti_translation",
        "dem_pairs_rmse_median",
        "dem_pairs_rmse_max",
        "dem_pairs_completeness_min",
        "dem_merged_rmse",
        "dem_merged_nmad",
        "dem_merged_tilt",
        "path_check_hazard_cells",
        "path_check_length_ratio",
        "frames_posed",
        "frames_in_world",
        "reprojection_rms",
        "matched",
        "mapped_area",
        "elevation_sigma",
        "safe",
        "caution",
        "hazardous",
        "unknown",
        "local_paths",
        "path_length",
        "path_start",
        "agreement_rmse",
        "agreement_share",
        "agreement_flagged",
        "rig_residual",
        "overlap_median",
    }
)
"""Those that stand in the first table; the others are folded."""


def metrics(scene: Scene, frames: Rows, pairs: Rows) -> dict[str, Metric]:
    """Every figure: ``group, label, value, unit, how, truth, completeness, key``, those against truth first."""
    found = {
        **_drive(scene.view),
        **_trajectory(scene.view, frames),
        **_elevation(scene.view, pairs),
        **_path_check(scene.view),
    }
    for group, more in (
        ("Poses", _poses(frames)),
        ("Agreement with COLMAP", _agreement(scene)),
        ("Rig", _rig(scene)),
        ("Matching and terrain", _matching(pairs) | _terrain(scene) | _overlap(scene)),
        ("Hazards and path", _hazards(scene) | _local_paths(pairs) | _path(scene.view) | _path_sigma(scene)),
        ("Run", _run(scene.view)),
    ):
        found |= {name: {"group": group, "truth": None, **metric} for name, metric in more.items()}
    return {name: {**metric, "key": name in KEY} for name, metric in found.items()}


def _assessed(view: RunView, handle: Any, prefix: str, group: str, truth: str) -> Iterator[tuple[str, Metric]]:
    """Figures as an assessing stage gives them."""
    bundle = view.bundle(handle)
    for name, given in (bundle.meta["metrics"] if bundle is not None else {}).items():
        label = LABELS.get(name, name.replace("_", " ").capitalize())
        yield prefix + name, {**given, "group": group, "label": label, "truth": truth}


def _trajectory(view: RunView, frames: Rows) -> dict[str, Metric]:
    """Ours, then the other program's, both against the truth."""
    complete = f"{sum(r['in_world'] for r in frames)} of {len(frames)} frames"
    found: dict[str, Metric] = {}
    if len(frames) < 2:
        return found
    for prefix, handle, group in (
        ("trajectory_", view.products.accuracy or view.products.position_accuracy, "Trajectory against truth"),
        ("crosscheck_", view.products.crosscheck_accuracy, "COLMAP against truth"),
    ):
        given = dict(_assessed(view, handle, prefix, group, view.sequence.truth_source))
        order = [f"{prefix}{name}" for name in LABELS]
        ordered = sorted(given, key=lambda name: order.index(name) if name in order else len(order))
        share = (complete if prefix == "trajectory_" else _posed(given, prefix)) + _with_truth(view)
        found |= {name: {**given[name], "completeness": share} for name in ordered}
    return found


def _with_truth(view: RunView) -> str:
    """How many of the frames have a truth, where some have none."""
    known = delivery.has_truth(view)
    return "" if not any(known) or all(known) else f", truth for {sum(known)}"


def _posed(given: Mapping[str, Metric], prefix: str) -> str:
    frames, lost = (given.get(prefix + name, {}).get("value") for name in ("frames", "frames_missing"))
    return "frames that COLMAP posed" if frames is None or lost is None else f"{frames - lost} of {frames} frames"


def _agreement(scene: Scene) -> dict[str, Metric]:
    """Two trajectories that share the given calibration alone."""
    found = scene.comparison
    if found is None or not found.registered.any():
        return {}
    every = f"{int(np.isfinite(found.distance).sum())} of {len(found.distance)} frames"
    given = found.meta.get("metrics") or {}
    metrics = {
        f"agreement_{name}": {**given[name], "label": label, "completeness": every}
        for name, label in AGREEMENT.items()
        if name in given
    }
    scale = given.get("scale_ratio", {}).get("value")
    if scale is not None:
        how = "scale that would fit COLMAP's trajectory to ours best, less 1: a hint only"
        metrics["agreement_scale"] = _metric("Difference of scale", scale - 1.0, "1", how, every)
    flagged = int(found.flagged.sum())
    metrics["agreement_flagged"] = _metric(
        "Frames flagged", flagged, "frames", str(found.meta.get("rule") or "by their disagreement"), every
    )
    return metrics


def _rig(scene: Scene) -> dict[str, Metric]:
    """Epipolar residuals under the given and the used rig."""
    found = scene.calibration
    if found is None or not len(found.before):
        return {}
    every = f"{len(scene.view.products.orientations)} basic pairs, {len(found.before)} matches"
    rms = [found.residual(name) for name in ("before", "after")]
    how = "RMS distance of matched points from their epipolar lines, outliers left out, under the "
    metrics = {"rig_residual_given": _metric("Epipolar residual, given rig", rms[0], "px", how + "given rig", every)}
    metrics["rig_residual"] = _metric("Epipolar residual, used rig", rms[1], "px", how + "rig that was used", every)
    words = "repaired" if found.changed else "as given"
    metrics["rig_state"] = _metric("Rig used", words, "", str(found.facts[0].get("source", "")), None)
    return metrics


def _overlap(scene: Scene) -> dict[str, Metric]:
    """Disagreement of elevation models that see the same ground."""
    found = scene.differences
    if not found:
        return {}
    every = f"{len(found)} of {max(len(scene.view.products.world_dem) - 1, 0)} successive models"
    median = statistics.median(abs(d.median) for d in found)
    deviation = statistics.median(d.deviation for d in found)
    how = "elevation of a model minus that of the one before in their common cells: "
    return {
        "overlap_median": _metric(
            "Offset of overlapping models", median, "m", how + "size of its median, median over pairs", every
        ),
        "overlap_deviation": _metric(
            "Deviation of overlapping models", deviation, "m", how + "robust deviation, median over pairs", every
        ),
    }


def _elevation(view: RunView, pairs: Rows) -> dict[str, Metric]:
    """Local models (over pairs), then the merged one; the error never without the completeness."""
    group, truth = "Elevation against truth", "exact elevations of the scene"
    found: dict[str, Metric] = {}
    rmse = [r["rmse_m"] for r in pairs if r["rmse_m"] is not None]
    shares = [r["completeness"] for r in pairs if r["completeness"] is not None]
    if shares:
        where = "within the evaluation window" if view.sequence.evaluation_window else "over the whole model"
        least = (
            f"{len(rmse)} of {len(pairs)} pairs; {min(shares):.0%} to {max(shares):.0%} of the cells both cameras see"
        )
        for name, label, value, over in (
            ("median", "Elevation error of a pair, RMS, median", _of(statistics.median, rmse), "median over pairs"),
            ("max", "Elevation error of a pair, RMS, worst", _of(max, rmse), "worst pair"),
        ):
            how = f"RMS of local elevation minus exact elevation {where}, {over}"
            found[f"dem_pairs_rmse_{name}"] = _metric(label, value, "m", how, least)
        how = f"share of the cells that both cameras see which have an elevation, {where}, worst pair"
        found["dem_pairs_completeness_min"] = _metric("Completeness of a pair, worst", min(shares), "1", how, least)
    tilts = [r["tilt_deg"] for r in pairs if r["tilt_deg"] is not None]
    if tilts:
        value = float(np.sqrt(np.mean(np.square(tilts))))
        how = "between the vertical of a local model and the true one, RMS over pairs; not in the errors of elevation"
        every = f"{len(tilts)} of {len(pairs)} pairs"
        found["dem_pairs_tilt_rms"] = _metric("Vertical of a pair off by, RMS", value, "deg", how, every)
    found = {name: {"group": group, "truth": truth, **metric} for name, metric in found.items()}
    merged = dict(_assessed(view, view.products.dem_accuracy, "dem_merged_", group, truth))
    share = merged.get("dem_merged_completeness", {}).get("value")
    complete = None if share is None else f"{share:.0%} of the cells that both cameras of a pair see"
    for name, metric in merged.items():
        found[name] = {**metric, "label": f"Merged: {metric['label'][0].lower()}{metric['label'][1:]}"}
        found[name]["completeness"] = complete
    return found


def _drive(view: RunView) -> dict[str, Metric]:
    if view.products.drive is None:
        return {}
    truth = "the simulator's own placements"
    found = dict(_assessed(view, view.products.drive.check, "drive_", "Drive against truth", truth))
    return _labelled(found, "drive_", {"path_length": "Length driven", "shortest_length": SHORTEST})


def _labelled(found: Mapping[str, Metric], prefix: str, labels: Mapping[str, str]) -> dict[str, Metric]:
    """Metrics with other labels, and without a completeness: they are of the whole run."""
    return {
        name: {**metric, "label": labels.get(name.removeprefix(prefix), metric["label"]), "completeness": None}
        for name, metric in found.items()
    }


def _path_check(view: RunView) -> dict[str, Metric]:
    truth = "risk map of the exact elevations"
    found = dict(_assessed(view, view.products.path_check, "path_check_", "Path against truth", truth))
    labels = {
        "path_length": "Length of the path",
        "shortest_length": SHORTEST,
        "length_ratio": "Length of the path over the shortest",
    }
    return _labelled(found, "path_check_", labels)


def _of(figure: Callable[[list[float]], float], values: list[float]) -> float | None:
    """A figure of values, None of none."""
    return figure(values) if values else None


def _metric(label: str, value: Any, unit: str, how: str, completeness: str | None = None) -> Metric:
    plain = value if isinstance(value, str | int) or value is None else tables.finite(value)
    return {"label": label, "value": plain, "unit": unit, "how": how, "completeness": completeness}


def _poses(frames: Rows) -> dict[str, Metric]:
    posed = [r for r in frames if r["posed"]]
    resected = [r for r in posed if r["rms_px"]]
    every = f"{len(posed)} of {len(frames)} frames"
    found = {"frames_posed": _metric("Frames with a pose", len(posed), "frames", "counted", every)}
    pieces = len({r["piece"] for r in posed})
    if pieces > 1:
        how = f"in the largest of {pieces} pieces, whose frame is the world; the others have frames of their own"
        value = sum(r["in_world"] for r in posed)
        found["frames_in_world"] = _metric("Frames with a pose in the world", value, "frames", how, every)
    if resected:
        how = "root mean square over the landmarks that agree with the pose, then median over frames"
        value = statistics.median(r["rms_px"] for r in resected)
        found["reprojection_rms"] = _metric("Back-projection error", value, "px", how, every)
        how = "landmarks left after removal of inconsistent ones: median over frames"
        value = statistics.median(r["inliers"] for r in resected)
        found["inliers"] = _metric("Landmarks a frame", value, "", how, every)
    return found


def _matching(pairs: Rows) -> dict[str, Metric]:
    matched = [r["matched"] for r in pairs if r["matched"] is not None]
    every = f"{len(matched)} of {len(pairs)} basic pairs"
    found = {}
    if matched:
        how = (
            "pixels of the left image with a measured disparity, back-matched or on the plane of a textureless region "
            "(not interpolated): mean over pairs"
        )
        found["matched"] = _metric("Matched pixels", statistics.fmean(matched), "1", how, every)
    sources = sorted({r["vertical"] for r in pairs if r["vertical"]})
    if sources:
        how = "the most trusted one at hand"
        found["vertical"] = _metric("Source of the vertical", ", ".join(sources), "", how, every)
    return found


def _terrain(scene: Scene) -> dict[str, Metric]:
    world = scene.world
    if world is None or world.get("elevation") is None:
        return {}
    defined = np.isfinite(world.arrays["elevation"])
    area = float(defined.sum()) * world.lattice.cell**2
    of_map = f"{defined.mean():.0%} of the map's cells"
    found = {
        "cell_size": _metric("Cell size", world.lattice.cell, "m", "from the rig, or given (locus.cell_size)"),
        "mapped_area": _metric("Mapped area", area, "m²", "cells with an elevation", of_map),
    }
    sigma = world.get("elevation_std")
    if sigma is not None and np.isfinite(sigma).any():
        how = (
            "predicted from the disparity's error, the rig's geometry, how well both images agree and the poses' "
            "covariances: median over cells"
        )
        value = float(np.nanmedian(sigma))
        found["elevation_sigma"] = _metric("Predicted σ of elevation, median", value, "m", how, of_map)
    return found


def _hazards(scene: Scene) -> dict[str, Metric]:
    if scene.risk is None:
        return {}
    risk, found = scene.risk.arrays["risk"], {}
    for k, name in enumerate(("safe", "caution", "hazardous", "unknown")):
        how = f"share of all cells of the risk map; limits of {scene.view.config.vehicle.name}"
        found[name] = _metric(f"{name.capitalize()} cells", float((risk == k).mean()), "1", how)
    return found


def _local_paths(pairs: Rows) -> dict[str, Metric]:
    found, asked = delivery.local_paths(pairs)
    every = f"{asked} of {len(pairs)} basic pairs"
    how = "counted; a path leads at least the vehicle's length ahead, as far as the ground is known and safe"
    return {"local_paths": _metric("Local paths found", found, "", how, every)} if asked else {}


def _path(view: RunView) -> dict[str, Metric]:
    path = view.bundle(view.products.world_path)
    if path is None or not path.meta.get("found"):
        return {}
    meta = path.meta
    found = {"path_length": _metric("Path length", meta.get("length_m"), "m", "along its vertices in 3-D")}
    how = "in plan; nearer ground is not seen, or not to be driven on"
    away = delivery.start_of_path(view)
    found["path_start"] = _metric("Start of the path from the first camera", away, "m", how)
    for name, fact, label, unit, how in PATH:
        value = meta.get(fact)
        if value is not None:
            found[name] = _metric(label, float(np.degrees(value)) if unit == "deg" else value, unit, how)
    return found


def _path_sigma(scene: Scene) -> dict[str, Metric]:
    """Of the merged terrain, at the path's vertices."""
    if scene.world is None or scene.path is None:
        return {}
    sigma = scene.world.at("elevation_std", scene.path[:, :2])
    known = sigma[np.isfinite(sigma)]
    if not known.size:
        return {}
    how = "as that of the terrain; median over the path's vertices"
    every = f"{known.size} of {len(scene.path)} vertices"
    return {"path_sigma": _metric("Predicted σ of elevation along the path", float(np.median(known)), "m", how, every)}


def _run(view: RunView) -> dict[str, Metric]:
    rig = view.sequence.rig
    return {
        "baseline": _metric("Stereo baseline", rig.baseline, "m", "given calibration; sets the scale"),
    }
