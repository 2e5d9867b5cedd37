"""Key figures of a run by name: value, unit, how it was obtained, against which truth, and how complete."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.pipeline.export.view import RunView
from rille.pipeline.report import delivery, tables
from rille.pipeline.report.delivery import Rows
from rille.pipeline.report.gather import Scene, facts_of
from rille.stages.evaluation.reading.hand_eye import WITHOUT

Metric = dict[str, Any]

LABELS = {
    "drift": "Drift at the end",
    "position_drift": "Drift, positions only, after the fit",
    "path_length": "True length of the drive",
    "position_rmse": "Position error, RMS, positions only",
    "ate_rmse": "Absolute trajectory error, best fit",
    "rpe_translation_rmse": "Relative error, translation",
    "rpe_rotation_rmse": "Relative error, rotation",
    "scale_error": "Scale",
    "nees": "Squared error over the claimed one (NEES)",
    "nees_position": "The same, positions",
    "nees_rotation": "The same, rotations",
    "hand_eye_turn": "Turn of the truth's body, as it fits best",
    "hand_eye_shift": "Shift of the truth's body, as it fits best",
    "frames_missing": "Frames without a pose in the world",
    "rmse": "Elevation error, RMS",
    "nmad": "Elevation error, robust deviation (NMAD)",
    "unseen": "Cells that not both cameras see",
    "tilt": "Vertical off by",
}
LABELS |= {without: f"{LABELS[name]}, turn and shift of the truth's body left out" for name, without in WITHOUT.items()}
"""Words for names of assessing stages, in the order of the page; all others say by themselves what they are."""

AGREEMENT: Mapping[str, str] = {
    "rmse": "Disagreement of position, RMS",
    "share": "Disagreement of position over the length",
    "rmse_rotation": "Disagreement of rotation, RMS",
    "length": "Length of our trajectory where both have poses",
    "rmse_scaled": "Disagreement of position with a free scale, RMS",
}
"""Words for the figures of the comparison with the other program."""

ON_PATH = (
    ("path_climb", "climb_m", "Climb of the path", "m", "sum of its rises"),
    ("path_inclination", "max_inclination", "Steepest ground on the path", "deg", "local inclination, largest"),
    ("path_tilt", "max_tilt", "Greatest tilt on the path", "deg", "of the vehicle, at the worst heading"),
    ("path_clearance", "least_clearance", "Room under the belly, least", "m", "on the path, at the worst heading"),
    ("path_p_hazard", "max_p_hazard", "Greatest hazard probability", "1", "that a limit is exceeded, of its cells"),
)
"""Figures of the path where it has them: name, fact of the artifact (angles in radians), label, unit and how."""

SIGMA = (
    "predicted from the disparity's error, the rig's geometry, how well both images agree and the poses' covariances: "
    "median over "
)


def metrics(scene: Scene, frames: Rows, pairs: Rows) -> dict[str, Metric]:
    """Every figure: ``group, label, value, unit, how, truth, completeness``, those against truth first."""
    view = scene.view
    by_name = _against_truth(view, frames, pairs)
    for group, more in (
        ("Poses", _poses(frames)),
        ("Agreement with COLMAP", _agreement(scene)),
        ("Rig", _rig(scene)),
        ("Matching and terrain", _matching(pairs) | _terrain(scene)),
        ("Hazards and path", _hazards(scene, pairs) | _path(scene)),
        ("Run", {"baseline": metric("Stereo baseline", view.sequence.rig.baseline, "m", "given; sets the scale")}),
    ):
        by_name |= {name: {**entry, "group": group, "truth": None} for name, entry in more.items()}
    return by_name


def metric(label: str, value: Any, unit: str, how: str, completeness: str | None = None) -> Metric:
    """A figure of a run; its group and the truth are added by what lists it."""
    plain = value if isinstance(value, str | int) or value is None else tables.finite(value)
    return {"label": label, "value": plain, "unit": unit, "how": how, "completeness": completeness}


def _against_truth(view: RunView, frames: Rows, pairs: Rows) -> dict[str, Metric]:
    """Figures of the assessing stages: drive, both trajectories, elevations, path; no error without its share."""
    p, known = view.products, delivery.has_truth(view)
    of_truth = "" if not any(known) or all(known) else f", truth for {sum(known)}"
    posed, source = sum(r["in_world"] for r in frames), view.sequence.truth_source
    by_name: dict[str, Metric] = {}
    if p.drive is not None:
        truth = "the simulator's own placements"
        labels = {"path_length": "Length driven"}
        by_name |= _assessed(view, p.drive.check, "drive_", "Drive against truth", truth, labels)
    for prefix, handle, group in (
        ("trajectory_", p.accuracy or p.position_accuracy, "Trajectory against truth"),
        ("crosscheck_", p.crosscheck_accuracy, "COLMAP against truth"),
    ):
        figures = _assessed(view, handle, prefix, group, source) if len(frames) > 1 else {}
        lost = figures.get(f"{prefix}frames_missing", {}).get("value", len(frames) - posed)
        share = f"{len(frames) - lost} of {len(frames)} frames{of_truth}"
        by_name |= {name: {**entry, "completeness": share} for name, entry in figures.items()}
    by_name |= _disparity(view)
    group, truth = "Elevation against truth", "exact elevations of the scene"
    by_name |= {name: {"group": group, "truth": truth, **m} for name, m in _local_elevation(view, pairs).items()}
    merged = _assessed(view, p.dem_accuracy, "dem_merged_", group, truth)
    complete = merged.get("dem_merged_completeness", {}).get("value")
    of_seen = None if complete is None else f"{complete:.0%} of the cells that both cameras of a pair see"
    for name, entry in merged.items():
        label = f"Merged: {entry['label'][0].lower()}{entry['label'][1:]}"
        by_name[name] = {**entry, "label": label, "completeness": of_seen}
    group, truth = "Path against truth", "risk map of the exact elevations"
    return by_name | _assessed(view, p.path_check, "path_check_", group, truth, {})


def _disparity(view: RunView) -> dict[str, Metric]:
    """Errors of the disparities, each the mean over the pairs; those of each pair are in its row."""
    pairs = [facts_of(view, handle).get("metrics") for handle in view.products.disparity_accuracy.values()]
    judged = [figures for figures in pairs if figures]
    by_name = {}
    for name in judged[0] if judged else ():
        values = [figures[name]["value"] for figures in judged if figures[name]["value"] is not None]
        label, how = _label(name), f"{judged[0][name]['how'].partition('; ')[0]}: mean over pairs"
        every = f"{len(values)} of {len(pairs)} pairs"
        entry = metric(label, statistics.fmean(values) if values else None, judged[0][name]["unit"], how, every)
        by_name[f"disparity_{name}"] = {"group": "Disparity against truth", "truth": "true disparities", **entry}
    return by_name


def _assessed(
    view: RunView, handle: Any, prefix: str, group: str, truth: str | None, labels: Mapping[str, str] = LABELS
) -> dict[str, Metric]:
    """Figures as an assessing stage gives them, those with a label first and in its order."""
    given, order = facts_of(view, handle).get("metrics") or {}, list(labels)
    about = {"group": group, "truth": truth, "completeness": None}
    return {
        prefix + name: {**given[name], **about, "label": labels.get(name) or _label(name)}
        for name in sorted(given, key=lambda name: order.index(name) if name in labels else len(order))
    }


def _label(name: str) -> str:
    """``ate_first_frame_rmse`` to ``ATE first frame RMS``."""
    first, *rest = name.replace("rmse", "RMS").split("_")
    return " ".join([first.upper() if first in ("ate", "rpe") else first[0].upper() + first[1:], *rest])


def _local_elevation(view: RunView, pairs: Rows) -> dict[str, Metric]:
    """Errors of the local models over pairs."""
    by_name: dict[str, Metric] = {}
    errors, shares = _values(pairs, "rmse_m"), _values(pairs, "completeness")
    if shares:
        every = f"{len(errors)} of {len(pairs)} pairs; "
        every += f"{min(shares):.0%} to {max(shares):.0%} of the cells both cameras see"
        where = "within the evaluation window" if view.sequence.evaluation_window else "over the whole model"
        how = f"RMS of local elevation minus exact elevation {where}"
        median, worst = (statistics.median(errors), max(errors)) if errors else (None, None)
        label = "Elevation error of a pair, RMS"
        by_name["dem_pairs_rmse_median"] = metric(f"{label}, median", median, "m", f"{how}, median over pairs", every)
        by_name["dem_pairs_rmse_max"] = metric(f"{label}, worst", worst, "m", f"{how}, worst pair", every)
        how = f"share of the cells that both cameras see which have an elevation, {where}"
        by_name["dem_pairs_completeness_min"] = metric("Completeness of a pair, worst", min(shares), "1", how, every)
    return by_name


def _values(rows: Rows, key: str) -> list[Any]:
    """Values of a column that are there."""
    return [row[key] for row in rows if row[key] is not None]


def _poses(frames: Rows) -> dict[str, Metric]:
    posed = [r for r in frames if r["posed"]]
    resected = [r for r in posed if r["rms_px"]]
    every = f"{len(posed)} of {len(frames)} frames"
    by_name = {"frames_posed": metric("Frames with a pose", len(posed), "frames", "counted", every)}
    pieces = len({r["piece"] for r in posed})
    if pieces > 1:
        how = f"in the largest of {pieces} pieces, whose frame is the world; the others have frames of their own"
        value = sum(r["in_world"] for r in posed)
        by_name["frames_in_world"] = metric("Frames with a pose in the world", value, "frames", how, every)
    if resected:
        how = "root mean square over the landmarks that agree with the pose, then median over frames"
        value = statistics.median(r["rms_px"] for r in resected)
        by_name["reprojection_rms"] = metric("Back-projection error", value, "px", how, every)
        how = "landmarks left after removal of inconsistent ones: median over frames"
        value = statistics.median(r["inliers"] for r in resected)
        by_name["inliers"] = metric("Landmarks a frame", value, "", how, every)
    return by_name


def _agreement(scene: Scene) -> dict[str, Metric]:
    """Two trajectories that share the given calibration alone."""
    compared = scene.comparison
    if compared is None or not compared.registered.any():
        return {}
    every = f"{int(np.isfinite(compared.distance).sum())} of {len(compared.distance)} frames"
    given = _assessed(scene.view, scene.view.products.agreement, "agreement_", "", None, AGREEMENT)
    by_name = {name: {**entry, "completeness": every} for name, entry in given.items()}
    how = str(compared.meta.get("rule") or "by their disagreement")
    by_name["agreement_flagged"] = metric("Frames flagged", int(compared.flagged.sum()), "frames", how, every)
    return by_name


def _rig(scene: Scene) -> dict[str, Metric]:
    """Epipolar residuals under the given and the used rig."""
    calibration = scene.calibration
    if calibration is None or not len(calibration.before):
        return {}
    every = f"{len(scene.view.products.orientations)} basic pairs, {len(calibration.before)} matches"
    by_name, how = {}, "RMS distance of matched points from their epipolar lines, outliers left out"
    for name, rig, when in (("rig_residual_given", "given rig", "before"), ("rig_residual", "used rig", "after")):
        by_name[name] = metric(f"Epipolar residual, {rig}", calibration.residual(when), "px", how, every)
    return by_name


def _matching(pairs: Rows) -> dict[str, Metric]:
    """What the basic pairs gave, and how their models agree."""
    by_name, matched = {}, _values(pairs, "matched")
    if matched:
        how = (
            "pixels of the left image with a measured disparity, back-matched or on the plane of a textureless region "
            "(not interpolated): mean over pairs"
        )
        every = f"{len(matched)} of {len(pairs)} basic pairs"
        by_name["matched"] = metric("Matched pixels", statistics.fmean(matched), "1", how, every)
    offsets = _values(pairs, "difference_m")
    if offsets:
        how = (
            "elevation of a model minus that of the one before, bias of their common cells: its size, median over pairs"
        )
        every, value = f"{len(offsets)} of {len(pairs) - 1} successive models", statistics.median(map(abs, offsets))
        by_name["overlap_median"] = metric("Offset of overlapping models", value, "m", how, every)
    return by_name


def _terrain(scene: Scene) -> dict[str, Metric]:
    world = scene.world
    if world is None:
        return {}
    there, cell = np.isfinite(world.arrays["elevation"]), world.lattice.cell
    of_map = f"{there.mean():.0%} of the map's cells"
    by_name = {
        "cell_size": metric("Cell size", cell, "m", "from the rig, or given (locus.cell_size)"),
        "mapped_area": metric("Mapped area", float(there.sum()) * cell**2, "m²", "cells with an elevation", of_map),
    }
    sigma = world.arrays["elevation_std"]
    if np.isfinite(sigma).any():
        value = float(np.nanmedian(sigma))
        by_name["elevation_sigma"] = metric("Predicted σ of elevation, median", value, "m", SIGMA + "cells", of_map)
    return by_name


def _hazards(scene: Scene, pairs: Rows) -> dict[str, Metric]:
    """Shares of the classes of the risk map, and how many stops have a local path."""
    by_name = {}
    if scene.risk is not None:
        how = f"share of all cells of the risk map; limits of {scene.view.config.vehicle.name}"
        for k, name in enumerate(("safe", "caution", "hazardous", "unknown")):
            share = float((scene.risk.arrays["risk"] == k).mean())
            by_name[name] = metric(f"{name.capitalize()} cells", share, "1", how)
    reached, asked = delivery.local_paths(pairs)
    if asked:
        how = "counted; a path leads at least the vehicle's length ahead, as far as the ground is known and safe"
        every = f"{asked} of {len(pairs)} basic pairs"
        by_name["local_paths"] = metric("Local paths found", reached, "", how, every)
    return by_name


def _path(scene: Scene) -> dict[str, Metric]:
    view, points = scene.view, scene.path
    facts = facts_of(view, view.products.world_path)
    if points is None or not facts.get("found"):
        return {}
    how = "in plan; nearer ground is not seen, or not to be driven on"
    away = delivery.start_of_path(view)
    by_name = {
        "path_length": metric("Path length", facts.get("length_m"), "m", "along its vertices in 3-D"),
        "path_start": metric("Start of the path from the first camera", away, "m", how),
    }
    for name, fact, label, unit, how in ON_PATH:
        value = facts.get(fact)
        if value is not None:
            by_name[name] = metric(label, float(np.degrees(value)) if unit == "deg" else value, unit, how)
    sigma = np.zeros(0) if scene.world is None else scene.world.at("elevation_std", points[:, :2])
    known = sigma[np.isfinite(sigma)]
    if known.size:
        every, label = f"{known.size} of {len(points)} vertices", "Predicted σ of elevation along the path"
        by_name["path_sigma"] = metric(label, float(np.median(known)), "m", SIGMA + "the path's vertices", every)
    return by_name
