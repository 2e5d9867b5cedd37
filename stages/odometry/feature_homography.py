"""Homography between two frames that are far apart, from features that stand turns and changes of scale.

Upright windows match what moved by some hundred pixels; behind a turn by half the field of view they match little, and
the search for them meets mostly what is not the same. SIFT (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94, by
OpenCV) finds without any search what two such frames have in common. The homography of most of its matches is a start
only: it is undone before matching, and what comes of it counts if more pixels match than without.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.imaging.pyramid import Pyramid

LARGEST = 1400
"""Pixels: longer side up to which features are looked for in the finest image."""
FEATURES = 4000
"""Features of an image, the most prominent."""
DISTINCT = 0.85
"""Distance of descriptors over that to the second best, above which a match is ambiguous."""
NEAR = 0.016
"""Share of the width: distance to a homography at which a match still agrees; relief parts them from one plane."""
LEAST = 12
"""Matches that agree, three times as many as a homography needs: fewer may agree by chance."""


def feature_homography(a: Pyramid, b: Pyramid) -> Floats | None:
    """Homography (3, 3) from level-0 pixels of frame a to those of frame b; None: too few features agree with one."""
    level = next((n for n, image in enumerate(a.images) if max(image.shape) <= LARGEST), a.levels - 1)
    level = min(level, b.levels - 1)
    (p, first), (q, second) = (_features(frame, level) for frame in (a, b))
    pairs = _matches(first, second)
    if len(pairs) < LEAST:
        return None
    # Pixel centres of a level lie between those of the finer one: x0 = 2^n x + (2^n - 1) / 2.
    there = np.array([[2.0**level, 0.0, 0.5 * 2.0**level - 0.5], [0.0, 2.0**level, 0.5 * 2.0**level - 0.5], [0, 0, 1]])
    source, target = p[pairs[:, 0]], q[pairs[:, 1]]
    # OpenCV seeds its samples by itself, always alike: the same images give the same homography.
    found, agrees = cv2.findHomography(source, target, cv2.RANSAC, NEAR * a.images[level].shape[1], maxIters=5000)
    if found is None or int(agrees.sum()) < LEAST:
        return None
    homography = there @ found @ np.linalg.inv(there)
    middle = homography @ [(a.images[0].shape[1] - 1) / 2.0, (a.images[0].shape[0] - 1) / 2.0, 1.0]
    # A homography has no scale of its own; at 1 in the image's centre its rows are comparable.
    return homography / middle[2] if abs(middle[2]) > 1e-9 else None


def _features(frame: Pyramid, level: int) -> tuple[Floats32, Floats32]:
    """Positions (n, 2) column, row in pixels of the level, and RootSIFT descriptors (n, 128)."""
    image = np.clip(np.rint(np.nan_to_num(frame.images[level])), 0, 255).astype(np.uint8)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(image, frame.valid[level])
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
    # RootSIFT: Euclidean distances of the roots are Hellinger distances of the histograms, which few large bins do not
    # rule.
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), np.float32(1e-9)))
    return np.array([k.pt for k in points], np.float32), root


def _matches(a: Floats32, b: Floats32) -> NDArray[np.intp]:
    """Numbers (k, 2) of the features that are each other's nearest, by far."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.intp)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m[0].queryIdx: m[0].trainIdx for m in matcher.knnMatch(b, a, k=1)}
    pairs = [
        (one.queryIdx, one.trainIdx)
        for one, two in matcher.knnMatch(a, b, k=2)
        if one.distance < DISTINCT * two.distance and back[one.trainIdx] == one.queryIdx
    ]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
