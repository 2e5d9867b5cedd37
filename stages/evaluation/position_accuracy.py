"""Trajectory against true positions: truth without rotation, of a clock and of a frame of its own.

A GNSS receiver or a total station says where, not how turned. Its frame shares the vertical with the world at most, its
clock may be off by a constant. Truth is therefore moved rigidly in the plane (turned about the vertical and shifted; in
height it is shifted alone) so that the squared distances are least, for each offset of its clock; the offset whose
distances are least against the extent of both tracks is taken.

Where the world's vertical was not measured and the truth has heights, it is moved rigidly in space. What was measured
may stand off the camera: its lever arm ``l`` in the camera's frame (``P_i + R_i l`` is the antenna) is given, or fitted
where turns show it. The error is that of the camera, ``P_i - (truth_i - R_i l)``.

With positions as complex numbers, ``a_i`` estimated and ``b_i`` true about their means, the best turn is
``exp(i theta) = sum(conj(b_i) a_i) / |sum(conj(b_i) a_i)|``.

An offset can only be found where speed or direction change: on a straight line at constant speed it is a shift of
place. Stated with it is how far it may be moved until the squared error doubles: up to there it adds less than remains,
and what remains (drift, scale) may have moved the best offset as far. Where this range does not end within what was
searched, or takes half of it, the offset is not determined, and that of the stated clocks, 0, is kept if it lies in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.evaluation.accuracy import by_frame
from rille.stages.evaluation.accuracy_parts import along, metric, rms, umeyama
from rille.stages.evaluation.conventions import UNITS
from rille.stages.facts.evaluation import AccuracyFacts, Metric
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.odometry.resection.trajectory import world_poses

LEAST = 4
"""Fewest frames with pose and truth: more than the unknowns (turn, shift, clock offset) take up."""

REACH = 10.0
"""Largest clock offset [s] that is searched where the clocks have a time in common: a longer search finds other
stretches of the track that look alike."""

SHARE = 2 / 3
"""Smallest number of compared frames, as a share of the most that any offset compares: few frames fit anywhere."""

GROWTH = 2**0.5
"""Factor on the least error up to which offsets count as equally good: they add less to it than what remains."""

WITHIN = 1e-6
"""Difference [s] below which two times are the same."""

WIDE = 0.5
"""Share of the searched range: where equally good offsets span more, the offset is not determined."""

MOST = 20000
"""Most offsets that are tried before the best one is refined."""

ANOTHER = 0.5
"""Share of the error: where other axes, another unit or a lever arm of the truth leave less than this, it is said."""

# By which a lever arm is fitted: with turn, shift and clock it has up to ten unknowns.
MIN_LEVER_FRAMES = 10
# RMS way of the antenna about the camera over its lever arm, from which on turns show it: they are 6 degrees.
MIN_SWING = 0.1
# m, of a large vehicle; more is an error of the track.
MAX_LEVER_ARM = 5.0
# Sources of the vertical by which heights of truth and world have one direction; ground is not level.
MEASURED = ("attitude",)


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
        t = self.times
        # Times are written with few digits: the first and the last image must not fall out by a rounding.
        moments = np.where(moments < t[0], np.minimum(moments + WITHIN, t[0]), moments)
        moments = np.where(moments > t[-1], np.maximum(moments - WITHIN, t[-1]), moments)
        after = np.clip(np.searchsorted(t, moments, side="left"), 1, max(len(t) - 1, 1))
        known = (moments >= t[0]) & (moments <= t[-1])
        if len(t) > 1:
            at_row = np.minimum(np.abs(moments - t[after - 1]), np.abs(moments - t[after])) <= WITHIN
            # At a row itself a gap beside it does not matter.
            known &= (t[after] - t[after - 1] <= self.max_gap) | at_row
        moved = np.stack([np.interp(moments, t, axis) for axis in self.positions.T], axis=1)
        return np.where(known[:, None], moved, np.nan)


class Fit(NamedTuple):
    """Truth moved into the world: (frame, 2 or 3) m; ``error``: RMS, m; ``relative``: over the extent of the tracks."""

    moved: Floats
    error: float
    relative: float


class Offset(NamedTuple):
    """Seconds to add to the times of the truth; ``low`` and ``high``: until there the squared error at most doubles.

    ``determined``: both ends lie within what was searched, and close enough together.
    """

    value: float
    low: float
    high: float
    determined: bool


def fit_rigid(estimate: Floats, truth: Floats, upright: bool = True) -> Fit:
    """Truth (frame, 2 or 3) turned and shifted to the estimated positions (frame, 3), m.

    It is turned about the vertical alone where the world is ``upright``, i.e. its vertical was measured, and where the
    truth has no heights. Rows of NaN in either do not count, but are moved as well.
    """
    width = truth.shape[1]
    both = _both(estimate, truth)
    if not both.any():
        return Fit(np.full_like(truth, np.nan), np.inf, np.inf)
    centre, origin = estimate[both, :width].mean(axis=0), truth[both].mean(axis=0)
    a, b = estimate[:, :width] - centre, truth - origin
    if upright or width == 2:
        # Its angle is the turn of least squares in the plane, see the module.
        cross = np.sum(np.conj(_plane(b[both])) * _plane(a[both]))
        turned = _plane(b) * (cross / abs(cross) if abs(cross) > 0 else 1.0)
        b[:, 0], b[:, 1] = turned.real, turned.imag
    else:
        b = b @ umeyama(b[both], a[both])[0].T
    error = rms(a[both] - b[both])
    # Against the extent of both tracks: else the offset wins that compares the fewest, nearest frames.
    extent = np.sqrt(np.mean(np.sum(a[both] ** 2, axis=1) + np.sum(b[both] ** 2, axis=1)))
    return Fit(b + centre, error, float(error / extent) if extent > 0 else np.inf)


def _plane(points: Floats) -> NDArray[np.complex128]:
    return np.asarray(points[:, 0] + 1j * points[:, 1])


def find_offset(moments: Floats, estimate: Floats, truth: TruePositions, upright: bool = True) -> Offset | None:
    """The constant offset of the truth's clock against that of the images.

    Parameters
    ----------
    moments : (frame,) s, of the images.
    estimate : (frame, 3) m in the world, NaN of a frame without a pose.

    Returns
    -------
    None where no offset makes :data:`LEAST` frames comparable.
    """
    tried = _candidates(moments, truth)
    posed = np.isfinite(estimate).all(axis=1)
    moments, estimate = moments[posed], estimate[posed]
    # An offset at which few frames have truth fits almost anything.
    counts = np.array([np.isfinite(truth.at(moments - offset)[:, 0]).sum() for offset in tried])
    least = max(LEAST, SHARE * counts.max(initial=0))

    def error(offset: float) -> float:
        there = truth.at(moments - offset)
        return fit_rigid(estimate, there, upright).relative if np.isfinite(there[:, 0]).sum() >= least else np.inf

    errors = np.array([error(offset) for offset in tried])
    if not np.isfinite(errors).any():
        return None
    best, step = int(np.argmin(errors)), float(tried[1] - tried[0])
    value = float(tried[best])
    for _ in range(4):  # each time ten times finer
        near = value + np.linspace(-step, step, 21)
        value, step = float(near[np.argmin([error(offset) for offset in near])]), step / 10
    limit = GROWTH * error(value)
    low, low_ends = _end(error, limit, value, tried[:best][::-1])
    high, high_ends = _end(error, limit, value, tried[best + 1 :])
    searched = np.ptp(tried[np.isfinite(errors)])
    determined = bool(low_ends and high_ends and high - low < WIDE * searched)
    return Offset(0.0 if not determined and low <= 0.0 <= high else value, low, high, determined)


def _candidates(moments: Floats, truth: TruePositions) -> Floats:
    """Offsets (n,) to try, s, half a frame apart: near 0 where the clocks have a time in common, else all."""
    assert truth.times is not None
    low, high = float(moments[0] - truth.times[-1]), float(moments[-1] - truth.times[0])
    step = 0.5 * float(np.median(np.diff(moments))) if len(moments) > 1 else 0.1
    if low < 0.0 < high:
        low, high = max(low, -REACH), min(high, REACH)
        # Of images a minute apart half a frame is more than all that is searched.
        step = min(max(step, (high - low) / MOST), 0.5 * (high - low))
        return np.asarray(step * np.arange(np.ceil(low / step), np.floor(high / step) + 1))
    return np.linspace(low, high, int(np.clip((high - low) / step, 2, MOST)) + 1)


def _end(error: Callable[[float], float], limit: float, start: float, outward: Floats) -> tuple[float, bool]:
    """How far from ``start`` the error stays below the limit, and whether it grows above it in what was tried."""
    inside = start
    for tried in outward:
        outside, found = float(tried), error(float(tried))
        if not np.isfinite(found):
            break
        if found > limit and abs(outside - start) > 0:
            # Bisection: after twenty halvings the bound is exact to a microsecond.
            for _ in range(20):
                middle = 0.5 * (inside + outside)
                inside, outside = (middle, outside) if error(middle) <= limit else (inside, middle)
            return inside, True
        inside = outside
    return inside, False


def fit_lever_arm(estimate: Floats, rotations: Floats, truth: Floats, upright: bool) -> tuple[Floats, int]:
    """The lever arm ``l`` (3,), m, by which ``P_i + R_i l`` fits the true positions best, and how much of it shows.

    Along directions that the turns do not show, such as the axis of all turns, it is 0; others are counted.

    Parameters
    ----------
    estimate, rotations : (frame, 3) m and (frame, 3, 3), R_world_left.
    truth : (frame, 2 or 3) m, of a frame of its own.
    """
    both, width, arm, shown = _both(estimate, truth), truth.shape[1], np.zeros(3), np.zeros(3, bool)
    P, R = estimate[both], rotations[both]
    for _ in range(20):
        moved = fit_rigid(P + R @ arm, truth[both], upright).moved
        # A shift of the truth takes the mean, its turns about one or three axes what looks like them.
        centred = np.pad(moved - moved.mean(axis=0), ((0, 0), (0, 3 - width)))
        axes = np.eye(3)[2 if upright or width == 2 else 0 :]
        turns = np.stack([np.cross(axis, centred)[:, :width] for axis in axes], axis=2).reshape(-1, len(axes))
        swings = (R - R.mean(axis=0))[:, :width].reshape(-1, 3)
        off = centred[:, :width] - (P - P.mean(axis=0))[:, :width]
        u, s, vt = np.linalg.svd(swings - turns @ np.linalg.pinv(turns) @ swings, full_matrices=False)
        shown = s > MIN_SWING * np.sqrt(len(P))
        arm = vt[shown].T @ ((u.T @ off.reshape(-1))[shown] / s[shown])
    return arm, int(shown.sum())


def position_accuracy(
    estimate: Floats,
    truth: TruePositions,
    moments: Floats | None = None,
    rotations: Floats | None = None,
    upright: bool = True,
) -> tuple[Floats, dict[str, Metric], list[str]]:
    """Compare estimated positions with true ones.

    Parameters
    ----------
    estimate : (frame, 3) in the world, m; NaN where a frame has no pose.
    truth : positions of a clock and frame of their own; one row a frame where there are no times.
    moments : (frame,) s, of the images; None where either has no times.
    rotations : (frame, 3, 3) R_world_left, by which a lever arm is fitted; None: it is known, and in ``estimate``.
    upright : whether the world's vertical was measured; else truth with heights is fitted in space.

    Returns
    -------
    True positions (frame, 2 or 3) in the world, NaN where there are none, less the lever arm where one is fitted;
    metrics by name; warnings.
    """
    offset, warnings = None, []
    arm = np.zeros_like(estimate) if rotations is None or truth.lever_arm is None else rotations @ truth.lever_arm
    antenna = estimate + arm
    if moments is None or truth.times is None:
        there, clock = truth.positions, "rows matched to frames one to one"
    else:
        offset = find_offset(moments, antenna, truth, upright)
        shift = 0.0 if offset is None else offset.value
        there = truth.at(moments - shift)
        clock = f"offset of {shift:.3f} s added to the times of the truth"
        if offset is not None and not offset.determined:
            kept = ", so 0 is kept" if shift == 0.0 else ""
            clock += " (not determined)"
            warnings.append(
                f"offset in time of the truth: not determined{kept}; from {offset.low:.2f} to {offset.high:.2f} s the "
                "tracks agree about as well: the motion changes too little"
            )
    fit, both, width = fit_rigid(antenna, there, upright), _both(antenna, there), there.shape[1]
    if both.sum() >= LEAST:
        others = {words: fit_rigid(antenna, axes, upright) for words, axes in _otherwise(there).items()}
        best = min(others, key=lambda words: others[words].error)
        if others[best].error < ANOTHER * fit.error and others[best].relative < ANOTHER:
            warnings.append(f"true positions fit far better {best}")
    where = "in the plane" if upright or width == 2 else "in space, since the vertical was not measured"
    # Of the camera, as the estimate is; where it has no pose, of the antenna.
    moved = fit.moved - np.nan_to_num(arm[:, :width])
    metrics = _figures(estimate, moved, both, f"positions only, after a rigid fit {where}, {clock}")
    if offset is not None:
        metrics |= _clock(offset)
    if rotations is None or truth.lever_arm is not None or both.sum() < MIN_LEVER_FRAMES:
        return moved, metrics, warnings
    lever, rank = fit_lever_arm(estimate, rotations, there, upright)
    fitted = position_accuracy(estimate, replace(truth, lever_arm=lever), moments, rotations, upright)
    before, after = (figures["position_rmse"]["value"] for figures in (metrics, fitted[1]))
    if not rank or np.linalg.norm(lever) > MAX_LEVER_ARM or after is None or after > ANOTHER * before:
        return moved, metrics, warnings
    x, y, z = lever.round(3) + 0.0
    said = (
        f"lever arm fitted: the true positions lie {x:g} m right of, {y:g} m below and {z:g} m ahead of the "
        f"left camera; {after:.2g} m RMS, without it {before:.2g} m: state truth.lever_arm = [{x:g}, {y:g}, {z:g}]"
        " ([0, 0, 0]: none)" + ("" if rank == 3 else "; along the axis of its turns the images do not tell")
    )
    return fitted[0], fitted[1], [said, *fitted[2]]


def _both(estimate: Floats, truth: Floats) -> Bools:
    return np.asarray(np.isfinite(estimate).all(axis=1) & np.isfinite(truth).all(axis=1))


def _otherwise(truth: Floats) -> dict[str, Floats]:
    """Truth (frame, 2 or 3) as it would be if its axes or its unit were others, by the words that say so."""
    mirrored = truth * np.array([1.0, -1.0, 1.0])[: truth.shape[1]]
    found = {"mirrored: x and y may be swapped; seen from above y lies left of x": mirrored}
    found |= {f"in units of {unit:g} m: state truth.unit = {unit:g}": unit * truth for unit in UNITS}
    if truth.shape[1] == 3:
        # Cameras have x to the right, y down and z ahead; their positions are often given in the first one's frame.
        upright = truth[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
        found['as those of a camera, y down: give [truth] columns = { x = "x", y = "z" }, of the ground'] = upright
    return found


def _figures(estimate: Floats, truth: Floats, both: Bools, how: str) -> dict[str, Metric]:
    n, compared = len(estimate), int(both.sum())
    missing = int((~np.isfinite(estimate).all(axis=1)).sum())
    counts = {
        "frames": metric(n, "frames", "frames that were to be posed"),
        "frames_missing": metric(missing, "frames", "of them without a pose"),
        "frames_judged": metric(compared, "frames", "of them with a pose and a true position"),
    }
    units = {
        "position_rmse": "m",
        "position_median": "m",
        "position_max": "m",
        "path_length": "m",
        "position_drift": "%",
    }
    if compared < LEAST:
        why = f"not applicable: {compared} frames have a pose and a true position, {LEAST} are needed"
        return counts | {name: metric(None, unit, why) for name, unit in units.items()}
    error = (estimate[:, : truth.shape[1]] - truth)[both]
    away = np.linalg.norm(error, axis=1)
    first, last = np.flatnonzero(both)[[0, -1]]
    # With the truth of frames between that have no pose: the true path leads on there.
    way, bridged = along(truth[first : last + 1])
    length = float(way[-1])
    apart = float(np.linalg.norm(error[-1] - error[0]))
    axes = "in x, y and z" if truth.shape[1] == 3 else "in x and y"
    values = {
        "position_rmse": (float(np.sqrt(np.mean(away**2))), f"RMS error {axes}, {compared} of {n} frames, {how}"),
        "position_median": (float(np.median(away)), f"median error {axes}, {how}"),
        "position_max": (float(away.max()), f"largest error {axes}, {how}"),
        "path_length": (length, f"true length from the first to the last compared frame{bridged}"),
        "position_drift": (
            100.0 * apart / length if length > 0 else None,
            f"error of the way from the first to the last compared frame over the true length{bridged}, {how}",
        ),
    }
    return counts | {name: metric(value, units[name], words) for name, (value, words) in values.items()}


def _clock(offset: Offset) -> dict[str, Metric]:
    ends = f"from {offset.low:.3f} to {offset.high:.3f} s the squared error at most doubles"
    if not offset.determined:
        ends += ", most or the end of what was searched: not determined"
    return {
        "time_offset": metric(offset.value, "s", f"added to the times of the truth, where the error is least; {ends}"),
        "time_offset_range": metric(
            0.5 * (offset.high - offset.low), "s", f"half the range of offsets that fit about as well: {ends}"
        ),
    }


@stage(
    "position_accuracy",
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
    positions: Sequence[Any],
    times: Sequence[float] | None,
    moments: Sequence[float | None] | None,
    max_gap: float,
    source: str,
    lever_arm: Sequence[float] | None = None,
) -> Bundle[AccuracyFacts]:
    """Trajectory against positions without rotation, of a frame and a clock of their own."""
    poses = by_frame(world_poses(trajectory), trajectory.meta["frames"], frames)
    estimate, vertical = poses[:, :, 3], trajectory.meta["verticals"][trajectory.meta["main"]]
    given = np.array(positions, dtype=np.float64)
    clock, at = (None if t is None else np.array(t, dtype=np.float64) for t in (times, moments))
    arm = None if lever_arm is None else np.array(lever_arm)
    truth = TruePositions(given, clock, max_gap, arm)
    there, metrics, warnings = position_accuracy(estimate, truth, at, poses[:, :, :3], vertical in MEASURED)
    whole = np.full((len(frames), 3), np.nan)
    whole[:, : there.shape[1]] = there
    facts: AccuracyFacts = {"metrics": metrics, "frames": frames, "truth": source, "warnings": warnings}
    return Bundle({"position": estimate.copy(), "position_truth": whole}, facts)
