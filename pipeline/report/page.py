"""Writes ``report.json`` and ``report.html`` into a run's folder; the page is one file that opens from disk."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline.products import write_text
from pipeline.report import gallery, summary, tables
from pipeline.report.gather import Scene
from pipeline.report.view import RunView

SMALL = {"m": ("mm", 1000.0, 0.1), "m²": ("cm²", 10000.0, 0.01)}
"""Unit for small values: its name, the factor and the bound below which it is used."""


def write_report(folder: Path, view: RunView) -> None:
    """Write ``report.json`` and ``report.html``; each appears whole or not at all.

    Parameters
    ----------
    folder : the run's folder; what it holds already is listed and explained in the report.
    view : the run.
    """
    # Opening an artifact reads its manifest; a few stay open, since several tables and figures need the same.
    scene = Scene(replace(view, bundle=lru_cache(maxsize=16)(view.bundle)))
    drawn = gallery.draw(scene)
    facts = summary.summarise(scene, drawn)
    write_text(folder / "report.json", json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    write_text(folder / "report.html", render(scene, facts, drawn, tables.files(folder)))


def render(scene: Scene, facts: Mapping[str, Any], drawn: gallery.Gallery, files: list[tuple[str, str, str]]) -> str:
    """The page as text."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    env = Environment(
        loader=PackageLoader("pipeline.report", "."),
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
    }
    rows, together = tables.table_2(scene.view)
    return env.get_template("template.html").render(
        facts=facts,
        blocks=drawn.blocks,
        files=files,
        table_2=rows,
        together=together,
        others=tables.other_stages(scene.view),
        config_toml=scene.view.config_toml,
        true_mean=scene.view.sequence.truth is not None,
    )


def number(value: Any, digits: int = 3) -> str:
    """Value with a sensible number of digits; a dash where there is none."""
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int) or (value == int(value) and abs(value) < 1e6):
        return f"{int(value)}"
    if abs(value) < 1e-6:
        return f"{value:.0e}".replace("-", "−")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def quantity(value: Any, unit: str) -> str:
    """Value with its unit, small lengths and areas in mm and cm²."""
    if isinstance(value, float) and unit in SMALL and abs(value) < 1e-9:
        value = 0  # rounding
    if isinstance(value, int | float) and unit in SMALL and value != 0 and abs(value) < SMALL[unit][2]:
        unit, factor, _ = SMALL[unit]
        value = value * factor
    elif isinstance(value, int | float) and unit == "deg":
        return f"{number(value)}°"
    elif isinstance(value, int | float) and unit == "1":
        return f"{number(100 * value)} %"
    return f"{number(value)} {unit}".strip() if value is not None else "–"


def metres(value: Any) -> str:
    """Metres with a unit that fits."""
    return quantity(value, "m")


def coordinate(value: Any) -> str:
    """Coordinate in metres to a tenth of a millimetre."""
    return "–" if value is None else f"{round(value, 4) + 0.0:.4f}".replace("-", "−")


def share(value: Any) -> str:
    """Share as per cent."""
    return "–" if value is None else f"{100 * value:.0f} %"


def seconds(value: Any) -> str:
    """Seconds with two or three digits."""
    if value is None:
        return "–"
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 1 else f"{value:.2f}"
