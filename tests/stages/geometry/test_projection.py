"""Projection: against the camera's own, and its derivatives against differences."""

import numpy as np

from rille.stages.geometry.geometry import Camera, left_jacobian, rotation_exp, rotation_log
from rille.stages.geometry.projection import Pinhole, linearise, rotated

CAMERA = Camera(600.0, 610.0, 300.0, 250.0, 600, 500)


def test_a_kernels_row_holds_the_derivatives_by_pose_and_shift_and_the_error():
    rng = np.random.default_rng(2)
    R, t = rotation_exp(rng.normal(0, 0.3, 3)), rng.normal(0, 0.3, 3)
    X, along, seen = np.array([0.4, -0.3, 5.0]), np.array([0.1, 0.2, 0.3]), np.array([310.0, 240.0])

    def error(xi):
        turn = rotation_exp(xi[3:6])
        x = turn @ R @ (X + (0.2 + xi[6]) * along) + turn @ t + xi[:3]
        return CAMERA.project(x) - seen

    j = np.empty((2, 8))
    x = tuple(R @ (X + 0.2 * along) + t)
    linearise(Pinhole.of(CAMERA), x, rotated(R, along), seen, j)
    numeric = np.array([(error(e) - error(-e)) / 2e-6 for e in 1e-6 * np.eye(7)]).T
    np.testing.assert_allclose(j[:, :7], numeric, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(j[:, 7], error(np.zeros(7)), rtol=1e-12)


def test_logarithm_inverts_the_exponential_and_the_jacobian_is_its_derivative():
    w = np.random.default_rng(3).normal(0, 0.7, (4, 5, 3))
    np.testing.assert_allclose(rotation_log(rotation_exp(w)), w, atol=1e-12)
    one = w[0, 0]
    turns = [rotation_log(rotation_exp(one + e) @ rotation_exp(one - e).T) / 2e-6 for e in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(left_jacobian(one), np.array(turns).T, atol=1e-8)
