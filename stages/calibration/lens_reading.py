"""Whether matches fit the rig better with another reading of the lens coefficients, or of R between the cameras.

Programs write the same numbers in different orders, and under the names of different models. A wrong reading bends
the epipolar lines by pixels, which no rotation of a camera explains. MATLAB's rotations are transposed, since they
multiply row vectors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rille.stages.calibration.relative_orientation import RIG, PointPairs
from rille.stages.geometry.epipolar import distances
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lens import Lens

TRANSPOSED = "it is transposed"


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


def better_reading(rig: Rig, lenses: Mapping[str, Lens], pairs: Sequence[PointPairs]) -> str:
    """Message on another reading of the calibration that brings the matches to their epipolar lines; empty: none does.

    Parameters
    ----------
    lenses : of the left and the right camera; with them the images were undistorted to those of the ``rig``.
    pairs : matches in ideal images.
    """
    ideal = {"left": rig.left, "right": rig.right}
    points = {side: np.concatenate([getattr(m, side) for m in pairs]) for side in ideal}

    def off(by: Mapping[str, Lens], rig: Rig = rig) -> float:
        """Median distance, pixels, of the matches from their lines, their raw pixels undistorted by these lenses."""
        at = {s: by[s].undistort(lenses[s].distort(points[s], ideal[s]), ideal[s]) for s in ideal}
        return float(np.nanmedian(np.abs(distances(rig, np.zeros(RIG), *at.values())[0])))

    given = off(lenses)
    # 0.3 px: a good calibration leaves less.
    if given < 0.3:
        return ""
    other = {side: readings(lens) for side, lens in lenses.items()}
    names = {name: None for found in other.values() for name in found}
    both = {name: off({s: other[s].get(name, lenses[s]) for s in ideal}) for name in names}
    between = RigidTransform(rig.T_right_left.rotation.T, rig.T_right_left.translation)
    both[TRANSPOSED] = off(lenses, replace(rig, T_right_left=between))
    name, least = min(both.items(), key=lambda item: item[1])
    # Half of it: by chance no reading is so much better.
    if least > min(0.5 * given, 0.3):
        return ""
    what = "R between the cameras seems" if name == TRANSPOSED else "the coefficients of the lenses seem"
    return (
        f"{what} misread: the matches lie "
        f"{given:.2f} px off their epipolar lines (median) as given, {least:.2f} px if {name}"
    )
