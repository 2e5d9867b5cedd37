"""Files for other programs: GeoTIFFs, the path as GeoJSON, the trajectory in KITTI's and TUM's formats.

Every file is written beside its final name and moved there, so that a reader finds a whole file or none.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.errors import InputError
from stages.lattice import Lattice

FRAME = (
    "right-handed, metres: origin at the first left camera's centre, z up, y the horizontal projection of its "
    "optical axis, x right"
)
"""The world frame in words; every file repeats it where its format allows."""

ENGINEERING_CRS = (
    'ENGCRS["Rille world frame (local metres)",EDATUM["centre of the first left camera"],CS[Cartesian,2],'
    'AXIS["x",east,ORDER[1]],AXIS["y",north,ORDER[2]],LENGTHUNIT["metre",1]]'
)
"""WKT 2. GDAL keeps it, but rasterio's ``crs.is_valid`` is False for every engineering CRS: do not test that."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Temporary name beside ``path`` that becomes ``path`` when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_raster(
    path: Path,
    bands: Mapping[str, NDArray[Any]],
    lattice: Lattice,
    *,
    unit: str,
    nodata: float | None,
    tags: Mapping[str, str] | None = None,
) -> None:
    """Write a cloud-optimised GeoTIFF in the engineering CRS.

    Parameters
    ----------
    path : file to write or replace.
    bands : arrays (row, col) of one dtype on ``lattice``, by the band's name.
    unit : unit of the values; ``"m"`` is written as GDAL's ``metre``.
    nodata : value of unknown cells (NaN for floats). None where every value means something; the overviews then take
        the most frequent value, since classes have no mean.
    tags : more metadata; the frame, the unit and the cell size are always there.

    Raises
    ------
    InputError
        An array does not fit the lattice.
    """
    import rasterio
    from rasterio.transform import from_origin

    for name, values in bands.items():
        if values.shape != lattice.shape:
            raise InputError(f"band {name} of {values.shape} cells does not fit its lattice {lattice.shape}")
    half = 0.5 * lattice.cell
    profile = {
        "driver": "COG",
        "height": lattice.rows,
        "width": lattice.cols,
        "count": len(bands),
        "dtype": next(iter(bands.values())).dtype.name,
        "crs": rasterio.crs.CRS.from_wkt(ENGINEERING_CRS),
        "transform": from_origin(lattice.x0 - half, lattice.y0 + half, lattice.cell, lattice.cell),
        "nodata": nodata,
        "compress": "deflate",
        "level": 1,
        "num_threads": "all_cpus",
        "predictor": "yes",
        "blocksize": 256,
        "overview_resampling": "mode" if nodata is None else "average",
    }
    facts = {"FRAME": FRAME, "UNIT": unit, "CELL_SIZE_M": f"{lattice.cell:.12g}"}
    with replacing(path) as temporary, rasterio.open(temporary, "w", **profile) as file:
        for number, (name, values) in enumerate(bands.items(), start=1):
            file.write(np.asarray(values), number)
            file.set_band_description(number, name)
        file.units = ("metre" if unit == "m" else unit,) * len(bands)
        file.update_tags(**facts, **{key.upper(): value for key, value in dict(tags or {}).items()})


def write_path_geojson(path: Path, vertices: NDArray[np.float64], facts: Mapping[str, Any]) -> None:
    """Write the path as GeoJSON: a line, its start and its target; a feature without geometry where none was found.

    RFC 7946 knows WGS 84 only. The coordinates here are local metres, which the properties say; a program that
    overlooks it draws the path near latitude 0.

    Parameters
    ----------
    vertices : (vertex, xyz) metres, world frame; empty where no path was found.
    facts : JSON-able properties of the line.
    """
    common = {"crs_name": "local metres (not WGS 84)", "frame": FRAME, "unit": "m"}
    coordinates = [[round(float(v), 6) for v in vertex] for vertex in vertices]
    line = {"type": "LineString", "coordinates": coordinates} if len(coordinates) > 1 else None
    features = [_feature(line, {"name": "path"} | dict(facts) | common)]
    if coordinates:
        for name, at in (("start", 0), ("target", -1)):
            features.append(_feature({"type": "Point", "coordinates": coordinates[at]}, {"name": name} | common))
    write_text(path, json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n")


def _feature(geometry: Mapping[str, Any] | None, properties: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": dict(properties)}


def write_trajectory_kitti(path: Path, poses: NDArray[np.float64]) -> None:
    """Write the 3 x 4 of every frame, row by row, a line a frame; NaN where a frame has no pose.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, metres; optical axes x right, y down, z forward.
    """
    write_text(path, "".join(_line(pose.reshape(-1)) for pose in poses))


def write_trajectory_tum(path: Path, poses: NDArray[np.float64], times: Sequence[float]) -> None:
    """Write ``time x y z qx qy qz qw``, a line for every frame with a pose.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, metres; optical axes x right, y down, z forward.
    times : of the frames, seconds; frame numbers where there is no clock.
    """
    head = f"# time x y z qx qy qz qw; world from left camera (x right, y down, z forward); world {FRAME}\n"
    lines = [
        _line([time, *pose[:, 3], *Rotation.from_matrix(pose[:, :3]).as_quat(canonical=True)])
        for time, pose in zip(times, poses, strict=True)
        if np.isfinite(pose).all()
    ]
    write_text(path, head + "".join(lines))


def _line(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(f"{value:.15g}" for value in values) + "\n"


def write_disparity(path: Path, column: NDArray[Any], row: NDArray[Any], tags: Mapping[str, str]) -> None:
    """Write the disparity of two images as a float32 TIFF: bands ``column_disparity`` and ``row_disparity``.

    Parameters
    ----------
    column, row : (row, col) float32 pixels on the left image, right minus left, NaN undefined.
    tags : more metadata.
    """
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    height, width = column.shape
    profile = {"driver": "GTiff", "height": height, "width": width, "count": 2, "dtype": "float32"}
    profile |= {"nodata": float("nan"), "compress": "deflate", "predictor": 3}
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # an image has no place on the ground
        with rasterio.open(temporary, "w", **profile) as file:
            for number, (name, values) in enumerate((("column_disparity", column), ("row_disparity", row)), start=1):
                file.write(np.asarray(values, dtype=np.float32), number)
                file.set_band_description(number, name)
            file.units = ("pixel", "pixel")
            file.update_tags(CONVENTION="right minus left, pixels of the left image, NaN undefined", **dict(tags))
