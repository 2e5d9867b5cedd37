"""The map around a vehicle: poses it may drive through, poses it may plan through, and the cost of a metre there.

The rules are those of :mod:`rille.stages.planning.local_planner.policy`. Paths are searched on a lattice of poses
through the vehicle (:mod:`rille.stages.planning.local_planner.state_lattice`); a path planned at an earlier stop is
evaluated again on the present map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Params
from rille.stages.planning.local_planner.clearance import Footing, Gaps
from rille.stages.planning.local_planner.route import STEP_TURN, Piece, pieces
from rille.stages.planning.local_planner.state_lattice import LatticeGraph, PoseGrid

Point = tuple[float, float]

TOLERANCE_WHEELBASES = 0.3
"""Distance from the goal at which it is reached."""
MIN_LEG_WHEELBASES = 0.3
"""Length of the shortest leg; where none is longer, the rover looks elsewhere first."""


class LocalPlannerParams(Params):
    """Parameters of the stage ``local_planner``.

    Attributes
    ----------
    max_length : longest leg [wheelbases]: the distance that is driven on one map; larger: fewer stops.
    max_turn_deg : largest angle [degrees] between any two headings of a leg; at least half of the landmarks must stay
        in view.
    p_certain_hazard : probability of a hazard from which ground is closed; the second value applies where the first
        leaves no path. Both are high because far elevations are uncertain, and nearer ones decide later.
    p_max_traversable : probability of a hazard up to which ground may be driven on that only its standard deviation
        makes hazardous; 0: never, then few paths among rocks are found. The vehicle's limits are about half of those at
        which it tips over.
    """

    max_length: float = Field(2.0, ge=MIN_LEG_WHEELBASES)
    max_turn_deg: float = Field(40.0, gt=5, le=120)
    p_certain_hazard: tuple[float, float] = (0.9, 0.995)
    p_max_traversable: float = Field(0.3, ge=0, le=0.5)


SPACING_WHEELS = 0.25
"""Of the lattice of poses, wheel diameters."""
# Costs are factors of a metre's cost; a metre over known, free ground costs 1.
UNKNOWN_COST = 2.0
FAR_COST = 1.3
"""Cost of a metre over ground seen from afar alone; it seldom changes when seen from near."""
LIKELY_COST = 4.0
"""Cost of a metre over ground with a likely hazard, or with unseen spots narrower than a wheel, which are shadows of
stones; both mostly remain when seen from near."""
CAUTION_COST = 0.2
"""Added to the cost of a metre where all wheels are on caution ground."""
PROXIMITY_COST = 0.5
"""Added to the cost of a metre at the margin of a hazard; it falls to 0 at twice the margin."""
HERE_WHEELBASES = 0.3
"""Radius around the start pose within which a cell is accepted if its clearance is at least that of the start."""
NEAR_WHEELBASES = 3.0
"""Distance beyond which doubtful ground will be seen again from nearer, where most doubts vanish."""
CLOSED_WHEELBASES = 0.8
"""Radius of the unknown ground that is closed after looking did not help."""


class Ground:
    """The map around a vehicle, with the lattice of poses that is searched on it."""

    turn_cost = 0.3
    """Cost of a turn on the spot, wheelbases of free ground per radian."""
    reverse_cost = 3.0
    """Cost of a metre driven backwards, where no camera looks."""

    def __init__(
        self, footing: Footing, start: Point, heading: float, p: LocalPlannerParams, closed: Sequence[Point] = ()
    ) -> None:
        """
        Parameters
        ----------
        start, heading : x, y [m] and heading [rad, to the left of y] of the vehicle.
        closed : middles [m] of circles in which unknown ground counts as closed.
        """
        self.footing, self.start, self.heading, self.p, self.closed = footing, start, heading, p, tuple(closed)
        self.vehicle, self.cell = footing.vehicle, footing.lattice.cell
        here = footing.gaps(*(np.array([v]) for v in (*start, heading)))
        # A vehicle that slipped into a margin may leave it: near its place, ground that is no worse by more than a cell
        # is accepted.
        self.here = [
            min(limit, float(a[0]) - self.cell)
            for limit, a in ((self.vehicle.margin, here.gap), (0.0, here.doubtful), (self.vehicle.margin, here.proven))
        ]
        # Rounded to cells, places less than half a cell apart may be a diagonal apart.
        self.unknown_here = min(0.0, float(here.unknown[0]) - 1.5 * self.cell)
        spacing = max(SPACING_WHEELS * self.vehicle.wheel_diameter, self.cell)
        self.grid = PoseGrid.over(footing.lattice, start, heading, spacing)
        self.graph = LatticeGraph.of(footing, self.grid, self._price)

    def _split(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Bools, Bools]:
        """Poses that may be driven, and poses that may be planned through; margins are shortened by ``slack`` metres.

        No margin is kept from hazards by sigma alone: sigma is the room for error there.
        """
        near, margin = self._away(x, y) <= HERE_WHEELBASES, self.vehicle.margin
        known = (gaps.gap > np.where(near, self.here[0], margin) - slack) & (
            gaps.unknown > np.where(near, self.unknown_here, 0.0)
        )
        known &= gaps.doubtful > np.where(near, self.here[1], 0.0)
        # Hazards that are likely but not proven may be planned over, at a price: most of them vanish from nearer.
        opened = gaps.proven > np.where(near, self.here[2], margin) - slack
        for cx, cy in self.closed:
            # Where looking did not help, unknown ground is closed; known ground in the circle may be driven.
            opened &= np.hypot(x - cx, y - cy) > CLOSED_WHEELBASES * self.vehicle.wheel_base
        return known, opened | known

    def _away(self, x: Floats, y: Floats) -> Floats:
        """Distance from the start [wheelbases]."""
        return np.asarray(np.hypot(x - self.start[0], y - self.start[1]) / self.vehicle.wheel_base)

    def _price(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Bools, Floats]:
        """Poses that may be driven, and the price of a metre, infinite where none may be planned."""
        known, opened = self._split(gaps, x, y, slack)
        unknown = np.full(x.shape, UNKNOWN_COST)
        if self.footing.glanced is not None:
            lattice = self.footing.lattice
            at = lattice.index(np.stack([x, y], axis=-1))
            unknown[lattice.values(self.footing.glanced, at, False)] = FAR_COST
        # Likely hazards, and gaps narrower than a wheel, which are the shadows of stones, remain when seen from nearer.
        stays = (gaps.gap <= self.vehicle.margin) | ((gaps.unknown <= 0) & (gaps.frontier > 0))
        unknown = np.where(stays, LIKELY_COST, unknown)
        # Of the five parts that stand on ground: the wheels and the middle.
        # 60: ratio of the cost of doubted ground to that of caution ground: one wheel on it more than triples the cost.
        caution = CAUTION_COST * ((gaps.caution + 60 * gaps.doubted) / 5)
        # Far doubts cost no more than unknown ground.
        fades = (self._away(x, y) > NEAR_WHEELBASES) & ~stays
        caution = np.where(fades, np.minimum(caution, UNKNOWN_COST - 1.0), caution)
        price = np.where(known, 1.0, unknown) + caution
        if self.vehicle.margin > 0:
            # From the edge of hazards by sigma alone, as they have no margin.
            beside = np.minimum(gaps.gap / self.vehicle.margin - 1.0, gaps.doubtful / self.vehicle.margin)
            price = price + PROXIMITY_COST * np.clip(1.0 - beside, 0.0, 1.0)
        return known, np.where(opened, price, np.inf)

    def clear(self, x: Floats, y: Floats, heading: Floats) -> bool:
        """Whether all of these poses may be driven."""
        return bool(self.free(x, y, heading).all())

    def plain(self, x: Floats, y: Floats, heading: Floats) -> bool:
        """Whether all of these poses may be driven and no wheel stands on doubtful ground there."""
        gaps = self.footing.gaps(x, y, heading)
        return bool((self._split(gaps, x, y)[0] & (gaps.doubted == 0)).all())

    def free(self, x: Floats, y: Floats, heading: Floats) -> Bools:
        """Which of these poses may be driven."""
        return self._split(self.footing.gaps(x, y, heading), x, y)[0]

    def search(self, goal: Point, reach: float, *, whole: bool = False) -> tuple[Bools, Floats, NDArray[np.int8]]:
        """Goals (row, col) within ``reach`` metres, cost and move (heading, row, col)."""
        x, y = self.grid.places()
        goals: Bools = np.asarray(np.hypot(x - goal[0], y - goal[1]) <= reach)
        turn = self.turn_cost * self.vehicle.wheel_base
        return goals, *self.graph.search(goals, turn, self.reverse_cost, whole=whole)

    def open_track(self, track: Sequence[tuple[float, float, float]]) -> None:
        """Let the vehicle go back over places where it stood, x, y (m) and heading (rad) in order, whatever the map
        shows there now."""
        stands = np.array([*track, (*self.start, self.heading)])
        stands[:, 2] = np.unwrap(stands[:, 2])
        way, turn = np.hypot(*np.diff(stands[:, :2], axis=0).T), np.abs(np.diff(stands[:, 2]))
        done = np.append(0.0, np.cumsum(2.0 * way / self.grid.spacing + turn / STEP_TURN))
        between = np.linspace(0.0, done[-1], 1 + math.ceil(done[-1]))
        x, y, angle = (np.interp(between, done, v) for v in stands.T)
        self.graph.open_at(x, y, angle, LIKELY_COST)

    def opens(self, goals: Bools) -> bool:
        """Whether the vehicle may be at one of these places (row, col)."""
        return bool(np.isfinite(self.graph.pose[:, goals]).any())

    def from_start(self, cost: Floats) -> float:
        """Cost of the way from the start, infinite where there is none."""
        return float(cost[0, self.grid.origin[0], self.grid.origin[1]])

    def way(self, move: NDArray[np.int8]) -> list[Piece]:
        """The way from the start in steps."""
        return pieces(self.graph, self.graph.follow(move))

    def again(self, way: Sequence[Piece]) -> tuple[list[Piece], float]:
        """A path planned at an earlier stop: its pieces, split at the end of known ground, and its cost now.

        Its margin may be short by a cell: it was planned on poses of the lattice and is sampled more closely here.
        """
        out, cost, heading = list[Piece](), 0.0, self.heading
        for piece in way:
            share, x, y, angle = self._along(piece, heading)
            known, price = self._price(self.footing.gaps(x, y, angle), x, y, self.cell)
            if not np.isfinite(price).all():
                return [], math.inf
            # A turn costs as in the lattice, by its costliest pose; a piece costs by the mean of its poses.
            n = int(np.count_nonzero(share < 0))
            turn = abs(piece.heading - heading) * self.turn_cost * self.vehicle.wheel_base
            metres = piece.length * (self.reverse_cost if piece.gear < 0 else 1.0)
            cost += turn * float(price[:n].max()) + metres * float(price[n:].mean())
            # The known part is driven now: cut there, or a whole long piece would count as unknown.
            unknown = int(np.argmin(known))
            first = piece.length * float(share[unknown - 1]) if unknown else 0.0  # metres before that pose
            if not known.all() and first > 0:
                out.append(replace(piece.cut(first), known=True))
                piece = replace(piece, a=out[-1].b)
            out.append(replace(piece, known=bool(known.all())))
            heading = piece.heading
        return out, cost

    def _along(self, piece: Piece, before: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Poses (n,) of a turn on the spot and of the piece after it: share of the piece, -1 in the turn; x, y [m] and
        heading [rad]."""
        turn, steps = abs(piece.heading - before) / STEP_TURN, 2.0 * piece.length / self.grid.spacing
        n, m = (max(2, 1 + math.ceil(v)) for v in (turn, steps))
        share = np.append(np.full(n, -1.0), np.linspace(0.0, 1.0, m))
        x, y = (piece.a[i] + np.maximum(share, 0.0) * (piece.b[i] - piece.a[i]) for i in (0, 1))
        return share, x, y, np.append(np.linspace(before, piece.heading, n), np.full(m, piece.heading))

    def lacking(self, way: Sequence[Piece], first: int) -> Floats:
        """Middles (n, 2), m, of the cells to blame at the first pose of piece ``first`` of a path, the first that is
        not known to be free: those that were never seen from near; where there are none, the hazards."""
        piece, before = way[first], way[first - 1].heading if first > 0 else self.heading
        _, x, y, angle = self._along(piece.cut(self.grid.spacing), before)
        k = int(np.argmin(self.free(x, y, angle)))
        stand = float(x[k]), float(y[k]), float(angle[k])
        maps = self.footing.maps
        for mask in (maps.unknown == 0, (maps.wheels.likely == 0) | (maps.wheels.doubtful == 0)):
            points = self.footing.beneath(mask, stand)
            if len(points):
                return points
        return np.array([stand[:2]])


class KnownFreeGround(Ground):
    """Known ground alone, at no price but its length, whatever the direction."""

    turn_cost, reverse_cost = 0.0, 1.0

    def _price(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Bools, Floats]:
        known, _ = self._split(gaps, x, y, slack)
        return known, np.where(known, 1.0, np.inf)
