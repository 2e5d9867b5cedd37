"""``rille export RUN``: a run written for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rille.pipeline.commands.options import (
    COMPLETE,
    RUNS,
    CacheFolder,
    Output,
    Run,
    Runs,
    cache_folder,
    check_output,
)
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import lookup
from rille.stages.core.errors import ConfigError

Form = Literal["laz", "ply", "glb", "colmap", "nav2"]


def export(
    run: Run,
    *,
    to: Annotated[list[Form], Parameter(negative="")],
    output: Annotated[Path | None, Output] = None,
    runs: Runs = RUNS,
    cache: CacheFolder = None,
) -> int:
    """Write a run for other programs: cloud.laz or cloud.ply (points), terrain.glb (mesh), a model, a map.

    Parameters
    ----------
    to
        laz: CloudCompare, PDAL, QGIS; ply: CloudCompare, MeshLab; glb: any glTF viewer, Blender; colmap: cameras, rig,
        poses and tracked points; nav2: occupancy map of ROS 2's navigation. May be repeated.
    output
        What to write, for one form only; by default cloud.laz, cloud.ply, terrain.glb or a folder of the form's name in
        the run's folder.
    """
    if output is not None and len(to) > 1:
        raise ConfigError(
            "RIL-020", f"--output names one place for {len(to)} forms", remedy="give one --to, or leave --output out"
        )
    folder = lookup.find(run, runs)
    for form in to:
        if form in ("laz", "ply", "glb"):
            from rille.pipeline.export.programs import point_cloud

            if output is not None:
                check_output(output, f".{form}")
            path, words = point_cloud.export(folder, form, output)
            print(f"{path}  {words}")
        else:
            from rille.pipeline.export.programs.run_artifacts import export_run

            with lookup.reading(folder):
                print(export_run(form, folder, output or folder / form, Store(cache_folder(cache))))
    return COMPLETE
