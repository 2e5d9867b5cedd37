"""The path over the merged terrain as a file for GIS programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rille.datasets.georeference import Georeference
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.writers import write_path_gpkg
from rille.stages.core.declare import Bundle


def _write_gpkg(path: Path, planned: Bundle, place: Georeference | None = None) -> None:
    write_path_gpkg(path, np.asarray(planned["path"]), planned.meta, place)


OUTPUTS = (
    Output(
        "path.gpkg",
        "path over the merged terrain, its start and target, with their coordinate system",
        "QGIS, GDAL",
        _write_gpkg,
        lambda run: {"planned": run.products.world_path, "place": run.sequence.georeference},
        "world",
    ),
)
STAGE = stage("output.paths", "The path as a file", OUTPUTS)
