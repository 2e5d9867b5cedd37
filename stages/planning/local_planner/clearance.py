"""Clearance of a vehicle from hazards and unknown ground on a risk map, at any place and heading.

Hazards to a wheel were computed in a window as large as the wheel, so only the centre of a wheel must avoid them. The
vehicle may pass a stone between its wheels, since ground that the belly cannot pass over (tilt, slope, rise, for the
worst heading) is a hazard to its middle. Unknown ground may not be under the belly unless it is known to be low enough
(below). The centres of the wheels keep the margin from it as from a hazard, because unknown ground is mostly hidden by
a stone, or is the stone itself.

Lines of sight that pass over unseen ground bound its height
(:mod:`rille.stages.terrain.occlusion_bounds`). A vehicle whose wheels all stand on ground that was seen then has, at
each point of its belly, a rise below it of at most

    sum_i w_i max(0, top - stand_i)

with the weights w_i of the wheels there, ``stand_i`` the least height at which wheel i stands, and ``top`` the greatest
that ground may have about that point; see :mod:`rille.stages.hazard.placement` for the rise. Tilt is judged by the same
heights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.core.kernel import kernel
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.measures import BODY_BITS, WHEEL_BITS
from rille.stages.hazard.risk import CAUTION, DOUBT_BIT, HAZARDOUS, UNKNOWN
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.numeric.extrema import running_max
from rille.stages.planning.configuration_space import distance
from rille.stages.planning.wheels import wheel_positions
from rille.stages.terrain.occlusion_bounds import Bounds


class Straddle(NamedTuple):
    """Distances and heights (row, col) float32, m: ``void`` to unknown ground that nothing bounds; ``top`` of what may
    be below a point of the belly; ``stand`` (2, row, col) at which a wheel stands at least and at most, NaN unknown.

    ``weights`` (point, wheel) of the belly's points; ``limits``: track, wheel base, clearance (m) and the greatest
    squared gradient.
    """

    void: Floats32
    top: Floats32
    stand: Floats32
    weights: Floats
    limits: Floats

    @staticmethod
    def of(void: Floats32, bounds: Bounds, vehicle: Vehicle, belly: Floats, cell: float) -> Straddle:
        """``belly`` (point, 2) right and ahead of the middle, m; ``cell`` side of a cell, m."""
        gradient = math.tan(math.radians(vehicle.max_slope_deg))
        limits = np.array([vehicle.track, vehicle.wheel_base, vehicle.clearance, gradient * gradient])
        share = belly / limits[:2]
        # Bilinear weights of the four wheels: products of a share along the track and one along the wheel base.
        weights = np.prod(0.5 + share[:, None] * np.sign(wheel_positions(vehicle)), axis=-1)
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


@kernel
def stands(straddle, at, heights):  # type: ignore[no-untyped-def]
    """Return whether all wheels stand on ground that was seen, and the slope between them is surely within the limit.

    Parameters
    ----------
    straddle : :class:`Straddle`.
    at : (4, 2) row and column of the cells under the wheels: front left, front right, rear left, rear right.
    heights : (4,), m; filled with the least height at which each wheel stands.
    """
    stand = straddle.stand
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


@kernel
def clears(straddle, point, row, col, heights):  # type: ignore[no-untyped-def]
    """Whether a point of the belly has its clearance over a cell, with the wheels at these heights, m."""
    top, rise = straddle.top[row, col], 0.0
    for k in range(4):
        rise += straddle.weights[point, k] * max(0.0, top - heights[k])
    return rise <= straddle.limits[2]


CAUTION_GROUND, DOUBTED_GROUND = 1, 2
"""Classes of ground that costs more than its length; 0: any other."""


class Gaps(NamedTuple):
    """Distances of poses from hazards and unknown ground, float32; off the map a vehicle's middle is in a hazard.

    ``gap``: metres to the nearest hazard that is none by sigma alone, from the wheels to cells hazardous to wheels and
    from the middle to cells hazardous to the vehicle; ``doubtful``: to hazards by sigma alone; ``proven``: to proven
    ones. ``unknown``: metres, at least, from the belly to unknown ground, and from the wheels beyond their margin; not
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
    """Maps (row, col) of hazards, and of how well the ground is known.

    ``risk``: classes of :mod:`rille.stages.hazard.risk`; ``reason`` bits, without which every hazard is one to a wheel;
    ``p_hazard``, without which each is certain, and ``p_wheel`` of those to a wheel, without which it is ``p_hazard``.
    ``unknown``: cells on which the vehicle may not stand because too little is known; None: those of the unknown class.
    ``glanced``: unknown cells that were seen from afar. ``doubted``: cells that cost a wheel as much as a hazard by
    sigma alone that is driven on.
    """

    risk: Bytes
    reason: NDArray[np.uint16] | None = None
    p_hazard: Floats32 | None = None
    p_wheel: Floats32 | None = None
    unknown: Bools | None = None
    glanced: Bools | None = None
    doubted: Bools | None = None


