"""``report.json``: all that the page says, as data: metrics, what is missing, warnings, rows, stages, versions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import numpy as np

from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RUN, RunView
from rille.pipeline.flow.products import Products
from rille.pipeline.report import delivery, tables
from rille.pipeline.report.canvas import Figure
from rille.pipeline.report.gather import Scene, facts_of, frames_of
from rille.pipeline.report.metrics import metric, metrics
from rille.stages.core.quantities import count, metres, number, quantity
from rille.stages.evaluation import imu_check
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry import rigid
from rille.stages.geometry.epipolar import standing
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.hfvm.coarse import ImageDifference
from rille.stages.odometry.resection.calibration_errors import CORRECTED
from rille.stages.odometry.resection.intrinsics import MIN_YAW_PX
from rille.stages.odometry.resection.trajectory import world_poses
from rille.stages.terrain.reference import camera_height, seen_up


def collect(view: RunView) -> dict[str, Any]:
    """Collect the part of ``report.json`` that depends on the artifacts alone, not on time and place of the run."""
    scene = Scene(view)
    frames, pairs = tables.frames(scene), tables.pairs(scene)
    assessed, figures = any(delivery.has_truth(view)), metrics(scene, frames, pairs)
    maps = bool(view.products.disparity_accuracy)
    source = view.sequence.truth_source if assessed else "true disparities" if maps else "no truth"
    return {
        "verdict": _verdict(view, frames, pairs, figures),
        **delivery.account(scene, frames, pairs, _unlike(figures)),
        "warnings": find_warnings(scene, figures),
        "seams": _seams(view),
        "sequence": _sequence(view),
        "truth": {"used": assessed or maps, "source": source},
        "metrics": figures,
        "frames": frames,
        "pairs": pairs,
        "vehicle": view.config.vehicle.model_dump(mode="json"),
        "notes": [
            *view.sequence.notes,
            *delivery.coverage(view),
            *delivery.moved(view),
            *delivery.unmeasured_vertical(view),
            *given_numbers(view),
            *resting(view),
        ],
        "rig": _rig(scene),
        "crosscheck": _crosscheck(scene),
        "path": _path(scene),
        "drive": _drive(scene),
        **tables.loops(scene),
    }


def summarise(view: RunView, facts: Mapping[str, Any], figures: Sequence[Figure]) -> dict[str, Any]:
    """Everything that ``report.json`` holds, with what this run alone knows; the page has the same numbers."""
    outcome = delivery.complete(facts, view, figures)
    complete = not (delivery.lacking(outcome["missing"]) or view.part)
    state = "Incomplete" if not complete else "Complete but for what is listed" if outcome["missing"] else "Complete"
    listed = {item["what"] for item in outcome["missing"]}
    # Figures that a warning calls in question are not to be taken for sure.
    if complete and (doubts := [line for line in facts["warnings"] if line not in listed]):
        state += f", with {count(len(doubts), 'warning')}"
    how = "wall clock, without writing the page; what is cached costs no time"
    clock = {"group": "Run", "truth": None, **metric("Time of this run's tasks", view.seconds, "s", how)}
    return {
        "format": 2,  # raised when the meaning of a key changes
        "run": view.run_id,
        "started": view.started,
        "command": view.command,
        "complete": complete,
        **facts,
        "verdict": f"{state}: {f'a part of the reconstruction, {view.part}.' if view.part else facts['verdict']}",
        **outcome,
        "metrics": {**facts["metrics"], "wall_clock": clock},
        "stages": _stages(view),
        "seconds": round(view.seconds, 3),
        "versions": dict(view.versions),
        "vehicle": {**facts["vehicle"], "source": view.vehicle_source},
    }


def _write(path: Path, run: RunView) -> None:
    path.write_text(json.dumps(collect(run), allow_nan=False), encoding="utf-8")


def find_warnings(scene: Scene, figures: Mapping[str, Any]) -> list[str]:
    """List warnings, one line each: on the input, the rig, the choice of pairs, the comparison."""
    view, p, compared = scene.view, scene.view.products, scene.comparison
    lines = list(view.sequence.warnings)
    lines += scene.calibration.warnings() if scene.calibration is not None else []
    early = [p.screening, *p.contradictions, p.keyframes, p.intrinsics, *p.crosschecks, p.crosscheck, p.agreement]
    truths = (p.accuracy, p.position_accuracy, *p.disparity_accuracy.values())
    for handle in (*early, p.trajectory, *truths, p.overlap_audit, *p.ground.values()):
        lines += facts_of(view, handle).get("warnings") or []
    # Against truth that was misread no standard deviation can hold.
    misread = bool(facts_of(view, p.accuracy).get("warnings"))
    lines += (
        _blurred(view)
        + _sensed_turns(view)
        + _verticals(view)
        + delivery.oversized(view)
        + ([] if misread else _small_sigma(figures))
        + _displaced(view)
    )
    if compared is not None and compared.flagged.any():
        bad = frames_of(view, compared.flagged)
        share = f"{len(bad)} of {len(view.frames)} frames"
        lines.append(f"trajectory and COLMAP disagree more than elsewhere at {share}: {delivery.frame_words(bad)}")
    lines += _unlike(figures)
    # A name in the data may hold line feeds, and a warning is one line.
    return list(dict.fromkeys(" ".join(str(line).split()) for line in lines))


def given_numbers(view: RunView) -> list[str]:
    """What rests on the calibration's numbers alone, and what one per cent of each would do to this run.

    With z = f b / d the whole path scales with the baseline b, its part along the optical axis with the focal length f:
    of steps p (in the camera) by p_z^2 / |p|. A principal point that is off by e pixels turns all rays by e / f, and
    with them the path as a whole and the ground in front.
    """
    trajectory, rig = view.bundle(view.products.trajectory), view.sequence.rig
    levels = [view.bundle(handle) for handle in view.products.level.values()]
    known = [cast(GroundFacts, level.meta) for level in levels if level is not None and not delivery.on_planes(view)]
    grounds = [box for facts in known if (box := facts.get("footprint"))]
    poses = np.zeros((0, 3, 4)) if trajectory is None else world_poses(trajectory)
    poses = poses[rigid.posed(poses)]
    steps = np.einsum("nji,nj->ni", poses[:-1, :, :3], np.diff(poses[:, :, 3], axis=0))
    long = np.linalg.norm(steps, axis=1)
    if not long.sum() > 0:
        return []
    ahead = float((steps[:, 2] ** 2 / np.maximum(long, 1e-12)).sum())
    left, off = rig.left, float(np.linalg.norm(poses[-1, :, 3] - poses[0, :, 3]))
    line = (
        "By the images alone, scale and heading rest on the calibration as given, whose errors a straight drive does "
        "not show. 1 % of the "
        f"baseline ({metres(rig.baseline)}) is {metres(0.01 * long.sum())} of the path of {metres(long.sum())}; 1 % of "
        f"the focal length ({left.fx:.4g} px) is {metres(0.01 * ahead)}; a principal point off by 1 % of the image's "
        f"width ({0.01 * left.width:.2g} px) leads its end {metres(0.01 * left.width / left.fx * off)} aside"
    )
    if grounds:
        far = float(np.median([0.5 * (box[2] + box[3]) for box in grounds]))
        lift = metres(0.01 * left.height / left.fy * far)
        line += f", off by 1 % of the height it lifts or lowers ground {metres(far)} ahead by {lift}"
    heights = [camera_height(facts) for facts in known if facts.get("plane")]
    if heights:
        line += f". By that baseline the left camera stands {metres(float(np.median(heights)))} above the ground"
    return [line + "."]


def _unlike(figures: Mapping[str, Any]) -> list[str]:
    """Trajectory and crosscheck are not alike anywhere: no frame then stands out."""
    # Per cent of the length. 29 are left of a straight way where the other trajectory rests: half of that is not alike.
    if (_value(figures, "agreement_share") or 0.0) <= 15.0:
        return []
    rmse, length = (metres(_value(figures, name)) for name in ("agreement_rmse", "agreement_length"))
    text = f"trajectory and COLMAP are unlike throughout: {rmse} RMS over {length}; one is wrong"
    return [f"{text}: do shadows or things in view move, or does the ground repeat?"]


def _value(figures: Mapping[str, Any], name: str) -> Any:
    """Value of a figure, None where there is none."""
    return figures.get(name, {}).get("value")


def _displaced(view: RunView) -> list[str]:
    """The place on Earth is that of a camera which is not the origin of this run's world."""
    facts = facts_of(view, view.products.trajectory)
    first = facts["pieces"][facts["main"]][0] if facts and view.sequence.georeference is not None else 0
    if first == 0:
        return []
    return [
        f"this run's world begins at frame {first}: rasters and path.gpkg are displaced on Earth, unless world.origin "
        f"and world.azimuth_deg are those of frame {first}"
    ]


