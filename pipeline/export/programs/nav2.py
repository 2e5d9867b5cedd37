"""A run as maps and a path for the navigation stack of ROS 2 (Nav2).

Everything is in the run's world frame, metres, x to the right and y ahead: frame ``map``. The formats are those that
Nav2's documentation states for ``map_server`` (map_io) and for the costmap filters:

- ``map.yaml``, ``map.pgm``: mode ``raw``, a pixel is the occupancy itself: 100 times the probability of a hazard, 100
  where the class is hazard, 255 (unknown) where the ground is unknown.
- ``map_scale.yaml``, ``map_scale.png``: the same in mode ``scale``: black is occupied, white free, transparent unknown.
- ``keepout.yaml``, ``keepout.pgm``: mask of the keepout filter: 100 where the class is hazard or unknown, else 0.
- ``speed.yaml``, ``speed.pgm``: mask of the speed filter in percent of the greatest speed: :data:`SLOW` on caution,
  else 0, which means no limit.
- ``path.yaml``: the planned path as ``nav_msgs/msg/Path``, each pose with the yaw of the way ahead.

The first row of an image is the map's greatest y; ``origin`` is the lower left corner of its lower left pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.run_artifacts import RunArtifacts, check_new
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.classification import CAUTION, HAZARDOUS, UNKNOWN

FRAME = "map"
OCCUPIED, NOT_KNOWN = 100, 255
"""Values of a pixel of mode raw."""

SLOW = 50
"""Percent of the greatest speed on ground of class caution; a convention, to be changed in the mask's multiplier."""

CHORD = 10
"""Vertices to either side between which a pose's yaw is taken: cells next to each other make steps of 45 degrees."""

FREE_THRESHOLD, OCCUPIED_THRESHOLD = 0.0, 1.0
"""Of mode scale: between them occupancy grows with darkness, here from 0 to 100."""


def export_run(run: Path, target: Path, store: Store) -> str:
    """Write the maps, masks and path of a run as files for Nav2 into a new or empty folder.

    Returns
    -------
    The line to print: number of cells, and of poses of the path.

    Raises
    ------
    InputError
        ``run`` is not the folder of a run with a risk map, its artifacts are not in the cache, or ``target``
        is not empty.
    """
    check_new(target)
    risk, _, path = RunArtifacts(run, store).world()
    with atomic.replacing(target) as folder:
        folder.mkdir()
        write(folder, risk, path)
    way = "no path" if path is None or len(path["path"]) == 0 else f"a path of {len(path['path'])} poses"
    return f"{target}: map, keepout and speed masks of {risk['risk'].size} cells, {way}"


def write(folder: Path, risk: Bundle, path: Bundle | None) -> None:
    """Write the files of a risk map and a path into an empty folder."""
    lattice, classes = Lattice.from_dict(risk.meta["lattice"]), np.asarray(risk["risk"])
    maps = occupancy(classes, np.asarray(risk["p_hazard"]))
    closed = (classes == HAZARDOUS) | (classes == UNKNOWN)
    masks = {
        "map": maps,
        "keepout": np.where(closed, OCCUPIED, 0),
        "speed": np.where(classes == CAUTION, SLOW, 0),
    }
    for name, values in masks.items():
        _image(folder / f"{name}.pgm", values.astype(np.uint8))
        (folder / f"{name}.yaml").write_text(_yaml(f"{name}.pgm", "raw", lattice), encoding="utf-8")
    _image(folder / "map_scale.png", scaled(maps))
    (folder / "map_scale.yaml").write_text(_yaml("map_scale.png", "scale", lattice), encoding="utf-8")
    if path is not None and len(path["path"]):
        (folder / "path.yaml").write_text(path_message(np.asarray(path["path"])), encoding="utf-8")


def occupancy(classes: NDArray[Any], p_hazard: NDArray[Any]) -> NDArray[np.uint8]:
    """Occupancy 0..100 of every cell (row, col), 255 unknown."""
    percent = np.rint(100.0 * np.nan_to_num(np.clip(p_hazard, 0.0, 1.0)))
    percent[classes == HAZARDOUS] = OCCUPIED
    percent[classes == UNKNOWN] = NOT_KNOWN
    return np.asarray(percent, np.uint8)


def scaled(maps: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Image (row, col, BGRA) for mode ``scale`` of occupancies."""
    known = maps != NOT_KNOWN
    # 205 is the grey by which map_saver shows unknown ground; map_server goes by alpha alone.
    grey = np.where(known, np.rint(255.0 * (1.0 - np.minimum(maps, OCCUPIED) / OCCUPIED)), 205.0).astype(np.uint8)
    return np.dstack([grey, grey, grey, np.where(known, 255, 0).astype(np.uint8)])


def path_message(xyz: NDArray[np.float64]) -> str:
    """Vertices (n, 3), metres, as ``nav_msgs/msg/Path`` in YAML."""
    number = np.arange(len(xyz))
    ahead = xyz[np.minimum(number + CHORD, len(xyz) - 1)] - xyz[np.maximum(number - CHORD, 0)]
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    stamp = "stamp: {sec: 0, nanosec: 0}"
    lines = ["header:", f"  {stamp}", f"  frame_id: {FRAME}", "poses:"]
    for (x, y, z), angle in zip(xyz, yaw, strict=True):
        turn = f"{{x: 0.0, y: 0.0, z: {np.sin(0.5 * angle):.9f}, w: {np.cos(0.5 * angle):.9f}}}"
        lines += [
            f"- header: {{{stamp}, frame_id: {FRAME}}}",
            f"  pose: {{position: {{x: {x:.6f}, y: {y:.6f}, z: {z:.6f}}}, orientation: {turn}}}",
        ]
    return "\n".join(lines) + "\n"


def _yaml(image: str, mode: str, lattice: Lattice) -> str:
    half = 0.5 * lattice.cell
    left, bottom = lattice.x0 - half, lattice.y0 - (lattice.rows - 1) * lattice.cell - half
    facts: Mapping[str, Any] = {
        "image": image,
        "mode": mode,
        "resolution": f"{lattice.cell:.9g}",
        "origin": f"[{left:.9g}, {bottom:.9g}, 0.0]",
        "negate": 0,
        # map_server demands both thresholds in every mode, also in raw, which has no use for them.
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    return "".join(f"{name}: {value}\n" for name, value in facts.items())


def _image(path: Path, values: NDArray[np.uint8]) -> None:
    done, data = cv2.imencode(path.suffix, values)
    assert done
    path.write_bytes(data.tobytes())
