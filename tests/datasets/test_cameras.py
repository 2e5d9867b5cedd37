import json
import math

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.cameras import UNKNOWN_SIZE, CalibratedCamera, read_cameras, rig_of
from rille.datasets.cameras.model import relative_pose
from rille.stages.geometry.geometry import Camera, RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens

SIZE = (640, 480)
ROTATION = rotation_exp([0.01, -0.02, 0.03])
SHIFT = np.array([-0.12, 0.002, 0.003])


def written(tmp_path, text, name="calibration.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def numbers(values):
    return "[" + ", ".join(repr(float(v)) for v in np.ravel(values)) + "]"


def centre(T_camera_reference):
    return T_camera_reference.inverse().translation


# -- OpenCV and ROS ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_stereo_as_opencv_writes_it(tmp_path, suffix):
    path = tmp_path / f"stereo.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    for n, f in ((1, 500.0), (2, 510.0)):
        storage.write(f"M{n}", np.array([[f, 0, 320.5], [0, f + 1, 240.25], [0, 0, 1]]))
        storage.write(f"D{n}", np.array([[-0.3, 0.1, 1e-5, -2e-3, 0.02]]))
    storage.write("R", ROTATION)
    storage.write("T", SHIFT.reshape(3, 1))
    for n in (1, 2):  # of the rectified images; in KITTI's files P1 is a label
        storage.write(f"R{n}", np.eye(3))
        storage.write(f"P{n}", np.eye(3, 4))
    storage.release()
    left, right = read_cameras(path)
    assert (left.name, right.name) == ("left", "right")
    assert left.lens == Lens(Camera(500, 501, 320.5, 240.25, *SIZE), "radtan", (-0.3, 0.1, 1e-5, -2e-3, 0.02))
    assert right.lens.camera.fx == 510
    rig, lenses = rig_of(left, right)
    np.testing.assert_allclose(rig.T_right_left.rotation, ROTATION, atol=1e-12)
    np.testing.assert_allclose(rig.T_right_left.translation, SHIFT, atol=1e-12)
    assert lenses == {"left": left.lens, "right": right.lens}


P1 = np.array([[380.0, 0, 239.5, 0], [0, 380, 179.5, 0], [0, 0, 1, 0]])
P2 = np.array([[380.0, 0, 239.5, -76.0], [0, 380, 179.5, 0], [0, 0, 1, 0]])


def test_opencv_projections_alone_are_those_of_rectified_images(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "rectification.yml"), cv2.FILE_STORAGE_WRITE)
    for key, value in (("R1", ROTATION), ("R2", ROTATION), ("P1", P1), ("P2", P2), ("Q", np.eye(4))):
        storage.write(key, value)
    storage.release()
    left, right = read_cameras(tmp_path / "rectification.yml")
    rig, lenses = rig_of(left, right, ((480, 360), (480, 360)))
    assert (rig.left.fx, rig.left.cx, rig.left.cy) == (380, 239.5, 179.5)
    np.testing.assert_allclose(rig.T_right_left.translation, [-0.2, 0, 0], atol=1e-12)
    assert not lenses


