"""The next leg of a drive to a goal: where to, how far of it is safe to drive now, or why no way leads there.

The way is planned to the goal over all of the map. Ground that is known and free costs its length; unknown ground may
be planned over, at a higher price, since the next stop will see it, but is never driven on: the leg ends before it. So
may ground that is hazardous only by the standard deviation of its elevations. Ground that is known to be hazardous, or
nearer to it than the vehicle and its margin need, is closed. What was seen from afar alone counts as unknown but for
its hazards and for what is clearly free, at a price of its own: the windows of a matcher smooth away what is smaller
than they are on the ground.

So the way bends round dead ends as soon as they are seen, and where no way is left even over unknown ground there is
none. This is the usual free-space assumption (Koenig, Tovey, Smirnov 2003, doi:10.1016/S0004-3702(03)00062-6), planned
anew at each stop.

The vehicle drives ahead, or back at a higher price, and turns on the spot where its wheels have room to
(:mod:`stages.pose_graph`): it may pass between two hazards between which it could not turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stages.declare import Array, Bundle, Inputs, Params, Stage
from stages.errors import InputError
from stages.footing import Footing, Gaps
from stages.geometry import RigidTransform
from stages.lattice import Lattice
from stages.pose_graph import PoseGraph, PoseGrid
from stages.route import (
    STEP_TURN,
    Piece,
    first_metres,
    last_metres,
    length_of,
    pieces,
    straightened,
    through,
    turnable,
    vertices,
    within_turn,
)
from stages.vehicle import Vehicle
from stages.verdict import UNKNOWN, UNSEEN_BIT

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Point = tuple[float, float]


FACING = math.radians(8.0)
"""What lies within it of the heading is looked at already."""

ASIDE = tuple(math.radians(d) for d in (3.0, -3.0, 6.0, -6.0, 9.0, -9.0))
"""Headings off the present one from which a way is looked for where there is none: a graph's headings are some 20
degrees apart, and out of a narrow place a way may lead at those between alone."""


class LegParams(Params):
    """Parameters of the stage ``leg``."""

    length: float = Field(2.0, gt=0, description="wheel bases; longest leg, which is driven without a new map")
    least: float = Field(0.3, gt=0, description="wheel bases; a shorter leg is not worth a stop: look elsewhere first")
    max_turn_deg: float = Field(
        40.0,
        gt=5,
        le=120,
        description="degrees that a leg turns off its first heading: landmarks must stay in view, half of it at least",
    )
    sure: tuple[float, float] = Field(
        (0.9, 0.995),
        description="probability from which a hazard closes ground, and the same where no way is left: what is far is "
        "uncertain, and nearer to it more is known",
    )
    dare: float = Field(
        0.3,
        ge=0,
        le=0.5,
        description="probability up to which ground that is hazardous by sigma alone is driven on, at a price: limits "
        "are half of what tips the vehicle over, and who never dares does not arrive among rocks",
    )
    avoid: float = Field(
        0.06,
        gt=0,
        le=1,
        description="probability of a hazard from which ground is dear: on the simulator's beds all edges that the map "
        "did not show lay on ground of 0.07 and more",
    )
    clear: float = Field(
        0.02,
        ge=0,
        lt=1,
        description="probability of a hazard below which ground is driven on that was seen from afar alone: of places "
        "for a wheel below it 0.05 in a thousand had an edge that the map did not show, of all 3.7",
    )
    glance_price: float = Field(
        1.3, ge=1, description="price of a metre over ground that was seen from afar alone: mostly it is as it looks"
    )
    unknown_price: float = Field(2.0, ge=1, description="price of a metre over unknown ground, known ground is 1")
    caution_price: float = Field(
        0.2, ge=0, description="added to the price where all wheels are on caution ground: a detour of a fifth"
    )
    blind: float = Field(
        1.5,
        ge=0,
        description="wheel bases; unknown ground this near is not seen by looking there, and what is doubtful "
        "within twice of it will stay so",
    )
    blind_price: float = Field(6.0, ge=1, description="price of a metre over it, so that other ways are tried first")
    loyalty: float = Field(
        0.15,
        ge=0,
        description="share by which another way must be cheaper than the one that the vehicle is on",
    )
    near_price: float = Field(0.5, ge=0, description="added to the price beside hazards, falls to 0 within the margin")
    back_price: float = Field(3.0, ge=1, description="price of a metre driven back, which no camera looks along")
    turn_price: float = Field(0.3, ge=0, description="wheel bases that a radian turned on the spot is worth")
    spacing: float = Field(0.25, gt=0, le=1, description="wheel diameters; spacing of the places that are planned over")
    tolerance: float = Field(0.3, gt=0, description="wheel bases; the goal is reached this near")
    looks: int = Field(3, ge=1, description="looks around without a leg after which the way counts as closed")
    vain: float = Field(0.8, gt=0, description="wheel bases; radius of what is closed then, as far as it is unknown")


@dataclass(frozen=True)
class Leg:
    """``verdict``: drive, turn, look, closed, goal or no path; ``path`` (vertex, 2) m to drive, ``gear`` (piece,) 1 for
    ahead and -1 for back; ``turn`` rad then.

    A look around turns, or drives back to see what lies nearer than the camera's view. ``closed``: it did not help;
    ``where`` the way is not known to be free.

    ``way`` (vertex, 2) m to the goal, as it is planned; ``rest`` (vertex, 2) m what is left of it after the leg, and
    ``rest_gear`` (piece,) how it is driven; ``cost`` (row, col) m to the goal at these prices at the best
    heading, NaN where it is closed, or farther than the vehicle.
    """

    verdict: str
    reason: str
    path: Floats
    gear: NDArray[np.int8]
    turn: float
    way: Floats
    rest: Floats
    rest_gear: NDArray[np.int8]
    cost: NDArray[np.float32]
    where: Point | None = None


class Ground:
    """The map about a vehicle: what it may drive on, what it may plan over, and at which price."""

    def __init__(
        self,
        footing: Footing,
        start: Point,
        heading: float,
        p: LegParams,
        closed: Sequence[Point] = (),
        aside: float = 0.0,
    ) -> None:
        """``aside``: rad from the heading to the graph's first one."""
        self.footing, self.start, self.heading, self.p, self.closed = footing, start, heading, p, tuple(closed)
        self.vehicle, self.cell = footing.vehicle, footing.lattice.cell
        at = footing.gaps(*(np.array([v]) for v in (*start, heading)))
        # where it stands it may be: near there, ground that is no worse by more than a cell will do
        self.here = [min(self.vehicle.margin, float(a[0]) - self.cell) for a in (at.gap, at.proven)]
        self.unknown_here = min(0.0, float(at.unknown[0]) - self.cell)
        spacing = max(p.spacing * self.vehicle.wheel_diameter, self.cell)
        self.grid = PoseGrid.over(footing.lattice, start, heading + aside, spacing)
        self._sure: list[Mask] = []
        self.graph = PoseGraph.of(footing, self.grid, self._prices)

    def _split(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Mask, Mask]:
        """Poses that may be driven, and those that may be planned over: there the margin may lack ``slack`` m."""
        near = np.hypot(x - self.start[0], y - self.start[1]) <= 0.3 * self.vehicle.wheel_base
        margin = self.vehicle.margin
        known = gaps.gap > np.where(near, self.here[0], margin)
        known &= gaps.unknown > np.where(near, self.unknown_here, 0.0)
        opened = gaps.proven > np.where(near, self.here[1], margin) - slack
        for cx, cy in self.closed:
            opened &= known | (np.hypot(x - cx, y - cy) > self.p.vain * self.vehicle.wheel_base)
        return known, opened | known

    def _prices(self, gaps: Gaps, x: Floats, y: Floats, heading: Floats) -> Floats:
        known, price = self._price(gaps, x, y)
        self._sure.append(known)
        return price

    def _price(self, gaps: Gaps, x: Floats, y: Floats, slack: float = 0.0) -> tuple[Mask, Floats]:
        """Poses that may be driven, and the price of a metre, infinite where none may be planned."""
        known, opened = self._split(gaps, x, y, slack)
        reach = self.p.blind * self.vehicle.wheel_base * np.where(gaps.unknown > 0, 2.0, 1.0)
        blind = np.hypot(x - self.start[0], y - self.start[1]) <= reach
        unseen = np.full(x.shape, self.p.unknown_price)
        if self.footing.glanced is not None:
            unseen[~self._at(~self.footing.glanced, x, y)] = min(self.p.glance_price, self.p.unknown_price)
        unknown = np.where(blind, np.maximum(self.p.blind_price, unseen), unseen)
        price = np.where(known, 1.0, unknown) + self.p.caution_price * gaps.caution
        if self.vehicle.margin > 0:
            price = price + self.p.near_price * np.clip(2.0 - gaps.gap / self.vehicle.margin, 0.0, 1.0)
        return known, np.where(opened, price, np.inf)

    def _at(self, mask: Mask, x: Floats, y: Floats) -> Mask:
        """Values of a mask on the map at points; true outside."""
        at = np.rint(self.footing.lattice.index(np.stack([x, y], axis=-1))).astype(np.int64)
        inside = ((at >= 0) & (at < mask.shape)).all(axis=-1)
        row, col = (np.where(inside, at[..., k], 0) for k in (0, 1))
        return np.asarray(~inside | mask[row, col])

    def known(self) -> tuple[Mask, ...]:
        """Poses, steps and turns of the graph that may be driven, each (heading over half a turn, row, col)."""
        return tuple(np.stack(self._sure[kind::3]) for kind in range(3))

    def clear(self, x: Floats, y: Floats, heading: Floats) -> bool:
        """Whether all of these poses may be driven."""
        return bool(self.free(x, y, heading).all())

    def free(self, x: Floats, y: Floats, heading: Floats) -> Mask:
        """Which of these poses may be driven."""
        return self._split(self.footing.gaps(x, y, heading), x, y)[0]

    def places(self) -> tuple[Floats, Floats]:
        """x and y (row, col), m, of the graph's places."""
        row, col = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in self.grid.shape), indexing="ij")
        return self.grid.xy(row, col)

    def search(self, goal: Point, reach: float, *, whole: bool = False) -> tuple[Mask, Floats, NDArray[np.int8]]:
        """Goals (row, col) within ``reach`` metres, cost and move (heading, row, col)."""
        x, y = self.places()
        goals: Mask = np.asarray(np.hypot(x - goal[0], y - goal[1]) <= reach)
        turn = self.p.turn_price * self.vehicle.wheel_base
        return goals, *self.graph.search(goals, turn, self.p.back_price, whole=whole)

    def beside(self) -> Iterator[Ground]:
        """The same from headings a little aside, as far as the wheels have room to turn there."""
        for aside in ASIDE:
            if turnable(self.start, self.heading, self.heading + aside, self.clear):
                yield Ground(self.footing, self.start, self.heading, self.p, self.closed, aside)

    def opens(self, goals: Mask) -> bool:
        """Whether the vehicle may be at one of these places (row, col)."""
        return bool(np.isfinite(self.graph.pose[:, goals]).any())

    def from_start(self, cost: Floats) -> float:
        """Cost of the way from the start, infinite where there is none."""
        return float(cost[0, self.grid.origin[0], self.grid.origin[1]])

    def way(self, move: NDArray[np.int8]) -> list[Piece]:
        """The way from the start in steps."""
        return pieces(self.graph, self.known(), self.graph.follow(move))

    def again(self, way: Sequence[Piece]) -> tuple[list[Piece], float]:
        """A way that was planned before, from the start: which of it is known now, and its cost at present prices.

        It was looked at in steps of the places then; looked at more closely its margin may be short by a cell.
        """
        out, cost, heading = list[Piece](), 0.0, self.heading
        for piece in way:
            turn = abs(piece.heading - heading)
            n, m = (max(2, 1 + math.ceil(v)) for v in (turn / STEP_TURN, 2.0 * piece.length / self.grid.spacing))
            share = np.append(np.zeros(n), np.linspace(0.0, 1.0, m))
            x, y = (piece.a[i] + share * (piece.b[i] - piece.a[i]) for i in (0, 1))
            angle = np.append(np.linspace(heading, piece.heading, n), np.full(m, piece.heading))
            known, price = self._price(self.footing.gaps(x, y, angle), x, y, self.cell)
            metres = piece.length * (self.p.back_price if piece.gear < 0 else 1.0)
            if not np.isfinite(price).all():
                return [], math.inf
            cost += turn * self.p.turn_price * self.vehicle.wheel_base * float(price[:n].max())
            cost += metres * float(price[n:].mean())
            first = piece.length * float(share[np.argmin(known) - 1])  # metres before what is not known
            if not known.all() and np.argmin(known) > n and first > 0:
                out.append(replace(piece.cut(first), known=True))
                piece = replace(piece, a=out[-1].b)
            out.append(replace(piece, known=bool(known.all())))
            heading = piece.heading
        return out, cost

    def on_map(self, cost: Floats) -> NDArray[np.float32]:
        """Cost at the best heading on the cells of the map, NaN where it is not known."""
        best = cost.min(axis=0)
        xy = self.footing.lattice.xy()
        row, col = (np.rint(v).astype(np.int64) for v in self.grid.index(xy[..., 0], xy[..., 1]))
        inside = (row >= 0) & (col >= 0) & (row < self.grid.shape[0]) & (col < self.grid.shape[1])
        found = np.where(inside, best[np.where(inside, row, 0), np.where(inside, col, 0)], np.inf)
        return np.where(np.isfinite(found), found, np.nan).astype(np.float32)


