"""``report.json``: the metrics with unit, truth and how each was obtained; what is missing; stages; versions."""

from __future__ import annotations

from typing import Any

from pipeline.report import tables
from pipeline.report.gallery import Gallery
from pipeline.report.gather import Scene
from pipeline.report.metrics import metrics
from pipeline.report.view import RunView

FORMAT = 1
"""Raised when the meaning of a key of report.json changes."""


def summarise(scene: Scene, gallery: Gallery) -> dict[str, Any]:
    """Everything that ``report.json`` holds; the page is rendered from the same numbers."""
    view = scene.view
    frames, pairs = tables.frames(scene), tables.pairs(view)
    missing = find_missing(view, frames, gallery)
    holes = [m for m in missing if m["kind"] not in ("no truth", "no path")]
    rows, together = tables.table_2(view)
    return {
        "format": FORMAT,
        "run": view.run_id,
        "started": view.started,
        "command": view.command,
        "complete": not holes,
        "verdict": _verdict(view, frames, pairs, missing),
        "missing": missing,
        "sequence": _sequence(view),
        "truth": {"used": view.sequence.truth is not None, "source": view.sequence.truth_source or "no truth"},
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


def find_missing(view: RunView, frames: list[dict[str, Any]], gallery: Gallery) -> list[dict[str, str]]:
    """What a reader might take for granted and is not there: ``kind``, ``what``, ``why``."""
    found = [_missing("failed", t.label, t.reason) for t in view.tasks if t.status == "failed"]
    skipped = [t for t in view.tasks if t.status not in ("computed", "cached", "failed")]
    for reason in dict.fromkeys(t.reason for t in skipped):
        labels = [t.label for t in skipped if t.reason == reason]
        more = f" and {len(labels) - 6} more" if len(labels) > 6 else ""
        found.append(_missing("skipped", ", ".join(labels[:6]) + more, reason or "something it depends on is missing"))
    lost = [r["frame"] for r in frames if not r["posed"]]
    if lost:
        which = f"frame{'s' if len(lost) > 1 else ''} {_spans(lost)}"
        found.append(_missing("no pose", f"{len(lost)} of {len(frames)} frames have no pose", which))
    found += _path_missing(view)
    if view.sequence.truth is None:
        found.append(_missing("no truth", "No truth", "the sequence has none, so accuracy is not assessed"))
    found += [_missing("figure", title, reason) for title, reason in gallery.absent]
    return found


def _path_missing(view: RunView) -> list[dict[str, str]]:
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
    posed, models = sum(r["posed"] for r in frames), sum(r["modelled"] for r in pairs)
    path = view.bundle(view.products.path)
    length = None if path is None else path.meta.get("length_m")
    parts = [
        f"{posed} of {len(frames)} frames posed",
        f"{models} of {len(pairs)} elevation models",
        "no path" if length is None else f"a path of {length:.3g} m",
        *(["not assessed against truth"] if view.sequence.truth is None else []),
    ]
    failures = sum(m["kind"] in ("failed", "skipped") for m in missing)
    return ("Incomplete: " if failures or posed < len(frames) else "Complete: ") + ", ".join(parts) + "."


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


def _spans(numbers: list[int]) -> str:
    """``[1, 2, 3, 7]`` to ``1-3, 7``."""
    spans: list[list[int]] = []
    for n in numbers:
        if spans and n == spans[-1][1] + 1:
            spans[-1][1] = n
        else:
            spans.append([n, n])
    return ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in spans)
