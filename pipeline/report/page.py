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
from rille.pipeline.engine.runtime.private import private_folder
from rille.pipeline.export.catalogue import listed
from rille.pipeline.export.view import RunView
from rille.pipeline.report.canvas import Figure
from rille.pipeline.report.summary import summarise
from rille.stages.core.quantities import metres, number, quantity, spans
from rille.stages.hazard.measures import MEASURES


def write_report(folder: Path, view: RunView, facts: Mapping[str, Any], figures: Sequence[Figure]) -> dict[str, Any]:
    """Write ``report.json`` and ``report.html``, each whole or not at all; give what the former holds.

    Parameters
    ----------
    folder : the run's folder; what it holds already is listed and explained in the report.
    view : the run.
    facts : as :func:`rille.pipeline.report.summary.collect` gives them.
    figures : in the order of the page.
    """
    whole = summarise(view, facts, figures)
    # RFC 8259 has no NaN: better an error here than a file that only Python reads.
    atomic.write(folder / "report.json", json.dumps(whole, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    atomic.write(folder / "report.html", render(view, whole, figures, list(listed(folder))))
    return whole


def render(
    view: RunView, facts: Mapping[str, Any], figures: Sequence[Figure], files: Sequence[tuple[str, str, str]]
) -> str:
    """The page as text; ``files``: name, what it is, and what opens it."""
    from jinja2 import Environment, FileSystemBytecodeCache, PackageLoader, StrictUndefined

    env = Environment(
        loader=PackageLoader("rille.pipeline.report", "."),
        extensions=["jinja2.ext.do"],
        # Names of files and cameras come from who wrote the data: they must not become markup.
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # Compiling the page takes as long as looking up 500 artifacts.
        bytecode_cache=FileSystemBytecodeCache(str(private_folder())),
    )
    env.filters |= {"quantity": quantity, "number": number, "metres": metres, "spans": spans}
    scripts = "map_profile.js", "map_space.js", "map.js"  # of the map: the last one calls the others
    return env.get_template("template.html").render(
        facts=facts,
        run=view,
        blocks={figure.title: figure.block for figure in figures if figure.block is not None},
        known={name: metric for name, metric in facts["metrics"].items() if metric["value"] is not None},
        files=files,
        measures=MEASURES,
        script="".join(resources.files("rille.pipeline.report").joinpath(name).read_text("utf-8") for name in scripts),
    )
