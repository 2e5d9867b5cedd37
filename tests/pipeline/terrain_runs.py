"""A run's folder with a small terrain, written by the products' own functions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from rille.datasets.georeference import Georeference
from rille.pipeline.export.writers import Meaning, write_raster, write_trajectory_kitti
from rille.stages.geometry.lattice import Lattice

LATTICE = Lattice.at(-20, 90, 0.05, 60, 70)
PLACE = Georeference("EPSG:32633", (500100.0, 5200200.0, 1800.0), 0.6)


def hills(xy: np.ndarray) -> np.ndarray:
    return 0.1 * np.sin(2.0 * xy[..., 0]) * np.cos(1.5 * xy[..., 1]) - 0.5


def elevation() -> np.ndarray:
    z = hills(LATTICE.xy()).astype(np.float32)
    z[:9, :11] = np.nan
    return z


def finished(folder: Path, place: Georeference | None = None, lift: float = 0.0) -> Path:
    z = elevation() + np.float32(lift)
    height = z if place is None else (z.astype(np.float64) + place.origin[2]).astype(np.float32)
    nan = float("nan")
    write_raster(folder / "dem.tif", {"elevation": height}, LATTICE, Meaning("m"), place)
    sigma = np.where(np.isfinite(z), np.float32(0.004), np.float32(nan))
    write_raster(folder / "dem_sigma.tif", {"elevation_std": sigma}, LATTICE, Meaning("m"), place)
    grey = np.where(np.isfinite(z), np.mgrid[: LATTICE.rows, : LATTICE.cols][1] * 3.0, nan).astype(np.float32)
    write_raster(folder / "ortho.tif", {"ortho": grey}, LATTICE, Meaning(), place)
    pose = np.hstack([np.eye(3), [[0.0], [1.0], [0.2]]])
    write_trajectory_kitti(folder / "trajectory.kitti", np.array([pose]))
    facts = {"georeference": None if place is None else place.to_dict()}
    (folder / "frames.json").write_text(json.dumps(facts))
    return folder
