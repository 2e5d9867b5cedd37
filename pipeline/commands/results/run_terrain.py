"""The merged terrain of a finished run, for commands that register runs to maps or to each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rille.datasets.georeference import Georeference
from rille.pipeline.export.read_dem import frames_of, georeference_in, no_ground
from rille.pipeline.python.runs import Run
from rille.pipeline.runs import lookup
from rille.stages.core.errors import InputError
from rille.stages.evaluation.joint_terrain import Terrain
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.pose_arrays import REFERENCE_PLANE


@dataclass(frozen=True)
class RunTerrain(Terrain):
    """Merged terrain of a run; ``place`` of its world frame, if it has one; ``vertical``: source of its vertical."""

    place: Georeference | None
    vertical: str

    @staticmethod
    def of(folder: Path) -> RunTerrain:
        """Terrain in the folder of a run.

        Raises
        ------
        InputError
            The run has none, or its elevations are not those of ground.
        """
        run, name = Run(folder), lookup.name(folder)
        terrain = run.terrain
        with lookup.reading(folder):
            frames = frames_of(run.file("frames.json"))
            vertical = frames["frames_of_reference"]["world"].get("vertical", "")
            about = terrain.attrs
            rows, cols = terrain["elevation"].shape
            lattice = Lattice(float(terrain.x[0]), float(terrain.y[0]), float(about["cell_size_m"]), rows, cols)
            arrays = {key: np.asarray(terrain[key], np.float64) for key in ("elevation", "elevation_std", "ortho")}
            place = georeference_in(frames)
        if vertical == REFERENCE_PLANE:
            raise no_ground(f"run {name}")
        if not np.isfinite(arrays["elevation"]).any():
            text = f"the terrain of run {name} has no known cell"
            raise InputError("RIL-843", text, remedy="its report says what is missing")
        return RunTerrain(name, arrays, lattice, place, vertical)
