"""The hazards of a run as an occupancy map of ROS 2's navigation (Nav2), by the documentation of its ``map_server``.

``map.pgm`` in mode ``raw``: a pixel is the occupancy, 100 times the probability of a hazard, 100 where the class is
hazard, 255 where the ground is unknown. ``map.yaml`` places it in the frame ``map``, the run's world frame (metres, x
to the right and y ahead): the first row is the greatest y, ``origin`` the lower left corner of its lower left pixel.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.classification import HAZARDOUS, UNKNOWN


def write_run(folder: Path, run: RunArtifacts) -> str:
    """Write the map of a run into a new folder; return its content, in words."""
    risk = run.risk()
    lattice, classes = Lattice.from_dict(risk.meta["lattice"]), np.asarray(risk["risk"])
    percent = np.rint(100.0 * np.nan_to_num(np.clip(risk["p_hazard"], 0.0, 1.0)))
    cells = np.select([classes == HAZARDOUS, classes == UNKNOWN], [100, 255], percent)
    left, _, bottom, _ = (round(v, 9) for v in lattice.bounds)
    about = {"image": "map.pgm", "mode": "raw", "resolution": lattice.cell, "origin": [left, bottom, 0.0], "negate": 0}
    # map_server demands both thresholds in every mode, although raw does not use them.
    about |= {"occupied_thresh": 1.0, "free_thresh": 0.0}
    folder.mkdir()
    (folder / "map.pgm").write_bytes(cv2.imencode(".pgm", cells.astype(np.uint8))[1].tobytes())
    (folder / "map.yaml").write_text(yaml.safe_dump(about, sort_keys=False), encoding="utf-8")
    return f"map of {classes.size} cells"
