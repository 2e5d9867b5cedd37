"""``frames.json``: in which frame, unit and order every file of a run is written, for who reads them with a program."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rille.pipeline.export.catalogue import OUTPUTS
from rille.pipeline.export.trajectories import stamps
from rille.pipeline.export.view import RunView
from rille.pipeline.export.writers import FRAME, UNLEVELLED
from rille.stages.geometry.pose_arrays import NO_VERTICAL

FORMAT = 1
"""Raised when the meaning of a key of frames.json changes."""

FRAMES: dict[str, dict[str, Any]] = {
    "world": {
        "handedness": "right",
        "axes": {"x": "right", "y": "ahead", "z": "up"},
        "origin": "centre of the left camera at the first frame that has a pose here",
        "definition": FRAME,
    },
    "left camera": {
        "handedness": "right",
        "axes": {"x": "right in the image (columns)", "y": "down in the image (rows)", "z": "optical axis, forward"},
        "origin": "projection centre of the left camera at that frame",
    },
}

_PLACED = {
    "frame": "georeference",
    "crs": "that of georeference: easting, northing, height; metres; rasters are turned by the azimuth, not resampled",
}
IN_PLACE = {
    ".tif": _PLACED
    | {"raster": "row 0 at the greatest y of the world frame; the geotransform gives the corner of the first cell"},
    ".gpkg": _PLACED,
}
"""By their endings, the files whose coordinates are those of the sequence's CRS where it has one: what is then said."""


def describe(written: Sequence[str], run: RunView, vertical: str = "") -> dict[str, Any]:
    """Return the content of ``frames.json``.

    Parameters
    ----------
    written : names of the files that the run has written; only these are described.
    vertical : source of the world's vertical, "none" if there is none; empty without a trajectory.
    """
    times, place, names = run.sequence.times, run.sequence.georeference, run.sequence.frame_names
    world = FRAMES["world"] | ({"vertical": vertical} if vertical else {})
    if vertical == NO_VERTICAL:
        world |= {"axes": {"x": "right", "y": "optical axis of the first camera", "z": "that camera's up"}}
        world |= {"definition": UNLEVELLED}
    known = {o.name: {"frame": o.frame, **o.facts} for o in OUTPUTS if o.name in written and o.frame}
    if place is not None:
        known = {name: facts | IN_PLACE.get(Path(name).suffix, {}) for name, facts in known.items()}
    return {
        "format": FORMAT,
        "units": {"length": "m", "angle": "rad, deg where the name says so", "time": "s" if times else "frame number"},
        "frames_of_reference": FRAMES | {"world": world},
        "files": known,
        "georeference": None if place is None else place.to_dict(),
        "frames": [
            {"frame": frame, "name": names[frame], "time": stamp}
            for frame, stamp in zip(run.frames, stamps(run), strict=True)
        ],
    }
