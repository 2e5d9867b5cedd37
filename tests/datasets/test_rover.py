"""The simulated rover: without errors it drives as told, with them it departs as they say."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from raising import raises

from rille.datasets.mockup.obstacle import on_path
from rille.datasets.mockup.rover import (
    FRAME_TURN,
    ORIGIN,
    RoverParams,
    RoverPose,
    SentLeg,
    bed_ground,
    drive_leg,
    images_at,
)
from rille.datasets.mockup.sequence import vehicle_at_scale
from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import heading_of
from rille.stages.planning.wheels import HeightGrid

VEHICLE = vehicle_at_scale()
EXACT = RoverParams(slip=0.0, slip_sigma=0.0, heading_sigma_deg=0.0, turn_sigma=0.0)
PATH = np.array([[0.0, 0.0], [0.0, 0.1], [0.1, 0.2]])
X, Y = np.meshgrid(np.arange(-0.5, 0.501, 0.004), np.arange(0.5, -0.501, -0.004))
FLAT = HeightGrid.of(0.0 * X, -0.5, 0.5, 0.004, VEHICLE.wheel_diameter)


def driven(p: RoverParams, turn: float = 0.0, seed: int = 0, believed: RoverPose = ORIGIN):
    return drive_leg(FLAT, VEHICLE, ORIGIN, believed, SentLeg(PATH, [1, 1], turn), p, np.random.default_rng(seed))


def test_without_errors_it_is_where_it_was_sent_and_the_wheels_say_so() -> None:
    d = driven(EXACT, turn=0.3)
    end = d.trail[-1].T_ground_vehicle
    assert end.translation == pytest.approx([0.1, 0.2, 0.0], abs=1e-12)
    assert heading_of(end) == pytest.approx(-math.pi / 4 + 0.3)
    assert np.array(d.wheels[-1]) == pytest.approx([0.1, 0.2, -math.pi / 4 + 0.3])


def test_slip_shortens_the_way_and_not_what_the_wheels_say() -> None:
    d = driven(EXACT.model_copy(update={"slip": 0.3}))
    assert d.trail[-1].T_ground_vehicle.translation == pytest.approx([0.07, 0.14, 0.0], abs=1e-12)
    assert np.array(d.wheels[-1][:2]) == pytest.approx([0.1, 0.2])


def test_a_wrong_belief_of_the_heading_turns_the_way() -> None:
    d = driven(EXACT, believed=RoverPose(0.0, 0.0, math.pi / 2))
    assert d.trail[-1].T_ground_vehicle.translation == pytest.approx([0.2, -0.1, 0.0], abs=1e-12)


def test_heading_errors_scatter_as_said() -> None:
    p = EXACT.model_copy(update={"heading_sigma_deg": 2.0})
    ends = [heading_of(driven(p, seed=k).trail[-1].T_ground_vehicle) for k in range(60)]
    assert np.std(ends) == pytest.approx(math.radians(2.0), rel=0.4)  # four standard deviations of 60 samples


def test_the_same_seed_drives_the_same_way() -> None:
    a, b, c = (driven(RoverParams(), seed=k).trail[-1].T_ground_vehicle.matrix34 for k in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_images_are_taken_by_way_and_turn() -> None:
    d = driven(EXACT)
    wheels = np.array(d.wheels)
    at = images_at(wheels, EXACT)
    assert (at[0], at[-1]) == (0, len(wheels) - 1)
    for a, b in itertools.pairwise(at):
        way = np.hypot(*np.diff(wheels[a : b + 1, :2], axis=0).T).sum()
        turn = np.abs(np.diff(wheels[a : b + 1, 2])).sum()
        assert way <= EXACT.frame_step + 0.005
        assert turn <= FRAME_TURN + math.radians(2.5)


def test_a_piece_that_is_driven_back_is_driven_back() -> None:
    rng = np.random.default_rng(0)
    behind = np.array([[0.0, 0.0], [0.0, -0.1], [0.0, 0.05]])
    d = drive_leg(FLAT, VEHICLE, ORIGIN, ORIGIN, SentLeg(behind, [-1, 1], 0.0), EXACT, rng)
    y = np.array([s.T_ground_vehicle.translation[1] for s in d.trail])
    assert y.min() == pytest.approx(-0.1)
    assert y[-1] == pytest.approx(0.05)
    assert np.abs([heading_of(s.T_ground_vehicle) for s in d.trail]).max() < 1e-12
    assert np.array(d.wheels)[:, 1] == pytest.approx(y)


def test_beside_the_bed_it_is_not_placed() -> None:
    with raises("RIL-250"):
        drive_leg(
            FLAT, VEHICLE, RoverPose(0.5, 0.0, 0.0), ORIGIN, SentLeg(PATH, [1, 1], 0.0), EXACT, np.random.default_rng(0)
        )


@pytest.mark.parametrize("at", [(5.0, 5.0), (-5.0, -5.0), (0.0, 5.0), (5.0, 0.0), (0.0, -5.0)])
def test_far_from_the_bed_it_is_not_placed(at: tuple[float, float]) -> None:
    lattice = {"x0": -0.5, "y0": 0.5, "cell": 0.004}
    ground = bed_ground(Bundle({"height": FLAT.height}, {"lattice": lattice}), VEHICLE, at, 0.3)
    with raises("RIL-250"):
        drive_leg(
            ground, VEHICLE, RoverPose(*at, 0.0), ORIGIN, SentLeg(PATH, [1, 1], 0.0), EXACT, np.random.default_rng(0)
        )


def test_a_place_along_and_beside_a_path() -> None:
    assert on_path(PATH, 0.05, 0.01) == pytest.approx((0.01, 0.05))
    half = 0.05 / math.sqrt(2)
    assert on_path(PATH, 0.15, 0.0) == pytest.approx((half, 0.1 + half))
    assert on_path(PATH, 0.1 + 0.2 * math.sqrt(2), 0.0) == pytest.approx((0.2, 0.3))  # beyond its end
