"""``rille merge RUN RUN``: the terrains of several runs of one place as one, in the world frame of the first."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np

from rille.datasets.georeference import Georeference
from rille.pipeline.commands.results.run_terrain import RunTerrain
from rille.pipeline.engine.plain import warn
from rille.pipeline.export.read_dem import refuse_unlike_systems
from rille.pipeline.export.writers import Meaning, check_folder, write_json, write_raster
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import RUNS, Output, Run, Runs
from rille.stages.core.errors import ConfigError, InputError
from rille.stages.core.quantities import metres
from rille.stages.evaluation.joint_terrain import Session, joined, registered
from rille.stages.geometry.geometry import RigidTransform, heading_of, rotation_exp


def merge(run: Run, *more: Run, output: Annotated[Path, Output], runs: Runs = RUNS) -> None:
    """Merge the terrains of several runs of one place: dem.tif, dem_sigma.tif and ortho.tif in the first run's frame.

    Runs with georeferences in one system are laid by these, others by ortho images or relief; then elevations decide,
    with stated standard deviations, which those of the merged terrain contain. Prints how far the runs differ.

    Parameters
    ----------
    more
        Others.
    output
        Folder to write.
    """
    folders = [lookup.find(name, runs) for name in (run, *more)]
    if len(set(folders)) < 2:
        raise ConfigError("RIL-849", "one run alone is merged with nothing", remedy="name two runs of one place")
    check_folder(output, "merge.json")
    first, *others = terrains = [RunTerrain.of(folder) for folder in dict.fromkeys(folders)]
    for a, b in combinations(terrains, 2):
        if np.array_equal(a.arrays["elevation"], b.arrays["elevation"], equal_nan=True):
            text = f"{a.name} and {b.name} are one terrain, to the bit, which would count twice"
            raise InputError("RIL-968", text, remedy="name one of them")
    for line in lookup.shared_images(dict.fromkeys(folders)):
        warn(line)
    sessions = [registered(first, other, _stated(first, other), warn) for other in others]
    lattice, merged = joined(first, sessions)
    height = merged.elevation if first.place is None else merged.elevation + first.place.origin[2]
    # First, since it marks the folder as ours, so that the same command can continue after a kill.
    facts = {"frame_of": first.name, "runs": [dict(one.facts) for one in sessions]}
    write_json(output / "merge.json", facts)
    for name, band, values, unit in (
        ("dem.tif", "elevation", height, "m"),
        ("dem_sigma.tif", "elevation_std", merged.elevation_std, "m"),
        ("ortho.tif", "ortho", merged.ortho, ""),
    ):
        write_raster(output / name, {band: np.asarray(values, np.float32)}, lattice, Meaning(unit), first.place)
    for one in sessions:
        print(_line(one))
    known, several = int(np.isfinite(merged.elevation).sum()), int((merged.count > 1).sum())
    cells = f"{known} cells of {lattice.cell:g} m, {several} of several runs"
    print(f"{output}: dem.tif, dem_sigma.tif, ortho.tif, merge.json: {cells}")


def _stated(first: RunTerrain, other: RunTerrain) -> RigidTransform | None:
    """T_first_world of a run by the georeferences of both, if they have them.

    Raises
    ------
    InputError
        Their systems differ.
    """
    if first.place is None or other.place is None:
        return None
    refuse_unlike_systems({other.name: other.place.crs, first.name: first.place.crs})
    return _in_system(first.place).inverse() @ _in_system(other.place)


def _in_system(place: Georeference) -> RigidTransform:
    """T_system_world of a georeference."""
    return RigidTransform(rotation_exp([0.0, 0.0, -place.azimuth]), np.array(place.origin))


def _line(one: Session) -> str:
    """Line on the registration of a run and its differences."""
    x, y, z = one.pose.translation
    overlap = one.facts["overlap"]
    turned, turn = math.degrees(heading_of(one.pose)), math.degrees(one.sigma[5])
    sigma = f"sigma {', '.join(map(metres, one.sigma[:3]))}, {turn:.2g} degrees; by {one.facts['by']}"
    median, nmad, p95 = (metres(overlap[name], signed=name == "median") for name in ("median", "nmad", "p95"))
    common = f"{overlap['cells']:.0f} cells in common: median {median}, NMAD {nmad}, 95 % {p95}"
    return f"{one.terrain.name}: at {x:.4g}, {y:.4g}, {z:.4g} m, turned by {turned:.3f} degrees ({sigma}); {common}"
