"""One simulated pair each: images, Rille's elevation model of them, and the exact elevations far around it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.mockup.params import MockupParams
from datasets.mockup.sequence import mockup
from datasets.protocol import Source
from stages.geometry import Rig, RigidTransform
from stages.hfvm import match
from stages.lattice import Lattice
from stages.level import LevelParams, level, z_range
from stages.locus import LocusParams, local_lattice, reconstruct, usable
from stages.surface import plane
from stages.validity import matched
from stages.vehicle import Vehicle

Floats32 = NDArray[np.float32]

CELL = 0.001
BED = {"frames": 1, "bed_width": 1.3, "bed_length": 1.3}
PAD = 0.12
"""Metres of exact elevations around a model: what a vehicle at its border stands on."""


@dataclass(frozen=True)
class Scene:
    """Arrays (row, col) on ``lattice``; ``exact`` on ``wide``, which is ``PAD`` larger on every side.

    ``seen``: both cameras see the cell's true surface. ``level``: facts of stage ``level``.
    """

    seed: int
    cover: float
    slope_deg: float
    vehicle: Vehicle
    lattice: Lattice
    wide: Lattice
    elevation: Floats32
    elevation_std: Floats32
    exact: Floats32
    seen: NDArray[np.bool_]
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    rig: Rig
    T_local_left: RigidTransform
    z_range: tuple[float, float]

    def crop(self, array: NDArray[Any]) -> NDArray[Any]:
        """Part of an array on ``wide`` that lies on ``lattice``."""
        return array[self.wide.window(self.lattice)]


def fetcher() -> Callable[[Source], Any]:
    """Runs sources and keeps those without arguments (the bed)."""
    kept: dict[str, Any] = {}

    def run(source: Source) -> Any:
        key = f"{source.module} {source.params!r}"
        if not source.args and key in kept:
            return kept[key]
        inputs = {port: run(upstream) for port, upstream in source.inputs.items()}
        out = importlib.import_module(source.module).STAGE.run(source.params, dict(source.args), inputs)
        if not source.args:
            kept[key] = out
        return out

    return run


def build(seed: int, cover: float, slope_deg: float) -> Scene:
    """Simulate a pair and reconstruct it with default parameters."""
    sequence = mockup(MockupParams(**BED, seed=seed, rock_cover=cover, slope_deg=slope_deg))
    fetch = fetcher()
    left, right = (fetch(sequence.image(0, camera)) for camera in ("left", "right"))
    found = match(left["image"], right["image"], left_valid=left["valid"], right_valid=right["valid"])
    up = None if sequence.up is None else sequence.up[0]
    measured = matched(found.validity)
    args = found.column_disparity, found.row_disparity, measured, sequence.rig, LevelParams()
    facts = level(*args, up=up, pitch=sequence.pitch)
    params = LocusParams(cell_size=CELL, max_sigma=CELL)
    lattice = local_lattice(sequence.rig, facts, CELL, params)
    T_local_left = RigidTransform.from_matrix(facts["T_local_left"])
    low, high = z_range(facts["plane"], facts["relief"], list(lattice.bounds))
    dem = reconstruct(
        found.column_disparity, found.row_disparity, usable(found.validity, found.backmatch_error, params),
        np.asarray(left["image"], np.float32), sequence.rig, T_local_left, plane(lattice), (low, high), params,
        disparity_std=found.disparity_std,
    )  # fmt: skip
    assert sequence.truth is not None
    assert sequence.truth_dem is not None
    n = round(PAD / CELL)
    wide = Lattice.at(lattice.i0 - n, lattice.j0 + n, CELL, lattice.rows + 2 * n, lattice.cols + 2 * n)
    exact = fetch(sequence.truth_dem(wide.to_dict(), sequence.truth[0] @ T_local_left.inverse(), (0,)))
    seen = np.asarray(exact["seen"]) != 0
    return Scene(
        seed, cover, slope_deg, sequence.vehicle, lattice, wide, dem.elevation, dem.elevation_std,
        np.asarray(exact["elevation"], np.float32), seen[wide.window(lattice)],
        (np.asarray(left["image"]), np.asarray(right["image"])), sequence.rig, T_local_left, (low, high),
    )  # fmt: skip
