"""What a run leaves in its folder: products of the artifacts, then the report over them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline import products as files
from pipeline.conventions import describe
from pipeline.dag import Graph, Handle
from pipeline.report import RunView, TaskRow, write_report
from pipeline.report.artifacts import by_frame
from pipeline.report.canvas import ground_limits
from pipeline.report.comparison import compare
from pipeline.store import Store
from stages.declare import Bundle
from stages.lattice import Lattice, mosaic, union
from stages.risk import REASONS

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


def write(folder: Path, view: RunView) -> None:
    """All files of a run; what has no artifact is left out (the report says so)."""
    find, p = view.bundle, view.products
    tiles = [find(tile) for tile in p.tiles]
    if tiles and all(tiles):  # a hole in the run must not look like unknown terrain
        _write_terrain(folder, [t for t in tiles if t is not None])
    risk = find(p.risk)
    if risk is not None:
        bands = {"class": risk["risk"], "reason": risk["reason"], "filled": risk["filled"]}
        reasons = ", ".join(f"{bit} {name}" for name, bit in REASONS.items())
        tags = {"classes": "0 safe, 1 hazardous, 2 unknown (never safe)", "reason_bits": reasons}
        lattice = Lattice.from_dict(risk.meta["lattice"])
        files.write_raster(folder / "risk.tif", bands, lattice, unit="", nodata=None, tags=tags)
        files.write_style(folder / "risk.qml", "risk")
    path = find(p.path)
    if path is not None:
        facts = {k: v for k, v in path.meta.items() if not isinstance(v, dict)}
        files.write_path_geojson(folder / "path.geojson", np.asarray(path["path"]), facts)
        files.write_path_gpkg(folder / "path.gpkg", np.asarray(path["path"]), facts)
    _write_trajectories(folder, view)
    write_report(folder, view)


def _write_trajectories(folder: Path, view: RunView) -> None:
    """The trajectory, that of the crosscheck beside it, and what the frames of all files are."""
    times, names = view.sequence.times, view.sequence.frame_names
    stamps = [float(f) if times is None else times[f] for f in view.frames]
    trajectory, compared = view.bundle(view.products.trajectory), compare(view)
    if trajectory is not None:
        poses = np.asarray(trajectory["poses"])
        files.write_trajectory_kitti(folder / "trajectory.kitti", poses)
        files.write_trajectory_tum(folder / "trajectory.tum", poses, stamps)
    if compared is not None:
        positions = by_frame(view, trajectory, "poses")[:, :, 3] if trajectory is not None else None
        columns = {"frame": view.frames, "name": [names[f] for f in view.frames], "time_s": stamps}
        columns |= {} if positions is None else {f"{a}_m": positions[:, k].tolist() for k, a in enumerate("xyz")}
        columns |= {f"crosscheck_{a}_m": compared.poses[:, k, 3].tolist() for k, a in enumerate("xyz")}
        files.write_trajectory_tum(folder / "crosscheck.tum", compared.poses, stamps)
        files.write_table(folder / "agreement.csv", columns | compared.columns())
    written = [file.name for file in folder.iterdir()]
    chosen = [names[f] for f in view.frames]
    facts = describe(written, view.frames, chosen, stamps, clock=times is not None)
    files.write_text(folder / "frames.json", json.dumps(facts, indent=1) + "\n")


def _write_terrain(folder: Path, tiles: list[Bundle]) -> None:
    """Merged rasters, assembled from world tiles, and the style of the elevation."""
    lattices = [Lattice.from_dict(t.meta["lattice"]) for t in tiles]
    whole = union(lattices)
    for file, array, unit in (("dem", "elevation", "m"), ("dem_sigma", "elevation_std", "m"), ("ortho", "ortho", "")):
        values = mosaic([(part, t[array]) for part, t in zip(lattices, tiles, strict=True)], np.nan, whole)
        bands = {array: values.astype(np.float32)}
        files.write_raster(folder / f"{file}.tif", bands, whole, unit=unit, nodata=float("nan"))
        if file == "dem":
            low, high = ground_limits(values)
            steps = {f"e{k}": low + (high - low) * k / 8 for k in range(9)}
            files.write_style(folder / "dem.qml", "dem", steps)
