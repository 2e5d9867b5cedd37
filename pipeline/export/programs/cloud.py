"""The matched pixels of a run as a point cloud (LAZ 1.4, PLY): one pair after the other, in the world frame."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.export.colour import LUMA
from rille.pipeline.export.programs.placed_pairs import PlacedPair, PlacedPairs
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.read_dem import frames_of, georeference_in
from rille.pipeline.export.writers import ENGINEERING_CRS
from rille.stages.core.arrays import Floats
from rille.stages.core.quantities import count
from rille.stages.terrain.points import colours, cubes, one_a_cube

ABOUT = {
    "sigma_along": "standard deviation along ray, m",
    "sigma_across": "standard deviation across it, m",
    **dict.fromkeys(("ray_x", "ray_y", "ray_z"), "direction from camera to point"),
    "pair": "frame number of the stereo pair",
}
"""Descriptions of the columns that LAS does not define, at most 32 characters each."""

PLY_TYPES = {"float64": "double", "float32": "float", "uint8": "uchar", "uint32": "int"}  # Open3D reads no uint

Columns = Mapping[str, NDArray[Any]]


def write_run(path: Path, run: RunArtifacts, every: int = 1, voxel: float = 0.0) -> str:
    """Write the points of a run as LAZ or PLY, by the ending of the file; return its content, in words.

    Columns: x, y, z (m; on Earth if the sequence has a place there), red, green, blue of the left image, the standard
    deviations along and across the ray of the left camera (m), the ray's direction, and the pair's frame.

    Parameters
    ----------
    every : step of rows and columns.
    voxel : side of cubes with one point each, m (0: all points): the most certain one of the first pair.

    Raises
    ------
    InputError
        The run has no pair with a disparity and a pose.
    """
    from rasterio.crs import CRS

    place, pairs = georeference_in(frames_of(run.run / "frames.json")), PlacedPairs(run, every)
    # LAS 1.4 has WKT 1 alone.
    crs = CRS.from_user_input(place.crs if place is not None else ENGINEERING_CRS).to_wkt(version="WKT1_GDAL")
    write = _write_laz if path.suffix.lower() == ".laz" else _write_ply
    parts = (_columns(run, one, place) for one in pairs)
    origin = np.zeros(3) if place is None else np.array(place.origin)
    points = write(path, _thinned(parts, voxel, origin) if voxel else parts, crs)
    return f"{count(points, 'point')} of {pairs.words}"


def _thinned(parts: Iterator[Columns], voxel: float, origin: Floats) -> Iterator[Columns]:
    """Points of each pair after thinning; cubes count from ``origin`` (3,), m: from 0 on Earth there are too many."""
    taken = np.zeros(0, np.int64)
    for columns in parts:
        cube = cubes(np.column_stack([columns[axis] for axis in "xyz"]) - origin, voxel)
        first = one_a_cube(cube, columns["sigma_along"])
        first = first[~np.isin(cube[first], taken)]
        taken = np.union1d(taken, cube[first])
        yield {name: values[first] for name, values in columns.items()}


def _columns(run: RunArtifacts, one: PlacedPair, place: Georeference | None) -> Columns:
    """Columns of a pair's points."""
    found, T_world_left = one.points, one.T_world_left
    ray = found.position / np.linalg.norm(found.position, axis=1, keepdims=True) @ T_world_left.rotation.T
    position = T_world_left.apply(found.position)
    if place is not None:
        ray[:, :2], position = ray[:, :2] @ place.rotation.T, place.apply(position)
    columns = dict(zip("xyz", position.T, strict=True))
    columns |= zip(("red", "green", "blue"), colours(found.pixel, run.left_image(one.pair)).T, strict=True)
    columns |= {"sigma_along": found.sigma_along, "sigma_across": found.sigma_across}
    columns |= zip(("ray_x", "ray_y", "ray_z"), ray.T.astype(np.float32), strict=True)
    return columns | {"pair": np.full(len(position), one.pair, np.uint32)}


def _write_laz(path: Path, parts: Iterator[Columns], crs: str) -> int:
    """Write LAS 1.4, point format 7, the CRS as WKT 1; return the number of points."""
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    # The first pair with points determines offsets and scales.
    first = next(parts)
    while not len(first["x"]) and (following := next(parts, None)) is not None:
        first = following
    header = laspy.LasHeader(point_format=7, version="1.4")
    # A constant date, so that equal clouds make equal files.
    header.creation_date, header.generating_software, header.system_identifier = date(2000, 1, 1), "Rille", "stereo"
    # LAS has coordinates of 32 bits: without offsets eastings would overflow with such fine steps.
    if len(first["x"]):
        header.offsets = [float(np.floor(first[axis].min())) for axis in "xyz"]
    # Step: a tenth of the median standard deviation across the ray of the first pair.
    step = float(np.median(first["sigma_across"])) / 10 if len(first["x"]) else 1e-3
    header.scales = np.full(3, 10.0 ** np.floor(np.log10(step)))
    # With point formats 6 to 10 LAS 1.4 allows only WKT, and requires this bit.
    header.vlrs.append(WktCoordinateSystemVlr(crs))
    header.global_encoding.wkt = True
    for name, about in ABOUT.items():
        header.add_extra_dim(laspy.ExtraBytesParams(name, type=first[name].dtype, description=about))
    with laspy.open(path, mode="w", header=header, do_compress=True) as file:
        for part in itertools.chain([first], parts):
            record = laspy.ScaleAwarePointRecord.zeros(len(part["x"]), header=header)
            for name, values in part.items():
                # LAS has colours of 16 bits.
                record[name] = values.astype(np.uint16) * np.uint16(257) if values.dtype == np.uint8 else values
            record["intensity"] = np.rint(np.column_stack([record[b] for b in ("red", "green", "blue")]) @ LUMA)
            # LAS counts returns from 1: 0 of 0, laspy's default, is invalid.
            record["return_number"][:] = record["number_of_returns"][:] = 1
            file.write_points(record)
        return int(file.header.point_count)


def _write_ply(path: Path, parts: Iterator[Columns], crs: str) -> int:
    """Write binary PLY; return the number of points.

    Coordinates are 64-bit floats: eastings of 32 bits would jump by decimetres.
    """
    body, count, properties = path.with_suffix(".body"), 0, []
    with body.open("wb") as file:
        for part in parts:
            kinds = [(name, values.dtype.newbyteorder("<")) for name, values in part.items()]
            file.write(np.rec.fromarrays(list(part.values()), dtype=kinds).tobytes())
            count += len(part["x"])
            properties = [f"property {PLY_TYPES[values.dtype.name]} {name}" for name, values in part.items()]
    # In one line: a line feed would end the comment.
    lines = ["ply", "format binary_little_endian 1.0", f"comment crs {' '.join(crs.split())}"]
    lines += [f"comment {name}: {about}" for name, about in ABOUT.items()]
    lines += [f"element vertex {count}", *properties, "end_header"]
    # Header last, since the number of points is known at the end.
    with path.open("wb") as file, body.open("rb") as points:
        file.write("".join(f"{line}\n" for line in lines).encode())
        shutil.copyfileobj(points, file)
    body.unlink()
    return count
