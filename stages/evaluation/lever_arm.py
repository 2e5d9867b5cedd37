"""True positions brought to an estimated trajectory: the rigid fit, and the lever arm of what was measured.

The lever arm ``l`` in the camera's frame is where the antenna, prism or body whose positions are known stands beside
the camera: ``P_i + R_i l``. Turns of the camera show it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.geometry.rigid import rms, umeyama

MIN_LEVER_FRAMES = 10
"""Frames by which a lever arm is fitted: with turn, shift and clock it has up to ten unknowns."""

MIN_SWING = 0.1
"""RMS way of the antenna about the camera over its lever arm, from which on turns show it: they are 6 degrees."""


class Fit(NamedTuple):
    """Truth moved into the world: (frame, 2 or 3) m; ``error``: RMS, m; ``relative``: over the extent of the tracks."""

    moved: Floats
    error: float
    relative: float


def fit_rigid(estimate: Floats, truth: Floats, upright: bool = True) -> Fit:
    """Truth (frame, 2 or 3) turned and shifted to the estimated positions (frame, 3), m.

    It is turned about the vertical alone where the world is ``upright``, i.e. its vertical was measured, and where the
    truth has no heights. Rows of NaN in either do not count, but are moved as well.
    """
    width = truth.shape[1]
    both = in_both(estimate, truth)
    if not both.any():
        return Fit(np.full_like(truth, np.nan), np.inf, np.inf)
    centre, origin = estimate[both, :width].mean(axis=0), truth[both].mean(axis=0)
    a, b = estimate[:, :width] - centre, truth - origin
    turned = 2 if upright else width
    b[:, :turned] = b[:, :turned] @ umeyama(b[both, :turned], a[both, :turned])[0].T
    error = rms(a[both] - b[both])
    # Against the extent of both tracks: else the offset wins that compares the fewest, nearest frames.
    extent = np.hypot(rms(a[both]), rms(b[both]))
    return Fit(b + centre, error, float(error / extent) if extent > 0 else np.inf)


def fit_lever_arm(poses: Floats, truth: Floats, upright: bool, moments: Floats | None = None) -> tuple[Floats, int]:
    """The lever arm ``l`` (3,), m, by which ``P_i + R_i l`` fits the true positions best, and how much of it shows.

    Along directions that the turns do not show, such as the axis of all turns, it is 0; others are counted.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, m.
    truth : (frame, 2 or 3) m, of a frame of its own.
    moments : (frame,) s, where the truth has a clock of its own, which the arm ahead looks like; None: it has none.
    """
    both, width, arm, shown = in_both(poses[:, :, 3], truth), truth.shape[1], np.zeros(3), np.zeros(3, bool)
    P, R = poses[both, :, 3], poses[both, :, :3]
    way = np.zeros_like(P)
    if moments is not None:
        # Two images of one moment have no speed.
        way = np.gradient(P, axis=0) / np.maximum(np.gradient(moments[both]), 1e-9)[:, None]
    for _ in range(20):
        moved = fit_rigid(P + R @ arm, truth[both], upright).moved
        # The fit of shift, turns and clock absorbs the part of an arm's swings that looks like them: project it out.
        centred = np.pad(moved - moved.mean(axis=0), ((0, 0), (0, 3 - width)))
        axes = np.eye(3)[2 if upright or width == 2 else 0 :]
        turns = np.stack([*(np.cross(axis, centred) for axis in axes), way - way.mean(axis=0)], axis=2)
        turns = turns[:, :width].reshape(-1, len(axes) + 1)
        swings = (R - R.mean(axis=0))[:, :width].reshape(-1, 3)
        off = centred[:, :width] - (P - P.mean(axis=0))[:, :width]
        u, s, vt = np.linalg.svd(swings - turns @ np.linalg.pinv(turns) @ swings, full_matrices=False)
        shown = s > MIN_SWING * np.sqrt(len(P))
        arm = vt[shown].T @ ((u.T @ off.reshape(-1))[shown] / s[shown])
    return arm, int(shown.sum())


def in_both(estimate: Floats, truth: Floats) -> Bools:
    """Frames (frame,) that have an estimated (frame, 3) and a true position (frame, 2 or 3)."""
    return np.asarray(np.isfinite(estimate).all(axis=1) & np.isfinite(truth).all(axis=1))
