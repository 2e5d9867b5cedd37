"""Cameras of COLMAP's text models (``cameras.txt``, with ``rigs.txt`` beside it).

Its pixel coordinates begin at the corner of the top left pixel, so half a pixel is subtracted.
"""

from __future__ import annotations

from pathlib import Path

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import CalibratedCamera
from rille.datasets.text.reading import read_text
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lens import COEFFICIENTS

MODELS = {
    "SIMPLE_PINHOLE": ("f cx cy", "none"),
    "PINHOLE": ("fx fy cx cy", "none"),
    "SIMPLE_RADIAL": ("f cx cy k1", "radtan"),
    "RADIAL": ("f cx cy k1 k2", "radtan"),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", "radtan"),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "rational"),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", "fisheye"),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", "fisheye"),
}
"""Supported camera models: the order of their parameters, and the lens (:mod:`rille.stages.geometry.lens`)."""


def is_colmap(text: str) -> bool:
    """Whether every line is a camera (or a comment)."""
    lines = _lines(text)
    return bool(lines) and all(
        len(words) >= 5 and words[0].isdigit() and words[1].isupper() and words[2].isdigit() for words in lines
    )


def colmap(text: str, path: Path) -> list[CalibratedCamera]:
    """Cameras, named by their numbers; with poses in the rig's frame if ``rigs.txt`` has exactly one rig."""
    poses = _rig(path.with_name("rigs.txt"))
    cameras = []
    for number, model, width, height, *values in _lines(text):
        f = Fields({}, str(path), f"camera {number} ")
        if model not in MODELS:
            raise f.error("RIL-108", "model", f"{model} is not read", f"one of {', '.join(MODELS)}")
        names, lens = MODELS[model][0].split(), MODELS[model][1]
        if len(values) != len(names):
            count = f"are {len(values)}, {model} takes {len(names)}: {' '.join(names)}"
            raise f.error("RIL-109", "parameters", count)
        zeros = dict.fromkeys(COEFFICIENTS[lens], "0")
        stated = dict(zip(names, values, strict=True)) | {"width": width, "height": height}
        f = Fields(zeros | stated, str(path), f.at)
        pinhole = "f f cx cy" if "f" in f else "fx fy cx cy"
        optics = f.optics(pinhole, f.size("width", "height"), lens, corner=0.5)
        cameras.append(CalibratedCamera(number, optics, poses.get(number)))
    return cameras


def _rig(path: Path) -> dict[str, RigidTransform]:
    """T_camera_rig by camera number; empty if there is no rig, or more than one."""
    lines = _lines(read_text(path, "rigs")) if path.is_file() else []
    if len(lines) != 1 or len(lines[0]) < 4 or lines[0][2] != "CAMERA":
        return {}
    # RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID, then of each other sensor TYPE ID HAS_POSE [QW QX QY QZ TX TY
    # TZ], which maps the rig's frame to the sensor's (colmap.github.io/format).
    _, _, _, reference, *rest = lines[0]
    poses = {reference: RigidTransform.identity()}
    while len(rest) >= 3:
        kind, number, known, *rest = rest
        if known == "0":
            continue
        f = Fields({"pose": rest[:7]}, str(path), f"sensor {number} ")
        wxyz = f.numbers("pose", 7)
        rest = rest[7:]
        if kind == "CAMERA":
            poses[number] = f.by_quaternion("pose", wxyz[:4], wxyz[4:])
    return poses


def _lines(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
