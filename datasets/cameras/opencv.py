"""Calibrations with the keys of OpenCV, which ROS uses too."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from rille.datasets.cameras.fields import Fields, flattened
from rille.datasets.cameras.model import CalibratedCamera
from rille.datasets.protocol import CAMERAS
from rille.datasets.text.sides import side_of
from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lens import Lens

KEY = re.compile(r"(?:(?:(left|right|l|r)|cam(?:era)?_?([01]))[._ ]?)?([a-z._ ]+?)[._ ]?(left|right|l|r|[012])?", re.I)
"""A key of one side, with the side before or after the name."""

NUMBERS = {"l": "1", "r": "2"}
"""Numbers of the sides, by their first letters."""

MATRIX = re.compile(r"m|k|cm|mtx|matrix|cam(era)?(matrix|mtx)|intrinsics?(matrix)?")
DISTORTION_OF_SIDE = re.compile(r"d|dist(ortion)?(coeff?s?|coefficients)?")
"""Names of camera matrix and distortion of one side, in small letters alone."""

SINGLE = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K")
DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")
MESSAGE = {"K": "camera_matrix", "D": "distortion_coefficients", "R": "rectification_matrix", "P": "projection_matrix"}
"""Fields of ROS' message camera_info (small letters in ROS 2), and keys of its files."""
WIDTHS = ("image_width", "image_Width", "width", "LEFT.width", "Camera.width")
HEIGHTS = ("image_height", "image_Height", "height", "LEFT.height", "Camera.height")
ROTATIONS, TRANSLATIONS = ("R", "rotation_matrix", "rotation"), ("T", "translation_vector", "translation")
WHOLE = "T_right_left"
POSE = (*ROTATIONS, *TRANSLATIONS, WHOLE)

OST = re.compile(r"^\[?([a-z][\w/ ]*)\]?[ \t]*\n((?:[ \t]*[-+.\d].*\n?|[ \t]*\n)*)", re.MULTILINE)
OST_KEYS = {
    "width": "image_width",
    "height": "image_height",
    "camera matrix": "camera_matrix",
    "distortion": "distortion_coefficients",
    "rectification": "rectification_matrix",
    "projection": "projection_matrix",
}
"""Of a text of ROS's camera_calibrator: a heading with the numbers below it; and the keys of the same in its YAML."""


def sides(f: Fields) -> list[tuple[str, str]]:
    """Keys of camera matrix and distortion of the left and of the right camera; empty if not both have a matrix."""
    found: dict[tuple[str, bool], str] = {}
    for key, value in f.values.items():
        parts = KEY.fullmatch(key)
        side = (parts[1] or parts[2] or parts[4] or "").lower() if parts else ""
        if parts is None or not side or flattened(value) is None:  # k1 may be a coefficient
            continue
        what = re.sub("[._ ]", "", parts[3]).lower()
        matrix = MATRIX.fullmatch(what) is not None
        if matrix or DISTORTION_OF_SIDE.fullmatch(what):
            found.setdefault((NUMBERS.get(side[0], side), matrix), key)
    both = ("0", "1") if ("0", True) in found else ("1", "2")
    whole = all((side, True) in found for side in both)
    return [(found[side, True], found.get((side, False), "distortion")) for side in both] if whole else []


