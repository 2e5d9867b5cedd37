"""``rille localize RUN DEM``: place of a run's terrain in a map, with covariance, unless it is ambiguous."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter
from cyclopts.validators import Number
from rasterio.crs import CRS

from rille.datasets.georeference import Georeference
from rille.pipeline.commands.results.run_terrain import RunTerrain
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.paths import write_path
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.read_dem import crs_name, frames_of, read_elevation, read_ortho, refuse_unlike_systems
from rille.pipeline.export.writers import ENGINEERING_CRS, write_json, write_trajectory_tum
from rille.pipeline.python import runs as opened
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import COMPLETE, HOLES, RUNS, CacheFolder, Output, Run, Runs, cache_folder, output_file
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import ConfigError, DegenerateError, InputError
from rille.stages.evaluation.joint_terrain import TURN_DEG, locate, numbers
from rille.stages.terrain.map_localization import Placement, SearchArea

MAP_CRS = ENGINEERING_CRS.replace("Rille world frame", "frame of a map")
"""CRS for coordinates of a map that states none."""


@Parameter(name="*")
@dataclass(frozen=True)
class Area:
    """What of a map is searched.

    Parameters
    ----------
    near
        About where the world's origin is: x,y or x,y,yaw in the map's coordinates, metres, and degrees to the left from
        the map's x axis to that of the world; everywhere by default.
    within
        Distance from there that is searched, metres; all of the map by default.
    """

    near: str | None = None
    within: Annotated[float | None, Parameter(validator=Number(gt=0))] = None

    def around(self) -> SearchArea | None:
        """The area in numbers; None: everywhere.

        Raises
        ------
        ConfigError
            It is no place.
        """
        if self.near is None:
            if self.within is not None:
                raise ConfigError("RIL-846", "--within without --near", remedy="say near what: --near x,y")
            return None
        try:
            x, y, *yaw = (float(word) for word in self.near.split(","))
            if len(yaw) > 1 or not np.isfinite([x, y, *yaw]).all():
                raise ValueError
        except ValueError:
            text = f"--near {self.near!r} is not x,y or x,y,yaw"
            raise ConfigError("RIL-847", text, remedy="write e.g. --near 612.5,88.0,30") from None
        turn = math.radians(TURN_DEG) if yaw else math.pi
        return SearchArea(x, y, math.radians(sum(yaw)), self.within or math.inf, turn)


def for_file(placed: Placement) -> dict[str, Any]:
    """Facts for the JSON file."""
    known = np.isfinite(np.diag(placed.covariance))
    return {
        "T_map_world": placed.pose.to_list(),
        "place": {name: value for name, (value, _) in numbers(placed).items()},
        "sigma": {name: sigma for name, (_, sigma) in numbers(placed).items()},
        "covariance_m_rad": placed.covariance[np.ix_(known, known)].tolist(),
        **placed.figures,
    }


def table(placed: Placement) -> Iterator[str]:
    """A line for each number."""
    for name, (value, sigma) in numbers(placed).items():
        word, _, unit = name.rpartition("_")
        digits = min(6, max(0, 1 - math.floor(math.log10(max(sigma, 1e-6)))))
        yield f"  {word:10s} {value:.{digits}f} +- {sigma:.{digits}f} {unit}"


def for_manifest(placed: Placement, crs: str) -> Iterator[str]:
    """Lines of a manifest that state the place; none where the map has no code of a CRS, or no height is known."""
    code, known = CRS.from_user_input(crs).to_epsg() if crs else None, numbers(placed)
    if code is not None and "z_m" in known:
        origin = ", ".join(f"{known[name][0]:.4f}" for name in ("x_m", "y_m", "z_m"))
        # Azimuths go clockwise from north, yaw to the left.
        azimuth = -known["yaw_deg"][0] % 360.0
        yield f'\nnext         in the manifest:\n\n[world]\ncrs = "EPSG:{code}"'
        yield f"origin = [{origin}]\nazimuth_deg = {azimuth:.3f}"


def about(figures: Mapping[str, Any]) -> Iterator[str]:
    """Lines on the registration of a place."""
    if "cells" in figures:
        relief = f"RMS {figures['rms']:.3g} m, {max(figures['explained'], 0.0):.0%} of the relief explained"
        cells = f"{figures['cells']} cells ({figures['independent']:.0f} independent)"
        yield f"fit          {cells}, {figures['overlap']:.0%} of the terrain; {relief}"
        rival = "next best place ({x_m:.2f}, {y_m:.2f}) m: chi2 larger by {chi2:.0f}, {wanted:g} wanted"
        yield f"ambiguity    {rival.format(**figures['other']) if 'other' in figures else 'no other place'}"
    if "keypoints" in figures:
        yield f"ortho        {figures['keypoints']} keypoints agree"


def localize(
    run: Run,
    dem: Path | None = None,
    *,
    ortho: Path | None = None,
    area: Area = Area(),
    output: Annotated[Path, Output] = Path("localization"),
    runs: Runs = RUNS,
    cache: CacheFolder = None,
) -> int:
    """Find where the terrain of a run lies in an elevation model or an ortho image of a larger area.

    Prints the place of the run's world frame with standard deviations, and the next best place. If that fits nearly as
    well, the answer is "ambiguous" and the exit status 3. Writes OUTPUT.json and, unless it is ambiguous, trajectory
    and path in the map's coordinates: OUTPUT.tum, OUTPUT.gpkg.

    Parameters
    ----------
    dem
        Elevation model: GeoTIFF or ESRI ASCII grid in metres, as fine as the run's or up to 20 times coarser.
    ortho
        Ortho image, GeoTIFF; beside an elevation model, or instead of it: z is then not found.
    output
        Files to write, without ending.
    """
    written = [output_file(output, ".json")]
    if dem is None and ortho is None:
        raise ConfigError("RIL-844", "no map is given", remedy="name an elevation model, or --ortho IMAGE")
    folder, systems, model, image = lookup.find(run, runs), dict[str, str](), None, None
    around, terrain = area.around(), RunTerrain.of(folder)
    if ortho is not None:
        image, systems[str(ortho)] = read_ortho(ortho)
    if dem is not None:
        model = read_elevation(dem)
        systems[str(dem)] = model.crs
    crs = next((wkt for wkt in reversed(systems.values()) if wkt), "")
    if terrain.place is not None:
        systems[f"run {terrain.name}"] = CRS.from_user_input(terrain.place.crs).to_wkt(version="WKT2_2019")
    refuse_unlike_systems(systems)
    for line in () if model is None else model.warnings:
        warn(line)
    found, why = None, ""
    try:
        # Standard deviation, degrees, of a vertical by a sensor, and of one by the ground.
        tilt = 0.5 if terrain.vertical == "attitude" else 5.0
        found = locate(terrain, image, None if model is None else model.grid, around, tilt, warn)
        why = found.doubt
    except DegenerateError as error:
        why = f"{error.code}: {error}"
    # Files of an earlier place would be taken for those of this run.
    for ending in (".tum", ".gpkg"):
        output_file(output, ending).unlink(missing_ok=True)
    facts: dict[str, Any] = {"run": terrain.name, "dem": dem and str(dem), "ortho": ortho and str(ortho), "crs": crs}
    facts |= {"ambiguous": bool(why), "why": why, **({} if found is None else for_file(found))}
    write_json(written[0], facts)
    if found is None or why:
        lines = [f"ambiguous    {why}"]
    else:
        written += _export(folder, found, output, crs, Store(cache_folder(cache)))
        lines = [f"place        of the world's origin{f' in {crs_name(crs)}' if crs else ''}, yaw to the left"]
        lines += table(found)
    print("\n".join([*lines, *(() if found is None else about(found.figures))]))
    print("wrote        " + "  ".join(map(str, written)))
    # The origin of a manifest is that of the sequence's first frame.
    if found is not None and not why and frames_of(folder / "frames.json")["frames"][0]["frame"] == 0:
        for line in for_manifest(found, crs):
            print(line)
    return HOLES if why else COMPLETE


def _export(folder: Path, found: Placement, output: Path, crs: str, store: Store) -> Iterator[Path]:
    """Write trajectory and path in the map's coordinates; yield the files."""
    words = f"of the map{f', {crs_name(crs)}' if crs else ''}: T_map_world of {output_file(output, '.json').name}"
    if (folder / "trajectory.kitti").exists():
        known = opened.Run(folder).trajectory
        turned, there = found.pose.rotation @ known["rotation"].values, found.pose.apply(known["position"].values)
        poses = np.concatenate([turned, there[..., None]], axis=2)
        write_trajectory_tum(output_file(output, ".tum"), poses, known["time"].values.tolist(), words)
        yield output_file(output, ".tum")
    try:
        with lookup.reading(folder):
            planned = RunArtifacts(folder, store).find("path/world")
    except InputError as error:
        warn(f"{error.code}: {error}; no path is written")
        return
    if planned is not None:
        moved = Bundle({"path": found.pose.apply(np.asarray(planned["path"]))}, {**planned.meta, "frame": words})
        write_path(output_file(output, ".gpkg"), moved, Georeference(crs or MAP_CRS, (0.0, 0.0, 0.0), 0.0))
        yield output_file(output, ".gpkg")
