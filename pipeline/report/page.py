"""Writes ``report.json`` and ``report.html`` into a run's folder; the page is one file that opens from disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from pipeline.export.writers import write_text
from pipeline.report import gallery, summary, tables
from pipeline.report.block import Block, Gallery
from pipeline.report.gather import Scene
from pipeline.report.view import RunView
from pipeline.report.words import coordinate, metres, number, quantity, seconds, share


@dataclass(frozen=True)
class Drawn:
    """What takes the time of a report: figures, and facts gathered from the artifacts."""

    scene: Scene
    gallery: Gallery
    facts: Mapping[str, Any]


def draw(view: RunView, drawn: Mapping[str, Block] | None = None) -> Drawn:
    """Figures and facts of a run; needs none of its files. Figures ``drawn`` before (by title) are taken over."""
    # Opening an artifact reads its manifest; a few stay open, since several tables and figures need the same.
    scene = Scene(replace(view, bundle=lru_cache(maxsize=16)(view.bundle)))
    figures = gallery.draw(scene, drawn)
    return Drawn(scene, figures, summary.summarise(scene, figures))


def write_report(folder: Path, view: RunView, drawn: Drawn | None = None) -> None:
    """Write ``report.json`` and ``report.html``; each appears whole or not at all.

    Parameters
    ----------
    folder : the run's folder; what it holds already is listed and explained in the report.
    view : the run.
    drawn : of that run, where it was drawn before.
    """
    drawn = drawn or draw(view)
    facts = drawn.facts
    write_text(folder / "report.json", json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    write_text(folder / "report.html", render(drawn.scene, facts, drawn.gallery, tables.files(folder)))


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
        true_mean=scene.view.sequence.truth is not None and facts["truth"]["used"],
        compared=scene.comparison is not None,
    )
