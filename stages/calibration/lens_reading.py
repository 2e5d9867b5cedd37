"""Whether matches fit the rig better once the coefficients of the lenses, or R between the cameras, are read otherwise.

Programs write the same numbers in different orders, and under the names of different models. A wrong reading bends
the epipolar lines by pixels, which no rotation of a camera explains. MATLAB's rotations are transposed: they multiply
rows.
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
    """Other lenses that the coefficients of one may be those of, by name."""
    c, found = lens.coefficients, {"the images are free of distortion already": Lens(lens.camera)}
    found["they have the other sign"] = replace(lens, coefficients=tuple(-v for v in c))
    for model, other in (("radtan", "fisheye"), ("fisheye", "radtan")):
        if lens.model == model and len(c) == 4:
            found[f"they are those of model {other}"] = replace(lens, model=other)
    if lens.model == "radtan" and len(c) == 5:
        found["they are k1 k2 k3 p1 p2: give k1 k2 p1 p2 k3"] = replace(lens, coefficients=(*c[:2], *c[3:], c[2]))
    return found


def better_reading(rig: Rig, lenses: Mapping[str, Lens], pairs: Sequence[PointPairs]) -> str:
    """By which reading of the calibration the matches lie nearer to their epipolar lines, in words; empty: by none.

    Parameters
    ----------
    lenses : of the left and the right camera, from whose images the ideal ones of the ``rig`` were made.
    pairs : matches in ideal images.
    """
    ideal = {"left": rig.left, "right": rig.right}
    points = {side: np.concatenate([getattr(m, side) for m in pairs]) for side in ideal}

    def off(by: Mapping[str, Lens], rig: Rig = rig) -> float:
        """Median distance, pixels, of the matches from their lines, their raw pixels undistorted by these lenses."""
        at = {s: by[s].undistort(lenses[s].distort(points[s], ideal[s]), ideal[s]) for s in ideal}
        return float(np.nanmedian(np.abs(distances(rig, np.zeros(RIG), *at.values())[0])))

    given = off(lenses)
    # 0.3 px: more than a good calibration leaves.
    if given < 0.3:
        return ""
    other = {side: readings(lens) for side, lens in lenses.items()}
    names = {name: None for found in other.values() for name in found}
    both = {name: off({s: other[s].get(name, lenses[s]) for s in ideal}) for name in names}
    between = RigidTransform(rig.T_right_left.rotation.T, rig.T_right_left.translation)
    both[TRANSPOSED] = off(lenses, replace(rig, T_right_left=between))
    name, least = min(both.items(), key=lambda item: item[1], default=("", given))
    # Half of it: no reading is so much better by chance.
    if least > min(0.5 * given, 0.3):
        return ""
    what = "R between the cameras seems" if name == TRANSPOSED else "the coefficients of the lenses seem"
    return (
        f"{what} misread: the matches lie "
        f"{given:.2f} px off their epipolar lines (median) as given, {least:.2f} px if {name}"
    )