def _blurred(view: RunView) -> list[str]:
    """One camera shows less detail than the other one."""
    blurs = [facts_of(view, handle).get("blur", 0.0) for handle in view.products.disparity.values()]
    # Of pairs of two sharp cameras some differ by chance.
    blur = float(np.median(blurs)) if blurs else 0.0
    which, other = ImageDifference(blur=blur).blurred
    text = (
        f"the {which} images are blurred by {abs(blur):.1f} px beside the {other} ones: out of focus, or a dirty lens?"
    )
    return [text] if blur else []


def _sensed_turns(view: RunView) -> list[str]:
    """The IMU contradicts the images by its rotations."""
    s, trajectory = view.sequence, view.bundle(view.products.trajectory)
    if s.imu_axes is None or s.attitude is None or s.times is None or trajectory is None:
        return []
    frames, unknown = trajectory.meta["frames"], np.full((3, 3), np.nan)
    sensed = np.array([unknown if s.attitude[f] is None else s.attitude[f] for f in frames], dtype=float)
    times = np.array([s.times[f] for f in frames])
    return imu_check.of_rotations(world_poses(trajectory)[:, :, :3], sensed, times, np.array(s.imu_axes))


def _verticals(view: RunView) -> list[str]:
    """The IMU, an attitude or a stated pitch contradicts the ground that the images show."""
    # The ground also where elevations are measured from another plane.
    s, trajectory, levels = view.sequence, view.bundle(view.products.trajectory), view.products.ground
    axes, lines = None if s.imu_axes is None else np.array(s.imu_axes), list[str]()
    shown = {k: cast(GroundFacts, b.meta) for k, level in levels.items() if (b := view.bundle(level)) is not None}
    for source, stated in (("attitude", None), ("pitch", s.pitch)):
        told = {k: up for k, facts in shown.items() if facts["source"] == source and (up := seen_up(facts)) is not None}
        if not told:
            continue
        given = np.array([RigidTransform.from_matrix(shown[k]["T_local_left"]).rotation[2] for k in told])
        contradicted = imu_check.of_vertical(given, (seen := np.array(list(told.values()))), axes, stated)
        if source == "attitude" and trajectory is not None and not contradicted:
            turned = world_poses(trajectory)[[trajectory.meta["frames"].index(k) for k in told], :, :3]
            known = rigid.posed(turned)
            contradicted = imu_check.of_mount(given[known], seen[known], turned[known])
        lines += contradicted
    return lines


