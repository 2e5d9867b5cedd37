"""Calibrations of stereo cameras and data sets by their makers.

ZED's ``.conf``, OAK's JSON (DepthAI), RealSense's list, ``K.txt``, Middlebury's rectified pairs (2014 and 2021), and
figures by key.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from rille.datasets.cameras.fields import Fields, by_count
from rille.datasets.cameras.kitti import LEAST_FOCAL
from rille.datasets.cameras.model import UNKNOWN_SIZE, CalibratedCamera, parallel, stereo_cameras
from rille.datasets.cameras.opencv import relative
from rille.datasets.cameras.text import assignments, entries
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.sides import two_sides
from rille.datasets.text.tables import number
from rille.datasets.text.units import LENGTHS, unit_of, unitless
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens

SECTION = re.compile(r"^[ \t]*\[(\w{1,40})\]((?:.*\n(?![ \t]*\[))*.*)", re.MULTILINE)
ENTRY = re.compile(r"^[ \t]*(\w{1,40})[ \t]*=[ \t]*(\S+)", re.MULTILINE)
"""Of a ``.conf``: a section with its text, and one of its entries."""

MRPT_POSE = "_LEFT2RIGHT_POSE"
"""End of the name of MRPT's section with the pose of the right camera."""

ZED_SIZES = {
    "VGA": (672, 376),
    "SVGA": (960, 600),
    "HD": (1280, 720),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "2K": (2208, 1242),
    "QHDPLUS": (3200, 1800),
    "4K": (3840, 2160),
}
"""Pixels of the resolutions in a ``.conf``."""


def zed(text: str, path: Path) -> list[CalibratedCamera]:
    """Both cameras at each resolution. Lengths in the file are millimetres, here metres.

    ``Baseline``, TY and TZ are the translation of ``x_right = R x_left + (-Baseline, TY, TZ)``, RX, CV and RZ the
    rotation vector of R (``saveCalibZED`` of Stereolabs' calibration tool). With several resolutions each has its size;
    the size of a single one is that of the images.
    """
    parts = {
        name.upper(): entries(((k.lower(), v) for k, v in ENTRY.findall(body)), f"{path} {name}")
        for name, body in SECTION.findall(text)
    }
    names = [name.removeprefix("LEFT_CAM_") for name in parts if name.startswith("LEFT_CAM_")]
    stereo = Fields(parts.get("STEREO", {}), str(path), "STEREO ")
    cameras = []
    for name in names:
        size = ZED_SIZES.get(name, UNKNOWN_SIZE) if len(names) > 1 else UNKNOWN_SIZE
        # Newer files have one distortion for all resolutions.
        left, right = (
            _zed_lens(Fields(parts.get(f"{side}_DISTO", {}) | parts.get(at, {}), str(path), f"{at} "), size)
            for side, at in (("LEFT", f"LEFT_CAM_{name}"), ("RIGHT", f"RIGHT_CAM_{name}"))
        )
        rx, cv, rz, ty, tz = (
            stereo.number(f"{key}_{name.lower()}", stereo.number(key, 0.0)) for key in ("rx", "cv", "rz", "ty", "tz")
        )
        t = np.array([-stereo.number("baseline"), ty, tz]) / 1000
        pair = stereo_cameras(left, right, RigidTransform(rotation_exp([rx, cv, rz]), t))
        cameras += [replace(camera, name=f"{camera.name} {name}") for camera in pair]
    return cameras


def _zed_lens(f: Fields, size: tuple[int, int]) -> Lens:
    lens = f.optics("fx fy cx cy", size, "fisheye" if "k4" in f and "p1" not in f else "rational")
    f.check_lens()
    return lens


def mrpt(text: str, path: Path) -> list[CalibratedCamera]:
    """Both cameras of MRPT's ``TStereoCamera``, as of the Malaga data set.

    Sections are ``NAME_LEFT``, ``NAME_RIGHT`` and that of :data:`MRPT_POSE`, whose ``pose_quaternion``, x y z and the
    quaternion w x y z, is the pose of the right camera in the left one's frame, metres.
    """
    parts = {name: Fields.of_lines(assignments(body), str(path), f"{name} ") for name, body in SECTION.findall(text)}
    whole = next(name for name in parts if name.endswith(MRPT_POSE)).removesuffix(MRPT_POSE)
    names = (whole + end for end in (MRPT_POSE, "_LEFT", "_RIGHT"))
    pose, *sides = (parts.get(name) or Fields({}, str(path), f"{name} ") for name in names)
    left, right = (f.distorted("dist", f.optics("fx fy cx cy", f.size("resolution"), "none").camera) for f in sides)
    numbers = pose.numbers("pose_quaternion", 7)
    T_left_right = pose.by_quaternion("pose_quaternion", numbers[3:], numbers[:3])
    return stereo_cameras(left, right, T_left_right.inverse())