class ClearanceFields(NamedTuple):
    """Maps (row, col) of a part of the vehicle: distances, m, to hazards that are none by sigma alone, to those that
    are, and to proven ones; ``cost_class``: 0 (clear), :data:`CAUTION_GROUND` or :data:`DOUBTED_GROUND`."""

    likely: Floats32
    doubtful: Floats32
    proven: Floats32
    cost_class: Bytes


class FootingMaps(NamedTuple):
    """Maps (row, col) as a vehicle meets them, distances in metres.

    ``wheels``, ``body``: hazards to a wheel, and to the vehicle. ``unknown``: distance to unknown ground;
    ``frontier``: to that of it where a wheel has room, for the rest is mostly the shadows of stones. ``straddle``:
    unknown ground over which the belly may pass.
    """

    wheels: ClearanceFields
    body: ClearanceFields
    unknown: Floats32
    frontier: Floats32
    straddle: Straddle


class _Poses(NamedTuple):
    """Row and column (n, 2) and cosine and sine (n,) of the heading."""

    at: Floats
    cosine: Floats
    sine: Floats


class _Parts(NamedTuple):
    """Wheels and points of the belly (n, 2), right and ahead of the middle, cells; the margin of the wheels, the side
    of a cell, and a radius about the middle, m, within which all of the vehicle and its margin lie."""

    wheels: Floats
    belly: Floats
    margin: np.float32
    cell: np.float32
    radius: np.float32


