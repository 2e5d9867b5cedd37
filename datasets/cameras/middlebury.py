"""Calibration of Middlebury's stereo pairs (2014 and 2021): rectified, with ``cam0``, ``cam1`` and the baseline."""

from __future__ import annotations

from pathlib import Path

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import CalibratedCamera, parallel, stereo_cameras
from rille.datasets.cameras.text import assignments
from rille.stages.geometry.lens import Lens


def middlebury(text: str, path: Path) -> list[CalibratedCamera]:
    """Both cameras; the file's baseline is in millimetres, here it is in metres."""
    values: dict[str, object] = {}
    for key, value in assignments(text):
        matrix = value.startswith("[")
        values[key] = value.strip("[]").replace(";", " ").split() if matrix else value
    f = Fields(values, str(path))
    size = f.size("width", "height")
    left, right = (Lens(f.pinhole(key, size)) for key in ("cam0", "cam1"))
    f.check_lens()
    return stereo_cameras(left, right, parallel(f.number("baseline") / 1000))
