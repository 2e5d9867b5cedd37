"""The path over the merged terrain as a file for GIS programs.

A GeoPackage is a SQLite file with standard tables (OGC 12-128r19), which Python can write; GDAL's writer would need a
second GDAL beside rasterio's, of 100 MB.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RUN, artifact
from rille.pipeline.export.writers import ENGINEERING_CRS, FRAME, axes
from rille.stages.core.declare import Bundle

LINE_Z, POINT_Z = 1002, 1001
"""Geometry types of ISO 19125 well-known binary."""

SCHEMA = """
PRAGMA application_id = 0x47504B47;
PRAGMA user_version = 10300;
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
  srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL UNIQUE REFERENCES gpkg_contents(table_name), column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL REFERENCES gpkg_spatial_ref_sys(srs_id),
  z TINYINT NOT NULL, m TINYINT NOT NULL, PRIMARY KEY (table_name, column_name));
INSERT INTO gpkg_spatial_ref_sys VALUES ('undefined cartesian', -1, 'NONE', -1, 'undefined', NULL);
INSERT INTO gpkg_spatial_ref_sys VALUES ('undefined geographic', 0, 'NONE', 0, 'undefined', NULL);
"""

COLUMN_TYPES = {str: "TEXT", bool: "BOOLEAN", int: "INTEGER", float: "DOUBLE"}
"""SQL types of properties."""


def write_path(path: Path, planned: Bundle, place: Georeference | None = None) -> None:
    """Write a path as GeoPackage: layers ``path`` (line) and ``ends`` (start, target).

    Parameters
    ----------
    planned : ``path`` (vertex, xyz) metres, world frame; if no path was found it is empty, the layer ``path`` holds a
        feature without geometry, and there is no layer ``ends``. Facts that are a text, a number or a truth value are
        properties of the line.
    place : of the world frame, in whose CRS the coordinates are; without it in the engineering CRS.
    """
    facts = {"name": "path", "frame": FRAME, "axes": axes(place), "unit": "m", **planned.meta}
    facts = {name: value for name, value in facts.items() if type(value) in COLUMN_TYPES}
    vertices = np.asarray(planned["path"]) if place is None else place.apply(np.asarray(planned["path"]))
    with closing(sqlite3.connect(":memory:")) as package:
        package.executescript(SCHEMA)
        crs = _enter_crs(package, place)
        _add_layer(package, "path", LINE_Z, crs, [(vertices if len(vertices) > 1 else None, facts)])
        if len(vertices):
            ends = [(vertices[0], {"name": "start"}), (vertices[-1], {"name": "target"})]
            _add_layer(package, "ends", POINT_Z, crs, ends)
        package.commit()
        content = bytearray(package.serialize())
    # Version of the SQLite library that wrote the file: zero, so that equal paths make equal files.
    content[96:100] = bytes(4)
    atomic.write(path, bytes(content))


def _enter_crs(package: sqlite3.Connection, place: Georeference | None) -> int:
    """Add the coordinate system to a GeoPackage; return its number there."""
    from rasterio.crs import CRS

    row = "INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)"
    # Each GeoPackage must define EPSG:4326.
    package.execute(row, ("WGS 84", 4326, "EPSG", 4326, CRS.from_epsg(4326).to_wkt()))
    crs = None if place is None else CRS.from_user_input(place.crs)
    number, wkt = (None, ENGINEERING_CRS) if crs is None else (crs.to_epsg(), crs.to_wkt())
    # 100 000: number of a coordinate system without an EPSG code.
    number, owner = (100_000, "NONE") if number is None else (number, "EPSG")
    package.execute(row, (wkt.split('"')[1], number, owner, number, wkt))
    return number


def _add_layer(
    package: sqlite3.Connection,
    name: str,
    kind: int,
    crs: int,
    features: Sequence[tuple[NDArray[np.float64] | None, Mapping[str, Any]]],
) -> None:
    """Add a table of features, each with its points (n, 3) or (3,), or none, and its properties."""
    kind_name = "LINESTRING" if kind == LINE_Z else "POINT"
    properties = features[0][1]
    columns = "".join(f', "{key}" {COLUMN_TYPES[type(value)]}' for key, value in properties.items())
    package.execute(f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {kind_name}{columns})")
    # Without an extent, which is optional.
    contents = "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, NULL, NULL, NULL, NULL, ?)"
    # A constant time of change, so that equal paths make equal files.
    package.execute(contents, (name, name, "2000-01-01T00:00:00.000Z", crs))
    package.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 1, 0)", (name, kind_name, crs))
    for points, values in features:
        row = (None if points is None else _geometry(kind, points, crs), *values.values())
        package.execute(f"INSERT INTO {name} VALUES (NULL{', ?' * len(row)})", row)


def _geometry(kind: int, points: NDArray[np.float64], crs: int) -> bytes:
    """GeoPackage geometry of a point (3,) or a line (n, 3): header and well-known binary, little-endian."""
    header = struct.pack("<2sBBi", b"GP", 0, 1, crs)
    count = struct.pack("<I", len(points)) if kind == LINE_Z else b""
    return header + struct.pack("<BI", 1, kind) + count + np.ascontiguousarray(points, dtype="<f8").tobytes()


OUTPUTS = (
    Output(
        "path.gpkg",
        "path over the merged terrain, its start and target, with their coordinate system",
        "QGIS, GDAL",
        lambda path, run: write_path(path, artifact(run, run.products.world_path), run.sequence.georeference),
        "world",
        (RUN.products.world_path,),
        (RUN.sequence.georeference,),
    ),
)
STAGE = stage("output.paths", "The path as a file", OUTPUTS)
