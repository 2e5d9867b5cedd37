"""Writes ``report.json`` and ``report.html`` into a run's folder; the page is one file that opens from disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline.products import write_text
from pipeline.report import gallery, summary, tables
from pipeline.report.block import Gallery
from pipeline.report.gather import Scene
from pipeline.report.view import RunView
from pipeline.report.words import coordinate, metres, number, quantity, seconds, share


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


def render(scene: Scene, facts: Mapping[str, Any], drawn: Gallery, files: list[tuple[str, str, str]]) -> str:
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
        true_mean=facts["truth"]["used"],
        compared=scene.comparison is not None,
    )
