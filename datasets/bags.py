"""ROS 1 and ROS 2 bags and mcap files with the images of two cameras and their ``camera_info``.

Pairs are images of nearest ``header.stamp``. Images of a topic with a word in its name that begins with ``rect`` are
rectified: their camera is ``P``; that of others is ``K`` with the distortion ``D``, and ``R`` and ``P`` of both cameras
give their relative pose (REP 104 and ``sensor_msgs/msg/CameraInfo``). An IMU and wheel odometry are used if
``/tf_static`` has the transform from their frame to the left camera's: the IMU gives the vertical and rotations,
odometry predictions.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Sequence_
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.cameras import CalibratedCamera, opencv, rig_of
from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import RECTIFIED
from rille.datasets.images import bag
from rille.datasets.images.files import Digests, check_size
from rille.datasets.images.headers import Header, sizes_of
from rille.datasets.images.simultaneous import join
from rille.datasets.imu import ImuRecord, Inertial, at_frames, sensed
from rille.datasets.inspection.calibration import CALIBRATIONS, find_calibration
from rille.datasets.inspection.views import FoundImages
from rille.datasets.manifest.model import Cameras, Images, Manifest, RigSection
from rille.datasets.manifest.rig import Optics, check_baseline, placed, read_optics, street_defaults, unusual_cameras
from rille.datasets.poses import TimedPoses, interpolate
from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.datasets.text.names import derived_name
from rille.datasets.text.reading import SMALL, open_regular
from rille.datasets.text.sides import two_sides
from rille.datasets.text.times import seconds
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import NoParams
from rille.stages.core.errors import InputError, warning, within
from rille.stages.core.quantities import count
from rille.stages.geometry.geometry import RigidTransform, Sizes

FORMS = (
    ("BAG", "ROS 1 or 2 bag or mcap (FILE.bag, FILE.mcap, folder with metadata.yaml): two image topics, camera_info"),
    ("BAG:LEFT,RIGHT", "the same; LEFT and RIGHT name the image topics"),
)

SUFFIXES = (".bag", ".mcap", ".db3")
INFO, IMU, ODOMETRY = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"
FRAMES = "/tf_static"
UNSTATED = RigSection()


@dataclass(frozen=True)
class TakenImage:
    """One image message: time of its recording, its digest, width, height and bits of its image, and the frame of its
    camera; ``stamped``: whether its driver has set a stamp."""

    at: int
    sha256: str
    size: Header
    frame: str
    stamped: bool


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag."""
    about = path / "metadata.yaml"
    if not os.path.isfile(about):  # not pathlib's, which raises for a name that is too long
        return os.path.isfile(path) and path.suffix in SUFFIXES
    with open_regular(about, "bag's metadata", sys.maxsize) as file:
        return b"rosbag2_bagfile_information" in file.read(SMALL)


def open_layout(path: Path, number: str | None, digests: Digests) -> Sequence | None:
    """The sequence of a bag; None if the path is none.

    Raises
    ------
    InputError
        The package that reads bags is missing, the bag cannot be read, does not have exactly two image topics that
        belong together, or no cameras are known, or no two images are simultaneous.
    """
    return open_bag(path.resolve(), number) if is_bag(path) else None


def open_bag(
    path: Path,
    topics: str | None = None,
    optics_of: Callable[[Sizes], Optics] | None = None,
    tolerance: float | None = None,
    rig: RigSection = UNSTATED,
) -> Sequence:
    """The sequence of a bag.

    Parameters
    ----------
    topics : those of the left and right images, with a comma between them.
    optics_of : returns the cameras of images of some sizes; by default those of ``camera_info``, or else of a
        calibration file beside the bag.
    tolerance : s; largest difference of the stamps of a pair; None: see :func:`rille.datasets.images.pairing.join`.
    rig : baseline or pose of the right camera where ``optics_of`` is not given.
    """
    with bag.opened(path) as reader:
        chosen = _topics(reader, path, topics)
        there = [_images(reader, path, topic) for topic in chosen]
        both, warnings = _joined(path, chosen, there, tolerance)
        stamps = both[0]
        taken = {c: [of[stamp] for stamp in k] for c, of, k in zip(CAMERAS, there, both, strict=True)}
        sizes = sizes_of((taken["left"][0].size, taken["right"][0].size))
        for camera, topic in zip(CAMERAS, chosen, strict=True):
            for stamp, one in zip(stamps, taken[camera], strict=True):
                check_size(one.size, taken[camera][0].size, f"image {stamp} of {topic} in {path}")
        times = seconds(stamps, str(path), unit="ns")
        frame = taken["left"][0].frame
        optics, turned = (optics_of(sizes), np.eye(3)) if optics_of else _optics(reader, path, chosen, sizes, rig)
        inertial, odometry, unused = _movement(reader, path, times, frame, turned)

    def image(number: int, camera: str) -> Source:
        one = taken[camera][number]
        args = {"sha256": one.sha256, "camera": camera, "frame": number, "header": one.size._asdict()}
        place = bag.Message(str(path), chosen[CAMERAS.index(camera)], one.at)
        return Source("rille.datasets.images.bag", NoParams(), args, hints={"message": place._asdict()})

    sequence = Sequence(
        name=derived_name(path.stem),
        rig=optics.rig,
        frames=len(stamps),
        image=image,
        frame_names=tuple(map(str, stamps)),
        lenses=optics.lenses,
        times=times,
        odometry=odometry,
        defaults=street_defaults(optics.rig),
        warnings=(*warnings, *optics.warnings, *unused),
    )
    sequence = sensed(sequence, inertial)
    return sequence if optics.up is None else replace(sequence, up=(optics.up,) * len(stamps))