def plan_leg(
    footing: Footing,
    start: Point,
    heading: float,
    goal: Point,
    params: LegParams,
    looks: int = 0,
    closed: Sequence[Point] = (),
    before: tuple[Floats, NDArray[np.int8]] | None = None,
    backs: Sequence[Point] = (),
) -> Leg:
    """The next leg.

    Parameters
    ----------
    footing : of the map known so far.
    start, heading : m; rad to the left of y.
    looks : looks around since the last leg that was driven.
    closed : places about which unknown ground was looked at in vain.
    before : what was left, after the last leg, of the way planned then: (vertex, 2) m, (piece,) gear. It is kept unless
        another one is better by ``loyalty``; None: there is none.
    backs : places from which it drove back already, to see what lies before it.

    Raises
    ------
    InputError
        Start or goal lies outside the map.
    """
    for name, point in (("start", start), ("goal", goal)):
        _check(footing.lattice, name, point)
    base = footing.vehicle.wheel_base
    left = math.hypot(goal[0] - start[0], goal[1] - start[1])
    if left <= params.tolerance * base:
        nothing = np.full(footing.lattice.shape, np.nan, np.float32)
        return _stay("goal", f"{1000 * left:.0f} mm from the goal", start, [], nothing)
    ground = Ground(footing, start, heading, params, closed)
    goals, cost, move = ground.search(goal, 0.5 * params.tolerance * base)
    shown, least = ground.on_map(cost), ground.from_start(cost)
    kept, price = list[Piece](), math.inf
    if before is not None:
        kept, price = ground.again(_onward(before, start, heading, ground.grid.spacing))
    for other in ground.beside() if not np.isfinite(min(least, price)) and ground.opens(goals) else ():
        _, found, move = other.search(goal, 0.5 * params.tolerance * base)
        least = other.from_start(found)
        if np.isfinite(least):
            ground, shown = other, other.on_map(found)
            break
    if not np.isfinite(min(least, price)):
        why = _why_closed(ground, goals, cost)
        turn = 0.0 if looks >= params.looks else _free_turn(ground, 0.0, looks)
        if turn:
            return _stay("look", f"{why}: looks around", start, [], shown, turn)
        return _stay("no path", why, start, [], shown)
    way = kept if kept and price <= (1.0 + params.loyalty) * least else ground.way(move)
    sure = first_metres(way[: _sure(way)], 4.0 * params.length * base)
    straight = straightened(sure, heading, ground.clear, ground.cell)
    plan = [*straight, *last_metres(way, length_of(sure))]
    leg = first_metres(straight, params.length * base)
    if length_of(leg) >= min(params.least * base, length_of(way) - 1e-9):
        leg, turn = within_turn(leg, heading, math.radians(params.max_turn_deg))
        if leg:
            if not turnable(leg[-1].b, leg[-1].heading, leg[-1].heading + turn, ground.clear):
                turn = 0.0
            rest = last_metres(plan, length_of(leg))
            return Leg("drive", "", *_line(leg, start), turn, vertices(way, start), *_line(rest, leg[-1].b), shown)
        return _stay("turn", f"turns {math.degrees(turn):.0f} degrees to where it goes on", start, plan, shown, turn)
    x, y = way[min(_sure(way), len(way) - 1)].cut(ground.grid.spacing).b
    towards = math.remainder(math.atan2(-(x - start[0]), y - start[1]) - heading, 2 * math.pi)
    again = any(math.hypot(start[0] - bx, start[1] - by) < params.vain * base for bx, by in backs)
    if looks < params.looks and not again and (looks > 0 or abs(towards) < FACING):
        back = _free_back(ground, params.blind * base)
        if length_of(back) >= params.least * base:
            reason = f"drives back {1000 * length_of(back):.0f} mm to see the ground before it"
            rest = [Piece(back[-1].b, start, heading, 1), *plan]
            return Leg("look", reason, *_line(back, start), 0.0, vertices(way, start), *_line(rest, back[-1].b), shown)
    turn = 0.0 if looks >= params.looks else _free_turn(ground, towards, looks)
    if turn:
        return _stay("look", f"turns {math.degrees(turn):.0f} degrees to see the way", start, way, shown, turn)
    reason = f"{looks} looks around did not show the ground at ({x:.3f}, {y:.3f}) m"
    return _stay("closed", reason, start, way, shown, where=(x, y))


