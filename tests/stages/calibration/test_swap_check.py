"""Exchanged sides of a parallel rig (beyond infinity), and of one turned inward (rows depart the wrong way)."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from rille.stages.calibration import swap_check
from rille.stages.core.declare import NoParams
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.sides import fits, fits_turned
from rille.stages.imaging.features import extract

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
    assert fits(rig, left, right) > 0.95
    assert fits(rig, right, left) < 0.45


def test_matches_of_a_camera_that_was_knocked_fit_once_it_is_turned_back_and_those_of_another_time_do_not():
    rng = np.random.default_rng(3)
    T = RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    rig = Rig(CAMERA, CAMERA, T)
    left = rng.uniform([0, 0], [640, 480], (1000, 2))
    points = CAMERA.rays(left) * rng.uniform(1.2, 4.0, (1000, 1))
    turn, ahead = RigidTransform(rotation_exp([0.01, 0.0, 0.02]), np.zeros(3)), np.array([0.0, 0.0, -0.3])
    for pose, share in ((turn @ T, 0.9), (RigidTransform(np.eye(3), T.translation + ahead), 0.4)):
        right = CAMERA.project(pose.apply(points)) + rng.normal(0, 0.3, (1000, 2))
        right[::20] = rng.uniform(0, 400, (50, 2))
        assert fits(rig, left, right) < 0.4
        assert (fits_turned(rig, left, right) > share) == (share == 0.9)


def seen(camera, T, texture):
    """Image of a textured wall, whose lower half is nearer, by a camera; T maps the left camera frame to its own."""
    v, u = np.indices((camera.height, camera.width), np.float64)
    centre = -T.translation
    image = np.zeros(v.shape, np.float32)
    # What is nearer covers the lower half of the view.
    for depth, part in ((3.0, slice(None)), (1.5, slice(camera.height // 2, None))):
        x = (u[part] - camera.cx) / camera.fx * depth + centre[0]
        y = (v[part] - camera.cy) / camera.fy * depth + centre[1]
        where = np.stack([y * 240.0 / depth + 300.0, x * 240.0 / depth + 400.0])
        image[part] = map_coordinates(texture, where, order=1, mode="wrap")
    return image


@pytest.mark.parametrize("scale", [1.0, 0.5, 2.0])
@pytest.mark.parametrize("swap", [False, True])
def test_exchanged_images_are_told_at_any_scale_of_the_right_camera(scale, swap):
    texture = gaussian_filter(np.random.default_rng(5).normal(128, 200, (700, 900)), 1.5).astype(np.float32)
    left = Camera(240.0, 240.0, 159.5, 119.5, 320, 240)
    right = Camera(
        240.0 * scale, 240.0 * scale, 160 * scale - 0.5, 120 * scale - 0.5, round(320 * scale), round(240 * scale)
    )
    T = RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    images = [seen(left, RigidTransform.identity(), texture), seen(right, T, texture)]
    # Sharper than its pixels would alias.
    images = [gaussian_filter(image, max(0.0, k)) for image, k in zip(images, (0.7, 0.7 * scale), strict=True)]
    sides = images[::-1] if swap else images
    inputs = {side: extract(image, np.ones(image.shape)) for side, image in zip(("left", "right"), sides, strict=True)}
    found = swap_check.swap_check_stage.run(NoParams(), {"frame": 0, "rig": Rig(left, right, T).to_dict()}, inputs).meta
    assert found["swapped"] == swap, found
