"""Calibrations of programs of robotics: Kalibr, OKVIS, SVO, EuRoC's sensor.yaml, ORB-SLAM, camodocal, VINS, Basalt,
mrcal, DSO."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from rille.datasets.cameras.fields import Fields, by_count, flattened
from rille.datasets.cameras.model import CalibratedCamera, parallel, stereo_cameras
from rille.datasets.text.order import natural
from rille.datasets.text.reading import read_text
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lens import Lens

BODY_CAMERA = ("T_imu_cam", "T_BS", "T_SC", "T_BC", "T_B_C", "T_b")
"""Keys of the pose of a camera in the frame of the body or of another sensor: of OpenVINS, EuRoC, OKVIS, VBR."""

DISTORTION = ("distortion_coeffs", "distortion_coefficients", "distortion_parameters")
"""Keys of the coefficients of Kalibr, of OKVIS, and of SVO."""

BASALT: Mapping[str, str] = {"pinhole": "none", "kb4": "fisheye", "pinhole-radtan8": "rational"}
"""Types of cameras of Basalt: model of :mod:`rille.stages.geometry.lens`."""

CAMODOCAL: Mapping[str, tuple[str, str, str]] = {
    "PINHOLE": ("fx fy cx cy", "radtan", "k1 k2 p1 p2"),
    "PINHOLE_FULL": ("fx fy cx cy", "rational", "k1 k2 p1 p2 k3 k4 k5 k6"),
    "KANNALA_BRANDT": ("mu mv u0 v0", "fisheye", "k2 k3 k4 k5"),
    "MEI": ("gamma1 gamma2 u0 v0", "radtan", "k1 k2 p1 p2"),
}
"""Models of camodocal: keys of the pinhole part, model of :mod:`rille.stages.geometry.lens`, keys of its coefficients.
"""

MRCAL = re.compile(r"'(\w+)'[ \t]*:[ \t]*(?:'(\w+)'|\[([^][]*)\])")
"""An entry of mrcal's: a name, or a list."""


def chain(f: Fields) -> list[str]:
    """Names of parts that are cameras, by their names or by optics in four numbers, in natural order."""
    parts = ((key, value) for key, value in f.values.items() if isinstance(value, Mapping))
    listed = (k for k, of in parts if re.fullmatch(r"cam\d+", k) or len(flattened(of.get("intrinsics")) or ()) == 4)
    return sorted(listed, key=natural)


