from __future__ import annotations

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.odometry import pose
from rille.stages.terrain import merge


def test_one_pose_with_its_covariance() -> None:
    rng = np.random.default_rng(1)
    arrays = {"poses": rng.normal(size=(3, 3, 4)), "covariance": rng.normal(size=(3, 6, 6))}
    trajectory = Bundle(arrays | {"piece": np.zeros(3, np.int16)}, {"verticals": ["none"]})
    found = pose.pose_stage.run(NoParams(), {"row": 1}, {"trajectory": trajectory})
    check_outputs(pose.pose_stage, found)
    for name in ("poses", "covariance"):
        np.testing.assert_array_equal(found[name], trajectory[name][1:2])


@pytest.mark.parametrize(("vertical", "name"), [("ground plane", "own_covariance"), ("attitude", "covariance")])
def test_errors_of_the_calibration_are_in_heights_unless_a_plane_takes_them_out(vertical, name) -> None:
    rng = np.random.default_rng(1)
    arrays = {one: rng.normal(size=(3, 6, 6)) for one in ("covariance", "own_covariance")}
    arrays |= {"poses": rng.normal(size=(3, 3, 4)), "piece": np.array([0, 1, 1], np.int16)}
    trajectory = Bundle(arrays, {"verticals": ["none", vertical]})
    found = pose.pose_stage.run(NoParams(), {"row": 1}, {"trajectory": trajectory})
    np.testing.assert_array_equal(found["covariance"], arrays[name][1:2])


def test_the_merge_reads_height_and_rotations_of_it() -> None:
    covariance = np.arange(36.0)
    meta = {"pose_covariance": covariance.tolist(), "T_frame_left": [1, 0, 0, 4, 0, 1, 0, 5, 0, 0, 1, 6]}
    placed = merge.Placed.of(meta)
    assert placed.centre.tolist() == [4, 5, 6]
    assert placed.covariance.tolist() == [[14, 15, 16], [20, 21, 22], [26, 27, 28]]


@pytest.mark.parametrize(("turn", "kept"), [(1e-3, True), (4e-3, False)])
def test_a_pose_is_that_of_the_chain_where_its_model_moves_by_less_than_a_quarter_of_a_cell(turn, kept):
    # Cells of 10 mm, the farthest corner some 1.5 m from the camera: a quarter of a cell is 1.7 mrad.
    lattice = Lattice.at(-50, 140, 0.01, 140, 100).to_dict()
    local = Bundle(
        {}, {"lattice": lattice, "T_frame_left": RigidTransform.identity().to_list(), "z_range": [-0.2, 0.0]}
    )
    before = RigidTransform(rotation_exp([0.0, 0.0, 1.0]), [3.0, 4.0, 0.0])
    after = RigidTransform(rotation_exp([0.0, 0.0, turn]) @ before.rotation, before.translation)
    chained, adjusted = (
        Bundle(
            {"poses": T.matrix34[None], "covariance": np.full((1, 6, 6), k), "piece": np.zeros(1, np.int16)},
            {"verticals": ["attitude"]},
        )
        for k, T in enumerate((before, after))
    )
    ports = {"trajectory": adjusted, "chained": chained, "local": local}
    found, alone = (
        pose.pose_stage.run(NoParams(), {"row": 0}, given)
        for given in (ports, {"trajectory": chained if kept else adjusted})
    )
    for name in ("poses", "covariance"):
        np.testing.assert_array_equal(found[name], alone[name])
