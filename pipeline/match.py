"""``rille match``: any two images to a two-band disparity TIFF, without calibration or rectification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline import config as configuration
from stages.errors import ConfigError


def match_files(
    left: Path, right: Path, output: Path, *, preset: str | None, dense: bool, assignments: tuple[str, ...]
) -> int:
    """Match two image files and write ``column_disparity`` and ``row_disparity``, float32 pixels, NaN undefined.

    Without ``dense`` only what was matched and found consistent is written; with it, filled values too.

    Raises
    ------
    ConfigError
        An assignment is not one of the matcher's.
    InputError
        An image cannot be read.
    """
    from datasets.files import read_grey
    from pipeline.products import write_disparity

    params = matcher_params(preset, assignments)
    images = read_grey(left), read_grey(right)

    from stages.hfvm import match
    from stages.validity import matched

    found = match(*images, params)
    kept = np.isfinite(found.column_disparity) if dense else matched(found.validity)
    column = np.where(kept, found.column_disparity, np.nan)
    row = np.where(kept, found.row_disparity, np.nan)
    write_disparity(output, column, row, {"LEFT": left.name, "RIGHT": right.name, "FILLED": str(dense).lower()})
    share = float(matched(found.validity).mean())
    print(f"{output}  matched {100 * share:.1f} %, defined {100 * float(kept.mean()):.1f} % of {kept.size} pixels")
    return 0


def matcher_params(preset: str | None, assignments: tuple[str, ...]) -> Any:
    """Parameters of the matcher from ``--preset`` and ``--set hfvm.key=value``."""
    nested = configuration.parse_assignments(assignments)
    if set(nested) - {"hfvm"}:
        other = next(k for k in nested if k != "hfvm")
        raise ConfigError(f"--set {other}: match has the section hfvm only", remedy="write --set hfvm.key=value")
    values: dict[str, Any] = dict(nested.get("hfvm", {}))
    if preset is not None:
        values["preset"] = preset
    return configuration.validate(configuration.stage("hfvm").params, values, ("hfvm",))
