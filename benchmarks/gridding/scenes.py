"""Pairs with exact elevations: the simulator's, and Middlebury's true disparity as a surface over a plane."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stereo.pairs import fetcher, read_image, read_truth

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, level_rotation
from rille.stages.geometry.lattice import Lattice

from .mesh import rasterise, without_jumps

Floats = NDArray[np.float64]

SIGMA_PX = 0.2
"""Error of a disparity that the bound on the geometry stands for: that of Locus."""
NEAREST_CELLS_PX = 1.0
"""Pixels that a cell of the fronto-parallel plane spans at the plane."""


@dataclass(frozen=True)
class Disparities:
    """Disparity vectors of the left image (row, col), right minus left, pixels, and what is known of each.

    ``backmatch`` and ``std`` (pixels) are None for true disparities, which have neither.
    """

    column: NDArray[np.float32]
    row: NDArray[np.float32]
    measured: NDArray[np.bool_]
    backmatch: NDArray[np.float32] | None = None
    std: NDArray[np.float32] | None = None

    def usable(self, max_backmatch: float) -> NDArray[np.bool_]:
        """Pixels that were measured and match back to within ``max_backmatch`` pixels."""
        if self.backmatch is None:
            return self.measured
        with np.errstate(invalid="ignore"):
            return self.measured & (self.backmatch <= max_backmatch)


@dataclass(frozen=True)
class Scene:
    """One pair, where its cells are, and the truth on them.

    ``judged``: the cells (row, col) that count, seen by both cameras. ``z_range``: elevations that are searched, m.
    ``max_sigma``: bound on the geometry's error, m.
    """

    name: str
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    rig: Rig
    T_local_left: RigidTransform
    lattice: Lattice
    z_range: tuple[float, float]
    max_sigma: float
    truth: NDArray[np.float32]
    judged: NDArray[np.bool_]
    disparities: Disparities
    valid: tuple[NDArray[np.bool_], NDArray[np.bool_]]

    def matched(self, preset: str = "default") -> Scene:
        """The same scene with our matcher's disparities in place of the true ones."""
        return replace(self, disparities=match(self, preset))


def match(scene: Scene, preset: str = "default", turned: bool = False) -> Disparities:
    """Disparities by the matcher with a preset; ``turned``: of the right image."""
    from rille.pipeline.flow import config
    from rille.stages.core.validity import matched
    from rille.stages.hfvm.stage import match as hfvm

    chosen: Any = config.build({"hfvm": {"preset": preset}})
    sides = ((scene.left, scene.valid[0]), (scene.right, scene.valid[1]))
    (image, own), (other, its) = sides[::-1] if turned else sides
    found = hfvm(image, other, chosen.hfvm, valid=(own, its))
    maps = found.column_disparity, found.row_disparity, matched(found.validity)
    return Disparities(*maps, found.backmatch_error, found.disparity_std)


def mockup(pairs: int | None = None) -> Iterator[Scene]:
    """Basic pairs of the built-in simulator with its true disparities, in the window that its accuracy is judged in."""
    from rille.datasets.registry import open_sequence
    from rille.pipeline.runs.options import cache_folder

    sequence, fetch = open_sequence("mockup"), fetcher(cache_folder(None))
    assert sequence.truth is not None
    frames = range(0, sequence.frames, int(sequence.defaults.get("keyframes.stride", 1)))
    for frame in list(frames)[:pairs]:
        yield simulated(sequence, fetch, frame)


def simulated(sequence: Any, fetch: Any, frame: int) -> Scene:
    """One pair of a simulated sequence; ``fetch`` computes a source or reads it from the cache."""
    images = [fetch(sequence.image(frame, c)) for c in ("left", "right")]
    left, right = (np.asarray(i["image"]) for i in images)
    exact = fetch(sequence.truth_disparity(frame))
    column, row = (np.asarray(exact[n], np.float32) for n in ("column_disparity", "row_disparity"))
    true = Disparities(column, row, np.asarray(exact["occluded"]) == 0)
    pose = sequence.truth[frame]
    T_local_left = RigidTransform(level_rotation(pose.rotation[2]), np.zeros(3))
    cell = float(sequence.defaults.get("locus.cell_size", 0.001))
    x0, y0, x1, y1 = (round(v / cell) for v in sequence.evaluation_window)
    lattice = Lattice.at(x0, y1, cell, y1 - y0 + 1, x1 - x0 + 1)
    dem = fetch(sequence.truth_dem(lattice.to_dict(), pose @ T_local_left.inverse(), (frame,)))
    truth, seen = np.asarray(dem["elevation"]), np.asarray(dem["seen"]) != 0
    z_range = _searched(sequence.rig, true, pose.rotation[2], lattice)
    valid = tuple(np.asarray(i["valid"]) != 0 for i in images)
    judged = seen & np.isfinite(truth)
    place = T_local_left, lattice, z_range, cell
    return Scene(f"mockup {frame}", left, right, sequence.rig, *place, truth, judged, true, valid)