# -- images ------------------------------------------------------------------------------------------------------------


def _topics(reader: Any, path: Path, wanted: str | None) -> tuple[str, str]:
    """Topics of the left and right images: rectified before raw ones, raw before compressed ones."""
    kinds = {c.topic: c.msgtype for c in reader.connections}
    images = sorted(topic for topic, kind in kinds.items() if kind in (bag.IMAGE, bag.COMPRESSED))
    there = ", ".join(images) or "none"
    if wanted is not None:
        names = [name.strip() for name in wanted.split(",")]
        if len(names) != 2 or not set(names) <= set(images):
            text = f"{path} has not the image topics {wanted!r}"
            remedy = f"name two with a comma between them, left first; there are {there}"
            raise InputError("RIL-945", text, remedy=remedy)
        return names[0], names[1]
    ranks = {topic: (kinds[topic] == bag.COMPRESSED, not RECTIFIED.search(topic)) for topic in images}
    found = (two_sides(topic for topic in images if ranks[topic] == rank) for rank in sorted(set(ranks.values())))
    best = next((pairs for pairs in found if pairs), [])
    if len(best) != 1:
        text = f"{path} has {len(best) or 'no'} image topics that are left and right by name (images: {there})"
        raise InputError("RIL-946", text, remedy=f"name them: {path}:LEFT,RIGHT")
    return best[0]


def _messages(reader: Any, topic: str) -> Iterator[tuple[int, bytes, Any]]:
    """Time of recording (ns), bytes and content of each message of a topic."""
    connections = [c for c in reader.connections if c.topic == topic]
    for connection, at, data in reader.messages(connections) if connections else ():
        yield at, data, reader.deserialize(data, connection.msgtype)