def depthai(f: Fields, path: Path) -> list[CalibratedCamera]:
    """The two cameras that the device rectifies for stereo, or at sockets B and C where the file does not name them.

    Lengths in the file are centimetres, here metres. ``extrinsics`` map a camera to the one at ``toCameraSocket``; 14
    coefficients are OpenCV's, the first four a fisheye's.
    """
    rows = f.get("cameraData")
    pairs = [row for row in rows if isinstance(row, list) and len(row) == 2] if isinstance(rows, list) else []
    sockets = Fields({str(socket): camera for socket, camera in pairs}, f.file, "cameraData ")
    stereo = f.sub("stereoRectificationData") if "stereoRectificationData" in f else Fields({}, f.file)
    sides = tuple(stereo.text(f"{side}CameraSocket", "-1") for side in ("left", "right"))
    if "-1" in sides:  # as of boards that rectify nothing
        sides = ("CAM_B", "CAM_C") if "CAM_B" in sockets else ("1", "2")
    left, right = (_depthai_lens(sockets.sub(side)) for side in sides)
    (root, T_root_left), (other, T_root_right) = (_to_root(sockets, side) for side in sides)
    if root != other:
        return [CalibratedCamera("left", left), CalibratedCamera("right", right)]
    return stereo_cameras(left, right, T_root_right.inverse() @ T_root_left)


def _depthai_lens(f: Fields) -> Lens:
    camera = f.pinhole("intrinsicMatrix", f.size("width", "height"))
    coefficients, kind = f.numbers("distortionCoeff"), f.text("cameraType", "0")
    if kind == "1" and not any(coefficients[4:]):
        return f.lens("distortionCoeff", camera, "fisheye", coefficients[:4])
    if kind != "0":
        raise f.error("RIL-815", "cameraType", f"= {kind} is not read", "0 (perspective) and 1 (fisheye) are")
    return f.lens("distortionCoeff", camera, *by_count(coefficients))


def _to_root(sockets: Fields, socket: str) -> tuple[str, RigidTransform]:
    """The camera at the root of all extrinsics, and T_root_socket in metres."""
    T, seen = RigidTransform.identity(), set[str]()
    while socket not in seen:
        seen.add(socket)
        e = sockets.sub(socket).sub("extrinsics")
        other = e.text("toCameraSocket")
        if other not in sockets:
            break
        shift = e.sub("translation")
        t = np.array([shift.number(axis) for axis in "xyz"]) / 100
        T, socket = e.rigid("rotationMatrix", e.matrix("rotationMatrix", 3, 3), t) @ T, other
    return socket, T


LISTED = re.compile(r'Intrinsic of[ \t]+"((?:Infrared|Fisheye) ([12]))".*\n((?:[ \t]*[A-Z]\w+[^:\n]*:.*\n?)+)')
RELATIVE = re.compile(
    r'from[ \t]+"(Infrared|Fisheye) 1"[ \t]+To[ \t]+"\1 2"[^-\d]*([-+.\de\s]+)Translation[^:]*:([^\n]*)'
)
"""Of a RealSense's list: a camera of the pair with its entries, and R and T of ``x_right = R x_left + T``, metres."""


def realsense(text: str, path: Path) -> list[CalibratedCamera]:
    """The infrared cameras at each resolution, or the fisheye ones, as ``rs-enumerate-devices -c`` prints them."""
    cameras = {}
    placed = RELATIVE.search(text)
    R, T = (part.split() for part in placed.groups()[1:]) if placed else (None, None)
    for name, camera_number, body in LISTED.findall(text):
        rows = ((key.lower(), value.split()) for key, value in re.findall(r"(\w+)[^:\n]*:(.*)", body))
        stated = {key: row if key == "coeffs" else " ".join(row) for key, row in rows}
        f = Fields({**stated, "R": R, "T": T}, str(path), f"{name} ")
        camera = f.optics("fx fy ppx ppy", f.size("width", "height"), "none").camera
        pose = RigidTransform.identity() if camera_number == "1" else f.transform("R", "T")
        lens = f.distorted("coeffs", camera)
        cameras[camera_number, camera.width, camera.height] = CalibratedCamera(name, lens, pose)
    return list(cameras.values())


