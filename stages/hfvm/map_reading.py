"""How a map of disparities that contradicts its images may have been meant: in another unit, of another sign, or turned
upside down."""

from __future__ import annotations

import cv2
import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.image import thinned

FACTORS = (-1.0, 0.5, 2.0, 1.0 / 16, 16.0, 1.0 / 256, 256.0)
"""Factors of the values of wrong maps: the sign, images of another size, counts of SGBM, counts of KITTI's PNG."""


def better_reading(left: AnyArray, right: AnyArray, column: AnyArray) -> str:
    """How given column displacements (row, col) fit two grey images that they do not fit as they are; empty: no way."""
    readings = {f"their values times {factor:g}": column * np.float32(factor) for factor in FACTORS}
    readings["their rows in reverse"] = column[::-1]
    differences = {name: _difference(left, right, u) for name, u in readings.items()}
    name, least = min(differences.items(), key=lambda item: item[1])
    # Half of it: by chance no reading is so much better.
    return name if least < 0.5 * _difference(left, right, column) else ""


def _difference(left: AnyArray, right: AnyArray, column: AnyArray) -> float:
    """Median difference, grey values, of the right image's pixels at the ends of displacements from the left ones."""
    # At most as many as cv2.remap takes in a row.
    y, x = thinned(np.isfinite(column), 10_000)
    if not len(y):
        return 255.0
    end = x + column[y, x]
    inside = (end >= 0) & (end <= right.shape[1] - 1)
    # Values that lead out of most of the image are of another unit.
    if inside.mean() < 0.5:
        return 255.0
    there = cv2.remap(right, end[None].astype(np.float32), y[None].astype(np.float32), cv2.INTER_LINEAR)[0]
    return float(np.median(np.abs(there - left[y, x])[inside]))
