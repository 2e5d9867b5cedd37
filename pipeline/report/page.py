"""Writes ``report.json`` and ``report.html`` into a run's folder; the page is one file that opens from disk.

Both are rendered by each run, since they say when it was, how long it took and what was computed anew: around figures
and facts that are cached.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.catalogue import listed
from rille.pipeline.export.view import RunView
from rille.pipeline.report import tables
from rille.pipeline.report.block import Figure
from rille.pipeline.report.summary import summarise
from rille.pipeline.report.words import coordinate, metres, number, quantity, seconds, share


def write_report(folder: Path, view: RunView, facts: Mapping[str, Any], figures: Sequence[Figure]) -> None:
    """Write ``report.json`` and ``report.html``; each appears whole or not at all.

    Parameters
    ----------
    folder : the run's folder; what it holds already is listed and explained in the report.
    view : the run.
    facts : as :func:`rille.pipeline.report.summary.gather` gives them.
    figures : in the order of the page.
    """
    whole = summarise(view, facts, figures)
    atomic.write(folder / "report.json", json.dumps(whole, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    page = render(view, whole, figures, list(listed(folder)), compared=facts["compared"])
    atomic.write(folder / "report.html", page)


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
    rows, together = tables.table_2(view)
    return env.get_template("template.html").render(
        facts=facts,
        blocks=[figure.block for figure in figures if figure.block is not None],
        files=files,
        table_2=rows,
        together=together,
        others=tables.other_stages(view),
        config_toml=view.config_toml,
        true_mean=view.sequence.truth is not None and facts["truth"]["used"],
        compared=compared,
        place=view.sequence.georeference,
    )
