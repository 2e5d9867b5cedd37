"""The stereo pairs of a run that have a disparity and a pose in its world: their points, rigs and poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import InputError
from rille.stages.core.quantities import count
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.odometry.resection.trajectory import world_poses
from rille.stages.terrain.points import PairPoints, points


@dataclass(frozen=True)
class PlacedPair:
    """A pair of frame ``pair``: points in the frame of its left camera, and that camera's pose in the world."""

    pair: int
    disparity: Bundle
    points: PairPoints
    rig: Rig
    T_world_left: RigidTransform


class PlacedPairs:
    """Iterable of all placed pairs of a run, opened one at a time. ``words``: number of these, and of pairs without a
    pose; ``vertical``: source of the world's vertical.

    Raises
    ------
    InputError
        No pair of the run has both.
    """

    def __init__(self, run: RunArtifacts, every: int = 1) -> None:
        """``every``: step of rows and columns of the images."""
        trajectory = run.one("trajectory", last=True)
        self._run, self._every, self._poses = run, every, placed_frames(trajectory)
        self.vertical = trajectory.meta["verticals"][trajectory.meta["main"]]
        pairs = sorted(int(name) for name in run.labels(r"hfvm/(\d{1,9})"))
        self.pairs = [pair for pair in pairs if pair in self._poses]
        unplaced = len(pairs) - len(self.pairs)
        left_out = f", {unplaced} without a pose are left out" if unplaced else ""
        self.words = f"{count(len(self.pairs), 'pair')}{left_out}"
        if not self.pairs:
            text = "no pair of the run has both a disparity and a pose"
            raise InputError("RIL-613", text, remedy="its report says what failed")

    def __iter__(self) -> Iterator[PlacedPair]:
        for pair in self.pairs:
            rig = Rig.from_dict(self._run.input(f"ground_frame/{pair}", "rig").meta["rig"])
            disparity = self._run.one(f"hfvm/{pair}")
            found = points(disparity, rig, self._every)
            yield PlacedPair(pair, disparity, found, rig, self._poses[pair])


def placed_frames(trajectory: Bundle) -> dict[int, RigidTransform]:
    """Pose T_world_left of each frame that has one in the world."""
    rows = zip(trajectory.meta["frames"], world_poses(trajectory), strict=True)
    return {int(frame): RigidTransform.from_matrix(pose) for frame, pose in rows if np.isfinite(pose).all()}
