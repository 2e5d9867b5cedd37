"""Whether matches fit the rig better with another reading of the lens coefficients, of R between the cameras, or with
another focal length of one camera.

Programs write the same numbers in different orders, and under the names of different models. A wrong reading bends
the epipolar lines by pixels, which no rotation of a camera explains. MATLAB's rotations are transposed, since they
multiply row vectors. A focal length of one camera alone that is off stretches its rows against those of the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy

from rille.stages.calibration.relative_orientation import PointPairs
from rille.stages.core.arrays import Floats
from rille.stages.geometry.epipolar import line_distances
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens

TRANSPOSED = "it is transposed"
EXCHANGED = "those of left and right are exchanged"
RECTIFIED = "the images are rectified already: state images.rectified = true, with a calibration that has their P"
MIN_RATIO, MAX_RATIO = 1.005, 1.25
"""Ratios of a focal length to the given one between which it is misread: less is the error of a usual calibration;
beyond, images hardly match."""


def readings(lens: Lens) -> dict[str, Lens]:
    """Other lenses that the coefficients may describe, by the name of the reading."""
    c, found = lens.coefficients, {"the images are free of distortion already": Lens(lens.camera)}
    found["they have the other sign"] = replace(lens, coefficients=tuple(-v for v in c))
    for model, other in (("radtan", "fisheye"), ("fisheye", "radtan")):
        if lens.model == model and len(c) == 4:
            found[f"they are those of model {other}"] = replace(lens, model=other)
    if lens.model == "radtan" and len(c) == 5:
        found["they are k1 k2 k3 p1 p2: give k1 k2 p1 p2 k3"] = replace(lens, coefficients=(*c[:2], *c[3:], c[2]))
    if lens.model == "radtan" and len(c) >= 4:
        found["they are p1 p2 k1 k2: give k1 k2 p1 p2"] = replace(lens, coefficients=(*c[2:4], *c[:2], *c[4:]))
    return found


def better_reading(rig: Rig, repaired: Rig, lenses: Mapping[str, Lens], pairs: Sequence[PointPairs]) -> str:
    """Message on another reading of the calibration that brings the matches to their epipolar lines; empty: none does.

    Parameters
    ----------
    repaired : the rig as turned by the matches; where it fits them no focal length is doubted.
    lenses : of the left and the right camera; with them the images were undistorted to those of the ``rig``.
    pairs : matches in ideal images.
    """
    ideal = {"left": rig.left, "right": rig.right}
    points = {side: np.concatenate([getattr(m, side) for m in pairs]) for side in ideal}
    raw = {side: lenses[side].distort(points[side], ideal[side]) for side in ideal}

    def apart(by: Mapping[str, Lens], rig: Rig = rig) -> Floats:
        """Distances, pixels, of the matches from their lines, their raw pixels undistorted by these lenses."""
        at = {s: by[s].undistort(raw[s], ideal[s]) for s in ideal}
        return line_distances(rig, *at.values())

    def off(by: Mapping[str, Lens], rig: Rig = rig) -> float:
        """Median distance, pixels."""
        return float(np.nanmedian(np.abs(apart(by, rig))))

    def spread(ratio: float) -> float:
        """The same about the median, which a turn changes, with a right focal length ``ratio`` times as long."""
        found = apart({**lenses, "right": _longer(lenses["right"], ratio)})
        return float(np.nanmedian(np.abs(found - np.nanmedian(found))))

    given = off(lenses)
    # 0.3 px: a good calibration leaves less.
    if given < 0.3:
        return ""
    other = {side: readings(lens) for side, lens in lenses.items()}
    names = {name: None for found in other.values() for name in found}
    both = {name: off({s: other[s].get(name, lenses[s]) for s in ideal}) for name in names}
    between = RigidTransform(rig.T_right_left.rotation.T, rig.T_right_left.translation)
    both[TRANSPOSED] = off(lenses, replace(rig, T_right_left=between))
    both[EXCHANGED] = off({"left": lenses["right"], "right": lenses["left"]})
    # Rectified along the larger part of the baseline; given cameras that are parallel are those of rectified images.
    across = 1 - int(np.argmax(np.abs(rig.T_right_left.translation[:2])))
    if not (all(lens.ideal for lens in lenses.values()) and np.allclose(rig.T_right_left.rotation, np.eye(3))):
        both[RECTIFIED] = float(np.nanmedian(np.abs(raw["right"] - raw["left"])[:, across]))
    found = scipy.optimize.minimize_scalar(
        spread, bounds=(1.0 / MAX_RATIO, MAX_RATIO), method="bounded", options={"xatol": 1e-4}
    )
    ratio, fitted = float(found.x), float(found.fun)
    focal = f"the right camera's is {ratio:.3f} times as given, or the left one's {1 / ratio:.3f} times"
    if max(ratio, 1.0 / ratio) > MIN_RATIO and fitted <= 0.5 * min(spread(1.0), off(lenses, repaired)):
        both[focal] = fitted
    name, least = min(both.items(), key=lambda item: item[1])
    # Half of it: by chance no reading is so much better. A twentieth: rectified images miss each other's rows, too.
    if least > min(0.5 * given, max(0.3, 0.05 * given)):
        return ""
    subjects = {
        TRANSPOSED: "R between the cameras seems",
        EXCHANGED: "the figures of the two cameras seem",
        focal: "a focal length seems",
        RECTIFIED: "the calibration seems",
    }
    return (
        f"{subjects.get(name, 'the coefficients of the lenses seem')} misread: the matches lie "
        f"{given:.2f} px off their epipolar lines (median) as given, {least:.2f} px if {name}"
    )


def _longer(lens: Lens, ratio: float) -> Lens:
    """The lens with a focal length that is ``ratio`` times as long."""
    return replace(lens, camera=replace(lens.camera, fx=lens.camera.fx * ratio, fy=lens.camera.fy * ratio))
