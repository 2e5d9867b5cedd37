"""Scale of the right image of a pair: pixels of the right image for each pixel of the left one.

Two cameras may have pixels or lenses of unlike size, and two images may, without any calibration; matches show it, with
the turn between the images.
"""

from __future__ import annotations

import math

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import Rig

MAX_ALIKE_SCALE = 1.2
"""Scale up to which two cameras, or a slanted view, count as alike; it adds at most a fifth of a pixel to an error."""


def alike(scale: float) -> bool:
    """Whether a scale, or its inverse, is at most :data:`MAX_ALIKE_SCALE`."""
    return max(scale, 1.0 / scale) <= MAX_ALIKE_SCALE


def effective(scale: float) -> float:
    """The scale, or 1 if the images are alike."""
    return 1.0 if alike(scale) else scale


def of_rig(rig: Rig) -> Floats:
    """Scale (2,) along columns and rows by the focal lengths; 1 if they are alike."""
    return np.array([effective(rig.right.fx / rig.left.fx), effective(rig.right.fy / rig.left.fy)])


def right_pixels(rig: Rig) -> float:
    """Right pixels of an error of one pixel of the images: more than 1 if the left image is the coarser one."""
    return max(1.0, float(of_rig(rig).max()))


def axes(rig: Rig) -> Floats:
    """Directions in the right image, pixels, of a column and of a row of the left one: columns (2,) and rows (2,), by
    the scale, and by the roll between the cameras."""
    (cosine, _, _), (sine, _, _), _ = rig.T_right_left.rotation
    roll = math.atan2(sine, cosine)
    return of_rig(rig)[:, None] * [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]


def coarser_focal(rig: Rig) -> float:
    """Focal length along columns, pixels, of the camera of coarser pixels; the left one's if they are alike."""
    return rig.left.fx if of_rig(rig)[0] >= 1.0 else rig.right.fx


def other_size(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    """Whether images of two shapes, without a calibration, may show things in unlike size."""
    # 1.3: ratio above which they may be so unlike in size that nothing matches.
    return any(max(m, n) > 1.3 * min(m, n) for m, n in zip(a, b, strict=True))


def common_similarity(origin: Floats, moved: Floats) -> Floats:
    """Rotation and scale (2, 2) in the image that pairs (n, 2) share.

    The mean turn and the median stretch of the lines between pairs, all lines counting alike.
    """
    # Lines between pairs half the list apart, as complex numbers: a quotient is a turn and a stretch.
    p, q = ((a - np.roll(a, len(a) // 2, axis=0)) @ np.array([1.0, 1.0j]) for a in (origin, moved))
    long = (np.abs(p) > 0) & (np.abs(q) > 0)
    ratio = q[long] / p[long]
    # A mean of unit vectors, since angles have no mean across half a turn; outliers are few and of length 1.
    mean = (ratio / np.abs(ratio)).sum()
    if np.abs(mean) == 0:
        return np.eye(2)
    turn = np.median(np.abs(ratio)) * mean / np.abs(mean)
    return np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
