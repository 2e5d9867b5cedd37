"""All files that a run can have, each by its row, in the order in which the report lists them."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path

from rille.pipeline.export import paths, rasters, terrain_zarr, trajectories
from rille.pipeline.export.output import Output

MADE = (trajectories, rasters, terrain_zarr, paths)
"""Modules whose outputs are tasks."""

OUTPUTS = (
    Output("report.html", "the report, one page", "any browser"),
    Output("report.json", "every number of the report, for programs", "any text editor, jq"),
    *(output for module in MADE for output in module.OUTPUTS),
    Output(
        "frames.json",
        "frames, handedness, quaternion order and units of every file; the frames' names",
        "any text editor",
    ),
    Output("config.toml", "every parameter in force; give it back with --config", "any text editor"),
    Output("ledger.jsonl", "what became of every task, a JSON object a line", "any text editor, jq"),
)


def listed(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Name, meaning and programs of all that a run's folder holds, others than these behind."""
    # The page lists itself, though it is written only after its list.
    left = {p.name for p in folder.iterdir() if not p.name.startswith(".")} | {"report.html", "report.json"}
    for output in OUTPUTS:
        for name in sorted(n for n in left if fnmatchcase(n, output.name)):
            left.remove(name)
            yield name, output.what, output.opens
    yield from ((name, "", "") for name in sorted(left))
