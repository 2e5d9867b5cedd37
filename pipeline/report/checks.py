"""Figures by which a run checks itself: the rig, the choice of basic pairs, another program, overlapping models."""

from __future__ import annotations

from typing import Any

import numpy as np

from rille.pipeline.export import ranges
from rille.pipeline.export.artifacts import chain
from rille.pipeline.export.comparison import Comparison
from rille.pipeline.report import canvas, figures
from rille.pipeline.report.canvas import Block, Table
from rille.pipeline.report.gather import Calibration, Scene
from rille.pipeline.report.metrics import LABELS
from rille.pipeline.report.words import length, number, quantity, spans, spread

MOST_CURVES = 3
"""Parameters of the rig whose change over the pairs is drawn."""

MOST_FLAGS = 8
"""Flagged frames that a caption names with their reasons; agreement.csv has all."""


def rig(scene: Scene) -> Block | None:
    """Epipolar residuals under the given and the used rig, what was freed, and how each pair alone would have it."""
    found = scene.calibration
    if found is None:
        return None
    panels = _residuals(scene, found)
    drift = _drift(found)
    panels += [drift] if drift is not None else []
    facts = found.facts[0]
    sources = list(dict.fromkeys(str(f.get("source", "")) for f in found.facts if f.get("source")))
    words = [f"Used: {sources[0] if len(sources) == 1 else f'{len(found.facts)} rigs, one a basic pair'}."]
    before, after = facts.get("residual_before_px"), facts.get("residual_after_px")
    if before is not None and len(found.facts) == 1:
        words.append(
            f"The matches lie {before:.2f} px RMS off their epipolar lines under the given rig"
            + (f", {after:.2f} px under the one that was used." if found.changed and after is not None else ".")
        )
    words += _untold(scene, found)
    if panels:
        words.append(
            "In the maps the left image is divided into cells; a colour is the median distance of the right points "
            "from their epipolar lines, positive below the line (to the right of a steep one). Distances that change "
            "smoothly over the image tell of a rig (or lens) that is not as given; speckle is noise of matching."
        )
    if drift is not None:
        words.append(
            "Last: corrections that each basic pair alone would ask for, with their standard deviations"
            + ("; orange: what was used for all." if found.changed else ".")
        )
    title = "Relative orientation of the rig, " + ("before and after its repair" if found.changed else "checked")
    return Block("Rig", title, " ".join(words), tuple(panels), table=_parameters(found))


def _untold(scene: Scene, found: Calibration) -> list[str]:
    """What the images ask for but cannot tell from a principal point that is off, and what the truth says of it."""
    least = scene.view.config.rig.significance
    unsure = [
        p
        for p in found.collected("parameters")
        if not p.get("freed") and not p.get("observed") and p.get("sigma") and abs(p["asked"]) > least * p["sigma"]
    ]
    if not unsure:
        return []
    asked = ", ".join(f"{str(p['name']).replace('_', ' ')} {_signed(p['asked'], '°')}" for p in unsure)
    words = [
        f"Taken alone the images would turn the right camera ({asked}), but a principal point a few pixels off looks "
        "the same: they cannot tell, and the calibration is kept."
    ]
    accuracy = scene.view.bundle(scene.view.products.accuracy)
    scale = None if accuracy is None else accuracy.meta["metrics"].get("scale_error", {}).get("value")
    if scale is None:
        words.append("If depth matters, compare a known length.")
    else:
        off = number(abs(scale), 2)
        words.append(f"Against the truth the scale of the motions, and with it that of depth, is off by {off} %.")
    return words


