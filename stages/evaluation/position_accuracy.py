"""Trajectory against true positions: truth without rotation, with its own clock and frame.

A GNSS receiver or a total station measures positions alone. Its frame shares at most the vertical with the world; its
clock may be off by a constant. Truth is therefore moved rigidly in the plane (turned about the vertical and shifted; in
height only shifted) so that the squared distances are least (Umeyama 1991, doi:10.1109/34.88573), for each offset of
its clock (:mod:`rille.stages.evaluation.reading.clock`).

If the world's vertical was not measured and the truth has heights, it is moved rigidly in space. The antenna or prism
may stand off the camera: its lever arm ``l`` in the camera's frame (``P_i + R_i l`` is the antenna) is given, or fitted
if turns determine it. The error is that of the camera, ``P_i - (truth_i - R_i l)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.evaluation.accuracy import accuracy_stage, counts, over_length
from rille.stages.evaluation.reading.clock import MIN_FRAMES, Offset, TruePositions, find_offset
from rille.stages.evaluation.reading.conventions import MUCH, UNITS
from rille.stages.facts.evaluation import AccuracyFacts, Metric, metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry.lever_arm import MIN_LEVER_FRAMES, fit_lever_arm
from rille.stages.geometry.rigid import Fit, by_frame, fit_rigid, in_both, rms, standing_out
from rille.stages.odometry.resection.trajectory import world_poses

MAX_ERROR_SHARE = 0.5
"""Share of the error; if other axes, another unit or a lever arm of the truth leave less, a warning says so."""

MEASURED_VERTICAL = "attitude"
"""Source of the vertical by which heights of truth and world have one direction; ground is not level."""


class Comparison(NamedTuple):
    """True positions (frame, 2 or 3) of the camera in the world, NaN where there are none; metrics; warnings; whether
    they fit the trajectory as they were read."""

    truth: Floats
    metrics: dict[str, Metric]
    warnings: list[str]
    fits: bool = True


def position_accuracy(
    poses: Floats, truth: TruePositions, moments: Floats | None = None, upright: bool = True
) -> Comparison:
    """Compare the estimated positions with true ones; a lever arm is fitted if none is stated.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, m; NaN where a frame has no pose.
    truth : positions with their own clock and frame; one row a frame if there are no times.
    moments : (frame,) s, of the images; None if either has no times.
    upright : whether the world's vertical was measured; else truth with heights is fitted in space.
    """
    without = _compared(poses, truth, moments, upright)
    few = without.metrics["frames_judged"]["value"] < MIN_LEVER_FRAMES
    if truth.lever_arm is not None or few or not without.fits:
        return without
    lever, rank = fit_lever_arm(poses, without.truth, upright, None if truth.times is None else moments)
    fitted = _compared(poses, replace(truth, lever_arm=lever), moments, upright)
    before, after = (compared.metrics["position_rmse"]["value"] for compared in (without, fitted))
    # The lever arm of a large vehicle is at most 5 m; a longer one is an error of the track.
    if not rank or np.linalg.norm(lever) > 5.0 or after is None or after > MAX_ERROR_SHARE * before:
        return without
    x, y, z = lever.round(3) + 0.0
    said = (
        f"lever arm fitted: the true positions lie {x:g} m right of, {y:g} m below and {z:g} m ahead of the "
        f"left camera; {after:.2g} m RMS, without it {before:.2g} m: state truth.lever_arm = [{x:g}, {y:g}, {z:g}]"
        " ([0, 0, 0]: none)" + ("" if rank == 3 else "; along the axis of its turns the images do not tell")
    )
    return fitted._replace(warnings=[said, *fitted.warnings])


def _compared(poses: Floats, truth: TruePositions, moments: Floats | None, upright: bool) -> Comparison:
    """:func:`position_accuracy` with the lever arm as it is stated, or none."""
    arm = poses[:, :, :3] @ (np.zeros(3) if truth.lever_arm is None else truth.lever_arm)
    antenna, there, offset, warnings = poses[:, :, 3] + arm, truth.positions, None, []
    clock = "rows matched to frames one to one"
    if moments is not None and truth.times is not None:
        offset = find_offset(moments, antenna, truth, upright)
        shift = 0.0 if offset is None else offset.value
        there, clock = truth.at(moments - shift), f"offset of {shift:.3f} s added to the times of the truth"
    if offset is not None and not offset.determined:
        clock += " (not determined)"
        kept = ", so 0 is kept" if offset.value == 0.0 else ""
        warnings.append(
            f"offset in time of the truth: not determined{kept}; from {offset.low:.2f} to {offset.high:.2f} s the "
            "tracks agree about as well: the motion changes too little"
        )
    fit, both, width, doubt = fit_rigid(antenna, there, upright), in_both(antenna, there), there.shape[1], ""
    if both.sum() >= MIN_FRAMES:
        others = {words: fit_rigid(antenna, axes, upright) for words, axes in _otherwise(there).items()}
        best = min(others, key=lambda words: others[words].error)
        if others[best].error < MAX_ERROR_SHARE * fit.error and others[best].relative < MAX_ERROR_SHARE:
            doubt = f"fit far better {best}"
        else:
            doubt = _jump(antenna[both, :width], fit.moved[both], upright) or _misfit(fit)
    warnings += [f"true positions {doubt}"] if doubt else []
    where = "in the plane" if upright or width == 2 else "in space, since the vertical was not measured"
    # Position of the camera, like the estimate; of the antenna where the camera has no pose.
    moved = fit.moved - np.nan_to_num(arm[:, :width])
    figures = _figures(poses[:, :, 3], moved, f"positions only, after a rigid fit {where}, {clock}")
    return Comparison(moved, figures | (_clock(offset) if offset else {}), warnings, not doubt)


def _jump(antenna: Floats, truth: Floats, upright: bool) -> str:
    """Warning if few steps of the true positions (n, 2 or 3) depart from the antenna's and make most of the error."""
    off = np.diff(truth - antenna, axis=0)
    jumps = standing_out(np.linalg.norm(off, axis=1))
    steady = truth.copy()
    steady[1:] -= np.cumsum(np.where(jumps[:, None], off, 0.0), axis=0)
    target = np.pad(antenna, ((0, 0), (0, 3 - antenna.shape[1])))
    left, error = (fit_rigid(target, source, upright).error for source in (steady, truth))
    if not jumps.any() or left > MAX_ERROR_SHARE * error:
        return ""
    at, size = int(jumps.argmax()), float(np.linalg.norm(off[jumps.argmax()]))
    text = f"jump by {size:.2g} m against the trajectory after {at + 1} of {len(truth)} of them: {error:.2g} m RMS are"
    return f"{text} left, without that {left:.2g} m: correct or remove rows there, unless it is the trajectory's error"