@dataclass(frozen=True)
class Footing:
    """A risk map as a vehicle meets it; ``glanced`` (row, col): unknown ground that was seen from afar, None: none."""

    lattice: Lattice
    vehicle: Vehicle
    maps: FootingMaps
    glanced: Bools | None = None

    @staticmethod
    def of(
        hazards: Hazards,
        lattice: Lattice,
        vehicle: Vehicle,
        *,
        p_certain: float = 0.5,
        p_traversable: float = 0.0,
        bounds: Bounds | None = None,
    ) -> Footing:
        """Build the distance maps; with ``bounds`` the belly may pass over unknown ground that is low enough.

        A hazard is proven where it is not one by its standard deviation alone, and at least as probable as
        ``p_certain``. Where it is one by its standard deviation alone and less probable than ``p_traversable``, the
        ground is doubted, if it is not unknown. To wheels so is ground within a quarter of a wheel of the doubted
        cells, where a wheel's edge touches. A wheel's doubts are none of the middle's, which may pass over a stone.
        """
        risk, cell = hazards.risk, lattice.cell
        hazardous = risk == HAZARDOUS
        unknown = risk == UNKNOWN if hazards.unknown is None else hazards.unknown
        bits = np.full(risk.shape, WHEEL_BITS) if hazards.reason is None else hazards.reason
        by_sigma = (bits & DOUBT_BIT) > 0

        def part(which: np.uint16, chance: Floats32 | None, doubted: Bools | None) -> ClearanceFields:
            mine = hazardous & ((bits & which) > 0)
            doubtful = mine & by_sigma
            # Without probabilities every hazard that is none by sigma alone is proven.
            likely = proven = mine & ~by_sigma
            cost_class = np.where(risk == CAUTION, np.uint8(CAUTION_GROUND), np.uint8(0))
            if chance is not None:
                proven = likely & (chance >= p_certain)
                dared = doubtful & (chance < p_traversable)
                doubtful &= ~dared
                cost_class[dared & ~unknown] = DOUBTED_GROUND
            if doubted is not None:
                beside = distance(doubted, cell) <= 0.25 * vehicle.wheel_diameter
                cost_class[beside & ~unknown] = DOUBTED_GROUND
            likely_m, doubtful_m, proven_m = (distance(mask, cell) for mask in (likely, doubtful, proven))
            return ClearanceFields(likely_m, doubtful_m, proven_m, cost_class)

        p_wheel = hazards.p_hazard if hazards.p_wheel is None else hazards.p_wheel
        wheels, body = part(WHEEL_BITS, p_wheel, hazards.doubted), part(BODY_BITS, hazards.p_hazard, None)
        wide = _opened(unknown, 0.5 * vehicle.wheel_diameter, cell)
        # Where lines of sight bound the hidden ground, the belly may pass; elsewhere unknown ground is a void to it.
        nothing = np.full(risk.shape, np.nan, np.float32)
        bounds = bounds or Bounds(nothing, nothing)
        void = distance(unknown & np.isnan(bounds.upper), cell)
        straddle = Straddle.of(void, bounds, vehicle, _belly(vehicle), cell)
        unseen, frontier = distance(unknown, cell), distance(wide, cell)
        maps = FootingMaps(wheels, body, unseen, frontier, straddle)
        return Footing(lattice, vehicle, maps, hazards.glanced)

    def gaps(self, x: Floats, y: Floats, heading: Floats) -> Gaps:
        """Compute the distances at poses: x, y (m) and heading (rad to the left of y), arrays of one shape."""
        vehicle, cell, f = self.vehicle, self.lattice.cell, np.float32
        at = self.lattice.index(np.stack([x, y], axis=-1)).reshape(-1, 2)
        turn = np.broadcast_to(heading, np.shape(x)).reshape(-1)
        # Rounding to cells takes up to one and a half of them.
        radius = 0.5 * math.hypot(vehicle.track, vehicle.wheel_base) + 1.5 * cell + vehicle.margin
        points = wheel_positions(vehicle) / cell, _belly(vehicle) / cell
        out = Gaps(*(np.zeros(len(at), np.float32) for _ in Gaps._fields))
        poses, parts = _Poses(at, np.cos(turn), np.sin(turn)), _Parts(*points, f(vehicle.margin), f(cell), f(radius))
        _gaps(poses, parts, self.maps, out)
        for distances in (out.unknown, out.frontier):
            # Nearer than half a cell a point of the belly lies in an unknown cell.
            distances -= 0.5 * cell
        return Gaps(*(a.reshape(np.shape(x)) for a in out))

    def beneath(self, mask: Bools, stand: tuple[float, float, float]) -> Floats:
        """Middles (n, 2), m, of the cells of a mask (row, col) that a vehicle at x, y (m), heading (rad) has under its
        belly, or within its margin of the middles of its wheels, and of those a cell farther, for it rounds to
        cells."""
        x, y, heading = stand
        at, vehicle, cell = self.lattice.xy()[mask], self.vehicle, self.lattice.cell
        c, s = math.cos(heading), math.sin(heading)
        right = c * (at[:, 0] - x) + s * (at[:, 1] - y)
        ahead = c * (at[:, 1] - y) - s * (at[:, 0] - x)
        under = (np.abs(right) <= 0.5 * vehicle.track + cell) & (np.abs(ahead) <= 0.5 * vehicle.wheel_base + cell)
        for across, along in wheel_positions(vehicle):
            under |= np.hypot(right - across, ahead - along) <= vehicle.margin + cell
        return np.asarray(at[under])


def _opened(mask: Bools, radius: float, cell: float) -> Bools:
    """Cells of a mask that circles of this radius, m, cover that lie within it."""
    # Morphological opening by distances: an erosion and a dilation by a circle, whatever its radius in cells.
    inner = distance(~mask, cell) - 0.5 * cell  # to the edge of the nearest cell without
    return np.asarray(mask & (distance(inner >= radius, cell) < radius + 0.5 * cell))