def _line(way: Sequence[Piece], start: Point) -> tuple[Floats, NDArray[np.int8]]:
    """Vertices (n, 2) m, the start first, and gear (n - 1,)."""
    return vertices(way, start), np.array([piece.gear for piece in way], np.int8)


def _onward(before: tuple[Floats, NDArray[np.int8]], start: Point, heading: float, least: float) -> list[Piece]:
    """What was left of a way, from where the vehicle is now; vertices nearer than ``least`` metres are passed."""
    (points, gear), first = before, 1
    while first + 1 < len(points) and math.hypot(*(points[first] - start)) < least:
        first += 1
    return through(np.concatenate([[start], points[first:]]), gear[first - 1 :], heading)


def _stay(
    verdict: str,
    reason: str,
    start: Point,
    way: Sequence[Piece],
    cost: NDArray[np.float32],
    turn: float = 0.0,
    where: Point | None = None,
) -> Leg:
    """A leg on the spot."""
    return Leg(verdict, reason, *_line([], start), turn, vertices(way, start), *_line(way, start), cost, where)


def _sure(way: Sequence[Piece]) -> int:
    """Number of pieces before the first that is not known to be free."""
    return next((i for i, piece in enumerate(way) if not piece.known), len(way))


def _free_turn(ground: Ground, towards: float, looks: int) -> float:
    """Turn (rad) to look along the way, where it looks there already to one side and then to the other, that the
    wheels have room for; 0: none."""
    bound = math.radians(ground.p.max_turn_deg)
    aside = [math.radians(d) for d in (25.0, -50.0, 75.0)]
    aside = aside[looks % 3 :] + aside[: looks % 3] + [math.radians(d) for d in (-25.0, 15.0, -15.0)]
    wanted = [*([towards] if abs(towards) >= FACING else []), *aside]
    for turn in (max(-bound, min(bound, w)) for w in wanted):
        if turnable(ground.start, ground.heading, ground.heading + turn, ground.clear):
            return turn
    return 0.0