def _residuals(scene: Scene, found: Calibration) -> list[canvas.Panel]:
    if not len(found.before):
        return []
    left = scene.view.sequence.rig.left
    size, bound = (left.width, left.height), max(0.3, ranges.limits(np.abs(found.before), 0, 99)[1])
    parts = [("given rig", canvas.REFERENCE, found.before)]
    parts += [("used rig", canvas.ESTIMATE, found.after)] if found.changed else []
    panels = []
    for name, _, values in parts:
        label = f"distance from epipolar line, px: {name}"
        alt = f"Epipolar residuals over the left image, {name}: {spread(values)} px"
        panels.append(figures.residual_map(found.points, values, size, bound, label, alt))
    alt = f"Distribution of epipolar residuals of {len(found.before)} matches"
    panels.append(figures.histogram(parts, bound, "distance from epipolar line, px", alt))
    return panels


def _drift(found: Calibration) -> canvas.Panel | None:
    """Corrections of each pair; None for fewer than two."""
    pairs = sorted(found.collected("per_pair"), key=lambda p: p["pair"])
    names = [name for name in (pairs[0]["values"] if pairs else ()) if all(name in p["values"] for p in pairs)]
    if len(pairs) < 2 or not names:
        return None
    values, sigmas = (
        {name: np.array([p[key][name] for p in pairs], dtype=np.float64) for name in names}
        for key in ("values", "sigma")
    )
    used: dict[str, float] = {}
    if len(found.facts) == 1:
        used = {p["name"]: float(p["value"]) for p in found.facts[0].get("parameters") or () if p.get("freed")}
    # those that were freed, then those that stand out most
    far = {name: abs(float(np.median(values[name] / np.maximum(sigmas[name], 1e-9)))) for name in names}
    shown = sorted(names, key=lambda name: (name not in used, -far[name]))[:MOST_CURVES]
    words = ", ".join(f"{name.replace('_', ' ')} {spread(values[name])} degrees" for name in shown)
    return figures.drift(
        [p["pair"] for p in pairs],
        {name: values[name] for name in shown},
        {name: sigmas[name] for name in shown},
        used,
        f"Corrections by basic pair: {words}",
    )


def _parameters(found: Calibration) -> Table | None:
    """What was freed and what was held, and why."""
    entries = found.collected("parameters")
    if not entries or len(found.facts) > 1:
        return None
    rows = []
    for p in entries:
        unit = "°" if p.get("unit") == "deg" else f" {p.get('unit', '')}"
        asked = p.get("asked")
        rows.append(
            (
                str(p["name"]).replace("_", " "),
                "freed" if p.get("freed") else "held",
                _signed(p.get("value"), unit) if p.get("freed") else "as given",
                _signed(asked, unit),
                "–" if p.get("sigma") is None else f"{p['sigma']:.4f}{unit}",
                str(p.get("why", "")).replace("+-", "±"),
            )
        )
    head = ("Parameter of the right camera", "State", "Correction used", "Images alone ask for", "σ of that", "Why")
    return Table(head, tuple(rows), (2, 3, 4))


def _signed(value: Any, unit: str) -> str:
    return "–" if value is None else f"{value:+.4f}{unit}".replace("-", "−")


def basic_pairs(scene: Scene) -> Block | None:
    """Draw which pairs became elevation models, and why."""
    view = scene.view
    bundle = view.bundle(view.products.keyframes)
    if bundle is None or len(view.frames) < 2:
        return None
    meta, tracked = bundle.meta, chain(view)
    if len(tracked) < 2:  # all others are lost: there was nothing to choose from
        return None
    pairs = [tracked[i] for i in meta.get("basic", ())]
    # None becomes NaN.
    overlap = np.array(meta.get("overlap") or [None] * len(pairs), dtype=float)
    moved = np.array(meta.get("displacement") or (), dtype=float)
    if len(moved) != len(tracked) - 1:
        moved = np.full(len(tracked) - 1, np.nan)
    params = getattr(view.config, "keyframes", None)
    wanted = params.overlap if params is not None and params.rule == "overlap" else None
    known = overlap[np.isfinite(overlap)]
    shares = f"{known.min():.0%} to {known.max():.0%}" if len(known) else "not known"
    alt = f"Overlap of successive basic pairs {shares}; displacement between frames {spread(moved)} px"
    panel = figures.basic_pairs(pairs, overlap, wanted, tracked[1:], moved, alt)
    why = _reasons(meta.get("why") or ())
    caption = (
        f"{len(pairs)} of {len(view.frames)} pairs are basic by the rule “{meta.get('rule', '')}”{why}; each became an "
        f"elevation model. First: share of what a basic pair sees that the one before saw too ({shares}), from coarse "
        "displacements before any pose was known"
        + ("; the orange line is the overlap that is wanted. " if wanted is not None else ". ")
        + "Second: median displacement of the image from the frame before, at full resolution; blue lines are the "
        "basic pairs."
    )
    return Block("Basic pairs", "Choice of the basic pairs", caption, (panel,))


