"""SIFT features of an image, and matches between two images, for comparisons without a start.

Keypoints and descriptors are OpenCV's (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94); the square root of the
descriptors' L1-normalised values as bytes is that of COLMAP (Arandjelovic and Zisserman 2012,
doi:10.1109/CVPR.2012.6248018). OpenCV always begins with an image of twice the size: a large image is halved before, so
that its first octave has the resolution of the image, which takes a fifth of the time.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, Memory, NoParams, stage

PIXEL_CENTRE = 0.5
"""COLMAP puts the centre of the first pixel at (0.5, 0.5), we at (0, 0)."""

UNIT_BYTES = 512.0
"""Length of COLMAP's byte descriptors."""

MAX_FEATURES, MAX_IMAGE_SIDE = 1300, 1400
"""Features of an image, of most contrast; and pixels of its longer side, above which it is reduced before."""

MAX_DOUBLED_PIXELS = 150_000
"""Pixels up to which an image is not halved: of a street at 320 x 96, all of 29 frames have a pose so, 8 otherwise."""


def grey_bytes(image: NDArray[Any]) -> Bytes:
    """Image (row, col) as uint8: uint16 is divided by 257, floats of 0..255 are rounded."""
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    grey = image / 257.0 if image.dtype == np.uint16 else image
    return np.clip(np.rint(np.nan_to_num(grey)), 0, 255).astype(np.uint8)


def detected_pixel(width: int, height: int) -> float:
    """Side [pixels] of a pixel of the image in which the features of an image of this size are detected."""
    reduction = max(max(width, height) / MAX_IMAGE_SIDE, 1.0)
    return reduction * (2.0 if width * height > MAX_DOUBLED_PIXELS * reduction**2 else 1.0)


def extract(image: NDArray[Any], valid: NDArray[Any]) -> Bundle:
    """Points and descriptors of an image (row, col) where ``valid`` (row, col) is not 0."""
    height, width = image.shape
    grey = grey_bytes(image)
    reduction = max(width, height) / MAX_IMAGE_SIDE
    if reduction > 1:
        size = (max(1, round(width / reduction)), max(1, round(height / reduction)))
        # Area means: SIFT's first octave expects an image without aliasing.
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    factor = np.array([width / grey.shape[1], height / grey.shape[0]])
    halving = 2 if grey.size > MAX_DOUBLED_PIXELS else 1
    if halving == 2:
        # Smoothed by the blur that SIFT assumes; area means would leave aliases, and errors a tenth larger.
        grey = cv2.pyrDown(grey)
    # COLMAP's contrast of a keypoint in OpenCV's units. With OpenCV's default scale of the first octave, 1.6 px of a
    # doubled image, fewer small features are found, which are the most exact: errors on the short mockup are a third
    # larger.
    sift = cv2.SIFT.create(MAX_FEATURES, 3, 0.02, sigma=1.3, enable_precise_upscale=True)
    found, sizes, descriptors = root_sift(sift, grey)
    points = (halving * found + PIXEL_CENTRE) * factor
    # Sizes are diameters: two scales.
    keep = _away_from_mask(points, 0.5 * halving * factor[0] * sizes, valid)
    return Bundle({"points": points[keep].astype(np.float32), "descriptors": descriptors[keep]}, {})


def root_sift(sift: cv2.SIFT, grey: Bytes, valid: Bytes | None = None) -> tuple[Floats, Floats, Bytes]:
    """Points (n, 2) column, row of an image (row, col), their sizes (n,), pixels, and descriptors (n, 128).

    ``valid`` (row, col): not zero where points may lie; None: anywhere.
    """
    keypoints, values = sift.detectAndCompute(grey, valid)
    if not keypoints:
        return np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8)
    unit = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1.0))
    descriptors = np.minimum(np.rint(UNIT_BYTES * unit), 255).astype(np.uint8)
    return np.array([k.pt for k in keypoints]), np.array([k.size for k in keypoints]), descriptors


def _away_from_mask(points: Floats, scale: Floats, valid: NDArray[Any]) -> Bools:
    if np.all(valid):
        return np.ones(len(points), bool)
    # Distance to the nearest masked pixel at every pixel, looked up at the features.
    distance = cv2.distanceTransform((valid != 0).astype(np.uint8), cv2.DIST_L2, 5)
    cols, rows = np.floor(points).astype(np.intp).T
    inside = distance[np.clip(rows, 0, valid.shape[0] - 1), np.clip(cols, 0, valid.shape[1] - 1)]
    # Descriptors of nearer ones may show the edge of the mask.
    return np.asarray(inside > 3.0 * scale)


def match(a: Floats32, b: Floats32) -> NDArray[np.uint32]:
    """Indices (m, 2) of matching descriptors (n, 128), bytes: nearest in both directions, clearly nearer than others.

    Products of bytes summed over 128 stay below 2**24 and are thus exact in float32, in any order of summation; a
    matrix product is some ten times faster than COLMAP's loops.
    """
    if min(len(a), len(b)) == 0:
        return np.zeros((0, 2), np.uint32)
    # All descriptors have nearly the same length, so the greatest product is the least angle.
    products = a @ b.T
    nearest, rows = products.argmax(axis=1), np.arange(len(a))
    best = products[rows, nearest]
    rows = np.flatnonzero(products.max(axis=0)[nearest] == best)
    # One for each column: the other of two equally near ones remains, and is the second best below.
    rows = np.sort(rows[np.unique(nearest[rows], return_index=True)[1]])
    nearest, best = nearest[rows], best[rows]
    # The largest remaining product is the second best of each row and column.
    products[rows, nearest] = 0.0
    keep = _clear(best, products.max(axis=1)[rows]) & _clear(best, products.max(axis=0)[nearest])
    return np.stack([rows[keep], nearest[keep]], axis=1).astype(np.uint32)


def _clear(best: Floats32, second: Floats32) -> Bools:
    """Which products of descriptors are those of a match, clearly better than the second best."""
    near, next_near = (np.arccos(np.minimum(p / UNIT_BYTES**2, 1.0)) for p in (best, second))
    # COLMAP's limits: the angle to the nearest descriptor, radians, and over that to the second.
    return np.asarray((near <= 0.7) & (near < 0.8 * next_near))


def matched_points(a: Bundle, b: Bundle) -> tuple[Floats, Floats]:
    """Points (m, 2), (m, 2) column, row of matching features, from two results of stage ``features``; the centre of
    the first pixel is at (0, 0)."""
    pairs = match(*(np.asarray(one["descriptors"], np.float32) for one in (a, b)))
    first, second = (np.asarray(s["points"], np.float64)[pairs[:, k]] - PIXEL_CENTRE for k, s in enumerate((a, b)))
    return first, second


@stage(
    "features",
    outputs=[
        Array("points", ("feature", "xy"), "float32", "px", "column, row as COLMAP counts"),
        Array("descriptors", ("feature", "value"), "uint8", "1", "square root of the gradients' histogram"),
    ],
    memory=Memory(factor=30.0, result=0.3),
)
def features_stage(params: NoParams, image: Bundle) -> Bundle:
    """SIFT features of an image."""
    return extract(np.asarray(image["image"]), np.asarray(image["valid"]))
