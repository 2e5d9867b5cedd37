"""What a run leaves in its folder: products of the artifacts, then the report over them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.engine.graph import Graph, Handle
from pipeline.engine.store.folder import GoneError, Store
from pipeline.export import writers as files
from pipeline.export.frames_json import describe
from pipeline.export.terrain_zarr import write_terrain
from pipeline.report import RunView, TaskRow, draw, write_report
from pipeline.report.canvas import ground_limits
from pipeline.report.comparison import compare
from pipeline.runs.early import Early
from stages.core.declare import Array, Bundle
from stages.geometry.lattice import Lattice, mosaic, union
from stages.geometry.pose_arrays import NO_VERTICAL
from stages.hazard.risk import REASONS
from stages.hazard.risk import STAGE as RISK
from stages.odometry.resection.trajectory import world_poses
from stages.terrain import merge
from stages.terrain.shading import hillshade, slope_deg

SLOPE = Array("slope", ("row", "col"), "float32", "degree", "inclination of the terrain", "nan", "world")
Lookup = Callable[[Any], Bundle | None]


def bundles(store: Store) -> Lookup:
    """The artifact of a handle; None where it was not delivered."""

    def find(handle: Handle | None) -> Bundle | None:
        return None if handle is None or handle.ref is None else store.open(handle.ref)

    return find


def task_rows(graph: Graph, store: Store) -> tuple[TaskRow, ...]:
    """One row a task, with the seconds that it took whenever it was computed."""
    rows = []
    for h in graph.nodes:
        seconds: float | None = h.seconds if h.status == "computed" else None
        if h.status == "cached":
            manifest = store.manifest(h.stage, h.key)
            seconds = float(manifest["provenance"]["seconds"]) if manifest else None
        reason = " ".join(str(h.error).split()) if h.error is not None else h.reason
        rows.append(TaskRow(h.label, h.stage, h.status, seconds, reason))  # type: ignore[arg-type]
    return tuple(rows)


def write(folder: Path, view: RunView, early: Early) -> None:
    """All files of a run; what has no artifact is left out (the report says so). ``early`` was made before."""
    with ThreadPoolExecutor(1) as pool:  # rasters are computed and compressed while figures are drawn
        files = pool.submit(_write_files, folder, view, early.files)
        try:
            drawn = draw(view, early.figures)
        except GoneError:  # the other one may have set it aside, and says why
            files.result()
            raise
        files.result()
    _write_trajectories(folder, view)
    write_report(folder, view, drawn)


def _write_files(folder: Path, view: RunView, early: Mapping[str, Path]) -> None:
    for name, writer in WRITERS.items():
        if name not in early:
            writer(folder, view)
            continue
        for file in sorted(early[name].iterdir()):
            file.rename(folder / file.name)


def _write_terrain(folder: Path, view: RunView) -> None:
    tiles = [view.bundle(tile) for tile in view.products.tiles]
    if tiles and all(tiles):  # a hole in the run must not look like unknown terrain
        _write_tiles(folder, view, [t for t in tiles if t is not None])


def _write_path(folder: Path, view: RunView) -> None:
    path = view.bundle(view.products.path)
    if path is not None:
        facts = {k: v for k, v in path.meta.items() if not isinstance(v, dict)}
        files.write_path_geojson(folder / "path.geojson", np.asarray(path["path"]), facts)
        files.write_path_gpkg(folder / "path.gpkg", np.asarray(path["path"]), facts, view.sequence.georeference)


def _write_risk(folder: Path, view: RunView) -> None:
    """Class, measures in metres and degrees, probability and reasons in one file, so all of one type (float32)."""
    risk, place = view.bundle(view.products.risk), view.sequence.georeference
    if risk is None:
        return
    units = {a.name: a.unit for a in RISK.outputs if a.unit in ("m", "rad") and a.name != "elevation"}
    bands = {"class": risk["risk"], "reason": risk["reason"], "p_hazard": risk["p_hazard"], "filled": risk["filled"]}
    bands |= {name: np.degrees(risk[name]) if unit == "rad" else risk[name] for name, unit in units.items()}
    unit = {name: {"rad": "degree"}.get(units.get(name, ""), units.get(name, "")) for name in bands}
    tags = {
        "classes": "0 safe, 1 caution, 2 hazard, 3 unknown (never entered)",
        "reason_bits": ", ".join(f"{bit} {name}" for name, bit in REASONS.items()),
        "vehicle": json.dumps(risk.meta.get("vehicle", {})),
    }
    given = {name: np.asarray(values, dtype=np.float32) for name, values in bands.items()}
    files.write_raster(
        folder / "risk.tif", given, Lattice.from_dict(risk.meta["lattice"]), unit=unit, nodata=float("nan"),
        tags=tags, place=place, overviews="nearest",
    )  # fmt: skip
    files.write_style(folder / "risk.qml", "risk")


def _write_trajectories(folder: Path, view: RunView) -> None:
    """The trajectory, that of the crosscheck beside it, and what the frames of all files are."""
    times, names = view.sequence.times, view.sequence.frame_names
    stamps = [float(f) if times is None else times[f] for f in view.frames]
    trajectory, compared = view.bundle(view.products.trajectory), compare(view)
    facts = {} if trajectory is None else trajectory.meta
    verticals, main = list(facts.get("verticals", [""])), int(facts.get("main", 0))
    worlds = [files.UNLEVELLED if source == NO_VERTICAL else files.FRAME for source in verticals]
    if trajectory is not None:
        files.write_trajectory_kitti(folder / "trajectory.kitti", world_poses(trajectory))
        files.write_trajectory_tum(folder / "trajectory.tum", world_poses(trajectory), stamps, worlds[main])
        for number, words in enumerate(worlds):
            if number != main:
                path = folder / f"trajectory.piece{number + 1}.tum"
                files.write_trajectory_tum(path, world_poses(trajectory, number), stamps, words)
    if compared is not None:
        positions = world_poses(trajectory)[:, :, 3] if trajectory is not None else None
        columns = {"frame": view.frames, "name": [names[f] for f in view.frames], "time_s": stamps}
        columns |= {} if positions is None else {f"{a}_m": positions[:, k].tolist() for k, a in enumerate("xyz")}
        columns |= {f"crosscheck_{a}_m": compared.poses[:, k, 3].tolist() for k, a in enumerate("xyz")}
        files.write_trajectory_tum(folder / "crosscheck.tum", compared.poses, stamps)
        files.write_table(folder / "agreement.csv", columns | compared.columns())
    written = [file.name for file in folder.iterdir()]
    chosen = [names[f] for f in view.frames]
    described = describe(
        written,
        view.frames,
        chosen,
        stamps,
        clock=times is not None,
        place=view.sequence.georeference,
        vertical=verticals[main],
    )
    files.write_text(folder / "frames.json", json.dumps(described, indent=1) + "\n")


def _write_tiles(folder: Path, view: RunView, tiles: list[Bundle]) -> None:
    """Merged rasters, assembled from world tiles, what is derived of the elevation, its style, and all as zarr."""
    lattices, place = [Lattice.from_dict(t.meta["lattice"]) for t in tiles], view.sequence.georeference
    whole = union(lattices)
    arrays = {}
    for spec in merge.STAGE.outputs:
        if spec.dims == ("row", "col") and all(spec.name in t.arrays for t in tiles):
            parts = [(part, np.asarray(t[spec.name])) for part, t in zip(lattices, tiles, strict=True)]
            arrays[spec.name] = (
                spec,
                mosaic(parts, np.nan if spec.nodata == "nan" else float(spec.nodata or 0), whole),
            )
    elevation = arrays["elevation"][1]
    height = elevation if place is None else (elevation.astype(np.float64) + place.origin[2])
    slope = slope_deg(elevation, whole.cell)
    rasters = {
        "dem": ("elevation", height, "m"),
        "dem_sigma": ("elevation_std", arrays["elevation_std"][1], "m"),
        "ortho": ("ortho", arrays["ortho"][1], ""),
        "slope": ("slope", slope, "degree"),
    }
    for file, (name, values, unit) in rasters.items():
        bands = {name: np.asarray(values, np.float32)}
        files.write_raster(folder / f"{file}.tif", bands, whole, unit=unit, nodata=float("nan"), place=place)
    shade, light = hillshade(elevation, whole.cell), {"light": "from the upper left (315 degrees), 45 degrees high"}
    files.write_raster(
        folder / "hillshade.tif", {"hillshade": shade}, whole, unit="", nodata=0, tags=light, place=place
    )
    low, high = ground_limits(height)
    files.write_style(folder / "dem.qml", "dem", {f"e{k}": low + (high - low) * k / 8 for k in range(9)})
    arrays["slope"] = (SLOPE, slope)
    about = {
        "title": f"Merged terrain of the sequence {view.sequence.name}",
        "source": "stereo images: disparity by HFVM, elevation models by Locus, merged; Rille "
        + view.versions.get("rille", ""),
        "history": view.command,
    }
    write_terrain(folder / "terrain.zarr", arrays, whole, place, about)


WRITERS: Mapping[str, Callable[[Path, RunView], None]] = {
    "terrain": _write_terrain,
    "risk": _write_risk,
    "path": _write_path,
}
"""What writes files of artifacts alone, each of its own; it may be called before the run has ended."""
