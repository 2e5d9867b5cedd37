"""Delivered, absent (not asked for, or not possible with the data) and missing results, each from its facts.

If no path over the whole map exists, the path is listed as missing, although this is a valid answer: a reader of
"nothing is missing" would expect a path. A single stop without a path lacks nothing. Truth that the data do not have,
and a comparison that is switched off, are not missing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rille.pipeline.export.view import UNSTATED, RunView, TaskRow
from rille.pipeline.report.canvas import Figure
from rille.pipeline.report.gather import Scene, facts_of, frames_of
from rille.stages.core.quantities import count, metres, some, spans
from rille.stages.geometry.pose_arrays import GROUND_PLANE, REFERENCE_PLANE

Rows = list[dict[str, Any]]
Items = list[dict[str, str]]

HARMLESS = ("no path", "crosscheck")
"""Kinds of what is listed as missing that are answers, or lie outside of the reconstruction."""


def lacking(missing: Items) -> Items:
    """What leaves a run incomplete, of what its report lists as missing."""
    return [item for item in missing if item["kind"] not in HARMLESS]


def account(scene: Scene, frames: Rows, pairs: Rows, unlike: Sequence[str] = ()) -> dict[str, Any]:
    """List ``delivered``, ``absent`` and ``missing`` results as far as the artifacts tell.

    The first in words; the others with ``kind``, ``what`` and ``why`` each; what is absent is no loss.
    ``unlike``: lines on a crosscheck that contradicts the trajectory.
    """
    view = scene.view
    contradicted = [_item("contradiction", line, "") for line in (*contradictions(view), *unlike)]
    missing = contradicted + _poses(view, frames) + _path(view) + _crosscheck_lost(scene)
    absent = _reference(view) + _local_paths(pairs) + _truth(view) + _crosscheck_off(view) + _vehicle(view)
    return {"delivered": _delivered(view, frames, pairs), "missing": missing, "absent": absent}


def complete(accounted: Mapping[str, Any], view: RunView, figures: Sequence[Figure]) -> dict[str, Any]:
    """The lists of :func:`account` with what became of tasks and figures: all that a reader might take for granted."""
    made = {t.label for t in view.tasks if t.status in ("computed", "cached")}
    done = ["every task was done"] if view.tasks and len(made) == len(view.tasks) else []
    if view.part:
        absent = [_item("part", f"Left out, as {view.part} asks", left_out(view.left_out))]
        posed = any(label.partition("/")[0] == "trajectory" for label in made)
        judged = ("contradiction", *(("no pose", "piece") if posed else ()))
        wrong = [item for item in accounted["missing"] if item["kind"] in judged]
        return {"delivered": done, "absent": absent, "missing": [*wrong, *_failures(view), *_unmade(view)]}
    undrawn = [_item("figure", figure.title, figure.why) for figure in figures if figure.why]
    # What the images contradict comes first: it may be the cause of all that follows.
    missing = sorted(
        [*_failures(view), *accounted["missing"], *undrawn], key=lambda item: item["kind"] != "contradiction"
    )
    absent = [item for item in accounted["absent"] if item["kind"] != "vehicle" or view.vehicle_source == UNSTATED]
    return {"delivered": [*done, *accounted["delivered"]], "absent": absent, "missing": missing}


def left_out(stages: Mapping[str, int]) -> str:
    """What a part of a run leaves out, in words; ``stages`` counts the tasks that are known by stage."""
    known = f"{count(sum(stages.values()), 'known task')} ({some(sorted(stages), 40)}), " if stages else ""
    return f"{known}all that would have followed, and the report's figures"


def _unmade(view: RunView) -> Items:
    """Stages and files that were wanted, and that this run does not have."""
    made = {name for t in view.tasks for name in (t.stage, t.label.partition("/")[0], t.label.removeprefix("output/"))}
    failed = any(t.status == "failed" for t in view.tasks)
    why = "what it needs failed" if failed else "this sequence has none, or a parameter switches it off"
    return [_item("part", f"No {name}", why) for name in (*view.until, *view.only) if name not in made]


def has_truth(view: RunView) -> list[bool]:
    """Whether each chosen frame has a true pose, or a true position where truth is positions alone."""
    truth = view.sequence.truth
    alone = view.bundle(view.products.position_accuracy)
    if truth is None and alone is not None:
        there = np.isfinite(np.asarray(alone["position_truth"])[:, :2]).all(axis=1)
        return [bool(known) for known in there]
    return [truth is not None and truth[frame] is not None for frame in view.frames]


def frame_words(frames: list[int]) -> str:
    """``frames 1-3, 7``."""
    return f"frame{'s' if len(frames) > 1 else ''} {spans(frames)}"


def local_paths(pairs: Rows) -> tuple[int, int]:
    """How many stops have a local path, of how many at which one was looked for."""
    asked = [r for r in pairs if r["path"] is not None]
    return sum(r["path"] == "found" for r in asked), len(asked)


def start_of_path(view: RunView) -> float | None:
    """Distance in plan, m, of the path's start from the first left camera, the origin of the world; None: no path."""
    path = view.bundle(view.products.world_path)
    if path is None or not len(path["path"]):
        return None
    return float(np.hypot(*np.asarray(path["path"])[0, :2]))


