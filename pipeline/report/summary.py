"""``report.json``: the metrics with unit, truth and how each was obtained; what is missing; stages; versions."""

from __future__ import annotations

from typing import Any

from pipeline.report import seams, tables
from pipeline.report.block import Gallery
from pipeline.report.gather import Scene
from pipeline.report.metrics import metrics
from pipeline.report.view import RunView
from pipeline.report.words import spans

FORMAT = 1
"""Raised when the meaning of a key of report.json changes."""

NO_HOLES = ("no truth", "no path", "crosscheck")
"""Kinds of what is missing that are answers, or lie outside of the reconstruction: the run is complete with them."""


def summarise(scene: Scene, gallery: Gallery) -> dict[str, Any]:
    """Everything that ``report.json`` holds; the page is rendered from the same numbers."""
    view = scene.view
    frames, pairs = tables.frames(scene), tables.pairs(scene)
    missing = find_missing(scene, frames, gallery)
    holes = [m for m in missing if m["kind"] not in NO_HOLES]
    assessed = any(_truth(view))
    rows, together = tables.table_2(view)
    return {
        "format": FORMAT,
        "run": view.run_id,
        "started": view.started,
        "command": view.command,
        "complete": not holes,
        "verdict": _verdict(view, frames, pairs, missing),
        "missing": missing,
        "warnings": find_warnings(scene),
        "seams": seams.facts(scene),
        "sequence": _sequence(view),
        "truth": {"used": assessed, "source": view.sequence.truth_source if assessed else "no truth"},
        "metrics": metrics(scene, frames, pairs),
        "stages": _stages(view),
        "table_2": [vars(t) for t in (*rows, together)],
        "frames": frames,
        "pairs": pairs,
        "seconds": round(view.seconds, 3),
        "versions": dict(view.versions),
        "vehicle": {**view.config.vehicle.model_dump(mode="json"), "source": view.vehicle_source},
        "notes": list(dict.fromkeys([*view.sequence.notes, *view.notes])),
    }


def find_missing(scene: Scene, frames: list[dict[str, Any]], gallery: Gallery) -> list[dict[str, str]]:
    """What a reader might take for granted and is not there: ``kind``, ``what``, ``why``."""
    view = scene.view
    found = [_missing("failed", t.label, t.reason) for t in view.tasks if t.status == "failed"]
    skipped = [t for t in view.tasks if t.status not in ("computed", "cached", "failed")]
    for reason in dict.fromkeys(t.reason for t in skipped):
        labels = [t.label for t in skipped if t.reason == reason]
        more = f" and {len(labels) - 6} more" if len(labels) > 6 else ""
        found.append(_missing("skipped", ", ".join(labels[:6]) + more, reason or "something it depends on is missing"))
    lost = [r["frame"] for r in frames if not r["posed"]]
    if lost:
        found.append(_missing("no pose", f"{len(lost)} of {len(frames)} frames have no pose", _which(lost)))
    apart = [r["frame"] for r in frames if r["posed"] and not r["in_world"]]
    if apart:
        what = f"{len(apart)} of {len(frames)} frames have a pose in another piece of the trajectory, not in the world"
        found.append(_missing("piece", what, _which(apart)))
    found += _path_missing(view)
    found += _truth_missing(view)
    found += _crosscheck_missing(scene)
    found += [_missing("figure", title, reason) for title, reason in gallery.absent]
    return found


def _which(frames: list[int]) -> str:
    return f"frame{'s' if len(frames) > 1 else ''} {spans(frames)}"


def _truth(view: RunView) -> list[bool]:
    """Whether each chosen frame has a true pose."""
    truth = view.sequence.truth
    return [truth is not None and truth[frame] is not None for frame in view.frames]


def _truth_missing(view: RunView) -> list[dict[str, str]]:
    known = _truth(view)
    if view.sequence.truth is None:
        return [_missing("no truth", "No truth", "the sequence has none, so accuracy is not assessed")]
    gaps = [frame for frame, there in zip(view.frames, known, strict=True) if not there]
    if not any(known):
        return [_missing("no truth", "No truth", "it has none for the chosen frames, so accuracy is not assessed")]
    return [_missing("no truth", f"{len(gaps)} of {len(known)} frames have no truth", _which(gaps))] if gaps else []


def _crosscheck_missing(scene: Scene) -> list[dict[str, str]]:
    """Frames that the other program could not pose, or that nothing was compared at all."""
    view, compared = scene.view, scene.comparison
    if len(view.frames) < 2:
        return []
    if view.products.crosscheck is None:
        params = getattr(view.config, "crosscheck", None)
        off = params is not None and not params.enabled
        why = "the crosscheck is switched off (crosscheck.enabled = false)"
        return [_missing("crosscheck", "No second opinion on the trajectory", why)] if off else []
    if compared is None:
        return []  # the task that failed or was skipped says why
    lost = [frame for frame, there in zip(view.frames, compared.registered, strict=True) if not there]
    if not lost:
        return []
    joined = view.bundle(view.products.crosscheck)
    meta = {} if joined is None else joined.meta
    reasons = [f"COLMAP has no pose of {_which(lost)}"]
    if len(meta.get("pieces") or ()) > 1:
        reasons.append(f"its trajectory falls into {len(meta['pieces'])} pieces, each laid on ours by itself")
    reasons += [str(w["reason"]) for w in meta.get("windows") or () if w.get("reason")]
    what = f"{len(lost)} of {len(view.frames)} frames are not compared with another program"
    return [_missing("crosscheck", what, "; ".join(dict.fromkeys(reasons)))]