def stereo(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Both cameras of OpenCV's stereo samples: M1 D1 M2 D2, R T with ``x_right = R x_left + T``.

    R, T and P1, P2 may be in ``extrinsics.yml`` beside ``intrinsics.yml``, as the sample program writes them. Files
    with LEFT.R and RIGHT.P (rectification, as in ORB-SLAM2) are read too.
    """
    keys = enumerate(sides(f), start=1)
    lenses = [f.distorted(distortion, f.pinhole(matrix, _size(f, str(k)))) for k, (matrix, distortion) in keys]
    poses: tuple[RigidTransform | None, RigidTransform | None] = None, None
    placed = f if f.has(*POSE) else _beside(path) or f
    if "RIGHT.P" in f and "LEFT.R" in f:
        poses = _unrectified(f, "LEFT.R", "LEFT.P"), _unrectified(f, "RIGHT.R", "RIGHT.P")
    elif placed.has(*POSE):
        poses = RigidTransform.identity(), relative(placed)
    elif all(key in placed for key in ("R1", "P1", "R2", "P2")):  # of stereoRectify
        poses = _unrectified(placed, "R1", "P1"), _unrectified(placed, "R2", "P2")
    found = [CalibratedCamera(name, lens, T) for name, lens, T in zip(("left", "right"), lenses, poses, strict=True)]
    projections = ("LEFT.P", "RIGHT.P") if "RIGHT.P" in f else ("P1", "P2")
    return [_with_rectified(camera, placed, projection) for camera, projection in zip(found, projections, strict=True)]


def by_side(f: Fields) -> Fields:
    """Entries with those of parts for each side among them (``left_K`` for K of ``left``), and of one for the rig."""
    parts = {key: f"{CAMERAS[at[1]]}_" for key in f.values if (at := side_of(key)) is not None}
    return f.with_parts(parts | dict.fromkeys(("extrinsics", "extrinsic", "stereo"), ""))


def stereo_by_side(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Both cameras of a file with camera matrix and distortion in a part for each side."""
    f.values = by_side(f).values
    return stereo(f, path)


def projections_alone(f: Fields) -> bool:
    """Whether these are P1 and P2 of OpenCV's ``stereoRectify`` without the rig before rectification."""
    return "P1" in f and "P2" in f and not f.has(*POSE)


def projections(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Both cameras of rectified images."""
    sides = [_projected(name, f, key, _size(f)) for name, key in (("left", "P1"), ("right", "P2"))]
    return [side for side in sides if side is not None]


def reprojection(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Both cameras of rectified images by ``Q`` of OpenCV's ``stereoRectify``, which maps disparities to points."""
    Q = f.matrix("Q", 4, 4)
    if not (Q[2, 3] > 0 and Q[3, 2]):
        raise f.error("RIL-678", "Q", f"has the focal length {Q[2, 3]:g} and the inverse baseline {Q[3, 2]:g}")
    across = -1.0 / Q[3, 2]
    for key, column, shift in (("P1", -Q[0, 3], 0.0), ("P2", -Q[0, 3] - Q[3, 3] * across, across)):
        f.values[key] = [Q[2, 3], 0.0, column, shift * Q[2, 3], 0.0, Q[2, 3], -Q[1, 3], 0.0, 0.0, 0.0, 1.0, 0.0]
    return projections(f, path)


def is_message(f: Fields) -> bool:
    """Whether these are the fields of ROS' message camera_info."""
    return "distortion_model" in f and any(all(key in f for key in keys) for keys in (MESSAGE, map(str.lower, MESSAGE)))


def message(f: Fields, path: Path) -> list[CalibratedCamera]:
    """One camera of ROS' message camera_info as ``topic echo`` prints it."""
    f.values = {MESSAGE.get(key.upper(), key): value for key, value in f.values.items()}
    return single(f, path)


def single(f: Fields, path: Path) -> list[CalibratedCamera]:
    """One camera of OpenCV's calibration sample, or of ROS' camera_info.

    The pose of the latter refers to the rectified left camera: ``x_rectified = R x_camera``, and P holds the baseline.
    """
    matrix, distortion, T = f.spelt(SINGLE), f.spelt(DISTORTION), None
    if "projection_matrix" in f and "rectification_matrix" in f:
        T = _unrectified(f, "rectification_matrix", "projection_matrix")
    name = f.text("camera_name", path.stem)
    lens = f.distorted(distortion, f.pinhole(matrix, _size(f)))
    whole = _with_rectified(CalibratedCamera(name, lens, T), f, "projection_matrix")
    rectified = whole.rectified and replace(whole.rectified, lens=_read_out(f, whole.rectified.lens))
    return [replace(whole, lens=_read_out(f, whole.lens), rectified=rectified)]


def ost(text: str, path: Path) -> list[CalibratedCamera]:
    """Cameras of ROS's camera_calibrator as it prints them (``ost.txt``, ``.ini``), one after the other."""
    cameras = []
    for part in text.split("[image]")[1:]:
        rows = {OST_KEYS.get(heading, heading): numbers.split() for heading, numbers in OST.findall(part)}
        entries = {key: row if row[1:] else row[0] for key, row in rows.items() if row}
        name = next((heading for heading, row in rows.items() if not row), path.stem)
        cameras += single(Fields({"camera_matrix": None, **entries, "camera_name": name}, f"{path} {name}"), path)
    return cameras


def _read_out(f: Fields, lens: Lens) -> Lens:
    """The lens of images that show a part of the sensor, or combine several of its pixels (ROS' roi and binning).

    ``sensor_msgs/msg/CameraInfo`` states the whole sensor's camera, the part in its pixels, and the binning.
    """
    x, y = (int(f.number(key, 1)) or 1 for key in ("binning_x", "binning_y"))
    roi = f.sub("roi") if "roi" in f else Fields({}, f.file)
    left, top, width, height = (int(roi.number(key, 0)) for key in ("x_offset", "y_offset", "width", "height"))
    whole = lens.camera
    size = max((width or whole.width) // x, 1), max((height or whole.height) // y, 1)
    # The centre of a combined pixel lies in the middle of those that it combines.
    centre = (whole.cx - left) / x + (0.5 / x - 0.5), (whole.cy - top) / y + (0.5 / y - 0.5)
    return replace(lens, camera=f.camera("roi", (whole.fx / x, whole.fy / y, *centre), size))


def _size(f: Fields, side: str = "") -> tuple[int, int]:
    """Width and height; ``side``: 1 left, 2 right; ``rille calibrate`` writes both sizes if they differ."""
    for key in (f"image_size{side}", "image_size", "imageSize", "resolution"):
        if key in f:
            return f.size(key)
    return f.size(f.spelt(WIDTHS), f.spelt(HEIGHTS))


def relative(f: Fields) -> RigidTransform | None:
    """T_right_left, metres, stated as such or by R and T; None if there is none."""
    if not f.has(*POSE):
        return None
    T = f.pose(WHOLE) if WHOLE in f else f.transform(f.spelt(ROTATIONS), f.spelt(TRANSLATIONS))
    return RigidTransform(T.rotation, T.translation * f.unit)


def _beside(path: Path) -> Fields | None:
    """Entries of ``extrinsics.yml`` beside ``intrinsics.yml``."""
    if "intrinsic" not in path.name:
        return None
    other = path.with_name(path.name.replace("intrinsic", "extrinsic"))
    return Fields.read(other) if other.is_file() else None


def _with_rectified(raw: CalibratedCamera, f: Fields, projection: str) -> CalibratedCamera:
    """The camera with that of its rectified images, if the file has one."""
    size = raw.lens.camera.width, raw.lens.camera.height
    return replace(raw, rectified=_projected(raw.name, f, projection, size)) if projection in f else raw


def _projected(name: str, f: Fields, projection: str, size: tuple[int, int]) -> CalibratedCamera | None:
    """A camera of rectified images, with the axes of the rectified left camera; None if P is empty."""
    P = f.matrix(projection, 3, 4)
    if not P[0, 0] > 0:
        return None
    camera = f.camera(projection, (P[0, 0], P[1, 1], P[0, 2], P[1, 2]), size)
    return CalibratedCamera(name, Lens(camera), _baseline(P))


def _baseline(P: Floats) -> RigidTransform:
    """T_camera_left of a rectified camera."""
    # sensor_msgs/msg/CameraInfo: P[0, 3] is -fx' times the baseline, fx' = P[0, 0], and 0 of the left camera.
    return RigidTransform(np.eye(3), np.array([P[0, 3] / P[0, 0], P[1, 3] / P[0, 0], 0.0]))


def _unrectified(f: Fields, rotation: str, projection: str) -> RigidTransform:
    """T_camera_reference; the reference is the rectified left camera."""
    R, P = f.matrix(rotation, 3, 3), f.matrix(projection, 3, 4)
    if not P[0, 0] > 0:
        raise f.error("RIL-125", projection, f"has the focal length {P[0, 0]:g}")
    return f.rigid(rotation, R, np.zeros(3)).inverse() @ _baseline(P)