def _stamp(message: Any) -> int:
    """Time stamp of a message, ns; 0 if its driver has not set one: then the time of its recording counts."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _images(reader: Any, path: Path, topic: str) -> dict[int, TakenImage]:
    """Images of a topic by their stamp, ns."""
    found: dict[int, TakenImage] = {}
    for at, data, message in _messages(reader, topic):
        stamped = _stamp(message)
        stamp = stamped or at
        size = bag.depth(message, f"image {stamp} of {topic} in {path}")
        taken = TakenImage(at, hashlib.sha256(data).hexdigest(), size, message.header.frame_id, bool(stamped))
        if found.setdefault(stamp, taken).sha256 != taken.sha256:  # a copy of the message does no harm
            text = f"{path}: two images of {topic} have the stamp {stamp}"
            raise InputError("RIL-993", text, remedy="record header.stamp as the time when an image was taken")
    _check_clock(found, f"{path} {topic}")
    return found


def _check_clock(found: Mapping[int, TakenImage], where: str) -> None:
    """Refuse images whose clock was set back meanwhile; ``found``: images by stamp, in order of their recording.

    Single images may be written late; after a clock was set back all later ones are.
    """
    stamps, late = np.array(list(found)), np.array([one.at - stamp for stamp, one in found.items()])
    for k in 1 + np.flatnonzero(np.diff(stamps) < 0):
        # 3: fewest images that show a clock that was set back; fewer may be written late.
        if len(late) - k >= 3 and late[k:].min() > late[:k].max():
            text = f"{where}: header.stamp goes back by {(stamps[k - 1] - stamps[k]) / 1e9:.3g} s at image {k}"
            remedy = "its clock was set meanwhile: cut the bag there, and take each part as a sequence"
            raise InputError("RIL-958", text, remedy=remedy)


def _joined(
    path: Path, topics: tuple[str, str], taken: Sequence_[Mapping[int, TakenImage]], tolerance: float | None
) -> tuple[tuple[list[int], list[int]], list[str]]:
    """Stamps of the left and of the right images of all pairs, in order, and warnings about images left out."""
    left, right = sorted(taken[0]), sorted(taken[1])
    joined = join([stamp / 1e9 for stamp in left], [stamp / 1e9 for stamp in right], tolerance)
    if not joined.places:
        near = f"the nearest are {1e3 * joined.apart:.4g} ms apart, {1e3 * joined.allowed:.3g} ms are allowed"
        text = f"{path}: no image of {topics[0]} ({len(left)}) has the stamp of one of {topics[1]} ({len(right)})"
        remedy = "synchronise the cameras, or state images.tolerance (s) in a manifest"
        raise InputError("RIL-947", f"{text}; {near}", remedy=remedy)
    both = [left[i] for i, _ in joined.places], [right[j] for _, j in joined.places]
    lines = joined.lines("RIL-948")
    for topic, of in zip(topics, taken, strict=True):
        if unstamped := sum(not image.stamped for image in of.values()):
            text = f"{path}: {count(unstamped, 'image')} of {topic} without header.stamp: the time of recording counts"
            lines.append(warning("RIL-994", text))
    return both, lines


# -- cameras -----------------------------------------------------------------------------------------------------------


def _optics(
    reader: Any, path: Path, topics: tuple[str, str], sizes: Sizes, section: RigSection
) -> tuple[Optics, Floats]:
    """Cameras of the image topics, and the rotation from the left camera's frame to that of its images."""
    infos = [_info(reader, path, topic) for topic in topics]
    missing = next((_beside(topic) for topic, info in zip(topics, infos, strict=True) if info is None), None)
    if missing is not None:
        texts = [p for p in sorted(path.parent.iterdir()) if p.suffix.lower() in CALIBRATIONS]
        beside = find_calibration(path.parent, texts, FoundImages("", "", 0, sizes, "")).best
        if beside is None or beside.baseline is None:
            there = sorted({c.topic for c in reader.connections if c.msgtype == INFO})
            text = f"{path} has no {missing} of a calibrated camera (camera_info: {', '.join(there) or 'none'})"
            remedy = "record that of both cameras, put a calibration file beside the bag, or write a manifest"
            raise InputError("RIL-949", text, remedy=remedy)
        stated = dict(zip(CAMERAS if beside.files[1:] else ("file",), beside.files, strict=True))
        cameras = Cameras.model_validate({**stated, "names": beside.names})
        manifest = Manifest(images=Images(left="", right=""), cameras=cameras, rig=section)
        line = warning("RIL-825", f"{path} has no {missing}: its cameras are those of {' and '.join(beside.files)}")
        with within(str(path)):
            optics = read_optics(manifest, path.parent, sizes)
        return replace(optics, warnings=(line, *optics.warnings)), np.eye(3)
    (left, turned), (right, _) = (_camera(path, topic, info) for topic, info in zip(topics, infos, strict=True) if info)
    with within(str(path)):
        left, right, lines = placed(left, right, section)
        rig, lenses = rig_of(left, right, sizes)
        lines += check_baseline(rig.baseline, section)
    return Optics(rig, lenses, None, (*lines, *unusual_cameras((left, right), sizes))), turned


def _beside(topic: str) -> str:
    """Topic of the ``camera_info`` of an image topic."""
    return f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


def _info(reader: Any, path: Path, topic: str) -> dict[str, Any] | None:
    """Fields of the ``camera_info`` of an image topic; messages of uncalibrated cameras, with P or K = 0, do not count.

    ROS 1 names the fields K, D, R and P, ROS 2 k, d, r and p.
    """
    first: dict[str, Any] | None = None
    for _, _, m in _messages(reader, _beside(topic)):
        info = {key.lower(): getattr(m, key) for key in m.__dataclass_fields__ if key != "header"}
        if not np.any(info["p"]) or not (np.any(info["k"]) or RECTIFIED.search(topic)):
            continue
        first = first or info
        if changed := [key for key, value in info.items() if not np.array_equal(value, first[key])]:
            text = f"{path}: {_beside(topic)} changes meanwhile: {', '.join(changed)}"
            raise InputError("RIL-959", text, remedy="cut the bag there, or state the cameras in a manifest")
    return first


