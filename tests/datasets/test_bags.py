"""ROS bags: written with rosbags in every form, and opened like the folder of the same images."""

from __future__ import annotations

import resource
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
from raising import raises
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import rille
from rille.datasets import bags
from rille.datasets.bags import is_bag
from rille.datasets.images import bag as bag_images
from rille.datasets.registry import open_sequence
from rille.pipeline.cli import main
from rille.stages.core.declare import declared
from rille.stages.geometry.geometry import RigidTransform

START, STEP = 1_700_000_000_000_000_000, 100_000_000
LEFT, RIGHT = "/stereo/left/image_rect", "/stereo/right/image_rect"
P = [50.0, 0.0, 31.0, 0.0, 0.0, 51.0, 24.0, 0.0, 0.0, 0.0, 1.0, 0.0]
FORMS = ("bag", "sqlite", "mcap", "mcap-file")


class Bag:
    """Messages by topic, and how they are written."""

    def __init__(self, form="mcap-file"):
        self.form, self.rows = form, []
        self.store = get_typestore(Stores.ROS1_NOETIC if form == "bag" else Stores.ROS2_HUMBLE)

    def make(self, name, **fields):
        kind = self.store.types[name]
        if "seq" in kind.__dataclass_fields__:  # headers of ROS 1
            fields |= {"seq": 0}
        return kind(**fields)

    def header(self, stamp, frame="camera"):
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def add(self, topic, stamp, message):
        self.rows.append((topic, stamp, message))

    def image(self, topic, stamp, pixels, encoding="mono8", pad=0):
        padded = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, pad)))
        data = np.frombuffer(padded.tobytes(), np.uint8)
        sizes = {"height": pixels.shape[0], "width": pixels.shape[1], "step": padded.strides[0]}
        fields = {"header": self.header(stamp), "encoding": encoding, "is_bigendian": 0, "data": data, **sizes}
        self.add(topic, stamp, self.make("sensor_msgs/msg/Image", **fields))

    def compressed(self, topic, stamp, data):
        fields = {"header": self.header(stamp), "format": "mono8; png compressed"}
        message = self.make("sensor_msgs/msg/CompressedImage", data=np.frombuffer(data, np.uint8), **fields)
        self.add(topic, stamp, message)

    def info(self, topic, size, p, k=None, d=(), r=None, binning=0, part=(0, 0, 0, 0)):
        none = {**dict(zip(("x_offset", "y_offset", "width", "height"), part, strict=True)), "do_rectify": False}
        matrices = {"K": np.reshape(p, (3, 4))[:, :3].ravel() if k is None else k, "D": d, "P": p}
        matrices |= {"R": np.eye(3).ravel() if r is None else r}
        numbers = {n if self.form == "bag" else n.lower(): np.array(v, float) for n, v in matrices.items()}
        whole = {"height": size[1], "width": size[0], "distortion_model": "plumb_bob"}
        whole |= {"binning_x": binning, "binning_y": binning}
        roi = self.make("sensor_msgs/msg/RegionOfInterest", **none)
        header = self.header(START)
        self.add(topic, START, self.make("sensor_msgs/msg/CameraInfo", header=header, roi=roi, **whole, **numbers))

    def vector(self, values, name="geometry_msgs/msg/Vector3"):
        return self.make(name, **dict(zip("xyzw", map(float, values), strict=False)))

    def fixed(self, parent, child, T):
        quaternion = self.vector(Rotation.from_matrix(T.rotation).as_quat(), "geometry_msgs/msg/Quaternion")
        move = self.make("geometry_msgs/msg/Transform", translation=self.vector(T.translation), rotation=quaternion)
        one = {"header": self.header(START, parent), "child_frame_id": child, "transform": move}
        stamped = self.make("geometry_msgs/msg/TransformStamped", **one)
        self.add("/tf_static", START, self.make("tf2_msgs/msg/TFMessage", transforms=[stamped]))

    def write(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / ("drive.bag" if self.form == "bag" else "drive")
        plugin = StoragePlugin.SQLITE3 if self.form == "sqlite" else StoragePlugin.MCAP
        writer = Writer1(path) if self.form == "bag" else Writer2(path, version=9, storage_plugin=plugin)
        if self.form == "packed":
            writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
        with writer:
            topics = {}
            for topic, stamp, message in self.rows:
                kind = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.store)
                dump = self.store.serialize_ros1 if self.form == "bag" else self.store.serialize_cdr
                writer.write(topics[topic], stamp + 7_000_000, dump(message, kind))
        return next(path.glob("*.mcap")) if self.form == "mcap-file" else path


