"""Errors of a trajectory: by length of the path, by cause, and against its stated covariances.

Source of the relative errors: Sturm et al. 2012 (doi:10.1109/IROS.2012.6385773), over several numbers of frames;
Geiger et al. 2012 (doi:10.1109/CVPR.2012.6248074) and Zhang and Scaramuzza 2018 (doi:10.1109/IROS.2018.8593941), over
shares of the path, for paths shorter than KITTI's sections.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.evaluation.accuracy_parts import along, angle, inverse, metric, posed, relative_error, rms
from rille.stages.facts.evaluation import Metric
from rille.stages.geometry.geometry import cross_matrix, rotation_log

STEPS = (2, 5, 10, 20, 50)
"""Numbers of frames between the two poses of a relative error."""
SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Lengths of sections, as shares of the true path."""
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10
MIN_MOVED_M = 1e-6
"""Length [m] of the true path below which a camera counts as at rest, and has no scale error."""
MIN_SIGMAS = 3.0
"""Size of a systematic error, in its standard errors, from which on it counts as more than chance."""


def _motions(P: Floats, Q: Floats, step: int) -> Floats:
    """Relative errors (n, 4, 4) of all pairs of frames that are ``step`` apart and have poses in P and Q."""
    E = relative_error(P, Q, slice(None, -step), slice(step, None))
    return E[posed(E)]


def _rotation_rmse(E: Floats) -> float:
    """RMS rotation angle of transforms (n, 4, 4), degrees."""
    return float(np.sqrt(np.mean(np.degrees(angle(E)) ** 2)))


def by_steps(P: Floats, Q: Floats) -> dict[str, Metric]:
    """Relative errors of poses (n, 4, 4) from frame to frame, and over several numbers of frames."""
    E = _motions(P, Q, 1)
    if len(E) == 0:
        none = "not applicable: no two successive frames have poses"
        return {k: metric(None, u, none) for k, u in (("rpe_translation_rmse", "m"), ("rpe_rotation_rmse", "deg"))}
    shift, how = np.linalg.norm(E[:, :3, 3], axis=1), f"of the motion between successive frames, {len(E)} pairs"
    metrics = {
        "rpe_translation_rmse": metric(rms(E[:, :3, 3]), "m", f"RMS error {how}"),
        "rpe_translation_median": metric(float(np.median(shift)), "m", f"median error {how}"),
        "rpe_translation_max": metric(float(shift.max()), "m", f"largest error {how}"),
        "rpe_rotation_rmse": metric(_rotation_rmse(E), "deg", f"RMS rotation error {how}"),
    }
    for step in STEPS:
        E = _motions(P, Q, step)
        if len(E):
            how = f"of the motion over {step} frames, {len(E)} pairs"
            metrics[f"rpe_{step}_translation_rmse"] = metric(rms(E[:, :3, 3]), "m", f"RMS error {how}")
            metrics[f"rpe_{step}_rotation_rmse"] = metric(_rotation_rmse(E), "deg", f"RMS rotation error {how}")
    return metrics


def _section_errors(E: Floats, length: Any) -> Floats:
    """Shift, m, and angle, rad (n, 2), of relative errors (n, 4, 4) over the length of their sections, m."""
    return np.stack([np.linalg.norm(E[:, :3, 3], axis=1), angle(E)], axis=1) / np.reshape(length, (-1, 1))


def by_shares(P: Floats, Q: Floats) -> dict[str, Metric]:
    """Relative errors over sections of 10 to 80 % of the true path, from every frame, but not over a gap of the truth:
    mean, over their length."""
    way, _ = along(Q[:, :3, 3])
    total, why = float(way[-1]), "not applicable: no section has poses at both ends and truth throughout"
    # Equal at both ends of a section: no frame between is without truth.
    gaps, errors = np.cumsum(~posed(Q)), []
    for share in SHARES if total >= MIN_MOVED_M else ():
        last = np.searchsorted(way, way + share * total, side="left")
        first = np.flatnonzero(last < len(way))
        last = last[first]
        E, length = relative_error(P, Q, first, last), way[last] - way[first]
        known = posed(E) & (gaps[first] == gaps[last]) & (length > 0)
        errors += list(_section_errors(E[known], length[known]))
    if total < MIN_MOVED_M:
        why = "not applicable: the camera did not move"
    how = f"mean relative error of {len(errors)} sections of 10-80 % of the path, from every frame"
    shift, turn = np.mean(errors, axis=0) if errors else (math.nan, math.nan)
    return {
        "sections_translation": metric(100.0 * float(shift), "%", how if errors else why),
        "sections_rotation": metric(math.degrees(float(turn)), "deg/m", how if errors else why),
    }


def by_kitti(P: Floats, Q: Floats) -> dict[str, Metric]:
    """KITTI's relative errors, from the inverse of the other errors here, of the same length and angle."""
    way, has_truth, errors = along(Q[:, :3, 3])[0], np.isfinite(Q[:, 0, 0]), []
    for first in range(0, len(Q), KITTI_STEP):
        for length in KITTI_LENGTHS:
            # The first frame beyond the length, as in the development kit.
            last = int(np.searchsorted(way, way[first] + length, side="right"))
            if last < len(Q) and np.isfinite(P[[first, last]]).all() and has_truth[first : last + 1].all():
                errors += list(_section_errors(relative_error(Q, P, first, last)[None], length))
    how = f"mean relative error of {len(errors)} sections of 100-800 m, one set every {KITTI_STEP} frames"
    if not errors:
        how = f"not applicable: the true path is {way[-1]:.1f} m long, the shortest section 100 m"
        if way[-1] > KITTI_LENGTHS[0]:
            how = "not applicable: no section of 100 m has poses at both ends and truth throughout"
    shift, turn = np.mean(errors, axis=0) if errors else (math.nan, math.nan)
    return {
        "kitti_translation": metric(100.0 * float(shift), "%", how),
        "kitti_rotation": metric(100.0 * math.degrees(float(turn)), "deg/100 m", how),
    }


