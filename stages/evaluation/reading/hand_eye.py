"""Hand-eye calibration: constant error of the stated transform between the truth's body and the camera.

True poses are those of a body: markers, an IMU, two antennas. ``truth.T_body_left`` says where the camera is in it. If
that is off by a constant transform X, every true pose of the camera is off by X from the right, and every motion from
frame to frame becomes ``X^-1 M X``: a camera that turns seems to err in each step, however exact its estimate. X is
estimated from all frames together (Shiu, Ahmad 1989, doi:10.1109/70.88014): the shift as a lever arm, as far as turns
determine it, and the turn by the motions from frame to frame.

Figures without the effect of X stand beside those by the truth as given. If truth is positions alone, X is a shift
(:mod:`rille.stages.evaluation.position_accuracy`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.facts.evaluation import Metric, metric
from rille.stages.geometry import rigid
from rille.stages.geometry.geometry import RigidTransform, orthonormal, rotation_log
from rille.stages.geometry.lever_arm import MIN_LEVER_FRAMES, fit_lever_arm

MIN_TURN = math.radians(0.5)
"""Least turn of X without a shift: a smaller one may as well be due to the principal point."""


WITHOUT = {
    name: f"hand_eye_{name}"
    for name in (
        *("drift", "ate_rmse", "rpe_translation_rmse", "rpe_rotation_rmse", "scale_error"),
        *("nees", "nees_position", "nees_rotation"),
    )
}
"""Names of the figures without the effect of X, by those of the same figures as given."""


def hand_eye(estimate: Floats, truth: Floats) -> Floats | None:
    """Constant X (3, 4), m, by which ``truth X`` are the poses of the camera; None if the tracks do not show one.

    Parameters
    ----------
    estimate : (frame, 3, 4) T_world_left, m; NaN of a frame without a pose.
    truth : (frame, 3, 4) T_truth_left, m, as given; NaN where there is none.
    """
    p, q = rigid.steps(estimate, truth)
    if len(p) < MIN_LEVER_FRAMES:
        return None
    both = rigid.posed(estimate) & rigid.posed(truth)
    arm, shown = fit_lever_arm(estimate[both], truth[both, :, 3], upright=False)
    turn = _turn(p, q, arm, rigid.spread(estimate[both]))
    if not shown and rigid.angle(turn) < MIN_TURN:
        return None
    found = np.column_stack([turn, -turn @ arm])
    as_given, left = (
        rigid.rms(rigid.relative_error(*rigid.steps(estimate, true))[:, :, 3])
        for true in (truth, rigid.compose(truth, found))
    )
    # 0.5: largest share of the error of the motions from frame to frame that X may leave: it does not explain errors of
    # an estimate.
    return found if left < 0.5 * as_given else None


def _turn(p: Floats, q: Floats, arm: Floats, lever: float) -> Floats:
    """Turn (3, 3) by which motions q (n, 3, 4) of the truth become motions p of a camera's point at ``arm`` (3,), m.

    ``lever``, m: weight of rotations against positions.
    """
    moved = np.concatenate([p[:, :, 3] + (p[:, :, :3] - np.eye(3)) @ arm, lever * rotation_log(p[:, :, :3])])
    said = np.concatenate([q[:, :, 3], lever * rotation_log(q[:, :, :3])])
    # A weak prior of no turn keeps angles that no motion determines, as the roll about a straight path.
    # 0.003: its weight over that of all motions; it reduces a turn that they determine by as much.
    return orthonormal(said.T @ moved + 0.003 * np.linalg.norm(moved) ** 2 * np.eye(3))


def without_it(off: Floats, figures: Mapping[str, Metric]) -> dict[str, Metric]:
    """Size of X (3, 4), and ``figures`` of the errors without its effect, by their names (:data:`WITHOUT`)."""
    how = "of the truth's body against the camera, beyond what T_body_left says, as it fits the estimate best"
    size = {
        "hand_eye_turn": metric(math.degrees(float(rigid.angle(off))), "deg", f"constant turn {how}"),
        "hand_eye_shift": metric(float(np.linalg.norm(off[:, 3])), "m", f"constant shift {how}"),
    }
    left_out = "; with a constant turn and shift of the truth's body left out"
    errors = {WITHOUT[name]: figure for name, figure in figures.items() if name in WITHOUT}
    return size | {name: {**figure, "how": figure["how"] + left_out} for name, figure in errors.items()}


def misplaced(off: Floats, body: RigidTransform, given: Mapping[str, Metric], without: Mapping[str, Metric]) -> str:
    """One line on X (3, 4): its size, figures with and ``without`` it, and the ``T_body_left`` in place of ``body``."""

    def pair(name: str) -> str:
        return f"{given[name]['value']:.2g} m as given, {without[name]['value']:.2g} m without that"

    stated = rigid.compose(body.matrix34, off).round(4) + 0.0
    return (
        f"the truth's body is turned by {math.degrees(float(rigid.angle(off))):.3g} degrees and shifted by "
        f"{np.linalg.norm(off[:, 3]):.2g} m against what T_body_left says: errors from frame to frame are "
        f"{pair('rpe_translation_rmse')}, after the best fit {pair('ate_rmse')}: check how it is mounted (a principal "
        f"point that is off looks like a turn), or state truth.T_body_left = {stated.tolist()}"
    )