def _small_sigma(figures: Mapping[str, Any]) -> list[str]:
    """The standard deviations of the poses are not to be weighed by, where truth says so."""
    off = {}
    for part in ("position", "rotation"):
        nees = _value(figures, f"trajectory_nees_{part}")
        # Errors of three times their standard deviations are worth a word.
        if nees is not None and nees > 3.0**2:
            off[part] = f"{part}s by about {number(math.sqrt(nees), 2)} times"
    if not off:
        return []
    line = (
        f"the poses are off the truth, {' and '.join(off.values())} their standard deviations: these are too small, or "
        "the truth has a turn or errors of its own, beyond what truth.sigma_m and sigma_deg state; until that is known "
        "do not weigh by them"
    )
    if "position" in off:
        line += (
            "; what the merged map says of σ and of the probability of a hazard holds for the shape of the ground, not "
            "for its place"
        )
    return [line]


def resting(view: RunView) -> list[str]:
    """Numbers of the cameras that the tracks show little of, with the standard deviations that poses reckon with."""
    facts = facts_of(view, view.products.intrinsics)
    numbers = list(facts.get("errors", {}).items())[:CORRECTED]
    held = [f"{name} +- {100.0 * sigma:.2g} %" for name, (_, sigma) in numbers if name in facts["held"]]
    text = "These numbers of the cameras rest on the calibration as given, for the tracks show little of them"
    lines = [f"{text}: {', '.join(held)} of the focal length; the covariances of poses hold that."] if held else []
    return lines + wrong_toe_in(view)


