"""Features of two images that show the same, found without any search, and the homography of most of them.

SIFT (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94, by OpenCV). Upright windows match what moved by some hundred
pixels and turned by some ten degrees; behind a turn by more they match little, and the search for them meets mostly
what is not the same.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.imaging.pyramid import Pyramid

MAX_SIDE_PX = 1400
"""Longest side [pixels] of the pyramid level in which features are detected."""
MAX_FEATURES = 4000
"""Most features of an image, the most prominent ones."""
MAX_DISTANCE_RATIO = 0.85
"""Ratio of the best to the second best descriptor distance above which a match is ambiguous."""
MAX_MISS_SHARE = 0.016
"""Largest distance between a match and the homography, as a share of the image width; relief departs from one plane."""
MIN_AGREEING = 12
"""Fewest matches that agree with a homography, three times as many as it needs: fewer may agree by chance."""


def feature_homography(a: Pyramid, b: Pyramid) -> Floats | None:
    """Homography (3, 3) from level-0 pixels of frame a to those of frame b; None: too few features agree with one."""
    level = next((n for n, image in enumerate(a.images) if max(image.shape) <= MAX_SIDE_PX), a.levels - 1)
    level = min(level, b.levels - 1)
    (p, first), (q, second) = (features(frame, level) for frame in (a, b))
    pairs = matches(first, second)
    if len(pairs) < MIN_AGREEING:
        return None
    # Pixel centres of a level lie between those of the finer one: x0 = 2^n x + (2^n - 1) / 2.
    there = np.array([[2.0**level, 0.0, 0.5 * 2.0**level - 0.5], [0.0, 2.0**level, 0.5 * 2.0**level - 0.5], [0, 0, 1]])
    source, target = p[pairs[:, 0]], q[pairs[:, 1]]
    # OpenCV seeds its samples by itself, always alike: the same images give the same homography.
    found, agrees = cv2.findHomography(
        source, target, cv2.RANSAC, MAX_MISS_SHARE * a.images[level].shape[1], maxIters=5000
    )
    if found is None or int(agrees.sum()) < MIN_AGREEING:
        return None
    homography = there @ found @ np.linalg.inv(there)
    middle = homography @ [(a.images[0].shape[1] - 1) / 2.0, (a.images[0].shape[0] - 1) / 2.0, 1.0]
    # A homography has no scale of its own; at 1 in the image's centre its rows are comparable.
    return homography / middle[2] if abs(middle[2]) > 1e-9 else None


def features(frame: Pyramid, level: int, most: int = MAX_FEATURES) -> tuple[Floats32, Floats32]:
    """Positions (n, 2) column, row in pixels of the level, and RootSIFT descriptors (n, 128)."""
    image = np.clip(np.rint(np.nan_to_num(frame.images[level])), 0, 255).astype(np.uint8)
    points, descriptors = cv2.SIFT.create(most).detectAndCompute(image, frame.valid[level])
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    # RootSIFT: Euclidean distances of the roots are Hellinger distances of the histograms, which few large bins do not
    # rule.
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), np.float32(1e-9)))
    return np.array([k.pt for k in points], np.float32), root


def matches(a: Floats32, b: Floats32) -> NDArray[np.intp]:
    """Numbers (k, 2) of the features that are each other's nearest, by far."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.intp)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m[0].queryIdx: m[0].trainIdx for m in matcher.knnMatch(b, a, k=1)}
    pairs = [
        (one.queryIdx, one.trainIdx)
        for one, two in matcher.knnMatch(a, b, k=2)
        if one.distance < MAX_DISTANCE_RATIO * two.distance and back[one.trainIdx] == one.queryIdx
    ]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
