"""Exchanged sides of a parallel rig (beyond infinity), and of one turned inward (rows depart the wrong way)."""

import numpy as np
import pytest

from rille.stages.geometry.epipolar import fits
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp

CAMERA = Camera(400.0, 400.0, 319.5, 239.5, 640, 480)


@pytest.mark.parametrize("toe_in", [0.0, 0.09])
def test_matches_fit_one_way_round(toe_in):
    """Turned inward the axes cross at 2.2 m, amid the scene: disparities have both signs either way."""
    rng = np.random.default_rng(3)
    T = RigidTransform(rotation_exp([0.0, toe_in, 0.0]), rotation_exp([0.0, toe_in, 0.0]) @ np.array([-0.2, 0.0, 0.0]))
    rig = Rig(CAMERA, CAMERA, T)
    left = rng.uniform([0, 0], [640, 480], (4000, 2))
    points = CAMERA.rays(left) * rng.uniform(1.2, 4.0, (4000, 1))
    right = CAMERA.project(T.apply(points)) + rng.normal(0, 0.7, (4000, 2))
    assert fits(rig, left, right, 4.0) > 0.95
    assert fits(rig, right, left, 4.0) < 0.45
