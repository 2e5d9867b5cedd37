"""Reads the artifacts of a run into the plain arrays and facts that figures and tables need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.pipeline.export.rasters import whole
from rille.pipeline.export.trajectories import crosscheck_poses
from rille.pipeline.export.view import RunView, by_frame, used_rig
from rille.pipeline.flow.products import Stop
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray, Bundle
from rille.stages.core.quantities import count
from rille.stages.geometry import rigid
from rille.stages.geometry.epipolar import line_distances
from rille.stages.geometry.lattice import Lattice
from rille.stages.odometry.resection.trajectory import world_poses


@dataclass(frozen=True)
class WorldTerrain:
    """Arrays (row, col) of an elevation model, and the lattice they lie on."""

    lattice: Lattice
    arrays: Mapping[str, AnyArray]

    def at(self, name: str, xy: Floats) -> Floats:
        """Values (n,) of an array in the cells of points (n, 2), m; NaN outside."""
        return self.lattice.values(self.arrays[name], self.lattice.index(xy), np.nan)


@dataclass(frozen=True)
class Track:
    """The trajectory: positions (frame, 3) m in the world, one row a chosen frame, NaN without a pose there.

    ``truth`` (frame, 3): aligned by the first frame that has both, NaN where the truth has a gap.
    ``sigma`` (frame,): standard deviation of the position, m. ``segment`` (frame,): which segment posed it, -1 none.
    ``piece`` (frame,): unbroken piece that it lies in, -1 without a pose; one of them is the world.
    """

    left: Floats
    truth: Floats | None
    sigma: Floats
    segment: NDArray[np.int64]
    piece: NDArray[np.int64]

    @property
    def error(self) -> Floats | None:
        """Distance (frame,) from the truth, m, NaN where either has no position; None without truth."""
        return None if self.truth is None else np.asarray(np.linalg.norm(self.left - self.truth, axis=1))

    @property
    def in_world(self) -> NDArray[np.bool_]:
        """Frames that have a pose in the world."""
        return np.asarray(np.isfinite(self.left).all(axis=1))


@dataclass(frozen=True)
class CrosscheckComparison:
    """Our trajectory and the crosscheck's, one row for each chosen frame, NaN where either has no pose.

    ``poses`` (frame, 3, 4): the crosscheck's left cameras in our world, NaN where ours is in another piece.
    ``registered`` (frame,): whether the crosscheck has a pose, in any piece. ``distance`` m, ``angle`` rad:
    disagreement of the poses; ``step_distance``, ``step_angle``: of the motion since the frame before.
    ``error_crosscheck`` m: its distance from the truth, first poses equal. ``flagged``: the pose may be wrong.
    """

    poses: Floats
    registered: NDArray[np.bool_]
    distance: Floats
    angle: Floats
    step_distance: Floats
    step_angle: Floats
    flagged: NDArray[np.bool_]
    error_crosscheck: Floats
    meta: Mapping[str, Any]


def compare(view: RunView, agreement: Bundle) -> CrosscheckComparison:
    """The comparison by an artifact of stage ``agreement``."""
    return CrosscheckComparison(
        poses=crosscheck_poses(view, agreement),
        registered=rigid.posed(by_frame(view, agreement, "poses")),
        flagged=np.nan_to_num(by_frame(view, agreement, "flagged")) > 0,
        error_crosscheck=_error(view, view.bundle(view.products.crosscheck_accuracy)),
        meta=agreement.meta,
        **{name: by_frame(view, agreement, name) for name in ("distance", "angle", "step_distance", "step_angle")},
    )


def _error(view: RunView, accuracy: Bundle | None) -> Floats:
    """Distance (frame,) from the truth, m, first poses equal."""
    if accuracy is None:
        return np.full(len(view.frames), np.nan)
    ours, true = (by_frame(view, accuracy, name) for name in ("position", "position_truth"))
    return np.asarray(np.linalg.norm(ours - true, axis=1))


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

    @property
    def parameters(self) -> list[Mapping[str, Any]]:
        """The parameters of all rigs."""
        return [parameter for facts in self.facts for parameter in facts.get("parameters") or ()]

    def warnings(self) -> list[str]:
        """Warnings of all rigs; of those that begin alike (up to a colon) at several rigs only the first."""
        said: dict[tuple[str, int], list[str]] = {}
        for facts in self.facts:
            begun = Counter[str]()
            for line in facts.get("warnings") or ():
                begun[lead := line.partition(":")[0]] += 1
                said.setdefault((lead, begun[lead]), []).append(line)
        alike = ((lines[0], len(lines) - lines.count(lines[0])) for lines in said.values())
        return [f"{line} (and alike at {count(more, 'other pair')})" if more else line for line, more in alike]


class Scene:
    """A run with what several figures and tables share, each read once."""

    def __init__(self, view: RunView) -> None:
        self.view = view

    @cached_property
    def world(self) -> WorldTerrain | None:
        """Merged terrain, put together of its tiles."""
        tiles = [b for b in map(self.view.bundle, self.view.products.world_tiles) if b is not None]
        if not tiles:
            return None
        names = "elevation", "elevation_std", "spread", "count", "source", "ortho"
        merged = {name: whole(tiles, name) for name in names}
        return WorldTerrain(merged["elevation"][0], {name: values for name, (_, values) in merged.items()})

    @cached_property
    def risk(self) -> WorldTerrain | None:
        """Risk map of the merged terrain."""
        return terrain(self.view.bundle(self.view.products.world_risk), "risk", "reason", "p_hazard", "inclination")

    @cached_property
    def path(self) -> Floats | None:
        """Vertices (n, 3) of the path over the merged terrain; None without a path."""
        return vertices(self.view.bundle(self.view.products.world_path))

    @cached_property
    def track(self) -> Track:
        """Positions of all chosen frames, estimated and true."""
        view, p = self.view, self.view.products
        bundle, assessed, n = view.bundle(p.trajectory), view.bundle(p.accuracy), len(view.frames)
        nowhere, nothing = np.full((n, 3), np.nan), np.full(n, -1)
        if bundle is None:
            return Track(nowhere, None, nowhere[:, 0], nothing, nothing)
        poses = rigid.by_frame(world_poses(bundle), list(bundle.meta["frames"]), list(view.frames))
        there = rigid.posed(poses)
        variances = np.trace(by_frame(view, bundle, "covariance")[:, :3, :3], axis1=1, axis2=2)
        numbers = (by_frame(view, bundle, name) for name in ("segment", "piece"))
        segment, piece = (np.nan_to_num(one, nan=-1).astype(int) for one in numbers)
        # As ``accuracy`` brought it to the world.
        truth = nowhere if assessed is None else by_frame(view, assessed, "position_truth")
        return Track(
            np.where(there[:, None], poses[:, :, 3], np.nan),
            truth if np.isfinite(truth).any() else None,
            np.where(there, np.sqrt(np.maximum(variances, 0)), np.nan),
            np.where(there, segment, -1),
            piece,
        )

    @cached_property
    def comparison(self) -> CrosscheckComparison | None:
        """The trajectory against that of another program; None where there is no comparison."""
        agreement = self.view.bundle(self.view.products.agreement)
        return None if agreement is None else compare(self.view, agreement)

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


def terrain(bundle: Bundle | None, *names: str) -> WorldTerrain | None:
    """Arrays of one artifact with a lattice."""
    if bundle is None:
        return None
    return WorldTerrain(Lattice.from_dict(bundle.meta["lattice"]), {name: np.asarray(bundle[name]) for name in names})


def stops(view: RunView) -> list[Stop]:
    """The stops of a drive that have a leg and a map; empty where nothing was driven."""
    drive = view.products.drive
    listed = [] if drive is None else drive.stops
    return [stop for stop in listed if view.bundle(stop.leg) is not None and view.bundle(stop.risk) is not None]


def facts_of(view: RunView, handle: Any) -> Mapping[str, Any]:
    """Facts of an artifact; empty where there is none."""
    bundle = view.bundle(handle)
    return {} if bundle is None else bundle.meta


def frames_of(view: RunView, chosen: NDArray[np.bool_]) -> list[int]:
    """Numbers of the frames whose row in ``chosen`` is true."""
    return [frame for frame, there in zip(view.frames, chosen, strict=True) if there]


_NONE = (np.empty((0, 2)), np.empty(0), np.empty(0))


def _residuals(view: RunView, pair: int) -> tuple[Floats, Floats, Floats] | None:
    """Left points of a pair's inliers, and their epipolar residuals under the given and the used rig, px."""
    bundle = view.bundle(view.products.orientations.get(pair))
    if bundle is None:
        return None
    left, right = (np.asarray(bundle[name], dtype=np.float64) for name in ("left", "right"))
    kept = np.asarray(bundle["weight"]) > 0
    left, right, given, used = left[kept], right[kept], view.sequence.rig, used_rig(view, pair)
    before = line_distances(given, left, right)
    after = before if used.to_dict() == given.to_dict() else line_distances(used, left, right)
    return left, before, after
