"""Images of two cameras that were taken at one time, by their time stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rille.stages.core.errors import warning
from rille.stages.core.quantities import count

SHARE, MOST_APART = 0.25, 0.01
"""Largest time between the images of a pair: share of the usual interval, and seconds (0.1 m at 10 m/s)."""


class TimedPairs(NamedTuple):
    """Simultaneous images of two cameras.

    Attributes
    ----------
    places : indices of the left and of the right image of each pair, in order of time.
    alone : number of images without a partner.
    apart : s; longest time between the images of a pair; between the nearest ones if there is no pair.
    allowed : s; its limit.
    two_clocks : whether no images are simultaneous, and all are apart alike, by the share of the interval at most.
    """

    places: list[tuple[int, int]]
    alone: int
    apart: float
    allowed: float
    two_clocks: bool = False

    def lines(self, code: str) -> list[str]:
        """A warning if images have no partner, or those of a pair are not simultaneous."""
        text = f"images of a pair are up to {1e3 * self.apart:.3g} ms apart ({1e3 * self.allowed:.3g} ms are allowed)"
        alone = f"; {count(self.alone, 'image')} without a partner of the same time are left out" if self.alone else ""
        return [warning(code, text + alone)] if self.apart or alone else []


def join(left: Sequence[float], right: Sequence[float], tolerance: float | None = None) -> TimedPairs:
    """Pair images of two cameras that are nearest to each other in time.

    Parameters
    ----------
    left, right : seconds, increasing.
    tolerance : s; by default a quarter of the usual interval of the faster camera, at most ``MOST_APART``.
    """
    a, b = np.asarray(left), np.asarray(right)
    intervals = [float(np.median(np.diff(times))) for times in (a, b) if len(times) > 1]
    allowed = tolerance or min([MOST_APART, *(SHARE * interval for interval in intervals)])
    ours, theirs = (np.searchsorted((t[1:] + t[:-1]) / 2, s) for t, s in ((b, a), (a, b)))
    apart = np.abs(a - b[ours])
    # Each must be the other's nearest, else one image would be in two pairs.
    there = np.flatnonzero((theirs[ours] == np.arange(len(a))) & (apart <= allowed))
    longest = float(max(apart[there], default=apart.min()))
    later = b - a if len(a) == len(b) > 2 and not len(there) else np.array([0.0, np.inf])
    alike = float(np.ptp(later)) <= allowed and abs(float(np.median(later))) <= SHARE * min(intervals)
    places = [(int(i), int(ours[i])) for i in there]
    return TimedPairs(places, len(a) + len(b) - 2 * len(there), longest, allowed, alike)
