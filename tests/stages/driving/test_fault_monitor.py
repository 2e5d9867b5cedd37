"""Safety stops: each reason at the image where it shows, none before, none without."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.driving.fault_monitor import Readings, Verdict, fault_monitor_stage, judge
from rille.stages.geometry.geometry import RigidTransform, rotation_exp

OPTICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
T_VEHICLE_LEFT = RigidTransform(rotation_exp([-0.5, 0.0, 0.0]) @ OPTICAL, np.array([0.0, 0.05, 0.18]))
VEHICLE = {"max_slope_deg": 20.0, "wheel_base": 0.1}
STEP = 0.025


def leg(n: int = 5, slip: float = 0.05, turn: float = 0.0) -> dict[str, Any]:
    """A straight leg of which everything is in order; the world is turned against the vehicle."""
    world = RigidTransform(rotation_exp([0.0, 0.0, 0.7]), np.array([1.0, 2.0, 0.0]))
    poses = []
    for k in range(n):
        moved = RigidTransform(rotation_exp([0, 0, turn * k]), np.array([0.0, (1 - slip) * STEP * k, 0.0]))
        poses.append((world @ moved @ T_VEHICLE_LEFT).matrix34)
    up = np.tile(T_VEHICLE_LEFT.rotation[2], (n, 1))
    odometry = np.array([[0.0, STEP * k, 0.0] for k in range(n)])
    return {
        "up": up,
        "acceleration": np.full(n, 0.1),
        "odometry": odometry,
        "poses": np.array(poses),
        "tracked": [{"inliers": 99}] * n,
    }


def judged(**changes: Any) -> Verdict:
    given = leg() | changes
    readings = Readings(given["up"], given["acceleration"], given["odometry"])
    return judge(readings, given["poses"], given["tracked"], T_VEHICLE_LEFT, VEHICLE)


def test_a_leg_in_order_is_driven_to_its_end() -> None:
    assert judged() == Verdict(None, "", "")


def test_a_tilt_beyond_the_vehicles_stops() -> None:
    up = leg()["up"].copy()
    up[3] = T_VEHICLE_LEFT.rotation.T @ rotation_exp([math.radians(21.0), 0, 0]) @ [0.0, 0.0, 1.0]
    found = judged(up=up)
    assert (found.stop, found.kind) == (3, "attitude")
    assert "21.0" in found.reason
    up[3] = T_VEHICLE_LEFT.rotation.T @ rotation_exp([math.radians(19.0), 0, 0]) @ [0.0, 0.0, 1.0]
    assert judged(up=up).stop is None


@pytest.mark.parametrize(
    ("name", "kind", "sensor"),
    [
        ("up", "attitude", "inclinometer"),
        ("acceleration", "acceleration", "accelerometer"),
        ("odometry", "slip", "wheel odometry"),
    ],
)
def test_a_sensor_without_a_reading_stops(name: str, kind: str, sensor: str) -> None:
    values = leg()[name].copy()
    values[2] = np.nan
    found = judged(**{name: values})
    assert (found.stop, found.kind) == (2, kind)
    assert sensor in found.reason


def test_a_bump_stops() -> None:
    found = judged(acceleration=np.array([9.0, 0.1, 0.1, 0.1, 3.5]))
    assert (found.stop, found.kind) == (4, "acceleration")  # what came before the leg is not its own
    assert "3.5 m/s2" in found.reason


def test_too_few_landmarks_stop() -> None:
    tracked = [{"inliers": n} for n in (99, 50, 11, 50, 50)]
    found = judged(tracked=tracked)
    assert (found.stop, found.kind) == (2, "lost")
    assert "11 landmarks" in found.reason
    tracked[2] = {"inliers": 0, "lost": "8 landmarks leave the position uncertain by 0.008 m"}
    assert judged(tracked=tracked).reason == "tracking is lost: 8 landmarks leave the position uncertain by 0.008 m"


@pytest.mark.parametrize(("slip", "stop"), [(0.05, None), (0.15, None), (0.3, 2), (-0.3, 2)])
def test_slip_stops_as_soon_as_the_way_tells(slip: float, stop: int | None) -> None:
    found = judged(**leg(slip=slip))
    assert found.stop == stop
    if slip == 0.3:
        assert [fact for fact in ("30%", "50 mm", "35 mm") if fact not in found.reason] == []


def test_a_heading_that_the_wheels_do_not_know_stops() -> None:
    found = judged(**leg(turn=math.radians(3.0)))
    assert (found.stop, found.kind) == (3, "slip")
    assert "9.0 degrees" in found.reason


def test_wheels_count_turns_on_where_headings_begin_anew() -> None:
    given = leg(turn=1.0)
    given["odometry"][:, 2] = np.arange(5)
    assert judged(**given).stop is None


def test_readings_are_taken_from_the_first_image_on() -> None:
    given, heading = leg(turn=0.05), 2.0
    ways = given["odometry"] + [0.3 * STEP, 0.0, 0.05] * np.arange(5)[:, None]
    given["odometry"] = ways @ rotation_exp([0, 0, heading]).T + [5.0, -3.0, heading]
    moved = [RigidTransform(rotation_exp([0, 0, z]), np.array([x, y, 0])) @ T_VEHICLE_LEFT for x, y, z in ways]
    facts = [{"frame": 7 + k, "inliers": 99} for k in range(5)]
    resect = Bundle({"poses": np.array([T.matrix34 for T in moved])}, {"per_frame": facts})
    args = {"rows": list(range(5)), "T_vehicle_left": T_VEHICLE_LEFT.to_list(), "vehicle": VEHICLE}
    sense = Bundle({name: given[name] for name in ("up", "acceleration", "odometry")}, {})
    assert fault_monitor_stage.run(NoParams(), args, {"sense": sense, "resect": resect}).meta["stop"] is None
    sense.arrays["odometry"][3, :2] -= 0.5 * (given["odometry"][3, :2] - given["odometry"][0, :2])
    assert fault_monitor_stage.run(NoParams(), args, {"sense": sense, "resect": resect}).meta["stop"] == 3


def test_a_vehicle_that_lies_upside_down_stops() -> None:
    up = leg()["up"].copy()
    up[2] *= -1.0 - 1e-15
    found = judged(up=up)
    assert (found.stop, found.kind) == (2, "attitude")
