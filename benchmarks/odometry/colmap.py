"""COLMAP through the stages ``features`` and ``crosscheck``: windows, the rig held, joined to one trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rille.stages.core.declare import Bundle
from rille.stages.evaluation.crosscheck import windows
from rille.stages.geometry.rigid import by_frame
from rille.stages.odometry.resection.trajectory import world_poses

from .chain import STAGES, Clock, Images, Navigated

SIDES = ("left", "right")


def features(images: Images, clock: Clock) -> dict[tuple[int, str], Bundle]:
    """Features of every image, by frame and camera."""
    stage, made = STAGES["features"], {}
    for frame, camera in ((f, c) for f in images.frames for c in SIDES):
        image = clock.timed("undistort", images.ideal, frame, camera)
        made[frame, camera] = clock.timed("colmap", stage.run, stage.params(), {}, {"image": image})
    return made


def joined(seen: Mapping[tuple[int, str], Bundle], rig: Any, config: Any, clock: Clock) -> tuple[Bundle, float | None]:
    """The crosscheck of the frames whose features are ``seen``, and the reprojection error of its first window, px."""
    frames = sorted({frame for frame, _ in seen})
    window_stage, join = STAGES["crosscheck"], STAGES["crosscheck_join"]
    parts = []
    for window in windows(frames, config.crosscheck):
        pair = {c: [seen[f, c] for f in window] for c in SIDES}
        args = {"frames": window, "rig": rig.to_dict()}
        parts.append(clock.timed("colmap", window_stage.run, config.crosscheck, args, pair))
    whole = clock.timed("join", join.run, join.params(), {"frames": frames}, {"windows": parts})
    return whole, parts[0].meta["reprojection_px"]


def run(images: Images, config: Any) -> Navigated:
    """Poses of the largest piece, NaN elsewhere."""
    clock = Clock()
    found, reprojection_px = joined(features(images, clock), images.sequence.rig, config, clock)
    poses = by_frame(world_poses(found), [int(f) for f in found.meta["frames"]], list(images.frames))
    return Navigated(poses, None, {"reprojection_px": reprojection_px}, clock)
