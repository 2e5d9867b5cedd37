"""The path over the merged terrain as a file for GIS programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.writers import write_path_gpkg


def _write_gpkg(path: Path, view: Any) -> None:
    planned = view.bundle(view.products.world_path)
    write_path_gpkg(path, np.asarray(planned["path"]), planned.meta, view.sequence.georeference)


OUTPUTS = (
    Output(
        "path.gpkg",
        "path over the merged terrain, its start and target, with their coordinate system",
        "QGIS, GDAL",
        _write_gpkg,
        ("world_path",),
        knows=("sequence.georeference",),
        frame="world",
        facts={"crs": "engineering CRS, metres", "coordinates": "x y z, m"},
    ),
)
STAGE = stage("output.paths", "The path as a file", OUTPUTS)
