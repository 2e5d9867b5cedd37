"""The report's tables as plain rows: Table 2 of the paper beside this run, frames, pairs, files."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rille.pipeline.export.artifacts import chain
from rille.pipeline.export.view import RunView, TaskRow
from rille.pipeline.report import gather
from rille.pipeline.report.canvas import Table
from rille.pipeline.report.words import metres, number, quantity, share

TABLE_2: tuple[tuple[str, str, float, tuple[str, ...]], ...] = (
    ("Stereo matching (HFVM)", "one stereo pair, every pixel", 40.0, ("hfvm",)),
    ("Locus: elevation and ortho image", "one stereo pair", 20.0, ("locus/local",)),
    ("Risk map", "one local elevation model", 1.0, ("risk/local",)),
    ("Path", "one local risk map", 1.0, ("path/local",)),
    (
        "Tracking of landmarks",
        "one segment between basic pairs",
        5.0,
        ("track", "motion", "image_quality", "frame_screening", "swap_check"),
    ),
    ("Calibration update (resection)", "one segment between basic pairs", 5.0, ("resect",)),
)
"""The paper's modules, our unit of work, seconds in 1999 on a Pentium 166 MHz, and the labels of our tasks: the first
one's is one unit, further ones are its preparation (the coarse disparities of tracking, section 5.2.1)."""


@dataclass(frozen=True)
class Timing:
    """Seconds of one kind of task; ``unit`` is the median of a task with its share of preparation, or None."""

    name: str
    what: str
    in_1999: float | None
    unit: float | None
    total: float | None
    tasks: int
    computed: int
    cached: int


def _timing(
    name: str, what: str, in_1999: float | None, rows: Sequence[TaskRow], preparation: Sequence[TaskRow] = ()
) -> Timing:
    seconds = [r.seconds for r in rows if r.seconds is not None]
    by_stage: dict[str, list[float]] = defaultdict(list)
    for r in preparation:
        by_stage[r.stage] += [] if r.seconds is None else [r.seconds]
    # A median a stage: one over all tasks would fall between the short ones and the long ones.
    before = sum(statistics.median(times) * len(times) for times in by_stage.values() if times)
    return Timing(
        name,
        what,
        in_1999,
        statistics.median(seconds) + before / len(seconds) if seconds else None,
        sum(seconds) + sum(map(sum, by_stage.values())) if seconds else None,
        len(rows),
        sum(r.status == "computed" for r in rows),
        sum(r.status == "cached" for r in rows),
    )


def table_2(view: RunView) -> tuple[list[Timing], Timing]:
    """The paper's Table 2 beside this run, and its last line ("together")."""
    rows = [
        _timing(
            name,
            what,
            then,
            [t for t in view.tasks if _belongs(t.label, labels[:1])],
            [t for t in view.tasks if _belongs(t.label, labels[1:])],
        )
        for name, what, then, labels in TABLE_2
    ]
    units = [r.unit for r in rows if r.unit is not None]
    complete = len(units) == len(rows)
    together = Timing(
        "Together",
        "one cycle",
        sum(then for *_, then, _ in TABLE_2),
        sum(units) if complete else None,
        sum(r.total or 0.0 for r in rows),
        sum(r.tasks for r in rows),
        sum(r.computed for r in rows),
        sum(r.cached for r in rows),
    )
    return rows, together


def other_stages(view: RunView) -> list[Timing]:
    """Seconds of what Table 2 does not list, by the first one or two parts of the label."""
    paper = [label for *_, labels in TABLE_2 for label in labels]
    kinds: dict[str, list[TaskRow]] = {}
    for task in view.tasks:
        if not _belongs(task.label, paper):
            kinds.setdefault(_kind(task.label), []).append(task)
    return [_timing(kind, "", None, rows) for kind, rows in kinds.items()]


def _belongs(label: str, kinds: Sequence[str]) -> bool:
    return any(label == kind or label.startswith(f"{kind}/") for kind in kinds)


def _kind(label: str) -> str:
    """``pyramid/left/3`` to ``pyramid``, ``locus/world/4`` to ``locus/world``."""
    parts = label.split("/")
    split = parts[0] in ("locus", "risk", "path", "dem_accuracy") and len(parts) > 1
    return "/".join(parts[:2]) if split else parts[0]


