"""Folders of runs with the terrain of one known ground in a frame of their own, and maps of it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import scipy
from affine import Affine
from numpy.typing import NDArray

from rille.datasets.georeference import Georeference
from rille.pipeline.export.terrain_zarr import write_terrain
from rille.pipeline.export.writers import write_trajectory_kitti
from rille.stages.core.declare import raster
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice

Floats = NDArray[np.float64]
CELL, SIGMA = 0.02, 0.001


def height(x: Floats, y: Floats, seed: int = 4) -> Floats:
    """Relief without a period, m."""
    rng = np.random.default_rng(seed)
    z = np.zeros_like(x)
    for _ in range(14):
        a, b, phase = rng.uniform(-6, 6), rng.uniform(-6, 6), rng.uniform(0, 6.3)
        z += 0.03 * np.sin(a * x + b * y + phase)
    return z


def grey(x: Floats, y: Floats, seed: int = 4) -> Floats:
    """Texture of several scales, 0..255; known from -4 to 4 m."""
    rng = np.random.default_rng(seed)
    out = np.full(x.shape, 128.0)
    for n in (40, 80, 160, 320):
        at = np.stack([y, x]) * (n / 8.0) + n / 2.0
        out += 25.0 * scipy.ndimage.map_coordinates(rng.normal(size=(n, n)), at, order=3, mode="nearest")
    return np.clip(out, 0, 255)


@dataclass(frozen=True)
class Frame:
    """A run's world frame on the ground: x, y, z, m, yaw and tilt about x, degrees; ``seed`` of the ground."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    tilt: float = 0.0
    seed: int = 4

    @property
    def pose(self) -> RigidTransform:
        turn = rotation_exp([0.0, 0.0, math.radians(self.yaw)]) @ rotation_exp([math.radians(self.tilt), 0.0, 0.0])
        return RigidTransform(turn, np.array([self.x, self.y, self.z]))


def made_run(folder: Path, frame: Frame, place: Georeference | None = None, **more: Any) -> Path:
    """A run that saw 3 x 2.4 m ahead of its origin, but for a corner."""
    lattice = Lattice.snap((-1.5, 1.5, 0.2, 2.6), more.get("cell", CELL))
    xy, pose = lattice.xy(), frame.pose
    z = np.zeros(lattice.shape)
    for _ in range(6):  # the point of the ground above each cell of a tilted frame
        there = pose.apply(np.concatenate([xy, z[..., None]], axis=-1))
        z += (height(there[..., 0], there[..., 1], frame.seed) - there[..., 2]) / pose.rotation[2, 2]
    rng = np.random.default_rng(more.get("noise", 1))
    elevation = z + SIGMA * rng.standard_normal(lattice.shape)
    elevation[:20, :30] = np.nan
    values = {
        "elevation": elevation * more.get("known", 1.0),
        "elevation_std": np.full(lattice.shape, SIGMA),
        "ortho": np.where(
            np.isfinite(elevation), grey(there[..., 0], there[..., 1], more.get("light", frame.seed)), np.nan
        ),
    }
    arrays = {
        name: (raster(name, "m", name, "float32", "nan", "world"), v.astype(np.float32)) for name, v in values.items()
    }
    folder.mkdir(parents=True)
    write_terrain(folder / "terrain.zarr", arrays, lattice, place, {"title": "made"})
    world = {"definition": "made", "vertical": more.get("vertical", "attitude")}
    frames = [{"frame": 0, "name": "0", "time": 0.0}]
    facts = {
        "units": {"time": "s"},
        "frames_of_reference": {"world": world},
        "frames": frames,
        "georeference": None if place is None else place.to_dict(),
    }
    (folder / "frames.json").write_text(json.dumps(facts))
    (folder / "ledger.jsonl").write_text("")
    write_trajectory_kitti(folder / "trajectory.kitti", np.array([np.hstack([np.eye(3), [[0.1], [0.2], [0.3]]])]))
    return folder


def made_map(path: Path, values: NDArray[Any], transform: Affine, **more: Any) -> Path:
    about = {"height": values.shape[0], "width": values.shape[1], "dtype": values.dtype.name} | more
    with rasterio.open(path, "w", driver="GTiff", count=1, transform=transform, **about) as file:
        file.write(values, 1)
        file.units = ("metre",)
    return path


def centres(rows: int, cols: int, transform: Affine) -> tuple[Floats, Floats]:
    """x, y (row, col) of the cells of a map."""
    col, row = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    t = transform
    return t.a * col + t.b * row + t.c, t.d * col + t.e * row + t.f
