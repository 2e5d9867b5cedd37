"""Rows of the report as plain facts: frames, basic pairs, stops of a drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.pipeline.export.view import RUN, chain
from rille.pipeline.report import gather
from rille.pipeline.report.gather import facts_of
from rille.stages.odometry.resection.loop import closure

Row = dict[str, Any]


def frames(scene: gather.Scene) -> list[Row]:
    """One row a chosen frame: how its pose was found, how well, and how far it is from the truth."""
    view, track = scene.view, scene.track
    # Of a key frame those of the segment that posed it, the one before, come first.
    facts = dict[int, Mapping[str, Any]]()
    for handle in view.products.resections:
        for item in facts_of(view, handle).get("per_frame", ()):
            facts.setdefault(int(item["frame"]), item)
    names, compared = view.sequence.frame_names, scene.comparison
    rows = []
    for i, frame in enumerate(view.frames):
        fact = facts.get(frame, {})
        rows.append(
            {
                "frame": frame,
                "name": names[frame] if frame < len(names) else str(frame),
                "posed": bool(track.piece[i] >= 0),
                "in_world": bool(track.in_world[i]),
                "piece": int(track.piece[i]) + 1 if track.piece[i] >= 0 else None,
                "segment": int(track.segment[i]) if track.segment[i] >= 0 else None,
                "landmarks": fact.get("landmarks"),
                "inliers": fact.get("inliers"),
                "rms_px": fact.get("rms_px"),
                "x_m": finite(track.left[i, 0]),
                "y_m": finite(track.left[i, 1]),
                "z_m": finite(track.left[i, 2]),
                "sigma_m": finite(track.sigma[i]),
                "error_m": None if track.error is None else finite(track.error[i]),
                "disagreement_m": None if compared is None else finite(compared.distance[i]),
                "disagreement_deg": None if compared is None else finite(np.degrees(compared.angle[i])),
                "step_disagreement_m": None if compared is None else finite(compared.step_distance[i]),
                "step_disagreement_deg": None if compared is None else finite(np.degrees(compared.step_angle[i])),
                "crosscheck_error_m": None if compared is None else finite(compared.error_crosscheck[i]),
                "flagged": compared is not None and bool(compared.flagged[i]),
                "basic": frame in view.products.disparity,
            }
        )
    if rows and rows[0]["in_world"]:  # the first frame is the world's origin: nothing was resected
        rows[0]["rms_px"] = rows[0]["segment"] = None
    return rows


def loops(scene: gather.Scene) -> dict[str, list[Row]]:
    """Rows of places that were seen again, and of frames that look alike but were refused; none without loops."""
    p, bundle = scene.view.products, scene.view.bundle
    chained, adjusted, seen = bundle(p.chained), bundle(p.trajectory), [bundle(handle) for handle in p.loops]
    if chained is None or adjusted is None:
        return {}
    facts = [one.meta for one in seen if one is not None]
    rows = [
        {**{key: f[key] for key in ("from", "to", "source")}, **closure(f, chained, adjusted)._asdict()}
        for meta in facts
        for f in meta["factors"]
        if all(np.isfinite(adjusted["poses"][adjusted.meta["frames"].index(f[end])]).all() for end in ("from", "to"))
    ]
    return {"loops": rows, "loops_refused": [row for meta in facts for row in meta["refused"]]}


P = RUN.products
OF_PAIRS = (
    *(P.keyframes, P.screening, P.orientations, P.disparity, P.level, P.local_dem, P.local_risk, P.local_path),
    *(P.disparity_accuracy, P.local_dem_accuracy, P.seams),
)
"""Products that :func:`pairs` reads."""


def pairs(scene: gather.Scene) -> list[Row]:
    """One row a basic pair: choice, matching, rig, levelling, elevation model, local hazards and path."""
    view, p = scene.view, scene.view.products
    choice = facts_of(view, p.keyframes)
    tracked = chain(view)
    numbers = [tracked[i] for i in choice.get("basic", ())]
    overlap, why = (dict(zip(numbers, choice.get(key) or (), strict=False)) for key in ("overlap", "why"))
    rows = list[Row]()
    for pair, handle in p.disparity.items():
        disparity, before = view.bundle(handle), rows[-1]["frame"] if rows else None
        seams = facts_of(view, p.seams.get(pair)).get("seams", ())
        difference: Row = next((seam for seam in seams if seam["other"] == before), {})
        dem, path = facts_of(view, p.local_dem.get(pair)), facts_of(view, p.local_path.get(pair))
        shares = facts_of(view, p.local_risk.get(pair)).get("shares", {})
        judged = facts_of(view, p.local_dem_accuracy.get(pair)).get("metrics", {})
        matching = facts_of(view, p.disparity_accuracy.get(pair)).get("metrics", {})
        rows.append(
            {
                "frame": pair,
                "matched": None if disparity is None else float(np.mean(np.asarray(disparity["validity"]) & 1)),
                "vertical": facts_of(view, p.level.get(pair)).get("source"),
                "modelled": view.bundle(p.local_dem.get(pair)) is not None,
                "defined": dem.get("defined"),
                "coverage": dem.get("coverage"),
                "sigma_m": dem.get("median_elevation_std"),
                "hazardous": shares.get("hazardous"),
                "unknown": shares.get("unknown"),
                "path": ("found" if path["found"] else path.get("reason") or "none") if path else None,
                "path_m": path.get("length_m"),
                "path_end": path.get("ended_by"),
                "blocked_m": path.get("blocking_y"),
                "rmse_m": judged.get("rmse", {}).get("value"),
                "completeness": judged.get("completeness", {}).get("value"),
                "tilt_deg": judged.get("tilt", {}).get("value"),
                "against_truth": {"disparity": matching, "elevation": judged},
                "why_basic": why.get(pair),
                "overlap": overlap.get(pair),
                "epipolar_px": facts_of(view, p.orientations.get(pair)).get("residual_before_px"),
                "difference_m": difference.get("bias"),
                "difference_deviation_m": difference.get("noise"),
            }
        )
    return rows


def stops(scene: gather.Scene) -> list[Row]:
    """One row a stop of a drive: the leg that follows it, and the error of the position there."""
    view, track, rows = scene.view, scene.track, []
    for stop in gather.stops(view):
        leg, at = facts_of(view, stop.leg), view.frames.index(stop.frame)
        off = None if track.truth is None else float(np.hypot(*(track.left[at] - track.truth[at])[:2]))
        rows.append(
            {
                "stop": stop.index,
                "frame": stop.frame,
                "left_m": leg["left_m"],
                "decision": leg["verdict"],
                "leg_m": leg["length_m"],
                "error_m": finite(off),
                "event": stop.event,
            }
        )
    return rows


def finite(value: Any) -> float | None:
    """A number that JSON can hold, or None."""
    return float(value) if value is not None and np.isfinite(value) else None
