from __future__ import annotations

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.odometry.resection import pose
from rille.stages.terrain import merge


def test_one_pose_with_its_covariance() -> None:
    rng = np.random.default_rng(1)
    trajectory = Bundle({"poses": rng.normal(size=(3, 3, 4)), "covariance": rng.normal(size=(3, 6, 6))}, {})
    found = pose.pose_stage.run(NoParams(), {"row": 1}, {"trajectory": trajectory})
    check_outputs(pose.pose_stage, found)
    for name in ("poses", "covariance"):
        np.testing.assert_array_equal(found[name], trajectory[name][1:2])
    alone = Bundle({"poses": trajectory["poses"]}, {})
    found = pose.pose_stage.run(NoParams(), {"row": 2}, {"trajectory": alone})
    check_outputs(pose.pose_stage, found)
    assert set(found.arrays) == {"poses"}


def test_the_merge_reads_height_and_rotations_of_it() -> None:
    covariance = np.arange(36.0)
    meta = {"pose_covariance": covariance.tolist(), "T_frame_left": [1, 0, 0, 4, 0, 1, 0, 5, 0, 0, 1, 6]}
    placed = merge.Placed.of(meta)
    assert placed.centre.tolist() == [4, 5]
    assert placed.covariance.tolist() == [[14, 15, 16], [20, 21, 22], [26, 27, 28]]
