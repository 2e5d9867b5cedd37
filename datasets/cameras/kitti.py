"""KITTI's calibration text: each line has a label and numbers.

Odometry has ``P0 ... P3``, the raw recordings ``P_rect_00 ... P_rect_03`` beside the cameras before rectification
(``K_00``, ``D_00``, ``R_00``, ``T_00``), the older Karlsruhe sequences ``P1_roi`` and ``P2_roi``. Projections
P = K [R | t] are those of the rectified images, and are preferred. Files of two to four rows of twelve numbers without
labels are projections too, in the order of the cameras.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import CalibratedCamera
from rille.datasets.cameras.text import entries
from rille.datasets.text.tables import number
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError, within
from rille.stages.geometry.geometry import RigidTransform, orthonormal
from rille.stages.geometry.lens import Lens

PROJECTION = re.compile(r"P(\d)(?:_roi)?|P_rect_(\d{2,3})")
LINE = re.compile(r"^[ \t]*(P\d(?:_roi)?|P_rect_\d{2,3})[ \t]*:[ \t]*[-+.\d]", re.MULTILINE)
"""A label and its first number, unlike the `P1` of OpenCV's YAML, a matrix or a list in brackets."""

LEAST_FOCAL = 2.0
"""Pixels; poses have twelve numbers too, but the first three are at most 1."""


def is_kitti(text: str) -> bool:
    """Whether a line has the label of a projection, or all are projections without labels."""
    # The beginning is enough for calibrations; `rille init` tries other texts too.
    return LINE.search(text[:100_000]) is not None or bool(_nameless(text))


def _nameless(text: str) -> dict[str, list[str]]:
    """Rows of projections without labels, by the labels that they would have; empty if any row is something else."""
    rows = [line.split() for line in text[:100_000].splitlines() if line.strip()]
    if not 2 <= len(rows) <= 4 or any(len(row) != 12 for row in rows):
        return {}
    first = np.array([[number(word) for word in row[:3]] for row in rows])
    if not (np.isfinite(first).all() and (np.abs(first).max(axis=1) > LEAST_FOCAL).all()):
        return {}
    return {f"P{k}": row for k, row in enumerate(rows)}


def kitti(text: str, path: Path) -> list[CalibratedCamera]:
    """All cameras of the file, by the labels of their projections, in order."""
    lines = (line.partition(":") for line in text.splitlines())
    labelled = entries(((label.strip(), numbers.split()) for label, _, numbers in lines if numbers.strip()), str(path))
    fields = Fields(labelled or _nameless(text), str(path))
    labels = sorted(label for label in fields.values if PROJECTION.fullmatch(label))
    if any(label.endswith("_roi") for label in labels):  # of the part that the images show
        labels = [label for label in labels if label.endswith("_roi")]
    fields.used |= {f"D_{label.rpartition('_')[2]}" for label in labels}  # of the images before they were rectified
    fields.check_lens()
    return [_rectified(fields, label) for label in labels]


def _rectified(fields: Fields, label: str) -> CalibratedCamera:
    projection = fields.matrix(label, 3, 4)
    with within(fields.file):
        k, T_camera_reference = decompose(projection, label)
    rectified = label.rpartition("_")[2] if label.startswith("P_rect") else ""
    camera = fields.camera(label, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), fields.size(f"S_rect_{rectified}"))
    return CalibratedCamera(label, Lens(camera, "none", ()), T_camera_reference)


def decompose(projection: Floats, name: str) -> tuple[Floats, RigidTransform]:
    """K (3, 3) and T_camera_reference of a projection matrix P = K [R | t]."""
    m = projection[:, :3]
    # Refuse singular matrices before anything divides by them.
    if abs(np.linalg.det(m)) < 1e-9:
        text = f"calibration: {name} is singular"
        raise InputError("RIL-203", text, remedy="give P = K [R | t], 12 numbers, row-major")
    if m[1, 0] == m[2, 0] == m[2, 1] == 0.0 and m[2, 2] > 0:
        k, r = m / m[2, 2], np.eye(3)
    else:
        from scipy.linalg import rq  # late, since rectified cameras do not need it

        k, r = rq(m * np.sign(np.linalg.det(m)))
        signs = np.sign(np.diag(k))
        k, r = k * signs, signs[:, None] * r
        k = k / k[2, 2]
    scale = np.linalg.norm(m[2])
    if abs(k[0, 1]) > 1e-4 * k[0, 0]:
        text = f"calibration: {name} has skewed pixels"
        raise InputError("RIL-204", text, remedy="give a camera with perpendicular axes")
    t = np.linalg.solve(k, projection[:, 3]) / scale * np.sign(np.linalg.det(m))
    return k, RigidTransform(orthonormal(r), t)
