"""``rille export RUN``: a run written for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.run_artifacts import FILES, export_run
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import RUNS, CacheFolder, Output, Run, Runs, cache_folder, check_output
from rille.stages.core.errors import ConfigError

Form = Literal["laz", "ply", "glb", "frames", "colmap", "nav2", "rocrate"]


def export(
    run: Run,
    *,
    to: Form,
    output: Annotated[Path | None, Output] = None,
    every: Annotated[int, Parameter(validator=Number(gte=1))] = 1,
    voxel: Annotated[float, Parameter(validator=Number(gte=0))] = 0.0,
    runs: Runs = RUNS,
    cache: CacheFolder = None,
) -> None:
    """Write a run for other programs: cloud.laz or cloud.ply (points), terrain.glb (mesh), a model, a map.

    Parameters
    ----------
    to
        laz (CloudCompare, PDAL, QGIS), ply (CloudCompare, MeshLab): every matched pixel as a point with its standard
        deviations; glb: the ground as a mesh, for any glTF viewer, Blender; frames: position, range, normal, slope,
        roughness and disparity of each pair as rasters of its left image; colmap: cameras, rig, poses and tracked
        points; nav2: occupancy map of ROS 2's navigation; rocrate: an RO-Crate of all files with digests of results and
        inputs, parameters, versions and the command, for archives; `rille reconstruct` runs it again.
    output
        What to write; by default cloud.laz, cloud.ply, terrain.glb or a folder of the form's name in the run's folder.
    every
        laz, ply: each so many-th row and column of the images alone.
    voxel
        laz, ply: one point in each cube of so many metres; 0: all.
    """
    if to not in ("laz", "ply") and (every > 1 or voxel > 0):
        raise ConfigError("RIL-967", f"--every and --voxel thin points: --to {to} has none", remedy="leave them out")
    if output is not None and to in FILES:
        check_output(output, f".{to}")
    folder = lookup.find(run, runs)
    path, thinning = output or folder / FILES.get(to, to), {"every": every, "voxel": voxel}
    with lookup.reading(folder):
        words = export_run(to, folder, path, Store(cache_folder(cache)), **(thinning if to in ("laz", "ply") else {}))
    print(f"{path}  {words}")
