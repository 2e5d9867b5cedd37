"""Where the ortho image of one model lies in that of another of the same place: for runs whose world frames differ.

Keypoints of both images (SIFT, Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94) that are alike, and the turn and
shift that most of them agree on. Both images are in metres, so that a scale other than 1 is a wrong place.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import DegenerateError

KEYPOINTS, RATIO = 8000, 0.8
"""Of an image; and how much more alike than the second best a match must be."""

NEAR_CELLS = 2.0
"""Cells of the coarser image within which matches agree."""

FEWEST, MOST_SCALE = 12, 0.03
"""Matches that must agree, and departure of their scale from 1."""


class Ortho(NamedTuple):
    """Grey image (row, col), which of its cells are known, and the map (2, 3) from (col, row, 1) to x, y, metres."""

    grey: AnyArray
    known: Bools
    matrix: Floats


def place(a: Ortho, b: Ortho) -> tuple[Floats, int]:
    """Motion (2, 3) from x, y of A to those of B, a turn and a shift, and how many matches agree on it.

    Raises
    ------
    DegenerateError
        Too few matches agree: the images show other places, or another light.
    """
    (here, one), (there, other) = _described(a), _described(b)
    agreeing, motion = 0, None
    if len(here) and len(there):
        matches = cv2.BFMatcher().knnMatch(one, other, k=2)
        pairs = [first for first, *second in matches if second and first.distance < RATIO * second[0].distance]
        if len(pairs) >= FEWEST:
            p, q = here[[m.queryIdx for m in pairs]], there[[m.trainIdx for m in pairs]]
            near = NEAR_CELLS * max(_cell(a), _cell(b))
            motion, used = cv2.estimateAffinePartial2D(p, q, method=cv2.RANSAC, ransacReprojThreshold=near)
            agreeing = 0 if motion is None else int(used.sum())
    scale = 1.0 if motion is None else math.hypot(motion[0, 0], motion[1, 0])
    if motion is None or agreeing < FEWEST or abs(scale - 1.0) > MOST_SCALE:
        text = f"the ortho images do not show one place: {agreeing} keypoints agree, at a scale of {scale:.3f}"
        raise DegenerateError("RIL-327", text, remedy="compare models in one frame, or of one place in one light")
    # A turn alone, about the middle of the matches that agree.
    turn = motion[:, :2] / scale
    middle = p[used.ravel() != 0].mean(axis=0)
    return np.column_stack([turn, motion[:, :2] @ middle + motion[:, 2] - turn @ middle]), agreeing


def _cell(image: Ortho) -> float:
    return float(np.sqrt(abs(np.linalg.det(image.matrix[:, :2]))))


def _described(image: Ortho) -> tuple[Floats, AnyArray]:
    """Places x, y (n, 2) of keypoints, metres, and descriptors (n, 128)."""
    grey = np.clip(np.nan_to_num(image.grey), 0, 255).astype(np.uint8)
    # Beside unknown cells the edge of what is known is no texture.
    mask = cv2.erode(image.known.astype(np.uint8), np.ones((9, 9), np.uint8))
    # Without it keypoints lie a part of a cell off their places.
    sift = cv2.SIFT.create(KEYPOINTS, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(grey, mask)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    at = np.array([point.pt for point in points])
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return at @ image.matrix[:, :2].T + image.matrix[:, 2], root
