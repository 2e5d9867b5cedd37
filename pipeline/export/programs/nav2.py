"""A run as maps and a path for the navigation stack of ROS 2 (Nav2).

Everything is in the run's world frame, metres, x to the right and y ahead: frame ``map``. The formats are those that
Nav2's documentation states for ``map_server`` (map_io) and for the costmap filters:

- ``map.yaml``, ``map.pgm``: mode ``raw``, a pixel is the occupancy itself: 100 times the probability of a hazard, 100
  where the class is hazard, 255 (unknown) where the ground is unknown.
- ``keepout.yaml``, ``keepout.pgm``: mask of the keepout filter: 100 where the class is hazard or unknown, else 0.
- ``speed.yaml``, ``speed.pgm``: mask of the speed filter in percent of the greatest speed: :data:`SLOW` on caution,
  else 0, which means no limit.
- ``path.yaml``: the planned path as ``nav_msgs/msg/Path``, each pose with the yaw of the way ahead.

The first row of an image is the map's greatest y; ``origin`` is the lower left corner of its lower left pixel.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.classification import CAUTION, HAZARDOUS, UNKNOWN

OCCUPIED, NOT_KNOWN = 100, 255
"""Values of a pixel of mode raw."""

SLOW = 50
"""Percent of the greatest speed on ground of class caution; a convention, to be changed in the mask's multiplier."""

CHORD = 10
"""Vertices to either side between which a pose's yaw is taken: cells next to each other make steps of 45 degrees."""


def write_run(folder: Path, run: RunArtifacts) -> str:
    """Write maps, masks and path of a run into a new folder; what was written, in words."""
    risk, _, path = run.world()
    folder.mkdir()
    write(folder, risk, path)
    way = "no path" if path is None or len(path["path"]) == 0 else f"a path of {len(path['path'])} poses"
    return f"map, keepout and speed masks of {risk['risk'].size} cells, {way}"


def write(folder: Path, risk: Bundle, path: Bundle | None) -> None:
    """Write the files of a risk map and a path into an empty folder."""
    lattice, classes = Lattice.from_dict(risk.meta["lattice"]), np.asarray(risk["risk"])
    hazardous, unknown = classes == HAZARDOUS, classes == UNKNOWN
    percent = np.rint(100.0 * np.nan_to_num(np.clip(risk["p_hazard"], 0.0, 1.0)))
    maps = {
        "map": np.select([hazardous, unknown], [OCCUPIED, NOT_KNOWN], percent),
        "keepout": np.where(hazardous | unknown, OCCUPIED, 0),
        "speed": np.where(classes == CAUTION, SLOW, 0),
    }
    left, _, bottom, _ = (round(v, 9) for v in lattice.bounds)
    # map_server demands both thresholds in every mode, also in raw, which has no use for them.
    about = {"mode": "raw", "resolution": lattice.cell, "negate": 0, "occupied_thresh": 1.0, "free_thresh": 0.0}
    for name, values in maps.items():
        _, image = cv2.imencode(".pgm", values.astype(np.uint8))
        (folder / f"{name}.pgm").write_bytes(image.tobytes())
        _write_yaml(folder / f"{name}.yaml", {"image": f"{name}.pgm", **about, "origin": [left, bottom, 0.0]})
    if path is not None and len(path["path"]):
        _write_yaml(folder / "path.yaml", path_message(np.asarray(path["path"])))


def path_message(xyz: NDArray[np.float64]) -> dict[str, Any]:
    """Vertices (n, 3), metres, as ``nav_msgs/msg/Path``."""
    number = np.arange(len(xyz))
    ahead = xyz[np.minimum(number + CHORD, len(xyz) - 1)] - xyz[np.maximum(number - CHORD, 0)]
    half_yaw = 0.5 * np.arctan2(ahead[:, 1], ahead[:, 0])
    turns = np.column_stack([np.zeros((len(xyz), 2)), np.sin(half_yaw), np.cos(half_yaw)])
    poses = [
        {
            "header": _header(),
            "pose": {
                "position": dict(zip("xyz", place, strict=True)),
                "orientation": dict(zip("xyzw", turn, strict=True)),
            },
        }
        for place, turn in zip(np.round(xyz, 6).tolist(), np.round(turns, 9).tolist(), strict=True)
    ]
    return {"header": _header(), "poses": poses}


def _header() -> dict[str, Any]:
    return {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "map"}


def _write_yaml(path: Path, facts: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(facts, sort_keys=False), encoding="utf-8")