def by_cause(P: Floats, Q: Floats) -> dict[str, Metric]:
    """Errors of the motion between successive frames, split: scale, direction, rotation, and what is left.

    With p and q the estimated and the true displacement in the camera of the earlier frame: the scale is the
    least-squares factor of q, the direction the angle between their means, and what remains scatters.
    """
    here = posed(P) & posed(Q)
    both = here[:-1] & here[1:]
    dP, dQ = (inverse(T[:-1][both]) @ T[1:][both] for T in (P, Q))
    p, q = dP[:, :3, 3], dQ[:, :3, 3]
    length = float(np.linalg.norm(q, axis=1).sum())
    if len(p) < 3 or length < MIN_MOVED_M:
        why = "not applicable: fewer than three motions" if len(p) < 3 else "not applicable: the camera did not move"
        return {"scale_error": metric(None, "%", why)}
    scale = float((p * q).sum() / (q * q).sum())
    rest = p - scale * q
    # Standard error of a least-squares factor: residual variance over the sum of squares.
    bound = float(np.sqrt((rest**2).sum() / (3 * len(p) - 1) / (q * q).sum()))
    a, b = q.mean(0), p.mean(0)
    swing = _between(a, b)
    pointed = min(float(np.linalg.norm(a)), float(np.linalg.norm(b))) >= MIN_MOVED_M
    direction = math.degrees(math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b)))
    turns = rotation_log(np.swapaxes(dQ[:, :3, :3], 1, 2) @ dP[:, :3, :3])
    mean, count = turns.mean(0), len(turns)
    bias = float(np.linalg.norm(mean))
    error = float(np.sqrt(((turns - mean) ** 2).sum() / max(count - 1, 1) / count))
    per_metre = math.degrees(bias) * count / length
    sure = "" if abs(scale - 1.0) > MIN_SIGMAS * bound else ", which is not told from chance"
    steady = "" if bias > MIN_SIGMAS * error else ", which is not told from chance"
    return {
        "scale_error": metric(
            100.0 * (scale - 1.0),
            "%",
            f"estimated over true length of the motions, +- {100.0 * bound:.2g}{sure}; hangs on baseline, toe-in and"
            " focal length",
        ),
        "direction_error": metric(
            direction if pointed else None,
            "deg",
            "between the mean motions, estimated and true, in the camera; hangs on mount and pitch"
            if pointed
            else "not applicable: motions that cancel have no mean direction",
        ),
        "rotation_bias": metric(
            per_metre, "deg/m", f"mean rotation error{steady}; hangs on principal point and lens distortion"
        ),
        "scatter": metric(rms(p - scale * (q @ swing.T)), "m", "RMS of what remains of a frame's motion: tracking"),
    }


def _between(a: Floats, b: Floats) -> Floats:
    """Least rotation (3, 3) from the direction of a to that of b; the identity where either is none, or they oppose."""
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    # Beyond a right angle the scale is negative, and has turned the motion already.
    if size < MIN_MOVED_M**2 or float(a @ b) <= 0:
        return np.eye(3)
    k = cross_matrix(np.cross(a, b) / size)
    return np.asarray(np.eye(3) + k + k @ k / (1.0 + float(a @ b) / size))


def against_claims(P: Floats, aligned: Floats, covariance: Floats) -> dict[str, Metric]:
    """Mean squared error over the claimed one, per degree of freedom (NEES): 1 where the claims are right.

    ``covariance`` (n, 6, 6) of (position m, rotation rad) in the world whose origin is the first posed frame, which is
    exact: ``aligned`` is the truth with the first poses made equal.
    """
    claimed = posed(P) & posed(covariance)
    known = claimed & posed(aligned)
    # The first frame is exact by definition and has no covariance to judge.
    rows, origin = np.flatnonzero(known)[1:], int(np.argmax(claimed))
    why = ""
    if len(rows) == 0:
        why = "no covariances of frames behind the first"
    elif not known[origin]:
        why = "the first posed frame, where the covariances begin, has no truth"
    elif not (np.linalg.eigvalsh(covariance[rows])[:, 0] > 0).all():
        why = "a covariance is singular"
    if why:
        return {"nees": metric(None, "", f"not applicable: {why}")}
    turn = rotation_log(aligned[rows, :3, :3] @ np.swapaxes(P[rows, :3, :3], 1, 2))
    error = np.concatenate([aligned[rows, :3, 3] - P[rows, :3, 3], turn], axis=1)
    weighed = np.linalg.solve(covariance[rows], error[..., None])[..., 0]
    value = float((error * weighed).sum(1).mean()) / 6.0
    how = "squared error over the claimed one per degree of freedom, mean over frames (NEES); 1 is right"
    return {"nees": metric(value, "", how)}
