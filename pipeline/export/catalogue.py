"""The table of all files that a run can have, and ``frames.json``.

Every module of this folder that has ``OUTPUTS`` belongs to it, without another list.

``frames.json`` describes frame, unit and order of the values in every file of a run, for programs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from rille.pipeline import export
from rille.pipeline.export.output import Output
from rille.pipeline.export.trajectories import stamps
from rille.pipeline.export.view import RunView
from rille.pipeline.export.writers import FRAME, WORLDS
from rille.stages.geometry.pose_arrays import NO_VERTICAL, REFERENCE_PLANE

NAMES = (name for _, name, package in iter_modules(export.__path__, f"{export.__name__}.") if not package)
MADE = tuple(module for module in map(import_module, NAMES) if hasattr(module, "OUTPUTS"))
"""Modules whose outputs are tasks."""

OUTPUTS = (
    Output("report.html", "the report, one page", "any browser"),
    Output("report.json", "every number of the report, for programs", "any text editor, jq"),
    *sorted((output for module in MADE for output in module.OUTPUTS), key=attrgetter("name")),
    Output(
        "frames.json",
        "frames, handedness, quaternion order and units of every file; the frames' names",
        "any text editor",
    ),
    Output("config.toml", "every parameter in force; give it back with --config", "any text editor"),
    Output("ledger.jsonl", "what became of every task, a JSON object a line", "any text editor, jq"),
)

RENDERED = frozenset(output.name for output in OUTPUTS if output.write is None)
"""Files that each run writes anew, because they state time and place of the run; they differ even for equal results."""


def listed(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Name, meaning and programs of all files in a run's folder; files that are not of a run come last, with the name
    alone."""
    # The page lists itself, although it is written after its list.
    left = {p.name for p in folder.iterdir() if not p.name.startswith(".")} | {"report.html", "report.json"}
    for output in OUTPUTS:
        for name in sorted(n for n in left if fnmatchcase(n, output.name)):
            left.remove(name)
            yield name, output.what, output.opens
    yield from ((name, "", "") for name in sorted(left))


# -- frames.json --------------------------------------------------------------------------------------------------

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

OTHER_WORLDS: dict[str, dict[str, Any]] = {
    NO_VERTICAL: {"axes": {"x": "right", "y": "optical axis of the first camera", "z": "that camera's up"}},
    REFERENCE_PLANE: {
        "axes": {"x": "right", "y": "up in the image", "z": "away from the reference plane, to the cameras"},
        "origin": "point of the reference plane nearest to the first left camera",
    },
}
"""How the world frame differs by the source of its vertical."""

CONVENTIONS = {
    "pose": "of the left camera, T_world_left: x_world = R x_left + t",
    "trajectory.kitti": "[R | t] row by row, a line a frame in the order of `frames` here; nan where there is no pose",
    ".tum": "time x y z qx qy qz qw; frames without a pose have no line",
    "quaternion": "x y z w (scalar last), Hamilton, w >= 0, rotates from the left camera to the world",
    "raster": "row 0 at the greatest y of the world frame; the geotransform gives the corner of the first cell",
    "world": "engineering CRS, metres: x, y and z of the world frame",
    "georeference": "that CRS, metres: easting, northing, height; rasters are turned by the azimuth, not resampled",
}
"""Conventions of poses and rasters, and coordinates of files by their frame."""


def describe(written: Sequence[str], run: RunView, vertical: str = "") -> dict[str, Any]:
    """Return the content of ``frames.json``.

    Parameters
    ----------
    written : names of the files that the run has written; only these are described.
    vertical : source of the world's vertical, "none" if there is none; empty without a trajectory.
    """
    times, place, names = run.sequence.times, run.sequence.georeference, run.sequence.frame_names
    world = FRAMES["world"] | OTHER_WORLDS.get(vertical, {}) | {"definition": WORLDS.get(vertical, FRAME)}
    world |= {"vertical": vertical} if vertical else {}
    # Endings of files with coordinates in the sequence's CRS, if it has one.
    placed = (".tif", ".gpkg") if place is not None else ()
    known = {
        o.name: {"frame": "georeference" if o.name.endswith(placed) else o.frame, "holds": o.what}
        for o in OUTPUTS
        if o.name in written and o.frame
    }
    # Increased when the meaning of a key of frames.json changes.
    return {
        "format": 2,
        "units": {"length": "m", "angle": "rad, deg where the name says so", "time": "s" if times else "frame number"},
        "frames_of_reference": FRAMES | {"world": world},
        "conventions": CONVENTIONS,
        "files": known,
        "georeference": None if place is None else place.to_dict(),
        "frames": [
            {"frame": frame, "name": names[frame], "time": stamp}
            for frame, stamp in zip(run.frames, stamps(run), strict=True)
        ],
    }