def wrong_toe_in(view: RunView) -> list[str]:
    """A line on a toe-in that poses are corrected for and elevations are not, if it is known and more than little."""
    facts, rig = facts_of(view, view.products.intrinsics), view.sequence.rig
    angle, sigma = facts.get("errors", {}).get("toe-in", (0.0, 1.0))
    right = rig.right
    span, focal = (right.height, right.fy) if standing(rig) else (right.width, right.fx)
    off = abs(angle) * focal * (0.5 * span / focal) ** 2
    if abs(angle) < 5.0 * sigma or off < MIN_YAW_PX:
        return []
    return [
        f"By the tracks, disparities at the sides of the image are off by {off:.1f} px against its middle, as if the "
        f"right camera were turned by {math.degrees(angle):+.3f} +- {math.degrees(sigma):.3f} degrees and its "
        "principal point took that back (toe-in). Poses are corrected for it, elevations are not: calibrate anew."
    ]


AGAINST_TRUTH = {
    "trajectory_drift": "drift",
    "trajectory_position_drift": "drift",
    "trajectory_ate_rmse": "RMSE",
    "dem_merged_rmse": "RMSE",
    "disparity_bad_2": "bad-2",
}
"""The one figure against truth that the verdict gives: the first of these that has a value; and its word."""


def _verdict(view: RunView, frames: delivery.Rows, pairs: delivery.Rows, figures: Mapping[str, Any]) -> str:
    """One line: what there is, of how much."""
    posed, placed = (sum(r[key] for r in frames) for key in ("posed", "in_world"))
    models = sum(r["modelled"] for r in pairs)
    apart = f", {placed} of them in the world" if placed < posed else ""
    stops = delivery.local_paths(pairs)
    length = facts_of(view, view.products.world_path).get("length_m")
    errors = [
        f"{word} {quantity(_value(figures, name), figures[name]['unit'])} against truth"
        for name, word in AGAINST_TRUTH.items()
        if _value(figures, name) is not None
    ]
    parts = [
        "one stereo pair" if len(frames) == 1 else f"{posed} of {len(frames)} frames posed{apart}",
        *errors[:1],
        f"{models} of {len(pairs)} elevation models",
        *([f"{stops[0]} of {stops[1]} local paths"] if stops[1] else []),
        _way_words(view, length),
        *([] if view.products.disparity_accuracy or any(delivery.has_truth(view)) else ["not assessed against truth"]),
    ]
    first = "".join(f"{line}. " for line in delivery.contradictions(view)[:1])
    return first + ", ".join(parts) + "."


def _way_words(view: RunView, length: float | None) -> str:
    """What came of the path, or of the drive."""
    if view.products.drive is not None:
        drive = view.products.drive
        reason = f" ({drive.reason})" if drive.reason else ""
        return f"{drive.verdict} after {count(len(drive.stops), 'stop')}{reason}"
    if delivery.on_planes(view):
        return "distances from a plane that is no ground"
    return "no path" if length is None else f"a path of {length:.3g} m{delivery.start_words(view)}"


def _seams(view: RunView) -> dict[str, Any] | None:
    """The audit of seams: models, how many seams there are and the worst of them."""
    audit = facts_of(view, view.products.overlap_audit)
    return {name: audit[name] for name in ("models", "seam_count", "seams")} if audit.get("seams") else None


def _rig(scene: Scene) -> dict[str, Any] | None:
    """The rig that was used, and what the images ask for; None if no task examined it."""
    calibration = scene.calibration
    if calibration is None:
        return None
    facts = {key: calibration.facts[0].get(key) for key in ("source", "residual_before_px", "residual_after_px")}
    parameters = calibration.parameters
    unsure = undecided(parameters, scene.view.config.rig.significance)
    counts = {"rigs": len(calibration.facts), "changed": calibration.changed}
    return counts | facts | {"parameters": parameters, "undecided": unsure}


