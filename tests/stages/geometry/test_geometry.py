"""Cameras, rigid transforms, the paper's angles."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pointing_angles import angles_from_rotation, rotation_from_angles
from raising import raises
from scipy.spatial.transform import Rotation

from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import (
    Camera,
    Rig,
    RigidTransform,
    level_rotation,
    orthonormal,
    rotation_exp,
    rotation_log,
)

CAMERA = Camera(600.0, 610.0, 285.0, 260.0, 570, 520)
angle = st.floats(-1.4, 1.4)


def test_project_by_hand() -> None:
    np.testing.assert_allclose(CAMERA.project([0.1, -0.2, 2.0]), [285.0 + 30.0, 260.0 - 61.0])


def test_behind_the_camera_is_nan() -> None:
    assert np.isnan(CAMERA.project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])).all()


def test_rays_are_the_inverse_of_projection() -> None:
    pixels = np.array([[0.0, 0.0], [569.0, 519.0], [300.5, 17.25]])
    np.testing.assert_allclose(CAMERA.project(3.7 * CAMERA.rays(pixels)), pixels, atol=1e-10)


@given(angle, angle, angle)
def test_eq_5_is_a_proper_rotation_and_its_angles_come_back(omega: float, phi: float, kappa: float) -> None:
    r = rotation_from_angles(omega, phi, kappa)
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(r) == pytest.approx(1.0)
    np.testing.assert_allclose(angles_from_rotation(r), (omega, phi, kappa), atol=1e-9)


def test_eq_5_by_hand() -> None:
    r = rotation_from_angles(0.0, 0.0, math.pi / 2)
    np.testing.assert_allclose(r, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)


@given(angle, angle, angle)
def test_exponential_against_scipy(x: float, y: float, z: float) -> None:
    np.testing.assert_allclose(rotation_exp([x, y, z]), Rotation.from_rotvec([x, y, z]).as_matrix(), atol=1e-12)


def test_t_is_the_translation_and_the_position_is_its_negative_rotated() -> None:
    r = rotation_from_angles(0.1, -0.2, 0.3)
    centre = np.array([1.0, 2.0, 3.0])
    T_cam_world = RigidTransform(r, -r @ centre)
    np.testing.assert_allclose(T_cam_world.apply(centre), 0.0, atol=1e-15)
    np.testing.assert_allclose(T_cam_world.inverse().translation, centre)


@given(angle, angle, angle)
def test_round_trip(x: float, y: float, z: float) -> None:
    T = RigidTransform(rotation_exp([x, y, z]), np.array([x, -y, 2 * z]))
    np.testing.assert_allclose((T @ T.inverse()).matrix34, np.eye(3, 4), atol=1e-12)
    np.testing.assert_allclose(RigidTransform.from_matrix(T.to_list()).matrix34, T.matrix34)
    rig = Rig(CAMERA, CAMERA, T)
    np.testing.assert_allclose(Rig.from_dict(rig.to_dict()).T_right_left.matrix34, T.matrix34)


def test_a_matrix_that_is_no_rotation_is_refused() -> None:
    with raises("RIL-333"):
        RigidTransform(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    with raises("RIL-332"):
        RigidTransform(np.eye(3), np.array([0.0, np.nan, 0.0]))


def test_level_rotation_of_a_camera_that_looks_down() -> None:
    pitch = math.radians(17.0)
    up = [0.0, -math.cos(pitch), -math.sin(pitch)]  # optical frame: y down, z forward and down by the pitch
    R_level_cam = level_rotation(up)
    np.testing.assert_allclose(R_level_cam @ up, [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(R_level_cam @ [0, 0, 1], [0, math.cos(pitch), -math.sin(pitch)], atol=1e-15)
    assert np.linalg.det(R_level_cam) == pytest.approx(1.0)
    # Straight down: x right in the image, y to its top; wherever a gust tilts it.
    np.testing.assert_allclose(level_rotation([0.0, 0.0, -1.0]), [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-15)
    for tilt in ([0.1, 0.0], [0.0, 0.1], [-0.1, 0.1]):
        assert level_rotation([*tilt, -1.0])[1] @ [0, -1, 0] > 0.99


@pytest.mark.parametrize("to", [[0.0, -1.0], [-0.7, -0.7], [1.0, 0.0]])
@pytest.mark.parametrize("down", [-1.0, 1.0])
def test_level_rotation_of_a_camera_that_tilts_does_not_jump(to: list[float], down: float) -> None:
    """From straight down (or up) to the horizon, ahead or aside: half a degree of tilt turns it by 3 at most."""
    tilts = np.radians(np.arange(0.0, 90.0, 0.5))
    ups = np.array([[to[0] * math.sin(t), to[1] * math.sin(t), down * math.cos(t)] for t in tilts])
    turned = np.array([level_rotation(up) for up in ups])
    steps = np.einsum("nij,nkj->nik", turned[1:], turned[:-1])
    assert np.degrees(np.linalg.norm(rotation_log(steps), axis=1)).max() < 3.0


def test_orthonormal_repairs_rounding() -> None:
    r = rotation_from_angles(0.1, 0.2, 0.3)
    np.testing.assert_allclose(orthonormal(r + 1e-7), r, atol=1e-6)


def test_errors_survive_a_process_boundary() -> None:
    import pickle

    error = pickle.loads(pickle.dumps(InputError("RIL-123", "what", remedy="do")))
    assert isinstance(error, InputError)
    assert str(error) == "what: do"
