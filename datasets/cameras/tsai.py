"""Pinhole cameras of the Ames Stereo Pipeline (``.tsai``).

Source: its manual, "Frame camera models" (https://stereopipeline.readthedocs.io, pinholemodels): a point Q of the
camera frame is at R Q + C in the world, so that R is camera to world and C the projection centre; focal length and
principal point divided by ``pitch`` are pixels, with pixel centres at integers; ``u_direction``, ``v_direction`` and
``w_direction`` are the directions in the camera frame of columns, rows and depth. TSAI distortion, which older files
do not name, is OpenCV's radial and tangential one; it acts on coordinates divided by the focal length.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import UNKNOWN_SIZE, CalibratedCamera
from rille.datasets.cameras.text import assignments
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.lens import COEFFICIENTS, Lens

LENSES = {"null": "none", "fisheye": "fisheye", "tsai": "radtan"}
"""Supported lens models: those of :mod:`rille.stages.geometry.lens`."""

HEADER = re.compile(r"(VERSION_\d+|PINHOLE)?")


def tsai(text: str, path: Path) -> list[CalibratedCamera]:
    """The camera, named by its file; its pose refers to the file's world. The image size is unknown."""
    lines = assignments(text)
    f = Fields.of_lines(lines, str(path))
    pitch = f.number("pitch", 1.0)
    if not pitch > 0:
        raise f.error("RIL-146", "pitch", f"= {pitch:g} is not positive")
    fu, fv, cu, cv = (f.number(key) / pitch for key in ("fu", "fv", "cu", "cv"))
    camera = f.camera("fu", (fu, fv, cu, cv), UNKNOWN_SIZE)
    # With the directions as rows the projection is K axes R^T (P - C).
    keys = ("u_direction", "v_direction", "w_direction")
    axes = np.array([f.numbers(key, 3) if key in f else row for key, row in zip(keys, np.eye(3), strict=True)])
    if np.linalg.det(axes) < 0:
        mirrored = "and the other two directions mirror the image"
        raise f.error("RIL-147", "u_direction", mirrored, "give a model without mirroring")
    T_world_body = f.transform("R", "C")
    T_camera_body = f.rigid("u_direction", axes, np.zeros(3))
    # The name of the lens model stands alone on its line.
    model = next((value for key, value in lines if not key and not HEADER.fullmatch(value)), "")
    found = CalibratedCamera(path.stem, _lens(f, model, camera), T_camera_body @ T_world_body.inverse())
    f.check_lens()
    return [found]


def _lens(f: Fields, kind: str, camera: Camera) -> Lens:
    model = LENSES.get(kind.lower() or ("tsai" if "k1" in f else "null"))
    if model is None:
        remedy = "convert it by convert_pinhole_model --output-type TsaiLensDistortion"
        raise f.error("RIL-148", f"lens model {kind}", "is not read", remedy)
    keys = [key for key in COEFFICIENTS[model] if model == "fisheye" or key != "k3" or key in f]
    return f.lens("k1", camera, model, tuple(map(f.number, keys)))
