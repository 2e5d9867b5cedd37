"""Constant offset of the truth's clock against that of the images.

At this offset the distance of estimated and true positions after a rigid motion, over the extent of both tracks, is
least.

Changes of speed or direction determine the offset: on a straight line at constant speed it is the same as a shift in
space. Its range extends to where the squared error doubles, because remaining errors (drift, scale) may have moved the
best offset as far. If this range does not end within the searched one, or takes half of it, the offset is not
determined, and 0 (the clocks as stated) is kept if it lies in the range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.geometry.rigid import fit_rigid

MIN_FRAMES = 4
"""Fewest frames with pose and truth: more than the unknowns (turn, shift, clock offset) need."""

MIN_SHARE = 2 / 3
"""Fewest compared frames over the most that any offset compares, since few frames fit anywhere."""

EQUAL_ERROR = 2**0.5
"""Factor on the least error up to which offsets count as equally good: its square doubles."""

MAX_TRIALS = 20000
"""Most offsets that are tried before the best one is refined."""


@dataclass(frozen=True)
class TruePositions:
    """``positions`` (row, 2 or 3), m, x and y in the plane and z up; ``times`` (row,), s; without them rows are frames.

    Nothing is interpolated between rows that are more than ``max_gap`` s apart. ``lever_arm`` (3,), m, is the place of
    the antenna or prism in the left camera's frame (x right, y down, z ahead); None: not known.
    """

    positions: Floats
    times: Floats | None = None
    max_gap: float = 0.5
    lever_arm: Floats | None = None

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> TruePositions:
        """From the JSON form of :class:`rille.datasets.protocol.Positions`."""
        values: Mapping[str, Any] = {name: np.array(v) if isinstance(v, list | tuple) else v for name, v in d.items()}
        return TruePositions(**values)

    def at(self, moments: Floats) -> Floats:
        """Positions (moment, 2 or 3) on the straight line between two rows; NaN in longer gaps and beyond the ends."""
        assert self.times is not None
        after = np.searchsorted(self.times, moments).clip(0, len(self.times) - 1)
        start, end = self.times[(after - 1).clip(0)], self.times[after]
        known = (start <= moments) & (moments <= end) & (end - start <= self.max_gap)
        # At a row itself a gap beside it does not matter; and times have few digits: rounding must not exclude the
        # first and the last image.
        known |= np.minimum(np.abs(moments - start), np.abs(moments - end)) <= 1e-6
        places = np.stack([np.interp(moments, self.times, axis) for axis in self.positions.T], axis=1)
        return np.where(known[:, None], places, np.nan)


class Offset(NamedTuple):
    """Seconds to add to the times of the truth; from ``low`` to ``high`` the squared error at most doubles, to half the
    time between frames.

    ``determined``: both ends lie within the searched range, and close enough together.
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
    None if no offset makes :data:`MIN_FRAMES` frames comparable.
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
    # The search takes differences, which infinity does not have.
    near = scipy.optimize.minimize_scalar(lambda x: min(error(x), 1e3), bounds=span, method="bounded", options=options)
    value = value if errors.min() <= near.fun else float(near.x)
    equal = np.append(tried[errors <= EQUAL_ERROR * error(value)], value)
    # The nearest offsets beyond all equally good ones: on the straight lines between rows of the truth, offsets fit
    # worse than at the rows. An offset that compares too few frames is no end.
    beyond = np.searchsorted(tried, equal.min()) - 1, np.searchsorted(tried, equal.max(), side="right")
    ends = np.clip(beyond, 0, len(tried) - 1)
    ended = [bool(EQUAL_ERROR * error(value) < errors[k] < np.inf) for k in ends]
    low, high = (float(tried[k]) for k in ends)
    # 0.5: share of the searched range; if equally good offsets span more, the offset is not determined.
    determined = all(ended) and high - low < 0.5 * np.ptp(tried[np.isfinite(errors)])
    return Offset(0.0 if not determined and low <= 0.0 <= high else value, low, high, bool(determined))


def _candidates(moments: Floats, truth: TruePositions) -> Floats:
    """Offsets (n,) to try, s, half a frame apart: near 0 if the clocks have a time in common, else all."""
    assert truth.times is not None
    low, high = float(moments[0] - truth.times[-1]), float(moments[-1] - truth.times[0])
    step = 0.5 * float(np.median(np.diff(moments))) if len(moments) > 1 else 0.1
    if low < 0.0 < high:
        # 10.0: largest clock offset, s, that is tried if the clocks have a time in common: larger ones may fit other
        # stretches of the track that look alike.
        low, high = max(low, -10.0), min(high, 10.0)
        # Half the time between images that are a minute apart is more than the searched range.
        step = min(max(step, (high - low) / MAX_TRIALS), 0.5 * (high - low))
        return np.asarray(step * np.arange(np.ceil(low / step), np.floor(high / step) + 1))
    return np.linspace(low, high, int(np.clip((high - low) / step, 2, MAX_TRIALS)) + 1)


class LateTruth(NamedTuple):
    """Seconds to add to the times of true poses, and RMS error of the positions with them, m."""

    offset: float
    error: float


def late_truth(moments: Floats, estimate: Floats, truth: TruePositions) -> LateTruth | None:
    """Clock offset of true poses; None if the tracks do not determine one (:func:`find_offset`)."""
    offset = find_offset(moments, estimate, truth, upright=False)
    # Not "<=": an offset of 0, which is tried too, may be the end of the range although it is worse.
    if offset is None or not offset.determined or offset.low < 0.0 < offset.high:
        return None
    return LateTruth(offset.value, fit_rigid(estimate, truth.at(moments - offset.value), upright=False).error)
