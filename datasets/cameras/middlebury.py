"""Calibration of Middlebury's stereo pairs (2014 and 2021): rectified, with ``cam0``, ``cam1`` and the baseline."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from datasets.cameras.fields import Fields
from datasets.cameras.model import CalibratedCamera
from stages.geometry import RigidTransform
from stages.lens import Lens

ENTRY = re.compile(r"^\s*(\w+)\s*=\s*(.*?)\s*$")
FIRST = re.compile(r"^\s*cam0\s*=\s*\[", re.MULTILINE)


def is_middlebury(text: str) -> bool:
    """Whether this is the text of such a calibration."""
    return FIRST.search(text) is not None


def middlebury(text: str, path: Path) -> list[CalibratedCamera]:
    """Both cameras; the file's baseline is in millimetres, here it is in metres."""
    values: dict[str, object] = {}
    for entry in filter(None, map(ENTRY.match, text.splitlines())):
        matrix = entry[2].startswith("[")
        values[entry[1]] = entry[2].strip("[]").replace(";", " ").split() if matrix else entry[2]
    f = Fields(values, str(path))
    size = f.size("width", "height")
    left, right = (Lens(f.pinhole(key, size)) for key in ("cam0", "cam1"))
    shift = np.array([-f.number("baseline") / 1000, 0.0, 0.0])
    return [
        CalibratedCamera("left", left, RigidTransform.identity()),
        CalibratedCamera("right", right, RigidTransform(np.eye(3), shift)),
    ]
