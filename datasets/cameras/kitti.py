"""KITTI's calibration text: a label and numbers a line.

Odometry has ``P0 ... P3``, the raw recordings ``P_rect_00 ... P_rect_03`` beside the cameras before rectification
(``K_00``, ``D_00``, ``R_00``, ``T_00``), the older Karlsruhe sequences ``P1_roi`` and ``P2_roi``. Projections
P = K [R | t] are those of the rectified images, and are taken where the file has them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from datasets.cameras.fields import Fields
from datasets.cameras.model import UNKNOWN_SIZE, CalibratedCamera
from stages.core.errors import InputError
from stages.geometry.geometry import RigidTransform, orthonormal
from stages.geometry.lens import Lens

PROJECTION = re.compile(r"P(\d)(?:_roi)?|P_rect_(\d\d)")
LINE = re.compile(r"^[ \t]*(P\d(?:_roi)?|P_rect_\d\d|K_\d\d)[ \t]*:", re.MULTILINE)
RAW = re.compile(r"K_(\d\d)")


def is_kitti(text: str) -> bool:
    """Whether a line has the label of a projection or of a raw camera."""
    return LINE.search(text[:100_000]) is not None


def kitti(text: str, path: Path) -> list[CalibratedCamera]:
    """All cameras of the file, by the labels of their projections (or of K), in order."""
    lines = (line.partition(":") for line in text.splitlines())
    fields = Fields({label.strip(): numbers.split() for label, _, numbers in lines if numbers.strip()}, str(path))
    labels = sorted(label for label in fields.values if PROJECTION.fullmatch(label))
    if any(label.endswith("_roi") for label in labels):  # of the part that the images show
        labels = [label for label in labels if label.endswith("_roi")]
    if labels:
        return [_rectified(fields, label) for label in labels]
    return [_raw(fields, label, label[-2:]) for label in sorted(fields.values) if RAW.fullmatch(label)]


def _rectified(fields: Fields, label: str) -> CalibratedCamera:
    from datasets.kitti import decompose

    try:
        k, T_camera_reference = decompose(fields.matrix(label, 3, 4), label)
    except InputError as error:
        raise error.at(fields.file) from error
    number = label.rpartition("_")[2] if label.startswith("P_rect") else ""
    camera = fields.camera(label, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), _size(fields, f"S_rect_{number}"))
    return CalibratedCamera(label, Lens(camera, "none", ()), T_camera_reference)


def _raw(fields: Fields, label: str, number: str) -> CalibratedCamera:
    camera = fields.pinhole(label, _size(fields, f"S_{number}"))
    coefficients = fields.numbers(f"D_{number}") if f"D_{number}" in fields else ()
    lens = fields.lens(f"D_{number}", camera, "radtan" if coefficients else "none", coefficients)
    pose = None
    if f"R_{number}" in fields and f"T_{number}" in fields:
        R, t = fields.matrix(f"R_{number}", 3, 3), np.array(fields.numbers(f"T_{number}", 3))
        pose = RigidTransform(orthonormal(R), t)  # seven digits in the files
    return CalibratedCamera(label, lens, pose)


def _size(fields: Fields, key: str) -> tuple[int, int]:
    return fields.pair_of_pixels(key) if key in fields else UNKNOWN_SIZE
