"""Figures of the navigation benchmark by hand, and the odometry beside ours on a drive that is known."""

import cv2
import numpy as np
import pytest

from benchmarks.odometry.limits import lines
from benchmarks.odometry.measures import judge
from benchmarks.odometry.opencv import Odometry
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform


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


def figures(method, **changes):
    plain = {"lost": 0.0, "one_frame": 0.01, "drift": 0.9, "rmse_first": 0.02, "processor": 200.0}
    return {"method": method, **plain, **changes}


def test_limits_are_those_of_the_same_run():
    run = [
        figures("OpenCV odometry", one_frame=0.0125),
        figures("Rille default", processor=201.0),
        figures("Rille navigation", one_frame=0.0119, rmse_first=0.03, processor=99.0),
        figures("COLMAP", rmse_first=0.02, processor=1000.0),
    ]
    kept = {line.what: line.kept for line in lines("somewhere/kitti06_51", run)}
    assert kept == {
        "Rille default: frames lost": True,
        "Rille default: error of one frame, mm": True,
        "Rille default: drift, %": True,
        "Rille default: error of one frame against OpenCV's": True,  # 0.8
        "Rille default: processor time against OpenCV's": False,
        "Rille default: RMSE of the first frames against COLMAP's": True,
        "Rille default: processor time against COLMAP's": False,
        "Rille navigation: frames lost": True,
        "Rille navigation: error of one frame, mm": False,
        "Rille navigation: drift, %": True,
        "Rille navigation: error of one frame against OpenCV's": False,  # 0.952
        "Rille navigation: processor time against OpenCV's": True,
        "Rille navigation: RMSE of the first frames against COLMAP's": False,
        "Rille navigation: processor time against COLMAP's": True,
    }


def test_elsewhere_and_alone_there_are_fewer_limits_and_a_missing_figure_keeps_none():
    alone = lines("mockup-short", [figures("Rille default", lost=float("nan"))])
    assert [(line.what, line.kept) for line in alone] == [("Rille default: frames lost", False)]


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
