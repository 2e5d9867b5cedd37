"""Rigid alignment of two sets of poses, by positions and orientations together.

Positions alone do not say how far a straight drive is rolled about its own line, nor anything of a resting camera's
attitude. Each pose therefore counts as seven points: its centre, and the ends of three crossed rods of half length
``lever`` along its axes; the points are brought together by least squares (Umeyama 1991, doi:10.1109/34.88573).
"""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.evaluation.accuracy_parts import rms, umeyama

REST_LEVER = 1.0
"""m, lever of a camera at rest: far beyond the millimetres of its positions."""


def spread(poses: Floats) -> float:
    """RMS distance of the positions of poses (n, 3, 4) from their mean, metres."""
    return rms(poses[:, :, 3] - poses[:, :, 3].mean(axis=0))


def align(source: Floats, target: Floats, share: float) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) that bring poses (n, 3, 4) nearest to others of the same frames.

    ``share`` is the lever over the spread of the target's positions: how much orientations count beside positions.
    A camera at rest has no spread but noise; infinity lets the orientations alone decide.
    """
    lever = share * spread(target)
    if lever < 1e-6 or not np.isfinite(lever):
        lever = REST_LEVER
    return umeyama(_points(source, lever), _points(target, lever))


def moved(poses: Floats, rotation: Floats, translation: Floats) -> Floats:
    """Poses (..., 3, 4) with a rigid motion applied from the left."""
    out = rotation @ poses
    out[..., 3] += translation
    return np.asarray(out)


def _points(poses: Floats, lever: float) -> Floats:
    centre = poses[:, None, :, 3]
    rods = lever * np.swapaxes(poses[:, :, :3], 1, 2)
    # Both ends of each rod: their mean is the centre, so that rods pull no position aside.
    return np.concatenate([centre, centre + rods, centre - rods], axis=1).reshape(-1, 3)
