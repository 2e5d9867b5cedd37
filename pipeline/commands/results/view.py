"""``rille view RUN``: the report of a run in the browser."""

from __future__ import annotations

import os
import sys

from rille.pipeline import api
from rille.pipeline.commands.options import COMPLETE, RUNS, Run, Runs


def view(run: Run = "latest", *, runs: Runs = RUNS) -> int:
    """Open the report of a run in the browser; print its path."""
    opened = api.open_run(run, runs)
    page = opened.file("report.html")
    # Over SSH there may be a text browser, which would take the terminal.
    if sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        opened.show()
    print(page)
    return COMPLETE
