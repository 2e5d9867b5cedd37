"""Files for other programs: GeoTIFFs, tables, the trajectory in KITTI's and TUM's formats.

Every file is written beside its final name and moved there, so that a reader finds a whole file or none.
"""

from __future__ import annotations

import io
import json
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.plain import plain
from rille.pipeline.engine.runtime import atomic
from rille.stages.core.errors import ConfigError
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.pose_arrays import NO_VERTICAL, REFERENCE_PLANE
from rille.stages.geometry.rigid import posed

FRAME = (
    "right-handed, metres: origin at the first left camera's centre, z up, y the horizontal projection of its "
    "optical axis (of one that looks straight down that of its images' upper edge), x right"
)
"""The world frame in words; every file repeats it where its format allows."""

UNLEVELLED = (
    "right-handed, metres: that of the first left camera, whose own up is z since nothing tells of the vertical; "
    "origin at its centre, y its optical axis, x right"
)
"""The world frame in words where the vertical is not known."""

ON_PLANE = (
    "right-handed, metres: z is the distance from a reference plane that is no ground, towards the cameras; origin at "
    "the point of the plane that is nearest to the first left camera, x right in its image, y up"
)
"""The world frame in words where elevations are distances from another plane than the ground."""

WORLDS = {NO_VERTICAL: UNLEVELLED, REFERENCE_PLANE: ON_PLANE}
"""The world frame in words by the source of its vertical, where it is not :data:`FRAME`."""

ENGINEERING_CRS = (
    'LOCAL_CS["Rille world frame (local metres)",UNIT["metre",1,AUTHORITY["EPSG","9001"]],'
    'AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
)
"""WKT 1 as GDAL reads a local CRS back from a GeoTIFF, which keeps its name, unit and directions alone. With this text
in all files, programs see path and rasters in one CRS. The axes are not east and north; the tag AXES describes them.
rasterio's ``crs.is_valid`` is False for every engineering CRS: do not test that."""


@dataclass(frozen=True)
class Meaning:
    """Meaning of the values of a raster.

    Parameters
    ----------
    unit : unit of the values, or of each band by name; ``"m"`` is written as GDAL's ``metre``.
    nodata : value of unknown cells (NaN for floats). None for classes, all of which have a meaning; overviews then take
        the most frequent value.
    tags : more metadata; frame, unit and cell size are always written.
    colours : of the values 0, 1, ... of a single band, ``#rrggbb``.
    """

    unit: str | Mapping[str, str] = ""
    nodata: float | None = math.nan
    tags: Mapping[str, str] = field(default_factory=dict)
    colours: Sequence[str] = ()

    def units(self, bands: Iterable[str]) -> list[str]:
        """Unit of each band."""
        return [self.unit if isinstance(self.unit, str) else self.unit[name] for name in bands]


def check_folder(folder: Path, ours: str = "") -> None:
    """Refuse to write a folder where there is a file, or a folder with files, unless one of them is named ``ours``.

    Raises
    ------
    ConfigError
        It is refused.
    """
    taken = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if taken and not (ours and (folder / ours).exists()):
        raise ConfigError("RIL-607", f"{folder} exists, and is no empty folder", remedy="name a new one")


def write_raster(
    path: Path, bands: Mapping[str, NDArray[Any]], lattice: Lattice, meaning: Meaning, place: Georeference | None = None
) -> None:
    """Write a cloud-optimised GeoTIFF in the engineering CRS, or in that of ``place``.

    Parameters
    ----------
    path : file to write or replace.
    bands : arrays (row, col) of one dtype on ``lattice``, by the band's name.
    place : of the world frame. The raster is not resampled: its geotransform is turned by the azimuth. Elevations must
        be heights in its CRS already.
    """
    profile = {
        "driver": "COG",
        "crs": ENGINEERING_CRS if place is None else place.crs,
        "transform": raster_transform(lattice, place),
        "level": 1,
        "num_threads": "all_cpus",
        # COG chooses the predictor by the dtype: for integers (2) or for floats (3).
        "predictor": "yes",
        "blocksize": 256,
        "overview_resampling": "mode" if meaning.nodata is None else "average",
    }
    tags = {"frame": FRAME, "axes": axes(place), "cell_size_m": f"{lattice.cell:.12g}"}
    tags["unit"] = ", ".join(dict.fromkeys(meaning.units(bands)))
    write_bands(path, bands, replace(meaning, tags=tags | dict(meaning.tags)), profile)


