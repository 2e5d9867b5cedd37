"""One calibrated camera."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from rille.stages.geometry.geometry import RigidTransform, Sizes
from rille.stages.geometry.lens import Lens

UNKNOWN_SIZE = (1, 1)
"""Width and height of a camera whose file does not state the size of its images."""

RECTIFIED = re.compile(r"(?<![a-z])rect(?!ang)|Rect|RECT")
"""In the name of a topic or of a folder of rectified images; not as in unrectified, corrected or direct."""


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera of a calibration file.

    Attributes
    ----------
    name : in the file.
    lens : its optics; the image size is ``UNKNOWN_SIZE`` if the file does not state it.
    T_camera_reference : maps the file's reference frame (first camera, body, world ...), the same for all cameras of
        one calibration, to the optical frame of this camera, in the file's unit of length (metres if the format defines
        it); None if the file does not state the pose.
    rectified : the camera of its rectified images, if the file has one.
    """

    name: str
    lens: Lens
    T_camera_reference: RigidTransform | None = None
    rectified: CalibratedCamera | None = None

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of its images, pixels; None if the file does not state them."""
        size = (self.lens.camera.width, self.lens.camera.height)
        return None if size == UNKNOWN_SIZE else size

    @property
    def mount(self) -> RigidTransform | None:
        """T_reference_camera; None if the file does not state it, or the reference is this camera."""
        T = self.T_camera_reference
        return None if T is None or np.allclose(T.matrix34, np.eye(3, 4)) else T.inverse()


def of_size(cameras: list[CalibratedCamera], sizes: Sizes | None) -> list[CalibratedCamera]:
    """The two of several cameras whose images have these sizes; all cameras if there are not exactly two."""
    fit = [camera for camera in cameras if sizes is not None and camera.size in sizes]
    return fit if len(fit) == 2 else cameras


def relative_pose(left: CalibratedCamera, right: CalibratedCamera) -> RigidTransform | None:
    """T_right_left of two cameras of one calibration; None if it does not state both poses."""
    T_left, T_right = left.T_camera_reference, right.T_camera_reference
    return None if T_left is None or T_right is None else T_right @ T_left.inverse()


def parallel(baseline: float) -> RigidTransform:
    """T_right_left of parallel cameras, the right one ``baseline`` along the left one's x axis."""
    return RigidTransform(np.eye(3), np.array([-baseline, 0.0, 0.0]))


def stereo_cameras(left: Lens, right: Lens, T_right_left: RigidTransform) -> list[CalibratedCamera]:
    """Both cameras of a file that states their relative pose; the left one is the reference."""
    return [CalibratedCamera("left", left, RigidTransform.identity()), CalibratedCamera("right", right, T_right_left)]