def picture(k, side, dtype=np.uint8):
    return np.random.default_rng(2 * k + side).integers(0, np.iinfo(dtype).max, (48, 64), dtype)


def street(form="mcap-file", frames=3, lag=0, infos=True, dtype=np.uint8):
    bag = Bag(form)
    if infos:
        right = [*P]
        right[3] = -50.0 * 0.5
        bag.info("/stereo/left/camera_info", (64, 48), P)
        bag.info("/stereo/right/camera_info", (64, 48), right)
    for k in range(frames):
        for side, topic in enumerate((LEFT, RIGHT)):
            encoding = "mono16" if dtype == np.uint16 else "mono8"
            bag.image(topic, START + k * STEP + side * lag, picture(k, side, dtype), encoding, pad=4)
    return bag


def run(source):
    stage = declared(import_module(source.module))
    return stage.run(source.params, {**source.args, **source.hints}, {})


def pixels(sequence, frame, camera):
    return np.asarray(run(sequence.image(frame, camera))["image"])


def test_a_bag_that_unpacks_without_bound_is_refused(tmp_path, monkeypatch):
    limits = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setattr(bag_images, "MAX_UNPACKED_BYTES", 1 << 27)
    bag = street("packed")
    assert open_sequence(str(bag.write(tmp_path / "sound"))).frames == 3
    bag.image(LEFT, START - STEP, np.zeros((14_000, 14_000), np.uint8))
    path = bag.write(tmp_path / "huge")
    assert sum(file.stat().st_size for file in path.iterdir()) < 1e6
    with raises("RIL-939"):
        open_sequence(str(path))
    assert resource.getrlimit(resource.RLIMIT_AS) == limits


def test_a_large_file_that_is_called_as_a_bags_makes_no_bag(tmp_path):
    with (tmp_path / "metadata.yaml").open("wb") as file:
        file.truncate(200_000_000)
    assert not is_bag(tmp_path)
    assert not is_bag(tmp_path / ("x" * 300))


@pytest.mark.parametrize("form", FORMS)
def test_rectified_pairs_come_back_as_they_were_written(tmp_path, form):
    path = street(form).write(tmp_path)
    if path.is_dir():
        (path / "notes").mkdir()
    sequence = open_sequence(str(path))
    assert sequence.frames == 3
    assert sequence.times == pytest.approx([1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2])
    assert sequence.rig.baseline == pytest.approx(0.5)
    assert sequence.rig.T_right_left.translation[0] == pytest.approx(-0.5)
    assert (sequence.rig.left.fx, sequence.rig.left.cy, sequence.lenses) == (50.0, 24.0, None)
    for k in range(3):
        assert (pixels(sequence, k, "left") == picture(k, 0)).all()
        assert (pixels(sequence, k, "right") == picture(k, 1)).all()


def test_raw_images_have_lenses_and_the_rectification_says_how_the_cameras_stand(tmp_path):
    R_left, R_right = (Rotation.from_rotvec(v).as_matrix() for v in ([0.01, -0.02, 0.005], [-0.01, 0.015, 0.0]))
    bag, d = Bag(), [-0.3, 0.1, 0.001, -0.002, 0.0]
    right = [*P]
    right[3] = -25.0
    for name, R, p in (("left", R_left, P), ("right", R_right, right)):
        bag.info(f"/{name}/camera_info", (64, 48), p, [55, 0, 30, 0, 56, 25, 0, 0, 1], d, R.ravel())
        bag.image(f"/{name}/image_raw", START, picture(0, name == "right"))
    sequence = open_sequence(str(bag.write(tmp_path)))
    assert sequence.lenses["left"].coefficients == pytest.approx(d)
    assert sequence.rig.left.fx == 55.0
    point = np.array([0.3, -0.2, 4.0])  # in the left camera; rectified, the right one sees it half a metre further left
    expected = R_right.T @ (R_left @ point - [0.5, 0, 0])
    assert sequence.rig.T_right_left.apply(point) == pytest.approx(expected)


