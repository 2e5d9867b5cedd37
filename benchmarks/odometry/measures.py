"""Errors of a trajectory as odometry is compared: one frame at a time, at the end, and after alignment."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.optimize
from scipy.spatial.transform import Rotation

from rille.stages.evaluation.accuracy import nees, trajectory_accuracy
from rille.stages.geometry.rigid import posed, umeyama

FIRST = 20
"""Frames of the shorter alignment: on a street some twenty metres, where odometry has not drifted yet."""

MOUNT_RAD, MOUNT_M = 0.1, 1.0
"""Usual size of the turn and of the lever arm between a camera and the body that a truth is of."""


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

    ``nees``: first poses made equal. ``nees_mounted``: besides, the constant turn and lever arm between the camera and
    the body that the truth is of, which no image shows, are fitted to the motions between frames and left out. An
    exact truth has none.
    """
    mount = _mount(estimate, truth)
    known = np.flatnonzero(posed(estimate) & posed(truth))
    found = {}
    for name, T in (("nees", np.eye(4)), ("nees_mounted", mount)):
        at, true = _four(estimate[known]), _four(truth[known]) @ T
        aligned = at[0] @ np.linalg.inv(true[0]) @ true
        value = nees(at[:, :3], aligned[:, :3], covariance[known])["nees"]
        found[name] = float("nan") if isinstance(value, str) else value
    return found


def _four(poses: Any) -> Any:
    """Poses (n, 4, 4) of poses (n, 3, 4)."""
    last = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(poses), 1, 4))
    return np.concatenate([poses, last], axis=1)


def _mount(P: Any, Q: Any) -> Any:
    """T_body_camera (4, 4) of a truth ``Q`` of some body, from the motions of ``P`` between frames, robustly."""
    known = posed(P) & posed(Q)
    pairs = np.flatnonzero(known[:-1] & known[1:])
    steps = [np.linalg.inv(_four(M[pairs])) @ _four(M[pairs + 1]) for M in (P, Q)]

    def mount(x: Any) -> Any:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        return T

    def misses(x: Any) -> Any:
        T = mount(x)
        off = steps[0] @ np.linalg.inv(np.linalg.inv(T) @ steps[1] @ T)
        return np.hstack([off[:, :3, 3], Rotation.from_matrix(off[:, :3, :3]).as_rotvec()])

    # Shifts and turns each by their own scatter; what no motion shows stays 0.
    scale = np.repeat(np.sqrt((misses(np.zeros(6)) ** 2).reshape(-1, 2, 3).sum(2).mean(0)), 3)
    usual = np.repeat([MOUNT_RAD, MOUNT_M], 3)
    weighed = scipy.optimize.least_squares(
        lambda x: np.concatenate([(misses(x) / scale).ravel(), x / usual]), np.zeros(6), loss="soft_l1"
    )
    return mount(weighed.x)
