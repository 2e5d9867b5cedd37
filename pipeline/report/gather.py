"""Reads the artifacts of a run into the plain arrays and facts that figures and tables need."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export import ranges
from rille.pipeline.export.artifacts import Floats, image, used_rig
from rille.pipeline.export.comparison import Comparison, compare
from rille.pipeline.export.rasters import whole
from rille.pipeline.export.view import RunView
from rille.pipeline.report.canvas import Extent
from rille.stages.core.declare import Bundle
from rille.stages.geometry.epipolar import distances
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice, union
from rille.stages.numeric.robust import mad_sigma
from rille.stages.odometry.resection.trajectory import world_poses

WORLD = ("elevation", "elevation_std", "spread", "count", "source", "ortho")
"""Arrays of the merged terrain that figures and tables show."""


@dataclass(frozen=True)
class Terrain:
    """Arrays (row, col) of an elevation model, and the lattice they lie on."""

    lattice: Lattice
    arrays: Mapping[str, Floats]

    @property
    def extent(self) -> Extent:
        """x_min, x_max, y_min, y_max, metres."""
        return self.lattice.bounds

    def get(self, name: str) -> Floats | None:
        """An array, None where there is none."""
        return self.arrays.get(name)

    def at(self, name: str, xy: Floats) -> Floats:
        """Values (n,) of an array in the cells of points (n, 2), m; NaN outside, and where there is no such array."""
        values, found = self.get(name), np.full(len(xy), np.nan)
        if values is not None:
            row, col = np.rint(self.lattice.index(xy)).astype(int).T
            inside = (row >= 0) & (col >= 0) & (row < values.shape[0]) & (col < values.shape[1])
            found[inside] = values[row[inside], col[inside]]
        return found


@dataclass(frozen=True)
class Track:
    """The trajectory: positions (frame, 3) m in the world, one row a chosen frame, NaN without a pose there.

    ``right`` (pair, 3): right cameras at basic pairs. ``truth`` (frame, 3): aligned by the first frame that has both,
    NaN where the truth has a gap.
    ``sigma`` (frame,): standard deviation of the position, m. ``segment`` (frame,): which segment posed it, -1 none.
    ``piece`` (frame,): unbroken piece that it lies in, -1 without a pose; one of them is the world.
    """

    left: Floats
    right: Floats
    truth: Floats | None
    sigma: Floats
    segment: NDArray[np.int64]
    piece: NDArray[np.int64]

    @property
    def posed(self) -> NDArray[np.bool_]:
        """Frames that have a pose, in the world or in another piece."""
        return np.asarray(self.piece >= 0)

    @property
    def in_world(self) -> NDArray[np.bool_]:
        """Frames that have a pose in the world."""
        return np.asarray(np.isfinite(self.left).all(axis=1))


@dataclass(frozen=True)
class Difference:
    """Elevation of the model of ``pair`` minus that of ``before``, in the world, over their common cells, m.

    ``median``; ``deviation`` robust (1.4826 times the median absolute deviation); ``predicted`` median over the cells
    of what both models' own standard deviations let expect, errors of pose left out.
    """

    before: int
    pair: int
    cells: int
    median: float
    deviation: float
    predicted: float


@dataclass(frozen=True)
class Calibration:
    """The rig's facts by rig (one pooled, or one a pair), and what the matches of all basic pairs say about it.

    ``points`` (n, 2): column, row in the left image; ``before``, ``after`` (n,): signed distance of the right point
    from the epipolar line, px, under the given rig and under the one that was used. Outliers are left out.
    """

    facts: tuple[Mapping[str, Any], ...]
    points: Floats
    before: Floats
    after: Floats

    @property
    def changed(self) -> bool:
        """Whether any rig that was used differs from the given one."""
        return any(bool(facts.get("changed")) for facts in self.facts)

    def residual(self, when: str) -> float:
        """RMS distance from the epipolar lines, px, ``before`` or ``after``; of one rig as it was weighed there."""
        stated = self.facts[0].get(f"residual_{when}_px") if len(self.facts) == 1 else None
        return float(np.sqrt(np.mean(np.square(getattr(self, when))))) if stated is None else float(stated)

    def collected(self, key: str) -> list[Any]:
        """The entries of a list that each rig's facts have."""
        return [entry for facts in self.facts for entry in facts.get(key) or ()]