def _free_back(ground: Ground, most: float) -> list[Piece]:
    """Straight back, at most so many metres, as far as it is free: then the camera sees what it is blind to now."""
    n = math.ceil(2.0 * most / ground.cell)
    way = np.linspace(0.0, most, n + 1)
    x, y = ground.start[0] + way * math.sin(ground.heading), ground.start[1] - way * math.cos(ground.heading)
    free = ground.free(x, y, np.full(way.shape, ground.heading))
    last = int(np.argmin(free)) - 1 if not free.all() else n
    return [Piece(ground.start, (float(x[last]), float(y[last])), ground.heading, -1)] if last > 0 else []


def shortest(footing: Footing, start: Point, heading: float, goal: Point, params: LegParams) -> float | None:
    """Length, m, of the shortest way over known ground, at no price but its length; None: none."""
    free = {"unknown_price": math.inf, "near_price": 0.0, "caution_price": 0.0, "turn_price": 0.0, "back_price": 1.0}
    ground = Ground(footing, start, heading, params.model_copy(update=free))
    _, cost, move = ground.search(goal, 0.5 * params.tolerance * footing.vehicle.wheel_base)
    if not np.isfinite(ground.from_start(cost)):
        return None
    return length_of(straightened(ground.way(move), heading, ground.clear, ground.cell))


