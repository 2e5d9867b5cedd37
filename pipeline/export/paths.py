"""The path over the merged terrain as a file for GIS programs."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.writers import ENGINEERING_CRS, FRAME, axes
from rille.stages.core.declare import Bundle

LINE_Z, POINT_Z = 1002, 1001
"""Geometry types of ISO 19125 well-known binary."""

GPKG_DATE = "2000-01-01T00:00:00.000Z"
"""Written as time of change into every GeoPackage, so that equal paths make equal files."""


def write_path(path: Path, planned: Bundle, place: Georeference | None = None) -> None:
    """Write a path as GeoPackage: layers ``path`` (line) and ``ends`` (start, target).

    Parameters
    ----------
    planned : ``path`` (vertex, xyz) metres, world frame; where no path was found it is empty, the layer ``path`` holds
        a feature without geometry, and there is no layer ``ends``. Its facts that are a text, a number or a truth value
        are properties of the line.
    place : of the world frame; the coordinates are then those of its CRS, else of the engineering CRS.
    """
    import pyogrio
    from pyogrio.raw import write

    # SpatiaLite, which nothing here needs, would look for PROJ's data in the current folder.
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": GPKG_DATE, "SPATIALITE_LOAD": "NO"})
    facts = {"name": "path", "frame": FRAME, "axes": axes(place), "unit": "m", **planned.meta}
    facts = {name: value for name, value in facts.items() if isinstance(value, str | int | float)}
    columns = [np.array([value], dtype=object if isinstance(value, str) else None) for value in facts.values()]
    common = {"driver": "GPKG", "crs": ENGINEERING_CRS if place is None else place.crs}
    vertices = np.asarray(planned["path"]) if place is None else place.apply(np.asarray(planned["path"]))
    line = np.array([_wkb(LINE_Z, vertices) if len(vertices) > 1 else None], dtype=object)
    with atomic.replacing(path) as temporary:
        write(temporary, line, columns, list(facts), layer="path", geometry_type="LineString Z", **common)
        if len(vertices):
            ends = np.array([_wkb(POINT_Z, vertices[at]) for at in (0, -1)], dtype=object)
            names = [np.array(["start", "target"], dtype=object)]
            write(temporary, ends, names, ["name"], layer="ends", geometry_type="Point Z", append=True, **common)


def _wkb(kind: int, points: NDArray[np.float64]) -> bytes:
    """Well-known binary, little-endian, of a point (3,) or a line (n, 3)."""
    count = struct.pack("<I", len(points)) if kind == LINE_Z else b""
    return struct.pack("<BI", 1, kind) + count + np.ascontiguousarray(points, dtype="<f8").tobytes()


OUTPUTS = (
    Output(
        "path.gpkg",
        "path over the merged terrain, its start and target, with their coordinate system",
        "QGIS, GDAL",
        write_path,
        lambda run: {"planned": run.products.world_path, "place": run.sequence.georeference},
        "world",
    ),
)
STAGE = stage("output.paths", "The path as a file", OUTPUTS)
