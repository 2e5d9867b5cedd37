"""Registration of one model to another of the same place by their ortho images, for runs whose world frames differ.

Keypoints (SIFT, Lowe 2004, doi:10.1023/B:VISI.0000029664.99615.94) are matched, and the turn and shift that most
matches agree on is the result. Both images are in metres, so that a scale other than 1 is a wrong place. Under another
sun, or over raked ground, keypoints do not match; then the relief is registered
(:func:`rille.stages.terrain.map_localization.fix`), and has to be unlike every other place.
"""

from __future__ import annotations

import math
from contextlib import suppress

import cv2
import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.imaging.features import match, root_sift
from rille.stages.terrain.map_localization import MapLocalizationParams, Placement, fix
from rille.stages.terrain.relief.grid import Grid

FEWEST = 12
"""Matches that must agree."""


def register(images: tuple[Grid, Grid], heights: tuple[Grid, Grid]) -> Placement:
    """Placement of A in B, without a start, by the ortho images of both or else their elevations, all in metres.

    Raises
    ------
    DegenerateError
        Neither the images nor the relief determine the place.
    """
    try:
        return place(*images)
    except DegenerateError:
        with suppress(DegenerateError, InputError):
            found = fix(*heights, None, MapLocalizationParams.model_validate({}))
            if not found.doubt:
                return found
        raise


def place(a: Grid, b: Grid) -> Placement:
    """Placement of the grey image A in the image B by keypoints; height and tilt are unknown.

    Raises
    ------
    DegenerateError
        Too few matches agree: the images show other places, or another light; or half as many agree on another place.
    """
    near = 2.0 * max(a.cell, b.cell)
    (here, one), (there, other) = _described(a, b.cell), _described(b, a.cell)
    alike = match(one, other)
    p, q = here[alike[:, 0]], there[alike[:, 1]]
    motion, used = _agreed(p, q, near)
    agreeing = int(used.sum())
    scale = 1.0 if motion is None else math.hypot(motion[0, 0], motion[1, 0])
    if motion is None or agreeing < FEWEST or abs(scale - 1.0) > 0.03:
        text = f"the ortho images do not show one place: {agreeing} keypoints agree, at a scale of {scale:.3f}"
        raise DegenerateError("RIL-327", text, remedy="compare models in one frame, or of one place")
    # A turn alone, about the middle of the matches that agree.
    turn = motion[:, :2] / scale
    start = p[used].mean(axis=0)
    middle = motion[:, :2] @ start + motion[:, 2]
    elsewhere, rival = _agreed(p[~used], q[~used], near)
    away = 0.0 if elsewhere is None else float(np.linalg.norm(elsewhere[:, :2] @ start + elsewhere[:, 2] - middle))
    # Half as many agree on another place: both are possible.
    if rival.sum() > 0.5 * agreeing and away > 2.0 * near:
        text = f"the ortho image fits two places: {agreeing} and {rival.sum()} keypoints agree, {away:.3g} m apart"
        raise DegenerateError("RIL-841", text, remedy="show more ground than what repeats; localize takes --near")
    arm = p[used] - start
    spread = float(np.sqrt(np.mean((q[used] - middle - arm @ turn.T) ** 2)))
    sigma = spread / np.sqrt([agreeing, agreeing, float((arm**2).sum())])
    # The errors are those at the middle of the matches; the origin may be far from it.
    x, y = lever = -turn @ start
    far = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    kept, covariance = np.ix_([0, 1, 5], [0, 1, 5]), np.diag(np.full(6, math.inf))
    covariance[kept] = far @ np.diag(sigma**2) @ far.T
    pose = RigidTransform(
        rotation_exp([0.0, 0.0, math.atan2(turn[1, 0], turn[0, 0])]), np.array([*(middle + lever), 0.0])
    )
    return Placement(pose, covariance, f"ortho images, {agreeing} keypoints", {"keypoints": agreeing})


def _agreed(p: Floats, q: Floats, near: float) -> tuple[Floats | None, Bools]:
    """Similarity (2, 3) on which most matches agree within ``near`` metres, and which of them do."""
    if len(p) < FEWEST:
        return None, np.zeros(len(p), dtype=bool)
    # OpenCV computes in float32: eastings and northings would lose the centimetres.
    a, b = p.mean(axis=0), q.mean(axis=0)
    motion, used = cv2.estimateAffinePartial2D(p - a, q - b, method=cv2.RANSAC, ransacReprojThreshold=near)
    if motion is None:
        return None, np.zeros(len(p), dtype=bool)
    return np.column_stack([motion[:, :2], motion[:, 2] + b - motion[:, :2] @ a]), used.ravel() != 0


def _described(image: Grid, other: float) -> tuple[Floats, Floats32]:
    """Positions x, y (n, 2), metres, and descriptors (n, 128) of keypoints, in the image coarsened to cells of at least
    ``other``, m."""
    while other > 1.5 * image.cell:
        image = image.halved()
    grey: AnyArray = np.nan_to_num(image.values.astype(np.float32))
    known, matrix = np.isfinite(image.values).astype(np.float32), image.matrix
    low, high = np.percentile(grey[known > 0], (1, 99)) if known.any() else (0.0, 255.0)
    if low < 0 or high > 255 or high - low < 16.0:  # of other units, or pale
        grey = (grey - low) * (255.0 / max(high - low, 1e-12))
    # Unknown cells take the values around them, so that their edge is no texture.
    around = [cv2.GaussianBlur(v.astype(np.float32), (0, 0), 4.0) for v in (np.where(known > 0, grey, 0), known)]
    grey = np.where(known > 0, grey, around[0] / np.maximum(around[1], 1e-6))
    # Without enable_precise_upscale keypoints are off by a part of a cell.
    sift = cv2.SIFT.create(8000, enable_precise_upscale=True)
    at, _, descriptors = root_sift(sift, np.clip(grey, 0, 255).astype(np.uint8), known.astype(np.uint8))
    return at @ matrix[:, :2].T + matrix[:, 2], descriptors.astype(np.float32)