def start_words(view: RunView, lead: str = ", which ") -> str:
    """Describe the start of the path, after ``lead``; empty if it is within the vehicle's length of the camera."""
    away, vehicle = start_of_path(view), view.config.vehicle
    if away is None or away <= vehicle.wheel_base + vehicle.wheel_diameter:
        return ""
    return f"{lead}starts {metres(away)} from the first camera"


def _delivered(view: RunView, frames: Rows, pairs: Rows) -> list[str]:
    words = ["every frame has a pose"] if len(frames) > 1 and all(r["in_world"] for r in frames) else []
    reached, asked = local_paths(pairs)
    words += ["every stop has a local path"] if asked and reached == asked else []
    drive, away = view.products.drive, start_of_path(view)
    words += ["the goal was reached"] if drive is not None and drive.verdict == "goal" else []
    words += [f"a path over the merged terrain was found{start_words(view)}"] if away is not None else []
    return words


CONTRADICTIONS = ("repeats", "contradiction", "knocked", "misread")
"""Facts that say what the images contradict."""


def contradictions(view: RunView) -> list[str]:
    """List what the images contradict so that no figure may rest on it, one line each."""
    p = view.products
    told = (*p.contradictions, *p.rigs.values(), *p.ground.values(), *p.resections, p.trajectory, p.overlap_audit)
    facts = [facts_of(view, handle) for handle in told]
    return list(dict.fromkeys(f[key] for f in facts for key in CONTRADICTIONS if key in f))


def _failures(view: RunView) -> Items:
    """Failed tasks by cause, with the number of tasks that depend on them; and what was left out for another reason."""
    tasks = {t.label: t for t in view.tasks}
    causes: dict[tuple[str, str], list[TaskRow]] = {}
    for t in view.tasks:
        root = t
        while root.cause in tasks:
            root = tasks[root.cause]
        if root.status in ("failed", "skipped"):
            # The figures in a message are those of one pair: the cause is the words.
            kind = _kind(root.label) if root.status == "failed" else ""
            causes.setdefault((kind, re.sub(r"-?[0-9][0-9.]*", "#", root.reason)), []).append(t)
    return [_failure(view, kind, behind) for (kind, _), behind in causes.items()]


def _failure(view: RunView, kind: str, behind: list[TaskRow]) -> dict[str, str]:
    """What one cause has cost: failed tasks of a ``kind`` (empty: none failed) and those that depend on them."""
    if not kind:
        why = behind[0].reason or "something it depends on is missing"
        return _item("skipped", some([t.label for t in behind], 6), why)
    failed = [t for t in behind if t.status == "failed"]
    n, waiting = len(failed), len(behind) - len(failed)
    whole, names = sum(_kind(t.label) == kind for t in view.tasks), [t.label[len(kind) + 1 :] for t in failed]
    what = f"{n} of {whole} tasks {kind} failed ({some(names, 12)})" if whole > 1 else f"{failed[0].label} failed"
    if waiting:
        what += f": {count(waiting, 'task')} depend{'s' * (waiting == 1)} on {'it' if n == 1 else 'them'}"
    return _item("failed", what, failed[0].reason)