class Scene:
    """A run with what several figures and tables share, each read once."""

    def __init__(self, view: RunView) -> None:
        self.view = view

    @cached_property
    def world(self) -> Terrain | None:
        """Merged terrain, put together of its tiles."""
        tiles = [b for b in map(self.view.bundle, self.view.products.world_tiles) if b is not None]
        if not tiles:
            return None
        names = [name for name in WORLD if all(name in tile.arrays for tile in tiles)]
        lattice = union(Lattice.from_dict(tile.meta["lattice"]) for tile in tiles)
        return Terrain(lattice, {name: whole(tiles, name)[1] for name in names})

    @cached_property
    def risk(self) -> Terrain | None:
        """Risk map of the merged terrain."""
        return terrain(self.view.bundle(self.view.products.world_risk), "risk", "reason", "p_hazard", "inclination")

    @cached_property
    def path(self) -> Floats | None:
        """Vertices (n, 3) of the path over the merged terrain; None without a path."""
        return vertices(self.view.bundle(self.view.products.world_path))

    @cached_property
    def track(self) -> Track:
        """The trajectory."""
        return trajectory(self.view)

    @cached_property
    def comparison(self) -> Comparison | None:
        """The trajectory against that of another program."""
        return compare(self.view)

    @cached_property
    def differences(self) -> list[Difference]:
        """Differences of successive elevation models that overlap, in the order of the pairs."""
        view = self.view
        present = [pair for pair, handle in view.products.world_dem.items() if view.bundle(handle) is not None]
        found = (_difference(view, before, pair) for before, pair in itertools.pairwise(present))
        return [one for one in found if one is not None]

    @cached_property
    def calibration(self) -> Calibration | None:
        """The rig, as it was given and as it was used; None if no task examined it."""
        p = self.view.products
        # A pooled rig is one handle under many pairs: its facts count once.
        handles = list({id(handle): handle for handle in p.rigs.values()}.values())
        facts = tuple(bundle.meta for bundle in map(self.view.bundle, handles) if bundle is not None)
        if not facts:
            return None
        parts = [_residuals(self.view, pair) for pair in p.orientations]
        points, before, after = (np.concatenate([part[k] for part in parts if part] or [_NONE[k]]) for k in range(3))
        return Calibration(facts, points, before, after)


def vertices(path: Bundle | None) -> Floats | None:
    """Vertices (n, 3), m, of a path artifact; None without a path."""
    points = None if path is None else np.asarray(path["path"])
    return points if points is not None and len(points) else None


def terrain(bundle: Bundle | None, *names: str) -> Terrain | None:
    """Arrays of one artifact with a lattice."""
    if bundle is None or "lattice" not in bundle.meta:
        return None
    arrays = {name: np.asarray(bundle[name]) for name in names if name in bundle.arrays}
    return Terrain(Lattice.from_dict(bundle.meta["lattice"]), arrays)


def trajectory(view: RunView) -> Track:
    """Positions of all chosen frames, of the right cameras at basic pairs, and of the truth."""
    n = len(view.frames)
    row = {frame: i for i, frame in enumerate(view.frames)}
    left, sigma = np.full((n, 3), np.nan), np.full(n, np.nan)
    segment, piece = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    right, posed = [], {}
    bundle = view.bundle(view.products.trajectory)
    if bundle is not None:
        poses = world_poses(bundle)
        for i, frame in enumerate(bundle.meta["frames"]):
            if frame not in row:
                continue
            piece[row[frame]] = int(bundle["piece"][i])
            if not np.isfinite(poses[i]).all():
                continue
            posed[frame] = pose = RigidTransform.from_matrix(poses[i])
            left[row[frame]] = pose.translation
            segment[row[frame]] = int(bundle["segment"][i])
            sigma[row[frame]] = np.sqrt(max(float(np.trace(bundle["covariance"][i][:3, :3])), 0.0))
            if frame in view.products.disparity:
                right.append((pose @ used_rig(view, frame).T_right_left.inverse()).translation)
    true = truth_in_world(view, posed)
    at = None if true is None else np.array([[np.nan] * 3 if pose is None else pose.translation for pose in true])
    return Track(left, np.array(right).reshape(-1, 3), at, sigma, segment, piece)


def truth_in_world(view: RunView, posed: Mapping[int, RigidTransform]) -> list[RigidTransform | None] | None:
    """True poses of the left camera, one a chosen frame, brought to the world by the first frame that has both alone.

    None in gaps, and instead of all where no frame has both.
    """
    truth = view.sequence.truth
    if truth is None:
        return None
    true = [truth[frame] for frame in view.frames]
    both = ((posed[f], pose) for f, pose in zip(view.frames, true, strict=True) if pose is not None and f in posed)
    estimate, first = next(both, (None, None))
    if estimate is None or first is None:
        return None
    T_world_truth = estimate @ first.inverse()
    return [None if pose is None else T_world_truth @ pose for pose in true]