def undecided(parameters: Sequence[Mapping[str, Any]], significance: float) -> list[Mapping[str, Any]]:
    """Parameters that the images ask for but cannot tell from a principal point that is off."""
    held = [p for p in parameters if not p.get("freed") and not p.get("observed") and p.get("sigma")]
    return [p for p in held if abs(p["asked"]) > significance * p["sigma"]]


def _crosscheck(scene: Scene) -> dict[str, Any] | None:
    """How the other program's trajectory was compared; None where it was not."""
    compared = scene.comparison
    if compared is None:
        return None
    facts = {key: compared.meta.get(key) for key in ("pieces", "rule", "flagged")}
    return {**facts, "lost": frames_of(scene.view, ~compared.registered)}


def _path(scene: Scene) -> dict[str, Any] | None:
    """Where the path over the merged terrain ends, what it was to reach, and what it leaves out; None: not computed."""
    view = scene.view
    path = view.bundle(view.products.world_path)
    if path is None:
        return None
    facts = {key: path.meta.get(key) for key in ("reason", "ground", "left_out_m")}
    end = None if scene.path is None else scene.path[-1, :2].tolist()
    return {**facts, "end": end, "start": delivery.start_words(view, "")}


def _drive(scene: Scene) -> dict[str, Any] | None:
    """How a drive ended, its stops, and its place in a global map; None where nothing was driven."""
    drive = scene.view.products.drive
    if drive is None:
        return None
    fix = scene.view.bundle(drive.fix)
    place: dict[str, Any] = {}
    if fix is not None:
        place = {key: fix.meta[key] for key in ("source", "std") if key in fix.meta}
        place |= {"xy": fix.meta["T_global_local"][3:8:4], "other": fix.meta.get("fit", {}).get("other")}
    return {"verdict": drive.verdict, "reason": drive.reason, "stops": tables.stops(scene), "place": place}


def _sequence(view: RunView) -> dict[str, Any]:
    s, cameras = view.sequence, {"": view.sequence.rig.left, "right_": view.sequence.rig.right}
    return {
        "name": s.name,
        "frames": len(view.frames),
        "frames_of_sequence": s.frames,
        "first": view.frames[0],
        "last": view.frames[-1],
        **{f"{side}image_width_px": camera.width for side, camera in cameras.items()},
        **{f"{side}image_height_px": camera.height for side, camera in cameras.items()},
        **{f"{side}focal_length_px": camera.fx for side, camera in cameras.items()},
        "baseline_m": s.rig.baseline,
        "basic_pairs": sorted(view.products.disparity),
    }


def _stages(view: RunView) -> dict[str, dict[str, Any]]:
    """By stage: tasks computed and cached in this run; seconds of the former, and of all when they were computed."""
    by_stage, counted = dict[str, dict[str, Any]](), ("computed", "cached", "failed", "skipped")
    timed = "seconds", "seconds_when_computed"
    for t in view.tasks:
        row = by_stage.setdefault(t.stage, dict.fromkeys(counted, 0) | dict.fromkeys(timed, 0.0))
        row[t.status] += 1
        row["seconds"] += (t.seconds or 0.0) if t.status == "computed" else 0.0
        row["seconds_when_computed"] += t.seconds or 0.0
    return {name: {key: round(value, 3) for key, value in row.items()} for name, row in by_stage.items()}


NOT_IN_FACTS = ("images", "world_dem")
"""Products that the facts are not made of."""


S, CONFIG = RUN.sequence, RUN.config
READS = (
    *(getattr(RUN.products, product.name) for product in fields(Products) if product.name not in NOT_IN_FACTS),
    *(CONFIG.vehicle, CONFIG.rig.significance, CONFIG.crosscheck.enabled),
    *(S.name, S.frames, S.frame_names, S.rig, S.truth, S.truth_source, S.truth_positions, S.warnings, S.notes),
    *(S.evaluation_window, S.georeference, S.times, S.pitch, S.attitude, S.imu_axes, S.loose_odometry),
)

OUTPUTS = (Output("facts", "", "", _write, reads=READS),)
STAGE = stage("output.facts", "Figures and tables of the report in numbers", OUTPUTS)
