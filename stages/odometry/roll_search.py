"""In-plane rotation and scale between two frames, found from the images where no sensor tells of them.

Feature vectors compare upright windows and stand a turn of some ten degrees. Up to twice that enough of them still
match to show the rotation, which is then undone. Beyond, the later frame is turned by a few angles about the image
centre, each copy is matched at a coarse level, and the copy of which most pixels match shows the rotation to within a
step; what its matches say of rotation and scale is then fitted and undone for good.
"""

from __future__ import annotations

import math

import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32

STEP_DEG = 15.0
"""Degrees between two copies: the rotation wanted is at most half of it from one of them, where windows still match."""
GAIN = 1.2
"""A rotation is believed if it raises the share of matches by a fifth; chance matches do not."""
LEAST_DEG = 10.0
"""Degrees below which a rotation is left to the matcher: one to three per cent of the tracks are wrong up to there."""
LEAST = 100
"""Coarse pixels, or matches, below which nothing is said of a rotation."""


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
    """What of a rotation (degrees) and scale a known homography (3, 3) leaves, by its derivative at the centre."""
    centre = np.array([(shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0, 1.0])
    moved = known @ centre
    # Quotient rule of (H p)_xy / (H p)_z at the centre: what a homography does to lengths and angles there.
    derivative = (known[:2, :2] - np.outer(moved[:2] / moved[2], known[2, :2])) / moved[2]
    turn = math.degrees(math.atan2(derivative[1, 0] - derivative[0, 1], derivative[0, 0] + derivative[1, 1]))
    scale = math.sqrt(abs(float(np.linalg.det(derivative))))
    # Into -180 .. 180: a difference of 350 degrees is a turn by 10 the other way.
    return (found[0] - turn + 180.0) % 360.0 - 180.0, found[1] / max(scale, 1e-9)
