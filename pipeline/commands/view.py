"""``rille view RUN``: the report of a run in the browser."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path

from rille.pipeline.runs import lookup
from rille.stages.core.errors import ConfigError


def view(run: Path) -> int:
    """Open the report where there is a screen, and print its path; gives the exit code.

    Raises
    ------
    ConfigError
        The run has none.
    """
    page = run / "report.html"
    if not page.is_file():
        raise ConfigError("RIL-891", f"run {lookup.name(run)} has no report", remedy="run the same command again")
    # Over SSH there may be a text browser, which would take the terminal.
    if sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        webbrowser.open(page.resolve().as_uri())
    print(page)
    return 0
