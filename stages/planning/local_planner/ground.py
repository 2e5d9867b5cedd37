"""The map around a vehicle: which poses it may drive through, which it may plan through, and what a metre costs there.

The rules are those of :mod:`rille.stages.planning.local_planner.policy`. Paths are searched on a lattice of poses
through the vehicle (:mod:`rille.stages.planning.local_planner.state_lattice`); a path planned at an earlier stop is
evaluated again on the present map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.planning.local_planner.clearance import Footing, Gaps
from rille.stages.planning.local_planner.params import LocalPlannerParams
from rille.stages.planning.local_planner.route import STEP_TURN, Piece, pieces, turnable
from rille.stages.planning.local_planner.state_lattice import PoseGraph, PoseGrid

Point = tuple[float, float]

ASIDE = tuple(math.radians(d) for d in (3.0, -3.0, 6.0, -6.0, 9.0, -9.0))
"""Offsets [rad] of the lattice's first heading that are tried where the present heading finds no path: headings of a
lattice are some 20 degrees apart, and out of a narrow place a path may lead only between two of them."""

DOUBT_WEIGHT = 60
"""Ratio of the cost of doubted ground to that of caution ground: one wheel on it more than triples the cost."""
PARTS = 5
"""Parts of a vehicle that stand on ground: its wheels and its middle."""
HERE = 0.3
"""Radius [wheelbases] around the start pose within which a cell is accepted if its clearance is not below that of the
start pose."""
NEARER = 2.0
"""Factor on ``occluded_radius``: doubtful ground beyond that radius will be seen again from nearer, where most
doubts vanish."""


class Ground:
    """The map around a vehicle, with the lattice of poses that is searched on it."""

    def __init__(
        self,
        footing: Footing,
        start: Point,
        heading: float,
        p: LocalPlannerParams,
        closed: Sequence[Point] = (),
        aside: float = 0.0,
    ) -> None:
        """
        Parameters
        ----------
        start, heading : x, y [m] and heading [rad, to the left of y] of the vehicle.
        closed : middles [m] of circles in which unknown ground counts as closed.
        aside : angle [rad] from the heading to the lattice's first heading.
        """
        self.footing, self.start, self.heading, self.p, self.closed = footing, start, heading, p, tuple(closed)
        self.vehicle, self.cell = footing.vehicle, footing.lattice.cell
        at = footing.gaps(*(np.array([v]) for v in (*start, heading)))
        # where it stands it may be: near there, ground that is no worse by more than a cell will do
        margin = self.vehicle.margin
        # Else a vehicle that slipped into a margin could never leave it.
        self.here = [
            min(most, float(a[0]) - self.cell)
            for most, a in ((margin, at.gap), (0.0, at.doubtful), (margin, at.proven))
        ]
        # rounded to cells, places less than half a cell apart may be a diagonal apart
        self.unknown_here = min(0.0, float(at.unknown[0]) - 1.5 * self.cell)
        spacing = max(p.spacing * self.vehicle.wheel_diameter, self.cell)
        self.grid = PoseGrid.over(footing.lattice, start, heading + aside, spacing)
        self.graph = PoseGraph.of(footing, self.grid, self._price)

    def _split(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Bools, Bools]:
        """Poses that may be driven, and poses that may be planned through; margins are shortened by ``slack`` metres.

        No margin is kept from hazards by sigma alone: sigma is the room for error there.
        """
        near, margin = self._away(x, y) <= HERE, self.vehicle.margin
        known = (gaps.gap > np.where(near, self.here[0], margin) - slack) & (
            gaps.unknown > np.where(near, self.unknown_here, 0.0)
        )
        known &= gaps.doubtful > np.where(near, self.here[1], 0.0)
        # Hazards that are likely but not proven may be planned over, at a price: seen from nearer most of them go.
        opened = gaps.proven > np.where(near, self.here[2], margin) - slack
        for cx, cy in self.closed:
            # Where looking did not help, unknown ground is closed; known ground in the circle may be driven.
            opened &= known | (np.hypot(x - cx, y - cy) > self.p.failed_view_radius * self.vehicle.wheel_base)
        return known, opened | known

    def _away(self, x: Floats, y: Floats) -> Floats:
        """Distance from the start [wheelbases]."""
        return np.asarray(np.hypot(x - self.start[0], y - self.start[1]) / self.vehicle.wheel_base)

    def _price(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Bools, Floats]:
        """Poses that may be driven, and the price of a metre, infinite where none may be planned."""
        known, opened = self._split(gaps, x, y, slack)
        away = self._away(x, y)
        blind = away <= self.p.occluded_radius * np.where(gaps.unknown > 0, NEARER, 1.0)
        unseen = np.full(x.shape, self.p.unknown_cost)
        if self.footing.glanced is not None:
            unseen[~self._at(~self.footing.glanced, x, y)] = min(self.p.far_cost, self.p.unknown_cost)
        unknown = np.where(blind, np.maximum(self.p.occluded_cost, unseen), unseen)
        # Likely hazards, and gaps narrower than a wheel, which are the shadows of stones: looking nearer does not free
        # them.
        stays = (gaps.gap <= self.vehicle.margin) | ((gaps.unknown <= 0) & (gaps.frontier > 0))
        unknown = np.where(stays, np.maximum(self.p.uncertainty_cost, unknown), unknown)
        caution = self.p.caution_cost * ((gaps.caution + DOUBT_WEIGHT * gaps.doubted) / PARTS)
        # No higher than the cost of unknown ground.
        fades = (away > NEARER * self.p.occluded_radius) & ~stays
        caution = np.where(fades, np.minimum(caution, self.p.unknown_cost - 1.0), caution)
        price = np.where(known, 1.0, unknown) + caution
        if self.vehicle.margin > 0:
            beside = np.minimum(gaps.gap / self.vehicle.margin - 1.0, gaps.doubtful / self.vehicle.margin)
            # Falls from one at the margin to none at twice the margin; of hazards by sigma alone from their edge, as
            # they have none.
            price = price + self.p.proximity_cost * np.clip(1.0 - beside, 0.0, 1.0)
        return known, np.where(opened, price, np.inf)

    def _at(self, mask: Bools, x: Floats, y: Floats) -> Bools:
        """Values of a mask on the map at points; true outside."""
        at = np.rint(self.footing.lattice.index(np.stack([x, y], axis=-1))).astype(np.int64)
        inside = ((at >= 0) & (at < mask.shape)).all(axis=-1)
        row, col = (np.where(inside, at[..., k], 0) for k in (0, 1))
        return np.asarray(~inside | mask[row, col])

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

    def places(self) -> tuple[Floats, Floats]:
        """x and y (row, col), m, of the graph's places."""
        row, col = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in self.grid.shape), indexing="ij")
        return self.grid.xy(row, col)

    def search(self, goal: Point, reach: float, *, whole: bool = False) -> tuple[Bools, Floats, NDArray[np.int8]]:
        """Goals (row, col) within ``reach`` metres, cost and move (heading, row, col)."""
        x, y = self.places()
        goals: Bools = np.asarray(np.hypot(x - goal[0], y - goal[1]) <= reach)
        turn = self.p.turn_cost * self.vehicle.wheel_base
        return goals, *self.graph.search(goals, turn, self.p.reverse_cost, whole=whole)

    def beside(self) -> Iterator[Ground]:
        """Yield this map with other lattices: their first heading is offset by each of :data:`ASIDE`.

        An offset is left out if the wheels have no room for the turn.
        """
        for aside in ASIDE:
            if turnable(self.start, self.heading, self.heading + aside, self.clear):
                yield Ground(self.footing, self.start, self.heading, self.p, self.closed, aside)

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
        """A path planned at an earlier stop: its pieces, split where they stop being known, and its cost now.

        Its margin may be short by a cell: it was planned on poses of the lattice and is sampled more closely here.
        """
        out, cost, heading = list[Piece](), 0.0, self.heading
        for piece in way:
            n, share, (x, y, angle) = self._along(piece, heading)
            known, price = self._price(self.footing.gaps(x, y, angle), x, y, self.cell)
            metres = piece.length * (self.p.reverse_cost if piece.gear < 0 else 1.0)
            if not np.isfinite(price).all():
                return [], math.inf
            # A turn costs as in the lattice, by its costliest pose; a piece costs by the mean of its poses.
            cost += abs(piece.heading - heading) * self.p.turn_cost * self.vehicle.wheel_base * float(price[:n].max())
            cost += metres * float(price[n:].mean())
            # The known part is driven now: cut there, or a whole long piece would count as unknown.
            first = piece.length * float(share[np.argmin(known) - 1])  # metres before what is not known
            if not known.all() and np.argmin(known) > n and first > 0:
                out.append(replace(piece.cut(first), known=True))
                piece = replace(piece, a=out[-1].b)
            out.append(replace(piece, known=bool(known.all())))
            heading = piece.heading
        return out, cost

    def _along(self, piece: Piece, before: float) -> tuple[int, Floats, tuple[Floats, Floats, Floats]]:
        """Poses of a turn on the spot and of the piece after it: number of poses of the turn, share of the piece (n,),
        and x, y [m], heading [rad] (n,)."""
        turn, steps = abs(piece.heading - before) / STEP_TURN, 2.0 * piece.length / self.grid.spacing
        n, m = (max(2, 1 + math.ceil(v)) for v in (turn, steps))
        share = np.append(np.zeros(n), np.linspace(0.0, 1.0, m))
        x, y = (piece.a[i] + share * (piece.b[i] - piece.a[i]) for i in (0, 1))
        return n, share, (x, y, np.append(np.linspace(before, piece.heading, n), np.full(m, piece.heading)))

    def lacking(self, way: Sequence[Piece], first: int) -> tuple[Floats, bool]:
        """Why piece ``first`` of a path, the first that is not known to be free, is not.

        Returns the middles (n, 2), m, of the cells to blame at its first pose that may not be driven, and whether they
        were never seen from near; cells that were seen are to blame, as hazards, only where all were seen.
        """
        piece, before = way[first], way[first - 1].heading if first > 0 else self.heading
        _, _, (x, y, angle) = self._along(piece.cut(self.grid.spacing), before)
        gaps = self.footing.gaps(x, y, angle)
        k = int(np.argmin(self._split(gaps, x, y)[0]))
        stand = float(x[k]), float(y[k]), float(angle[k])
        fields = self.footing.fields
        for mask, unseen in ((self.footing.unknown == 0, True), ((fields[:2] == 0).any(axis=0), False)):
            points = self.footing.beneath(mask, stand)
            if len(points):
                return points, unseen
        return np.array([stand[:2]]), False

    def on_map(self, cost: Floats) -> Floats32:
        """Cost at the best heading on the cells of the map, NaN where it is not known."""
        best = cost.min(axis=0)
        xy = self.footing.lattice.xy()
        row, col = (np.rint(v).astype(np.int64) for v in self.grid.index(xy[..., 0], xy[..., 1]))
        inside = (row >= 0) & (col >= 0) & (row < self.grid.shape[0]) & (col < self.grid.shape[1])
        found = np.where(inside, best[np.where(inside, row, 0), np.where(inside, col, 0)], np.inf)
        return np.where(np.isfinite(found), found, np.nan).astype(np.float32)