def _belly(vehicle: Vehicle) -> Floats:
    """Points (n, 2) right and ahead of the middle, m, at most half a wheel apart."""
    sides = [np.linspace(-0.5, 0.5, 1 + math.ceil(v / (0.5 * vehicle.wheel_diameter))) * v
             for v in (vehicle.track, vehicle.wheel_base)]  # fmt: skip
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


@kernel
def _cell_under(poses, n, point):  # type: ignore[no-untyped-def]
    """Row and column of the cell under a point of the vehicle, right and ahead of its middle, cells, at pose ``n``."""
    c, s = poses.cosine[n], poses.sine[n]
    row = poses.at[n, 0] - (point[0] * s + point[1] * c)
    col = poses.at[n, 1] + (point[0] * c - point[1] * s)
    return math.floor(row + 0.5), math.floor(col + 0.5)


@kernel
def _gaps(poses, parts, maps, out):  # type: ignore[no-untyped-def]
    """Fill ``out``, the arrays (n,) of :class:`Gaps`."""
    rows, cols = maps.unknown.shape
    stand, heights = np.empty((4, 2), dtype=np.int64), np.empty(4)
    middle = np.zeros(2)
    for n in range(poses.at.shape[0]):
        i, j = _cell_under(poses, n, middle)
        if i < 0 or j < 0 or i >= rows or j >= cols:
            out.gap[n] = out.doubtful[n] = out.proven[n] = -np.inf
            # Off the map is on unknown ground.
            out.unknown[n] = out.frontier[n] = -1.0
            continue
        # The middle keeps off cells hazardous to the vehicle, the wheels keep off those hazardous to wheels.
        gap, doubtful, proven = maps.body.likely[i, j], maps.body.doubtful[i, j], maps.body.proven[i, j]
        cautious, doubted = (
            int(maps.body.cost_class[i, j] == CAUTION_GROUND),
            int(maps.body.cost_class[i, j] == DOUBTED_GROUND),
        )
        spare = maps.unknown[i, j] - parts.radius
        inside, unknown, frontier = True, np.float32(np.inf), np.float32(np.inf)
        for k in range(4):
            i, j = _cell_under(poses, n, parts.wheels[k])
            if i < 0 or j < 0 or i >= rows or j >= cols:
                inside, unknown, frontier = False, np.float32(-1.0), np.float32(-1.0)
                continue
            stand[k, 0], stand[k, 1] = i, j
            gap, doubtful = min(gap, maps.wheels.likely[i, j]), min(doubtful, maps.wheels.doubtful[i, j])
            proven = min(proven, maps.wheels.proven[i, j])
            cautious += maps.wheels.cost_class[i, j] == CAUTION_GROUND
            doubted += maps.wheels.cost_class[i, j] == DOUBTED_GROUND
            unknown = min(unknown, maps.unknown[i, j] - parts.margin)
            frontier = min(frontier, maps.frontier[i, j] - parts.margin)
        if inside and spare > 0:
            # No unknown ground within the circle about the vehicle: its belly need not be judged point by point.
            unknown = frontier = spare + parts.cell
        elif inside:
            steady = stands(maps.straddle, stand, heights)
            for k in range(parts.belly.shape[0]):
                i, j = _cell_under(poses, n, parts.belly[k])
                # All wheels are on the map: a point outside is a rounding to cells.
                i, j = min(max(i, 0), rows - 1), min(max(j, 0), cols - 1)
                void = maps.straddle.void[i, j]
                # Unknown, but bounded and low enough: then only the nearest ground without a bound counts.
                if steady and void > maps.unknown[i, j] and clears(maps.straddle, k, i, j, heights):
                    unknown = min(unknown, void)
                else:
                    unknown, frontier = min(unknown, maps.unknown[i, j]), min(frontier, maps.frontier[i, j])
        out.gap[n], out.doubtful[n], out.proven[n] = gap, doubtful, proven
        out.unknown[n], out.frontier[n] = unknown, frontier
        out.caution[n], out.doubted[n] = cautious, doubted