def _misfit(fit: Fit) -> str:
    """Warning if the best fit leaves more than an estimate's error."""
    if fit.relative < MUCH:
        return ""
    text = f"do not fit the trajectory: {fit.error:.2g} m RMS are left, {fit.relative:.0%} of both extents"
    return f"{text}: are they of this drive, and are their columns and times, and the order of the images, right?"


def _otherwise(truth: Floats) -> dict[str, Floats]:
    """Truth (frame, 2 or 3) with other axes or another unit, by their description."""
    mirrored = truth * np.array([1.0, -1.0, 1.0])[: truth.shape[1]]
    readings = {"mirrored: x and y may be swapped; seen from above y lies left of x": mirrored}
    readings |= {f"in units of {unit:g} m: state truth.unit = {unit:g}": unit * truth for unit in UNITS}
    # Metres of a degree of latitude and, on average of where people drive, of longitude.
    degrees = truth * np.array([1e5, 1e5, 1.0])[: truth.shape[1]]
    readings["as degrees of latitude and longitude: project them to metres, as UTM has them"] = degrees
    if truth.shape[1] == 3:
        # Cameras have x to the right, y down and z ahead; their positions are often given in the first one's frame.
        upright = truth[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
        readings['as those of a camera, y down: give [truth] columns = { x = "x", y = "z" }, of the ground'] = upright
    return readings


def _figures(estimate: Floats, truth: Floats, how: str) -> dict[str, Metric]:
    """Figures of positions (frame, 3) against those of the truth (frame, 2 or 3), both in the world."""
    both, width = in_both(estimate, truth), truth.shape[1]
    figures, compared = counts(np.isfinite(estimate[:, 0]), np.isfinite(truth[:, 0])), int(both.sum())
    if compared < MIN_FRAMES:
        why = f"{compared} frames have a pose and a true position, {MIN_FRAMES} are needed"
        return figures | {"position_rmse": metric(why, "m", how)}
    error = (estimate[:, :width] - truth)[both]
    away = np.linalg.norm(error, axis=1)
    first, last = np.flatnonzero(both)[[0, -1]]
    # With frames between that have no pose, since the true path goes on there.
    whole = truth[first : last + 1]
    length, drift = over_length(float(np.linalg.norm(error[-1] - error[0])), whole, f"error of the way, {how}")
    return figures | {
        "position_rmse": metric(rms(error), "m", f"RMS error, {how}"),
        "position_median": metric(float(np.median(away)), "m", f"median error, {how}"),
        "position_max": metric(float(away.max()), "m", f"largest error, {how}"),
        "path_length": length,
        "position_drift": drift,
    }


def _clock(offset: Offset) -> dict[str, Metric]:
    ends = f"from {offset.low:.3f} to {offset.high:.3f} s the squared error at most doubles"
    if not offset.determined:
        ends += ", most or the end of what was searched: not determined"
    half = 0.5 * (offset.high - offset.low)
    return {
        "time_offset": metric(offset.value, "s", f"added to the times of the truth, where the error is least; {ends}"),
        "time_offset_range": metric(half, "s", f"half the range of offsets that fit about as well: {ends}"),
    }


@stage("position_accuracy", outputs=accuracy_stage.outputs)
def position_accuracy_stage(
    params: NoParams,
    trajectory: Bundle[TrajectoryFacts],
    *,
    frames: list[int],
    truth: TruePositions,
    moments: Sequence[float | None] | None = None,
) -> Bundle[AccuracyFacts]:
    """Trajectory against positions without rotation, of a frame and a clock of their own."""
    poses = by_frame(world_poses(trajectory), trajectory.meta["frames"], frames)
    at = None if moments is None else np.array(moments, dtype=np.float64)
    upright = trajectory.meta["verticals"][trajectory.meta["main"]] == MEASURED_VERTICAL
    compared = position_accuracy(poses, truth, at, upright)
    whole = np.full((len(frames), 3), np.nan)
    whole[:, : compared.truth.shape[1]] = compared.truth
    facts: AccuracyFacts = {"metrics": compared.metrics, "frames": frames, "warnings": compared.warnings}
    return Bundle({"position": poses[:, :, 3].copy(), "position_truth": whole}, facts)