def frames(scene: gather.Scene) -> list[dict[str, Any]]:
    """One row a chosen frame: how its pose was found, how well, and how far it is from the truth."""
    view, track = scene.view, scene.track
    facts = gather.frame_facts(view)
    names, compared = view.sequence.frame_names, scene.comparison
    rows = []
    for i, frame in enumerate(view.frames):
        fact = facts.get(frame, {})
        error = None if track.truth is None else float(np.linalg.norm(track.left[i] - track.truth[i]))
        rows.append(
            {
                "frame": frame,
                "name": names[frame] if frame < len(names) else str(frame),
                "posed": bool(track.posed[i]),
                "in_world": bool(track.in_world[i]),
                "piece": int(track.piece[i]) + 1 if track.posed[i] else None,
                "segment": int(track.segment[i]) if track.segment[i] >= 0 else None,
                "landmarks": fact.get("landmarks"),
                "inliers": fact.get("inliers"),
                "rms_px": fact.get("rms_px"),
                "x_m": finite(track.left[i, 0]),
                "y_m": finite(track.left[i, 1]),
                "z_m": finite(track.left[i, 2]),
                "sigma_m": finite(track.sigma[i]),
                "error_m": finite(error),
                "disagreement_m": None if compared is None else finite(compared.distance[i]),
                "disagreement_deg": None if compared is None else finite(np.degrees(compared.angle[i])),
                "flagged": compared is not None and bool(compared.flagged[i]),
                "basic": frame in view.products.disparity,
            }
        )
    if rows and rows[0]["in_world"]:  # the first frame is the world's origin: nothing was resected
        rows[0]["rms_px"] = rows[0]["segment"] = None
    return rows


def pairs(scene: gather.Scene) -> list[dict[str, Any]]:
    """One row a basic pair: choice, matching, rig, levelling, elevation model, local hazards and path."""
    view = scene.view
    select = view.bundle(view.products.keyframes)
    meta = {} if select is None else select.meta
    tracked = chain(view)
    numbers = [tracked[i] for i in meta.get("basic", ())]
    overlap = dict(zip(numbers, meta.get("overlap") or (), strict=False))
    why = dict(zip(numbers, meta.get("why") or (), strict=False))
    different = {d.pair: d for d in scene.differences}
    rows = []
    for pair in view.products.disparity:
        orientation = view.bundle(view.products.orientations.get(pair))
        difference = different.get(pair)
        more = {
            "why_basic": why.get(pair),
            "overlap": overlap.get(pair),
            "epipolar_px": None if orientation is None else orientation.meta.get("residual_before_px"),
            "difference_m": None if difference is None else difference.median,
            "difference_deviation_m": None if difference is None else difference.deviation,
        }
        rows.append(_pair(view, pair) | more)
    return rows


def pair_table(rows: list[dict[str, Any]]) -> Table:
    """Table of the pairs with the columns that hold anything."""
    columns = [column for column in _PAIR_COLUMNS if any(r[column[1]] is not None for r in rows)]
    cells = (["–" if r[name] is None else shown(r[name]) for _, name, shown in columns] for r in rows)
    numbers = tuple(k for k, (_, _, shown) in enumerate(columns) if shown is not str)
    return Table(tuple(head for head, _, _ in columns), tuple(map(tuple, cells)), numbers)


_PAIR_COLUMNS: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
    ("Frame", "frame", number),
    ("Chosen by", "why_basic", str),
    ("Overlap", "overlap", share),
    ("Matched", "matched", share),
    ("Off epipolar line", "epipolar_px", lambda v: quantity(v, "px")),
    ("Vertical from", "vertical", str),
    ("Cells defined", "defined", share),
    ("Median σ", "sigma_m", metres),
    ("Above the one before", "difference_m", metres),
    ("Hazardous", "hazardous", share),
    ("Unknown", "unknown", share),
    ("Path", "path", str),
    ("Length of the path", "path_m", metres),
    ("Ended by", "path_end", str),
    ("Blocked ahead at", "blocked_m", metres),
    ("RMSE", "rmse_m", metres),
    ("Completeness", "completeness", share),
)


def _pair(view: RunView, pair: int) -> dict[str, Any]:
    p = view.products
    disparity, level = view.bundle(p.disparity[pair]), view.bundle(p.level.get(pair))
    dem, risk, path = (view.bundle(d.get(pair)) for d in (p.local_dem, p.local_risk, p.local_path))
    accuracy = view.bundle(p.local_dem_accuracy.get(pair))
    assessed = {} if accuracy is None else accuracy.meta["metrics"]
    shares = {} if risk is None else risk.meta.get("shares", {})
    return {
        "frame": pair,
        "matched": None if disparity is None else float(np.mean(np.asarray(disparity["validity"]) & 1)),
        "vertical": None if level is None else level.meta.get("source"),
        "modelled": dem is not None,
        "defined": None if dem is None else dem.meta.get("defined"),
        "sigma_m": None if dem is None else dem.meta.get("median_elevation_std"),
        "hazardous": shares.get("hazardous"),
        "unknown": shares.get("unknown"),
        "path": None if path is None else ("found" if path.meta["found"] else path.meta.get("reason") or "none"),
        "path_m": None if path is None else path.meta.get("length_m"),
        "path_end": None if path is None else path.meta.get("ended_by"),
        "blocked_m": None if path is None else path.meta.get("blocking_y"),
        "rmse_m": assessed.get("rmse", {}).get("value"),
        "completeness": assessed.get("completeness", {}).get("value"),
        "tilt_deg": assessed.get("tilt", {}).get("value"),
    }


def finite(value: Any) -> float | None:
    """A number that JSON can hold, or None."""
    return float(value) if value is not None and np.isfinite(value) else None
