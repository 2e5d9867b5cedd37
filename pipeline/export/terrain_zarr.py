"""The merged terrain as one zarr group by the CF conventions, which xarray and GDAL open.

Dimensions are y (decreasing) and x, both with their coordinates; every variable has its unit, its long name and its
frame; ``ancillary_variables`` of ``elevation`` lists the variables on its accuracy and source (standard deviation,
spread, number of models, pair of the greatest weight). The format is zarr 2, which GDAL reads since 3.4; GDAL 3.10
reads no zarr 3 of zarr-python.

The world frame is no map projection: x and y are plain axes, and a scalar coordinate ``spatial_ref`` has the
engineering CRS, as rioxarray expects it. CF has no ``grid_mapping`` for such a frame, and no standard name for heights
above the first camera, so there are none. If the sequence has a place on Earth, the attributes ``georeference_*`` state
it; ``dem.tif`` is in that place's CRS.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.rasters import plane_tag, tiles_of, whole
from rille.pipeline.export.view import RUN, RunView
from rille.pipeline.export.writers import ENGINEERING_CRS, FRAME, raster_transform
from rille.stages.core.declare import Array
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain import merge
from rille.stages.terrain.shading import slope_deg

UNITS = {"px": "1", "grey": "1"}
"""Replacements of units that UDUNITS does not know; ``quantity`` has the word."""


def write_terrain(
    path: Path,
    arrays: Mapping[str, tuple[Array, NDArray[Any]]],
    lattice: Lattice,
    place: Georeference | None,
    facts: Mapping[str, Any],
) -> None:
    """Write the arrays (rows, cols) of a terrain, whole or not at all.

    Parameters
    ----------
    arrays : declaration and values by name.
    lattice : of the cells, world frame.
    place : of the world frame, if known.
    facts : attributes of the whole group, e.g. ``title``, ``source``.
    """
    import xarray

    where = {} if place is None else {f"georeference_{name}": value for name, value in place.to_dict().items()}
    about = {"Conventions": "CF-1.11", "frame": FRAME, **facts, "cell_size_m": lattice.cell, **where}
    variables = {name: (("y", "x"), values, _attributes(spec)) for name, (spec, values) in arrays.items()}
    others = [name for name in arrays if name not in ("elevation", "ortho", SLOPE.name)]
    variables["elevation"][2].update(positive="up", ancillary_variables=" ".join(others))
    # Codecs of every GDAL build; for coordinates too, since zarr's default changes with its version.
    encoding: dict[str, Any] = {name: {"compressors": numcodecs.Blosc()} for name in ("x", "y", "spatial_ref")}
    encoding |= {name: {"compressors": numcodecs.Zlib(level=1)} for name in arrays}
    for name, (spec, values) in arrays.items():
        encoding[name]["chunks"] = tuple(min(n, 512) for n in values.shape)
        encoding[name]["_FillValue"] = np.nan if values.dtype.kind == "f" else int(spec.nodata) if spec.nodata else None
    # zarr warns that other readers may not know consolidated metadata.
    with atomic.replacing(path) as folder, warnings.catch_warnings(action="ignore"):
        terrain = xarray.Dataset(variables, _coordinates(lattice), about)
        terrain.to_zarr(folder, zarr_format=2, consolidated=True, encoding=encoding, write_empty_chunks=True)


def _attributes(spec: Array) -> dict[str, Any]:
    about: dict[str, Any] = {"units": UNITS.get(spec.unit, spec.unit), "long_name": spec.long_name}
    about |= {"quantity": spec.unit} if spec.unit in UNITS else {}
    # _CRS is GDAL's attribute for the CRS of a zarr array.
    return about | {"frame": spec.frame or "world", "_CRS": {"wkt": ENGINEERING_CRS}}


def _coordinates(lattice: Lattice) -> dict[str, Any]:
    reference = {
        # crs_wkt is CF's name, spatial_ref GDAL's: readers expect either.
        "crs_wkt": ENGINEERING_CRS,
        "spatial_ref": ENGINEERING_CRS,
        "long_name": "Rille world frame (local metres)",
        "GeoTransform": " ".join(f"{v:.17g}" for v in raster_transform(lattice, None).to_gdal()),
    }
    coordinates: dict[str, Any] = {"spatial_ref": ((), np.int32(0), reference)}
    for axis, values, words in (("x", lattice.xs(), "right"), ("y", lattice.ys(), "ahead")):
        about = {"units": "m", "axis": axis.upper(), "long_name": f"{axis} of the cell centre, world frame, {words}"}
        coordinates[axis] = (axis, values, about)
    return coordinates


SLOPE = Array("slope", ("row", "col"), "float32", "degree", "inclination of the terrain", "nan", "world")


def _write_output(path: Path, run: RunView) -> None:
    """Write all merged arrays, assembled from the world tiles, and the slope."""
    arrays, tiles = {}, tiles_of(run)
    for spec in merge.merge_stage.outputs:
        if spec.dims == ("row", "col"):
            lattice, values = whole(tiles, spec.name)
            arrays[spec.name] = (spec, values)
    arrays["slope"] = (SLOPE, slope_deg(arrays["elevation"][1], lattice.cell))
    about = {
        "title": f"Merged terrain of the sequence {run.sequence.name}",
        "source": "stereo images: disparity by HFVM, elevation models by Locus, merged; Rille",
        **plane_tag(run),
    }
    write_terrain(path, arrays, lattice, run.sequence.georeference, about)


OUTPUTS = (
    Output(
        "terrain.zarr",
        "all merged arrays with units and coordinates",
        "xarray.open_zarr, GDAL",
        _write_output,
        "world",
        (RUN.products.world_tiles,),
        (RUN.sequence.name, RUN.sequence.georeference),
    ),
)
STAGE = stage("output.terrain", "The merged terrain as one zarr group", OUTPUTS)
