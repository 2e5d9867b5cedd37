"""Writes ``report.json`` and ``report.html`` into a run's folder; the page is one file that opens from disk.

Both are rendered by each run, since they say when it was, how long it took and what was computed anew: around figures
and facts that are cached.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.catalogue import listed
from rille.pipeline.export.view import RunView
from rille.pipeline.report import canvas, tables
from rille.pipeline.report.canvas import Figure
from rille.pipeline.report.delivery import Items
from rille.pipeline.report.summary import summarise
from rille.pipeline.report.words import coordinate, metres, number, quantity, seconds, share
from rille.stages.geometry.geometry import Rig
from rille.stages.hazard.measures import MEASURES

TILES = (
    ("frames_posed",),
    ("trajectory_drift", "agreement_rmse"),
    ("dem_merged_rmse", "elevation_sigma"),
    ("mapped_area",),
    ("path_length", "drive_path_length"),
)
"""Metrics of the opening screen: of each row the first that has a value."""

BESIDE: Mapping[str, tuple[tuple[str, str], ...]] = {
    "trajectory_drift": (("{} at the end", "trajectory_final_error"), ("of {} driven", "trajectory_path_length")),
    "agreement_rmse": (("over {}", "agreement_length"), ("{} if scale is free", "agreement_rmse_scaled")),
    "dem_merged_rmse": (("after a tilt of {} is taken out", "dem_merged_tilt"),),
    "path_length": (
        ("inclination up to {} of {limit}°", "path_inclination"),
        ("tilt up to {} of {limit}°", "path_tilt"),
        ("probability of a hazard up to {}", "path_p_hazard"),
        ("σ of elevation {} along it", "path_sigma"),
    ),
    "drive_path_length": (
        ("judged at {}", "drive_placements"),
        ("belly struck at {}", "drive_clearance_violations"),
        ("tilted beyond the limit at {}", "drive_tilt_violations"),
        ("a wheel on too high an edge at {}", "drive_step_violations"),
        ("at least {} of room under the belly", "drive_least_clearance"),
        ("tilt up to {} of {limit}°", "drive_greatest_tilt"),
        ("edges up to {}", "drive_greatest_step"),
    ),
}
"""What a tile says below its figure: words and another metric, before truth and completeness."""

CHAPTERS = (
    ("Trajectory", "trajectory", ("Crosscheck",)),
    ("Terrain", "terrain", ("Elevation error", "Overlap", "Seams", "Seam audit")),
    ("Hazards and path", "hazards", ("Drive",)),
    ("Rig", "rig-chapter", ("Rig",)),
    ("Matching", "matching", ("Stops", "Basic pairs")),
    ("Accuracy", "key-figures", ()),
    ("Times", "times", ()),
    ("The paper's figures", "paper", ("Figure 3", "Figure 6", "Figure 7", "Figure 8", "Figure 9")),
)
"""Title, anchor and figures of each chapter, in the order in which a user asks."""
SCRIPTS = ("map_profile.js", "map_space.js", "map.js")
"""Of the map: the last one calls the others."""
ALWAYS = ("trajectory", "matching", "key-figures", "times", "paper")
"""Chapters that hold more than figures."""


def write_report(folder: Path, view: RunView, facts: Mapping[str, Any], figures: Sequence[Figure]) -> Items:
    """Write ``report.json`` and ``report.html``, each whole or not at all; give what they list as missing.

    Parameters
    ----------
    folder : the run's folder; what it holds already is listed and explained in the report.
    view : the run.
    facts : as :func:`rille.pipeline.report.summary.gather` gives them.
    figures : in the order of the page.
    """
    whole = summarise(view, facts, figures)
    # RFC 8259 has no NaN: better an error here than a file that only Python reads.
    atomic.write(folder / "report.json", json.dumps(whole, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    page = render(view, whole, figures, list(listed(folder)), compared=facts["compared"])
    atomic.write(folder / "report.html", page)
    missing: Items = whole["missing"]
    return missing


def render(
    view: RunView,
    facts: Mapping[str, Any],
    figures: Sequence[Figure],
    files: list[tuple[str, str, str]],
    *,
    compared: bool,
) -> str:
    """The page as text."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    env = Environment(
        loader=PackageLoader("rille.pipeline.report", "."),
        # Names of files and cameras come from who wrote the data: they must not become markup.
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.filters |= {
        "quantity": quantity,
        "seconds": seconds,
        "number": number,
        "share": share,
        "metres": metres,
        "coordinate": coordinate,
        "themed": canvas.themed,
    }
    blocks = {figure.block.name: figure.block for figure in figures if figure.block is not None}
    chapters = [(title, anchor, [blocks[n] for n in names if n in blocks]) for title, anchor, names in CHAPTERS]
    rows, together = tables.table_2(view)
    return env.get_template("template.html").render(
        facts=facts,
        theme=canvas.theme(),
        map=blocks.get("Map"),
        chapters=[c for c in chapters if c[2] or c[1] in ALWAYS],
        tiles=_tiles(facts["metrics"], view.config.vehicle.max_slope_deg),
        tasks=len(view.tasks),
        cached=sum(t.status == "cached" for t in view.tasks),
        script="".join(resources.files("rille.pipeline.report").joinpath(name).read_text("utf-8") for name in SCRIPTS),
        files=files,
        table_2=rows,
        pair_table=tables.pair_table(facts["pairs"]),
        reasons=reasons(),
        together=together,
        others=tables.other_stages(view),
        config_toml=view.config_toml,
        true_mean=view.sequence.truth is not None and facts["truth"]["used"],
        compared=compared,
        place=view.sequence.georeference,
        cameras=_cameras(view.sequence.rig),
    )