def _searched(rig: Rig, found: Disparities, up: Floats, lattice: Lattice) -> tuple[float, float]:
    from rille.stages.terrain.ground_frame import GroundFrameParams, VerticalHint, level, z_range
    from rille.stages.terrain.matches import Matches

    facts = level(Matches(found.column, found.row, found.measured), rig, GroundFrameParams(), VerticalHint(up=up))
    low, high = z_range(facts["plane"], facts["relief"], list(lattice.bounds))
    return low, high


def motorcycle() -> Scene | None:
    """Middlebury's motorcycle: its true disparity as a surface over a fronto-parallel plane behind it.

    The plane's axes are x right, y up, z to the camera. The surface is that of the triangles between neighbouring
    pixels, none across a jump of more than a pixel; where several lie over one cell, the nearest to the camera.
    """
    folder = Path(os.environ.get("RILLE_DATA") or "-") / "motorcycle"
    if not folder.is_dir():
        return None
    left, right = (read_image(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    truth = read_truth(folder / "motorcycle_disp.npz")
    height, width = left.shape
    f, cx, cy, offset, baseline = 994.978, 311.193, 254.877, 31.086, 0.193001
    cameras = [Camera(f, f, c, cy, width, height) for c in (cx, cx + offset)]
    rig = Rig(cameras[0], cameras[1], RigidTransform(np.eye(3), np.array([-baseline, 0.0, 0.0])))
    known = np.isfinite(truth.u)
    depth = f * baseline / (offset - truth.u)
    far = float(np.nanpercentile(depth, 99.5))
    T_local_left = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, far]))
    points = T_local_left.apply(cameras[0].rays(pixels_of(left.shape)) * depth[..., None])
    cell = round(float(np.nanmin(depth)) / f * NEAREST_CELLS_PX, 4)
    bounds = [float(v) for k in (0, 1) for v in np.nanpercentile(points[..., k], [1, 99])]
    lattice = Lattice.snap(bounds, cell)
    z_range = (float(np.nanmin(points[..., 2])) - 0.05, float(np.nanmax(points[..., 2])) + 0.05)
    max_sigma = SIGMA_PX * far**2 / (f * baseline)  # at the plane: the depth's error is far above a cell everywhere
    both = known & ~_hidden(truth.u)
    smooth = without_jumps(truth.u, truth.v, known, 1.0)
    surface = rasterise(points, smooth, lattice)
    seen = rasterise(points, smooth & _quads(both), lattice)
    judged = np.isfinite(surface) & (np.abs(seen - surface) < 1e-9)
    true = Disparities(truth.u.astype(np.float32), truth.v.astype(np.float32), both)
    everywhere = np.ones(left.shape, bool)
    place = T_local_left, lattice, z_range, max_sigma
    valid = everywhere, everywhere
    return Scene("motorcycle", left, right, rig, *place, surface.astype(np.float32), judged, true, valid)


def pixels_of(shape: tuple[int, ...]) -> Floats:
    r, c = np.mgrid[: shape[0], : shape[1]]
    return np.stack([c, r], axis=-1).astype(np.float64)


def _hidden(u: Floats) -> NDArray[np.bool_]:
    """Pixels (row, col) hidden from the right camera, or outside its image: another one lands there from nearer."""
    cols = np.arange(u.shape[1]) + u
    out = ~(cols >= 0) | (cols > u.shape[1] - 1)
    nearest = np.full(u.shape, np.inf)
    rows = np.broadcast_to(np.arange(u.shape[0])[:, None], u.shape)
    landing = np.rint(np.where(out, 0, cols)).astype(np.intp)
    np.minimum.at(nearest, (rows[~out], landing[~out]), u[~out])
    return out | (u > nearest[rows, landing] + 1.0)


def _quads(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Quadrangles (row, col) of pixels whose four corners are all set."""
    return mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