def frame_facts(view: RunView) -> dict[int, dict[str, Any]]:
    """Facts of the resection of each frame; a key frame's come from the segment that posed it, the one before.

    Inliers and error are those of the joint refinement, where there was one: its poses are the trajectory's.
    """
    facts: dict[int, dict[str, Any]] = {}
    for bundle in map(view.bundle, view.products.resections):
        for item in bundle.meta.get("per_frame", ()) if bundle is not None else ():
            facts.setdefault(int(item["frame"]), dict(item))
    for bundle in map(view.bundle, view.products.refined):
        for item in bundle.meta["per_frame"] if bundle is not None else ():
            facts.setdefault(int(item["frame"]), {}).update(item)
    return facts


def trails(view: RunView, frames: tuple[int, ...]) -> dict[int, tuple[list[Floats], list[bool]]]:
    """Trails (n, 2) column, row of the landmarks up to each of ``frames``, and whether each is an inlier there."""
    found: dict[int, tuple[list[Floats], list[bool]]] = {}
    resections = list(view.products.resections) + [None] * len(view.products.tracks)
    for handle, other in zip(view.products.tracks, resections, strict=False):
        track, resection = view.bundle(handle), view.bundle(other)
        if track is None:
            continue
        points, names = np.asarray(track["points"], dtype=np.float64), list(track.meta.get("frames", ()))
        inlier = None if resection is None else np.asarray(resection["inlier"])
        for at, frame in enumerate(names):
            # A key frame ends one segment and begins the next: its trails are those that lead to it.
            if frame not in frames or (frame in found and at == 0):
                continue
            alive = [i for i in range(len(points)) if np.isfinite(points[i, at]).all()]
            lines = [_finite(points[i, : at + 1]) for i in alive]
            good = [inlier is None or bool(inlier[i, at]) for i in alive]
            found[frame] = (lines, good)
    return found


def _finite(line: Floats) -> Floats:
    return line[np.isfinite(line).all(axis=1)]


def consecutive(view: RunView) -> tuple[int, ...]:
    """The first four successive frames whose images are there (fewer where there are fewer)."""
    return tuple(f for f in view.frames[:16] if image(view, f) is not None)[:4]


_NONE = (np.empty((0, 2)), np.empty(0), np.empty(0))


def _residuals(view: RunView, pair: int) -> tuple[Floats, Floats, Floats] | None:
    """Left points of a pair's inliers, and their epipolar residuals under the given and the used rig, px."""
    bundle = view.bundle(view.products.orientations.get(pair))
    if bundle is None:
        return None
    left, right = (np.asarray(bundle[name], dtype=np.float64) for name in ("left", "right"))
    kept = np.asarray(bundle["weight"]) > 0
    left, right, given, used = left[kept], right[kept], view.sequence.rig, used_rig(view, pair)
    before = distances(given, np.zeros(5), left, right)[0]
    after = before if used.to_dict() == given.to_dict() else distances(used, np.zeros(5), left, right)[0]
    return left, before, after


def _difference(view: RunView, before: int, pair: int) -> Difference | None:
    a, b = (view.bundle(view.products.world_dem[k]) for k in (before, pair))
    if a is None or b is None or "lattice" not in a.meta or "lattice" not in b.meta:
        return None
    lattices = [Lattice.from_dict(m.meta["lattice"]) for m in (a, b)]
    common = lattices[0].intersection(lattices[1])
    if common is None:
        return None
    windows = [lattice.window(common) for lattice in lattices]
    z, sigma = (
        [np.asarray(m[name][window], dtype=np.float64) for m, window in zip((a, b), windows, strict=True)]
        for name in ("elevation", "elevation_std")
    )
    difference, expected = z[1] - z[0], np.hypot(*sigma)
    cells = int(np.isfinite(difference).sum())
    if cells < ranges.FEW:
        return None
    sampled = ranges.sample(difference)
    median = float(np.median(sampled))
    deviation = mad_sigma(sampled)
    predicted = ranges.sample(np.where(np.isfinite(difference), expected, np.nan))
    return Difference(before, pair, cells, median, deviation, float(np.median(predicted)))
