"""Visual-inertial recordings in the layout of EuRoC: a folder made by hand, and a real one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.euroc import open_layout
from rille.datasets.images.files import Digests
from rille.stages.geometry.geometry import RigidTransform, rotation_exp

START = 1403715273262142976
STEP = 50_000_000
FRAMES = 5

# body: x up, y left, z backwards, as on a drone with a turned camera; metres
T_BODY_LEFT = RigidTransform([[0, -1, 0], [-1, 0, 0], [0, 0, -1]], [0.02, 0.06, 0.01])
T_BODY_RIGHT = RigidTransform([[0, -1, 0], [-1, 0, 0], [0, 0, -1]], [0.02, -0.05, 0.01])
T_BODY_IMU = RigidTransform(rotation_exp([0.2, 0.5, -0.9]), [0.1, 0.0, 0.0])
T_BODY_MARKER = RigidTransform(rotation_exp([0.0, 0.0, np.pi / 2]), [0.0, 0.0, 0.3])


def sensor(T, camera=True):
    rows = [*T.to_list(), 0.0, 0.0, 0.0, 1.0]
    text = f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: {rows}\n"
    if camera:
        text += "resolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50.0, 51.0, 31.0, 24.0]\n"
        text += "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]\n"
    return text


def body(t):
    """T_world_body of a drone that turns about the vertical (its x axis is up) and rises; t in seconds."""
    up = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]])  # body x is world z
    return RigidTransform(rotation_exp([0, 0, 0.1 * t]) @ up, [1.0, 2.0, 0.2 * t])


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def poses(marker, times):
    lines = ["#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"]
    for t in times:
        T = body((t - START) / 1e9) @ marker
        w, x, y, z = quaternion(T.rotation)
        lines.append(f"{t},{','.join(repr(float(v)) for v in (*T.translation, w, x, y, z))}")
    return "\n".join(lines) + "\n"


def quaternion(R):
    w = np.sqrt(max(0.0, 1 + np.trace(R))) / 2
    assert w > 0.05
    return w, (R[2, 1] - R[1, 2]) / 4 / w, (R[0, 2] - R[2, 0]) / 4 / w, (R[1, 0] - R[0, 1]) / 4 / w


def imu_rows():
    lines = ["#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z"]
    R_imu_body = T_BODY_IMU.rotation.T
    w, a = R_imu_body @ [0.1, 0, 0], R_imu_body @ [9.81, 0, 0]
    for k in range(-200, 300):
        moving = w if k >= 0 else 0 * w
        lines.append(f"{START + k * 5_000_000},{','.join(repr(float(v)) for v in (*moving, *a))}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def flight(tmp_path):
    folder = tmp_path / "hall"
    stamps = [START + k * STEP for k in range(FRAMES)]
    for name, T in (("cam0", T_BODY_LEFT), ("cam1", T_BODY_RIGHT)):
        write(folder / "mav0" / name / "sensor.yaml", sensor(T))
        (folder / "mav0" / name / "data").mkdir()
        rows = ["#timestamp [ns],filename"]
        for k, stamp in enumerate(stamps):
            picture = np.full((48, 64), 10 * k + (100 if name == "cam1" else 0), np.uint8)
            cv2.imwrite(str(folder / "mav0" / name / "data" / f"{stamp}.png"), picture)
            rows.append(f"{stamp},{stamp}.png")
        write(folder / "mav0" / name / "data.csv", "\r\n".join(rows) + "\r\n")
    write(folder / "mav0" / "imu0" / "sensor.yaml", sensor(T_BODY_IMU, camera=False))
    write(folder / "mav0" / "imu0" / "data.csv", imu_rows())
    # truth at other moments than the images
    times = [START - 20_000_000 + k * STEP for k in range(FRAMES + 2)]
    write(folder / "mav0" / "state_groundtruth_estimate0" / "data.csv", poses(RigidTransform.identity(), times))
    return folder


def opened(folder):
    return open_layout(folder, None, Digests())


def test_a_whole_recording(flight, materialise):
    s = opened(flight)
    assert (s.name, s.frames, s.warnings) == ("hall", FRAMES, ())
    assert s.frame_names[1] == str(START + STEP)
    np.testing.assert_allclose(np.diff(s.times), 0.05, atol=3e-7)
    assert s.rig.baseline == pytest.approx(0.11)
    np.testing.assert_allclose(s.rig.T_right_left.translation, [-0.11, 0, 0], atol=1e-12)
    assert s.lenses["left"].coefficients[0] == -0.28
    assert s.lenses["right"].camera.fy == 51.0
    assert materialise(s.image(2, "left"))["image"][0, 0] == 20
    assert materialise(s.image(3, "right"))["image"][0, 0] == 130


def test_mav0_itself_is_recognised_and_others_are_not(flight, tmp_path):
    assert opened(flight / "mav0").name == "hall"
    assert opened(tmp_path) is None


def test_truth_is_that_of_the_left_camera_at_the_image(flight):
    s = opened(flight)
    for k, found in enumerate(s.truth):
        np.testing.assert_allclose(found.matrix34, (body(0.05 * k) @ T_BODY_LEFT).matrix34, atol=1e-6)
    assert "state_groundtruth_estimate0" in s.truth_source


def test_markers_stand_somewhere_in_the_body(flight):
    (flight / "mav0" / "state_groundtruth_estimate0").rename(flight / "mav0" / "vicon0")
    times = [START + k * STEP for k in range(FRAMES)]
    write(flight / "mav0" / "vicon0" / "data.csv", poses(T_BODY_MARKER, times))
    s = opened(flight)
    assert s.truth is None
    assert [line[:7] for line in s.warnings] == ["RIL-683"]
    write(flight / "mav0" / "vicon0" / "sensor.yaml", sensor(T_BODY_MARKER, camera=False))
    s = opened(flight)
    np.testing.assert_allclose(s.truth[3].matrix34, (body(0.15) @ T_BODY_LEFT).matrix34, atol=1e-6)


def test_imu_gives_the_rotation_and_the_vertical_of_the_camera(flight):
    s = opened(flight)
    truth = [(body(0.05 * k) @ T_BODY_LEFT).rotation for k in range(FRAMES)]
    for k, rows in enumerate(s.attitude):
        ours = np.array(s.attitude[0]).T @ np.array(rows)
        # the rate jumps within one sample, 0.1 rad/s x 0.0025 s
        np.testing.assert_allclose(ours, truth[0].T @ truth[k], atol=3e-4)
        np.testing.assert_allclose(s.up[k], truth[k].T @ [0, 0, 1], atol=1e-3)
    assert "1.0 s of rest" in s.notes[0]


def test_truth_with_a_gap_is_said(flight):
    path = flight / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    lines = path.read_text().splitlines()
    write(path, "\n".join(lines[:2] + lines[5:]) + "\n")
    s = opened(flight)
    assert [T is not None for T in s.truth] == [False, False, False, False, True]
    assert "RIL-688" in [line[:7] for line in s.warnings]


def test_images_without_a_partner_are_left_out_and_counted(flight):
    (flight / "mav0" / "cam1" / "data" / f"{START + 2 * STEP}.png").unlink()
    s = opened(flight)
    assert s.frames == FRAMES - 1
    assert str(START + 2 * STEP) not in s.frame_names
    assert s.image(2, "right").hints["path"].endswith(f"{START + 3 * STEP}.png")
    assert [line[:7] for line in s.warnings] == ["RIL-821"]
    assert "1 image " in s.warnings[0]


def test_without_imu_truth_or_lists(flight):
    for name in ("imu0", "state_groundtruth_estimate0"):
        (flight / "mav0" / name / "data.csv").unlink()
    for name in ("cam0", "cam1"):
        (flight / "mav0" / name / "data.csv").unlink()
    s = opened(flight)
    assert s.frames == FRAMES
    assert (s.truth, s.up, s.attitude, s.warnings) == (None, None, None, ())
    assert s.times[0] == pytest.approx(START / 1e9)


def _no_calibration(m):
    (m / "cam1" / "sensor.yaml").unlink()


def _mixed(m):
    for name in ("cam0", "cam1"):
        text = (m / name / "data.csv").read_text().splitlines()
        text[3] = text[3][:16] + text[3][19:]
        (m / name / "data.csv").write_text("\n".join(text))


def _empty(m):
    for path in (m / "cam0" / "data").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (_no_calibration, ("RIL-161", "cam1/sensor.yaml", "cam1")),
        (_mixed, ("RIL-293", "cam0/data.csv", "line 4", "in one unit")),  # its title says which
        (_empty, ("RIL-217", "cam0/data")),
    ],
)
def test_what_is_wrong_is_one_line_with_a_remedy(flight, spoil, expected):
    spoil(flight / "mav0")
    with raises(*expected) as caught:
        opened(flight)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


def test_a_damaged_sensor_is_no_reason_to_give_the_recording_up(flight):
    record = flight / "mav0" / "imu0" / "data.csv"
    lines = record.read_text().splitlines()
    record.write_text("\n".join([*lines[:9], *lines[7:]]))
    with raises("RIL-293", "line 10", f"or rename {record.parent}"):
        opened(flight)
    record.parent.rename(record.parent.with_name("imu0.damaged"))
    assert opened(flight).frames == FRAMES


def test_positions_of_a_laser_tracker_are_a_truth(flight):
    """EuRoC's ``leica0``: positions of a prism that its ``T_BS`` places in the body."""
    m = flight / "mav0"
    (m / "state_groundtruth_estimate0").rename(m / "other")
    prism = [body(k * STEP / 1e9) @ T_BODY_MARKER for k in range(FRAMES)]
    rows = [f"{START + k * STEP},{','.join(map(repr, T.translation.tolist()))}" for k, T in enumerate(prism)]
    write(m / "leica0" / "sensor.yaml", sensor(T_BODY_MARKER, camera=False))
    write(
        m / "leica0" / "data.csv", "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n" + "\n".join(rows) + "\n"
    )
    truth = opened(flight).truth_positions
    for k, T in enumerate(prism):
        left = body(k * STEP / 1e9) @ T_BODY_LEFT
        np.testing.assert_allclose(left.apply(np.array(truth.lever_arm)), T.translation, atol=1e-9)
        np.testing.assert_allclose(truth.positions[k], T.translation)


