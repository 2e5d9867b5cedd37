"""Test whether left and right images are simultaneous: find the time shift of the right images that fits rows best.

While the vehicle moves, matches of a right image of another time lie pixels off their epipolar lines; those of the
simultaneous image do not. At rest all shifts fit equally, and no finding results.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.geometry.epipolar import distances
from rille.stages.geometry.geometry import Rig
from rille.stages.numeric.robust import mad_sigma

Floats = NDArray[np.float64]

SHIFTS = (0, -1, 1, -2, 2)
"""Frames by which the right images may be late; nought: as they are named."""

FEATURES = 1500
RATIO = 0.75
"""Of the best match's distance to the next best one (Lowe 2004)."""

REACH = 0.1
"""Share of the right image's height that a match may depart from its line: what departs more is mismatched."""

LEAST = 40
"""Matches, below which a pair says nothing."""

BETTER = 0.5
"""A shift explains the rows where its spread is below this share of the spread as named, in the median of the pairs."""

CLEAR = 1.0
"""Pixels of spread as named, below which no shift is looked for."""


def features(image: NDArray[Any]) -> tuple[Floats, NDArray[np.float32]]:
    """Positions (n, 2) column, row and descriptors (n, 128) of an image (row, col)."""
    grey = image if image.dtype == np.uint8 else cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    found, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    return np.array([k.pt for k in found], dtype=np.float64), descriptors


def row_spread(rig: Rig, left: tuple[Floats, Any] | None, right: tuple[Floats, Any] | None) -> float | None:
    """Spread [px] of the matches' distances from their epipolar lines about their median.

    None of too few matches, or of an image that is not there.

    The median is that of a camera that is turned a little, which no shift in time explains.
    """
    if left is None or right is None or min(len(left[0]), len(right[0])) < LEAST:
        return None
    pairs = cv2.BFMatcher().knnMatch(left[1], right[1], k=2)
    good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance]
    if len(good) < LEAST:
        return None
    rows = np.array(good)
    apart, _ = distances(rig, np.zeros(5), left[0][rows[:, 0]], right[0][rows[:, 1]])
    # Before the spread is taken: far mismatches would hide what a shift does to the others.
    apart = apart[np.abs(apart) < REACH * rig.right.height]
    if len(apart) < LEAST:
        return None
    return mad_sigma(apart)


def best_shift(spreads: Mapping[int, list[float | None]]) -> tuple[int, float, float] | None:
    """The shift that explains the rows where as named they are not: shift, spread as named and with it, medians, px.

    ``spreads``: by shift, one a pair, in the same order; None where a pair says nothing.
    """
    best = None
    for shift, values in spreads.items():
        both = [(a, b) for a, b in zip(spreads[0], values, strict=True) if a is not None and b is not None]
        # Pairs alone that say something with both: else shifts would be compared over different frames.
        if shift == 0 or not both:
            continue
        named, shifted = (float(np.median(column)) for column in zip(*both, strict=True))
        if named > CLEAR and shifted < BETTER * named and (best is None or shifted < best[2]):
            best = shift, named, shifted
    return best
