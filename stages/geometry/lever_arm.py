"""The lever arm between camera and measured positions, as those of an antenna, estimated from turns of the camera."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry import rigid

MIN_LEVER_FRAMES = 10
"""Fewest frames for the fit of a lever arm, which has up to ten unknowns with turn, shift and clock."""


def fit_lever_arm(poses: Floats, truth: Floats, upright: bool, moments: Floats | None = None) -> tuple[Floats, int]:
    """Lever arm ``l`` (3,), m, by which ``P_i + R_i l`` fits the true positions best, and its determined directions.

    Along directions that the turns do not determine, such as the axis of all turns, it is 0; the others are counted.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, m.
    truth : (frame, 2 or 3) m, in its own frame of reference.
    moments : (frame,) s, if the truth has its own clock, whose offset looks like an arm ahead; else None.
    """
    both, width, arm, shown = rigid.in_both(poses[:, :, 3], truth), truth.shape[1], np.zeros(3), np.zeros(3, bool)
    P, R = poses[both, :, 3], poses[both, :, :3]
    way = np.zeros_like(P)
    if moments is not None:
        # 1e-9: two images may have one time.
        way = np.gradient(P, axis=0) / np.maximum(np.gradient(moments[both]), 1e-9)[:, None]
    for _ in range(20):
        moved = rigid.fit_rigid(P + R @ arm, truth[both], upright).moved
        # Project out the effects of the arm that shift, turns and clock offset have as well.
        centred = np.pad(moved - moved.mean(axis=0), ((0, 0), (0, 3 - width)))
        axes = np.eye(3)[2 if upright or width == 2 else 0 :]
        turns = np.stack([*(np.cross(axis, centred) for axis in axes), way - way.mean(axis=0)], axis=2)
        turns = turns[:, :width].reshape(-1, len(axes) + 1)
        swings = (R - R.mean(axis=0))[:, :width].reshape(-1, 3)
        off = centred[:, :width] - (P - P.mean(axis=0))[:, :width]
        u, s, vt = np.linalg.svd(swings - turns @ np.linalg.pinv(turns) @ swings, full_matrices=False)
        # 0.1: least RMS motion of the antenna about the camera over its lever arm, by turns of 6 degrees.
        shown = s > 0.1 * np.sqrt(len(P))
        arm = vt[shown].T @ ((u.T @ off.reshape(-1))[shown] / s[shown])
    return arm, int(shown.sum())
