"""Ground that was not seen, under the belly: passed over where all that may be there leaves the belly its clearance.

How high it may be is known where lines of sight pass over it (:mod:`rille.stages.terrain.occlusion_bounds`). A vehicle
whose wheels all stand on ground that was seen then has, at each point of its belly, a rise below it of at most

    sum_i w_i max(0, top - stand_i)

with the weights w_i of the wheels there, ``stand_i`` the least height at which wheel i stands, and ``top`` the greatest
that ground may have about that point; see :mod:`rille.stages.hazard.placement` for the rise. Tilt is judged by the same
heights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import running_max
from rille.stages.planning.wheels import wheel_positions
from rille.stages.terrain.occlusion_bounds import Bounds


class Straddle(NamedTuple):
    """Distances and heights (row, col) float32, m: ``void`` to unknown ground that nothing bounds; ``top`` of what may
    be below a point of the belly; ``stand`` (2, row, col) at which a wheel stands at least and at most, NaN unknown.

    ``weights`` (point, wheel) of the belly's points; ``limits``: track, wheel base, clearance (m) and the greatest
    squared gradient. Without bounds all arrays of heights are empty.
    """

    void: Floats32
    top: Floats32
    stand: Floats32
    weights: Floats
    limits: Floats

    @staticmethod
    def of(void: Floats32, bounds: Bounds | None, vehicle: Vehicle, belly: Floats, cell: float) -> Straddle:
        """``belly`` (point, 2) right and ahead of the middle, m; ``cell`` side of a cell, m."""
        gradient = math.tan(math.radians(vehicle.max_slope_deg))
        limits = np.array([vehicle.track, vehicle.wheel_base, vehicle.clearance, gradient * gradient])
        share = belly / limits[:2]
        # Bilinear weights of the four wheels: products of a share along the track and one along the wheel base.
        weights = np.prod(0.5 + share[:, None] * np.sign(wheel_positions(vehicle)), axis=-1)
        if bounds is None:
            nothing = np.empty((0, 0), np.float32)
            return Straddle(void, nothing, np.stack([nothing, nothing]), weights, limits)
        seen = np.isfinite(bounds.lower)
        # A point stands for the square of belly about it, half a diagonal wide, and the margin beyond.
        apart = max(float(np.diff(np.unique(side)).max()) for side in belly.T)
        reach = 0.25 * vehicle.wheel_diameter, vehicle.margin + apart / math.sqrt(2.0)
        contact, around = (max(1, math.ceil(v / cell - 0.5)) for v in reach)
        stand = [running_max(np.where(seen, a, np.float32(np.nan)), contact) for a in (bounds.lower, bounds.upper)]
        known = np.isfinite(stand[0])
        return Straddle(
            void,
            running_max(bounds.upper, around),
            np.stack([np.where(known, a, np.float32(np.nan)) for a in stand]),
            weights,
            limits,
        )


@njit(cache=True, nogil=True)
def stands(straddle, at, heights):  # type: ignore[no-untyped-def]
    """Return whether all wheels stand on ground that was seen, and the slope between them is surely within the limit.

    Parameters
    ----------
    straddle : :class:`Straddle`; without bounds the answer is False.
    at : (4, 2) row and column of the cells under the wheels: front left, front right, rear left, rear right.
    heights : (4,), m; filled with the least height at which each wheel stands.
    """
    stand = straddle.stand
    if stand.shape[1] == 0:
        return False
    for k in range(4):
        heights[k] = stand[0, at[k, 0], at[k, 1]]
        if math.isnan(heights[k]):
            return False
    along = across = 0.0
    for k in range(4):
        high = stand[1, at[k, 0], at[k, 1]]
        # The steepest that the bounds allow: one wheel at its highest; the one before or behind it (k + 2), or beside
        # it (k ^ 1), at its lowest.
        along, across = max(along, high - heights[(k + 2) % 4]), max(across, high - heights[k ^ 1])
    along, across = along / straddle.limits[1], across / straddle.limits[0]
    return along * along + across * across <= straddle.limits[3]


@njit(cache=True, nogil=True)
def clears(straddle, point, row, col, heights):  # type: ignore[no-untyped-def]
    """Whether a point of the belly has its clearance over a cell, with the wheels at these heights, m."""
    top, rise = straddle.top[row, col], 0.0
    for k in range(4):
        rise += straddle.weights[point, k] * max(0.0, top - heights[k])
    return rise <= straddle.limits[2]
