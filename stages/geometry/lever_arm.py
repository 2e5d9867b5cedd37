"""The lever arm of positions that were measured off the camera, as of an antenna: turns of the camera show it."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry import rigid

MIN_LEVER_FRAMES = 10
"""Frames by which a lever arm is fitted: with turn, shift and clock it has up to ten unknowns."""


def fit_lever_arm(poses: Floats, truth: Floats, upright: bool, moments: Floats | None = None) -> tuple[Floats, int]:
    """The lever arm ``l`` (3,), m, by which ``P_i + R_i l`` fits the true positions best, and how much of it shows.

    Along directions that the turns do not show, such as the axis of all turns, it is 0; others are counted.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, m.
    truth : (frame, 2 or 3) m, of a frame of its own.
    moments : (frame,) s, where the truth has a clock of its own, which the arm ahead looks like; None: it has none.
    """
    both, width, arm, shown = rigid.in_both(poses[:, :, 3], truth), truth.shape[1], np.zeros(3), np.zeros(3, bool)
    P, R = poses[both, :, 3], poses[both, :, :3]
    way = np.zeros_like(P)
    if moments is not None:
        # Two images of one moment have no speed.
        way = np.gradient(P, axis=0) / np.maximum(np.gradient(moments[both]), 1e-9)[:, None]
    for _ in range(20):
        moved = rigid.fit_rigid(P + R @ arm, truth[both], upright).moved
        # The fit of shift, turns and clock absorbs the part of an arm's swings that looks like them: project it out.
        centred = np.pad(moved - moved.mean(axis=0), ((0, 0), (0, 3 - width)))
        axes = np.eye(3)[2 if upright or width == 2 else 0 :]
        turns = np.stack([*(np.cross(axis, centred) for axis in axes), way - way.mean(axis=0)], axis=2)
        turns = turns[:, :width].reshape(-1, len(axes) + 1)
        swings = (R - R.mean(axis=0))[:, :width].reshape(-1, 3)
        off = centred[:, :width] - (P - P.mean(axis=0))[:, :width]
        u, s, vt = np.linalg.svd(swings - turns @ np.linalg.pinv(turns) @ swings, full_matrices=False)
        # 0.1: RMS way of the antenna about the camera over its lever arm, from which on turns show it: they are 6
        # degrees.
        shown = s > 0.1 * np.sqrt(len(P))
        arm = vt[shown].T @ ((u.T @ off.reshape(-1))[shown] / s[shown])
    return arm, int(shown.sum())
