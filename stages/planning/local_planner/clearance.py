"""Clearance of a vehicle from hazards and unknown ground on a risk map, at any place and heading.

Hazards to a wheel were found in a window as large as the wheel, so only the centre of a wheel must avoid them. The
vehicle may pass a stone between its wheels, since ground that the belly cannot pass over (tilt, slope, rise, for the
worst heading) is a hazard to its middle. Unknown ground may not be under the belly unless it is known to be low enough
(:mod:`rille.stages.planning.local_planner.underbody`). The centres of the wheels keep the margin from it as from a
hazard, because unknown ground is mostly hidden by a stone, or is the stone itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BODY_BITS, WHEEL_BITS
from rille.stages.hazard.risk import CAUTION, DOUBT_BIT, HAZARDOUS, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.local_planner.underbody import Straddle, clears, stands
from rille.stages.planning.wheels import wheel_positions
from rille.stages.terrain.occlusion_bounds import Bounds

NEAR_UNKNOWN = 0.5
"""Cells; nearer than this a point of the belly lies in an unknown cell."""

CAUTION_GROUND, DOUBTED_GROUND = 1, 2
"""Classes of ground that costs more than its length; 0: any other."""


@dataclass(frozen=True)
class Gaps:
    """Distances of poses from hazards and unknown ground, float32; off the map a vehicle's middle is in a hazard.

    ``gap``: metres to the nearest hazard that is none by sigma alone, from the wheels to what is hazardous to wheels
    and from the middle to what is to the vehicle; ``doubtful``: to hazards by sigma alone; ``proven``: to proven ones.
    ``unknown``: metres, at least, from the belly to unknown ground, and from the wheels beyond their margin; not
    positive: on it, or too near. ``frontier``: the same to that of it where a wheel has room. ``caution``,
    ``doubted``: how many of the four wheels and the middle stand on caution ground and on doubted ground.
    """

    gap: Floats32
    doubtful: Floats32
    proven: Floats32
    unknown: Floats32
    frontier: Floats32
    caution: Floats32
    doubted: Floats32


class Hazards(NamedTuple):
    """Maps (row, col) of :mod:`rille.stages.hazard.risk`: classes; reason bits, without which every hazard is one to a
    wheel; probabilities of a hazard, without which each is certain."""

    risk: Bytes
    reason: NDArray[np.uint16] | None = None
    p_hazard: Floats32 | None = None


class KnownGround(NamedTuple):
    """How well the ground is known, masks (row, col).

    ``unknown``: cells on which the vehicle may not stand because too little is known; None: those of the unknown class.
    ``glanced``: unknown cells that were seen from afar. ``doubted``: cells that cost as much as a hazard by sigma alone
    that is driven on.
    """

    unknown: Bools | None = None
    glanced: Bools | None = None
    doubted: Bools | None = None


class _Ground(NamedTuple):
    """The maps of :class:`Footing` that its kernel reads."""

    fields: Floats32
    unknown: Floats32
    frontier: Floats32
    cost_class: Bytes
    straddle: Straddle


@dataclass(frozen=True)
class Footing:
    """A risk map as a vehicle meets it; all arrays (row, col), distances in metres.

    ``fields`` (6, row, col): distances to hazards to a wheel that are none by sigma alone, to those that are, and to
    proven ones; then the same three of hazards to the vehicle. ``unknown``: distance to unknown ground; ``frontier``:
    to that of it where a wheel has room, for the rest is mostly the shadows of stones. ``cost_class``: 0 (clear),
    :data:`CAUTION_GROUND` or :data:`DOUBTED_GROUND`. ``straddle``: what of unknown ground the belly may pass over.
    ``glanced``: where unknown ground was seen from afar; None: nowhere.
    """

    lattice: Lattice
    vehicle: Vehicle
    fields: Floats32
    unknown: Floats32
    frontier: Floats32
    cost_class: Bytes
    straddle: Straddle
    glanced: Bools | None = None

    @staticmethod
    def of(
        hazards: Hazards,
        lattice: Lattice,
        vehicle: Vehicle,
        known: KnownGround | None = None,
        *,
        p_certain: float = 0.5,
        p_traversable: float = 0.0,
        bounds: Bounds | None = None,
    ) -> Footing:
        """Build the distance maps; with ``bounds`` the belly may pass over unknown ground that is low enough.

        A hazard is proven where it is not one by its standard deviation alone, and at least as probable as
        ``p_certain``. Where it is one by its standard deviation alone and less probable than ``p_traversable``, the
        ground is doubted, if it is not unknown. So is ground within a quarter of a wheel of what is given as doubted,
        where a wheel's edge touches.
        """
        risk, reason, p_hazard = hazards
        unknown, glanced, doubted = known or KnownGround()
        hazardous, cell = risk == HAZARDOUS, lattice.cell
        unknown = risk == UNKNOWN if unknown is None else unknown
        bits = np.full(risk.shape, WHEEL_BITS) if reason is None else reason
        doubtful = hazardous & ((bits & DOUBT_BIT) > 0)
        # Without probabilities every hazard that is none by sigma alone is proven.
        likely = proven = hazardous & ~doubtful
        cost_class = np.where(risk == CAUTION, np.uint8(CAUTION_GROUND), np.uint8(0))
        if p_hazard is not None:
            proven = likely & (p_hazard >= p_certain)
            dared = doubtful & (p_hazard < p_traversable)
            doubtful &= ~dared
            cost_class[dared & ~unknown] = DOUBTED_GROUND
        if doubted is not None:
            cost_class[(_distance(doubted, cell) <= 0.25 * vehicle.wheel_diameter) & ~unknown] = DOUBTED_GROUND
        kinds = [(bits & which) > 0 for which in (WHEEL_BITS, BODY_BITS)]
        fields = np.stack([_distance(mask & kind, cell) for kind in kinds for mask in (likely, doubtful, proven)])
        wide = _opened(unknown, 0.5 * vehicle.wheel_diameter, cell)
        # Where lines of sight bound what hides there, the belly may pass; elsewhere unknown ground is a void to it.
        void = _distance(unknown if bounds is None else unknown & np.isnan(bounds.upper), cell)
        straddle = Straddle.of(void, bounds, vehicle, _belly(vehicle), cell)
        unseen, frontier = _distance(unknown, cell), _distance(wide, cell)
        return Footing(lattice, vehicle, fields, unseen, frontier, cost_class, straddle, glanced)

    def gaps(self, x: Floats, y: Floats, heading: Floats) -> Gaps:
        """Compute the distances at poses: x, y (m) and heading (rad to the left of y), arrays of one shape."""
        at = self.lattice.index(np.stack([x, y], axis=-1)).reshape(-1, 2)
        turn = np.broadcast_to(heading, np.shape(x)).reshape(-1)
        out = np.empty((7, len(at)), np.float32)
        cell = self.lattice.cell
        # beyond the circle about the vehicle, and what rounding to cells takes, nothing is beneath it
        around = 0.5 * math.hypot(self.vehicle.track, self.vehicle.wheel_base) + 1.5 * cell
        reach = np.array([around + self.vehicle.margin, cell, self.vehicle.margin], np.float32)
        parts = wheel_positions(self.vehicle) / cell, _belly(self.vehicle) / cell
        ground = _Ground(self.fields, self.unknown, self.frontier, self.cost_class, self.straddle)
        _gaps((at, np.cos(turn), np.sin(turn)), parts, ground, reach, out)
        out[3:5] -= NEAR_UNKNOWN * cell
        return Gaps(*(a.reshape(np.shape(x)) for a in out))

    def beneath(self, mask: Bools, stand: tuple[float, float, float]) -> Floats:
        """Middles (n, 2), m, of the cells of a mask (row, col) that a vehicle at x, y (m), heading (rad) has under its
        belly, or within its margin of the middles of its wheels: all that come too near to it, for it rounds to cells,
        and what is a cell farther."""
        x, y, heading = stand
        cell, vehicle = self.lattice.cell, self.vehicle
        reach = 0.5 * math.hypot(vehicle.track, vehicle.wheel_base) + vehicle.margin + 2.0 * cell
        # Only the cells in a box about the vehicle are looked at, for maps are far larger.
        row, col = self.lattice.index((x, y))
        n = math.ceil(reach / cell)
        rows, cols = (slice(max(0, round(float(v)) - n), max(0, round(float(v)) + n + 1)) for v in (row, col))
        at = self.lattice.xy()[rows, cols][mask[rows, cols]]
        c, s = math.cos(heading), math.sin(heading)
        right = c * (at[:, 0] - x) + s * (at[:, 1] - y)
        ahead = c * (at[:, 1] - y) - s * (at[:, 0] - x)
        under = (np.abs(right) <= 0.5 * vehicle.track + cell) & (np.abs(ahead) <= 0.5 * vehicle.wheel_base + cell)
        for across, along in wheel_positions(vehicle):
            under |= np.hypot(right - across, ahead - along) <= vehicle.margin + cell
        return np.asarray(at[under])


def _distance(mask: Bools, cell: float) -> Floats32:
    far = scipy.ndimage.distance_transform_edt(~mask) * cell if mask.any() else np.full(mask.shape, np.inf)
    return np.asarray(far, dtype=np.float32)


def _opened(mask: Bools, radius: float, cell: float) -> Bools:
    """What of a mask circles of this radius, m, cover that lie within it."""
    # Morphological opening by distances: an erosion and a dilation by a circle, whatever its radius in cells.
    inner = _distance(~mask, cell) - 0.5 * cell  # to the edge of the nearest cell without
    return np.asarray(mask & (_distance(inner >= radius, cell) < radius + 0.5 * cell))


def _belly(vehicle: Vehicle) -> Floats:
    """Points (n, 2) right and ahead of the middle, m, at most half a wheel apart."""
    sides = [np.linspace(-0.5, 0.5, 1 + math.ceil(v / (0.5 * vehicle.wheel_diameter))) * v
             for v in (vehicle.track, vehicle.wheel_base)]  # fmt: skip
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


@njit(cache=True, nogil=True)
def _gaps(poses, parts, ground, reach, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` (7, n) with the fields of :class:`Gaps`, in its order.

    ``poses``: row and column (n, 2), cosine and sine (n,) of the heading; ``parts``: wheels and points of the belly,
    right and ahead, cells; ``reach``: see :meth:`Footing.gaps`.
    """
    at, cosine, sine = poses
    wheels, belly = parts
    fields, unknown, frontier, cost_class, straddle = ground
    rows, cols = unknown.shape
    stand, heights = np.empty((4, 2), dtype=np.int64), np.empty(4)
    for n in range(at.shape[0]):
        row, col, c, s = at[n, 0], at[n, 1], cosine[n], sine[n]
        for k in range(7):
            # On unknown ground, unless all wheels are found on the map below.
            out[k, n] = np.float32(-1.0) if k == 3 or k == 4 else np.float32(0.0)
        i, j = math.floor(row + 0.5), math.floor(col + 0.5)
        if i < 0 or j < 0 or i >= rows or j >= cols:
            out[0, n] = out[1, n] = out[2, n] = -np.inf
            continue
        # The middle is judged by what is hazardous to the vehicle, the wheels below by what is to wheels.
        gap, doubtful, proven = fields[3, i, j], fields[4, i, j], fields[5, i, j]
        cautious, doubted = int(cost_class[i, j] == CAUTION_GROUND), int(cost_class[i, j] == DOUBTED_GROUND)
        spare = unknown[i, j] - reach[0]
        outside, least, wide = False, np.float32(np.inf), np.float32(np.inf)
        for k in range(4):
            a, b = wheels[k, 0], wheels[k, 1]
            i, j = math.floor(row - (a * s + b * c) + 0.5), math.floor(col + (a * c - b * s) + 0.5)
            if i < 0 or j < 0 or i >= rows or j >= cols:
                outside = True
                continue
            stand[k, 0], stand[k, 1] = i, j
            gap, doubtful = min(gap, fields[0, i, j]), min(doubtful, fields[1, i, j])
            proven = min(proven, fields[2, i, j])
            cautious += cost_class[i, j] == CAUTION_GROUND
            doubted += cost_class[i, j] == DOUBTED_GROUND
            least, wide = min(least, unknown[i, j] - reach[2]), min(wide, frontier[i, j] - reach[2])
        out[0, n], out[1, n], out[2, n], out[5, n], out[6, n] = gap, doubtful, proven, cautious, doubted
        if outside:
            continue
        # No unknown ground within the circle about the vehicle: its belly need not be looked at point by point.
        if spare > 0:
            out[3, n] = out[4, n] = spare + reach[1]
            continue
        steady = stands(straddle, stand, heights)
        for k in range(belly.shape[0]):
            a, b = belly[k, 0], belly[k, 1]
            i, j = math.floor(row - (a * s + b * c) + 0.5), math.floor(col + (a * c - b * s) + 0.5)
            # All wheels are on the map: what sticks out between them is a rounding to cells.
            i, j = min(max(i, 0), rows - 1), min(max(j, 0), cols - 1)
            # Unknown, but bounded and low enough: then only the nearest ground without a bound counts.
            if steady and straddle.void[i, j] > unknown[i, j] and clears(straddle, k, i, j, heights):
                least = min(least, straddle.void[i, j])
            else:
                least, wide = min(least, unknown[i, j]), min(wide, frontier[i, j])
        out[3, n], out[4, n] = least, wide