def numbers_of_matrix(text: str) -> list[str]:
    """The nine numbers fx 0 cx, 0 fy cy, 0 0 1 of a text, and perhaps a tenth; empty for any other text."""
    words = re.sub(r"[\[\],;]", " ", text[:1000]).split()
    k = list(map(number, words[:9]))
    fits = len(words) in (9, 10) and k[0] > LEAST_FOCAL and k[1] == k[3] == k[6] == k[7] == 0 and k[8] == 1
    return words if fits else []


def matrix(text: str, path: Path) -> list[CalibratedCamera]:
    """Two equal parallel cameras of ``K.txt`` with K row by row and a baseline in metres; one camera if that lacks."""
    fx, _, cx, _, fy, cy, _, _, _, *baseline = numbers_of_matrix(text)
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "baseline": next(iter(baseline), None)}
    return figures(Fields(values, str(path)), path)


GROUP = re.compile(r"(in|ex)trinsics?|camera|stereo|rig|calibration")
"""Parts of a file of figures by key that have entries of their own."""


def _flat(f: Fields) -> Fields:
    """Entries with those of the parts ``intrinsic``, ``extrinsic``, ``camera`` and the like among them."""
    return f.with_parts({key: "" for key in f.values if GROUP.fullmatch(key)})


def _parts(f: Fields) -> list[Fields]:
    """Entries of the left and of the right camera, or those of the file, which are of one camera."""
    names = next(iter(two_sides(key for key, value in f.values.items() if isinstance(value, Mapping))), ())
    return [part for name in names if "fx" in (part := _flat(f.sub(name)))] or [_flat(f)]


def _centre(part: Fields) -> str:
    """Keys of the principal point: those of RealSense, of Cityscapes, or the usual ones."""
    return next((keys for keys in ("ppx ppy", "u0 v0") if keys.split()[0] in part), "cx cy")


def has_figures(f: Fields) -> bool:
    """Whether there are fx, fy, and the principal point of one camera, or of ``left`` and ``right``."""
    return all(key in part for part in _parts(f) for key in ("fx", "fy", _centre(part).split()[0]))


def figures(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of a file with a number for each key, as scripts write it (Cityscapes' ``camera.json``, too).

    ``x_right = R x_left + T``, metres; with ``baseline`` alone the cameras are parallel.
    """
    lenses, parts = [], _parts(f)
    for part in parts:
        listed = "coeffs" in part and "model" in part  # as RealSense's library states them
        lens = part.optics(f"fx fy {_centre(part)}", part.size("width", "height"), "none" if listed else "")
        lenses.append(part.distorted("coeffs", lens.camera) if listed else lens)
    rig = _flat(f)
    if "ppx" in parts[0] and len(rig.values.get("rotation") or ()) == 9:
        # librealsense's ``rs2_extrinsics`` lists its rotation column by column.
        rig.values["rotation"] = np.reshape(rig.values["rotation"], (3, 3)).T
    T_right_left = relative(rig)
    rig.check_turn()
    T_right_left = T_right_left or beside(rig)
    if T_right_left is not None:
        return stereo_cameras(lenses[0], lenses[-1], T_right_left)
    names = CAMERAS if lenses[1:] else [path.stem]
    return [CalibratedCamera(name, lens) for name, lens in zip(names, lenses, strict=True)]


def beside(f: Fields) -> RigidTransform | None:
    """T_right_left of parallel cameras by a ``baseline``, metres or the unit in its key; None if there is none."""
    keys = [key for key in f.values if unitless(key).lower() == "baseline" and key in f]
    return parallel(f.number(keys[0]) * LENGTHS.get(unit_of(keys[0]), f.unit)) if len(keys) == 1 else None


def middlebury(text: str, path: Path) -> list[CalibratedCamera]:
    """Both cameras; the file's baseline is in millimetres, here in metres."""
    f = Fields.of_lines(assignments(text), str(path))
    size = f.size("width", "height")
    left, right = (Lens(f.pinhole(key, size)) for key in ("cam0", "cam1"))
    f.check_lens()
    return stereo_cameras(left, right, parallel(f.number("baseline") / 1000))
