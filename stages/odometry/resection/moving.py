"""Pixels of a basic pair that moved by themselves: neither the still scene nor the camera's motion explains them.

A point with a known distance has a place in the next left image that follows from the camera's motion alone. Where the
measured displacement (stage ``motion``) leads elsewhere, by more than both are uncertain by, over a connected part of
the image, something moved: a vehicle, a person, their shadow. The world's model is made without such pixels. If the
next image looks the same at the place of the still scene, the displacement is wrong, as on tiles and wallpaper, which
repeat, and on walls that show little.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, Params, stage
from rille.stages.core.validity import matched
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.imaging import PyramidFacts
from rille.stages.facts.odometry import MotionFacts, MovingFacts
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.scale import right_pixels
from rille.stages.imaging.pyramid import Pyramid
from rille.stages.numeric.windows import window_correlation
from rille.stages.odometry.resection.landmarks import triangulated


class MovingParams(Params):
    """Parameters of the stage ``moving``.

    Attributes
    ----------
    enabled : leave what moves by itself out of the world's terrain.
    """

    enabled: bool = True


ALIKE = 0.8
"""Correlation of 5 x 5 coarse pixels above which both images show the same at the place of the still scene; chosen on a
rendered room and a corridor with wallpaper, tiles and plain walls."""


def departures(
    disparity: Bundle,
    motion: Bundle[MotionFacts],
    rig: Rig,
    T_b_a: RigidTransform,
    images: tuple[Floats32, Floats32],
    *,
    back: bool,
) -> Floats:
    """Departure (row, col) of each pixel of the coarse grid from the motion of the still scene, in its pixels.

    Less the uncertainty of the scene's own place; NaN where the disparity or the displacement is not known, where
    the still scene leaves the view, and where both images look alike at its place.

    Parameters
    ----------
    disparity : of the pair.
    motion : displacements from left image a to b, on the grid of a coarse level.
    T_b_a : motion of the camera.
    images : left images a and b (row, col) on that grid.
    back : the pair is that of image b and not of a.
    """
    scale = 2 ** int(motion.meta["level"])
    shift = np.stack([np.asarray(motion[name], np.float64) for name in ("column_disparity", "row_disparity")], -1)
    shift[~matched(np.asarray(motion["validity"]))] = np.nan
    shape = shift.shape[:2]
    cells = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), -1).reshape(-1, 2)
    # Coarse pixels may reach beyond the end of the image.
    here = np.minimum(cells * scale + scale // 2, np.subtract(np.shape(disparity["validity"])[::-1], 1))
    # 0.3: standard deviation of a disparity [pixels of the coarser image], with what a coarse pixel holds of relief.
    right, sigma = here + _disparities(disparity, here), right_pixels(rig) * 0.3
    points = triangulated(here.astype(float), right, rig, RigidTransform.identity(), np.full(len(here), sigma))
    to = T_b_a.inverse() if back else T_b_a
    there, farther = (rig.left.project(to.apply(points.position + share * points.per_pixel)) for share in (0.0, sigma))
    # From a pair of image b the still scene leads to its place in a, whose displacement must lead back.
    measured = _at(shift, (there + 0.5) / scale - 0.5) if back else shift.reshape(-1, 2)
    off = np.linalg.norm(there + measured - here if back else here + measured - there, axis=1)
    off = (off - 3.0 * np.linalg.norm(farther - there, axis=1)).reshape(shape) / scale
    own, other = images[::-1] if back else images
    seen = _at(other, (there + 0.5) / scale - 0.5, cv2.INTER_LINEAR).reshape(shape)
    # A match of what has left the view is one of chance.
    return np.where(window_correlation(own, seen, 5) <= ALIKE, off, np.nan)


def _disparities(disparity: Bundle, pixels: NDArray[np.intp]) -> Floats:
    """Disparities (n, 2) of pixels (n, 2), column and row; NaN unmatched."""
    col, row = pixels.T
    maps = [np.asarray(disparity[n])[row, col] for n in ("column_disparity", "row_disparity")]
    good = matched(np.asarray(disparity["validity"])[row, col])
    return np.where(good[:, None], np.stack(maps, axis=-1), np.nan).astype(np.float64)


def _at(values: NDArray, places: Floats, how: int = cv2.INTER_NEAREST) -> Floats:
    """Values (n, ...) of a raster (row, col, ...) at the places (n, 2) of all pixels, column, row; NaN outside."""
    x, y = np.nan_to_num(places, nan=-9.0).astype(np.float32).T.reshape(2, *values.shape[:2])
    found = cv2.remap(values, x, y, how, borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan, np.nan))
    return np.asarray(found, np.float64).reshape(-1, *values.shape[2:])


def moving(off: Floats) -> Bools:
    """Pixels (row, col) of connected parts that depart, each a little widened."""
    with np.errstate(invalid="ignore"):
        # 1.5: departure of a displacement from that of the still scene, in pixels of its level, from which on something
        # moved.
        departs = (off > 1.5).astype(np.uint8)
    # Single rows and corners are errors of the displacements; what is left after opening is a surface.
    opened = cv2.morphologyEx(departs, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    # Smaller parts are errors.
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= 0.002 * off.size]
    # The windows of the matcher blur the border of what moves.
    return np.asarray(cv2.dilate(np.isin(labels, large).astype(np.uint8), np.ones((5, 5), np.uint8)) != 0)


@stage(
    "moving",
    outputs=[Array("moving", ("row", "col"), "uint8", "1", "left pixel that moved by itself", "0", "left image")],
)
def moving_stage(
    params: MovingParams,
    disparity: Bundle,
    rig: Bundle[CalibrationFacts],
    motion: Bundle[MotionFacts],
    segment: Bundle,
    pyramids: Sequence[Bundle[PyramidFacts]],
    *,
    back: bool = False,
) -> Bundle[MovingFacts]:
    """Pixels of a basic pair's left image that moved by themselves to the next image; ``back``: from the one before.

    ``pyramids``: of both left images, the earlier first.
    """
    shape = np.shape(disparity["validity"])
    poses = np.asarray(segment["poses"])[-2:] if back else np.asarray(segment["poses"])[:2]
    out = np.zeros(shape, np.uint8)
    if len(poses) == 2 and np.isfinite(poses).all():
        before, after = (RigidTransform.from_matrix(pose) for pose in poses)
        level = int(motion.meta["level"])
        a, b = (Pyramid.from_bundle(one).images[level] for one in pyramids)
        T_b_a = after.inverse() @ before
        off = departures(disparity, motion, Rig.from_dict(rig.meta["rig"]), T_b_a, (a, b), back=back)
        parts = moving(off).astype(np.uint8)
        scale = 2**level
        out = parts.repeat(scale, axis=0).repeat(scale, axis=1)[: shape[0], : shape[1]]
    share = float(out.mean())
    return Bundle({"moving": out}, {"share": share})
