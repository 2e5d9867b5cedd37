"""``accuracy.json``: all errors against truth, for programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RunView
from rille.pipeline.export.writers import write_json


def _write(path: Path, run: RunView) -> None:
    """Write the figures by the judged product; those of a pair by its frame. No file if nothing was compared."""
    p = run.products
    by_pair: dict[str, Mapping[int, Any]] = {"disparity": p.disparity_accuracy, "elevation": p.local_dem_accuracy}
    whole = {"trajectory": p.accuracy or p.position_accuracy, "merged_elevation": p.dem_accuracy, "path": p.path_check}
    figures: dict[str, Any] = {
        name: {str(pair): bundle.meta["metrics"] for pair, one in of.items() if (bundle := run.bundle(one)) is not None}
        for name, of in by_pair.items()
    }
    figures |= {name: one.meta["metrics"] for name, of in whole.items() if (one := run.bundle(of)) is not None}
    figures = {name: values for name, values in figures.items() if values}
    if figures:
        write_json(path, {"truth": run.sequence.truth_source, **figures})


def _reads(run: RunView) -> tuple[object, ...]:
    p = run.products
    by_pair = p.disparity_accuracy, p.local_dem_accuracy
    return *by_pair, p.accuracy, p.position_accuracy, p.dem_accuracy, p.path_check, run.sequence.truth_source


OUTPUTS = (
    Output(
        "accuracy.json",
        "errors against truth: of each pair's disparities and elevations, the trajectory, the merged map, the path",
        "any text editor, jq",
        _write,
        reads=_reads,
    ),
)
STAGE = stage("output.accuracy", "Errors against truth as a file", OUTPUTS)
