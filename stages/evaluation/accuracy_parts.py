"""Small parts of judging trajectories: figures as the report prints them, inverses, angles, lengths."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.facts.evaluation import Metric


def metric(value: float | int | None, unit: str, how: str) -> Metric:
    """Return one figure of the report: ``value``, its ``unit``, and ``how`` it was measured.

    A value of None, NaN or infinity becomes None: the figure does not apply, and ``how`` says why.
    """
    sound = value is not None and math.isfinite(value)
    return {"value": value if sound else None, "unit": unit, "how": how}


def posed(poses: Floats) -> Bools:
    """Which of the poses (frame, 3, 4), or other matrices, are there, i.e. without NaN."""
    return np.asarray(np.isfinite(poses).all(axis=(1, 2)))


def square(poses: Floats) -> Floats:
    """Poses (n, 3, 4) as (n, 4, 4)."""
    out = np.zeros((len(poses), 4, 4))
    out[:, :3], out[:, 3, 3] = poses, 1.0
    return out


def inverse(T: Floats) -> Floats:
    """Inverses of rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    # The transpose instead of a general inverse: no rounding enters the rotation.
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R
    out[..., :3, 3] = -(R @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def relative_error(P: Floats, Q: Floats, first: Any, last: Any) -> Floats:
    """Error (..., 4, 4) of estimated motions P (n, 4, 4) against true ones Q, from frames ``first`` to ``last``.

    ``(Q_first^-1 Q_last)^-1 (P_first^-1 P_last)``; the frames are indices or slices.
    """
    return np.asarray(inverse(inverse(Q[first]) @ Q[last]) @ (inverse(P[first]) @ P[last]))


def angle(T: Floats) -> Floats:
    """Rotation angle, radians, of transforms (..., 4, 4); exact for small angles, unlike acos of the trace."""
    R = T[..., :3, :3]
    axis = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0))


def rms(vectors: Floats) -> float:
    """Root of the mean squared length of vectors (n, k)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def along(positions: Floats) -> tuple[Floats, str]:
    """Way (frame,) from the first frame along positions (frame, 2 or 3), m, straight over gaps; and that in words.

    The words follow a length of the true path, and are empty where no frame between two others is without a position.
    """
    # Interpolated over frames without a position, so that the way of every frame is a number to search in.
    rows = np.flatnonzero(np.isfinite(positions).all(axis=1))
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions[rows], axis=0), axis=1))])
    gaps = int((np.diff(rows) > 1).sum())
    bridged = f", straight over {gaps} gap{'s' if gaps > 1 else ''} of the truth" if gaps else ""
    return np.interp(np.arange(len(positions)), rows, way), bridged


def umeyama(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3) and translation (3,) that bring points (n, 3) nearest to others in the least-squares sense."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    # Else positions on a plane or a line may be fitted best by a reflection.
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ sign @ vt
    return rotation, b - rotation @ a
