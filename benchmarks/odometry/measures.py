"""Errors of a trajectory as odometry is compared: one frame at a time, at the end, and after alignment."""

from __future__ import annotations

from typing import Any

import numpy as np

from rille.stages.evaluation.accuracy import trajectory_accuracy
from rille.stages.evaluation.rigid import posed, umeyama

FIRST = 20
"""Frames of the shorter alignment: on a street some twenty metres, where odometry has not drifted yet."""


def judge(estimate: Any, truth: Any) -> dict[str, float]:
    """Figures of poses (frame, 3, 4) against true ones; NaN where they cannot be told.

    ``one_frame``: mean length of the error of the motion between successive frames, metres. ``drift``: error of the
    last position with the first poses made equal, per cent of the true way. ``rmse_first``, ``rmse``: RMS distance of
    the positions, metres, after the best rigid alignment (no scale) of the first frames alone, and of all. ``lost``:
    frames without a pose.
    """
    both = posed(estimate) & posed(truth)
    found = {"lost": float((~posed(estimate)).sum()), "one_frame": _one_frame(estimate, truth)}
    known = both.sum() > 2
    drift = trajectory_accuracy(estimate, truth)[1]["drift"]["value"] if known else None
    found["drift"] = float("nan") if drift is None else float(drift)
    for name, use in (("rmse_first", both & (np.arange(len(both)) < FIRST)), ("rmse", both)):
        found[name] = _aligned(estimate[use], truth[use]) if use.sum() > 2 else float("nan")
    return found


def _one_frame(P: Any, Q: Any) -> float:
    errors = []
    for k in range(len(P) - 1):
        # t of the motion from k to k + 1, in the left camera of k, and what the rotations differ by from there
        p = P[k, :, :3].T @ (P[k + 1, :, 3] - P[k, :, 3])
        q = Q[k, :, :3].T @ (Q[k + 1, :, 3] - Q[k, :, 3])
        errors.append(float(np.linalg.norm(p - q)))
    known = [e for e in errors if np.isfinite(e)]
    return float(np.mean(known)) if known else float("nan")


def _aligned(P: Any, Q: Any) -> float:
    rotation, translation = umeyama(P[:, :, 3], Q[:, :, 3])
    off = P[:, :, 3] @ rotation.T + translation - Q[:, :, 3]
    return float(np.sqrt((off**2).sum(1).mean()))