def _reasons(why: Any) -> str:
    counts = {reason: list(why).count(reason) for reason in dict.fromkeys(why)}
    counts.pop("first frame", None)
    if not counts or set(counts) == {"stride"}:
        return ""
    return " (" + ", ".join(f"{n} by {reason}" for reason, n in counts.items()) + ")"


def crosscheck(scene: Scene) -> Block | None:
    """Our trajectory against another program's, frame by frame."""
    found, view = scene.comparison, scene.view
    if found is None or not found.registered.any():
        return None
    flagged = [f for f, bad in zip(view.frames, found.flagged, strict=True) if bad]
    lost = [f for f, there in zip(view.frames, found.registered, strict=True) if not there]
    shown = "#333333"
    factor, unit = canvas.metres_or_mm(found.distance)
    position = [("disagreement", shown, found.distance * factor)]
    off, off_unit = canvas.metres_or_mm(np.concatenate([found.error, found.error_crosscheck]))
    errors = [
        (name, color, error * off)
        for name, color, error in (
            ("ours", canvas.ESTIMATE, found.error),
            ("COLMAP's", canvas.OTHER, found.error_crosscheck),
        )
        if np.isfinite(error).any()
    ]
    per_step, step_unit = canvas.metres_or_mm(found.step_distance)
    turn, step_turn = ([("disagreement", shown, np.degrees(a))] for a in (found.angle, found.step_angle))
    step = [("disagreement", shown, found.step_distance * per_step)]
    poses = [
        (f"position, {unit}", position, _limit(found, "distance", factor)),
        ("rotation, °", turn, _limit(found, "angle")),
    ]
    motions = [
        (f"motion, {step_unit}", step, _limit(found, "step_distance", per_step)),
        ("rotation, °", step_turn, _limit(found, "step_angle")),
    ]
    # An axis of its own: both are aligned by the first pose here, by all of them above.
    poses += [(f"error, {off_unit}", errors, None)] if errors else []
    degrees = f"{spread(np.degrees(found.angle))} degrees"
    panels = (
        figures.disagreement(
            view.frames, poses, flagged, lost, f"Disagreement of poses: {spread(found.distance)} m, {degrees}"
        ),
        figures.disagreement(
            view.frames, motions, flagged, lost, f"Disagreement of motions: {spread(found.step_distance)} m"
        ),
    )
    legend = (
        (canvas.HAZARDOUS, f"flagged frames: {len(flagged)} (dotted: limits)"),
        (canvas.UNDEFINED, f"frames without a pose by COLMAP: {len(lost)}"),
    )
    title = "The trajectory against structure from motion (COLMAP)"
    words = _crosscheck_words(found, lost, repaired=scene.calibration is not None and scene.calibration.changed)
    return Block("Crosscheck", title, words, panels, legend=legend, table=_side_by_side(scene))


def _limit(found: Comparison, name: str, factor: float = 1.0) -> float | None:
    limit = (found.meta.get("limits") or {}).get(name)
    return None if limit is None else float(limit) * factor


