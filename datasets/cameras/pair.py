"""Two calibrated cameras as a rig."""

from __future__ import annotations

from dataclasses import replace

from rille.datasets.cameras.model import CalibratedCamera, relative_pose
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Camera, Rig, Sizes
from rille.stages.geometry.lens import Lens

MAX_OFF_CENTRE = 0.1
"""Usual largest distance of a principal point from the centre, over the image's width."""


def check_focal(camera: Camera, name: str) -> None:
    """Refuse a focal length that is impossible for images of this size.

    Raises
    ------
    InputError
        It is impossible.
    """
    for f, what, side in ((camera.fx, "fx", camera.width), (camera.fy, "fy", camera.height)):
        # Angles of view of 169 and 0.06 degrees; a fisheye has a longer focal length, even for a full circle.
        if not 0.05 <= f / side <= 1000.0:
            size = f"{camera.width} x {camera.height} pixels"
            text = f"camera {name}: {what} = {f:g} px cannot be that of images of {size}"
            raise InputError("RIL-987", text, remedy="give fx and fy in pixels")


def rig_of(
    left: CalibratedCamera, right: CalibratedCamera, sizes: Sizes | None = None
) -> tuple[Rig, dict[str, Lens] | None]:
    """Ideal rig, and the real lenses of its cameras.

    Parameters
    ----------
    left, right : cameras whose poses refer to one frame.
    sizes : of the images; needed if the calibration does not state them.

    Returns
    -------
    rig : with ideal cameras (:meth:`rille.stages.geometry.lens.Lens.ideal_camera`), in the calibration's unit of
        length.
    lenses : by camera, ``"left"`` and ``"right"``, only those with distortion; None if there are none.

    Raises
    ------
    InputError
        The image size or the relative pose is unknown, the images have another size than the calibration's, a focal
        length is impossible, or the cameras stand in one place.
    """
    of_left, of_right = sizes or (None, None)
    if sizes is not None:
        _check_scale((left, right), sizes)
    lenses = {"left": _sized(left, of_left), "right": _sized(right, of_right)}
    T_right_left = relative_pose(left, right)
    if T_right_left is None:
        lacking = left if left.T_camera_reference is None else right
        text = f"cameras {left.name} and {right.name} have no relative pose: the calibration does not say where"
        remedy = "give the baseline in metres, or a stereo calibration"
        raise InputError("RIL-128", f"{text} {lacking.name} stands", remedy=remedy)
    rig = Rig(lenses["left"].ideal_camera(), lenses["right"].ideal_camera(), T_right_left)
    # 1e-6: below, in any usual unit of length, both cameras stand in one place.
    if rig.baseline < 1e-6:
        text = f"cameras {left.name} and {right.name} stand in one place: the baseline is 0 m"
        raise InputError(
            "RIL-129", text, remedy="give rig.baseline (m) in a manifest, or the calibration of both cameras"
        )
    distorted = {side: lens for side, lens in lenses.items() if not lens.ideal}
    return rig, distorted or None


def _check_scale(cameras: tuple[CalibratedCamera, CalibratedCamera], sizes: Sizes) -> None:
    """Refuse images of another scale than a calibration without sizes, by its principal points."""
    both = tuple(camera.lens.camera for camera in cameras)
    if any(camera.size is not None for camera in cameras) or min(min(c.cx, c.cy) for c in both) <= 0:
        return
    scales = [(width / (2 * c.cx + 1), height / (2 * c.cy + 1)) for c, (width, height) in zip(both, sizes, strict=True)]
    # If columns and rows differ, images were cropped, or principal points are off-centre: the scale is unknown.
    if any(max(one) > 1.1 * min(one) for one in scales):
        return
    for camera, c, one, (width, height) in zip(cameras, both, scales, sizes, strict=True):
        scale = sum(one) / 2
        if abs(0.5 / scale - 0.5) > MAX_OFF_CENTRE:
            centre = f"the centre of images of some {2 * c.cx + 1:.0f} x {2 * c.cy + 1:.0f} pixels"
            text = f"the principal point of camera {camera.name} is {centre}, the images are {width} x {height}"
            remedy = f"give the calibration of images of this size (fx, fy, cx and cy times {scale:.2g})"
            more = "if it is theirs, state it with width and height in a manifest"
            raise InputError("RIL-974", text, remedy=f"{remedy}; {more}")


def _check_axes(camera: CalibratedCamera, width: int, height: int) -> None:
    """Refuse a camera whose principal point is the centre of its images, of this size, if cx and cy are exchanged."""
    c = camera.lens.camera
    off, exchanged = (max(abs(x - width / 2), abs(y - height / 2)) for x, y in ((c.cx, c.cy), (c.cy, c.cx)))
    # 4.0: distance from the centre over that with columns and rows exchanged above which these are exchanged.
    if off > max(4.0 * exchanged, 0.5 * MAX_OFF_CENTRE * width):
        text = f"the principal point ({c.cx:g}, {c.cy:g}) px of camera {camera.name} would be the centre of"
        remedy = "exchange them; or, if the images were turned, turn them back (by a tag: magick mogrify -auto-orient)"
        raise InputError("RIL-133", f"{text} {width} x {height} images if cx and cy were exchanged", remedy=remedy)


def _sized(camera: CalibratedCamera, size: tuple[int, int] | None) -> Lens:
    c = camera.lens.camera
    if camera.size is not None and size is not None and camera.size != size:
        (width, height), x = camera.size, size[0] / camera.size[0]
        y = size[1] / height
        remedy = "give the images as they were calibrated, or the calibration of images of this size"
        if camera.size == size[::-1]:
            remedy += " (turned by their tag: magick mogrify -auto-orient FILES; or its width and height are exchanged)"
        elif abs(height * x - size[1]) < 1 and camera.lens.model != "cahvore":  # whose skew is in pixels, too
            # The centre of the first pixel is at 0, and its corner stays in place.
            cx, cy = x * (c.cx + 0.5) - 0.5, y * (c.cy + 0.5) - 0.5
            focal = f"fx = {c.fx * x:.8g}, fy = {c.fy * y:.8g}"
            remedy += f"; if they were scaled, it has {focal}, cx = {cx:.8g}, cy = {cy:.8g} and the same distortion"
        text = f"camera {camera.name} is calibrated for {width} x {height} pixels, the images are {size[0]} x {size[1]}"
        raise InputError("RIL-131", text, remedy=remedy)
    if camera.size is None and size is None:
        text = f"the calibration of camera {camera.name} does not say how large its images are"
        raise InputError("RIL-132", text, remedy="give the size of the images")
    width, height = camera.size or size or (0, 0)
    lens = replace(camera.lens, camera=replace(c, width=width, height=height))
    check_focal(lens.camera, camera.name)
    _check_axes(camera, width, height)
    return lens
