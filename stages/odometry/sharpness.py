"""Frames of unequal sharpness: lost points are aligned once more, with the sharper image blurred like the other.

A template of a sharp frame has steeper edges than a blurred frame, so its alignment does not converge, or fails the
check there and back. The ratio of the gradients at points that both frames show says how much sharper one of them is.
"""

from __future__ import annotations

import cv2
import numpy as np

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.odometry.affine_lk import SIDE
from rille.stages.odometry.displacements import windows_at

NOTABLE = 0.6
"""Share of squared gradients from which on images count as equally sharp: a blur of half a pixel leaves .7."""


def equally_sharp(a: Floats32, b: Floats32, in_a: Floats, in_b: Floats) -> tuple[Floats32, Floats32] | None:
    """Images (rows, cols), the sharper one blurred until it is about as sharp as the other; None if they are alike.

    Parameters
    ----------
    in_a, in_b : (n, 2) column, row of the same points in both, NaN unknown.
    """
    both = np.isfinite(in_a).all(axis=1) & np.isfinite(in_b).all(axis=1)
    there, here = _gradients(a, in_a[both]), _gradients(b, in_b[both])
    if there < NOTABLE * here:
        return a, _blurred(b, in_b[both], there)
    if here < NOTABLE * there:
        return _blurred(a, in_a[both], here), b
    return None


def _blurred(image: Floats32, points: Floats, wanted: float) -> Floats32:
    """The image with the widest blur that leaves the squared gradients that are wanted."""
    blurred, sigma = image, 0.5
    while sigma <= 8.0:
        wider = cv2.GaussianBlur(image, (0, 0), sigma)
        if _gradients(wider, points) < wanted:
            break
        # 1.2: ratio of the blurs that are tried: four fifths of the right one serve the alignment as well.
        blurred, sigma = wider, sigma * 1.2
    return blurred


def _gradients(image: Floats32, points: Floats) -> float:
    """Mean squared gradient of the templates around the points, over their brightness squared, whatever the exposure.

    Median over those inside; 0 where none is.
    """
    squares = sum(cv2.Scharr(image, cv2.CV_32F, dx, 1 - dx) ** 2 for dx in (0, 1))
    brightness = np.maximum(cv2.blur(image, (SIDE, SIDE)), 1.0)
    inside, (mean,) = windows_at(points, 0, cv2.blur(squares, (SIDE, SIDE)) / brightness**2)
    return float(np.median(mean[inside])) if inside.any() else 0.0