def write_bands(path: Path, bands: Mapping[str, NDArray[Any]], meaning: Meaning, profile: Mapping[str, Any]) -> None:
    """Write bands of one shape and dtype by GDAL; ``profile``: driver, place and packing of the file.

    The file is made in memory, because GDAL leaves a damaged file without an error if the disk is full.
    """
    from rasterio.enums import ColorInterp
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    first = next(iter(bands.values()))
    about = {"height": first.shape[0], "width": first.shape[1], "count": len(bands), "dtype": first.dtype.name}
    with MemoryFile() as memory, warnings.catch_warnings():
        # A raster in the geometry of an image has no geotransform.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with memory.open(**profile, **about, nodata=meaning.nodata, compress="deflate") as file:
            for number, (name, values) in enumerate(bands.items(), start=1):
                file.write(values, number)
                file.set_band_description(number, name)
            if list(bands) == ["red", "green", "blue"]:
                file.colorinterp = [ColorInterp[name] for name in bands]
            if meaning.colours:
                file.write_colormap(1, {k: tuple(bytes.fromhex(c[1:])) for k, c in enumerate(meaning.colours)})
            file.units = tuple("metre" if u == "m" else u for u in meaning.units(bands))
            file.update_tags(**{key.upper(): plain(value) for key, value in meaning.tags.items()})
        # The driver COG writes on close.
        atomic.write(path, bytes(memory.getbuffer()))


def raster_transform(lattice: Lattice, place: Georeference | None) -> Any:
    """Affine transform from (column, row) of a raster, corners of cells at integers, to its CRS."""
    from affine import Affine

    half = 0.5 * lattice.cell
    corner = Affine(lattice.cell, 0.0, lattice.x0 - half, 0.0, -lattice.cell, lattice.y0 + half)
    if place is None:
        return corner
    (a, b), (c, d) = place.rotation
    return Affine(a, b, place.origin[0], c, d, place.origin[1]) @ corner


def axes(place: Georeference | None) -> str:
    """Axes of a file's CRS relative to those of the world frame, in words."""
    if place is None:
        return "the CRS's x and y are the world frame's; rows fall with y"
    e, n, h = place.origin
    formulas = f"easting = {e:.3f} + x cos a + y sin a, northing = {n:.3f} - x sin a + y cos a, height = {h:.3f} + z"
    angle = f"a = {np.degrees(place.azimuth):.6g} degrees, clockwise from grid north"
    return f"{formulas} with x, y, z of the frame and {angle}"


def write_trajectory_kitti(path: Path, poses: NDArray[np.float64]) -> None:
    """Write the 3 x 4 matrix of every frame, row by row, one line for each; NaN for frames without a pose.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, metres; optical axes x right, y down, z forward.
    """
    _write_rows(path, poses.reshape(len(poses), 12))


def write_trajectory_tum(path: Path, poses: NDArray[np.float64], times: Sequence[float], world: str = FRAME) -> None:
    """Write ``time x y z qx qy qz qw``, one line for every frame with a pose.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, metres; optical axes x right, y down, z forward.
    times : of the frames, seconds; frame numbers if there is no clock.
    world : the frame of reference in words.
    """
    from scipy.spatial.transform import Rotation

    there = posed(poses)
    # Of two quaternions of a rotation the one with w >= 0, as frames.json says.
    turns = Rotation.from_matrix(poses[there, :, :3]).as_quat(canonical=True)
    head = f"time x y z qx qy qz qw; world from left camera (x right, y down, z forward); world {world}"
    rows = np.column_stack([np.asarray(times, np.float64)[there], poses[there, :, 3], turns])
    # All digits of a time: microseconds since 1970 need sixteen.
    _write_rows(path, rows, ["%s"] + 7 * ["%.15g"], head)


def _write_rows(path: Path, rows: NDArray[np.float64], form: str | list[str] = "%.15g", head: str = "") -> None:
    out = io.StringIO()
    np.savetxt(out, rows, form, header=head)
    atomic.write(path, out.getvalue())


def write_image(path: Path, bands: Mapping[str, NDArray[Any]], meaning: Meaning) -> None:
    """Write arrays (row, col) on image pixels as bands of a float32 TIFF, NaN undefined."""
    # 3: predictor for floats, which GTiff, unlike COG, does not choose.
    profile = {"driver": "GTiff", "predictor": 3}
    write_bands(path, {n: np.asarray(v, np.float32) for n, v in bands.items()}, meaning, profile)


def write_json(path: Path, facts: Mapping[str, Any]) -> None:
    """Write facts for programs; a number that is not finite is an error."""
    atomic.write(path, json.dumps(facts, indent=1, allow_nan=False) + "\n")