def find_warnings(scene: Scene) -> list[str]:
    """What is suspicious but possible, one line each: of the input, the rig, the choice of pairs, the comparison."""
    view = scene.view
    lines = list(view.sequence.warnings)
    lines += scene.calibration.collected("warnings") if scene.calibration is not None else []
    p = view.products
    for handle in (
        p.continuity,
        p.select,
        p.refined,
        *p.crosschecks,
        p.crosscheck,
        p.agreement,
        p.trajectory,
        p.accuracy,
        p.seam_audit,
    ):
        bundle = view.bundle(handle)
        lines += (bundle.meta.get("warnings") or []) if bundle is not None else []
    compared = scene.comparison
    if compared is not None and compared.flagged.any():
        bad = [frame for frame, flagged in zip(view.frames, compared.flagged, strict=True) if flagged]
        share = f"{len(bad)} of {len(view.frames)} frames"
        lines.append(f"trajectory and COLMAP disagree more than elsewhere at {share}: {_which(bad)}")
    return list(dict.fromkeys(" ".join(str(line).split()) for line in lines))


def _path_missing(view: RunView) -> list[dict[str, str]]:
    drive = view.products.drive
    if drive is not None:
        return [] if drive.verdict == "goal" else [_missing("no path", f"Drive: {drive.verdict}", drive.reason)]
    path = view.bundle(view.products.path)
    if path is None:
        return [_missing("no path", "No path", "the path over the merged terrain was not computed")]
    if not path.meta.get("found"):
        row, y = path.meta.get("blocking_row"), path.meta.get("blocking_y")
        where = "" if row is None else f"; blocked at row {row}" + ("" if y is None else f", {y:.3g} m ahead")
        return [_missing("no path", "No path", (path.meta.get("reason") or "the far row cannot be reached") + where)]
    return []


def _missing(kind: str, what: str, why: str) -> dict[str, str]:
    return {"kind": kind, "what": what, "why": why}


def _verdict(
    view: RunView, frames: list[dict[str, Any]], pairs: list[dict[str, Any]], missing: list[dict[str, str]]
) -> str:
    """One line: what there is, of how much."""
    posed, placed = (sum(r[key] for r in frames) for key in ("posed", "in_world"))
    models = sum(r["modelled"] for r in pairs)
    apart = f", {placed} of them in the world" if placed < posed else ""
    path = view.bundle(view.products.path)
    length = None if path is None else path.meta.get("length_m")
    parts = [
        "one stereo pair" if len(frames) == 1 else f"{posed} of {len(frames)} frames posed{apart}",
        f"{models} of {len(pairs)} elevation models",
        _way_words(view, length),
        *([] if any(_truth(view)) else ["not assessed against truth"]),
    ]
    failures = sum(m["kind"] in ("failed", "skipped") for m in missing)
    return ("Incomplete: " if failures or placed < len(frames) else "Complete: ") + ", ".join(parts) + "."


def _way_words(view: RunView, length: float | None) -> str:
    """What came of the path, or of the drive."""
    if view.products.drive is not None:
        drive = view.products.drive
        return f"{drive.verdict} after {len(drive.stops)} stops" + (f" ({drive.reason})" if drive.reason else "")
    return "no path" if length is None else f"a path of {length:.3g} m"


def _sequence(view: RunView) -> dict[str, Any]:
    s = view.sequence
    left = s.rig.left
    return {
        "name": s.name,
        "frames": len(view.frames),
        "frames_of_sequence": s.frames,
        "first": view.frames[0],
        "last": view.frames[-1],
        "image_width_px": left.width,
        "image_height_px": left.height,
        "focal_length_px": left.fx,
        "baseline_m": s.rig.baseline,
        "basic_pairs": sorted(view.products.disparity),
    }


def _stages(view: RunView) -> dict[str, dict[str, Any]]:
    """By stage: tasks computed and cached in this run; seconds of the former, and of all when they were computed."""
    found: dict[str, dict[str, Any]] = {}
    for t in view.tasks:
        zero = {"computed": 0, "cached": 0, "failed": 0, "skipped": 0, "seconds": 0.0, "seconds_when_computed": 0.0}
        row = found.setdefault(t.stage, zero)
        row[t.status] = row.get(t.status, 0) + 1
        row["seconds"] += (t.seconds or 0.0) if t.status == "computed" else 0.0
        row["seconds_when_computed"] += t.seconds or 0.0
    for row in found.values():
        row["seconds"], row["seconds_when_computed"] = round(row["seconds"], 3), round(row["seconds_when_computed"], 3)
    return found
