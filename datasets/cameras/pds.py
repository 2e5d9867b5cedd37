"""Cameras in PDS3 and VICAR labels (``GEOMETRIC_CAMERA_MODEL``), and in texts of their vectors: CAHV, CAHVOR, CAHVORE.

Components 1 to 7 are C, A, H, V, O, R and E; 8 is the type of a CAHVORE (1 perspective, 2 fisheye, 3 general) and 9 the
linearity of type 3. Pixels count from 0 at the centre of the first one. The label may stand before the image in one
file. Source: PDS3 data dictionary, ``GEOMETRIC_CAMERA_MODEL`` and ``MODEL_COMPONENT_1`` to ``_9``.

JPL's programs write the vectors as a text (``.cahv``, ``.cahvor``, ``.cahvore``): ``Model = CAHVOR = ...``, or
``CAHVORE3,0.5`` with type and linearity; ``Dimensions = WIDTH HEIGHT``; and a line for each vector, ``C = X Y Z``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import CalibratedCamera
from rille.datasets.text.reading import SMALL, open_regular
from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.lens import Lens

BEGINS = (b"PDS_VERSION_ID", b"ODL_VERSION_ID", b"CCSD3ZF", b"LBLSIZE=")
END = re.compile(r"^END[ \t\r]*$", re.MULTILINE)
GROUP = re.compile(r"^[ \t]*(?:GROUP|OBJECT)[ \t]*=[ \t]*\"?GEOMETRIC_CAMERA_MODEL[A-Z_]*\"?[ \t\r]*$", re.MULTILINE)
GROUP_END = re.compile(r"^[ \t]*END_(?:GROUP|OBJECT)\b", re.MULTILINE)
PROPERTY = re.compile(r"\bPROPERTY='GEOMETRIC_CAMERA_MODEL[A-Z_]*'")
PROPERTY_END = re.compile(r"\b(?:PROPERTY|TASK)='")
# Repeats are bounded, here and below, so that the time for a hostile label is linear in its length.
COMPONENT = re.compile(r"\bMODEL_COMPONENT_([1-9])\s*=\s*(\([^()]{0,400}\)|[^\s(),]{1,60})")
TYPE = re.compile(r"\bMODEL_TYPE\s*=\s*[\"']?([A-Z]{1,20})\b")
UNIT = re.compile(r"<[^<>]{0,40}>")
TEXT = re.compile(r"^[ \t]*Model[ \t]*=[ \t]*(CAHV[A-Z]{0,20})(?:(\d),([-+.\deE]{1,60}))?", re.MULTILINE)
VECTOR = re.compile(r"^[ \t]*([CAHVORE]|Dimensions)[ \t]*=(.{0,400})$", re.MULTILINE)
"""Of a text of vectors: the model with its type and linearity, and a vector or the size of the images."""

MODELS = ("CAHV", "CAHVOR", "CAHVORE")


def attached(path: Path) -> str:
    """The label at the beginning of an image file; empty if it has none."""
    # 2**31 bytes: images with a label are large.
    with open_regular(path, "calibration", 2**31) as file:
        start = file.read(16)
        if not start.startswith(BEGINS):
            return ""
        # latin-1 decodes any byte, since the image follows the label.
        text = (start + file.read(SMALL)).decode("latin-1")
    if text.startswith("LBLSIZE="):
        size = re.match(r"LBLSIZE=(\d{1,7})\b", text)
        return text[: int(size[1])] if size is not None else ""
    end = END.search(text)
    return text if end is None else text[: end.start()]


def is_label(text: str) -> bool:
    """Whether this is the text of a label with a camera, or of the vectors of one."""
    return bool(_model(text) or TEXT.search(text))


def label(text: str, path: Path) -> list[CalibratedCamera]:
    """The camera, named by its file; its pose refers to the label's frame. The lens is that of far points.

    A label does not state the image size.
    """
    f = _entries(text, path)
    kind = f.text("MODEL_TYPE")
    if kind not in MODELS:
        raise f.error("RIL-952", "MODEL_TYPE", f"= {kind} is not read", f"{', '.join(MODELS)} are")
    camera, axes, skew = _pinhole(f)
    T_camera_reference = f.rigid("MODEL_COMPONENT_2", axes, -axes @ f.numbers("MODEL_COMPONENT_1", 3))
    axis, linearity = axes[2], 1.0
    radial: tuple[float, ...] = (0.0, 0.0, 0.0)
    if kind != "CAHV":
        axis, radial = _unit(f, "MODEL_COMPONENT_5"), f.numbers("MODEL_COMPONENT_6", 3)
    if kind == "CAHVORE":
        f.numbers("MODEL_COMPONENT_7", 3)  # of near points alone
        linearity = _linearity(f)
    # 1e-6 of the focal length: below, columns and rows are perpendicular.
    if not any(radial) and linearity == 1.0 and abs(skew) <= 1e-6 * camera.fy:
        lens = Lens(camera)
    else:
        terms = (skew, *map(float, axes @ axis), *radial, linearity)
        lens = f.lens("MODEL_COMPONENT_5", camera, "cahvore", terms)
    return [CalibratedCamera(path.stem, lens, T_camera_reference)]


def _pinhole(f: Fields) -> tuple[Camera, Floats, float]:
    """Camera by A, H and V, its axes x, y, z as rows, and its skew, px: z is A, and x the part of H across A."""
    a = _unit(f, "MODEL_COMPONENT_2")
    h, v = (np.array(f.numbers(f"MODEL_COMPONENT_{k}", 3)) for k in (3, 4))
    cx, cy = float(h @ a), float(v @ a)
    fx = float(np.linalg.norm(h - cx * a))
    if fx <= 1e-6 * abs(cx):
        raise f.error("RIL-957", "MODEL_COMPONENT_3", "is along the axis: the columns have no direction")
    # H = fx x + cx A and V = fy y + cy A, of axes x, y, A (Yakimovsky and Cunningham 1978).
    x = (h - cx * a) / fx
    y = np.cross(a, x)
    skew, fy = float(v @ x), float(v @ y)
    if fy < 0:
        raise f.error("RIL-953", "MODEL_COMPONENT_4", "mirrors the image", "give a model without mirroring")
    return f.camera("MODEL_COMPONENT_3", (fx, fy, cx, cy), f.size("Dimensions")), np.array([x, y, a]), skew


def _model(text: str) -> str:
    """Text of the first camera model of a label; empty if it has none."""
    for opens, closes in ((GROUP, GROUP_END), (PROPERTY, PROPERTY_END)):
        if begin := opens.search(text):
            return closes.split(text[begin.end() :], maxsplit=1)[0]
    return ""


def _entries(text: str, path: Path) -> Fields:
    """The first camera model of a label, or that of a text of vectors: its type and components."""
    part = UNIT.sub(" ", _model(text))
    if not part and (model := TEXT.search(text)):
        kind, type_, linearity = model.groups()
        lines = Fields({name: numbers.split() for name, numbers in VECTOR.findall(text)}, str(path))
        # The name of a model spells its vectors.
        vectors = {f"MODEL_COMPONENT_{k}": lines.numbers(v, 3) for k, v in enumerate("CAHVORE", start=1) if v in kind}
        values = vectors | {"MODEL_TYPE": kind, "MODEL_COMPONENT_8": type_, "MODEL_COMPONENT_9": linearity}
        return Fields({**values, "Dimensions": lines.values.get("Dimensions")}, str(path))
    values = dict[str, Any]()
    for number, value in COMPONENT.findall(part):
        words = value.strip("()").replace(",", " ").split()
        values.setdefault(f"MODEL_COMPONENT_{number}", words if len(words) > 1 else words[0] if words else None)
    kind = TYPE.search(part)
    if kind is not None:
        values["MODEL_TYPE"] = kind[1]
    return Fields(values, str(path), "GEOMETRIC_CAMERA_MODEL.")


def _unit(f: Fields, key: str) -> Floats:
    vector = np.array(f.numbers(key, 3))
    length = float(np.linalg.norm(vector))
    # 1e-3: largest error of A and O by the digits of the label.
    if not abs(length - 1.0) < 1e-3:
        raise f.error("RIL-954", key, f"has the length {length:.6g}, it should be a unit vector")
    return np.asarray(vector / length)


def _linearity(f: Fields) -> float:
    kind = f.number("MODEL_COMPONENT_8")
    if kind not in (1, 2, 3):
        raise f.error("RIL-955", "MODEL_COMPONENT_8", f"= {kind:g} is no type of CAHVORE", "1, 2 or 3")
    if kind < 3:
        # Type 1 (perspective) is a linearity of 1, type 2 (fisheye) of 0.
        return 2.0 - kind
    linearity = f.number("MODEL_COMPONENT_9")
    if not -1.0 <= linearity <= 1.0:
        raise f.error("RIL-956", "MODEL_COMPONENT_9", f"= {linearity:g} is no linearity", "-1 to 1")
    return linearity