# -- a real drone, at rest ---------------------------------------------------------------------------------------------


def angle_deg(R):
    return np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))


@pytest.mark.data
def test_resting_drone(data_dir, materialise):
    s = opened(data_dir / "euroc_still")
    assert (s.name, s.frames, s.warnings) == ("euroc_still", 20, ())
    assert s.rig.baseline == pytest.approx(0.1101, abs=1e-4)
    assert materialise(s.image(19, "right"))["image"].shape == (480, 752)
    way = np.linalg.norm(np.diff([T.translation for T in s.truth], axis=0), axis=1).sum()
    assert 0.001 < way < 0.005
    for k, T in enumerate(s.truth):
        # two sensors of their own: the accelerometer's bias of 0.1 m/s^2 is 0.6 degrees
        assert np.degrees(np.arccos(np.array(s.up[k]) @ (T.rotation.T @ [0, 0, 1]))) < 0.8
        ours, true = (
            np.array(a).T @ np.array(b) for a, b in ((s.attitude[0], s.attitude[k]), (s.truth[0].rotation, T.rotation))
        )
        assert angle_deg(ours.T @ true) < 0.12
    # at frame 15 the drone was shaken by 0.18 degrees; the gyroscope saw the same turn, not another of that size
    ours = np.array(s.attitude[0]).T @ np.array(s.attitude[15])
    true = s.truth[0].rotation.T @ s.truth[15].rotation
    assert angle_deg(true) > 0.15
    assert angle_deg(ours.T @ true) < 0.5 * angle_deg(true)
