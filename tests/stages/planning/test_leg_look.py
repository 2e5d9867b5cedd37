"""Where a vehicle looks: what comes into view from there, by its cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
from leg_scenes import CAMERAS, GOAL, LATTICE, START, P, X, Y, ground

from rille.stages.hazard.risk import UNKNOWN
from rille.stages.planning.local_planner.ground import Ground
from rille.stages.planning.local_planner.look import TURN_STEP, Target
from rille.stages.planning.local_planner.route import Piece, split

FREE = Ground(ground(), START, 0.0, P)
BOUND = math.radians(P.max_turn_deg)


def target(points: list[tuple[float, float]]) -> Target:
    return Target(FREE, CAMERAS, np.array(points))


@pytest.mark.parametrize("side", [-0.15, 0.0, 0.2, 0.35])
def test_it_turns_no_more_than_it_must(side: float) -> None:
    aim = target([(side, 0.3)])
    turn = aim.turn(START, 0.0, BOUND, BOUND)
    assert turn is not None
    assert CAMERAS.sees(aim.points, (*START, turn)).all()
    if turn != 0.0:
        assert math.copysign(1.0, turn) == math.copysign(1.0, -side)
        assert not CAMERAS.sees(aim.points, (*START, turn - math.copysign(TURN_STEP, turn))).any()
    assert aim.turn(START, 0.0, 0.0, 0.0) == (0.0 if turn == 0.0 else None)


def test_a_leg_is_driven_as_far_as_the_target_stays_in_view() -> None:
    leg = [Piece(START, (0.0, 0.1), 0.0, 1), Piece((0.0, 0.1), (0.0, 0.4), 0.0, 1)]
    for points in ([(0.0, 0.35)], [(0.1, 0.3), (0.12, 0.3)]):
        seen = target(points).last_view(leg, BOUND)
        assert seen is not None
        y = split(leg, seen[0])[0][-1].b[1]
        assert CAMERAS.sees(np.array(points), (0.0, y, seen[1])).all()
        beyond = [
            CAMERAS.sees(np.array(points), (0.0, y + 2.1 * LATTICE.cell, k * TURN_STEP)).all() for k in range(-8, 9)
        ]
        assert not any(beyond)
    assert target([(0.0, -0.1)]).last_view(leg, BOUND) is None


def test_the_target_is_what_is_not_known_beneath_the_first_pose_that_is_not() -> None:
    spot = np.hypot(X - 0.04, Y - 0.4) < 0.015
    on = Ground(ground((spot, UNKNOWN)), START, 0.0, P)
    way = [Piece(START, (0.0, 0.33), 0.0, 1), Piece((0.0, 0.33), GOAL, 0.0, 1, known=False)]
    aim = Target(on, CAMERAS, on.lacking(way, 1))
    assert np.hypot(*(aim.points - (0.04, 0.4)).T).max() < 0.015
