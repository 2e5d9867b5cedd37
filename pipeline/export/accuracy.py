"""``accuracy.json``: every error against truth that the assessing stages give, for programs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RunView
from rille.stages.core.declare import Bundle


def _assessed(run: RunView) -> dict[str, Any]:
    """What was compared with truth; it may lack any part."""
    p = run.products
    return {
        "trajectory": p.accuracy or p.position_accuracy,
        "disparity": p.disparity_accuracy,
        "elevation": p.local_dem_accuracy,
        "merged": p.dem_accuracy,
        "path_check": p.path_check,
        "source": run.sequence.truth_source,
    }


def _write(
    path: Path,
    *,
    trajectory: Bundle | None = None,
    disparity: Mapping[int, Bundle | None] | None = None,
    elevation: Mapping[int, Bundle | None] | None = None,
    merged: Bundle | None = None,
    path_check: Bundle | None = None,
    source: str = "",
) -> None:
    """Write the figures by what they judge; those of a pair by its frame. Nothing where nothing was compared."""
    by_pair = {"disparity": disparity or {}, "elevation": elevation or {}}
    found: dict[str, Any] = {
        name: {str(pair): one.meta["metrics"] for pair, one in of.items() if one is not None}
        for name, of in by_pair.items()
    }
    whole = {"trajectory": trajectory, "merged_elevation": merged, "path": path_check}
    found |= {name: one.meta["metrics"] for name, one in whole.items() if one is not None}
    found = {name: figures for name, figures in found.items() if figures}
    if found:
        text = json.dumps({"truth": source, **found}, indent=1, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")


OUTPUTS = (
    Output(
        "accuracy.json",
        "errors against truth: of each pair's disparities and elevations, the trajectory, the merged map, the path",
        "any text editor, jq",
        _write,
        _assessed,
    ),
)
STAGE = stage("output.accuracy", "Errors against truth as a file", OUTPUTS)
