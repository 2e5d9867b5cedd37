"""COLMAP through the stage ``crosscheck``: left and right images in windows, the rig held, joined to one trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np

from rille.pipeline.flow import config as configuration
from rille.stages.evaluation.accuracy import by_frame
from rille.stages.evaluation.crosscheck import windows

from .chain import Clock, Images, Navigated


def run(images: Images, config: Any) -> Navigated:
    """Poses of the largest piece, NaN elsewhere."""
    clock, frames, rig = Clock(), list(images.frames), images.sequence.rig.to_dict()
    window_stage, join = configuration.stage("crosscheck"), configuration.stage("crosscheck_join")
    parts = []
    for window in windows(frames, config.crosscheck):
        pair = {c: [clock.timed("undistort", images.ideal, f, c) for f in window] for c in ("left", "right")}
        args = {"frames": window, "rig": rig}
        parts.append(clock.timed("colmap", window_stage.run, config.crosscheck, args, pair))
    joined = clock.timed("join", join.run, join.params(), {"frames": frames}, {"windows": parts})
    poses = by_frame(np.asarray(joined["poses"]), [int(f) for f in joined.meta["frames"]], frames)
    return Navigated(poses, None, {"reprojection_px": parts[0].meta["reprojection_px"]}, clock)
