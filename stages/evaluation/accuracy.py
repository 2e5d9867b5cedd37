"""Trajectory against truth: absolute and relative errors, drift, scale, and the claimed covariances (section 7.4).

``P_i`` are estimated, ``Q_i`` true poses of the left camera. Frames without an estimate, and frames without truth, are
counted and left out. Where truth has a gap, its path is taken to be straight, which is the least that it can be.

* ATE: RMS distance of the positions after the best rotation and translation (Umeyama 1991,
  doi:10.1109/34.88573, without scale);
* RPE: ``(Q_i^-1 Q_i+1)^-1 (P_i^-1 P_i+1)`` of successive frames (Sturm et al. 2012, doi:10.1109/IROS.2012.6385773);
* drift: error of the last position after making the first poses equal, over the true length of the path;
* scale: least-squares factor between the lengths of the motions of successive frames;
* NEES: mean squared error over the claimed one, per degree of freedom: 1 if the claims are right; of whole poses,
  of positions and of rotations, since a truth may be good in one and poor in the other. Errors of the truth itself,
  where they are stated, are added to what is claimed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.evaluation.claims import CLAIMS, nees, truth_covariance
from rille.stages.evaluation.reading.clock import TruePositions, late_truth
from rille.stages.evaluation.reading.conventions import better_reading
from rille.stages.evaluation.reading.hand_eye import hand_eye, misplaced, without_it
from rille.stages.facts.evaluation import AccuracyFacts, Metric, metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry import rigid
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.rigid import posed, rms
from rille.stages.odometry.resection.trajectory import world_poses


class TruthSource(NamedTuple):
    """Source of the true poses: ``mount``, T_body_left, by which its poses were multiplied; their ``sigmas``, m and
    rad; ``record``, its positions at its own times, and ``moments`` (frame,), s, of the images.
    """

    mount: RigidTransform = RigidTransform.identity()
    sigmas: tuple[float, float] = (0.0, 0.0)
    record: TruePositions | None = None
    moments: Sequence[float] | None = None

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> TruthSource:
        """From its JSON form."""
        record = d["record"] and TruePositions.from_dict(d["record"])
        return TruthSource(RigidTransform.from_matrix(d["mount"]), d["sigmas"], record, d["moments"])


def trajectory_accuracy(
    estimate: Floats,
    truth: Floats,
    covariance: Floats | None = None,
    sigma_m: float = 0.0,
    sigma_rad: float = 0.0,
) -> tuple[dict[str, Floats], dict[str, Metric]]:
    """Compare an estimated trajectory with the true one.

    Parameters
    ----------
    estimate : (frame, 3, 4) T_world_left, metres; NaN where a frame has no pose.
    truth : (frame, 3, 4) T_truth_left of the same frames; NaN where there is no truth.
    covariance : (frame, 6, 6) of the estimate in the world, if it has one; see
    :mod:`rille.stages.odometry.resection.resect`.
    sigma_m, sigma_rad : standard deviations of the true positions, and of the true rotations about each axis.

    Returns
    -------
    Arrays ``position``, ``position_truth`` (frame, xyz) in the world frame (truth aligned at the first frame that has
    both), and metrics by name; errors do not apply with fewer than two frames that have both.
    """
    has_pose, has_truth = posed(estimate), posed(truth)
    judged, figures = np.flatnonzero(has_pose & has_truth), counts(has_pose, has_truth)
    aligned = np.full_like(truth, np.nan)
    if len(judged):
        # Aligned at the first frame that has both: drift grows from the start of the run, not from the truth's origin.
        start = judged[0]
        aligned = rigid.compose(estimate[start], rigid.compose(rigid.inverse(truth[start]), truth))
    if len(judged) > 1:
        # With frames between that have no pose, since the true path goes on there.
        whole = slice(judged[0], judged[-1] + 1)
        figures |= _absolute(estimate[whole, :, 3], aligned[whole, :, 3])
        figures |= _relative(estimate, truth) | _scale(estimate, truth)
    else:
        figures["drift"] = metric("fewer than two frames have a pose and truth", "%", "")
    if covariance is not None and len(judged) > 1:
        how = "squared error over the claimed one per degree of freedom, mean over frames (NEES); 1 is right"
        if sigma_m or sigma_rad:
            how += f"; with {sigma_m:g} m and {math.degrees(sigma_rad):g} degrees of the truth itself"
        total = covariance + truth_covariance(estimate[:, :, 3] - estimate[start, :, 3], sigma_m, sigma_rad)
        values = nees(estimate, aligned, total)
        figures |= {name: metric(values[name], "", how + whose) for name, _, whose in CLAIMS}
    return {"position": estimate[:, :, 3].copy(), "position_truth": aligned[:, :, 3].copy()}, figures


def counts(has_pose: Bools, has_truth: Bools) -> dict[str, Metric]:
    """Numbers of frames (frame,) by whether they have a pose and truth, by name."""
    return {
        "frames": metric(len(has_pose), "frames", "frames that were to be posed"),
        "frames_missing": metric(int((~has_pose).sum()), "frames", "of them without a pose"),
        "frames_without_truth": metric(int((~has_truth).sum()), "frames", "of them without truth, left out"),
        "frames_judged": metric(int((has_pose & has_truth).sum()), "frames", "of them with a pose and truth"),
    }


def over_length(error: float, truth: Floats, what: str) -> tuple[Metric, Metric]:
    """Length, m, of the true path (frame, 2 or 3) of the judged frames; ``error``, m, at its end over the length."""
    length = float(rigid.lengths_along(truth)[-1])
    drift = 100.0 * error / length if length > 0 else "the camera did not move"
    way = "true length from the first to the last judged frame, straight over gaps of the truth"
    return metric(length, "m", way), metric(drift, "%", f"{what}, over the true length")


def _absolute(P: Floats, Q: Floats) -> dict[str, Metric]:
    """Errors of positions (frame, 3), m, both in the world; the first and the last frame have both."""
    both = np.isfinite(P + Q).all(axis=1)
    rotation, translation = rigid.umeyama(P[both], Q[both])
    best = rms(P[both] @ rotation.T + translation - Q[both])
    error, last = float(np.linalg.norm(P[-1] - Q[-1])), "error of the last position with the first poses made equal"
    length, drift = over_length(error, Q, last)
    return {
        "ate_rmse": metric(best, "m", "RMS position error after the best rotation and translation, no scale"),
        "path_length": length,
        "final_error": metric(error, "m", last),
        "drift": drift,
    }


def _relative(P: Floats, Q: Floats) -> dict[str, Metric]:
    """Errors of the motion between successive frames."""
    E = rigid.relative_error(*rigid.steps(P, Q))
    how = f"RMS error of the motion between successive frames, {len(E)} pairs"
    return {
        "rpe_translation_rmse": metric(rms(E[:, :, 3]), "m", how),
        "rpe_rotation_rmse": metric(math.degrees(rms(rigid.angle(E)[:, None])), "deg", f"{how}, rotation"),
    }


def _scale(P: Floats, Q: Floats) -> dict[str, Metric]:
    """Error of the scale of the motions between successive frames."""
    p, q = (motions[:, :, 3] for motions in rigid.steps(P, Q))
    if len(p) < 3 or np.linalg.norm(q, axis=1).sum() < 1e-6:
        return {"scale_error": metric("fewer than three motions, or the camera did not move", "%", "")}
    square = float((q * q).sum())
    scale = float((p * q).sum()) / square
    # Standard error of a least-squares factor: residual variance over the sum of squares.
    sigma = math.sqrt(float(((p - scale * q) ** 2).sum()) / (3 * len(p) - 1) / square)
    how = (
        f"estimated over true length of the motions, +- {100.0 * sigma:.2g}; hangs on baseline, toe-in and focal length"
    )
    return {"scale_error": metric(100.0 * (scale - 1.0), "%", how)}


def pose_rows(poses: Sequence[Sequence[float] | None]) -> Floats:
    """Poses (frame, 3, 4) of lists of twelve numbers, NaN for None."""
    return np.array([pose or [np.nan] * 12 for pose in poses], dtype=np.float64).reshape(-1, 3, 4)


@stage(
    "accuracy",
    outputs=[
        Array("position", ("frame", "xyz"), "float64", "m", "estimated position", "nan", "world"),
        Array("position_truth", ("frame", "xyz"), "float64", "m", "true position, laid on it", "nan", "world"),
    ],
)
def accuracy_stage(
    params: NoParams,
    trajectory: Bundle[TrajectoryFacts],
    *,
    frames: list[int],
    truth: Sequence[Sequence[float] | None],
    source: TruthSource | None = None,
) -> Bundle[AccuracyFacts]:
    """Trajectory against the true poses of some frames: ATE, RPE, drift, scale, NEES."""
    given, true, source = trajectory.meta["frames"], pose_rows(truth), source or TruthSource()
    estimate, claimed = rigid.by_frame(world_poses(trajectory), given, frames), None
    if "covariance" in trajectory.arrays:
        claimed = rigid.by_frame(np.asarray(trajectory["covariance"]), given, frames)
    arrays, figures = trajectory_accuracy(estimate, true, claimed, *source.sigmas)
    facts: AccuracyFacts = {"metrics": figures, "frames": frames}
    both = posed(estimate) & posed(true)
    if claimed is not None and both.sum() > 1:
        stated = math.sqrt(np.nanmean(np.trace(claimed[both, :3, :3], axis1=1, axis2=2)))
        off = hand_eye(estimate, true)
        mounted = None if off is None else rigid.compose(true[both], off)
        warnings = better_reading(estimate[both], true[both], source.mount, stated, mounted)
        off = None if warnings else off
        late = None
        # Errors within the estimate's stated ones another clock might fit by chance.
        if source.record is not None and not warnings and float(figures["ate_rmse"]["value"] or 0.0) > stated:
            late = late_truth(np.array(source.moments), estimate[:, :, 3], source.record)
        if off is not None:
            _, without = trajectory_accuracy(estimate, rigid.compose(true, off), claimed, *source.sigmas)
            left = float(without["ate_rmse"]["value"] or 0.0)
            # A lever arm ahead and a clock offset have the same effect except in turns.
            if late is None or left <= late.error:
                late, warnings = None, [misplaced(off, source.mount, figures, without)]
                figures |= without_it(off, without)
        if late is not None:
            as_given = f"as given {figures['ate_rmse']['value']:.2g} m"
            words = f"with {late.offset:.3f} s added to its times {late.error:.2g} m RMS are left after the best fit"
            warnings = [f"the truth's clock is off: {words}, {as_given}: add that to truth.time_offset"]
        if warnings:
            facts["warnings"] = warnings
    return Bundle(arrays, facts)
