"""A focal length that changed since the key frame, as a zoom or an autofocus changes it.

Such an image is stretched about its centre, and near and far landmarks by the same factor, as no motion of the camera
does. Many landmarks contradict every pose then; with a focal length of its own for the frame most of them agree.
"""

from __future__ import annotations

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import Camera
from rille.stages.odometry.resection.robust_pose import sampled_pose

MIN_CHANGE = 0.003
"""Change of the focal length over itself that can be told from errors of the landmarks."""


def refuse_zoom(landmarks: Floats, pixels: Floats, camera: Camera, agreeing: int, bound: float, frame: int) -> None:
    """Refuse a frame whose landmarks agree with another focal length than the calibrated one.

    Parameters
    ----------
    landmarks, pixels : of the key frame, (n, 3) in the local frame, m, and where they are seen, (n, 2) column, row.
    agreeing : how many of them are within the bound with a pose of the calibrated camera.
    bound : largest error of a landmark that agrees, pixels.
    frame : its number, for messages and for the seed of the random samples.

    Raises
    ------
    DegenerateError
        The focal length changed.
    """
    from rille.stages.geometry.colmap import pycolmap

    count = len(pixels)
    # 0.1: share of the landmarks that contradict a pose from which on the focal length is tried: moving objects and
    # wrong tracks make up less, mostly.
    # 20: landmarks below which nothing is said: a pose with its focal length fits any four.
    if count < 20 or count - agreeing < 0.1 * count:
        return
    # One focal length, as the solver wants it: that of the columns.
    square = (pixels - [camera.cx, camera.cy]) * [1.0, camera.fx / camera.fy]
    size = {"width": camera.width, "height": camera.height}
    pinhole = pycolmap.Camera(model="SIMPLE_PINHOLE", **size, params=[camera.fx, 0, 0])
    found = sampled_pose(square, landmarks, pinhole, bound, frame, focal_length=True)
    if found is None:
        return
    agree, larger = found["num_inliers"], pinhole.focal_length_x / camera.fx - 1.0
    # 0.6: share of those that agree with another focal length from which on that is the cause: of a zoom by 2 % some
    # 0.8, of another vehicle or of the own body, to which a focal length adapts as well, at most 0.35.
    if agree - agreeing < 0.6 * (count - agreeing) or abs(larger) < MIN_CHANGE:
        return
    raise DegenerateError(
        "RIL-771",
        f"frame {frame}: the focal length changed by some {100.0 * larger:+.2g} %, by zoom or focus (or, if all frames "
        f"say so, a principal point's column is wrong, or one image cut): {agree} of {count} landmarks agree with one "
        f"pose then, {agreeing} as calibrated",
        remedy="keep zoom and focus as they were calibrated; what was taken with others is a sequence of its own, with "
        "its own calibration",
    )