@pytest.mark.parametrize("name", ["image_unrectified", "direct/image_raw"])
def test_a_word_that_only_ends_in_rect_does_not_make_images_rectified(tmp_path, name):
    bag, right = Bag(), [*P]
    right[3] = -25.0
    for side, p in (("left", P), ("right", right)):
        place = f"/{side}/{name}".rpartition("/")[0]
        bag.info(f"{place}/camera_info", (64, 48), p, [55, 0, 30, 0, 56, 25, 0, 0, 1], [-0.3, 0.1, 0, 0, 0])
        bag.image(f"/{side}/{name}", START, picture(0, side == "right"))
    sequence = open_sequence(str(bag.write(tmp_path)))
    assert sequence.lenses is not None
    assert sequence.rig.left.fx == 55.0


def test_colour_depth_and_compression(tmp_path):
    deep = open_sequence(str(street(dtype=np.uint16).write(tmp_path / "deep")))
    assert (pixels(deep, 1, "right") == picture(1, 1, np.uint16)).all()
    bag = street(frames=0)
    colour = np.dstack([picture(k, 0) for k in range(3)])
    bag.image(LEFT, START, colour, "rgb8")
    bag.image(RIGHT, START, colour[:, :, ::-1].copy(), "bgr8")
    mixed = open_sequence(str(bag.write(tmp_path / "colour")))
    grey = colour @ [0.299, 0.587, 0.114]
    for camera in ("left", "right"):
        assert np.abs(pixels(mixed, 0, camera) - grey).max() < 1
    bag = street(frames=0)
    for side, topic in enumerate((LEFT, RIGHT)):
        bag.compressed(f"{topic}/compressed", START, cv2.imencode(".png", picture(0, side))[1].tobytes())
    packed = open_sequence(str(bag.write(tmp_path / "packed")))
    assert (pixels(packed, 0, "right") == picture(0, 1)).all()


