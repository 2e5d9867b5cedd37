"""Truth that was read by another convention: each is named, and good truth never is."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rille.stages.core.arrays import Floats
from rille.stages.evaluation.reading.conventions import better_reading
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.rigid import compose

NED = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Camera axes (x right, y down, z ahead) in those of a vehicle: x ahead, y right, z down."""


def poses(rotations: Floats, positions: Floats) -> Floats:
    return np.concatenate([rotations, positions[:, :, None]], axis=2)


def drive(seed: int, turn: float = 0.4, frames: int = 24) -> Floats:
    """T_world_left (frame, 3, 4) of a drive of some 12 m with turns of ``turn`` radians, and climbs."""
    rng = np.random.default_rng(seed)
    angles = turn * np.cumsum(rng.normal(size=(frames, 3)), axis=0) / np.sqrt(frames)
    R = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix() @ Rotation.from_rotvec(angles).as_matrix()
    return poses(R, np.cumsum(R @ [0.02, 0.03, 0.5], axis=0))


def estimated(true: Floats, seed: int) -> Floats:
    """In another world, with a drift of a per cent and of half a degree."""
    rng = np.random.default_rng(seed)
    off = np.cumsum(rng.normal(size=true[:, :, 3].shape), axis=0) / len(true)
    turn = Rotation.from_rotvec(0.01 * off).as_matrix()
    world = Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix()
    return poses(world @ true[:, :, :3] @ turn, (true[:, :, 3] * 1.005 + 0.05 * off) @ world.T)


def quaternion(true: Floats, order: list[int]) -> Floats:
    q = Rotation.from_matrix(true[:, :, :3]).as_quat()[:, order]
    return poses(Rotation.from_quat(q).as_matrix(), true[:, :, 3])


def inverted(true: Floats) -> Floats:
    R = np.swapaxes(true[:, :, :3], 1, 2)
    return poses(R, -np.einsum("nij,nj->ni", R, true[:, :, 3]))


def mirrored(true: Floats, *signs: float) -> Floats:
    M = np.diag(signs)
    return poses(M @ true[:, :, :3] @ M, true[:, :, 3] @ M)


MISREAD = {
    "truth.unit = 0.001": lambda true: poses(true[:, :, :3], 1e3 * true[:, :, 3]),
    "truth.unit = 0.3048": lambda true: poses(true[:, :, :3], true[:, :, 3] / 0.3048),
    "begin with w": lambda true: quaternion(true, [3, 0, 1, 2]),
    "end with w": lambda true: quaternion(true, [1, 2, 3, 0]),
    "invert each": inverted,
    "runs backwards": lambda true: true[::-1],
    "transpose each R": lambda true: poses(inverted(true)[:, :, :3], true[:, :, 3]),
    "negate x, qy and qz": lambda true: mirrored(true, -1, 1, 1),
    "negate y, qx and qz": lambda true: mirrored(true, 1, -1, 1),
    "negate z, qx and qy": lambda true: mirrored(true, 1, 1, -1),
    "[[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]": lambda true: poses(
        NED @ true[:, :, :3] @ NED.T, true[:, :, 3] @ NED.T
    ),
    "and its unit of length is 0.001 m": lambda true: inverted(poses(true[:, :, :3], 1e3 * true[:, :, 3])),
}


@pytest.mark.parametrize("words", MISREAD)
def test_the_convention_that_would_fit_is_named_alone(words):
    true = drive(1)
    (line,) = better_reading(estimated(true, 2), MISREAD[words](true), RigidTransform.identity(), 0.01)
    assert words in line
    assert "; or:" not in line


@pytest.mark.parametrize("words", ["invert each", "begin with w", "negate y, qx and qz"])
def test_conventions_are_those_of_the_file_not_of_the_camera_in_its_body(words):
    true, mount = drive(3), RigidTransform(Rotation.from_rotvec([1.5, 0.2, 0.4]).as_matrix(), np.array([0.1, 0.2, 0.3]))
    back = mount.inverse()
    body = poses(true[:, :, :3] @ back.rotation, true[:, :, 3] + true[:, :, :3] @ back.translation)
    file = MISREAD[words](body)
    read = poses(file[:, :, :3] @ mount.rotation, file[:, :, 3] + file[:, :, :3] @ mount.translation)
    (line,) = better_reading(estimated(true, 4), read, mount, 0.01)
    assert words in line


def test_the_mount_of_a_tilted_camera_is_found():
    true, R_body_left = drive(5), Rotation.from_euler("xyz", [25, 10, -20], degrees=True).as_matrix() @ NED
    body = poses(true[:, :, :3] @ R_body_left.T, true[:, :, 3])
    (line,) = better_reading(estimated(true, 6), body, RigidTransform.identity(), 0.01)
    numbers = [float(v) for v in re.findall(r"-?\d+\.\d+", line[line.index("[[") :])]
    assert np.reshape(numbers, (3, 4))[:, :3] == pytest.approx(R_body_left, abs=0.06)  # the estimate's own 2 degrees


