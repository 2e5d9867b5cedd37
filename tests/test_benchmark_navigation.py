"""Figures of the navigation benchmark by hand, and the odometry beside ours on a drive that is known."""

import cv2
import numpy as np
import pytest

from benchmarks.odometry.measures import judge
from benchmarks.odometry.opencv import Odometry
from stages.declare import Bundle
from stages.geometry import Camera, Rig, RigidTransform


def straight(n=30, step=0.5):
    poses = np.tile(np.eye(4)[:3], (n, 1, 1))
    poses[:, 2, 3] = step * np.arange(n)
    return poses


def test_figures_of_a_stretched_drive_by_hand():
    true, long = straight(), straight(step=0.51)
    found = judge(long, true)
    assert found["one_frame"] == pytest.approx(0.01)
    assert found["drift"] == pytest.approx(2.0)
    # Positions on a line, one centimetre too far apart each: after alignment of the means k - 9.5 centimetres.
    assert found["rmse_first"] == pytest.approx(0.01 * np.std(np.arange(20)))
    assert found["rmse"] == pytest.approx(0.01 * np.std(np.arange(30)))
    assert found["lost"] == 0


def test_a_lost_frame_takes_two_motions_with_it():
    estimate = straight()
    estimate[3] = np.nan
    found = judge(estimate, straight())
    assert found["lost"] == 1
    assert found["one_frame"] == pytest.approx(0.0, abs=1e-12)


class Drive:
    """Pairs of a textured plane across the view, two frames a quarter of a metre apart, by their homographies."""

    def __init__(self):
        self.camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
        rig = Rig(self.camera, self.camera, RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0])))
        self.sequence = type("Sequence", (), {"rig": rig})()
        self.frames = range(2)
        noise = np.random.default_rng(3).uniform(0, 255, (600, 800)).astype(np.float32)
        self.texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.5), None, 0, 255, cv2.NORM_MINMAX)

    def ideal(self, frame, camera):
        """Plane 4 m ahead, a pixel of texture a hundredth of a metre, seen from (x, 0, z)."""
        x, z = (0.2 if camera == "right" else 0.0), 0.25 * frame
        K = self.camera.matrix
        to_texture = np.array([[100.0, 0, 400.0], [0, 100.0, 300.0], [0, 0, 1.0]])
        to_plane = np.array([[4.0 - z, 0, x], [0, 4.0 - z, 0], [0, 0, 1.0]]) @ np.linalg.inv(K)
        image = cv2.warpPerspective(
            self.texture, to_texture @ to_plane, (320, 240), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        )
        return Bundle({"image": np.clip(image, 0, 255).astype(np.uint8)}, {})


def test_the_plain_odometry_finds_the_step():
    found = Odometry(Drive()).run()
    assert found.facts["lost"] == 0
    np.testing.assert_allclose(found.poses[1, :, 3], [0.0, 0.0, 0.25], atol=0.02)
