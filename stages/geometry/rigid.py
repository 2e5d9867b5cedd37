"""Sets of camera poses [R | t] (..., 3, 4): products, errors, lengths, and the motion that aligns one set with another.

Positions alone do not determine the roll about a straight drive, nor the attitude of a camera at rest. For an alignment
by positions and orientations each pose counts as seven points: its centre, and the ends of three crossed rods of half
length ``lever`` along its axes; the points are aligned by least squares (Umeyama 1991, doi:10.1109/34.88573, without
scale).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rille.stages.core.arrays import Bools, Floats


def posed(poses: Floats) -> Bools:
    """Which of the poses (frame, 3, 4), or other matrices, are known, i.e. without NaN."""
    return np.asarray(np.isfinite(poses).all(axis=(1, 2)))


def by_frame(values: Floats, frames: Sequence[int], wanted: Sequence[int]) -> Floats:
    """Rows (frame, ...) of the wanted frames, of poses or covariances of ``frames``; NaN where there is none."""
    row = {frame: k for k, frame in enumerate(frames)}
    missing = np.full(values.shape[1:], np.nan)
    rows = [values[row[frame]] if frame in row else missing for frame in wanted]
    return np.array(rows, dtype=np.float64).reshape(-1, *values.shape[1:])


def compose(a: Floats, b: Floats) -> Floats:
    """Products a b (..., 3, 4) of rigid transforms."""
    out = a[..., :3] @ b
    out[..., 3] += a[..., 3]
    return np.asarray(out)


def inverse(T: Floats) -> Floats:
    """Inverses (..., 3, 4) of rigid transforms."""
    # The transpose, unlike a general inverse, rounds no number of the rotation.
    R = np.swapaxes(T[..., :3], -1, -2)
    return np.concatenate([R, -R @ T[..., 3:]], axis=-1)


def motion(poses: Floats, first: Any, last: Any) -> Floats:
    """Motions (..., 3, 4) from frames ``first`` to ``last`` (indices or slices), in the earlier camera."""
    return compose(inverse(poses[first]), poses[last])


def steps(P: Floats, Q: Floats) -> tuple[Floats, Floats]:
    """Motions (n, 3, 4) of P and of Q (frame, 3, 4) between those successive frames that both have."""
    p, q = (motion(T, slice(None, -1), slice(1, None)) for T in (P, Q))
    both = posed(p) & posed(q)
    return p[both], q[both]


def relative_error(p: Floats, q: Floats) -> Floats:
    """Errors ``q^-1 p`` (..., 3, 4) of motions p against q (..., 3, 4)."""
    return compose(inverse(q), p)


def angle(T: Floats) -> Floats:
    """Rotation angles, radians, of transforms (..., 3, 3 or 4); exact for small angles, unlike acos of the trace."""
    R = T[..., :3]
    axis = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0))


def angles_between(a: Floats, b: Floats) -> Floats:
    """Rotation angles (n,), radians, between the orientations of poses (n, 3, 4) and (n, 3, 4)."""
    return angle(np.swapaxes(a[..., :3], -1, -2) @ b[..., :3])


def rms(vectors: Floats) -> float:
    """Root of the mean squared length of vectors (n, k); NaN for none."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else float("nan")


def lengths_along(positions: Floats) -> Floats:
    """Length (frame,), m, of the path from the first of positions (frame, 2 or 3), straight over gaps."""
    # Interpolated over frames without a position, so that the lengths can be searched.
    rows = np.flatnonzero(np.isfinite(positions).all(axis=1))
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions[rows], axis=0), axis=1))])
    return np.asarray(np.interp(np.arange(len(positions)), rows, lengths))


def umeyama(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Rotation (k, k) and translation (k,) that align points (n, k) with others by least squares."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    # A reflection may fit positions on a plane or a line best.
    u[:, -1] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation = u @ vt
    return rotation, b - rotation @ a


class Fit(NamedTuple):
    """Positions ``moved`` (n, 2 or 3), m; ``error``: RMS residual, m; ``relative``: that over both sets' extent."""

    moved: Floats
    error: float
    relative: float


def fit_rigid(target: Floats, source: Floats, upright: bool = True) -> Fit:
    """Positions ``source`` (n, 2 or 3) turned and shifted to those of ``target`` (n, 3), m.

    They are turned about the vertical alone if both are ``upright``, i.e. share the vertical, or if the source has no
    heights. Rows that are NaN in either do not count, but are moved as well.
    """
    width = source.shape[1]
    both = in_both(target, source)
    if not both.any():
        return Fit(np.full_like(source, np.nan), np.inf, np.inf)
    centre, origin = target[both, :width].mean(axis=0), source[both].mean(axis=0)
    a, b = target[:, :width] - centre, source - origin
    turned = 2 if upright else width
    b[:, :turned] = b[:, :turned] @ umeyama(b[both, :turned], a[both, :turned])[0].T
    error = rms(a[both] - b[both])
    # Relative to the extent of both sets: else clock offsets that compare few, near frames have the least error.
    extent = np.hypot(rms(a[both]), rms(b[both]))
    return Fit(b + centre, error, float(error / extent) if extent > 0 else np.inf)


def standing_out(lengths: Floats, least: float = 0.0) -> Bools:
    """Which lengths (n,) exceed ten times their median and ``least``, as jumps do; none if three in ten do."""
    far = lengths > max(10.0 * float(np.median(lengths)), least)
    return np.asarray(far & (far.mean() < 0.3))


def in_both(a: Floats, b: Floats) -> Bools:
    """Rows (n,) that are known, i.e. without NaN, in both sets of positions (n, 2 or 3)."""
    return np.asarray(np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1))


def spread(poses: Floats) -> float:
    """RMS distance of the positions of poses (n, 3, 4) from their mean, metres."""
    return rms(poses[:, :, 3] - poses[:, :, 3].mean(axis=0))


def alignment(source: Floats, target: Floats, share: float) -> Floats:
    """Motion (3, 4) that aligns poses (n, 3, 4), from the left, with others of the same frames.

    ``share`` is the lever over the spread of the target's positions: the weight of orientations against positions. For
    a camera at rest, whose spread is noise, infinity lets the orientations alone decide.
    """
    lever = share * spread(target)
    if lever < 1e-6 or not np.isfinite(lever):
        # Far beyond the millimetres of its positions.
        lever = 1.0
    return np.column_stack(umeyama(_points(source, lever), _points(target, lever)))


def _points(poses: Floats, lever: float) -> Floats:
    centre = poses[:, None, :, 3]
    rods = lever * np.swapaxes(poses[:, :, :3], 1, 2)
    # Both ends of each rod, so that their mean is the centre.
    return np.concatenate([centre, centre + rods, centre - rods], axis=1).reshape(-1, 3)
