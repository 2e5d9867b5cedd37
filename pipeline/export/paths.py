"""The path over the merged terrain as files for GIS programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.writers import write_path_geojson, write_path_gpkg
from rille.stages.core.declare import Bundle


def _facts(path: Bundle) -> dict[str, Any]:
    return {k: v for k, v in path.meta.items() if not isinstance(v, dict)}


def _write_gpkg(path: Path, view: Any) -> None:
    planned = view.bundle(view.products.world_path)
    write_path_gpkg(path, np.asarray(planned["path"]), _facts(planned), view.sequence.georeference)


def _write_geojson(path: Path, view: Any) -> None:
    planned = view.bundle(view.products.world_path)
    write_path_geojson(path, np.asarray(planned["path"]), _facts(planned))


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
    Output(
        "path.geojson",
        "the same in metres of the world frame (not longitude and latitude)",
        "any text editor, QGIS",
        _write_geojson,
        ("world_path",),
        frame="world",
        facts={"crs": "none: local metres, not WGS 84", "coordinates": "x y z, m"},
    ),
)
STAGE = stage("output.paths", "The path as files", OUTPUTS)
