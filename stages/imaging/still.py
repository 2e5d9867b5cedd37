"""Parts of a camera's images that stay in place while the scene moves: the vehicle's own body, a smear on the lens.

The mean of images keeps the contrast of still parts, and reduces that of others: of n images of a moving scene one n-th
of the variance remains. So in each window

    r = variance of the mean image / mean of the images' variances

is near 1 on the body and near 1/n elsewhere. Parts without texture have no r; they are still if still parts surround
them.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.core.declare import AnyArray
from rille.stages.imaging.pyramid import grey

WINDOW_SIDE_PX = 15
"""Pixels: side of the windows."""


MIN_IMAGES = 5
"""Fewest images: the mean of fewer keeps too much of any scene."""


def still(images: Sequence[AnyArray]) -> Bools:
    """Mask (row, col) of the still parts of images (row, col) of one camera."""
    evened = np.stack([_evened(grey(image)) for image in images])
    share = _variance(evened.mean(axis=0)) / np.maximum(np.mean([_variance(image) for image in evened], axis=0), 1e-9)
    # Closing adds parts without texture between still ones, opening removes thin ones.
    window = np.ones((WINDOW_SIDE_PX, WINDOW_SIDE_PX), np.uint8)
    # 0.75: r above which a part is still. In eleven frames of a street it is 1 on the bonnet, and above .75 on a tenth
    # of the street, its sky; in twenty of a street without bonnet at most .64; in ten of a rover above .75 on a sky
    # that darkens upwards.
    parts = (share > 0.75).view(np.uint8)
    for operation in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN):
        parts = cv2.morphologyEx(parts, operation, window)
    number, label = cv2.connectedComponents(parts, connectivity=4)
    border = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    area = np.bincount(label.ravel(), minlength=number)
    # Smaller parts, and those that do not reach the image's border, do not count.
    body = [n for n in border if n > 0 and area[n] >= 0.002 * label.size]
    # The variance of a window half on the body may be that of the scene.
    return np.asarray(cv2.dilate(np.isin(label, body).view(np.uint8), window) != 0)


def _evened(image: Floats32) -> Floats32:
    """Image with brightness and contrast normalised."""
    return np.asarray((image - image.mean()) / max(float(image.std()), 1.0), np.float32)


def _variance(image: Floats32) -> Floats32:
    """Variance in the window around each pixel (row, col)."""
    mean, square = (
        cv2.blur(a, (WINDOW_SIDE_PX, WINDOW_SIDE_PX), borderType=cv2.BORDER_REPLICATE) for a in (image, image * image)
    )
    return np.asarray(np.maximum(square - mean * mean, np.float32(0.0)))
