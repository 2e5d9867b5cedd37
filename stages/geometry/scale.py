"""Scale of the right image of a pair against the left one: pixels of the right image for each pixel of the left one.

Two cameras may have pixels or lenses of unlike size; so may the images that are given, without any calibration.
"""

from __future__ import annotations

import math

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import Rig

MAX_ALIKE_SCALE = 1.2
"""Scale up to which two cameras, or a slanted view, count as alike: it adds a fifth of a pixel to an error at most."""


def alike(scale: float) -> bool:
    """Whether a scale, of either image against the other, is none to speak of."""
    return max(scale, 1.0 / scale) <= MAX_ALIKE_SCALE


def effective(scale: float) -> float:
    """The scale to count with: 1 where the images are alike."""
    return 1.0 if alike(scale) else scale


def of_rig(rig: Rig) -> Floats:
    """Scale (2,) along columns and rows by the focal lengths; 1 where they are alike."""
    return np.array([effective(rig.right.fx / rig.left.fx), effective(rig.right.fy / rig.left.fy)])


def right_pixels(rig: Rig) -> float:
    """Right pixels that an error of one pixel of the images makes: more than 1 where the left image is the coarser."""
    return max(1.0, float(of_rig(rig).max()))


def axes(rig: Rig) -> Floats:
    """Where a column and a row of the left image lead in the right one, pixels: its columns (2,) and rows (2,), by the
    scale, and by how the cameras are rolled against each other."""
    (cosine, _, _), (sine, _, _), _ = rig.T_right_left.rotation
    roll = math.atan2(sine, cosine)
    return of_rig(rig)[:, None] * [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]


def coarser_focal(rig: Rig) -> float:
    """Focal length along columns, pixels, of the camera whose pixels are the coarser ones, which hide what is smaller;
    the left one's where they are alike."""
    return rig.left.fx if of_rig(rig)[0] >= 1.0 else rig.right.fx


def other_size(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    """Whether images of two shapes may show things in unlike size, with no calibration to tell."""
    # From this ratio on they may show things so unlike in size that none matches.
    return any(max(m, n) > 1.3 * min(m, n) for m, n in zip(a, b, strict=True))
