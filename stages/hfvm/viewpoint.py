"""Turn, scale and slant between two images of one scene, from keypoints, where matching them as they are fails.

Feature vectors compare upright windows, so coarse matching finds nothing beyond a turn of some 20 degrees or a scale of
1.3. Keypoints that carry their own orientation and scale (SIFT, Lowe 2004; compared by the square roots of their
histograms, Arandjelovic and Zisserman 2012) tell the homography of the dominant surface. The right image is resampled
by it as by :mod:`rille.stages.hfvm.plane`, and matching starts anew in a frame that is turned alike.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import plane
from rille.stages.hfvm.image import Image
from rille.stages.hfvm.windows import Shape

MAX_SIDE_PX = 1024
"""Pixels: keypoints are looked for at the finest level whose longer side is at most this."""

MIN_CONTRAST = 0.02
"""Least contrast of a keypoint; half of OpenCV's default, for sand and haze."""

MAX_KEYPOINTS = 4000
"""Keypoints of an image: comparing all with all takes this many squared."""

MAX_DISTANCE_RATIO = 0.8
"""The nearest keypoint must be nearer by this factor than the second nearest (Lowe 2004)."""

MIN_AGREEING = 15
"""Keypoints that must agree; in unrelated images and under other suns 6 do."""

MIN_AGREEING_SHARE = 0.2
"""Share of the unambiguous keypoints that must agree."""


def find(left: Image, right: Image) -> plane.Matrix | None:
    """Homography from left to right pixels (level 0) on which enough keypoints agree, or None."""
    levels = [_level(view) for view in (left, right)]
    (p, a), (q, b) = (_keypoints(view, level) for view, level in zip((left, right), levels, strict=True))
    first, second = _alike(a, b)
    if len(first) < MIN_AGREEING:
        return None
    # What relief does to a keypoint's place on the dominant surface.
    limit = 0.01 * max(right.shapes[levels[1]])
    h, agree = cv2.findHomography(p[first], q[second], cv2.USAC_MAGSAC, limit, maxIters=5000, confidence=0.999)
    if (
        h is None
        or agree.sum() < max(MIN_AGREEING, MIN_AGREEING_SHARE * len(first))
        or not _upright(h, left.shapes[levels[0]])
    ):
        return None
    # Images of unlike size are looked at on levels of their own, so each side has its own scale.
    return np.asarray(plane.finer(levels[1]) @ h @ np.linalg.inv(plane.finer(levels[0])), dtype=np.float64)


def _level(view: Image) -> int:
    """Finest level whose longer side is at most :data:`MAX_SIDE_PX`, else the coarsest."""
    return next((n for n, shape in enumerate(view.shapes) if max(shape) <= MAX_SIDE_PX), len(view.shapes) - 1)


def _keypoints(view: Image, level: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Columns and rows (n, 2) of keypoints, pixels of the level, and their descriptors (n, 128) of length one."""
    layer = view.layers[level]
    grey = np.clip(np.rint(layer.grey), 0, 255).astype(np.uint8)
    sift = cv2.SIFT_create(nfeatures=MAX_KEYPOINTS, contrastThreshold=MIN_CONTRAST)  # type: ignore[attr-defined]  # not in the stubs
    points, histograms = sift.detectAndCompute(grey, (layer.valid != 0).astype(np.uint8))
    if not points:
        return np.empty((0, 2), np.float32), np.empty((0, 128), np.float32)
    total = np.maximum(histograms.sum(axis=1, keepdims=True), 1e-9)
    # Roots of shares have length one, and their Euclidean distance is Hellinger's between the histograms.
    return np.array([point.pt for point in points], np.float32), np.sqrt(histograms / total)


def _alike(a: AnyArray, b: AnyArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of descriptors (n, 128) of which each is the other's nearest, by far."""
    if len(a) < 2 or len(b) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = [m.trainIdx for (m,) in matcher.knnMatch(b, a, k=1)]
    near = matcher.knnMatch(a, b, k=2)
    kept = [m for m, n in near if m.distance < MAX_DISTANCE_RATIO * n.distance and back[m.trainIdx] == m.queryIdx]
    return np.array([m.queryIdx for m in kept], np.intp), np.array([m.trainIdx for m in kept], np.intp)


def _upright(h: plane.Matrix, shape: Shape) -> bool:
    """Whether the whole image stays on this side of the horizon and is not mirrored."""
    rows, cols = shape
    corners = np.array([[0, 0, 1], [cols - 1, 0, 1], [0, rows - 1, 1], [cols - 1, rows - 1, 1]], np.float64).T
    # The horizon is a line: with all corners on this side no pixel lies beyond it.
    return bool(((h @ corners)[2] > 0).all() and np.linalg.det(h) > 0)