def _camera(path: Path, topic: str, given: Mapping[str, Any]) -> tuple[CalibratedCamera, Floats]:
    """Camera of an image topic by its ``camera_info``, and the rotation from its frame to the image's."""
    roi = {key: getattr(given["roi"], key) for key in ("x_offset", "y_offset", "width", "height")}
    distortion_model = given["distortion_model"] or "plumb_bob"
    entries = {**given, "roi": roi, "camera_name": topic, "distortion_model": distortion_model}
    fields, turned = Fields(entries, f"{path} {_beside(topic)}"), np.eye(3)
    if RECTIFIED.search(topic):
        turned = fields.rigid("r", fields.matrix("r", 3, 3), np.zeros(3)).rotation
        # The images are rectified already: P alone is their camera, and R must not be applied again.
        fields.values |= {"k": fields.matrix("p", 3, 4)[:, :3], "d": [], "r": np.eye(3), "distortion_model": "none"}
    return opencv.message(fields, path)[0], turned


# -- motion ------------------------------------------------------------------------------------------------------------


def _movement(
    reader: Any, path: Path, times: tuple[float, ...], frame: str, R_image_camera: Floats
) -> tuple[Inertial, tuple[RigidTransform | None, ...] | None, list[str]]:
    """Records of IMU and odometry at each frame, and warnings about unusable ones."""
    frames, warnings = _static(reader), list[str]()
    inertial, odometry = Inertial(), None
    for kind in (IMU, ODOMETRY):
        topics = sorted({c.topic for c in reader.connections if c.msgtype == kind})
        # By stamp, because drivers repeat messages.
        messages = {_stamp(m) or at: m for topic in topics[:1] for at, _, m in _messages(reader, topic)}
        if len(topics) > 1 or (topics and not messages):
            warnings.append(warning("RIL-950", f"{path}: of {', '.join(topics)} none is used: one with messages is"))
        if len(topics) != 1 or not messages:
            continue
        stamps = sorted(messages)
        record = [messages[stamp] for stamp in stamps]
        sensor = record[0].header.frame_id if kind == IMU else record[0].child_frame_id
        why = f"{FRAMES} does not say how {frame!r} stands in {sensor!r}"
        try:
            if (T_sensor_camera := _between(frames, sensor, frame)) is not None:
                # frame_id is the frame of the mounted camera; a rectified image is turned by R against it.
                T_sensor_left = T_sensor_camera @ RigidTransform(R_image_camera.T, np.zeros(3))
                moments = seconds(stamps, f"{path} {topics[0]}", unit="ns")
                if kind == IMU:
                    rates = np.array([_vector(m.angular_velocity) for m in record])
                    forces = np.array([_vector(m.linear_acceleration) for m in record])
                    inertial = at_frames(ImuRecord(np.array(moments), rates, forces, topics[0]), times, T_sensor_left)
                else:
                    poses = tuple(_pose(m.pose.pose.position, m.pose.pose.orientation) for m in record)
                    # 0.5 s: longest gap over which odometry is interpolated.
                    between = interpolate(TimedPoses(moments, poses, topics[0]), times, 0.5)
                    odometry = tuple(T and T @ T_sensor_left for T in between)
                continue
        except (InputError, ValueError) as error:  # ValueError: quaternions of zeros, forces of NaN
            why = error.message if isinstance(error, InputError) else str(error)
        warnings.append(warning("RIL-951", f"{path}: {topics[0]} is not used: {why}"))
    return inertial, odometry, warnings


def _static(reader: Any) -> dict[str, dict[str, RigidTransform]]:
    """Fixed transforms, ``T_a_b`` at ``[a][b]``, of ``/tf_static``."""
    found: dict[str, dict[str, RigidTransform]] = {}
    for _, _, message in _messages(reader, FRAMES):
        for one in message.transforms:
            parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
            T_parent_child = _pose(one.transform.translation, one.transform.rotation)
            found.setdefault(parent, {})[child] = T_parent_child
            found.setdefault(child, {})[parent] = T_parent_child.inverse()
    return found


def _between(frames: Mapping[str, Mapping[str, RigidTransform]], a: str, b: str) -> RigidTransform | None:
    """``T_a_b`` along fixed transforms; None if they do not connect the frames."""
    a, b = a.lstrip("/"), b.lstrip("/")
    known = {a: RigidTransform.identity()}
    # Breadth first, since the graph of transforms may have cycles.
    todo = [a]
    for one in todo:
        for other, T in frames.get(one, {}).items():
            if other not in known:
                known[other] = known[one] @ T
                todo.append(other)
    return known.get(b)


def _pose(position: Any, turn: Any) -> RigidTransform:
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    return RigidTransform(rotation, np.array(_vector(position)))


def _vector(message: Any) -> list[float]:
    return [message.x, message.y, message.z]