def _cameras(rig: Rig) -> tuple[str, str]:
    """Size of the images and focal length in words, of both cameras where they differ."""
    sizes = [f"{camera.width} × {camera.height} pixels" for camera in (rig.left, rig.right)]
    lengths = [f"{number(camera.fx, 4)} px" for camera in (rig.left, rig.right)]
    return tuple(a if a == b else f"{a} (right: {b})" for a, b in (sizes, lengths))  # type: ignore[return-value]


def reasons() -> list[tuple[str, str]]:
    """Return the possible reasons of a cell's class on the map: name and description."""
    measures = [(m.name, f"{m.description} (limit: {m.limit})") for m in MEASURES]
    return [
        *measures,
        ("unknown", "too little of the wheel's window has an elevation"),
        ("unseen", "some of the ground below the vehicle has none"),
        ("filled", "the elevation was interpolated"),
        ("uncertain", "over a limit only with the standard deviations added"),
    ]


def _tiles(metrics: Mapping[str, Any], limit: float) -> list[tuple[str, str, str]]:
    """Label, figure and words of each tile; ``limit`` of slope and tilt, degrees."""
    known = {name: metric for name, metric in metrics.items() if metric["value"] is not None}
    return [_tile(found, known, limit) for names in TILES if (found := next((n for n in names if n in known), None))]


def _tile(name: str, known: Mapping[str, Any], limit: float) -> tuple[str, str, str]:
    metric = known[name]
    if name == "frames_posed":
        return metric["label"], metric["completeness"], ""
    words = [
        text.format(quantity(known[other]["value"], known[other]["unit"]), limit=number(limit))
        for text, other in BESIDE.get(name, ())
        if other in known and not (other.endswith("_violations") and known[other]["value"] == 0)
    ]
    words += ["against truth"] if metric["truth"] else []
    words += [metric["completeness"]] if metric["completeness"] else []
    label = "Disagreement with COLMAP, RMS" if name == "agreement_rmse" else metric["label"]
    return label, quantity(metric["value"], metric["unit"]), "; ".join(words)
