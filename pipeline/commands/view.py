"""``rille view RUN``: the report of a run in the browser."""

from __future__ import annotations

import os
import sys
import webbrowser

from rille.pipeline.commands.options import COMPLETE, RUNS, Run, Runs
from rille.pipeline.runs import lookup
from rille.stages.core.errors import ConfigError


def view(run: Run = "latest", *, runs: Runs = RUNS) -> int:
    """Open the report of a run in the browser; print its path."""
    folder = lookup.find(run, runs)
    page = folder / "report.html"
    if not page.is_file():
        raise ConfigError("RIL-891", f"run {lookup.name(folder)} has no report", remedy="run the same command again")
    # Over SSH there may be a text browser, which would take the terminal.
    if sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        webbrowser.open(page.resolve().as_uri())
    print(page)
    return COMPLETE