def kalibr(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of a chain: ``T_cn_cnm1`` maps camera n - 1 to camera n, metres.

    If not all have it, poses are those against the IMU or the body, by ``T_cam_imu`` or one of :data:`BODY_CAMERA`.
    """
    names = chain(f)
    parts = [f.sub(name) for name in names]
    whole = len(parts) > 1 and all("T_cn_cnm1" in part for part in parts[1:])
    poses = [RigidTransform.identity() if whole else _of_body(parts[0])]
    for part in parts[1:]:
        T, before = (None if whole else _of_body(part)), poses[-1]
        # Each pose is relative to the camera before, so that poses multiply along the chain.
        poses.append(part.pose("T_cn_cnm1") @ before if T is None and before and "T_cn_cnm1" in part else T)
    for part, T in zip(parts, poses, strict=True):
        if T is None:
            part.check_turn()
    return [
        CalibratedCamera(name, _pinhole_lens(part, part.spelt(DISTORTION)), T)
        for name, part, T in zip(names, parts, poses, strict=True)
    ]


def camera_list(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of OKVIS, or of maplab, ROVIO and SVO, whose optics are a part ``camera`` with a part ``distortion``.

    Empty if the list holds anything else.
    """
    parts = dict[str, dict[str, object]]()
    for k, one in enumerate(f.get("cameras")):
        if not isinstance(one, Mapping) or not {"camera", "focal_length"} & one.keys():
            return []
        whole = Fields(one, f.file).with_parts({"camera": ""}).with_parts({"distortion": "distortion_"})
        apart = whole.values.pop("focal_length", []), whole.values.pop("principal_point", [])
        parts[f"cam{k}"] = {"intrinsics": [*apart], **whole.values}
    f.values = f.values | parts
    return kalibr(f, path) if parts else []


def _of_body(part: Fields) -> RigidTransform | None:
    if "T_cam_imu" in part:
        return part.pose("T_cam_imu")
    return part.pose(key).inverse() if (key := part.spelt(BODY_CAMERA)) in part else None


def camodocal(f: Fields, path: Path) -> list[CalibratedCamera]:
    """The camera; ``extrinsicRotation`` and ``extrinsicTranslation`` map it to the body (VINS-Mono), metres."""
    kind = f.text("model_type").upper()
    # With xi = 0 Mei's unified model is a pinhole camera.
    xi = f.sub("mirror_parameters").number("xi") if kind == "MEI" else 0.0
    if kind not in CAMODOCAL or xi:
        text = f"= {kind} (xi = {xi:g}) is not read" if xi else f"= {kind} is not read"
        raise f.error("RIL-814", "model_type", text, "calibrate as PINHOLE or KANNALA_BRANDT")
    pinhole, model, coefficients = CAMODOCAL[kind]
    p = f.sub("projection_parameters")
    d = p if kind == "KANNALA_BRANDT" else f.sub("distortion_parameters")
    camera = p.optics(pinhole, f.size("image_width", "image_height"), "none").camera
    lens = d.lens(coefficients, camera, model, tuple(d.number(key) for key in coefficients.split()))
    T = f.transform("extrinsicRotation", "extrinsicTranslation").inverse() if "extrinsicRotation" in f else None
    return [CalibratedCamera(path.stem, lens, T)]


def vins(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of the files named by ``cam0_calib`` ...; ``body_T_cam0`` ... map each to the body, metres."""
    cameras = []
    for name in sorted(key[:4] for key in f.values if re.fullmatch(r"cam\d_calib", key)):
        other = path.parent / f.text(f"{name}_calib")
        part = Fields.read(other)
        T = f.pose(f"body_T_{name}").inverse() if f"body_T_{name}" in f else None
        cameras += [replace(camera, name=name, T_camera_reference=T) for camera in camodocal(part, other)]
        part.check_lens()
    return cameras


def basalt(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of Basalt's JSON: ``T_imu_cam`` maps each camera to the IMU by a quaternion, metres."""
    f = f.sub("value0")
    cameras, poses, sizes = (
        Fields(dict(enumerate(f.get(key))), f.file, f"{f.at}{key}.", f.used)
        for key in ("intrinsics", "T_imu_cam", "resolution")
    )
    found = []
    for k in cameras.values:
        camera, pose = cameras.sub(k), poses.sub(k)
        kind, q = camera.text("camera_type"), [pose.number(f"q{axis}") for axis in "wxyz"]
        if kind not in BASALT:
            raise camera.error("RIL-768", "camera_type", f"= {kind} is not read", f"calibrate as {' or '.join(BASALT)}")
        lens = camera.sub("intrinsics").optics("fx fy cx cy", sizes.size(k), BASALT[kind])
        T = pose.by_quaternion("qx, qy, qz, qw", q, [pose.number(f"p{axis}") for axis in "xyz"])
        found.append(CalibratedCamera(f"cam{k}", lens, T.inverse()))
    return found


def dsec(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of DSEC's ``cam_to_cam.yaml``: ``T_10`` maps camera 0 to camera 1, metres, and so on, and ``R_rect1``
    camera 1 to that of its rectified images, ``camRect1``."""
    stated, placed, found = f.sub("intrinsics"), f.sub("extrinsics"), list[CalibratedCamera]()
    T = RigidTransform.identity()
    for k in range(len([key for key in stated.values if re.fullmatch(r"cam\d", key)])):
        T = placed.pose(f"T_{k}{k - 1}") @ T if k else T
        turn = placed.rigid(f"R_rect{k}", placed.matrix(f"R_rect{k}", 3, 3), np.zeros(3))
        raw, ideal = (_pinhole_lens(stated.sub(f"{name}{k}"), "distortion_coeffs") for name in ("cam", "camRect"))
        rectified = CalibratedCamera(f"cam{k}", ideal, turn @ T)
        found.append(CalibratedCamera(f"cam{k}", raw, T, rectified))
    return found


DSO = re.compile(
    r"^(Pinhole|RadTan|EquiDistant|KannalaBrandt)((?:[ \t]+[-+.\deE]{1,40}){5,8})\s*^(\d+)[ \t]+(\d+)", re.M
)
"""Beginning of a calibration of DSO and 4Seasons: model with fx, fy, cx, cy and coefficients; width and height."""


def dso(text: str, path: Path) -> list[CalibratedCamera]:
    """The camera of ``calib_0.txt`` or ``calib_1.txt``; ``calib_stereo.txt`` beside them has T_right_left, metres."""
    model, numbers, *size = DSO.findall(text)[0]
    stated = {"intrinsics": numbers.split()[:4], "distortion_coeffs": numbers.split()[4:], "resolution": size}
    f = Fields(stated, str(path))
    bent = any(f.numbers("distortion_coeffs"))
    f.values |= {"distortion_model": model} if bent else {"distortion_coeffs": []}
    stereo, T = path.with_name(re.sub(r"_[01]\.", "_stereo.", path.name)), None
    if stereo != path and stereo.is_file():
        rig = Fields({"T_right_left": read_text(stereo, "calibration").split()}, str(stereo))
        T = rig.pose("T_right_left") if "_1." in path.name else RigidTransform.identity()
    return [CalibratedCamera(path.stem, _pinhole_lens(f, "distortion_coeffs"), T)]


def mrcal(text: str, path: Path) -> list[CalibratedCamera]:
    """The camera of a ``.cameramodel``; ``extrinsics``: rotation vector and t, x_camera = R x_reference + t, metres."""
    f = Fields({key: word or row.replace(",", " ").split() for key, word, row in MRCAL.findall(text)}, str(path))
    kind = f.text("lensmodel")
    if not re.fullmatch(r"LENSMODEL_(PINHOLE|OPENCV\d+)", kind):
        raise f.error("RIL-769", "lensmodel", f"= {kind} is not read", "mrcal-convert-lensmodel LENSMODEL_OPENCV8 FILE")
    fx, fy, cx, cy, *coefficients = f.numbers("intrinsics")
    camera = f.camera("intrinsics", (fx, fy, cx, cy), f.size("imagersize"))
    rt = np.array(f.numbers("extrinsics", 6))
    lens = f.lens("intrinsics", camera, *by_count(tuple(coefficients)))
    return [CalibratedCamera(path.stem, lens, f.rigid("extrinsics", rotation_exp(rt[:3]), rt[3:]))]


def sensor(f: Fields, path: Path) -> list[CalibratedCamera]:
    """The camera of a ``sensor.yaml``: ``T_BS`` maps the sensor to the body, metres; it is named by its folder."""
    T = f.pose("T_BS").inverse() if "T_BS" in f else None
    name = path.parent.name if path.stem == "sensor" and path.parent.name else path.stem
    return [CalibratedCamera(name, _pinhole_lens(f, "distortion_coefficients"), T)]


def _pinhole_lens(f: Fields, distortion: str) -> Lens:
    kind = f.text("camera_model", "pinhole")
    if kind.lower() != "pinhole":
        remedy = "calibrate as pinhole with radtan or equidistant"
        raise f.error("RIL-135", "camera_model", f"= {kind!r} is not read", remedy)
    key = f.spelt(("intrinsics", "camera_matrix"))  # the latter of DSEC
    fx, fy, cx, cy = f.numbers(key, 4)
    if "sensor_type" in f and "resolution" not in f:
        fy, cx = cx, fy  # OpenLORIS lists fx, cx, fy, cy
    whole, sides = f.spelt(("resolution", "image_dimension")), (("width", "image_width"), ("height", "image_height"))
    size = f.size(whole) if whole in f else f.size(*map(f.spelt, sides))
    return f.distorted(distortion, f.camera(key, (fx, fy, cx, cy), size))


def orbslam(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Camera or cameras of ORB-SLAM's settings.

    Version 2, and stella_vslam: equal parallel cameras, ``Camera.bf`` = baseline times fx; its sign is ignored. Version
    3: ``Camera1``, ``Camera2`` and ``Stereo.T_c1_c2``, or ``Stereo.b`` of rectified images. Lengths are metres.
    """
    f = f.with_parts({"Camera": "Camera."})
    first = "Camera1" if "Camera1.fx" in f else "Camera"
    size = f.size(*(("Camera.cols", "Camera.rows") if "Camera.cols" in f else ("Camera.width", "Camera.height")))
    left = f.optics("fx fy cx cy", size, prefix=f"{first}.")
    if "Stereo.T_c1_c2" in f:
        right = f.optics("fx fy cx cy", size, prefix="Camera2." if "Camera2.fx" in f else f"{first}.")
        return stereo_cameras(left, right, f.pose("Stereo.T_c1_c2").inverse())
    product = f.spelt(("Camera.bf", "Camera.focal_x_baseline"))
    if "Stereo.b" in f or product in f:
        baseline = f.number("Stereo.b") if "Stereo.b" in f else f.number(product) / left.camera.fx
        return stereo_cameras(left, left, parallel(abs(baseline)))
    return [CalibratedCamera(path.stem, left)]
