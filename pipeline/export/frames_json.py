"""``frames.json``: in which frame, unit and order every file of a run is written, for who reads them with a program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from datasets.georeference import Georeference
from pipeline.export.writers import FRAME, UNLEVELLED
from stages.geometry.pose_arrays import NO_VERTICAL

FORMAT = 1
"""Raised when the meaning of a key of frames.json changes."""

FRAMES: dict[str, dict[str, Any]] = {
    "world": {
        "handedness": "right",
        "axes": {"x": "right", "y": "ahead", "z": "up"},
        "origin": "centre of the left camera at the first frame",
        "definition": FRAME,
    },
    "left camera": {
        "handedness": "right",
        "axes": {"x": "right in the image (columns)", "y": "down in the image (rows)", "z": "optical axis, forward"},
        "origin": "projection centre of the left camera at that frame",
    },
}

_POSES = {"frame": "world", "of": "left camera", "transform": "T_world_left: x_world = R x_left + t"}
_TUM = {
    **_POSES,
    "columns": "time x y z qx qy qz qw",
    "quaternion": "x y z w (scalar last), Hamilton, w >= 0, rotates from the left camera to the world",
    "missing": "frames without a pose have no line",
}
_RASTER = {
    "frame": "world",
    "crs": "engineering CRS, metres",
    "raster": "row 0 at the greatest y; the geotransform gives the corner of the first cell; north is y",
}

IN_PLACE = (".tif", ".gpkg")
"""Endings of the files whose coordinates are those of the sequence's CRS where it has one."""
_PLACED = {
    "frame": "georeference",
    "crs": "that of georeference: easting, northing, height; metres; rasters are turned by the azimuth, not resampled",
}

FILES: dict[str, dict[str, str]] = {
    "trajectory.kitti": {
        **_POSES,
        "columns": "3 x 4 matrix [R | t], row by row",
        "lines": "one a frame, in the order of `frames` here",
        "missing": "nan",
    },
    "trajectory.tum": _TUM,
    "crosscheck.tum": {
        **_TUM,
        "source": "structure from motion by COLMAP with the given calibration; brought to the world by one rigid "
        "transform (no scale) fitted to trajectory.tum",
    },
    "agreement.csv": {
        "frame": "world",
        "columns": "frame number, name, time; positions of both trajectories; disagreement of pose and of the motion "
        "since the frame before; flagged 0 or 1, and for what; distance of either from the truth, where there is truth",
        "units": "s, m, deg as the column's name ends",
        "missing": "empty",
    },
    "dem.tif": {**_RASTER, "values": "elevation z of the cell centre, m", "missing": "nan"},
    "dem_sigma.tif": {**_RASTER, "values": "standard deviation of the elevation, m", "missing": "nan"},
    "ortho.tif": {**_RASTER, "values": "grey value 0..255", "missing": "nan"},
    "slope.tif": {**_RASTER, "values": "inclination of the terrain, degrees", "missing": "nan"},
    "hillshade.tif": {**_RASTER, "values": "shaded relief 1..255, light from the upper left", "missing": "0"},
    "terrain.zarr": {
        "frame": "world",
        "crs": "engineering CRS, metres; easting and northing beside x and y where the sequence has a place on Earth",
        "values": "all merged arrays as one zarr 3 group, by the CF conventions; units with each",
        "opens_with": "xarray.open_zarr",
    },
    "risk.tif": {**_RASTER, "values": "class 0 safe, 1 caution, 2 hazard, 3 unknown; reason bits; p_hazard; measures"},
    "path.gpkg": {"frame": "world", "crs": "engineering CRS, metres", "coordinates": "x y z, m"},
    "path.geojson": {"frame": "world", "crs": "none: local metres, not WGS 84", "coordinates": "x y z, m"},
}
"""By file: its frame, and what a reader has to know beside the format's own rules."""


def describe(
    written: Sequence[str],
    frames: Sequence[int],
    names: Sequence[str],
    stamps: Sequence[float],
    *,
    clock: bool,
    place: Georeference | None = None,
    vertical: str = "",
) -> dict[str, Any]:
    """What ``frames.json`` holds.

    Parameters
    ----------
    written : names of the files that the run has written; only these are described.
    frames, names, stamps : number, name and time stamp (as in the trajectory files) of each frame.
    clock : the stamps are seconds; otherwise they are the frames' numbers.
    place : of the world frame, where it is known; rasters and ``path.gpkg`` are then in its CRS.
    vertical : what told of the world's vertical, "none" where nothing did; empty without a trajectory.
    """
    world = FRAMES["world"] | ({"vertical": vertical} if vertical else {})
    if vertical == NO_VERTICAL:
        world |= {"axes": {"x": "right", "y": "optical axis of the first camera", "z": "that camera's up"}}
        world |= {"definition": UNLEVELLED}
    known = {name: FILES[name] for name in FILES if name in written}
    if place is not None:
        known = {name: facts | _PLACED if name.endswith(IN_PLACE) else facts for name, facts in known.items()}
    return {
        "format": FORMAT,
        "units": {"length": "m", "angle": "rad, deg where the name says so", "time": "s" if clock else "frame number"},
        "frames_of_reference": FRAMES | {"world": world},
        "files": known,
        "georeference": None if place is None else place.to_dict(),
        "frames": [
            {"frame": frame, "name": name, "time": stamp}
            for frame, name, stamp in zip(frames, names, stamps, strict=True)
        ],
    }