@pytest.mark.parametrize("flags", [0, cv2.CALIB_ZERO_DISPARITY])
def test_opencv_q_alone_is_that_of_rectified_images(tmp_path, flags):
    unlike = np.array([[400.0, 0, 260.0], [0, 400, 170], [0, 0, 1]])
    given = P1[:, :3], np.zeros(5), unlike, np.zeros(5), (480, 360), ROTATION, SHIFT.reshape(3, 1)
    _, _, first, second, Q, *_ = cv2.stereoRectify(*given, flags=flags)
    storage = cv2.FileStorage(str(tmp_path / "q.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("Q", Q)
    storage.release()
    rig, _ = rig_of(*read_cameras(tmp_path / "q.yml"), ((480, 360), (480, 360)))
    for camera, P in ((rig.left, first), (rig.right, second)):
        np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (P[0, 0], P[1, 1], P[0, 2], P[1, 2]))
    np.testing.assert_allclose(rig.T_right_left.translation, [-np.linalg.norm(SHIFT), 0, 0], atol=1e-9)


def test_opencv_projections_stand_in_extrinsics_beside_intrinsics(tmp_path):
    for file, entries in (
        (
            "intrinsics.yml",
            {f"{what}{n}": value for n in (1, 2) for what, value in (("M", P1[:, :3]), ("D", np.zeros(5)))},
        ),
        ("extrinsics.yml", {"R": ROTATION, "T": SHIFT.reshape(3, 1), "P1": P1, "P2": P2}),
    ):
        storage = cv2.FileStorage(str(tmp_path / file), cv2.FILE_STORAGE_WRITE)
        for key, value in entries.items():
            storage.write(key, value)
        storage.release()
    left, right = read_cameras(tmp_path / "intrinsics.yml")
    np.testing.assert_allclose(right.T_camera_reference.translation, SHIFT, atol=1e-12)
    rig, _ = rig_of(left.rectified, right.rectified, ((480, 360), (480, 360)))
    np.testing.assert_allclose(rig.T_right_left.translation, [-0.2, 0, 0], atol=1e-12)
    with raises("RIL-100"):  # of raw images it is no camera
        read_cameras(tmp_path / "extrinsics.yml")


MONO = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.e+02, 0., 3.2e+02, 0., 5.01e+02, 2.4e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: {count}
   dt: d
   data: {values}
"""


@pytest.mark.parametrize(
    ("values", "model", "kept"),
    [
        ([-0.2, 0.1, 0.0, 0.0], "radtan", 4),
        ([-0.2, 0.1, 0.0, 0.0, 0.3], "radtan", 5),
        ([-0.2, 0.1, 0.0, 0.0, 0.3, 0.1, 0.2, 0.3], "rational", 8),
        ([-0.2, 0.1, 0.0, 0.0, 0.3, 0.1, 0.2, 0.3, 0, 0, 0, 0], "rational", 8),
        ([-0.2, 0.1, 0.0, 0.0, 0.3, 0.1, 0.2, 0.3, 0.1, 0, 0, 0, 0, 0], "rational", 12),
    ],
)
def test_opencv_model_by_the_count_of_coefficients(tmp_path, values, model, kept):
    (camera,) = read_cameras(written(tmp_path, MONO.format(count=len(values), values=values), "left.yml"))
    assert camera.name == "left"
    assert camera.lens.model == model
    assert camera.lens.coefficients == tuple(values[:kept])
    assert camera.T_camera_reference is None


@pytest.mark.parametrize(
    ("matrix", "distortion"),
    [
        ("K{n}", "dist{n}"),
        ("cameraMatrix{n}", "distCoeffs{n}"),
        ("camera_matrix_{side}", "dist_coeffs_{side}"),
        ("{side}_camera_matrix", "{side}_distortion_coefficients"),
        ("{SIDE}.K", "{SIDE}.D"),
        ("cameraMatrix{Side}", "distCoeffs{Side}"),
        ("mtx{L}", "dist{L}"),
        ("K_{l}", "d_{l}"),
        ("{Side}CameraMatrix", "{Side}DistCoeffs"),
        ("intrinsic_matrix_{side}", "distortion_{side}"),
        ("CM{n}", "D{n}"),
        ("K{zero}", "D{zero}"),
        ("cam{zero}_K", "cam{zero}_D"),
        ("camera_matrix_{zero}", "dist_coeffs_{zero}"),
    ],
)
def test_both_cameras_by_whatever_name(tmp_path, matrix, distortion):
    text = f"R: {numbers(ROTATION)}\nT: {numbers(SHIFT)}\nimage_size: [{SIZE[0]}, {SIZE[1]}]\n"
    for n, side, f in ((2, "right", 510.0), (1, "left", 500.0)):
        words = {
            "n": n,
            "zero": n - 1,
            "side": side,
            "SIDE": side.upper(),
            "Side": side.title(),
            "l": side[0],
            "L": side[0].upper(),
        }
        text += f"{matrix.format(**words)}: {numbers(np.array([[f, 0, 320], [0, f, 240], [0, 0, 1]]))}\n"
        text += f"{distortion.format(**words)}: {numbers([0.1 * n, 0, 0, 0])}\n"
    left, right = read_cameras(written(tmp_path, text, "rig.yml"))
    assert (left.lens.camera.fx, right.lens.camera.fx) == (500, 510)
    assert (left.lens.coefficients[0], right.lens.coefficients[0]) == (0.1, 0.2)
    np.testing.assert_allclose(right.T_camera_reference.translation, SHIFT)


def test_opencv_sample_keeps_the_relative_pose_in_a_second_file(tmp_path):
    inner = "".join(
        f"{key}: {numbers(values)}\n"
        for n in (1, 2)
        for key, values in ((f"M{n}", np.diag([500, 500, 1.0])), (f"D{n}", [0, 0, 0, 0]))
    )
    path = written(tmp_path, inner, "intrinsics.yml")
    assert [camera.T_camera_reference for camera in read_cameras(path)] == [None, None]
    written(tmp_path, f"R: {numbers(ROTATION)}\nT: {numbers(SHIFT)}\n", "extrinsics.yml")
    left, right = read_cameras(path)
    assert left.size is None
    np.testing.assert_allclose(right.T_camera_reference.translation, SHIFT)
    with raises("RIL-100"):
        read_cameras(tmp_path / "extrinsics.yml")


ROS = """image_width: 640
image_height: 480
camera_name: stereo/{name}
camera_matrix: {{rows: 3, cols: 3, data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: {count}, data: {values}}}
rectification_matrix: {{rows: 3, cols: 3, data: {rotation}}}
projection_matrix: {{rows: 3, cols: 4, data: [450, 0, 300, {shift}, 0, 450, 200, 0, 0, 0, 1, 0]}}
"""


def test_ros_camera_info_holds_the_baseline_in_the_projection(tmp_path):
    a, b = rotation_exp([0.0, 0.01, 0.02]), rotation_exp([0.01, -0.03, 0.0])
    files = []
    for name, rotation, shift in (("left", a, 0.0), ("right", b, -54.0)):
        text = ROS.format(
            name=name, model="plumb_bob", count=5, values=[-0.1, 0, 0, 0, 0], rotation=numbers(rotation), shift=shift
        )
        files.append(written(tmp_path, text, f"{name}.yaml"))
    left, right = (read_cameras(file)[0] for file in files)
    assert left.name == "stereo/left"
    rig, _ = rig_of(left, right)
    assert rig.baseline == pytest.approx(54 / 450)
    # A point's rectified coordinates differ by the baseline alone.
    x = np.array([0.3, -0.2, 4.0])
    np.testing.assert_allclose(b @ rig.T_right_left.apply(x), a @ x - [0.12, 0, 0], atol=1e-12)


MESSAGE = """header:
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.1, 0.0, 0.0, 0.0, 0.0]
k: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]
r: {rotation}
p: [450.0, 0.0, 300.0, {shift}, 0.0, 450.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
---
"""


@pytest.mark.parametrize("capital", [False, True])
def test_ros_message_as_echo_prints_it_says_what_the_file_says(tmp_path, capital):
    rotation = numbers(rotation_exp([0.01, -0.03, 0.0]))
    text = MESSAGE.format(rotation=rotation, shift=-54.0)
    for key in "dkrp" if capital else "":  # ROS 1
        text = text.replace(f"\n{key}:", f"\n{key.upper()}:")
    file = ROS.format(
        name="right", model="plumb_bob", count=5, values=[-0.1, 0, 0, 0, 0], rotation=rotation, shift=-54.0
    )
    found, expected = (read_cameras(written(tmp_path, t, f"{k}.yaml"))[0] for k, t in enumerate((text, file)))
    assert found.size == (640, 480)
    assert found.lens.coefficients == expected.lens.coefficients
    assert found.lens.camera.matrix.tolist() == [[500, 0, 320], [0, 501, 240], [0, 0, 1]]
    assert found.T_camera_reference.to_list() == expected.T_camera_reference.to_list()
    stamped = [f"header:\n  stamp:\n    sec: {k}\n" + text.removeprefix("header:\n") for k in range(3)]
    several = written(tmp_path, "".join(stamped)[:-120], "several.yaml")  # printing was ended within the last one
    assert read_cameras(several)[0].lens == found.lens
    with raises("RIL-141", "another document"):
        read_cameras(written(tmp_path, text + text.replace("501.0", "502.0"), "unlike.yaml"))


@pytest.mark.parametrize(
    ("model", "values", "kind"),
    [
        ("rational_polynomial", [0.1, 0, 0, 0, 0, 0.1, 0, 0], "rational"),
        ("equidistant", [0.1, 0, 0, 0], "fisheye"),
        ("plumb_bob", [0, 0, 0, 0, 0], "radtan"),
    ],
)
def test_ros_models(tmp_path, model, values, kind):
    text = ROS.format(name="left", model=model, count=len(values), values=values, rotation=numbers(np.eye(3)), shift=0)
    assert read_cameras(written(tmp_path, text))[0].lens.model == kind


BENT = [0.0175653, -0.0031772, 0.0036, -0.0007]
COEFFICIENTS = f"distortion_coefficients: {BENT}\n"
PINHOLE = "camera_matrix: [500, 0, 320, 0, 501, 240, 0, 0, 1]\nimage_width: 640\nimage_height: 480\n"
CAM0 = "cam0:\n  camera_model: pinhole\n  intrinsics: [190, 190, 250, 250]\n  resolution: [512, 512]\n"


@pytest.mark.parametrize(
    ("text", "model"),
    [
        (PINHOLE + COEFFICIENTS, "radtan"),
        (PINHOLE + COEFFICIENTS + "camera_model: fisheye\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "distorsion: equidistant\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "dist_model: Kannala_Brandt4\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "lens: equi\ncamera_model: pinhole\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "type: fisheye\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "is_fisheye: true\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "fisheye_model: 0\ndistortion_model: plumb-bob\n", "radtan"),
        (PINHOLE + COEFFICIENTS + "camera_model: fisheye\ndistortion_model: equidistant\n", "fisheye"),
        (PINHOLE + COEFFICIENTS + "camera_model: pinhole-equi\n", "fisheye"),
        # Not of the lens, or nothing of it.
        (PINHOLE + COEFFICIENTS + "model: BFS-U3-31S4C\ncorner_dist: 0.1\nk3: 0.0\nsigmas: {left_k1: 0.1}\n", "radtan"),
        (PINHOLE + "distortion_model: plumb_bob\ndistortion_coefficients: []\n", "none"),
        (CAM0 + f"  distortion_coeffs: {BENT}\n  distorsion_model: equidistant\n", "fisheye"),
        (CAM0 + f"  distortion_coeffs: {BENT}\n  distortion_model: RadTan\n", "radtan"),
        ('{\n\t"K": [[500, 0, 320], [0, 501, 240], [0, 0, 1]],\n\t"D": [0.1, 0, 0, 0], "lens": "fisheye"}', "fisheye"),
    ],
)
def test_a_lens_is_read_under_any_key_that_names_it(tmp_path, text, model):
    assert read_cameras(written(tmp_path, text))[0].lens.model == model


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PINHOLE + COEFFICIENTS + "distortion_model: fisheye62\n", ("RIL-120", "fisheye62")),
        (PINHOLE + COEFFICIENTS + "lens_type: omni\n", ("RIL-120", "lens_type")),
        (PINHOLE + COEFFICIENTS + "distortion_model: plumb_bob\ncamera_model: fisheye\n", ("RIL-811", "camera_model")),
        (PINHOLE + "distortion_model: plumb_bob\n", ("RIL-812", "distortion_coefficients")),
        (PINHOLE + f"distorsion_coefficients: {BENT}\n", ("RIL-810", "distorsion_coefficients")),
        (PINHOLE + f"coeffs: {BENT}\n", ("RIL-810", "coeffs")),
        (PINHOLE + "distortion: {k1: 0.1, k2: 0.2}\n", ("RIL-810", "distortion.k1")),
        (PINHOLE + COEFFICIENTS + "lens: {type: fisheye}\n", ("RIL-810", "lens.type")),
        (PINHOLE + COEFFICIENTS + "k5: 1e-3\n", ("RIL-810", "k5")),
        (CAM0 + "  distortion_model: equidistant\n", ("RIL-812", "cam0.distortion_coeffs")),
        (CAM0 + f"  dist_coeffs: {BENT}\n", ("RIL-810", "cam0.dist_coeffs")),
        (CAM0 + f"  distortion_coeffs: {BENT}\ndistortion_model: equidistant\n", ("RIL-810", "distortion_model")),
        ("P0: 707 0 601 0 0 707 183 0 0 0 1 0\nD: -0.3 0.1 0 0 0\n", ("RIL-810", "D =")),
        ("cam0=[700 0 300; 0 700 200; 0 0 1]\ncam1=[700 0 300; 0 700 200; 0 0 1]\nbaseline=90\nk1=0.1\n", ("RIL-810",)),
    ],
)
def test_what_would_be_another_lens_is_refused(tmp_path, text, expected):
    path = written(tmp_path, text)
    with raises(*expected) as error:
        read_cameras(path)
    assert str(error.value).count(str(path)) == 1
    assert "\n" not in str(error.value)


def test_rectification_of_orbslam2_gives_the_raw_cameras(tmp_path):
    text = "%YAML:1.0\nCamera.fx: 435.2\nCamera.fy: 435.2\nCamera.cx: 367.4\nCamera.cy: 252.2\nCamera.bf: 47.9\n"
    a, b = rotation_exp([0.0, 0.01, 0.02]), rotation_exp([0.01, -0.03, 0.0])
    for side, rotation, shift in (("LEFT", a, 0.0), ("RIGHT", b, -43.52)):
        text += f"{side}.height: 480\n{side}.width: 752\n"
        text += f"{side}.D: {numbers([-0.28, 0.07, 0, 0, 0])}\n{side}.K: {numbers(np.diag([458, 457, 1.0]))}\n"
        text += f"{side}.R: {numbers(rotation)}\n"
        text += f"{side}.P: {numbers([[435.2, 0, 367, shift], [0, 435.2, 252, 0], [0, 0, 1, 0]])}\n"
    left, right = read_cameras(written(tmp_path, text))
    assert left.lens.camera.fx == 458
    assert left.size == (752, 480)
    rig, _ = rig_of(left, right)
    np.testing.assert_allclose(rig.T_right_left.rotation, b.T @ a, atol=1e-12)
    assert rig.baseline == pytest.approx(0.1)


# -- visual-inertial programs ------------------------------------------------------------------------------------------

KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]
  distortion_model: equidistant
  intrinsics: [190.9, 190.8, 254.9, 256.8]
  resolution: [512, 512]
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]
  distortion_model: radtan
  intrinsics: [190.4, 190.3, 252.5, 254.9]
  resolution: [512, 512]
"""


def test_kalibr_chain(tmp_path):
    third = KALIBR[KALIBR.index("cam1:") :].replace("cam1", "cam2").replace("-0.1]", "-0.2]")
    first, second, last = read_cameras(written(tmp_path, KALIBR + third))
    assert [c.name for c in (first, second, last)] == ["cam0", "cam1", "cam2"]
    assert first.lens.model == "fisheye"
    assert second.lens == Lens(Camera(190.4, 190.3, 252.5, 254.9, 512, 512), "radtan", (-0.28, 0.07, 0.0002, 1.7e-05))
    np.testing.assert_allclose(centre(second.T_camera_reference), [0.1, 0, 0])
    np.testing.assert_allclose(centre(last.T_camera_reference), [0.3, 0, 0])


def test_kalibr_by_the_imu(tmp_path):
    a = RigidTransform(ROTATION, [0.1, 0.2, 0.3])
    b = RigidTransform(np.eye(3), SHIFT) @ a
    text = "".join(
        f"cam{n}: {{intrinsics: [190, 190, 250, 250], resolution: [512, 512], "
        f"T_cam_imu: {[*map(list, np.vstack([T.matrix34, [0, 0, 0, 1]]).tolist())]}}}\n"
        for n, T in enumerate((a, b))
    )
    left, right = read_cameras(written(tmp_path, text))
    assert left.lens.model == "none"
    np.testing.assert_allclose(rig_of(left, right)[0].T_right_left.translation, SHIFT, atol=1e-12)


def test_kalibr_by_the_imu_in_either_direction_or_both(tmp_path):
    """OpenVINS states T_imu_cam; of a chain with both, links count where all have them."""
    a, between = RigidTransform(ROTATION, [0.1, 0.2, 0.3]), RigidTransform(np.eye(3), SHIFT)
    b = between @ a

    def rig(*poses, name="cam"):
        text = "".join(
            f"{name}{n}: {{intrinsics: [190, 190, 250, 250], resolution: [512, 512], {key}: "
            f"{np.vstack([T.matrix34, [0, 0, 0, 1]]).tolist()}}}\n"
            for n, (key, T) in enumerate(poses)
        )
        cameras = read_cameras(written(tmp_path, text))
        return rig_of(cameras[0], cameras[-1])[0].T_right_left.matrix34

    inverse = ("T_imu_cam", a.inverse()), ("T_imu_cam", b.inverse())
    mixed = ("T_imu_cam", a.inverse()), ("T_cam_imu", b)
    chained = ("T_cam_imu", b.inverse() @ a), ("T_imu_cam", a.inverse()), ("T_cn_cnm1", between)
    np.testing.assert_allclose(rig(*inverse), between.matrix34, atol=1e-12)
    np.testing.assert_allclose(rig(*mixed), between.matrix34, atol=1e-12)
    expected = (b @ (b.inverse() @ a).inverse()).matrix34
    np.testing.assert_allclose(rig(*chained), expected, atol=1e-12)
    for key in ("T_BS", "T_SC", "T_b"):
        found = rig((key, a.inverse()), (key, b.inverse()), name="camera_")
        np.testing.assert_allclose(found, between.matrix34, atol=1e-12)
    with raises("RIL-766", "camera_0.T_x"):
        rig(("T_x", a.inverse()), ("T_x", b.inverse()), name="camera_")


@pytest.mark.parametrize("form", ["okvis", "svo"])
def test_a_list_of_cameras_says_what_a_chain_says(tmp_path, form):
    size, optics, bent = [752, 480], [458.6, 457.3, 367.2, 248.4], [-0.28, 0.07, 0.0002, 2e-05]
    chain, cameras = {}, []
    for n, at in enumerate((0.0, 0.11)):
        pose = [1, 0, 0, at, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        chain[f"cam{n}"] = {"resolution": size, "intrinsics": optics, "distortion_coeffs": bent, "T_BS": pose}
        if form == "okvis":
            one = {"T_SC": pose, "image_dimension": size, "focal_length": optics[:2], "principal_point": optics[2:]}
            one |= {"distortion_coefficients": bent, "distortion_type": "radialtangential"}
        else:
            lens = {"type": "radial-tangential", "parameters": {"cols": 1, "rows": 4, "data": bent}}
            inner = {"image_height": 480, "image_width": 752, "type": "pinhole", "distortion": lens}
            inner["intrinsics"] = {"cols": 1, "rows": 4, "data": optics}
            one = {"camera": inner, "T_B_C": {"rows": 4, "cols": 4, "data": pose}}
        cameras.append(one)
    wanted = rig_of(*read_cameras(written(tmp_path, json.dumps(chain), "chain.json")))
    rig, lenses = rig_of(*read_cameras(written(tmp_path, json.dumps({"cameras": cameras}))))
    assert rig.baseline == pytest.approx(0.11)
    assert (rig.left, rig.right, lenses) == (wanted[0].left, wanted[0].right, wanted[1])
    del cameras[1]["focal_length" if form == "okvis" else "camera"]
    with raises("RIL-100"):
        read_cameras(written(tmp_path, json.dumps({"cameras": cameras})))


@pytest.mark.parametrize("listed", [[], ["left", "right"], [{}, {}]])
def test_a_list_of_other_things_is_none_of_cameras(tmp_path, listed):
    figures = {"fx": 458, "fy": 457, "cx": 367, "cy": 248, "baseline": 0.11}
    assert len(read_cameras(written(tmp_path, json.dumps({"cameras": listed} | figures)))) == 2
    with raises("RIL-100"):
        read_cameras(written(tmp_path, json.dumps({"cameras": listed})))


def test_kalibr_of_one_camera(tmp_path):
    """It stands where the IMU says, or nowhere: in a chain of one camera no link is missing."""
    one = "cam0: {{intrinsics: [190, 190, 250, 250], resolution: [512, 512]{}}}\n"
    pose = ", T_cam_imu: [[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    (camera,) = read_cameras(written(tmp_path, one.format(pose)))
    np.testing.assert_allclose(camera.T_camera_reference.translation, [0.2, 0, 0])
    (camera,) = read_cameras(written(tmp_path, one.format("")))
    assert camera.T_camera_reference is None


SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02, 1.0, 0.0, 0.0, {y}, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0]
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def test_euroc_sensor_stands_in_the_body(tmp_path):
    cameras = []
    for n, y in enumerate((-0.06, 0.05)):
        (tmp_path / f"cam{n}").mkdir()
        cameras += read_cameras(written(tmp_path / f"cam{n}", SENSOR.format(y=y), "sensor.yaml"))
    left, right = cameras
    assert (left.name, right.name) == ("cam0", "cam1")
    assert left.lens.coefficients == (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    # Body y is camera x: the right camera stands 0.11 m to the right.
    np.testing.assert_allclose(centre(left.T_camera_reference), [-0.02, -0.06, 0.01], atol=1e-12)
    np.testing.assert_allclose(centre(rig_of(left, right)[0].T_right_left), [0.11, 0, 0], atol=1e-12)


ORB = "%YAML:1.0\n\n# notes\nCamera.fx: 969.0\nCamera.fy: 970\nCamera.cx: 635.1\nCamera.cy: 463.5\n"


CAMODOCAL = """%YAML:1.0
---
model_type: {kind}
camera_name: camera
image_width: 752
image_height: 480
{mirror}distortion_parameters: {{k1: -0.29, k2: 0.1, p1: 0.001, p2: -0.002}}
projection_parameters: {{{projection}}}
"""
USUAL = "fx: 460, fy: 461, cx: 363, cy: 248"


@pytest.mark.parametrize(
    ("kind", "mirror", "projection", "lens"),
    [
        ("PINHOLE", "", USUAL, ("radtan", (-0.29, 0.1, 0.001, -0.002))),
        (
            "MEI",
            "mirror_parameters: {xi: 0}\n",
            "gamma1: 460, gamma2: 461, u0: 363, v0: 248",
            ("radtan", (-0.29, 0.1, 0.001, -0.002)),
        ),
        (
            "KANNALA_BRANDT",
            "",
            "k2: 0.1, k3: 0.2, k4: 0.3, k5: 0.4, mu: 460, mv: 461, u0: 363, v0: 248",
            ("fisheye", (0.1, 0.2, 0.3, 0.4)),
        ),
    ],
)
def test_camodocal(tmp_path, kind, mirror, projection, lens):
    text = CAMODOCAL.format(kind=kind, mirror=mirror, projection=projection)
    if kind == "KANNALA_BRANDT":
        text = text.replace("distortion_parameters: {k1: -0.29, k2: 0.1, p1: 0.001, p2: -0.002}\n", "")
    (camera,) = read_cameras(written(tmp_path, text))
    assert camera.lens == Lens(Camera(460, 461, 363, 248, 752, 480), *lens)


def test_vins_names_a_file_a_camera(tmp_path):
    for n in (0, 1):
        written(tmp_path, CAMODOCAL.format(kind="PINHOLE", mirror="", projection=USUAL), f"cam{n}_pinhole.yaml")
    pose = "body_T_cam{n}: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: d\n  data: {data}\n"
    text = "%YAML:1.0\nimu: 1\nnum_of_cam: 2\n"
    for n, x in ((0, -0.02), (1, 0.09)):
        T = np.vstack([RigidTransform(ROTATION, [x, 0.0, 0.0]).matrix34, [0, 0, 0, 1]])
        text += f"cam{n}_calib: cam{n}_pinhole.yaml\n" + pose.format(n=n, data=numbers(T))
    left, right = read_cameras(written(tmp_path, text))
    assert (left.name, right.name) == ("cam0", "cam1")
    np.testing.assert_allclose(
        centre(right.T_camera_reference) - centre(left.T_camera_reference), [0.11, 0, 0], atol=1e-12
    )


@pytest.mark.parametrize(
    ("kind", "figures", "lens"),
    [
        ("pinhole", {}, ("none", ())),
        ("kb4", {"k1": 0.01, "k2": 0.0, "k3": 0.002, "k4": 0.0}, ("fisheye", (0.01, 0.0, 0.002, 0.0))),
        (
            "pinhole-radtan8",
            {"k1": 0.1, "p2": 0.2, "k6": 0.3, "rpmax": 1.5},
            ("rational", (0.1, 0, 0, 0.2, 0, 0, 0, 0.3)),
        ),
        ("ds", {"xi": -0.2, "alpha": 0.6}, None),
    ],
)
def test_basalt(tmp_path, kind, figures, lens):
    camera = {"camera_type": kind, "intrinsics": {"fx": 460.0, "fy": 461.0, "cx": 363.0, "cy": 248.0, **figures}}
    half = np.sqrt(0.5)  # each camera looks along x of the IMU, right is -y
    poses = [{"px": 0.1, "py": y, "pz": 0.0, "qx": -0.5, "qy": 0.5, "qz": -0.5, "qw": 0.5} for y in (0.06, -0.05)]
    values = {"T_imu_cam": poses, "intrinsics": [camera] * 2, "resolution": [[752, 480]] * 2, "accel_noise_std": [0.1]}
    path = written(tmp_path, json.dumps({"value0": values}), "calibration.json")
    if lens is None:
        with raises("RIL-768", "camera_type", "ds"):
            read_cameras(path)
        return
    left, right = read_cameras(path)
    assert left.lens == Lens(Camera(460, 461, 363, 248, 752, 480), *lens)
    rig, _ = rig_of(left, right)
    np.testing.assert_allclose(rig.T_right_left.translation, [-0.11, 0, 0], atol=1e-12)
    np.testing.assert_allclose(left.T_camera_reference.inverse().rotation @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    poses[1]["qw"] = half
    with raises("RIL-767", "T_imu_cam.1"):
        read_cameras(written(tmp_path, json.dumps({"value0": values}), "calibration.json"))


def test_dsec_has_cameras_before_and_after_rectification(tmp_path):
    """Four cameras in a row, each turned by one degree against the one before, and back by its rectification."""
    turns = [rotation_exp([0.0, np.radians(k), 0.0]) for k in range(4)]
    optics = {"camera_matrix": [560.0, 561.0, 340.0, 220.0], "resolution": [640, 480], "camera_model": "pinhole"}
    bent = optics | {"distortion_coeffs": [-0.1, 0.05, 0.0, 0.001], "distortion_model": "radtan"}
    values = {"intrinsics": {}, "extrinsics": {}}
    for k, R in enumerate(turns):
        values["intrinsics"] |= {f"cam{k}": bent, f"camRect{k}": optics}
        values["extrinsics"][f"R_rect{k}"] = R.T.tolist()
        if k:
            T = RigidTransform(R, [0, 0, 0]) @ RigidTransform(turns[k - 1].T, [-0.1, 0, 0])
            values["extrinsics"][f"T_{k}{k - 1}"] = np.vstack([T.matrix34, [0, 0, 0, 1]]).tolist()
    found = read_cameras(written(tmp_path, json.dumps(values), "cam_to_cam.yaml"))
    assert [camera.name for camera in found] == ["cam0", "cam1", "cam2", "cam3"]
    assert found[1].lens.coefficients == (-0.1, 0.05, 0.0, 0.001)
    np.testing.assert_allclose(rig_of(found[1], found[2])[0].baseline, 0.1)
    ideal, lenses = rig_of(*(camera.rectified for camera in found[1:3]))
    assert lenses is None
    np.testing.assert_allclose(ideal.T_right_left.matrix34[:, :3], np.eye(3), atol=1e-12)


MRPT = """# Camera calibration
[CAMERA_PARAMS_LEFT]
resolution = [1024 768]
fx = 600.1
fy = 600.2
cx = 518.5
cy = 383.5
dist = [-3.4e-01 1.2e-01 0.001 0.002 0.0] // k1 k2 t1 t2 k3

[CAMERA_PARAMS_RIGHT]
resolution = [1024 768]
fx = 601
fy = 602
cx = 519
cy = 384
dist = [0 0 0 0 0]

[CAMERA_PARAMS_LEFT2RIGHT_POSE]
pose_yaw_pitch_roll = [0.12 0 0 0 -0.5 0] // degrees
pose_quaternion = [0.12 0.001 0 0.70710678 0.70710678 0 0]
"""


def test_mrpt_states_the_pose_of_the_right_camera_in_the_left_one(tmp_path):
    left, right = read_cameras(written(tmp_path, MRPT, "camera_params.txt"))
    assert left.lens == Lens(Camera(600.1, 600.2, 518.5, 383.5, 1024, 768), "radtan", (-0.34, 0.12, 0.001, 0.002, 0.0))
    T_left_right = right.T_camera_reference.inverse()
    np.testing.assert_allclose(T_left_right.translation, [0.12, 0.001, 0.0])
    np.testing.assert_allclose(T_left_right.rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-6)
    with raises("RIL-113", "CAMERA_PARAMS_RIGHT fx"):
        read_cameras(written(tmp_path, MRPT.replace("_RIGHT]", "]"), "camera_params.txt"))


@pytest.mark.parametrize(
    ("unit", "length"), [("mm", 120.0), ("millimeters", 120.0), ("CM", 12.0), ("inch", 0.12 / 0.0254), ("m", 0.12)]
)
def test_a_stated_unit_of_length(tmp_path, unit, length):
    K = [500, 0, 320, 0, 500, 240, 0, 0, 1]
    for stated in ({"T": [-length, 0, 0], "R": np.eye(3).tolist()}, {"baseline": length}):
        text = json.dumps({"unit": unit, "K1": K, "K2": K, **stated})
        cameras = read_cameras(written(tmp_path, text, "stereo.json"))
        np.testing.assert_allclose(cameras[1].T_camera_reference.translation, [-0.12, 0, 0], atol=1e-9)
    text = f"fx: 500\nfy: 500\ncx: 320\ncy: 240\nunits: {unit}\nbaseline_mm: 120\n"
    cameras = read_cameras(written(tmp_path, text))
    np.testing.assert_allclose(cameras[1].T_camera_reference.translation, [-0.12, 0, 0], atol=1e-9)


@pytest.mark.parametrize("turn", ["rvec_deg: [0.1, 0.5, 0]", "q: [0.9999, 0.01, 0, 0]", "om: [0, 0.01, 0]"])
def test_a_turn_of_another_form_is_named(tmp_path, turn):
    text = f"K1: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nK2: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nT: [-1, 0, 0]\n{turn}\n"
    with raises("RIL-766", turn.split(":")[0]):
        read_cameras(written(tmp_path, text))


def test_matrices_in_a_part_for_each_side(tmp_path):
    one = {"camera_matrix": [[500, 0, 320], [0, 501, 240], [0, 0, 1]], "dist_coeffs": [[0.1, 0, 0, 0, 0.2]]}
    stated = {"left": one, "right": one, "R": ROTATION.tolist(), "T": SHIFT.reshape(3, 1).tolist(), "rms": 0.2}
    left, right = read_cameras(written(tmp_path, json.dumps(stated), "stereo.json"))
    assert left.lens == right.lens == Lens(Camera(500, 501, 320, 240, *UNKNOWN_SIZE), "radtan", (0.1, 0, 0, 0, 0.2))
    np.testing.assert_allclose(right.T_camera_reference.translation, SHIFT)
    stated["left"] = one | {"distortion": [1, 2, 3]}
    with raises("RIL-810", "left_distortion"):
        read_cameras(written(tmp_path, json.dumps(stated), "stereo.json"))


FIGURES = {"fx": 460.0, "fy": 461.0, "cx": 363.0, "cy": 248.0, "width": 752, "height": 480}


@pytest.mark.parametrize("ending", ["json", "yaml", "toml"])
@pytest.mark.parametrize("sides", [False, True])
def test_figures_by_key(tmp_path, ending, sides):
    one = FIGURES | {"k1": 0.1, "p2": 0.2}
    stated = {"baseline": 0.12, "left": one, "right": one | {"fx": 470.0}} if sides else one | {"baseline": 0.12}
    text = json.dumps(stated)
    if ending == "toml":
        lines = (
            {k: v for k, v in stated.items() if not isinstance(v, dict)},
            *(stated.get(s, {}) for s in ("left", "right")),
        )
        text = "\n".join(
            f"{head}\n" + "\n".join(f"{k} = {v}" for k, v in of.items())
            for head, of in zip(("#", "[left]", "[right]"), lines, strict=True)
        )
    left, right = read_cameras(written(tmp_path, text, f"own.{ending}"))
    assert left.lens == Lens(Camera(460, 461, 363, 248, 752, 480), "radtan", (0.1, 0, 0, 0.2))
    assert right.lens.camera.fx == (470 if sides else 460)
    np.testing.assert_allclose(centre(right.T_camera_reference), [0.12, 0, 0], atol=1e-12)


def test_figures_without_a_baseline_are_cameras_and_an_unread_lens_is_refused(tmp_path):
    real = {"fx": 1.0, "fy": 1.0, "ppx": 2.0, "ppy": 3.0, "model": "distortion.brown_conrady", "coeffs": [0.0] * 5}
    left, right = read_cameras(written(tmp_path, json.dumps({"left": real, "right": real})))
    assert (left.name, right.name, left.T_camera_reference) == ("left", "right", None)
    (camera,) = read_cameras(written(tmp_path, json.dumps(FIGURES), "front.yaml"))
    assert (camera.name, camera.size) == ("front", (752, 480))
    del real["model"]
    real["coeffs"] = [0.1, 0, 0, 0, 0]
    with raises("RIL-810", "left.coeffs"):
        read_cameras(written(tmp_path, json.dumps({"left": real, "right": real})))


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("distortion.brown_conrady", [0.1, 0, 0, 0, 0.2], ("radtan", (0.1, 0, 0, 0, 0.2))),
        ("RS2_DISTORTION_BROWN_CONRADY", [0.1, 0, 0, 0, 0], ("radtan", (0.1, 0, 0, 0, 0))),
        ("Inverse Brown Conrady", [0.0] * 5, ("radtan", (0,) * 5)),
        ("distortion.kannala_brandt4", [0.1, 0, 0, 0, 0], ("fisheye", (0.1, 0, 0, 0))),
        ("distortion.inverse_brown_conrady", [0.1, 0, 0, 0, 0], "RIL-120"),
        ("distortion.modified_brown_conrady", [0.1, 0, 0, 0, 0], "RIL-120"),
        ("distortion.of_tomorrow", [0.1, 0, 0, 0, 0], "RIL-120"),
    ],
)
def test_realsense_models(tmp_path, model, coefficients, expected):
    """Of ``pyrealsense2``; its inverse model takes off what OpenCV's puts on."""
    real = {"fx": 1.0, "fy": 1.0, "ppx": 2.0, "ppy": 3.0, "model": model, "coeffs": coefficients}
    path = written(tmp_path, json.dumps({"left": real, "right": real, "baseline": 0.05}))
    if isinstance(expected, str):
        with raises(expected, "left.model"):
            read_cameras(path)
    else:
        left, _ = read_cameras(path)
        assert (left.lens.model, left.lens.coefficients) == expected


ONE = {"K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "D": [0] * 5}
TWO = {f"{key}{k}": value for k in "12" for key, value in ONE.items()}
SIDED = dict.fromkeys(("left", "right"), ONE)
T44 = np.block([[ROTATION, SHIFT[:, None]], [np.zeros(3), 1.0]]).tolist()


@pytest.mark.parametrize(
    ("stated", "key"),
    [
        (TWO | {"R_l_r": ROTATION.tolist(), "T_l_r": SHIFT.tolist()}, "R_l_r"),
        (TWO | {"rot": ROTATION.tolist(), "trans": SHIFT.tolist()}, "rot"),
        (SIDED | {"right": SIDED["right"] | {"T_camera_world": T44}}, "right_T_camera_world"),
        (ONE | {"T_cw": T44}, "T_cw"),
        (TWO | {"R12": ROTATION.tolist(), "T12": SHIFT.tolist()}, "R12"),
        (TWO | {"stereo_pose": np.array(T44)[:3].tolist()}, "stereo_pose"),
        (ONE | {"rmat": ROTATION.ravel().tolist(), "baseline": 0.12}, "rmat"),
        (TWO | {"om": [0, 0.1, 0], "T": SHIFT.tolist()}, "om"),
        (TWO | {"T": SHIFT.tolist(), "rpy": [0.1, 0, 0]}, "rpy"),
        ({"calibration_parameters": ONE | {"stereo_transform": {"rotation": [0, 0.1, 0]}}}, "stereo_transform"),
    ],
)
def test_a_pose_under_another_key_is_refused_beside_matrices_too(tmp_path, stated, key):
    with raises("RIL-766", key):
        read_cameras(written(tmp_path, json.dumps(stated)))


PLACED = {"R": ROTATION.tolist(), "T": SHIFT.tolist()}


@pytest.mark.parametrize(
    "stated",
    [
        {"date": "2026-05-31", "calibration": TWO | PLACED},
        SIDED | {"extrinsics": PLACED},
        {"left_camera": ONE, "right_camera": ONE, "stereo": PLACED | {"rms": 0.2}},
    ],
)
def test_a_stereo_calibration_in_parts(tmp_path, stated):
    left, right = read_cameras(written(tmp_path, json.dumps(stated)))
    assert left.lens.camera.fx == 500
    np.testing.assert_allclose(right.T_camera_reference.rotation, ROTATION, atol=1e-12)
    np.testing.assert_allclose(right.T_camera_reference.translation, SHIFT)


@pytest.mark.parametrize("key", ["xi1", "xi_left", "left_xi", "xiL"])
def test_a_mirror_of_one_side_is_no_perspective_lens(tmp_path, key):
    with raises("RIL-810", key):
        read_cameras(written(tmp_path, json.dumps(TWO | PLACED | {key: [[1.2]]})))


@pytest.mark.parametrize("key", ["IMU.T_b_c1", "Tbc", "cam_to_velodyne"])
def test_a_pose_among_other_sensors_is_no_pose_of_two_cameras(tmp_path, key):
    assert len(read_cameras(written(tmp_path, json.dumps(ONE | {key: T44})))) == 1


def test_rotations_of_rectification_state_the_pose_where_nothing_else_does(tmp_path):
    P = [[500, 0, 320, 0], [0, 500, 240, 0], [0, 0, 1, 0]]
    turned = [ROTATION.tolist(), np.eye(3).tolist()]
    rectified = {"R1": turned[0], "P1": P, "R2": turned[1], "P2": [[500, 0, 320, -60], *P[1:]]}
    left, right = read_cameras(written(tmp_path, json.dumps(TWO | rectified)))
    T = right.T_camera_reference @ left.T_camera_reference.inverse()
    np.testing.assert_allclose(T.matrix34, np.column_stack([ROTATION, [-0.12, 0, 0]]), atol=1e-12)


@pytest.mark.parametrize("cameras", [ONE, TWO, FIGURES])
@pytest.mark.parametrize(("key", "value"), [("baseline", 0.12), ("baseline_mm", 120), ("Baseline [cm]", 12)])
def test_a_baseline_beside_cameras_makes_them_parallel(tmp_path, cameras, key, value):
    left, right = read_cameras(written(tmp_path, json.dumps(cameras | {key: value}), "rig.json"))
    np.testing.assert_allclose(centre(right.T_camera_reference), [0.12, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(left.T_camera_reference.matrix34, np.eye(3, 4))
    if cameras is ONE:  # a file for each camera
        assert len(read_cameras(written(tmp_path, json.dumps(cameras | {key: value}), "left.json"))) == 1


def test_a_text_that_is_no_yaml_is_answered_with_what_is_read(tmp_path):
    with raises("RIL-100", "MATLAB", "angle of view"):
        read_cameras(written(tmp_path, "% Calib_Results_stereo.m\nfc_left = [ 700 ; 700 ];\n", "calib.m"))


def test_views_of_a_chessboard_are_no_pose_of_the_camera(tmp_path):
    views = {"rotation_vectors": [[0.1, 0.2, 0.3]] * 9, "rotation": 0}
    (camera,) = read_cameras(written(tmp_path, json.dumps(ONE | views)))
    assert camera.T_camera_reference is None


@pytest.mark.parametrize("cameras", [TWO, SIDED, {"left": FIGURES, "right": FIGURES}])
@pytest.mark.parametrize("rows", [3, 4])
def test_the_pose_may_have_the_manifests_name(tmp_path, cameras, rows):
    _, right = read_cameras(written(tmp_path, json.dumps(cameras | {"T_right_left": T44[:rows]})))
    np.testing.assert_allclose(right.T_camera_reference.matrix34, T44[:3], atol=1e-12)


@pytest.mark.parametrize("names", [("left", "right"), ("left_intrinsics", "right_intrinsics")])
def test_a_realsense_lists_its_rotation_by_columns(tmp_path, names):
    """``rs2_extrinsics``: column-major 3 x 3 rotation matrix."""
    real = {"fx": 1.0, "fy": 1.0, "ppx": 2.0, "ppy": 3.0, "model": "distortion.brown_conrady", "coeffs": [0.0] * 5}
    placed = {"rotation": ROTATION.T.ravel().tolist(), "translation": SHIFT.tolist()}
    text = json.dumps(dict.fromkeys(names, real) | {"extrinsics": placed})
    _, right = read_cameras(written(tmp_path, text))
    np.testing.assert_allclose(right.T_camera_reference.rotation, ROTATION, atol=1e-12)


MRCAL = """# generated by mrcal-calibrate-cameras
{{
    'lensmodel':  '{model}',
    # intrinsics are fx,fy,cx,cy,distortion0,...
    'intrinsics': [ 460., 461., 363., 248.,0.1,-0.2,0.,0.,0.,0.,0.,0.,],
    'valid_intrinsics_region': [ [ 1, 2 ], [ 3, 4 ] ],
    'extrinsics': [ 0,0,0.5, -0.12,0,0,],
    'imagersize': [ 752,480,],
    'optimization_inputs': b'y#{{,:',
}}
"""


def test_mrcal(tmp_path):
    (camera,) = read_cameras(written(tmp_path, MRCAL.format(model="LENSMODEL_OPENCV8"), "camera-1.cameramodel"))
    coefficients = (0.1, -0.2, 0, 0, 0, 0, 0, 0)
    assert camera.name == "camera-1"
    assert camera.lens == Lens(Camera(460, 461, 363, 248, 752, 480), "rational", coefficients)
    c, s = math.cos(0.5), math.sin(0.5)
    expected = [[c, -s, 0, -0.12], [s, c, 0, 0], [0, 0, 1, 0]]
    np.testing.assert_allclose(camera.T_camera_reference.matrix34, expected, atol=1e-12)
    with raises("RIL-769", "LENSMODEL_CAHVORE", "mrcal-convert-lensmodel"):
        read_cameras(written(tmp_path, MRCAL.format(model="LENSMODEL_CAHVORE"), "camera-0.cameramodel"))


def test_figures_in_parts_of_an_ini_file(tmp_path):
    text = "[camera]\nfx = 460\nfy = 461\ncx = 363\ncy = 248\n[stereo]\nbaseline = 0.12\n"
    _, right = read_cameras(written(tmp_path, text, "camera.ini"))
    np.testing.assert_allclose(centre(right.T_camera_reference), [0.12, 0, 0], atol=1e-12)


@pytest.mark.parametrize("placed", [{"R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "T": [-0.12, 0, 0]}, {"baseline": 0.12}])
@pytest.mark.parametrize("group", [False, True])
def test_figures_with_a_pose(tmp_path, placed, group):
    camera = {"fx": 460.0, "fy": 461.0, "u0": 363.0, "v0": 248.0}  # Cityscapes' camera.json has both groups
    stated = {"extrinsic": placed | {"yaw": 0.02}, "intrinsic": camera} if group else camera | placed
    rig, _ = rig_of(*read_cameras(written(tmp_path, json.dumps(stated), "camera.json")), ((752, 480), (752, 480)))
    assert (rig.left.cx, rig.right.fy, rig.baseline) == (363.0, 461.0, 0.12)
    np.testing.assert_allclose(rig.T_right_left.rotation, placed.get("R", np.eye(3)))


@pytest.mark.parametrize("turned", [{"rvec": [0, 0.1, 0]}, {"toe_in_deg": 3}, {"extrinsics": [0, 0.1, 0]}])
def test_a_rotation_that_is_not_read_is_refused(tmp_path, turned):
    with raises("RIL-766", *turned):
        read_cameras(written(tmp_path, json.dumps(FIGURES | {"baseline": 0.12} | turned)))
    with raises("RIL-116", "rotation"):
        read_cameras(written(tmp_path, json.dumps(FIGURES | {"rotation": [0, 0.1, 0], "translation": [-0.12, 0, 0]})))


@pytest.mark.parametrize(
    ("kind", "model", "k1", "lens"),
    [("Infrared", "Brown Conrady", 0, False), ("Fisheye", "Kannala Brandt4", -0.005, "fisheye")],
)
def test_a_realsense(tmp_path, kind, model, k1, lens):
    def camera(number, width, height):
        figures = f"PPX: \t{width / 2}\n  PPY: \t{height / 2}\n  Fx: \t{width / 2}\n  Fy: \t{width / 2}"
        lens = f"Distortion: \t{model}\n  Coeffs: \t{k1}  \t0  \t0  \t0  \t0  \n  FOV (deg): \t89.9 x 58.9"
        head = f'Intrinsic of "{kind} {number}" / {width}x{height} / {{Y8}}'
        return f" {head}\n  Width: \t{width}\n  Height: \t{height}\n  {figures}\n  {lens}\n\n"

    text = "Device info:\n    Name : \tIntel RealSense D435I\n\nIntrinsic Parameters:\n\n"
    text += "".join(camera(n, *size) for n in (1, 2) for size in ((848, 480), (640, 480), (640, 480)))
    for name, first in (("Depth", -0.015), (f"{kind} 2", -0.0499)):
        text += f'Extrinsic from "{kind} 1"\t  To\t  "{name}" :\n Rotation Matrix:\n'
        text += f"   1   0   0   \n   0   1   0   \n   0   0   1   \n\n Translation Vector: {first}  0  0  \n\n"
    cameras = read_cameras(written(tmp_path, text, "realsense.txt"))
    assert [(c.name, c.size) for c in cameras] == [
        (f"{kind} {n}", size) for n in (1, 2) for size in ((848, 480), (640, 480))
    ]
    rig, _ = rig_of(cameras[1], cameras[3])
    assert rig.baseline == 0.0499
    assert {not camera.lens.ideal and camera.lens.model for camera in cameras} == {lens}
    assert cameras[1].lens.camera == Camera(320, 320, 320, 240, 640, 480)


def test_both_cameras_as_camera_calibrator_prints_them(tmp_path):
    def camera(side, shift):
        k, p = (
            "481.2 0.0 320.5\n0.0 481.1 240.5\n0.0 0.0 1.0",
            f"460.0 0.0 320.5 {shift}\n0.0 460.0 240.5 0.0\n0.0 0.0 1.0 0.0",
        )
        head = f"# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n[narrow_stereo/{side}]\n\n"
        matrices = (
            f"camera matrix\n{k}\n\ndistortion\n0.1 -0.3 -0.001 0.0 0.0\n\nrectification\n1 0 0\n0 1 0\n0 0 1\n\n"
        )
        return f"{head}{matrices}projection\n{p}\n\n"

    cameras = read_cameras(written(tmp_path, camera("left", 0.0) + camera("right", -46.0), "ost.txt"))
    assert [(c.name, c.size) for c in cameras] == [(f"narrow_stereo/{side}", (640, 480)) for side in ("left", "right")]
    assert cameras[0].lens == Lens(Camera(481.2, 481.1, 320.5, 240.5, 640, 480), "radtan", (0.1, -0.3, -0.001, 0, 0))
    np.testing.assert_allclose(centre(cameras[1].T_camera_reference), [0.1, 0, 0])
    with raises("RIL-113", "image_height is missing"):
        read_cameras(written(tmp_path, "[image]\n\nwidth\n640\n\n[left]\ncamera matrix\n1 0 2\n"))


def test_labels_of_drivingstereo(tmp_path):
    rows = {"K_101": "1 0 9 0 1 5 0 0 1", "D_101": "-0.1 0.1 0 0 0", "S_rect_101": "1762 800"}
    rows |= {f"P_rect_{n}": f"2063 0 978 {t} 0 2063 544 0 0 0 1 0" for n, t in ((101, 0), (103, -1031.5))}
    left, right = read_cameras(written(tmp_path, "".join(f"{k}: {v}\n" for k, v in rows.items()), "calib.txt"))
    assert (left.name, left.size, right.name) == ("P_rect_101", (1762, 800), "P_rect_103")
    np.testing.assert_allclose(centre(right.T_camera_reference), [0.5, 0, 0])


def test_an_ini_file_is_no_camera(tmp_path):
    with raises("RIL-100"):
        read_cameras(written(tmp_path, "# of a program\n\n[image]\n\nwidth\n640\n"))


@pytest.mark.parametrize("bf", [226.746, -226.746])
def test_orbslam2_baseline_times_fx_of_either_sign(tmp_path, bf):
    text = f"{ORB}Camera.width: 1280\nCamera.height: 960\nCamera.k1: 0.0\nCamera.bf: {bf} #969.0 * 0.234\n"
    rig, lenses = rig_of(*read_cameras(written(tmp_path, text)))
    np.testing.assert_allclose(rig.T_right_left.translation, [-0.234, 0, 0])
    assert rig.left == rig.right == Camera(969, 970, 635.1, 463.5, 1280, 960)
    assert lenses is None


@pytest.mark.parametrize("nested", [False, True])
def test_stella_vslam_has_the_same_under_other_names(tmp_path, nested):
    stated = {"fx": 969, "fy": 970, "cx": 635.1, "cy": 463.5, "k1": 0.0, "cols": 1280, "rows": 960}
    stated["focal_x_baseline"] = 226.746
    text = json.dumps({"Camera": stated} if nested else {f"Camera.{key}": value for key, value in stated.items()})
    rig, _ = rig_of(*read_cameras(written(tmp_path, text)))
    np.testing.assert_allclose(rig.T_right_left.translation, [-0.234, 0, 0])
    assert rig.left == Camera(969, 970, 635.1, 463.5, 1280, 960)


def test_orbslam2_of_one_camera(tmp_path):
    (camera,) = read_cameras(written(tmp_path, f"{ORB}Camera.k1: 0.1\nCamera.k3: 0.2\n", "mono.yaml"))
    assert camera.lens == Lens(Camera(969, 970, 635.1, 463.5, *UNKNOWN_SIZE), "radtan", (0.1, 0, 0, 0, 0.2))


def test_orbslam3_pair_of_fisheyes(tmp_path):
    text = "%YAML:1.0\nCamera.type: KannalaBrandt8\nCamera.width: 512\nCamera.height: 512\n"
    for n in (1, 2):
        for key, value in zip(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), range(8), strict=True):
            text += f"Camera{n}.{key}: {190 + n + value if value < 4 else value / 1000}\n"
    T_left_right = np.vstack([RigidTransform(ROTATION, [0.1, 0, 0]).matrix34, [0, 0, 0, 1]])
    text += f"Stereo.T_c1_c2: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n  data: {numbers(T_left_right)}\n"
    left, right = read_cameras(written(tmp_path, text))
    assert left.lens.model == right.lens.model == "fisheye"
    assert right.lens.coefficients == (0.004, 0.005, 0.006, 0.007)
    np.testing.assert_allclose(centre(right.T_camera_reference), [0.1, 0, 0], atol=1e-12)


BOOF = """# Intrinsic and extrinsic parameters for a stereo camera pair
left:
  pinhole: {fx: 524.6, fy: 526.9, cx: 312.4, cy: 247.4, width: 640, height: 480, skew: 0.0}
  model: pinhole_radial_tangential
  radial_tangential: {radial: [-0.36, 0.17], t1: 0.001, t2: 0.002}
model: stereo_camera
rightToLeft:
  rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1]
  x: 120.0
  y: 0.5
  z: -0.25
right:
  pinhole: {fx: 524.6, fy: 526.9, cx: 312.4, cy: 247.4, width: 640, height: 480, skew: 0.0}
  model: pinhole_radial_tangential
  radial_tangential: {radial: [-0.36, 0.17], t1: 0.001, t2: 0.002}
"""


@pytest.mark.parametrize(
    ("radial", "kept"), [("[]", (0, 0)), ("[-0.3]", (-0.3, 0)), ("[-0.3, 0.1, 0.02]", (-0.3, 0.1))]
)
def test_boofcv_has_up_to_three_radial_terms(tmp_path, radial, kept):
    left, _ = read_cameras(written(tmp_path, BOOF.replace("[-0.36, 0.17]", radial)))
    assert left.lens.coefficients == (*kept, 0.001, 0.002, *((0.02,) if "0.02" in radial else ()))
    with raises("RIL-370", "radial", "6 coefficients"):
        read_cameras(written(tmp_path, BOOF.replace("[-0.36, 0.17]", "[-0.3, 0.1, 0.02, 0.3]")))


def test_boofcv_right_to_left(tmp_path):
    """Its coordinates begin at the corner of the first pixel."""
    left, right = read_cameras(written(tmp_path, BOOF))
    assert left.lens == Lens(Camera(524.6, 526.9, 311.9, 246.9, 640, 480), "radtan", (-0.36, 0.17, 0.001, 0.002))
    np.testing.assert_allclose(centre(right.T_camera_reference), [120, 0.5, -0.25])


# -- Ames Stereo Pipeline, COLMAP, Middlebury --------------------------------------------------------------------------

TSAI = """fu = 620.0
fv = 622.0
cu = 526.0
cv = 374.0
u_direction = {u}
v_direction = {v}
w_direction = 0 0 1
C = 1 2 3
R = 0 0 1 -1 0 0 0 -1 0
"""
BENT = "k1 = -0.33\nk2 = 0.12\np1 = -0.0004\np2 = 0.0011\n"
STRAIGHT = TSAI.format(u="1 0 0", v="0 1 0")


def test_tsai_rotates_from_the_camera_to_the_world(tmp_path):
    (camera,) = read_cameras(written(tmp_path, STRAIGHT + BENT, "black_left.tsai"))
    assert camera.name == "black_left"
    assert camera.lens == Lens(Camera(620, 622, 526, 374, *UNKNOWN_SIZE), "radtan", (-0.33, 0.12, -0.0004, 0.0011))
    # Columns of R are the camera's axes in the world: depth is world x, and columns run along -y.
    np.testing.assert_allclose(camera.T_camera_reference.apply([1 + 5.0, 2 - 0.5, 3]), [0.5, 0, 5], atol=1e-12)
    assert camera.size is None


def test_tsai_in_millimetres(tmp_path):
    text = "VERSION_4\nPINHOLE\n" + STRAIGHT.replace("620.0", "6.2").replace("622.0", "6.22")
    text = text.replace("526.0", "5.26").replace("374.0", "3.74") + "pitch = 0.01\nTSAI\n" + BENT + "k3 = 0.01\n"
    (camera,) = read_cameras(written(tmp_path, text, "a.tsai"))
    np.testing.assert_allclose(
        [camera.lens.camera.fx, camera.lens.camera.fy, camera.lens.camera.cx, camera.lens.camera.cy],
        [620, 622, 526, 374],
    )
    # Distortion is of normalised coordinates: it has no unit.
    assert camera.lens.coefficients == (-0.33, 0.12, -0.0004, 0.0011, 0.01)


def test_tsai_directions_turn_the_camera(tmp_path):
    (turned,) = read_cameras(written(tmp_path, TSAI.format(u="0 1 0", v="-1 0 0") + "NULL\n", "a.tsai"))
    (plain,) = read_cameras(written(tmp_path, STRAIGHT + "NULL\n", "b.tsai"))
    assert turned.lens.model == "none"
    x, y, z = plain.T_camera_reference.apply([4.0, 1.0, 3.5])
    np.testing.assert_allclose(turned.T_camera_reference.apply([4.0, 1.0, 3.5]), [y, -x, z], atol=1e-12)
    with raises("RIL-147"):
        read_cameras(written(tmp_path, TSAI.format(u="-1 0 0", v="0 1 0") + "NULL\n", "c.tsai"))


def test_tsai_fisheye_and_what_is_not_read(tmp_path):
    text = "VERSION_4\nPINHOLE\n" + STRAIGHT + "pitch = 1\n"
    (camera,) = read_cameras(written(tmp_path, text + "FISHEYE\nk1 = -0.036\nk2 = 0.038\nk3 = -0.058\nk4 = 0.029\n"))
    assert (camera.lens.model, camera.lens.coefficients) == ("fisheye", (-0.036, 0.038, -0.058, 0.029))
    with raises("RIL-148"):
        read_cameras(written(tmp_path, text + "Photometrix\nxp = 0\nk1 = 1\n"))


def test_colmap_with_a_rig(tmp_path):
    text = "# Camera list\n1 OPENCV 640 480 500 501 320.5 240.5 -0.1 0.01 0.001 0.002\n"
    text += "2 SIMPLE_RADIAL 640 480 400 320 240 0.1\n"
    path = written(tmp_path, text, "cameras.txt")
    assert [c.T_camera_reference for c in read_cameras(path)] == [None, None]
    # Half a turn about z, so that a wrong order of the quaternion shows.
    written(tmp_path, "# Rig\n1 2 CAMERA 1 CAMERA 2 1 0 0 0 1 -0.1 0.2 0.3\n", "rigs.txt")
    left, right = read_cameras(path)
    # Its pixel corner is at 0, ours at -0.5.
    assert left.lens == Lens(Camera(500, 501, 320, 240, *SIZE), "radtan", (-0.1, 0.01, 0.001, 0.002))
    assert right.lens == Lens(Camera(400, 400, 319.5, 239.5, *SIZE), "radtan", (0.1, 0, 0, 0))
    np.testing.assert_allclose(right.T_camera_reference.rotation, np.diag([-1, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(right.T_camera_reference.translation, [-0.1, 0.2, 0.3])


def test_middlebury_is_in_millimetres(tmp_path):
    text = "cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]\ncam1=[994.978 0 342.279; 0 994.978 254.877; 0 0 1]\n"
    rig, lenses = rig_of(
        *read_cameras(written(tmp_path, f"{text}doffs=31.086\nbaseline=193.001\nwidth=741\nheight=500\n"))
    )
    assert rig.baseline == pytest.approx(0.193001)
    assert rig.right.cx - rig.left.cx == pytest.approx(31.086)
    assert lenses is None


# -- what is wrong with a file -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            SENSOR.format(y=0).replace(", 1.76187114e-05]", "]"),
            ("RIL-370", "distortion_coefficients"),
        ),
        (
            SENSOR.format(y=0).replace("radial-tangential", "scaramuzza"),
            ("RIL-120", "'scaramuzza'"),
        ),
        (
            SENSOR.format(y=0).replace("camera_model: pinhole", "camera_model: omni"),
            ("RIL-135", "'omni'"),
        ),
        (SENSOR.format(y=0).replace("458.654", "wide"), ("RIL-121", "'wide'")),
        (SENSOR.format(y=0).replace("458.654", "1e308"), ("RIL-121", "'1e308'")),
        (SENSOR.format(y=0).replace("458.654", "-458"), ("RIL-329",)),
        (SENSOR.format(y=0).replace("458.654, ", ""), ("RIL-116",)),
        (SENSOR.format(y=0).replace("[752, 480]", "[752.5, 480]"), ("RIL-122", "752.5")),
        (SENSOR.format(y=0).replace("data: [0.0, -1.0", "data: [0.0, -2.0"), ("RIL-333",)),
        (SENSOR.format(y=0).replace("rows: 4", "rows: 3"), ("RIL-115", "T_BS")),
        (SENSOR.format(y=0) + "broken: [1, 2\n", ("RIL-141",)),
        (KALIBR.replace("intrinsics: [190.4, 190.3, 252.5, 254.9]", ""), ("RIL-113", "cam1.intrinsics")),
        (KALIBR.replace("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 1.0, 1.0]"), ("RIL-118", "cam1.T_cn_cnm1")),
        (ORB.replace("Camera.cy: 463.5\n", ""), ("RIL-113", "Camera.cy")),
        (BOOF.replace("skew: 0.0", "skew: 3.0"), ("RIL-104", "left.pinhole.skew")),
        (BOOF.replace("  z: -0.25\n", ""), ("RIL-113", "rightToLeft.z")),
        (STRAIGHT + "k1 = 1\n", ("RIL-113",)),
        (STRAIGHT + "lens_model = fisheye\n", ("RIL-810", "lens_model")),
        (STRAIGHT.replace("C = 1 2 3", "C = 1 2"), ("RIL-116",)),
        (STRAIGHT + "pitch = 0\n" + BENT, ("RIL-146",)),
        ("P0: 500 0 320 0\nP1: 500 0 320 -60\n", ("RIL-116", "P0")),
        ("1 OPENCV 640 480 500 501 320 240\n", ("RIL-109",)),
        ("1 THIN_PRISM 640 480 500\n", ("RIL-108", "THIN_PRISM")),
        (MONO.format(count=4, values="[0, 0, 0, .nan]"), ("RIL-121", "distortion_coefficients")),
        (MONO.format(count=6, values=[0.1] * 6), ("RIL-370", "distortion_coefficients")),
        (MONO.format(count=4, values=[0.1] * 4).replace("[ 5.e+02, 0.,", "[ 5.e+02, 3.,"), ("RIL-119", "without skew")),
        (
            MONO.format(count=4, values=[0.1] * 4).replace(
                "0., 3.2e+02, 0., 5.01e+02, 2.4e+02, 0., 0.", "0., 0., 0., 5.01e+02, 0., 320, 240"
            ),
            ("RIL-119", "transpose it"),
        ),
        (MONO.format(count=4, values=[0.1] * 4).replace("image_height: 480\n", ""), ("RIL-113", "image_height")),
        (CAMODOCAL.format(kind="MEI", mirror="mirror_parameters: {xi: 1.9}\n", projection=USUAL), ("RIL-814", "MEI")),
        (CAMODOCAL.format(kind="SCARAMUZZA", mirror="", projection=USUAL), ("RIL-814", "SCARAMUZZA")),
        ("sensor_type: imu\nrate_hz: 200\n", ("RIL-100",)),
        ('{"CameraParameters1":{"RadialDistortion":[0,0]},"TranslationOfCamera2":[-97,0,0]}', ("RIL-727", "MATLAB")),
        ("<?xml version='1.0'?><calibration>\n <projection>frame</projection></calibration>", ("RIL-100", "OpenCV")),
        ("", ("RIL-100",)),
        ("just words\n", ("RIL-100",)),
        ("<?xml version='1.0'?>\n<opencv_storage><imagelist>\"a.jpg\"</imagelist></opencv_storage>", ("RIL-100",)),
        ("<opencv_storage><M1>", ("RIL-143",)),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', ("RIL-142",)),
    ],
)
def test_one_line_that_names_file_and_key(tmp_path, text, expected):
    path = written(tmp_path, text)
    with raises(*expected) as error:
        read_cameras(path)
    assert str(error.value).count(str(path)) == 1
    assert "\n" not in str(error.value)
    assert error.value.remedy


# -- as cameras come with them -----------------------------------------------------------------------------------------


def test_calibrations_of_4seasons(tmp_path):
    text = "{} 501.47 501.48 421.79 167.65 {}\n800 400\ncrop\n800 400\n"
    pose = np.eye(4)
    pose[0, 3] = -0.3005
    (tmp_path / "undistorted_calib_stereo.txt").write_text("\n".join(" ".join(map(str, row)) for row in pose))
    left, right = (
        read_cameras(written(tmp_path, text.format("Pinhole", "0.0 0.0 0.0 0.0"), f"undistorted_calib_{k}.txt"))[0]
        for k in (0, 1)
    )
    assert left.lens == Lens(Camera(501.47, 501.48, 421.79, 167.65, 800, 400))
    np.testing.assert_allclose(centre(relative_pose(left, right)), [0.3005, 0, 0], atol=1e-12)
    (bent,) = read_cameras(written(tmp_path, text.format("EquiDistant", "-0.01 0.02 0.003 0.0004"), "calib_0.txt"))
    assert (bent.lens.model, bent.lens.coefficients) == ("fisheye", (-0.01, 0.02, 0.003, 0.0004))
    assert bent.T_camera_reference is None
    with raises("RIL-370", "calib_1.txt: distortion_coeffs"):
        read_cameras(written(tmp_path, text.format("Pinhole", "0.93"), "calib_1.txt"))


def test_openloris_lists_columns_before_rows(tmp_path):
    part = "{}:\n  sensor_type: camera\n  width: 848\n  height: 480\n  model: pinhole\n"
    part += (
        "  intrinsics: !!opencv-matrix\n    rows: 1\n    cols: 4\n    dt: d\n    data: [611.4, 433.2, 611.5, 249.5]\n"
    )
    names = "d400_color_optical_frame", "d400_depth_optical_frame"
    cameras = read_cameras(written(tmp_path, "%YAML:1.0\n" + "".join(map(part.format, names)), "sensors.yaml"))
    assert [camera.lens.camera for camera in cameras] == [Camera(611.4, 611.5, 433.2, 249.5, 848, 480)] * 2


ZED = """[LEFT_CAM_{0}]
fx={f}
fy={f}
cx=640
cy=360
k1=-0.17
k2=0.02
p1=0.001
p2=0.002
k3=0.003

[RIGHT_CAM_{0}]
fx={f}
fy={f}
cx=641
cy=361
{right}

"""
ZED_STEREO = "[STEREO]\nBaseline=120.5\nTY=0.1\nTZ=-0.2\nCV_HD=0.003\nRX_HD=0.001\nRZ_HD=-0.002\nCV_2K=0.004\n"


def test_zed(tmp_path):
    """All resolutions; lengths are millimetres; the rotation vector is RX, CV, RZ of each."""
    text = ZED.format("2K", f=1400, right="") + ZED.format("HD", f=700, right="") + ZED_STEREO
    text += "[RIGHT_DISTO]\nk4=0.1\np1=0\n"
    cameras = read_cameras(written(tmp_path, text, "SN1.conf"))
    assert [c.name for c in cameras] == ["left 2K", "right 2K", "left HD", "right HD"]
    assert [c.size for c in cameras] == [(2208, 1242)] * 2 + [(1280, 720)] * 2
    left, right = cameras[2:]
    assert left.lens.coefficients == (-0.17, 0.02, 0.001, 0.002, 0.003, 0, 0, 0)
    assert right.lens.coefficients == (0, 0, 0, 0, 0, 0.1, 0, 0)
    T = rig_of(left, right)[0].T_right_left
    np.testing.assert_allclose(T.rotation, rotation_exp([0.001, 0.003, -0.002]), atol=1e-12)
    np.testing.assert_allclose(T.translation, [-0.1205, 1e-4, -2e-4])
    np.testing.assert_allclose(cameras[1].T_camera_reference.rotation, rotation_exp([0, 0.004, 0]), atol=1e-12)


def test_zed_of_one_resolution_is_that_of_the_images(tmp_path):
    text = ZED.format("HD", f=700, right="k1=1\nk2=2\nk3=3\nk4=4") + ZED_STEREO
    left, right = read_cameras(written(tmp_path, text, "a.conf"))
    assert left.size is None
    assert (right.lens.model, right.lens.coefficients) == ("fisheye", (1, 2, 3, 4))
    with raises("RIL-113", "Baseline".lower()):
        read_cameras(written(tmp_path, ZED.format("HD", f=700, right=""), "b.conf"))


def oak(socket, to, shift, kind=0, coefficients=(0.0,) * 14):
    return [
        socket,
        {
            "cameraType": kind,
            "distortionCoeff": list(coefficients),
            "extrinsics": {
                "rotationMatrix": np.eye(3).tolist(),
                "translation": dict(zip("xyz", shift, strict=True)),
                "specTranslation": {"x": 0, "y": 0, "z": 0},
                "toCameraSocket": to,
            },
            "height": 800,
            "intrinsicMatrix": [[790.0, 0, 640], [0, 790.0, 400], [0, 0, 1]],
            "lensPosition": 130,
            "width": 1280,
        },
    ]


def test_depthai(tmp_path):
    """Centimetres along the chain of sockets; which of them are left and right, the file says."""
    bent = tuple(0.01 * k for k in range(1, 15))
    rows = [oak(0, -1, (0, 0, 0)), oak(4, 0, (-3.75, 0, 0), coefficients=bent), oak(7, 4, (7.5, 0.1, 0), kind=1)]
    text = {"cameraData": rows, "stereoRectificationData": {"leftCameraSocket": 4, "rightCameraSocket": 7}}
    rows[2][1]["distortionCoeff"][:4] = [0.1, 0.2, 0.3, 0.4]
    left, right = read_cameras(written(tmp_path, json.dumps(text, indent="\t"), "oak.json"))
    assert (left.lens.model, left.lens.coefficients, left.size) == ("rational", bent, (1280, 800))
    assert (right.lens.model, right.lens.coefficients) == ("fisheye", (0.1, 0.2, 0.3, 0.4))
    np.testing.assert_allclose(rig_of(left, right)[0].T_right_left.translation, [-0.075, -0.001, 0], atol=1e-12)
    rows[1][1]["extrinsics"]["toCameraSocket"] = -1
    rows[2][1]["extrinsics"]["toCameraSocket"] = 0
    assert read_cameras(written(tmp_path, json.dumps(text), "oak.json"))[1].T_camera_reference is None
    with raises("RIL-113", "cameraData 7"):
        read_cameras(written(tmp_path, json.dumps(text | {"cameraData": rows[:2]}), "oak.json"))


@pytest.mark.parametrize("sockets", [(0, 1, 2), ("CAM_A", "CAM_B", "CAM_C")])
@pytest.mark.parametrize("more", [{}, {"stereoRectificationData": {"leftCameraSocket": -1, "rightCameraSocket": -1}}])
def test_depthai_without_stereo_data(tmp_path, sockets, more):
    """As of boards for cameras of one's own: colour at A, left at B, right at C."""
    a, b, c = sockets
    text = {"cameraData": [oak(a, -1, (0, 0, 0)), oak(b, c, (-7.5, 0, 0)), oak(c, a, (3.75, 0, 0))], **more}
    left, right = read_cameras(written(tmp_path, json.dumps(text), "oak.json"))
    np.testing.assert_allclose(rig_of(left, right)[0].T_right_left.translation, [-0.075, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "754.7 0.0 489.4 0.0 755.1 265.2 0.0 0.0 1.0\n{}\n",
        "[[754.7, 0, 489.4],\n[0, 755.1, 265.2],\n[0, 0, 1]]\n{}",
        "7.547e+02 0.0e+00 4.894e+02\n0.0e+00 7.551e+02 2.652e+02\n0.0e+00 0.0e+00 1.0e+00\n{}\n",
    ],
)
def test_matrix_and_baseline(tmp_path, text):
    left, right = read_cameras(written(tmp_path, text.format("0.063"), "K.txt"))
    assert left.lens == Lens(Camera(754.7, 755.1, 489.4, 265.2, *UNKNOWN_SIZE))
    np.testing.assert_allclose(right.T_camera_reference.translation, [-0.063, 0, 0])
    assert len(read_cameras(written(tmp_path, text.format(""), "K.txt"))) == 1


def test_a_rotation_alone_is_no_camera(tmp_path):
    with raises("RIL-100"):
        read_cameras(written(tmp_path, "1 0 0 0 1 0 0 0 1\n", "R.txt"))


@pytest.mark.parametrize(
    "text",
    [
        "P0: 707,0912 0 601,8873 0 0 707,0912 183,1104 0 0 0 1 0\nP1: 7,0 0 6,0 -3,8 0 7,0 1,8 0 0 0 1 0\n",
        PINHOLE.replace("500, 0, 320, 0, 501, 240", "500,5, 0, 320,5, 0, 501,5, 240,5"),
        ORB.replace(".", ",").replace("Camera,", "Camera.").replace("YAML:1,0", "YAML:1.0"),
        ZED.format("HD", f="700,25", right="") + ZED_STEREO,
        "754,7 0,0 489,4 0,0 755,1 265,2 0,0 0,0 1,0\n0,063\n",
    ],
)
def test_decimal_commas_are_called_so(tmp_path, text):
    with raises("RIL-813", "decimal commas"):
        read_cameras(written(tmp_path, text))


PROJECTION = "7e2 0 31.5 {} 0 7e2 23.5 0 0 0 1 0"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("T: [-0.5, 0, 0]\nM1: 3\n", "T: [-0.4, 0, 0]\n"),
        (f"P0: {PROJECTION.format(0)}\nP1: {PROJECTION.format(-350)}\n", f"P1: {PROJECTION.format(-280)}\n"),
        ("fu = 3\nfv = 3\n", "fu = 4\n"),
        ("cam0=[3 0 1; 0 3 1; 0 0 1]\nbaseline=100\n", "baseline=120\n"),
        ("[LEFT_CAM_HD]\nfx=3\n", "fx=4\n"),
        ("<opencv_storage><M1>3</M1>", "<M1>4</M1></opencv_storage>"),
        ('{"cameraData": 3', ', "cameraData": 4}'),
    ],
)
def test_a_key_with_two_values_is_refused(tmp_path, first, second):
    with raises("RIL-141" if first.startswith(("T:", "{")) else "RIL-126", "twice"):
        read_cameras(written(tmp_path, first + second))


def test_a_key_that_says_the_same_twice_and_lists_are_fine(tmp_path):
    path = written(tmp_path, "<opencv_storage><a>1</a><a>1</a><b><_>1</_><_>2</_></b></opencv_storage>")
    with raises("RIL-100"):
        read_cameras(path)


@pytest.mark.parametrize(
    "text", [PINHOLE, ORB, "P0: 707 0 601 0 0 707 183 0 0 0 1 0\nP1: 707 0 601 -380 0 707 183 0 0 0 1 0\n"]
)
def test_encodings_line_ends_and_remarks_do_not_matter(tmp_path, text):
    known = [camera.lens for camera in read_cameras(written(tmp_path, text))]
    head, remark = ("", "") if text.startswith("%") else ("# left and right\n", "# end\n")
    for data in (text.encode("utf-16"), text.replace("\n", "\r").encode(), (head + text + remark).encode("utf-8-sig")):
        path = tmp_path / "calibration.yaml"
        path.write_bytes(data)
        assert [camera.lens for camera in read_cameras(path)] == known


def test_files_that_are_no_text(tmp_path):
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with raises("RIL-140"):
        read_cameras(tmp_path / "a.png")
    np.savez(tmp_path / "stereo.npz", K1=np.eye(3))
    with raises("RIL-140", "cv2.FileStorage"):
        read_cameras(tmp_path / "stereo.npz")
    with raises("RIL-138"):
        read_cameras(tmp_path / "absent.yaml")
    with raises("RIL-138"):
        read_cameras(tmp_path)
    (tmp_path / "large.yaml").write_bytes(b"#" * 5_000_000)
    with raises("RIL-139"):
        read_cameras(tmp_path / "large.yaml")


# -- the rig -----------------------------------------------------------------------------------------------------------


def camera(x, size=SIZE, coefficients=(), name="one"):
    lens = Lens(Camera(500, 500, 320, 240, *size), "radtan" if coefficients else "none", coefficients)
    pose = None if x is None else RigidTransform(np.eye(3), [-x, 0, 0])
    return CalibratedCamera(name, lens, pose)


def test_rig_of_cameras_without_size(tmp_path):
    bent = (-0.1, 0.0, 0.0, 0.0)
    rig, lenses = rig_of(camera(1.0, UNKNOWN_SIZE), camera(1.3, UNKNOWN_SIZE, bent), ((320, 200), (320, 200)))
    assert rig.baseline == pytest.approx(0.3)
    assert (rig.left.width, rig.left.height) == (320, 200)
    # Only the camera that has distortion has a lens.
    assert lenses == {"right": Lens(Camera(500, 500, 320, 240, 320, 200), "radtan", bent)}


def test_a_camera_that_is_said_to_have_no_distortion_has_zeros(tmp_path):
    part = "  intrinsics: [60, 60, 31.5, 23.5]\n  resolution: [64, 48]\n"
    (tmp_path / "chain.yaml").write_text(f"cam0:\n{part}  distortion_model: none\ncam1:\n{part}")
    assert [camera.lens.model for camera in read_cameras(tmp_path / "chain.yaml")] == ["radtan", "none"]


def test_fisheye_rig_has_the_focal_length_of_its_ideal_camera():
    lens = Lens(Camera(190, 190, 256, 256, 512, 512), "fisheye", (0.0, 0.0, 0.0, 0.0))
    left = CalibratedCamera("a", lens, RigidTransform.identity())
    right = CalibratedCamera("b", lens, RigidTransform(np.eye(3), [-0.1, 0, 0]))
    rig, _ = rig_of(left, right)
    assert rig.left == lens.ideal_camera()
    assert rig.left.fx < 190


@pytest.mark.parametrize(
    ("left", "right", "sizes", "expected"),
    [
        (camera(0.0), camera(None, name="two"), None, ("RIL-128",)),
        (camera(0.2), camera(0.2), None, ("RIL-129",)),
        (camera(0.0, UNKNOWN_SIZE), camera(0.1), None, ("RIL-132",)),
        (camera(0.0), camera(0.1), ((641, 480), (640, 480)), ("RIL-131", "640 x 480", "641 x 480")),
    ],
)
def test_rigs_that_cannot_be(left, right, sizes, expected):
    with raises(*expected) as error:
        rig_of(left, right, sizes)
    assert error.value.remedy


@pytest.mark.parametrize("centre", [(-0.01, 0.2, 0.0), (-0.2, 0.01, 0.0), (0.0, 0.0, -0.2)])
def test_the_right_camera_may_stand_anywhere(centre):
    """As that of two cameras that are mounted upside down: matches show whether sides are exchanged."""
    other = CalibratedCamera("other", camera(0).lens, RigidTransform(np.eye(3), np.negative(centre)))
    np.testing.assert_allclose(rig_of(camera(0.0), other)[0].centre, centre)


# -- real calibrations -------------------------------------------------------------------------------------------------


def matches(left, right):
    """SIFT matches (n, 2) of two images, one to one."""
    sift = cv2.SIFT_create(2000)
    (a, da), (b, db) = (sift.detectAndCompute(image, None) for image in (left, right))
    best = [m for m, n in cv2.BFMatcher().knnMatch(da, db, k=2) if m.distance < 0.75 * n.distance]
    back = {m[0].queryIdx: m[0].trainIdx for m in cv2.BFMatcher().knnMatch(db, da, k=1)}
    best = [m for m in best if back[m.trainIdx] == m.queryIdx]
    return np.array([a[m.queryIdx].pt for m in best]), np.array([b[m.trainIdx].pt for m in best])


def epipolar_distance(rig, lenses, p, q):
    """Pixels of the ideal right image between matches and their epipolar lines."""
    if lenses:
        p, q = lenses["left"].undistort(p), lenses["right"].undistort(q)
    T = rig.T_right_left
    normals = np.cross(T.translation, rig.left.rays(p) @ T.rotation.T) @ np.linalg.inv(rig.right.matrix)
    return np.abs(np.sum(normals * np.column_stack([q, np.ones(len(q))]), axis=1)) / np.hypot(*normals[:, :2].T)


def read_pair(folder, files, images):
    left, right = (cv2.imread(str(folder / image), cv2.IMREAD_GRAYSCALE) for image in images)
    cameras = [camera for file in files for camera in read_cameras(folder / file)]
    return *rig_of(*cameras, tuple((image.shape[1], image.shape[0]) for image in (left, right))), *matches(left, right)


@pytest.mark.data
def test_drone(data_dir):
    folder = data_dir / "euroc_still" / "mav0"
    name = sorted(path.name for path in (folder / "cam0" / "data").glob("*.png"))[5]
    files, images = [f"cam{n}/sensor.yaml" for n in (0, 1)], [f"cam{n}/data/{name}" for n in (0, 1)]
    rig, lenses, p, q = read_pair(folder, files, images)
    assert rig.baseline == pytest.approx(0.1101, abs=1e-4)
    assert np.median(epipolar_distance(rig, lenses, p, q)) < 0.25
    without = epipolar_distance(rig, None, p, q)
    assert np.median(without) > 2 * np.median(epipolar_distance(rig, lenses, p, q))


@pytest.mark.data
def test_rover_with_a_calibration_that_is_not_exact(data_dir):
    files, images = ("black_left.tsai", "black_right.tsai"), ("left4.png", "right4.png")
    rig, lenses, p, q = read_pair(data_dir / "nasa_k10", files, images)
    assert rig.baseline == pytest.approx(0.1058, abs=1e-4)
    assert centre(rig.T_right_left)[0] > 0.99 * rig.baseline
    # Rows differ by 14.6 px as they are; the calibration explains all but some (its yaw is 1 degree off).
    assert np.median(np.abs((p - q)[:, 1])) > 12
    distance = epipolar_distance(rig, lenses, p, q)
    assert np.median(distance) < 2
    # The other reading of R (world to camera) leaves 3 % of the matches there.
    assert np.mean(distance < 5) > 0.8


@pytest.mark.data
def test_desert_is_rectified_but_for_half_a_row(data_dir):
    images = ("left/048979.png", "right/048979.png")
    rig, lenses, p, q = read_pair(data_dir / "devon_island", ["source_config.yaml"], images)
    assert lenses is None
    assert rig.baseline == pytest.approx(0.234, abs=1e-4)
    assert np.median(epipolar_distance(rig, lenses, p, q)) < 0.7


@pytest.mark.data
def test_chessboards_of_other_programs(data_dir):
    (left,) = read_cameras(data_dir / "chessboard_opencv" / "left_intrinsics.yml")
    assert left.lens.camera.fx == pytest.approx(535.9157)
    assert len(left.lens.coefficients) == 5
    rig, _ = rig_of(*read_cameras(data_dir / "chessboard_bumblebee2" / "stereo.yaml"))
    # In millimetres, as its target: a Bumblebee 2 has 120 mm.
    assert rig.baseline == pytest.approx(120.05, abs=0.01)


def test_projections_without_labels_are_kittis_and_poses_are_none(tmp_path):
    file = tmp_path / "calib.txt"
    file.write_text("700 0 320 0 0 700 120 0 0 0 1 0\n700 0 320 -350 0 700 120 0 0 0 1 0\n")
    left, right = read_cameras(file)
    rig, *_ = rig_of(left, right, ((640, 240), (640, 240)))
    assert rig.left.fx == 700
    assert rig.baseline == pytest.approx(0.5)
    file.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    with raises("RIL-100"):
        read_cameras(file)


def test_a_part_of_the_sensor_in_a_printed_camera_info_is_applied(tmp_path):
    text = """height: 480
width: 640
distortion_model: plumb_bob
d: [0.0, 0.0, 0.0, 0.0, 0.0]
k: [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [500.0, 0.0, 320.0, -50.0, 0.0, 500.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: {0}
binning_y: {0}
roi: {{x_offset: {1}, y_offset: 20, height: 400, width: 600, do_rectify: false}}
"""
    (whole,) = read_cameras(written(tmp_path, text.replace("roi", "other").format(0, 0), "a.yaml"))
    assert (whole.lens.camera.cx, whole.size) == (320.0, (640, 480))
    (part,) = read_cameras(written(tmp_path, text.format(1, 40), "b.yaml"))
    assert (part.lens.camera.fx, part.lens.camera.cx, part.lens.camera.cy, part.size) == (500, 280, 220, (600, 400))
    (half,) = read_cameras(written(tmp_path, text.format(2, 40), "c.yaml"))
    assert (half.lens.camera.fx, half.lens.camera.cx, half.size) == (250, 139.75, (300, 200))
    for camera in (part, half):
        assert camera.T_camera_reference.translation == pytest.approx([-0.1, 0, 0])
    with raises("RIL-329", "roi"):
        read_cameras(written(tmp_path, text.format(-3, 40), "d.yaml"))


@pytest.mark.parametrize("halved", [0, 1])
def test_images_of_one_camera_that_were_made_smaller_are_refused_where_nothing_states_their_size(halved):
    left, right = (camera(float(k), UNKNOWN_SIZE, name=name) for k, name in enumerate(("one", "two")))
    sizes = [(640, 480), (640, 480)]
    assert rig_of(left, right, tuple(sizes))
    sizes[halved] = (320, 240)
    with raises("RIL-974", f"of camera {(left, right)[halved].name} is", "the images are 320 x 240", "times 0.5"):
        rig_of(left, right, tuple(sizes))


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("Calibration results\n=====\nCamera-system parameters:\n\tcam0 (/cam0/image_raw):\n", "camchain"),
        (
            '{"left_cam": {"fx": 700, "disto": [0, 0]}, "right_cam": {"fx": 700}, "R": [0, 0, 0], "T": [0.12, 0, 0]}',
            "SN",
        ),
        ('{"CameraParameters1": {"K": [[700, 0, 600], [0, 700, 180], [0, 0, 1]]}}', "stereoParametersToOpenCV"),
        ("%YAML:1.0\nCamera.fxl: 458.6\nCamera.fyl: 457.3\n", "M1, D1"),
        ('{"SettingsVersion": 1.2, "Vehicles": {}}', "FOV_Degrees"),
        ('{"camera_data_": []}', "stereo_front_left"),
    ],
)
def test_files_of_others_say_what_to_give_instead(tmp_path, text, remedy):
    path = tmp_path / "calibration.txt"
    path.write_text(text)
    with raises("RIL-727") as error:
        read_cameras(path)
    assert remedy in str(error.value)
