"""Trajectory against truth: absolute and relative errors, displacements, drift (section 7.4, Figure 9).

``P_i`` are estimated, ``Q_i`` true poses of the left camera. Frames without an estimate, and frames without truth, are
counted and left out. Where truth has a gap, its path is taken to be straight, which is the least that it can be.

* ATE: RMS distance of the positions after the best rotation and translation (Umeyama 1991,
  doi:10.1109/34.88573, without scale), and after making the first poses equal;
* RPE: ``(Q_i^-1 Q_i+1)^-1 (P_i^-1 P_i+1)`` of successive frames (Sturm et al. 2012, doi:10.1109/IROS.2012.6385773);
* drift: error of the last position after making the first poses equal, over the true length of the path;
* KITTI: relative error of all sections of 100, 200 ... 800 m that start every tenth frame, over their length
  (Geiger et al. 2012, doi:10.1109/CVPR.2012.6248074, and its development kit); not over a gap of the truth.

Relative errors over longer stretches, their causes and the claimed covariances:
:mod:`rille.stages.evaluation.trajectory_error`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError
from rille.stages.evaluation.accuracy_parts import along, angle, inverse, metric, posed, rms, square, umeyama
from rille.stages.evaluation.conventions import better_reading
from rille.stages.evaluation.trajectory_error import against_claims, by_cause, by_kitti, by_shares, by_steps
from rille.stages.facts.evaluation import AccuracyFacts, Metric, TruthFacts
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.odometry.resection.trajectory import world_poses


def trajectory_accuracy(
    estimate: Floats, truth: Floats, covariance: Floats | None = None
) -> tuple[dict[str, Floats], dict[str, Metric]]:
    """Compare an estimated trajectory with the true one.

    Parameters
    ----------
    estimate : (frame, 3, 4) T_world_left, metres; NaN where a frame has no pose.
    truth : (frame, 3, 4) T_truth_left of the same frames; NaN where there is no truth.
    covariance : (frame, 6, 6) of the estimate in the world, where it claims one; see
    :mod:`rille.stages.odometry.resection.resect`.

    Returns
    -------
    Arrays ``position``, ``position_truth`` (frame, xyz) and ``displacement``, ``displacement_truth`` (step, xyz), all
    in the world frame (truth brought there by the first frame that has both), and metrics by name.

    Raises
    ------
    InputError
        The numbers of frames differ, no frame has a pose, or none that has one has truth.
    """
    if estimate.shape != truth.shape:
        raise InputError("RIL-300", f"{len(estimate)} estimated and {len(truth)} true poses do not match")
    has_pose, has_truth = posed(estimate), posed(truth)
    if not has_pose.any():
        raise InputError("RIL-301", "no frame has a pose", remedy="see why tracking or resection failed")
    judged = np.flatnonzero(has_pose & has_truth)
    if len(judged) == 0:
        raise InputError("RIL-302", "no frame with a pose has truth", remedy="give truth that covers the chosen frames")
    P, Q = square(estimate), square(truth)
    # By the first frame that has both: a run is judged by what grows from its own start, not by where the truth's
    # origin lies.
    aligned = P[judged[0]] @ inverse(Q[judged[0]]) @ Q
    arrays = _curves(P, aligned)
    metrics = _absolute(P[judged], Q[judged], aligned[judged])
    metrics |= _drift(P, aligned, judged)
    metrics |= _displacement(arrays["displacement"], arrays["displacement_truth"])
    # With the frames between that have no pose: the true path leads on there.
    whole = slice(judged[0], judged[-1] + 1)
    metrics |= by_steps(P, Q) | by_kitti(P, Q) | by_shares(P[whole], Q[whole]) | by_cause(P, Q)
    if covariance is not None:
        metrics |= against_claims(P, aligned, covariance)
    if len(judged) == 1:
        # Its errors are 0 by the alignment, which is no answer.
        why = "not applicable: one frame alone has a pose and truth, and by it they are aligned"
        metrics = {name: metric(None, figure["unit"], why) for name, figure in metrics.items()}
    return arrays, _counts(has_pose, has_truth) | metrics


def _curves(estimate: Floats, truth: Floats) -> dict[str, Floats]:
    """Arrays of the stage, of poses (frame, 3 or 4, 4)."""
    a, b = estimate[:, :3, 3].copy(), truth[:, :3, 3].copy()
    return {
        "position": a,
        "position_truth": b,
        "displacement": np.diff(a, axis=0),
        "displacement_truth": np.diff(b, axis=0),
    }


def _counts(has_pose: Bools, has_truth: Bools) -> dict[str, Metric]:
    return {
        "frames": metric(len(has_pose), "frames", "frames that were to be posed"),
        "frames_missing": metric(int((~has_pose).sum()), "frames", "of them without a pose"),
        "frames_without_truth": metric(int((~has_truth).sum()), "frames", "of them without truth, left out"),
        "frames_judged": metric(int((has_pose & has_truth).sum()), "frames", "of them with a pose and truth"),
    }


def _absolute(P: Floats, Q: Floats, aligned: Floats) -> dict[str, Metric]:
    rotation, translation = umeyama(P[:, :3, 3], Q[:, :3, 3])
    best = P[:, :3, 3] @ rotation.T + translation - Q[:, :3, 3]
    first = P[:, :3, 3] - aligned[:, :3, 3]
    return {
        "ate_rmse": metric(rms(best), "m", "RMS position error after the best rotation and translation, no scale"),
        "ate_first_frame_rmse": metric(rms(first), "m", "RMS position error with the first poses made equal"),
        "ate_first_frame_max": metric(
            float(np.linalg.norm(first, axis=1).max()), "m", "largest position error with the first poses made equal"
        ),
    }


def _drift(P: Floats, aligned: Floats, judged: NDArray[np.intp]) -> dict[str, Metric]:
    last = judged[-1]
    way, bridged = along(aligned[judged[0] : last + 1, :3, 3])
    length = float(way[-1])
    error = float(np.linalg.norm(P[last, :3, 3] - aligned[last, :3, 3]))
    turn = math.degrees(float(angle(inverse(aligned[last]) @ P[last])))
    percent = 100.0 * error / length if length > 0 else None
    how = "error of the last position with the first poses made equal"
    return {
        "path_length": metric(
            length, "m", f"true length from the first to the last frame with pose and truth{bridged}"
        ),
        "final_error": metric(error, "m", how),
        "final_rotation_error": metric(turn, "deg", "rotation error of the last pose, first poses made equal"),
        "drift": metric(
            percent, "%", f"{how}, over the true length{bridged}" if length > 0 else "the camera did not move"
        ),
    }


def _displacement(estimate: Floats, truth: Floats) -> dict[str, Metric]:
    """Figure 9: components of the displacement between successive frames in the first levelled camera frame."""
    error = estimate - truth
    error = error[np.isfinite(error).all(axis=1)]
    return {
        f"displacement_{axis}_rmse": metric(
            float(np.sqrt(np.mean(error[:, k] ** 2))) if len(error) else None,
            "m",
            f"RMS error of the {axis} displacement between successive frames, {len(error)} pairs",
        )
        for k, axis in enumerate("xyz")
    }


def angles_between(a: Floats, b: Floats) -> Floats:
    """Rotation angle (n,), radians, between the orientations of poses (n, 3, 4) and (n, 3, 4)."""
    return angle(np.swapaxes(a[:, :, :3], 1, 2) @ b[:, :, :3])


def by_frame(values: Floats, frames: list[int], wanted: list[int]) -> Floats:
    """Rows (frame, ...) of the wanted frames, of poses or covariances; NaN where there is none."""
    row = {frame: k for k, frame in enumerate(frames)}
    out = np.full((len(wanted), *values.shape[1:]), np.nan)
    for k, frame in enumerate(wanted):
        if frame in row:
            out[k] = values[row[frame]]
    return out


@stage(
    "accuracy",
    version=4,
    outputs=[
        Array("position", ("frame", "xyz"), "float64", "m", "estimated position", "nan", "world"),
        Array("position_truth", ("frame", "xyz"), "float64", "m", "true position, first poses equal", "nan", "world"),
        Array("displacement", ("step", "xyz"), "float64", "m", "estimated displacement per frame", "nan", "world"),
        Array("displacement_truth", ("step", "xyz"), "float64", "m", "true displacement per frame", "nan", "world"),
    ],
)
def accuracy_stage(
    params: NoParams,
    trajectory: Bundle[TrajectoryFacts],
    truth: Bundle[TruthFacts],
    *,
    piece: int | None = None,
    mount: RigidTransform | None = None,
) -> Bundle[AccuracyFacts]:
    """Trajectory against truth: ATE, RPE, displacements, drift, KITTI."""
    given = list(trajectory.meta["frames"])
    wanted = given if truth.meta["frames"] is None else list(truth.meta["frames"])
    poses = world_poses(trajectory, piece)
    estimate, true = by_frame(poses, given, wanted), np.asarray(truth["poses"])
    has_pose, has_truth = posed(estimate), posed(true)
    warnings: list[str] = []
    if len(estimate) == len(true) and not (has_pose & has_truth).any():
        # The report draws the estimate all the same, without a curve of the truth.
        arrays, metrics = _curves(estimate, np.full_like(estimate, np.nan)), _counts(has_pose, has_truth)
    else:
        claims = "covariance" in trajectory.arrays
        claimed = by_frame(np.asarray(trajectory["covariance"]), given, wanted) if claims else None
        arrays, metrics = trajectory_accuracy(estimate, true, claimed)
        if claimed is not None:
            both = has_pose & has_truth
            sigma = float(np.sqrt(np.nanmean(np.trace(claimed[both, :3, :3], axis1=1, axis2=2))))
            warnings = better_reading(estimate[both], true[both], mount or RigidTransform.identity(), sigma)
    facts: AccuracyFacts = {"metrics": metrics, "frames": wanted, "truth": truth.meta["source"]}
    if warnings:
        facts["warnings"] = warnings
    return Bundle(arrays, facts)