def _kind(label: str) -> str:
    """A task's label without the number of its frame, pair or tile."""
    return label.rpartition("/")[0] or label


def _poses(view: RunView, frames: Rows) -> Items:
    items, remedy = [], ""
    if view.sequence.loose_odometry:
        remedy = ": state drift and turn_deg of [odometry], and it joins them"
    lost = [r["frame"] for r in frames if not r["posed"]]
    if lost:
        items.append(_item("no pose", f"{len(lost)} of {len(frames)} frames have no pose", frame_words(lost)))
    apart = [r["frame"] for r in frames if r["posed"] and not r["in_world"]]
    if apart:
        what = f"{len(apart)} of {len(frames)} frames have a pose in another piece of the trajectory, not in the world"
        items.append(_item("piece", what, frame_words(apart) + remedy))
    return items


def _local_paths(pairs: Rows) -> Items:
    """Stops without a local path, each reason with its frames."""
    reached, asked = local_paths(pairs)
    without = [r for r in pairs if r["path"] not in (None, "found")]
    at = {reason: [r["frame"] for r in without if r["path"] == reason] for reason in [r["path"] for r in without]}
    why = "; ".join(f"{reason} ({frame_words(frames)})" for reason, frames in at.items())
    return [_item("no local path", f"No local path from {asked - reached} of {asked} stops", why)] if why else []


def on_planes(view: RunView) -> list[Mapping[str, Any]]:
    """Facts on the plane of each pair whose elevations are distances from one that is no ground."""
    shown = [facts_of(view, level) for level in view.products.level.values()]
    return [facts for facts in shown if facts.get("source") == REFERENCE_PLANE]


def _reference(view: RunView) -> Items:
    """State that neither hazards nor paths were asked for, and why."""
    planes = on_planes(view)
    if not planes:
        return []
    first = planes[0]
    normal = ", ".join(f"{v + 0.0:.2f}" for v in first["T_local_left"][8:11])
    share = first["ground_share"]
    whose = f"the plane that {share:.0%} of the scene lies on" if share else "a plane, stated or across the view,"
    reason = f"{first['why']}: " if "why" in first else ""
    why = (
        f"{reason}elevations are distances from {whose} (normal [{normal}] in its camera's frame, "
        f"{metres(first['T_local_left'][11])} away), z points to the cameras; hazards and paths mean nothing there"
    )
    if "world.up" not in reason and "locus.cell_size" not in reason:
        why += ". If that is the ground, state its normal as world.up in a manifest"
    return [_item("reference", "No ground, so neither hazards nor paths", why)]


def coverage(view: RunView) -> list[str]:
    """Which matched pixels the map of a pair lacks, and what would bring them in: one line for the run."""
    maps = {pair: facts_of(view, dem).get("coverage", {}) for pair, dem in view.products.local_dem.items()}
    lacking = {pair: facts["outside"] + facts["unsure"] for pair, facts in maps.items() if facts.get("settings")}
    pair = max(lacking, key=lambda k: lacking[k], default=-1)
    # Shares of the matched pixels.
    if lacking.get(pair, 0.0) < 0.1:
        return []
    facts, size = maps[pair], [metres(v) for v in maps[pair]["size"]]
    settings = " ".join(f"--set {name}={value:g}" for name, value in facts["settings"].items())
    return [
        f"{lacking[pair]:.0%} of the matched pixels of pair {pair} are not on its map: {facts['outside']:.0%} lie "
        f"outside, {facts['unsure']:.0%} are too uncertain for it (locus.max_sigma, locus.max_range_cells). {settings} "
        f"brings most in, on {size[0]} x {size[1]}. Points of all of them: rille export RUN --to laz."
    ]


def moved(view: RunView) -> list[str]:
    """What moved by itself, in one line for the run."""
    shares = {pair: float(facts_of(view, one).get("share", 0.0)) for pair, one in view.products.moving.items()}
    # Errors of displacements come to less.
    pairs = [pair for pair, share in shares.items() if share >= 0.02]
    if not pairs:
        return []
    most = max(pairs, key=lambda pair: shares[pair])
    return [
        f"{len(pairs)} of {len(shares)} pairs show something that moves by itself, pair {most} the most: "
        f"{shares[most]:.0%} of its image. The world's terrain is made without it; models of single pairs hold it."
    ]