def _crosscheck_words(found: Comparison, lost: list[int], *, repaired: bool) -> str:
    pieces = found.meta.get("pieces")
    several = f"Its trajectory falls into {pieces} pieces, each laid" if pieces and pieces > 1 else "It was laid"
    words = [
        "COLMAP posed the frames by its own features, matches and bundle adjustment, with both cameras as one rig; "
        "what the two answers share is the given calibration alone, which they cannot judge. "
        f"{several} on ours by one rotation and translation, without a change of scale. First: disagreement of "
        "position and rotation; second: of the motion since the frame before."
    ]
    if np.isfinite(found.error).any():
        words.append(
            "The error of either against the truth is drawn below the first, aligned by the first pose alone: these "
            "curves begin at 0 and grow, while the disagreement is spread over all frames."
        )
    if repaired:
        words.append("COLMAP has used the rig as it was given, ours was repaired: that alone makes them differ.")
    rule = found.meta.get("rule")
    words += [f"Flagged is a {rule}." if rule else ""]
    flagged = found.meta.get("flagged") or ()
    if flagged:
        each = "; ".join(f"frame {f['frame']} ({', '.join(f['why'])})" for f in flagged[:MOST_FLAGS])
        more = f" and {len(flagged) - MOST_FLAGS} more" if len(flagged) > MOST_FLAGS else ""
        words.append(f"Flagged: {each}{more}. Either of the two may be wrong there: look at the tracks.")
    if lost:
        words.append(f"Not posed by COLMAP: {spans(lost)}.")
    return " ".join(w for w in words if w)


SIDE_BY_SIDE = ("drift", "ate_rmse", "rpe_translation_rmse", "rpe_rotation_rmse", "kitti_translation", "frames_missing")


def _side_by_side(scene: Scene) -> Table | None:
    """Both trajectories against the truth."""
    p, view = scene.view.products, scene.view
    ours, theirs = (view.bundle(handle) for handle in (p.accuracy, p.crosscheck_accuracy))
    if ours is None or theirs is None:
        return None
    rows = []
    for name in SIDE_BY_SIDE:
        pair = [b.meta.get("metrics", {}).get(name) for b in (ours, theirs)]
        if all(m is not None and m["value"] is not None for m in pair):
            rows.append((LABELS[name], *(quantity(m["value"], m["unit"]) for m in pair)))
    return Table(("Against the truth", "ours", "COLMAP"), tuple(rows), (1, 2)) if rows else None


def overlaps(scene: Scene) -> Block | None:
    """Disagreement of elevation models that see the same ground."""
    world, differences = scene.world, scene.differences
    panels, words = [], []
    if world is not None and {"spread", "count"} <= world.arrays.keys():
        count = world.arrays["count"]
        several = np.where(count > 1, world.arrays["spread"], np.nan)
        known = int(np.isfinite(several).sum())
        if known:
            alt = f"Standard deviation of the merged models about their mean, {spread(several)} m"
            panels.append(figures.scalar_map(several, world.extent, "deviation of the models", alt))
            words.append(
                "First: standard deviation of the models that were merged in a cell "
                f"({known / max(int((count > 0).sum()), 1):.0%} of the mapped cells have more than one), "
                f"median {length(float(np.median(ranges.sample(several))))}."
            )
    if differences:
        rows = np.array([(d.median, d.deviation, d.predicted) for d in differences])
        alt = (
            f"Elevation differences of successive models: median {spread(rows[:, 0])} m, "
            f"deviation {spread(rows[:, 1])} m"
        )
        panels.append(figures.differences([d.pair for d in differences], rows[:, 0], rows[:, 1], rows[:, 2], alt))
        words.append(
            "Elevation of each model minus that of the one before, in the cells that both have: a median beside zero "
            "is an error of pose or rig, a deviation above the expected one is noise that the σ does not know."
        )
    if not panels:
        return None
    return Block("Overlap", "Where elevation models overlap", " ".join(words), tuple(panels))
