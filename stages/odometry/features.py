"""Homography of most features of two images that show the same, found without any search.

Upright windows match what moved by some hundred pixels and turned by some ten degrees; behind a turn by more they match
little, and the search for them meets mostly what is not the same. Features are those of the crosscheck
(:mod:`rille.stages.imaging.features`).
"""

from __future__ import annotations

import cv2
import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.imaging.features import PIXEL_CENTRE, extract, match
from rille.stages.imaging.pyramid import Pyramid

MAX_MISS_SHARE = 0.016
"""Largest distance between a match and the homography, as a share of the image width; relief departs from one plane."""
MIN_AGREEING = 12
"""Fewest matches that agree with a homography, three times as many as it needs: fewer may agree by chance."""


def feature_homography(a: Pyramid, b: Pyramid) -> Floats | None:
    """Homography (3, 3) from level-0 pixels of frame a to those of frame b; None: too few features agree with one."""
    found = [extract(frame.images[0], frame.valid[0]) for frame in (a, b)]
    pairs = match(*(np.asarray(one["descriptors"], np.float32) for one in found))
    if len(pairs) < MIN_AGREEING:
        return None
    source, target = (np.asarray(one["points"])[rows] - PIXEL_CENTRE for one, rows in zip(found, pairs.T, strict=True))
    # OpenCV seeds its samples by itself, always alike: the same images give the same homography.
    homography, agrees = cv2.findHomography(source, target, cv2.RANSAC, MAX_MISS_SHARE * a.shape[1], maxIters=5000)
    if homography is None or int(agrees.sum()) < MIN_AGREEING:
        return None
    middle = homography @ [(a.shape[1] - 1) / 2.0, (a.shape[0] - 1) / 2.0, 1.0]
    # A homography has no scale of its own; at 1 in the image's centre its rows are comparable.
    return homography / middle[2] if abs(middle[2]) > 1e-9 else None
