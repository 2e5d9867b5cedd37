"""Rotation between two frames, found from the images if no sensor measured it.

Feature vectors compare upright windows and stand a turn of some ten degrees. Up to twice that enough of them still
match to show the rotation, which is then undone. Beyond, the later frame is turned by a few angles about the image
centre, each copy is matched at a coarse level, and the copy of which most pixels match shows the rotation to within a
step; what its matches say of rotation and scale is then fitted and undone for good.

Upright windows match what moved by some hundred pixels; behind a turn by half the field of view they match little, and
the search for them meets mostly what is not the same. SIFT (Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94, by
OpenCV) finds without any search what two such frames have in common. The homography of most of its matches is a start
only: it is undone before matching, and what comes of it counts if more pixels match than without.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.imaging.pyramid import Pyramid

STEP_DEG = 15.0
"""Step [degrees] between two copies: the rotation is at most half a step from one, where windows still match."""
GAIN = 1.2
"""A rotation is believed if it raises the share of matches by a fifth; chance matches do not."""
LEAST_DEG = 10.0
"""Rotation [degrees] below which nothing is undone: up to there, one to three per cent of the tracks are wrong."""
LEAST = 100
"""Fewest matches, at the coarse level, from which a rotation is estimated."""

LARGEST = 1400
"""Longest side [pixels] of the pyramid level in which features are detected."""
FEATURES = 4000
"""Most features of an image, the most prominent ones."""
DISTINCT = 0.85
"""Ratio of the best to the second best descriptor distance above which a match is ambiguous."""
NEAR = 0.016
"""Largest distance between a match and the homography, as a share of the image width; relief departs from one plane."""
LEAST_AGREEING = 12
"""Fewest matches that agree with a homography, three times as many as it needs: fewer may agree by chance."""


def candidates(reach_deg: float) -> list[float]:
    """Angles to try, degrees, small ones first; 0 is not among them."""
    steps = max(1, math.floor(reach_deg / STEP_DEG))
    # Small turns first, for the first of equal shares is kept: of two that match as well, the less.
    return [sign * k * STEP_DEG for k in range(1, steps + 1) for sign in (1.0, -1.0)]


def similarity(degrees: float, scale: float, shape: tuple[int, int]) -> Floats:
    """Homography (3, 3) that turns (column towards row) and stretches about the centre of an image (rows, columns)."""
    c, s = scale * math.cos(math.radians(degrees)), scale * math.sin(math.radians(degrees))
    x, y = (shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0
    return np.array([[c, -s, x - c * x + s * y], [s, c, y - s * x - c * y], [0.0, 0.0, 1.0]])


def fit(column: Floats32, row: Floats32, matched: Bools, level: int) -> tuple[float, float] | None:
    """Rotation, degrees, and scale that the displacements (row, col) of a coarse level share; None: too few.

    The median over lines between pairs of matches, half the image apart: outliers below a quarter of the matches, and
    a parallax that differs over the image, do not turn it far.
    """
    if np.count_nonzero(matched) < LEAST:
        return None
    r, c = np.nonzero(matched)
    scale = 2.0**level
    p = (c + 0.5) * scale - 0.5 + 1j * ((r + 0.5) * scale - 0.5)
    q = p + column[matched].astype(np.float64) + 1j * row[matched].astype(np.float64)
    half = len(p) // 2
    ratio = (q[half:] - q[: len(q) - half]) / (p[half:] - p[: len(p) - half])
    # Angles are taken about a first estimate, so that none lies near half a turn, where they jump.
    middle = np.median(ratio.real) + 1j * np.median(ratio.imag)
    if abs(middle) == 0.0:
        return None
    turned = np.angle(ratio / (middle / abs(middle)))
    return math.degrees(float(np.angle(middle) + np.median(turned))), float(np.median(np.abs(ratio)))


def relative(found: tuple[float, float], known: Floats, shape: tuple[int, int]) -> tuple[float, float]:
    """Return the rotation (degrees) and scale beyond a known homography (3, 3), by its derivative at the centre."""
    centre = np.array([(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0, 1.0])
    moved = known @ centre
    # Quotient rule of (H p)_xy / (H p)_z at the centre: what a homography does to lengths and angles there.
    derivative = (known[:2, :2] - np.outer(moved[:2] / moved[2], known[2, :2])) / moved[2]
    turn = math.degrees(math.atan2(derivative[1, 0] - derivative[0, 1], derivative[0, 0] + derivative[1, 1]))
    scale = math.sqrt(abs(float(np.linalg.det(derivative))))
    # Into -180 .. 180: a difference of 350 degrees is a turn by 10 the other way.
    return (found[0] - turn + 180.0) % 360.0 - 180.0, found[1] / max(scale, 1e-9)


def feature_homography(a: Pyramid, b: Pyramid) -> Floats | None:
    """Homography (3, 3) from level-0 pixels of frame a to those of frame b; None: too few features agree with one."""
    level = next((n for n, image in enumerate(a.images) if max(image.shape) <= LARGEST), a.levels - 1)
    level = min(level, b.levels - 1)
    (p, first), (q, second) = (features(frame, level) for frame in (a, b))
    pairs = matches(first, second)
    if len(pairs) < LEAST_AGREEING:
        return None
    # Pixel centres of a level lie between those of the finer one: x0 = 2^n x + (2^n - 1) / 2.
    there = np.array([[2.0**level, 0.0, 0.5 * 2.0**level - 0.5], [0.0, 2.0**level, 0.5 * 2.0**level - 0.5], [0, 0, 1]])
    source, target = p[pairs[:, 0]], q[pairs[:, 1]]
    # OpenCV seeds its samples by itself, always alike: the same images give the same homography.
    found, agrees = cv2.findHomography(source, target, cv2.RANSAC, NEAR * a.images[level].shape[1], maxIters=5000)
    if found is None or int(agrees.sum()) < LEAST_AGREEING:
        return None
    homography = there @ found @ np.linalg.inv(there)
    middle = homography @ [(a.images[0].shape[1] - 1) / 2.0, (a.images[0].shape[0] - 1) / 2.0, 1.0]
    # A homography has no scale of its own; at 1 in the image's centre its rows are comparable.
    return homography / middle[2] if abs(middle[2]) > 1e-9 else None


def features(frame: Pyramid, level: int, most: int = FEATURES) -> tuple[Floats32, Floats32]:
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
        if one.distance < DISTINCT * two.distance and back[one.trainIdx] == one.queryIdx
    ]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