def unmeasured_vertical(view: RunView) -> list[str]:
    """State that hazards are judged against the plane of the ground, where nothing else gives the vertical."""
    sources = {facts_of(view, level).get("source") for level in view.products.level.values()}
    if sources != {GROUND_PLANE} or view.bundle(view.products.world_risk) is None:
        return []
    return [
        "Nothing states the vertical, so the plane of the ground that is seen counts as level: a slope that all of it "
        "has is neither in the elevations nor in inclinations, risk and path. world.pitch_deg, world.up, an attitude "
        "or an IMU in a manifest gives the vertical."
    ]


def _path(view: RunView) -> Items:
    drive = view.products.drive
    if drive is not None:
        # No answer: a drive is asked for its goal, and all that it did not come to is missing with that.
        return [] if drive.verdict == "goal" else [_item("drive", f"Drive: {drive.verdict}", drive.reason)]
    path = view.bundle(view.products.world_path)
    if on_planes(view):
        return []
    if path is None:
        return [_item("no path", "No path", "the path over the merged terrain was not computed")]
    if path.meta.get("found"):
        return []
    y = path.meta.get("blocking_y")
    where = "" if y is None else f"; blocked {abs(y):.3g} m {'ahead of' if y >= 0 else 'behind'} the first camera"
    return [_item("no path", "No path", (path.meta.get("reason") or "the far row cannot be reached") + where)]


def _truth(view: RunView) -> Items:
    known = has_truth(view)
    if all(known):
        return []
    if any(known):
        gaps = [frame for frame, there in zip(view.frames, known, strict=True) if not there]
        return [_item("no truth", f"{len(gaps)} of {len(known)} frames have no truth", frame_words(gaps))]
    none = view.sequence.truth is None and view.sequence.truth_positions is None
    owner = "the sequence has none" if none else "it has none for the chosen frames"
    if view.products.disparity_accuracy:
        return [_item("no truth", "No true poses", f"{owner}, so the trajectory is not assessed")]
    return [_item("no truth", "No truth", f"{owner}, so accuracy is not assessed")]


def _vehicle(view: RunView) -> Items:
    """State that the vehicle's limits are the defaults; :func:`complete` keeps this where nobody has stated them."""
    v = view.config.vehicle
    if view.bundle(view.products.world_risk) is None:
        return []
    size = f"{metres(v.wheel_base)} between its axles, {metres(v.track)} between its wheels"
    why = (
        f"hazards and path are those of the {v.name}, {size}, up to {v.max_slope_deg:g}°; state yours in the manifest, "
        "or by --set vehicle.track=1.2 and the like"
    )
    return [_item("vehicle", "No vehicle was stated", why)]


def _crosscheck_off(view: RunView) -> Items:
    params = getattr(view.config, "crosscheck", None)
    if len(view.frames) < 2 or view.products.crosscheck is not None or params is None or params.enabled:
        return []
    why = "the crosscheck is switched off (crosscheck.enabled = false)"
    return [_item("crosscheck", "No second opinion on the trajectory", why)]


def _crosscheck_lost(scene: Scene) -> Items:
    """Frames that the other program was asked for and could not pose."""
    view, compared = scene.view, scene.comparison
    # a task that failed or was skipped has its own line
    lost = [] if compared is None or len(view.frames) < 2 else frames_of(view, ~compared.registered)
    if not lost:
        return []
    meta = facts_of(view, view.products.crosscheck)
    reasons = [f"COLMAP has no pose of {frame_words(lost)}"]
    if len(meta.get("pieces") or ()) > 1:
        reasons.append(f"its trajectory falls into {len(meta['pieces'])} pieces, each laid on ours by itself")
    reasons += meta.get("reasons") or ()
    what = f"{len(lost)} of {len(view.frames)} frames are not compared with another program"
    return [_item("crosscheck", what, "; ".join(dict.fromkeys(reasons)))]


def _item(kind: str, what: str, why: str) -> dict[str, str]:
    return {"kind": kind, "what": what, "why": why}
