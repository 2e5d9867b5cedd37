"""Trajectory against true positions: truth without rotation, of a clock and of a frame of its own.

A GNSS receiver or a total station says where, not how turned. Its frame shares the vertical with the world at most, its
clock may be off by a constant. Truth is therefore moved rigidly in the plane (turned about the vertical and shifted; in
height it is shifted alone) so that the squared distances are least (Umeyama 1991, doi:10.1109/34.88573), for each
offset of its clock; the offset whose distances are least against the extent of both tracks is taken.

Where the world's vertical was not measured and the truth has heights, it is moved rigidly in space. What was measured
may stand off the camera: its lever arm ``l`` in the camera's frame (``P_i + R_i l`` is the antenna) is given, or fitted
where turns show it. The error is that of the camera, ``P_i - (truth_i - R_i l)``.

An offset can only be found where speed or direction change: on a straight line at constant speed it is a shift of
place. Stated with it is how far it may be moved until the squared error doubles: up to there it adds less than remains,
and what remains (drift, scale) may have moved the best offset as far. Where this range does not end within what was
searched, or takes half of it, the offset is not determined, and that of the stated clocks, 0, is kept if it lies in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.evaluation.accuracy import counts, over_length
from rille.stages.evaluation.conventions import UNITS
from rille.stages.facts.evaluation import AccuracyFacts, Metric, metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.geometry.lever_arm import MIN_LEVER_FRAMES, fit_lever_arm
from rille.stages.geometry.rigid import by_frame, fit_rigid, in_both, rms
from rille.stages.odometry.resection.trajectory import world_poses

MIN_FRAMES = 4
"""Fewest frames with pose and truth: more than the unknowns (turn, shift, clock offset) take up."""

MAX_OFFSET_S = 10.0
"""Largest clock offset that is searched where the clocks have a time in common: a longer search finds other stretches
of the track that look alike."""

MIN_SHARE = 2 / 3
"""Smallest number of compared frames, as a share of the most that any offset compares: few frames fit anywhere."""

EQUAL_ERROR = 2**0.5
"""Factor on the least error up to which offsets count as equally good: they add less to it than what remains."""


MAX_TRIALS = 20000
"""Most offsets that are tried before the best one is refined."""

MAX_ERROR_SHARE = 0.5
"""Where other axes, another unit or a lever arm of the truth leave less than this share of the error, it is said."""

MEASURED_VERTICAL = "attitude"
"""Source of the vertical by which heights of truth and world have one direction; ground is not level."""


@dataclass(frozen=True)
class TruePositions:
    """``positions`` (row, 2 or 3), m, x and y in the plane and z up; ``times`` (row,), s; rows are frames without.

    Nothing is interpolated between rows that are more than ``max_gap`` s apart. ``lever_arm`` (3,), m, is the place of
    the antenna or prism in the left camera's frame (x right, y down, z ahead); None: not known.
    """

    positions: Floats
    times: Floats | None = None
    max_gap: float = 0.5
    lever_arm: Floats | None = None

    def at(self, moments: Floats) -> Floats:
        """Positions (moment, 2 or 3) on the straight line between two rows; NaN in longer gaps and beyond the ends."""
        assert self.times is not None
        after = np.searchsorted(self.times, moments).clip(0, len(self.times) - 1)
        start, end = self.times[(after - 1).clip(0)], self.times[after]
        known = (start <= moments) & (moments <= end) & (end - start <= self.max_gap)
        # At a row itself a gap beside it does not matter; and times are written with few digits: the first and the last
        # image must not fall out by a rounding.
        known |= np.minimum(np.abs(moments - start), np.abs(moments - end)) <= 1e-6
        places = np.stack([np.interp(moments, self.times, axis) for axis in self.positions.T], axis=1)
        return np.where(known[:, None], places, np.nan)


class Offset(NamedTuple):
    """Seconds to add to the times of the truth; ``low`` and ``high``: until there the squared error at most doubles, to
    half the time between frames.

    ``determined``: both ends lie within what was searched, and close enough together.
    """

    value: float
    low: float
    high: float
    determined: bool


def find_offset(moments: Floats, estimate: Floats, truth: TruePositions, upright: bool = True) -> Offset | None:
    """The constant offset of the truth's clock against that of the images.

    Parameters
    ----------
    moments : (frame,) s, of the images.
    estimate : (frame, 3) m in the world, NaN of a frame without a pose.

    Returns
    -------
    None where no offset makes :data:`MIN_FRAMES` frames comparable.
    """
    tried = _candidates(moments, truth)
    posed = np.isfinite(estimate).all(axis=1)
    moments, estimate = moments[posed], estimate[posed]
    # An offset at which few frames have truth fits almost anything.
    counts = np.array([np.isfinite(truth.at(moments - offset)[:, 0]).sum() for offset in tried])
    least = max(MIN_FRAMES, MIN_SHARE * counts.max(initial=0))

    def error(offset: float) -> float:
        there = truth.at(moments - offset)
        return fit_rigid(estimate, there, upright).relative if np.isfinite(there[:, 0]).sum() >= least else np.inf

    errors = np.array([error(offset) for offset in tried])
    if not np.isfinite(errors).any():
        return None
    value, step = float(tried[np.argmin(errors)]), float(tried[1] - tried[0])
    span, options = (value - step, value + step), {"xatol": 1e-5}
    near = scipy.optimize.minimize_scalar(error, bounds=span, method="bounded", options=options)
    value = value if errors.min() <= near.fun else float(near.x)
    worse = np.flatnonzero(errors > EQUAL_ERROR * error(value))
    above = int(np.searchsorted(tried[worse], value))
    # The nearest worse offset to either side; without one, and where too few frames are compared, no end was reached.
    ends = [worse[above - 1] if above > 0 else 0, worse[above] if above < len(worse) else -1]
    ended = [bool(EQUAL_ERROR * error(value) < errors[k] < np.inf) for k in ends]
    low, high = (float(tried[k]) for k in ends)
    # 0.5: share of the searched range: where equally good offsets span more, the offset is not determined.
    determined = all(ended) and high - low < 0.5 * np.ptp(tried[np.isfinite(errors)])
    return Offset(0.0 if not determined and low <= 0.0 <= high else value, low, high, bool(determined))


def _candidates(moments: Floats, truth: TruePositions) -> Floats:
    """Offsets (n,) to try, s, half a frame apart: near 0 where the clocks have a time in common, else all."""
    assert truth.times is not None
    low, high = float(moments[0] - truth.times[-1]), float(moments[-1] - truth.times[0])
    step = 0.5 * float(np.median(np.diff(moments))) if len(moments) > 1 else 0.1
    if low < 0.0 < high:
        low, high = max(low, -MAX_OFFSET_S), min(high, MAX_OFFSET_S)
        # Of images a minute apart half a frame is more than all that is searched.
        step = min(max(step, (high - low) / MAX_TRIALS), 0.5 * (high - low))
        return np.asarray(step * np.arange(np.ceil(low / step), np.floor(high / step) + 1))
    return np.linspace(low, high, int(np.clip((high - low) / step, 2, MAX_TRIALS)) + 1)


class Comparison(NamedTuple):
    """True positions (frame, 2 or 3) in the world, NaN where there are none, less the lever arm; figures; warnings."""

    truth: Floats
    metrics: dict[str, Metric]
    warnings: list[str]


def position_accuracy(
    poses: Floats, truth: TruePositions, moments: Floats | None = None, upright: bool = True
) -> Comparison:
    """Compare the estimated positions with true ones, by a lever arm that is fitted where none is stated.

    Parameters
    ----------
    poses : (frame, 3, 4) T_world_left, m; NaN where a frame has no pose.
    truth : positions of a clock and frame of their own; one row a frame where there are no times.
    moments : (frame,) s, of the images; None where either has no times.
    upright : whether the world's vertical was measured; else truth with heights is fitted in space.
    """
    without = _compared(poses, truth, moments, upright)
    if truth.lever_arm is not None or without.metrics["frames_judged"]["value"] < MIN_LEVER_FRAMES:
        return without
    lever, rank = fit_lever_arm(poses, without.truth, upright, None if truth.times is None else moments)
    fitted = _compared(poses, replace(truth, lever_arm=lever), moments, upright)
    before, after = (compared.metrics["position_rmse"]["value"] for compared in (without, fitted))
    # That of a large vehicle is at most 5 m; more is an error of the track.
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
    """The same with the lever arm as it is stated, or none."""
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
    fit, both, width = fit_rigid(antenna, there, upright), in_both(antenna, there), there.shape[1]
    if both.sum() >= MIN_FRAMES:
        others = {words: fit_rigid(antenna, axes, upright) for words, axes in _otherwise(there).items()}
        best = min(others, key=lambda words: others[words].error)
        if others[best].error < MAX_ERROR_SHARE * fit.error and others[best].relative < MAX_ERROR_SHARE:
            warnings.append(f"true positions fit far better {best}")
    where = "in the plane" if upright or width == 2 else "in space, since the vertical was not measured"
    # Of the camera, as the estimate is; where it has no pose, of the antenna.
    moved = fit.moved - np.nan_to_num(arm[:, :width])
    figures = _figures(poses[:, :, 3], moved, f"positions only, after a rigid fit {where}, {clock}")
    return Comparison(moved, figures | (_clock(offset) if offset else {}), warnings)


def _otherwise(truth: Floats) -> dict[str, Floats]:
    """Truth (frame, 2 or 3) as it would be if its axes or its unit were others, by the words that say so."""
    mirrored = truth * np.array([1.0, -1.0, 1.0])[: truth.shape[1]]
    readings = {"mirrored: x and y may be swapped; seen from above y lies left of x": mirrored}
    readings |= {f"in units of {unit:g} m: state truth.unit = {unit:g}": unit * truth for unit in UNITS}
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
    # With the truth of frames between that have no pose: the true path leads on there.
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


@stage(
    "position_accuracy",
    version=2,
    outputs=[
        Array("position", ("frame", "xyz"), "float64", "m", "estimated position", "nan", "world"),
        Array("position_truth", ("frame", "xyz"), "float64", "m", "true position, moved in the plane", "nan", "world"),
    ],
)
def position_accuracy_stage(
    params: NoParams,
    trajectory: Bundle[TrajectoryFacts],
    *,
    frames: list[int],
    truth: Mapping[str, Any],
    moments: Sequence[float | None] | None,
) -> Bundle[AccuracyFacts]:
    """Trajectory against positions without rotation, of a frame and a clock of their own."""
    poses = by_frame(world_poses(trajectory), trajectory.meta["frames"], frames)
    numbers = {name: None if truth[name] is None else np.array(truth[name]) for name in ("times", "lever_arm")}
    given = TruePositions(np.array(truth["positions"], dtype=np.float64), max_gap=truth["max_gap"], **numbers)
    at = None if moments is None else np.array(moments, dtype=np.float64)
    upright = trajectory.meta["verticals"][trajectory.meta["main"]] == MEASURED_VERTICAL
    compared = position_accuracy(poses, given, at, upright)
    whole = np.full((len(frames), 3), np.nan)
    whole[:, : compared.truth.shape[1]] = compared.truth
    facts: AccuracyFacts = {"metrics": compared.metrics, "frames": frames, "warnings": compared.warnings}
    return Bundle({"position": poses[:, :, 3].copy(), "position_truth": whole}, facts)