@pytest.mark.parametrize("turn", [0.0, 0.02, 0.4])
@pytest.mark.parametrize("frames", [4, 9, 40])
def test_good_truth_is_never_doubted(turn, frames):
    """Straight or not, short or not, and where the camera rests."""
    for seed in range(2):
        true = drive(seed, turn, frames)
        assert better_reading(estimated(true, seed + 50), true, RigidTransform.identity(), 0.01) == []
        rest = poses(true[:, :, :3], 1e-3 * true[:, :, 3])
        noise = poses(rest[:, :, :3], np.random.default_rng(seed).normal(scale=1e-2, size=(frames, 3)))
        assert better_reading(noise, rest, RigidTransform.identity(), 0.01) == []


@pytest.mark.parametrize("axes", [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
def test_axes_of_graphics_are_named_where_the_camera_hardly_turns(axes):
    """They look like another order of the quaternion, or like inverted poses."""
    true = drive(7, 0.02)
    (line,) = better_reading(
        estimated(true, 8), poses(true[:, :, :3] @ axes, true[:, :, 3]), RigidTransform.identity(), 0.01
    )
    assert f"{(axes + 0.0).tolist()[1]}"[1:-1] in line
    assert "T_body_left" in line


@pytest.mark.parametrize("factor", [0.5, 1.6, 2.4])
def test_lengths_of_no_usual_unit_may_be_those_of_a_clock(factor):
    true = drive(9)
    (line,) = better_reading(
        estimated(true, 10), poses(true[:, :, :3], factor * true[:, :, 3]), RigidTransform.identity(), 0.01
    )
    assert "truth.unit" in line
    assert "its clock" in line


def test_truth_that_rests_is_said():
    true = drive(11)
    (line,) = better_reading(
        estimated(true, 12), poses(true[:, :, :3], 0.0 * true[:, :, 3] + 5.0), RigidTransform.identity(), 0.01
    )
    assert "the truth rests" in line


def test_what_a_straight_drive_cannot_tell_apart_is_named_together():
    """Backwards: the axis of the drive may be mirrored, or the poses are those of the world."""
    along, upright = np.outer(np.arange(12), [0, 0, 1.0]), np.broadcast_to(np.eye(3), (12, 3, 3))
    (line,) = better_reading(poses(upright, along), poses(upright, -along), RigidTransform.identity(), 0.01)
    assert "invert each" in line
    assert "negate z" in line
    assert "; or: " in line
    assert line.endswith("this drive cannot tell these apart")


def test_a_jump_is_named_as_one_and_not_taken_for_a_unit():
    true = drive(1)
    wrong = true.copy()
    wrong[9, :, 3] = [1e6, 0.0, 0.0]
    (line,) = better_reading(estimated(true, 1), wrong, RigidTransform.identity(), 0.01)
    assert "jumps by 1e+06 m against the trajectory after 9 of its 24 poses" in line
    assert "unit" not in line


@pytest.mark.parametrize("much", [0.1, 0.4, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_jump_from_which_on_truth_stays_off_is_named(much: float, seed: int) -> None:
    true = drive(seed)
    wrong = true.copy()
    wrong[9:, :, 3] += [0.0, much, 0.0]
    (line,) = better_reading(true, wrong, RigidTransform.identity(), 0.01)
    assert f"jumps by {much:g} m against the trajectory after 9 of its 24 poses" in line


def test_a_mount_that_is_inverted_is_named_as_that() -> None:
    for seed in range(3):
        true, mount = drive(seed, turn=1.0), RigidTransform(NED, np.array([0.3, 0.05, -0.2]))
        wrong = compose(compose(true, mount.inverse().matrix34), mount.inverse().matrix34)
        (line,) = better_reading(estimated(true, seed), wrong, mount.inverse(), 0.01)
        assert line.endswith("as read): truth.T_body_left leads from the body to the camera: invert it")


@pytest.mark.parametrize("seed", range(4))
def test_truth_that_no_convention_explains_is_said_not_to_fit(seed: int) -> None:
    true = drive(seed, turn=3.0)
    exchanged = poses(true[:, :, :3], true[:, [1, 0, 2], 3])  # columns of the positions alone
    for truth in (exchanged, drive(seed + 1, turn=3.0)):
        [line] = better_reading(estimated(true, seed), truth, RigidTransform.identity(), 0.01)
        assert "does not fit" in line
        assert "of this drive" in line
