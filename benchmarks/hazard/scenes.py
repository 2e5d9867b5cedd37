"""One simulated pair each: images, Rille's elevation models of them, and the exact elevations far around.

The vertical is told by an inclinometer that errs; the elevation model of the exact one stands beside it. Both lie on
one lattice, and what is exact is so in the exact frame: an error of the vertical is one of the map.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.mockup.params import MockupParams
from rille.datasets.mockup.sequence import mockup
from rille.datasets.protocol import Source
from rille.pipeline.engine.task import resolve
from rille.pipeline.flow import config
from rille.stages.core.validity import matched_back
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.hfvm.stage import match
from rille.stages.terrain.ground import view_ground
from rille.stages.terrain.ground_frame import GroundFrameParams, VerticalHint, level, z_range
from rille.stages.terrain.locus.solve import LocusParams
from rille.stages.terrain.locus.stage import MatchedPair, local_lattice, reconstruct
from rille.stages.terrain.matches import Matches

Floats32 = NDArray[np.float32]

CELL = 0.001
BED = {"frames": 1, "bed_width": 1.3, "bed_length": 1.3}
PAD = 0.12
"""Metres of exact elevations around a model: what a vehicle at its border stands on."""


ATTITUDE_DEG = 0.2
"""Error of the inclinometer about each axis, degrees, as that of the simulated rover."""

MADE_BY = (
    "benchmarks/hazard/scenes.py", "pipeline/flow/config.py", "datasets/mockup/*.py", "stages/hfvm/**/*.py",
    "stages/terrain/ground_frame.py", "stages/terrain/ground.py", "stages/terrain/locus/*.py",
    "stages/geometry/lattice.py", "stages/core/validity.py",
)  # fmt: skip
"""Modules by which a scene is made: one that was kept is used as long as none of them changes."""


@dataclass(frozen=True)
class Scene:
    """Arrays (row, col) on ``lattice``; ``exact`` on ``wide``, which is ``PAD`` larger on every side.

    ``elevation`` with the inclinometer's vertical, ``posed`` with the exact one, each with its standard deviation.
    """

    seed: int
    cover: float
    slope_deg: float
    vehicle: Vehicle
    lattice: Lattice
    wide: Lattice
    elevation: Floats32
    elevation_std: Floats32
    posed: Floats32
    posed_std: Floats32
    exact: Floats32
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
        out = resolve(source.module).run(source.params, dict(source.args), inputs)
        if not source.args:
            kept[key] = out
        return out

    return run


@dataclass(frozen=True)
class Pair:
    """A matched pair: its images, disparities of the left one and, with ``locus.both``, of the right one."""

    images: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    rig: Rig
    params: LocusParams
    forth: Any
    back: Any

    def matches(self, found: Any) -> Matches:
        good = matched_back(found.validity, found.backmatch_error)
        return Matches(found.column_disparity, found.row_disparity, good, found.disparity_std)


def build(seed: int, cover: float, slope_deg: float, preset: str = "default") -> Scene:
    """Simulate a pair and reconstruct it as a run with this preset of the terrain does."""
    bed = MockupParams(**BED, seed=seed, rock_cover=cover, slope_deg=slope_deg, attitude_noise_deg=ATTITUDE_DEG)
    sequence = mockup(bed)
    fetch = fetcher()
    left, right = (fetch(sequence.image(0, camera)) for camera in ("left", "right"))
    chosen: Any = config.build({"terrain": {"preset": preset}, "locus": {"cell_size": CELL, "max_sigma": CELL}})
    assert isinstance(sequence.rig, Rig)
    images = np.asarray(left["image"]), np.asarray(right["image"])
    forth, back = (
        match(a["image"], b["image"], chosen.hfvm, valid=(a["valid"], b["valid"])) if wanted else None
        for a, b, wanted in ((left, right, True), (right, left, chosen.locus.both))
    )
    pair = Pair(images, sequence.rig, chosen.locus, forth, back)
    assert sequence.up is not None
    assert sequence.truth is not None
    assert sequence.truth_dem is not None
    lattice, first, (dem, std) = _reconstructed(pair, sequence.up[0])
    _, exactly, (posed, posed_std) = _reconstructed(pair, sequence.truth[0].rotation[2], lattice)
    n = round(PAD / CELL)
    wide = Lattice.at(lattice.i0 - n, lattice.j0 + n, CELL, lattice.rows + 2 * n, lattice.cols + 2 * n)
    exact = fetch(sequence.truth_dem(wide.to_dict(), sequence.truth[0] @ exactly[0].inverse(), (0,)))
    return Scene(
        seed, cover, slope_deg, sequence.vehicle, lattice, wide, dem, std, posed, posed_std,
        np.asarray(exact["elevation"], np.float32), images, sequence.rig, *first,
    )  # fmt: skip


def _reconstructed(
    pair: Pair, up: Any, lattice: Lattice | None = None
) -> tuple[Lattice, tuple[RigidTransform, tuple[float, float]], tuple[Floats32, Floats32]]:
    """Lattice, frame and range of elevations, and elevations with their standard deviation, by a vertical."""
    given = pair.matches(pair.forth)
    usable = matched_back(pair.forth.validity, pair.forth.backmatch_error)
    facts = level(Matches(given.column, given.row, usable), pair.rig, GroundFrameParams(), VerticalHint(up=up))
    T_local_left = RigidTransform.from_matrix(facts["T_local_left"])
    view = view_ground(pair.rig, T_local_left.rotation, facts["plane"])
    lattice = lattice or local_lattice(view, CELL, pair.params)
    low, high = z_range(facts["plane"], facts["relief"], list(lattice.bounds))
    left, right = (np.asarray(image, np.float32) for image in pair.images)
    both = MatchedPair(left, given, right, None if pair.back is None else pair.matches(pair.back))
    dem = reconstruct(both, pair.rig, T_local_left, lattice, (low, high), pair.params)
    return lattice, (T_local_left, (low, high)), (dem.elevation, dem.elevation_std)


def kept(folder: Path | None, seed: int, cover: float, slope_deg: float, preset: str = "default") -> Scene:
    """A scene that an earlier run left in the folder, or a new one that is left there."""
    if folder is None:
        return build(seed, cover, slope_deg, preset)
    path = folder / f"{seed}-{cover:g}-{slope_deg:g}-{preset}-{_fingerprint()}.pickle"
    if path.exists():
        with path.open("rb") as file:
            scene = pickle.load(file)
        assert isinstance(scene, Scene)
        return scene
    scene = build(seed, cover, slope_deg, preset)
    folder.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        pickle.dump(scene, file)
    part.replace(path)
    return scene


def _fingerprint() -> str:
    """Of the modules that make a scene."""
    root = Path(__file__).resolve().parents[2]
    files = sorted(path for pattern in MADE_BY for path in root.glob(pattern))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]
