"""Calibrations of visual-inertial programs: Kalibr's camchain, EuRoC's sensor.yaml, ORB-SLAM's settings."""

from __future__ import annotations

import re
from pathlib import Path

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import CalibratedCamera, parallel, stereo_cameras
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lens import Lens

CAMERA = re.compile(r"cam(\d+)")


def is_kalibr(f: Fields) -> bool:
    """Whether there is a ``cam0`` with entries of its own."""
    return any(CAMERA.fullmatch(key) and isinstance(f.values[key], dict) for key in f.values)


def kalibr(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras of a chain: ``T_cn_cnm1`` maps camera n - 1 to camera n; else all ``T_cam_imu``. Lengths are metres."""
    names = sorted((key for key in f.values if CAMERA.fullmatch(key)), key=lambda key: int(key[3:]))
    parts = [f.sub(name) for name in names]
    poses: list[RigidTransform | None] = [None] * len(parts)
    if len(parts) > 1 and all("T_cn_cnm1" in part for part in parts[1:]):
        poses = [RigidTransform.identity()]
        for part in parts[1:]:
            # Each camera is stated from the one before, so that poses multiply along the chain.
            poses.append(part.pose("T_cn_cnm1") @ (poses[-1] or RigidTransform.identity()))
    elif all("T_cam_imu" in part for part in parts):
        poses = [part.pose("T_cam_imu") for part in parts]
    return [
        CalibratedCamera(name, _pinhole_lens(part, "distortion_coeffs"), T)
        for name, part, T in zip(names, parts, poses, strict=True)
    ]


def is_sensor(f: Fields) -> bool:
    """Whether these are the entries of one EuRoC camera."""
    return "intrinsics" in f and ("T_BS" in f or "distortion_coefficients" in f)


def sensor(f: Fields, path: Path) -> list[CalibratedCamera]:
    """The camera of a ``sensor.yaml``: ``T_BS`` maps the sensor to the body, metres; it is named by its folder."""
    T = f.pose("T_BS").inverse() if "T_BS" in f else None
    name = path.parent.name if path.stem == "sensor" and path.parent.name else path.stem
    return [CalibratedCamera(name, _pinhole_lens(f, "distortion_coefficients"), T)]


def _pinhole_lens(f: Fields, distortion: str) -> Lens:
    kind = f.text("camera_model", "pinhole")
    if kind.lower() != "pinhole":
        raise f.error(
            "RIL-135", "camera_model", f"= {kind!r} is not read", "calibrate as pinhole with radtan or equidistant"
        )
    fx, fy, cx, cy = f.numbers("intrinsics", 4)
    camera = f.camera("intrinsics", (fx, fy, cx, cy), f.pair_of_pixels("resolution"))
    coefficients = f.numbers(distortion) if distortion in f else ()
    model = f.model("distortion_model", "radtan" if coefficients else "none")
    return f.lens(distortion, camera, model, () if model == "none" else coefficients)


def is_orbslam(f: Fields) -> bool:
    """Whether these are settings of ORB-SLAM 2 or 3."""
    return "Camera.fx" in f or "Camera1.fx" in f


def orbslam(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Camera or cameras of ORB-SLAM's settings.

    Version 2: both cameras alike and parallel, ``Camera.bf`` = baseline times fx; its sign is ignored. Version 3:
    ``Camera1``, ``Camera2`` and ``Stereo.T_c1_c2``, or ``Stereo.b`` of rectified images. Lengths are metres.
    """
    first = "Camera1" if "Camera1.fx" in f else "Camera"
    size = f.size("Camera.width", "Camera.height")
    left = _orbslam_lens(f, first, size)
    if "Stereo.T_c1_c2" in f:
        right = _orbslam_lens(f, "Camera2" if "Camera2.fx" in f else first, size)
        return stereo_cameras(left, right, f.pose("Stereo.T_c1_c2").inverse())
    if "Stereo.b" in f or "Camera.bf" in f:
        baseline = f.number("Stereo.b") if "Stereo.b" in f else f.number("Camera.bf") / left.camera.fx
        return stereo_cameras(left, left, parallel(abs(baseline)))
    return [CalibratedCamera(path.stem, left)]


def _orbslam_lens(f: Fields, name: str, size: tuple[int, int]) -> Lens:
    values = [f.number(f"{name}.{key}") for key in ("fx", "fy", "cx", "cy")]
    camera = f.camera(f"{name}.fx", (values[0], values[1], values[2], values[3]), size)
    if f.text("Camera.type", "").lower() == "kannalabrandt8":
        keys = [f"{name}.k{n}" for n in (1, 2, 3, 4)]
        return f.lens(keys[0], camera, "fisheye", tuple(f.number(key) for key in keys))
    keys = [f"{name}.{key}" for key in ("k1", "k2", "p1", "p2", "k3")]
    if not any(key in f for key in keys):
        return Lens(camera)
    coefficients = tuple(f.number(key, 0.0) for key in keys)
    return f.lens(keys[0], camera, "radtan", coefficients if coefficients[4] else coefficients[:4])
