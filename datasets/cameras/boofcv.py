"""Calibrations of BoofCV: one pinhole camera with radial and tangential distortion, or a stereo pair.

Its pixel (0, 0) reaches from (0, 0) to (1, 1) (boofcv.org, Coordinate Systems), so half a pixel is subtracted.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rille.datasets.cameras.fields import Fields
from rille.datasets.cameras.model import CalibratedCamera, stereo_cameras
from rille.stages.geometry.lens import Lens

MODELS = ("pinhole", "pinhole_radial_tangential")


def boofcv(f: Fields, path: Path) -> list[CalibratedCamera]:
    """Cameras; ``rightToLeft`` maps the right camera to the left, in the unit of the target (often millimetres)."""
    if "pinhole" in f:
        return [CalibratedCamera(path.stem, _lens(f))]
    pose = f.sub("rightToLeft")
    shift = np.array([pose.number(key) for key in ("x", "y", "z")])
    T_left_right = pose.rigid("rotation", pose.matrix("rotation", 3, 3), shift)
    return stereo_cameras(_lens(f.sub("left")), _lens(f.sub("right")), T_left_right.inverse())


def _lens(f: Fields) -> Lens:
    model = f.text("model", "pinhole")
    if model not in MODELS:
        raise f.error("RIL-103", "model", f"= {model!r} is not read", f"calibrate as {MODELS[1]}")
    p = f.sub("pinhole")
    if abs(p.number("skew", 0.0)) > 1e-6 * p.number("fx"):
        raise p.error("RIL-104", "skew", f"= {p.number('skew'):g} is not 0", "calibrate without skew")
    camera = p.optics("fx fy cx cy", p.size("width", "height"), "none", corner=0.5).camera
    if "radial_tangential" not in f:
        return Lens(camera)
    bent = f.sub("radial_tangential")
    radial = bent.numbers("radial") if "radial" in bent else ()
    k1, k2, *more = (*radial, *(0.0, 0.0)[len(radial) :])
    return bent.lens("radial", camera, "radtan", (k1, k2, bent.number("t1", 0.0), bent.number("t2", 0.0), *more))