def _check(lattice: Lattice, name: str, point: Point) -> None:
    row, col = (int(v) for v in np.rint(lattice.index(point)))
    if not (0 <= row < lattice.rows and 0 <= col < lattice.cols):
        x0, x1, y0, y1 = lattice.bounds
        raise InputError(
            f"the {name} ({point[0]:.3f}, {point[1]:.3f}) m is outside the map",
            remedy=f"give x in {x0:.3f}..{x1:.3f} and y in {y0:.3f}..{y1:.3f} m",
        )


def _why_closed(ground: Ground, goals: Mask, cost: Floats) -> str:
    if not ground.opens(goals):
        return "the goal itself is on hazardous ground, or too near to it"
    row, col = np.nonzero(np.isfinite(cost).any(axis=0))
    gap = float(np.hypot(row - ground.grid.origin[0], col - ground.grid.origin[1]).min()) * ground.grid.spacing
    return f"hazards close every way: ground from which the goal can be reached ends {1000 * gap:.0f} mm away"


def _run(params: LegParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    risk = inputs["risk"]
    lattice, vehicle = Lattice.from_dict(risk.meta["lattice"]), Vehicle.model_validate(risk.meta["vehicle"])
    T_world_left = RigidTransform.from_matrix(np.asarray(inputs["pose"]["poses"])[-1])
    T = T_world_left @ RigidTransform.from_matrix(args["T_vehicle_left"]).inverse()
    start = float(T.translation[0]), float(T.translation[1])
    heading = math.atan2(-T.rotation[0, 1], T.rotation[1, 1])
    goal = (float(args["goal"][0]), float(args["goal"][1]))
    closed = [(float(x), float(y)) for x, y in args["closed"]]
    before = None
    if "before" in inputs and len(inputs["before"]["rest_gear"]):
        before = np.asarray(inputs["before"]["rest"]), np.asarray(inputs["before"]["rest_gear"])
    names = ("risk", "reason", "p_hazard")
    classes, reason, chance = (np.asarray(risk[name]) for name in names)
    unknown, glanced = classes == UNKNOWN, None
    if "far" in inputs:
        far = inputs["far"]
        # at the rim of what is near, a window is cut off, which widens the doubt; all of it was seen from afar
        cut = unknown | ((reason & UNSEEN_BIT) != 0)
        classes, reason, chance = (
            np.where(cut, np.asarray(far[name]), near)
            for name, near in zip(names, (classes, reason, chance), strict=True)
        )
        unknown &= ~(chance < params.clear)
        glanced = unknown & (classes != UNKNOWN)
    doubted = chance >= params.avoid
    seen = {"unknown": unknown, "glanced": glanced, "doubted": doubted}
    for sure in params.sure:
        footing = Footing.of(classes, reason, lattice, vehicle, chance, sure, params.dare, **seen)
        found = plan_leg(footing, start, heading, goal, params, int(args["looks"]), closed, before, args["backs"])
        if found.verdict == "goal" or len(found.way) > 1:
            break
    best: float | None = None
    margin: float | None = None
    for margin in (vehicle.margin, 0.0) if args.get("whole") else ():
        bare = vehicle.model_copy(update={"margin": margin})
        allowed = Footing.of(classes, reason, lattice, bare, chance, params.sure[-1], params.dare)
        best = shortest(allowed, start, heading, goal, params)
        if best is not None:
            break
    meta = {
        "shortest_m": best,
        "shortest_margin_m": margin,
        "verdict": found.verdict,
        "reason": found.reason,
        "turn": found.turn,
        "where": None if found.where is None else list(found.where),
        "start": [*start, heading],
        "goal": list(goal),
        "left_m": math.hypot(goal[0] - start[0], goal[1] - start[1]),
        "length_m": _length(found.path),
        "way_m": _length(found.way),
    }
    arrays: dict[str, NDArray[Any]] = {"path": found.path, "gear": found.gear, "way": found.way}
    arrays |= {"rest": found.rest, "rest_gear": found.rest_gear, "cost_to_go": found.cost}
    return Bundle(arrays, meta)


def _length(path: Floats) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) > 1 else 0.0


STAGE = Stage(
    name="leg",
    version=6,
    summary="the next leg of a drive to a goal, over ground that is known to be free",
    params=LegParams,
    inputs=("risk", "far?", "pose", "before?"),
    outputs=(
        Array(
            "path",
            ("vertex", "xy"),
            "float64",
            "m",
            "vertices of the leg, from where the vehicle stands",
            frame="world",
        ),
        Array("gear", ("piece",), "int8", "1", "1 where the leg is driven ahead, -1 where it is driven back"),
        Array("way", ("way_vertex", "xy"), "float64", "m", "vertices of the way to the goal as planned", frame="world"),
        Array(
            "rest", ("rest_vertex", "xy"), "float64", "m", "vertices of what is left of it after the leg", frame="world"
        ),
        Array("rest_gear", ("rest_piece",), "int8", "1", "1 where that is driven ahead, -1 where it is driven back"),
        Array("cost_to_go", ("row", "col"), "float32", "m", "price of the way from each cell to the goal", "nan"),
    ),
    requires=("numpy", "numba", "scipy"),
    run=_run,
)