@pytest.mark.parametrize(("encoding", "at"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_images_of_usb_cameras_are_read_by_their_luminance(tmp_path, encoding, at):
    bag = street(frames=0)
    for side, topic in enumerate((LEFT, RIGHT)):
        both = np.full((48, 64, 2), 128, np.uint8)
        both[:, :, at] = picture(0, side)
        bag.image(topic, START, both, encoding)
    assert (pixels(open_sequence(str(bag.write(tmp_path))), 0, "right") == picture(0, 1)).all()


def test_imu_and_odometry_count_where_tf_static_places_them(tmp_path):
    T_base_camera = RigidTransform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.4, 0.1, 0.8])
    T_base_imu = RigidTransform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.2])
    bag = street(frames=3)
    bag.fixed("base", "camera", T_base_camera)
    bag.fixed("base", "imu", T_base_imu)
    zeros = np.zeros(9)
    for k in range(-300, 321):
        stamp = START + k * 10_000_000
        up = {"angular_velocity": bag.vector([0, 0, 0]), "linear_acceleration": bag.vector([0, 0, -9.81])}
        none = {f"{name}_covariance": zeros for name in ("orientation", *up)}
        level = bag.vector([0, 0, 0, 1], "geometry_msgs/msg/Quaternion")
        header = bag.header(stamp, "imu")
        bag.add("/imu", stamp, bag.make("sensor_msgs/msg/Imu", header=header, orientation=level, **up, **none))
        at = bag.make(
            "geometry_msgs/msg/Pose",
            position=bag.vector([k * 0.01, 0, 0], "geometry_msgs/msg/Point"),
            orientation=level,
        )
        still = bag.make("geometry_msgs/msg/Twist", linear=bag.vector([1, 0, 0]), angular=bag.vector([0, 0, 0]))
        pose = bag.make("geometry_msgs/msg/PoseWithCovariance", pose=at, covariance=np.zeros(36))
        twist = bag.make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36))
        fields = {"header": bag.header(stamp, "odom"), "child_frame_id": "base", "pose": pose, "twist": twist}
        bag.add("/odom", stamp, bag.make("nav_msgs/msg/Odometry", **fields))
    bag.rows.sort(key=lambda row: row[1])
    sequence = open_sequence(str(bag.write(tmp_path)))
    assert sequence.up[1] == pytest.approx((0.0, -1.0, 0.0), abs=1e-9)  # down is y of an optical frame
    assert sequence.odometry[2].translation == pytest.approx([0.2 + 0.4, 0.1, 0.8])
    assert sequence.odometry[2].rotation == pytest.approx(T_base_camera.rotation)
    assert sequence.attitude[0] is not None
    # Drivers repeat messages, and odometry may begin without a rotation: that costs no more than the sensor.
    bag.rows += [row for row in bag.rows if row[0] == "/imu"]
    first = next(m for topic, _, m in bag.rows if topic == "/odom")
    first.pose.pose.orientation = bag.vector([0, 0, 0, 0], "geometry_msgs/msg/Quaternion")
    partly = open_sequence(str(bag.write(tmp_path / "partly")))
    assert (partly.attitude, partly.odometry) == (sequence.attitude, None)
    assert [line for line in partly.warnings if "/odom" in line and "RIL-951" in line]
    lone = street(frames=2)
    lone.add("/imu", START, next(m for topic, _, m in bag.rows if topic == "/imu"))
    assert any("RIL-951" in line for line in open_sequence(str(lone.write(tmp_path / "lone"))).warnings)


def test_topics_are_named_where_names_do_not_tell(tmp_path):
    bag = street()
    bag.rows = [(topic.replace("right", "other"), stamp, message) for topic, stamp, message in bag.rows]
    path = bag.write(tmp_path)
    with raises("RIL-946", LEFT, "/stereo/other/image_rect"):
        open_sequence(str(path))
    assert open_sequence(f"{path}:{LEFT},/stereo/other/image_rect").frames == 3
    with raises("RIL-945", "/nowhere"):
        open_sequence(f"{path}:{LEFT},/nowhere")


def test_what_a_bag_lacks_is_one_line(tmp_path, monkeypatch):
    with raises("RIL-947", "30 ms apart, 10 ms are allowed"):
        open_sequence(str(street(lag=30_000_000).write(tmp_path / "lag")))
    with raises("RIL-949", "/stereo/left/camera_info"):
        open_sequence(str(street(infos=False).write(tmp_path / "infos")))
    bag = street(frames=0)
    for topic in (LEFT, RIGHT):
        bag.compressed(f"{topic}/compressed", START, b"\x89PNG, and nothing more")
    with raises("RIL-171", "/compressed"):
        open_sequence(str(bag.write(tmp_path / "packed")))
    bag = street(frames=0)
    for topic in (LEFT, RIGHT):
        bag.image(topic, START, picture(0, 0), "nv12")
    with raises("RIL-943", "nv12"):
        open_sequence(str(bag.write(tmp_path / "yuv")))
    sequence = street(frames=2).write(tmp_path / "half")
    sequence.write_bytes(sequence.read_bytes()[:2000])
    with raises("RIL-941", "drive"):
        open_sequence(str(sequence))
    path = street().write(tmp_path / "sound")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with raises("RIL-940", "rille[robots]"):
        open_sequence(str(path))


def test_a_short_image_and_a_changed_bag_are_refused(tmp_path):
    bag = street(frames=1)
    bag.rows[-1][2].data = bag.rows[-1][2].data[:100]
    sequence = open_sequence(str(bag.write(tmp_path / "short")))
    short = run(sequence.image(0, "right"))
    assert "100 bytes" in short.meta["damage"]
    assert not short["valid"].any()
    path = street().write(tmp_path / "changed")
    sequence = open_sequence(str(path))
    path.write_bytes(street(frames=1).write(tmp_path / "other").read_bytes())
    with raises("RIL-944"):
        pixels(sequence, 2, "left")


