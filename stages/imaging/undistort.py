"""One image with its lens distortion removed, as an ideal camera would have taken it, without rectification.

Each ideal pixel is read from the raw image at its position by the lens model. OpenCV's ``remap`` rounds weights to 1/32
pixel, and its cubic kernel (a = -0.75) displaces texture by up to 0.046 px, as much as the matcher resolves. Here the
weights are exact to 1/8192 pixel, and a pixel is valid only if all pixels that it is computed from are.

Source of the cubic kernel: Keys (1981), Cubic convolution interpolation for digital image processing,
doi:10.1109/TASSP.1981.1163711, the six-point kernel of fourth order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError, within
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.lens import Lens
from rille.stages.imaging.pyramid import grey, usable

PHASES_PER_PX = 4096
"""Positions between two pixels with tabulated weights; the nearest one is used."""

KERNEL_REACH_PX = 3
"""Pixels that the kernel reaches to each side. Six taps displace texture of a period of 6 pixels by at most 0.004
pixels; Lanczos' eight keep the finest contrast and displace smooth texture by up to 0.011."""


def _cubic(d: Floats) -> Floats:
    """Keys' six-point kernel: it reproduces cubic polynomials."""
    near = (4 / 3 * d - 7 / 3) * d * d + 1
    middle = ((-7 / 12 * d + 3) * d - 59 / 12) * d + 5 / 2
    far = ((1 / 12 * d - 2 / 3) * d + 7 / 4) * d - 3 / 2
    return np.where(d <= 1, near, np.where(d <= 2, middle, np.where(d <= 3, far, 0.0)))


def weights() -> Floats32:
    """Weights (phase, tap): phase i is i / ``PHASES_PER_PX`` past the left one of the middle taps; rows sum to 1."""
    phase = np.arange(PHASES_PER_PX + 1) / PHASES_PER_PX
    table = _cubic(np.abs(phase[:, None] - np.arange(1 - KERNEL_REACH_PX, KERNEL_REACH_PX + 1)))
    return np.asarray(table / table.sum(axis=1, keepdims=True), dtype=np.float32)


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
    valid : (row, col) uint8, 1 = usable. 0 where the interpolation kernel leaves the raw image or touches a pixel that
        is not usable, or where the lens model folds back.

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
    maps = lens.maps(camera)
    out, out_valid = np.zeros(maps[0].shape, np.float32), np.zeros(maps[0].shape, np.uint8)
    _resample(raw, usable(raw, valid), maps, weights(), out, out_valid)
    # Kernels with negative weights overshoot at edges.
    return np.clip(out, 0.0, 255.0, out=out), out_valid


@njit(cache=True, nogil=True)
def _resample(image, usable, maps, table, out, out_valid):  # type: ignore[no-untyped-def]
    """Separable weighted mean of the raw pixels around (column, row) of the maps, where all of them are usable."""
    column, row = maps
    # Most images have no mask: then neighbourhoods need no check.
    taps, whole = table.shape[1], usable.all()
    before = taps // 2 - 1
    rows, cols = image.shape
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            x, y = column[i, j], row[i, j]
            # Also excludes NaN, and a position on the last pixel, which needs no tap beyond it.
            if not (x >= before and x < cols - before - 1 and y >= before and y < rows - before - 1):
                continue
            left, top = int(x), int(y)
            wx = table[int((x - np.float32(left)) * np.float32(PHASES_PER_PX) + np.float32(0.5))]
            wy = table[int((y - np.float32(top)) * np.float32(PHASES_PER_PX) + np.float32(0.5))]
            left, top = left - before, top - before
            if not whole and not usable[top : top + taps, left : left + taps].all():
                continue
            value = np.float32(0.0)
            for m in range(taps):
                line = np.float32(0.0)
                for n in range(taps):
                    line += wx[n] * image[top + m, left + n]
                value += wy[m] * line
            out[i, j], out_valid[i, j] = value, 1


@stage(
    "undistort",
    version=2,
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
