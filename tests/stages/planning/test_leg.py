"""The next leg: known ground only, round what is closed, between hazards where it fits, back out of a dead end."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from leg_scenes import AT, CAMERAS, GOAL, LATTICE, ROVER, START, P, X, Y, ground
from raising import raises

from rille.stages.core.declare import Bundle
from rille.stages.hazard.risk import HAZARDOUS, REASONS, SAFE, UNKNOWN
from rille.stages.planning.local_planner import ground as ground_rules
from rille.stages.planning.local_planner import policy
from rille.stages.planning.local_planner.clearance import Footing, Hazards
from rille.stages.planning.local_planner.ground import CLOSED_WHEELBASES, FAR_COST, MIN_LEG_WHEELBASES, Ground
from rille.stages.planning.local_planner.look import AHEAD as ANYWHERE
from rille.stages.planning.local_planner.look import FieldOfView, PlannerMemory, Stand
from rille.stages.planning.local_planner.policy import MAX_LOOKS, Leg, plan_leg, shortest
from rille.stages.planning.local_planner.route import length_of, through
from rille.stages.planning.local_planner.stage import SeenGround, next_leg, seen_so_far, shortest_way
from rille.stages.terrain.occlusion_bounds import Bounds

TIRED = PlannerMemory(looks=MAX_LOOKS)
"""Of a vehicle that has looked as often as it may."""


def test_over_free_ground_it_goes_straight_one_leg_far() -> None:
    leg = plan_leg(ground(), AT, GOAL, P)
    assert leg.verdict == "drive"
    assert np.abs(leg.path[:, 0]).max() < 1e-9
    assert leg.path[-1, 1] == pytest.approx(P.max_length * ROVER.wheel_base, abs=1e-9)
    assert leg.gear.tolist() == [1]


def test_the_leg_ends_before_a_wheel_stands_on_unknown_ground() -> None:
    leg = plan_leg(ground((Y > 0.15, UNKNOWN)), AT, GOAL, P)
    assert leg.verdict == "drive"
    assert 0.15 - 0.5 * ROVER.wheel_base - 0.02 < leg.path[-1, 1] <= 0.155 - 0.5 * ROVER.wheel_base
    assert leg.way[-1, 1] > 0.75  # though the way is planned on over it


def test_unknown_ground_under_the_belly_alone_ends_the_leg_too() -> None:
    hole = (np.abs(X) < 0.016) & (np.abs(Y - 0.16) < 0.016)
    leg = plan_leg(ground((hole, UNKNOWN), (np.abs(X) > 0.06, HAZARDOUS)), AT, GOAL, P)
    assert leg.path[-1, 1] <= 0.145 - 0.5 * ROVER.wheel_base


def test_over_a_hole_between_walls_it_goes_where_lines_of_sight_pass_low_enough() -> None:
    hole = (np.abs(X) < 0.016) & (np.abs(Y - 0.16) < 0.016)
    risk = np.where(np.abs(X) > 0.075, np.uint8(HAZARDOUS), np.where(hole, np.uint8(UNKNOWN), np.uint8(SAFE)))
    meta = {"lattice": LATTICE.to_dict(), "vehicle": ROVER.model_dump(mode="json")}
    chance = np.where(risk == HAZARDOUS, np.float32(1.0), np.float32(0.0))
    chance[hole] = np.nan
    maps = {"risk": risk, "reason": np.full(risk.shape, REASONS["step"], np.uint16)}
    maps |= {"p_hazard": chance, "p_wheel": chance}
    seen = np.where(hole, np.nan, 0.0).astype(np.float32)

    def driven(top: float) -> Leg:
        bounds = Bounds(np.where(hole, np.float32(top), seen), seen)
        return next_leg(SeenGround(Bundle(maps, meta), None, bounds), AT, GOAL, P, PlannerMemory(), CAMERAS)

    over, before = driven(0.9 * ROVER.clearance), driven(1.1 * ROVER.clearance)
    assert over.path[-1, 1] > 0.16
    assert before.path[-1, 1] <= 0.145 - 0.5 * ROVER.wheel_base


def test_a_stone_between_the_wheels_is_passed_over_and_a_gap_too_narrow_to_turn_in_is_driven_through() -> None:
    stone = np.hypot(X, Y - 0.3) < 0.011
    walls = (np.abs(X) > 0.065) & (np.abs(Y - 0.3) < 0.1)
    leg = plan_leg(ground((stone, HAZARDOUS), (walls, HAZARDOUS)), AT, GOAL, P)
    assert leg.verdict == "drive"
    assert np.abs(leg.way[:, 0]).max() < 0.011
    narrow = (np.abs(X) > 0.045) & (np.abs(Y - 0.3) < 0.1)
    closed = plan_leg(ground((stone, HAZARDOUS), (narrow, HAZARDOUS)), AT, GOAL, P, TIRED)
    assert closed.verdict == "no path"


def test_out_of_a_dead_end_it_drives_back() -> None:
    pocket = ((np.abs(X) > 0.065) & (np.abs(Y) < 0.12)) | ((Y > 0.08) & (Y < 0.12))
    leg = plan_leg(ground((pocket, HAZARDOUS)), AT, (0.0, -0.19), P)
    assert leg.verdict == "drive"
    assert leg.gear[0] == -1
    assert leg.path[1, 1] < 0
    assert abs(leg.path[1, 0]) < 0.011


def test_a_wall_with_a_gap_is_gone_round_and_a_closed_one_is_no_path() -> None:
    wall = (np.abs(Y - 0.4) < 0.02) & (X < 0.1)
    leg = plan_leg(ground((wall, HAZARDOUS)), AT, GOAL, P)
    assert leg.verdict == "drive"
    beside = leg.way[np.abs(leg.way[:, 1] - 0.4) < 0.02]
    assert beside[:, 0].min() >= 0.1 + 0.5 * ROVER.track + ROVER.margin - 0.011
    across = ground((np.abs(Y - 0.4) < 0.02, HAZARDOUS))
    assert plan_leg(across, AT, GOAL, P).verdict == "look"
    closed = plan_leg(across, AT, GOAL, P, TIRED)
    assert closed.verdict == "no path"
    match = re.search(r"ends (\d+) mm away", closed.reason)
    assert match is not None
    # half a track and its margin behind the wall
    assert float(match[1]) == pytest.approx(1000 * (0.42 + 0.5 * ROVER.track + ROVER.margin), abs=15)


@pytest.mark.parametrize(("blocked", "degrees"), [(False, 25.0), (True, -25.0)])
def test_where_no_way_is_left_it_looks_around_as_its_wheels_have_room(blocked: bool, degrees: float) -> None:
    # the right rear wheel would move to (0.058, -0.029) m
    wall = (X > 0.045) & (Y > -0.045) & (Y < -0.02) & blocked
    leg = plan_leg(ground((np.abs(Y - 0.4) < 0.02, HAZARDOUS), (wall, HAZARDOUS)), AT, GOAL, P)
    assert (leg.verdict, math.degrees(leg.turn)) == ("look", pytest.approx(degrees))


def test_a_goal_among_hazards_is_said() -> None:
    rock = np.hypot(X - GOAL[0], Y - GOAL[1]) < 0.1
    leg = plan_leg(ground((rock, HAZARDOUS)), AT, GOAL, P, TIRED)
    assert (leg.verdict, leg.reason) == ("no path", "the goal itself is on hazardous ground, or too near to it")


def test_at_the_goal_it_ends() -> None:
    assert plan_leg(ground(), (0.0, 0.78, 0.0), GOAL, P).verdict == "goal"


def test_a_goal_outside_the_map_is_refused_with_the_map() -> None:
    with raises("RIL-406", "(0, 3)", "-0.4"):
        plan_leg(ground(), AT, (0.0, 3.0), P)


def test_more_than_the_greatest_turn_is_done_on_the_spot_first() -> None:
    leg = plan_leg(ground(), (*START, math.pi / 2), GOAL, P)
    assert (leg.verdict, len(leg.path)) == ("turn", 1)
    assert leg.turn == pytest.approx(-math.radians(P.max_turn_deg))
    assert length_of(through(leg.rest, leg.rest_gear, 0.0)) == pytest.approx(0.8, abs=0.02), "all of it is left"
    turned = math.pi / 2 + leg.turn
    onward = plan_leg(ground(), (*START, turned), GOAL, P, before=(leg.rest, leg.rest_gear))
    assert onward.turn == pytest.approx(-math.radians(P.max_turn_deg)), "on towards the same way, at any heading"


def test_it_closes_what_stays_unknown_in_view_and_goes_another_way() -> None:
    risk = ground(((np.abs(Y - 0.15) < 0.07) & (X < 0.1), UNKNOWN))
    start, goal = (-0.3, 0.0, 0.0), (-0.3, 0.8)
    places: list[tuple[float, float]] = []
    while (leg := plan_leg(risk, start, goal, P, PlannerMemory(MAX_LOOKS, places))).where is not None:
        places.append(leg.where)
        assert len(places) < 12
    assert leg.verdict in ("turn", "drive")
    over_unknown = leg.way[(leg.way[:, 1] > 0.04) & (leg.way[:, 1] < 0.26)]
    for place in places:
        assert np.hypot(*(over_unknown - place).T).min() > CLOSED_WHEELBASES * ROVER.wheel_base - LATTICE.cell


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(-math.pi, math.pi), st.sampled_from([ANYWHERE, CAMERAS]))
def test_no_leg_comes_near_a_hazard_or_onto_unknown_ground_or_turns_too_far(
    seed: int, heading: float, view: FieldOfView
) -> None:
    rng = np.random.default_rng(seed)
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    for _ in range(12):
        x, y, r = rng.uniform(-0.4, 0.4), rng.uniform(-0.15, 0.9), rng.uniform(0.01, 0.04)
        risk[np.hypot(X - x, Y - y) < r] = rng.choice([HAZARDOUS, UNKNOWN])
    risk[np.hypot(X, Y) < 0.1] = SAFE
    leg = plan_leg(Footing.of(Hazards(risk), LATTICE, ROVER), (*START, heading), GOAL, P, view=view)
    wheels = np.array([(a, b) for a in (-0.04, 0.04) for b in (-0.05, 0.05)])
    poses = list[tuple[np.ndarray, float]]()
    for a, b, gear in zip(leg.path, leg.path[1:], leg.gear, strict=False):
        dx, dy = gear * (b - a)
        towards = math.atan2(-dx, dy)
        turn = math.remainder(towards - heading, 2 * math.pi)
        poses += [(a, heading + t * turn) for t in np.linspace(0, 1, 20)]
        poses += [(a + t * (b - a), towards) for t in np.linspace(0, 1, 20)]
        heading = towards
    end = leg.path[-1] if len(leg.path) else np.array(START)
    poses += [(end, heading + leg.turn * t) for t in np.linspace(0, 1, 20)]
    assert np.ptp(np.unwrap([h for _, h in poses])) <= math.radians(P.max_turn_deg) + 1e-6
    for (x, y), h in poses:
        c, s = math.cos(h), math.sin(h)
        at = wheels @ np.array([[c, s], [-s, c]]) + (x, y)
        near = math.hypot(x, y) <= 0.3 * ROVER.wheel_base  # where it stands already is as it is
        for kind, need in ((HAZARDOUS, 0.0 if near else ROVER.margin), (UNKNOWN, ROVER.margin)):
            there = np.column_stack([X[risk == kind], Y[risk == kind]])
            if len(there):
                gap = np.hypot(*(at[:, None] - there[None]).transpose(2, 0, 1)).min()
                # a wheel is within its cell, and between two poses that were looked at within a tenth of a spacing
                assert gap > need - 0.5 * math.sqrt(2) * LATTICE.cell - 0.25 * LATTICE.cell


AHEAD = np.ones(2, np.int8)


def test_the_way_that_it_is_on_is_kept_unless_another_one_is_much_better() -> None:
    right_is_nearer = ground(((np.abs(Y - 0.4) < 0.02) & (X > -0.17) & (X < 0.15), HAZARDOUS))
    first = plan_leg(right_is_nearer, AT, GOAL, P)
    assert first.way[:, 0].max() > 0.15
    left = np.array([START, (-0.23, 0.4), GOAL])
    assert plan_leg(right_is_nearer, AT, GOAL, P, before=(left, AHEAD)).way[:, 0].min() < -0.17
    right_is_near = ground(((np.abs(Y - 0.4) < 0.02) & (X > -0.35) & (X < 0.0), HAZARDOUS))
    far = np.array([START, (-0.39, 0.4), GOAL])
    assert plan_leg(right_is_near, AT, GOAL, P, before=(far, AHEAD)).way[:, 0].min() > -0.1
    # and never where it is closed by now
    closed = ground(((np.abs(Y - 0.4) < 0.02) & (X < 0.15), HAZARDOUS))
    assert plan_leg(closed, AT, GOAL, P, before=(left, AHEAD)).way[:, 0].max() > 0.15


def test_what_is_left_after_a_leg_goes_on_from_where_the_vehicle_stands() -> None:
    band = ground(((np.abs(Y - 0.4) < 0.02) & (X > -0.17) & (X < 0.15), HAZARDOUS))
    leg = plan_leg(band, AT, GOAL, P)
    end, heading = leg.path[-1], math.atan2(*(leg.path[-2] - leg.path[-1])[:2] * (1, -1)) + leg.turn
    assert leg.rest[0] == pytest.approx(end)
    assert leg.rest[-1] == pytest.approx(leg.way[-1])
    beside = (float(end[0]) + 0.004, float(end[1]) - 0.003)
    onward = plan_leg(band, (*beside, heading), GOAL, P, before=(leg.rest, leg.rest_gear))
    assert onward.way[0] == pytest.approx(beside)
    assert onward.way[1:] == pytest.approx(leg.rest[1:])


def test_of_a_kept_way_it_drives_what_is_known() -> None:
    risk = ground((Y > 0.15, UNKNOWN))
    straight = np.array([START, GOAL])
    leg = plan_leg(risk, AT, GOAL, P, before=(straight, AHEAD[:1]))
    assert leg.verdict == "drive"
    assert leg.path[-1, 1] == pytest.approx(plan_leg(risk, AT, GOAL, P).path[-1, 1], abs=0.008)
    assert leg.rest == pytest.approx(np.array([leg.path[-1], GOAL]))
    # nearer by less than a leg is worth it looks, and what it looks at in vain is where known ground ends
    at = (0.0, float(leg.path[-1, 1]) - 0.01)
    kept = np.array([at, GOAL])
    closed = plan_leg(risk, (*at, 0.0), GOAL, P, TIRED, before=(kept, AHEAD[:1]))
    assert closed.verdict == "closed"
    assert closed.where is not None
    assert 0.0 <= closed.where[1] - leg.path[-1, 1] < LATTICE.cell + 1e-9


def test_a_kept_way_is_not_given_up_for_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy, "MIN_GAIN_SHARE", 5.0)
    beside = ground((X > 0.045, HAZARDOUS))  # the right wheels of a way straight ahead lack a part of the margin
    straight = np.array([START, GOAL])
    for closed in ([], [(0.0, 0.25)]):
        leg = plan_leg(beside, AT, GOAL, P, PlannerMemory(closed=closed), before=(straight, AHEAD[:1]))
        assert leg.verdict == "drive"
        assert leg.path == pytest.approx(np.array([START, (0.0, P.max_length * ROVER.wheel_base)]))
    # but never onto what is hazardous by sigma alone
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    risk[Y > 0.15] = HAZARDOUS
    reason = np.full(LATTICE.shape, REASONS["step"] | REASONS["uncertain"], np.uint16)
    leg = plan_leg(Footing.of(Hazards(risk, reason), LATTICE, ROVER), AT, GOAL, P, before=(straight, AHEAD[:1]))
    assert leg.path[-1, 1] < 0.15 - 0.5 * ROVER.wheel_base + LATTICE.cell


def test_a_kept_piece_that_begins_on_unknown_ground_is_not_known_to_its_end() -> None:
    there = Ground(ground(((np.abs(Y - 0.4) < 0.05), UNKNOWN)), START, 0.0, P)
    onward = through(np.array([(0.0, 0.4), GOAL]), AHEAD[:1], 0.0)
    assert [(piece.known, piece.length) for piece in there.again(onward)[0]] == [(False, pytest.approx(0.4))]


def test_a_kept_way_back_costs_as_much_as_a_new_one() -> None:
    there = Ground(ground(), START, 0.0, P)
    ways = (through(np.array([START, (0.0, 0.1 * gear)]), np.array([gear], np.int8), 0.0) for gear in (1, -1))
    ahead, back = (there.again(way)[1] for way in ways)
    assert back == pytest.approx(Ground.reverse_cost * ahead)


def test_a_metre_close_to_uncertain_ground_costs_more() -> None:
    careful, way = ROVER.model_copy(update={"margin": 0.03}), through(np.array([START, GOAL]), AHEAD[:1], 0.0)
    uncertain = np.full(LATTICE.shape, REASONS["step"] | REASONS["uncertain"], np.uint16)

    def cost(aside: float) -> float:
        risk = np.where(aside < X, np.uint8(HAZARDOUS), np.uint8(SAFE))
        return Ground(Footing.of(Hazards(risk, uncertain), LATTICE, careful), START, 0.0, P).again(way)[1]

    assert 1.1 * cost(0.2) < cost(0.05) < cost(0.041)


def judged(hazardous: np.ndarray, chance: float) -> Bundle:
    risk = np.where(hazardous, np.uint8(HAZARDOUS), np.uint8(SAFE))
    maps = {"risk": risk, "reason": np.where(hazardous, np.uint16(REASONS["step"]), np.uint16(0))}
    maps["p_hazard"] = maps["p_wheel"] = np.where(hazardous, chance, 0.0).astype(np.float32)
    return Bundle(maps, {"lattice": LATTICE.to_dict(), "vehicle": ROVER.model_dump(mode="json")})


def test_where_probable_hazards_close_every_way_those_next_to_certain_do() -> None:
    wall = np.abs(Y - 0.3) < 0.03
    for chance, verdict in ((0.93, "drive"), (0.999, "look")):
        leg = next_leg(SeenGround(judged(wall, chance)), AT, GOAL, P, PlannerMemory(), CAMERAS)
        assert leg.verdict == verdict
        assert (len(leg.way) > 1) == (verdict == "drive")


@pytest.mark.parametrize(("half", "margin"), [(0.065, ROVER.margin), (0.045, 0.0), (0.035, None)])
def test_the_shortest_way_keeps_the_margin_where_one_can(half: float, margin: float | None) -> None:
    walls = (np.abs(X) > half) & (np.abs(Y - 0.3) < 0.03)
    length, kept = shortest_way(judged(walls, 1.0), AT, GOAL, P)
    assert kept == margin
    assert (length is None) == (margin is None)


def test_doubtful_ground_is_dear_where_it_will_not_be_seen_from_nearer() -> None:
    free, way = np.full(LATTICE.shape, SAFE, np.uint8), through(np.array([START, GOAL]), AHEAD[:1], 0.0)

    def cost(y: float, kind: int) -> float:
        band = np.abs(Y - y) < 0.03
        risk = np.where(band, np.uint8(kind), free)
        footing = Footing.of(Hazards(risk, doubted=band if kind == SAFE else None), LATTICE, ROVER)
        return Ground(footing, START, 0.0, P).again(way)[1]

    assert cost(0.2, SAFE) > 1.05 * cost(0.5, SAFE)
    assert 0.85 < cost(0.5, SAFE) <= cost(0.5, UNKNOWN)


def test_what_is_likely_a_hazard_is_gone_round_farther_than_what_is_unknown() -> None:
    wall, band = (X < 0.22) & (np.abs(Y - 0.4) < 0.03), np.abs(Y - 0.4) < 0.12
    risk = np.where(wall, np.uint8(HAZARDOUS), np.uint8(SAFE))
    likely = Footing.of(Hazards(risk, None, np.where(wall, 0.7, 0.0).astype(np.float32)), LATTICE, ROVER, p_certain=0.9)
    assert plan_leg(likely, AT, GOAL, P).way[:, 0].max() > 0.22
    assert plan_leg(ground((band & wall, UNKNOWN)), AT, GOAL, P).way[:, 0].max() < 0.1
    across = Footing.of(Hazards(risk, None, np.where(wall, 0.7, 0.0).astype(np.float32)), LATTICE, ROVER, p_certain=0.6)
    assert plan_leg(across, AT, GOAL, P).way[:, 0].max() > 0.22  # which is certain


def test_the_shadow_of_a_stone_is_gone_round_farther_than_ground_that_nobody_looked_at() -> None:
    # 0.80 m straight over it, a vehicle's length and more of it unknown, or some 1.0 m round it
    shadow, unseen = ((X < 0.22) & (np.abs(Y - 0.4) < w) for w in (0.006, 0.021))
    assert plan_leg(ground((shadow, UNKNOWN)), AT, GOAL, P).way[:, 0].max() > 0.15
    assert plan_leg(ground((unseen, UNKNOWN)), AT, GOAL, P).way[:, 0].max() < 0.1


def test_no_wheel_is_driven_over_doubtful_ground_that_can_be_gone_round() -> None:
    free = np.full(LATTICE.shape, SAFE, np.uint8)
    doubted = np.hypot(X + 0.5 * ROVER.track, Y - 0.15) < 0.011
    footing = Footing.of(Hazards(free, doubted=doubted), LATTICE, ROVER)
    leg = plan_leg(footing, AT, GOAL, P)
    assert leg.verdict == "drive"
    for piece in through(leg.path, leg.gear, 0.0):
        along = np.linspace(0.0, 1.0, 50)
        x, y = (a + along * (b - a) for a, b in zip(piece.a, piece.b, strict=True))
        assert footing.gaps(x, y, np.full(50, piece.heading)).doubted.max() == 0
    # where there is no room to go round, it is driven over
    risk = np.where(np.abs(X) > 0.075, np.uint8(HAZARDOUS), free)
    between = plan_leg(Footing.of(Hazards(risk, doubted=doubted), LATTICE, ROVER), AT, GOAL, P)
    assert between.path[-1, 1] > 0.15


@pytest.mark.parametrize(("chance", "kind"), [(0.19, HAZARDOUS), (0.01, SAFE)])
def test_at_the_rim_of_what_is_near_only_what_is_clearly_free_from_afar_counts(chance: float, kind: int) -> None:
    def seen(risk: int, reason: int, p: float) -> Bundle:
        maps = {
            "risk": np.uint8(risk),
            "reason": np.uint16(reason),
            "p_hazard": np.float32(p),
            "p_wheel": np.float32(p),
        }
        return Bundle({name: np.full((2, 2), value) for name, value in maps.items()}, {})

    near = seen(HAZARDOUS, REASONS["slope"] | REASONS["uncertain"] | REASONS["unseen"], 0.45)
    known = seen_so_far(near, seen(SAFE, 0, chance))
    classes, found = known.risk, known.p_hazard
    assert (classes == kind).all()
    assert found == pytest.approx(0.45 if kind == HAZARDOUS else chance)
    assert known.unknown is not None
    assert not known.unknown.any()


def test_ground_seen_from_afar_alone_is_planned_over_rather_than_unseen_one_and_never_driven(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unknown = Y > 0.15
    glanced = unknown & (np.abs(X - 0.25) < 0.1)
    free = np.full(LATTICE.shape, SAFE, np.uint8)

    def planned(risk: np.ndarray) -> Leg:
        footing = Footing.of(Hazards(risk, unknown=unknown, glanced=glanced), LATTICE, ROVER)
        return plan_leg(footing, AT, GOAL, P)

    leg = planned(free)
    assert leg.path[-1, 1] + 0.5 * ROVER.wheel_base <= 0.155 - ROVER.margin
    assert leg.way[:, 0].max() > 0.15
    wall = np.where(glanced & (np.abs(Y - 0.5) < 0.02), np.uint8(HAZARDOUS), free)
    assert planned(wall).way[:, 0].max() < 0.15
    monkeypatch.setattr(ground_rules, "UNKNOWN_COST", FAR_COST)
    assert planned(free).way[:, 0].max() < 0.05


def test_standing_beside_unknown_ground_it_may_leave_but_not_go_nearer() -> None:
    beside = 0.04 + 0.5 * ROVER.margin < X
    leg = plan_leg(ground((beside, UNKNOWN)), AT, GOAL, P)
    assert leg.verdict == "drive"
    assert leg.path[:, 0].max() <= LATTICE.cell
    leg = plan_leg(ground((0.04 - 0.5 * ROVER.margin < X, UNKNOWN)), AT, GOAL, P)
    assert leg.verdict == "turn"  # to the left: a wheel stands on it already
    assert leg.turn > 0


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.floats(-3.2, 3.2), st.floats(-0.49, 0.49), st.floats(-0.49, 0.49))
def test_where_it_stands_it_may_be_half_a_cell_farther_too(seed: int, heading: float, dx: float, dy: float) -> None:
    rng = np.random.default_rng(seed)
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    row, col = (round(v) for v in LATTICE.index(START))
    at = rng.integers(-8, 9, (6, 2)) + np.array([row, col])
    risk[at[:, 0], at[:, 1]] = UNKNOWN
    there = Ground(Footing.of(Hazards(risk), LATTICE, ROVER), START, heading, P)
    assert there.clear(*(np.array([v]) for v in (dx * LATTICE.cell, dy * LATTICE.cell, heading)))


def test_hazards_to_the_whole_vehicle_count_at_its_middle_alone() -> None:
    risk = np.full(LATTICE.shape, SAFE, np.uint8)
    reason = np.zeros(LATTICE.shape, np.uint16)
    risk[60, 40] = HAZARDOUS
    x, y = (np.array([v]) for v in LATTICE.xy()[60, 50])
    ahead = np.zeros(1)
    gaps = {}
    for name in ("step", "tilt"):
        reason[60, 40] = REASONS[name]
        gaps[name] = float(Footing.of(Hazards(risk, reason), LATTICE, ROVER).gaps(x, y, ahead).gap[0])
    assert gaps["tilt"] == pytest.approx(0.1)
    assert gaps["step"] == pytest.approx(math.hypot(0.1 - 0.04, 0.05))
    reason[60, 40] |= REASONS["uncertain"]
    doubtful = Footing.of(Hazards(risk, reason), LATTICE, ROVER).gaps(x, y, ahead)
    assert doubtful.doubtful[0] == pytest.approx(0.1)
    assert doubtful.gap[0] == doubtful.proven[0] == np.inf


def test_uncertain_ground_is_planned_over_and_not_driven_on() -> None:
    risk, reason = np.full(LATTICE.shape, SAFE, np.uint8), np.zeros(LATTICE.shape, np.uint16)
    wall = np.abs(Y - 0.2) < 0.02
    risk[wall], reason[wall] = HAZARDOUS, REASONS["step"] | REASONS["uncertain"]
    leg = plan_leg(Footing.of(Hazards(risk, reason), LATTICE, ROVER), AT, GOAL, P)
    assert leg.verdict == "drive"
    assert leg.path[-1, 1] <= 0.18 - 0.5 * ROVER.wheel_base + LATTICE.cell
    assert leg.way[-1, 1] > 0.75


def test_the_shortest_way_is_straight_or_none() -> None:
    length = shortest(ground(), AT, GOAL, P)
    assert length == pytest.approx(0.8 - 0.015, abs=0.011)
    wall = ground((np.abs(Y - 0.4) < 0.02, HAZARDOUS))
    assert shortest(wall, AT, GOAL, P) is None
    assert shortest(ground((Y > 0.5, UNKNOWN)), AT, GOAL, P) is None


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.3, 0.3), st.floats(0.3, 0.9))
def test_the_shortest_way_over_free_ground_is_little_longer_than_the_beeline(x: float, y: float) -> None:
    length = shortest(ground(), AT, (x, y), P)
    assert length is not None
    assert math.hypot(x, y) - 0.016 <= length <= 1.02 * math.hypot(x, y)


def around_a_corner() -> Footing:
    """The way leads ahead and then to the right, over ground that is not known there."""
    return ground(((X > 0.09) & (Y < 0.3), HAZARDOUS), ((X > 0.15) & (Y >= 0.3), UNKNOWN))


FIRST = np.array([(0.16, 0.34), (0.16, 0.4)])
"""Ground there on which its right wheels come to stand first."""


@pytest.mark.parametrize("y", [0.1, 0.14, 0.18])
def test_a_leg_ends_facing_what_is_not_known_from_where_that_is_seen(y: float) -> None:
    leg = plan_leg(around_a_corner(), (0.0, y, 0.0), (0.35, 0.45), P, view=CAMERAS)
    assert leg.verdict == "drive"
    assert np.hypot(*(leg.path[-1] - leg.path[0])) >= MIN_LEG_WHEELBASES * ROVER.wheel_base
    last = leg.path[-1] - leg.path[-2]
    end: Stand = (leg.path[-1, 0], leg.path[-1, 1], math.atan2(-last[0], last[1]) + leg.turn)
    assert CAMERAS.sees(FIRST, end).all()


def test_it_turns_to_what_comes_next_before_it_is_too_near_to_see_it_and_then_drives() -> None:
    start, goal = (0.0, 0.26), (0.35, 0.45)
    leg = plan_leg(around_a_corner(), (*start, 0.0), goal, P, view=CAMERAS)
    assert leg.verdict == "look"
    assert -math.radians(P.max_turn_deg) - 1e-9 <= leg.turn < 0.0
    assert len(leg.path) == 1
    assert not CAMERAS.sees(FIRST, (*start, 0.0)).any()
    assert CAMERAS.sees(FIRST, (*start, leg.turn)).any()
    again = plan_leg(around_a_corner(), (*start, leg.turn), goal, P, PlannerMemory(1), view=CAMERAS)
    assert again.verdict == "drive", "it did not help"


@pytest.mark.parametrize("degrees", range(10, 180, 20))
def test_a_goal_nearer_than_the_shortest_leg_is_driven_to_though_the_way_is_made_straighter(degrees: int) -> None:
    angle = math.radians(degrees)
    goal = 0.035 * math.cos(angle), 0.3 + 0.035 * math.sin(angle)
    leg = plan_leg(ground(), (0.0, 0.3, 0.0), goal, P)
    assert leg.verdict in ("drive", "turn")


def test_from_where_every_way_is_closed_it_goes_back_as_it_came() -> None:
    came = [(0.0, y, 0.0) for y in (0.0, 0.15, 0.3)]
    walls = (np.abs(X) < 0.15) & (np.abs(Y - 0.3) < 0.15) & ((np.abs(X) > 0.065) | (np.abs(Y - 0.3) > 0.12))
    around = ground((walls, HAZARDOUS))
    assert plan_leg(around, came[-1], GOAL, P, TIRED).verdict == "no path"
    leg = plan_leg(around, came[-1], GOAL, P, PlannerMemory(MAX_LOOKS, track=came))
    assert leg.verdict == "drive"
    assert leg.gear.tolist()[0] == -1
    assert leg.path[-1, 1] < 0.15
    assert np.abs(leg.path[:, 0]).max() < 0.011
    # Beside the track, the ground is closed as before.
    assert plan_leg(around, came[-1], GOAL, P, PlannerMemory(MAX_LOOKS, track=came[1:])).verdict == "no path"
