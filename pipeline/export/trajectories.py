"""Files of the trajectory, and of the crosscheck's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rille.pipeline.export.output import Output, stage
from rille.pipeline.export.view import RUN, RunView, artifact, by_frame
from rille.pipeline.export.writers import FRAME, WORLDS, write_trajectory_kitti, write_trajectory_tum
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle
from rille.stages.evaluation.agreement import carried
from rille.stages.odometry.resection.trajectory import world_poses


def stamps(run: RunView) -> list[float]:
    """Time of each chosen frame, seconds; its number if there is no clock."""
    times = run.sequence.times
    return [float(f) if times is None else times[f] for f in run.frames]


def _trajectory(run: RunView) -> Bundle:
    return artifact(run, run.products.trajectory)


def _write_tum(path: Path, run: RunView, poses: Floats, piece: int | None = None) -> None:
    """Write poses in the frame of a piece of the trajectory; None: of the main one."""
    facts = _trajectory(run).meta
    vertical = facts["verticals"][facts["main"] if piece is None else piece]
    write_trajectory_tum(path, poses, stamps(run), WORLDS.get(vertical, FRAME))


def _write_pieces(path: Path, run: RunView) -> None:
    trajectory = _trajectory(run)
    for number in range(len(trajectory.meta["verticals"])):
        if number != trajectory.meta["main"]:
            piece = path.with_name(path.name.replace("*", str(number + 1)))
            _write_tum(piece, run, world_poses(trajectory, number), number)


def crosscheck_poses(view: RunView, agreement: Bundle) -> Floats:
    """Poses (frame, 3, 4) of the crosscheck's left cameras in our world, NaN where ours is in another piece."""
    poses, trajectory = by_frame(view, agreement, "poses"), view.bundle(view.products.trajectory)
    if trajectory is not None:  # other pieces, with the lost frames after them, have their own frames of reference
        piece = np.nan_to_num(by_frame(view, trajectory, "piece"), nan=-1).astype(np.int64)
        poses[carried(piece) != trajectory.meta["main"]] = np.nan
    return poses


POSED, TIMES = (RUN.products.trajectory,), (RUN.sequence.times,)

OUTPUTS = (
    Output(
        "trajectory.kitti",
        "pose of each left camera, a 3 x 4 matrix a line, world from camera, m",
        "evo (evo_traj kitti), any text editor",
        lambda path, run: write_trajectory_kitti(path, world_poses(_trajectory(run))),
        "world",
        POSED,
    ),
    Output(
        "trajectory.tum",
        "the same as time, position and quaternion x y z w",
        "evo (evo_traj tum), CloudCompare",
        lambda path, run: _write_tum(path, run, world_poses(_trajectory(run))),
        "world",
        POSED,
        TIMES,
    ),
    Output(
        "trajectory.piece*.tum",
        "another unbroken piece of the trajectory, in a frame of its own",
        "evo (evo_traj tum), CloudCompare",
        _write_pieces,
        needs=POSED,
        reads=TIMES,
    ),
    Output(
        "crosscheck.tum",
        "the trajectory by COLMAP in the same form, laid on ours without a change of scale",
        "evo (evo_ape tum trajectory.tum crosscheck.tum)",
        lambda path, run: _write_tum(path, run, crosscheck_poses(run, artifact(run, run.products.agreement))),
        "world",
        (RUN.products.agreement, *POSED),
        TIMES,
    ),
)
STAGE = stage("output.trajectories", "Trajectories as files", OUTPUTS)
