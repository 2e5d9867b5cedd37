"""Errors of a trajectory as odometry is compared: one frame at a time, at the end, and after alignment."""

from __future__ import annotations

from typing import Any

import numpy as np

from rille.stages.evaluation.accuracy import trajectory_accuracy
from rille.stages.evaluation.claims import nees
from rille.stages.evaluation.reading.hand_eye import hand_eye
from rille.stages.geometry.rigid import compose, inverse, posed, umeyama

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


def claims(estimate: Any, covariance: Any, truth: Any) -> dict[str, float]:
    """Squared error of the poses over the stated variance, per degree of freedom (NEES); of what ``truth`` has its own.

    ``nees``: first poses made equal. ``nees_mounted``: besides, a constant turn and shift of the body that the truth is
    of, which no image shows, are left out where they carry most of the error.
    """
    known = posed(estimate) & posed(truth)
    P, Q = estimate[known], truth[known]
    off = hand_eye(P, Q)
    found = {}
    for name, true in (("nees", Q), ("nees_mounted", Q if off is None else compose(Q, off))):
        value = nees(P, compose(P[0], compose(inverse(true[0]), true)), covariance[known])["nees"]
        found[name] = float("nan") if isinstance(value, str) else value
    return found
