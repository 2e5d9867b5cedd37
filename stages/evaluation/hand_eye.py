"""A constant turn and shift of the truth's body against the camera that its mounting does not say (hand-eye).

True poses are those of a body: markers, an IMU, two antennas. ``truth.T_body_left`` says where the camera is in it. If
that is off by a constant transform X, every true pose of the camera is off by X from the right, and every motion from
frame to frame becomes ``X^-1 M X``: a camera that turns seems to err in each of its steps, however exact it is. X is
found by all frames together (Shiu, Ahmad 1989, doi:10.1109/70.88014): the shift as a lever arm, as far as turns show
it, and the turn by the motions from frame to frame.

Figures with X left out stand beside those by the truth as given. Where truth is positions alone, the shift is all that
there is of X (:mod:`rille.stages.evaluation.position_accuracy`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.facts.evaluation import Metric, metric
from rille.stages.geometry import rigid
from rille.stages.geometry.geometry import RigidTransform, orthonormal, rotation_log

MIN_LEVER_FRAMES = 10
"""Frames by which a lever arm is fitted: with turn, shift and clock it has up to ten unknowns."""

MIN_SWING = 0.1
"""RMS way of the antenna about the camera over its lever arm, from which on turns show it: they are 6 degrees."""

MAX_ERROR_SHARE = 0.5
"""Share of the error of the motions from frame to frame that is left at most: errors of an estimate do not go with a
constant transform of the truth."""

MIN_TURN = math.radians(0.5)
"""Least turn where no shift shows: of a camera that hardly turns, a smaller one is as likely its principal point's."""

PRIOR_SHARE = 0.003
"""Weight of no turn over that of all motions: it draws a turn that they show by as much of it."""

ERRORS = (
    "drift",
    "ate_rmse",
    "rpe_translation_rmse",
    "rpe_rotation_rmse",
    "scale_error",
    "nees",
    "nees_position",
    "nees_rotation",
)
"""Figures that are given without it, too."""


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
        shown = s > MIN_SWING * np.sqrt(len(P))
        arm = vt[shown].T @ ((u.T @ off.reshape(-1))[shown] / s[shown])
    return arm, int(shown.sum())


def hand_eye(estimate: Floats, truth: Floats) -> Floats | None:
    """Constant X (3, 4), m, by which ``truth X`` are the poses of the camera; None where nothing speaks for one.

    Parameters
    ----------
    estimate : (frame, 3, 4) T_world_left, m; NaN of a frame without a pose.
    truth : (frame, 3, 4) T_truth_left, m, as given; NaN where there is none.
    """
    both = rigid.posed(estimate) & rigid.posed(truth)
    if both.sum() < MIN_LEVER_FRAMES:
        return None
    P, Q = estimate[both], truth[both]
    arm, shown = fit_lever_arm(P, Q[:, :, 3], upright=False)
    turn = _turn(P, Q, arm)
    if not shown and rigid.angle(turn) < MIN_TURN:
        return None
    found = np.column_stack([turn, -turn @ arm])
    return found if _step_error(P, rigid.compose(Q, found)) < MAX_ERROR_SHARE * _step_error(P, Q) else None


def _turn(P: Floats, Q: Floats, arm: Floats) -> Floats:
    """Turn (3, 3) by which the motions of the truth Q (n, 3, 4) become those of a point at ``arm`` (3,), m, of P."""
    p, q = (rigid.motion(T, slice(None, -1), slice(1, None)) for T in (P, Q))
    lever = rigid.spread(P)
    moved = np.concatenate([p[:, :, 3] + (p[:, :, :3] - np.eye(3)) @ arm, lever * rotation_log(p[:, :, :3])])
    said = np.concatenate([q[:, :, 3], lever * rotation_log(q[:, :, :3])])
    # What no motion shows, as the roll about a straight way, stays: the identity counts as much as a share of them.
    return orthonormal(said.T @ moved + PRIOR_SHARE * np.linalg.norm(moved) ** 2 * np.eye(3))


def without_it(off: Floats, figures: Mapping[str, Metric]) -> dict[str, Metric]:
    """Size of X (3, 4), and the errors among the figures against the truth without it, by their names."""
    how = "of the truth's body against the camera, beyond what T_body_left says, as it fits the estimate best"
    size = {
        "hand_eye_turn": metric(math.degrees(float(rigid.angle(off))), "deg", f"constant turn {how}"),
        "hand_eye_shift": metric(float(np.linalg.norm(off[:, 3])), "m", f"constant shift {how}"),
    }
    errors = {name: figure for name, figure in figures.items() if name in ERRORS}
    left_out = "; with a constant turn and shift of the truth's body left out"
    return size | {f"hand_eye_{name}": {**one, "how": one["how"] + left_out} for name, one in errors.items()}


def misplaced(off: Floats, body: RigidTransform, given: Mapping[str, Metric], without: Mapping[str, Metric]) -> str:
    """One line on X (3, 4): its size, figures with and ``without`` it, and the ``T_body_left`` in place of ``body``."""

    def pair(name: str) -> str:
        return f"{given[name]['value']:.2g} m as given, {without[name]['value']:.2g} m without that"

    stated = rigid.compose(body.matrix34, off).round(4) + 0.0
    return (
        f"the truth's body is turned by {math.degrees(float(rigid.angle(off))):.2g} degrees and shifted by "
        f"{np.linalg.norm(off[:, 3]):.2g} m against what T_body_left says: errors from frame to frame are "
        f"{pair('rpe_translation_rmse')}, after the best fit {pair('ate_rmse')}: check how it is mounted (a principal "
        f"point that is off looks like a turn), or state truth.T_body_left = {stated.tolist()}"
    )


def _step_error(P: Floats, Q: Floats) -> float:
    """RMS error of position, m, of the motions from frame to frame."""
    return rigid.rms(rigid.relative_error(P, Q, slice(None, -1), slice(1, None))[:, :, 3])
