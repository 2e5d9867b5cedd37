"""One image with its lens distortion removed, as an ideal camera would have taken it, without rectification.

Each ideal pixel is read from the raw image at its position by the lens model, from the cubic spline through the raw
pixels (:mod:`rille.stages.geometry.spline`). OpenCV's ``remap`` rounds weights to 1/32 pixel, and its cubic kernel
(a = -0.75) displaces texture by up to 0.046 px, as much as the matcher resolves; the spline displaces texture of a
period of 6 pixels by at most 0.001 px. A pixel is valid only if the 6 x 6 raw pixels around it are, beyond which an end
of the image or of the usable pixels hardly shows.
"""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Bytes, Floats32
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError, within
from rille.stages.core.kernel import kernel
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.lens import Lens
from rille.stages.geometry.spline import coefficients, value_and_gradient
from rille.stages.imaging.pyramid import grey, usable
from rille.stages.numeric.windows import window_mean


def undistort(image: AnyArray, lens: Lens, camera: Camera, valid: AnyArray | None = None) -> tuple[Floats32, Bytes]:
    """The image of ``camera`` at the same place, and its mask.

    Parameters
    ----------
    image : (row, col) uint8, uint16 (divided by 257) or floating point 0..255, of the size of ``lens.camera``.
    lens : the camera that took it.
    camera : the ideal camera, with the same viewing direction; any size.
    valid : (row, col) of the raw image, not zero where usable; None: everywhere.

    Returns
    -------
    image : (row, col) of ``camera``, float32, grey 0..255; 0 where not valid.
    valid : (row, col) uint8, 1 = usable. 0 where the pixels around leave the raw image or one of them is not usable, or
        where the lens model folds back.

    Raises
    ------
    InputError
        The image or the mask is not of the lens' size.
    """
    raw = grey(image)
    size = (lens.camera.height, lens.camera.width)
    if raw.shape != size:
        raise InputError(
            "RIL-454",
            f"the image is {raw.shape[1]} x {raw.shape[0]} pixels, its lens is calibrated for {size[1]} x {size[0]}",
            remedy="give images as they were calibrated: not scaled, not cropped",
        )
    maps, good = lens.maps(camera), usable(raw, valid)
    out, out_valid = np.zeros(maps[0].shape, np.float32), np.zeros(maps[0].shape, np.uint8)
    if not good.all():
        # A spline continues an edge some pixels beyond it: no edge where the usable pixels end.
        around = window_mean(np.where(good, raw, np.float32(np.nan)), 7)
        raw = np.where(good, raw, np.nan_to_num(around))
    _resample(coefficients(raw), good, maps, out, out_valid)
    # A spline overshoots at edges.
    return np.clip(out, 0.0, 255.0, out=out), out_valid


@kernel
def _resample(spline, usable, maps, out, out_valid):  # type: ignore[no-untyped-def]
    """Values of the spline at (column, row) of the maps, where the raw pixels around are usable."""
    column, row = maps
    # Most images have no mask: then neighbourhoods need no check.
    (rows, cols), whole = spline.shape, usable.all()
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            x, y = column[i, j], row[i, j]
            # Also excludes NaN.
            if x >= 2 and x < cols - 3 and y >= 2 and y < rows - 3:
                left, top = int(x) - 2, int(y) - 2
                if whole or usable[top : top + 6, left : left + 6].all():
                    out[i, j], out_valid[i, j] = value_and_gradient(spline, x, y)[0], 1


@stage(
    "undistort",
    outputs=[
        Array("image", ("row", "col"), "float32", "grey", "image of an ideal camera, 0..255, 0 where masked"),
        Array("valid", ("row", "col"), "uint8", "1", "1 = usable"),
        Array("colour", ("row", "col", "band"), "uint8", "grey", "red, green and blue of it", optional=True),
    ],
)
def undistort_stage(
    params: NoParams, image: Bundle, *, lens: Lens, camera: Camera, frame: int, camera_name: str
) -> Bundle:
    """One image with its lens distortion removed."""
    with within(f"frame {frame}, {camera_name} camera"):
        ideal, valid = undistort(image["image"], lens, camera, image["valid"])
    arrays: dict[str, AnyArray] = {"image": ideal, "valid": valid}
    if "colour" in image.arrays:
        bands = [undistort(band, lens, camera)[0] for band in np.moveaxis(image["colour"], 2, 0)]
        arrays["colour"] = np.rint(np.stack(bands, axis=2)).astype(np.uint8)
    return Bundle(arrays, image.meta)