def test_a_compressed_image_that_breaks_off_costs_its_frame_alone(tmp_path):
    bag = street(frames=0)
    for k in range(3):
        for side, topic in enumerate((LEFT, RIGHT)):
            data = cv2.imencode(".jpg", picture(k, side))[1].tobytes()
            bag.compressed(f"{topic}/compressed", START + k * STEP, data[: len(data) // 2] if k == 1 else data)
    sequence = open_sequence(str(bag.write(tmp_path)))
    assert sequence.frames == 3
    damaged = run(sequence.image(1, "left"))
    assert "decoded" in damaged.meta["damage"]
    assert not damaged["valid"].any()
    assert "damage" not in run(sequence.image(2, "left")).meta


def test_images_without_time_stamps_have_the_time_of_their_recording(tmp_path):
    bag = street(frames=3, lag=2_000_000)
    for topic, _, message in bag.rows:
        if topic in (LEFT, RIGHT):
            message.header = bag.header(0)
    sequence = open_sequence(str(bag.write(tmp_path / "none")))
    assert np.diff(sequence.times) == pytest.approx(STEP / 1e9, abs=1e-6)
    said = [line for line in sequence.warnings if "RIL-994" in line]
    assert [f"3 images of {topic}" in line for topic, line in zip((LEFT, RIGHT), said, strict=True)] == [True, True]
    np.testing.assert_array_equal(pixels(sequence, 2, "right"), picture(2, 1))
    # A recorder that sets its times to the stamps' is no driver without stamps.
    assert not any("RIL-994" in line for line in open_sequence(str(street().write(tmp_path / "all"))).warnings)


def test_images_without_a_partner_are_left_out(tmp_path):
    bag = street()
    bag.rows.pop()
    sequence = open_sequence(str(bag.write(tmp_path)))
    assert sequence.frames == 2
    assert any("RIL-948" in line for line in sequence.warnings)


def test_two_images_of_one_stamp_are_refused_and_a_copy_of_a_message_is_not(tmp_path):
    bag = street()
    bag.rows += bag.rows[-2:]
    assert open_sequence(str(bag.write(tmp_path / "copied"))).frames == 3
    bag.image(LEFT, START, picture(1, 0), pad=4)
    with raises("RIL-993", LEFT, str(START), "header.stamp"):
        open_sequence(str(bag.write(tmp_path / "stamps")))


def test_lengths_in_a_bag_that_are_no_metres_are_refused(tmp_path):
    bag, right = street(infos=False), [*P]
    right[3] = -50.0 * 500
    bag.info("/stereo/left/camera_info", (64, 48), P)
    bag.info("/stereo/right/camera_info", (64, 48), right)
    with raises("RIL-244", "500 m", "0.5"):
        open_sequence(str(bag.write(tmp_path)))


def test_init_says_that_a_bag_opens_as_it_is(tmp_path, capsys):
    path = street().write(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["init", str(path)])
    assert end.value.code == 0
    assert f"rille reconstruct {path}" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.data
def test_a_bag_of_a_street_gives_the_poses_of_its_folder(tmp_path, data_dir):
    folder, bag = data_dir / "kitti06_51", Bag()
    projections = np.loadtxt(folder / "calib.txt", usecols=range(-12, 0))
    images = {LEFT: sorted((folder / "image_l").iterdir()), RIGHT: sorted((folder / "image_r").iterdir())}
    for (topic, paths), p in zip(images.items(), projections, strict=True):
        pictures = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]
        bag.info(topic.replace("image_rect", "camera_info"), pictures[0].shape[::-1], p)
        for k, pixels in enumerate(pictures):
            bag.image(topic, START + k * STEP, pixels)
    found = []
    for name in (str(bag.write(tmp_path)), str(folder)):
        where = {"runs": tmp_path / "runs", "cache": tmp_path / "cache"}
        run = rille.reconstruct(rille.open(name), **where)
        found.append(np.loadtxt(run.folder / "trajectory.kitti"))
    assert found[0].shape == (51, 12)
    assert found[0] == pytest.approx(found[1], abs=1e-6)


@pytest.mark.parametrize("form", ["bag", "mcap-file"])
def test_images_of_nearly_one_time_are_joined(tmp_path, form):
    sequence = open_sequence(str(street(form, frames=4, lag=700_000).write(tmp_path)))
    assert sequence.frames == 4
    assert (pixels(sequence, 2, "right") == picture(2, 1)).all()
    assert ["up to 0.7 ms apart (10 ms are allowed)" in line for line in sequence.warnings] == [True]


def test_a_part_of_the_sensor_and_combined_pixels_are_applied(tmp_path):
    bag, right = street(infos=False), [*P]
    right[3] = -50.0 * 0.5
    # Of a sensor of 200 x 130 pixels 128 x 96 are read, and 2 x 2 of them are combined.
    for name, p in (("left", P), ("right", right)):
        bag.info(f"/stereo/{name}/camera_info", (200, 130), p, binning=2, part=(20, 10, 128, 96))
    camera = open_sequence(str(bag.write(tmp_path))).rig.left
    assert (camera.fx, camera.fy, camera.width, camera.height) == (25.0, 25.5, 64, 48)
    assert (camera.cx, camera.cy) == ((31.0 - 20 + 0.5) / 2 - 0.5, (24.0 - 10 + 0.5) / 2 - 0.5)
    assert open_sequence(str(tmp_path / "drive")).rig.baseline == pytest.approx(0.5)


PARALLEL = """image_width: 64
image_height: 48
camera_name: {name}
camera_matrix: {{rows: 3, cols: 3, data: [70, 0, 31, 0, 70, 24, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [70, 0, 31, {tx}, 0, 70, 24, 0, 0, 0, 1, 0]}}
"""


@dataclass
class Info:
    k: list[float]
    p: list[float]


@pytest.mark.parametrize(("topic", "counts"), [("/left/image_raw", False), ("/left/image_rect", True)])
def test_camera_info_without_K_is_that_of_rectified_images_alone(monkeypatch, topic, counts):
    monkeypatch.setattr(bags, "_messages", lambda *_: [(0, b"", Info([0.0] * 9, P))])
    assert (bags._info(None, Path(), topic) is not None) == counts


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("right", [None, [0.0] * 12])  # none at all, or of a camera that is not calibrated
def test_a_calibration_file_beside_a_bag_stands_for_its_camera_info(tmp_path, form, right):
    bag = street(form, infos=False)
    if right:
        bag.info("/stereo/left/camera_info", (64, 48), P)
        bag.info("/stereo/right/camera_info", (64, 48), right)
    path = bag.write(tmp_path)
    folder = path.parent
    with raises("RIL-949"):
        open_sequence(str(path))
    for name, tx in (("left", 0), ("right", -14)):
        (folder / f"{name}.yaml").write_text(PARALLEL.format(name=name, tx=tx))
    sequence = open_sequence(str(path))
    assert sequence.rig.baseline == pytest.approx(0.2)
    assert sequence.rig.left.fx == 70
    assert any("RIL-825" in line and "left.yaml and right.yaml" in line for line in sequence.warnings)


def test_a_manifest_takes_the_images_of_a_bag(tmp_path):
    street("bag", infos=False).write(tmp_path)
    path = tmp_path / "m.rille.toml"
    images = f'[images]\nleft = "drive.bag:{LEFT}"\nright = "drive.bag:{RIGHT}"\n'
    path.write_text(
        images + "[cameras]\nfx = 60.0\ncx = 31.5\ncy = 23.5\n[rig]\nbaseline = 0.1\n[world]\npitch_deg = 9.0\n"
    )
    sequence = open_sequence(str(path))
    assert (sequence.frames, sequence.rig.left.fx, sequence.rig.baseline) == (3, 60.0, pytest.approx(0.1))
    assert sequence.times == pytest.approx([1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2])
    assert sequence.pitch == pytest.approx(np.deg2rad(9.0))
    assert (pixels(sequence, 1, "right") == picture(1, 1)).all()
    (tmp_path / "truth.tum").write_text("".join(f"{1.7e9 + k / 10:.1f} {k} 0 0 0 0 0 1\n" for k in range(3)))
    path.write_text(path.read_text() + '[truth]\nfile = "truth.tum"\n')
    assert open_sequence(str(path)).truth[2].translation == pytest.approx([2, 0, 0])


def test_a_manifest_leaves_the_cameras_of_a_bag_as_they_are(tmp_path):
    street("bag", lag=15_000_000).write(tmp_path)
    path = tmp_path / "m.rille.toml"
    path.write_text('[images]\nleft = "drive.bag"\nright = "drive.bag"\n')
    with raises("RIL-947", "15 ms apart", "images.tolerance"):
        open_sequence(str(path))
    path.write_text(path.read_text() + "tolerance = 0.02\n")
    assert open_sequence(str(path)).rig.baseline == pytest.approx(0.5)
    path.write_text(path.read_text() + "[rig]\nbaseline = 0.4\n")
    moved = open_sequence(str(path))
    assert (moved.rig.baseline, moved.rig.left.fx) == (pytest.approx(0.4), 50)
    assert any("RIL-693" in line for line in moved.warnings)


def test_cameras_of_a_bag_that_were_calibrated_alone_are_a_rig_with_the_baseline_of_a_manifest(tmp_path):
    bag = street(infos=False)
    for side in ("left", "right"):
        bag.info(f"/stereo/{side}/camera_info", (64, 48), P)
    path = bag.write(tmp_path)
    with raises("RIL-129", "rig.baseline"):
        open_sequence(str(path))
    manifest = tmp_path / "m.rille.toml"
    manifest.write_text(f'[images]\nleft = "{path}"\nright = "{path}"\n[rig]\nbaseline = 0.4\n')
    assert open_sequence(str(manifest)).rig.baseline == pytest.approx(0.4)


@pytest.mark.parametrize("filters", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_of_16_bits_become_grey_as_those_of_8_do(tmp_path, filters):
    shown = []
    for bits, dtype in ((8, np.uint8), (16, np.uint16)):
        bag = street(frames=0)
        for side, topic in enumerate((LEFT, RIGHT)):
            bag.image(
                topic, START, picture(0, side).astype(dtype) * (1 if bits == 8 else 257), f"bayer_{filters}{bits}"
            )
        shown.append(pixels(open_sequence(str(bag.write(tmp_path / str(bits)))), 0, "left"))
    assert np.abs(shown[1] / 257.0 - shown[0]).max() <= 1


def test_cameras_that_change_in_a_recording_are_refused_unless_a_manifest_states_them(tmp_path):
    bag = street(frames=4)
    bag.info("/stereo/left/camera_info", (64, 48), [80.0, *P[1:]])
    path = bag.write(tmp_path)
    with raises("RIL-959", "camera_info changes"):
        open_sequence(str(path))
    manifest = tmp_path / "drive.toml"
    stated = "fx = 50\ncx = 31\ncy = 24\n[rig]\nbaseline = 0.5\n"
    manifest.write_text(f'[images]\nleft = "{path}"\nright = "{path}"\n[cameras]\n{stated}')
    assert open_sequence(str(manifest)).frames == 4


@pytest.mark.parametrize(("moved", "refused"), [([4, 5, 6, 7], True), ([4], False)])
def test_a_clock_that_was_set_back_is_told_from_images_written_late(tmp_path, moved, refused):
    bag = street(frames=0)
    for k in range(8):
        for side, topic in enumerate((LEFT, RIGHT)):
            bag.image(topic, START + (k - 3 * (k in moved)) * STEP + 1000 * k, picture(k, side))
            bag.rows[-1] = (topic, START + k * STEP, bag.rows[-1][2])
    path = bag.write(tmp_path)
    if refused:
        with raises("RIL-958", "image 4"):
            open_sequence(str(path))
    else:
        assert open_sequence(str(path)).frames == 8
