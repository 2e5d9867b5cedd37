"""Safety stops of a drive (section 2.2): readings of the sensors and the tracking, image by image, against thresholds.

    attitude      the inclinometer's tilt of the body exceeds the vehicle's limit
    acceleration  a peak of the accelerometer: the vehicle has struck or dropped off something
    lost          fewer landmarks are followed than a pose needs
    slip          the distances by the wheels and by vision differ by more than their errors explain

An image is judged with the images before it alone, as on the vehicle, which stops at the first image that exceeds a
threshold.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.odometry import ResectFacts
from rille.stages.facts.planning import StopFacts
from rille.stages.geometry.geometry import RigidTransform, heading_of

MAX_ACCELERATION = 3.0
"""Vertical acceleration, m/s2, at which the vehicle stops; permitted steps cause less than half of it."""
MIN_LANDMARKS = 12
"""Fewest landmarks that agree with a pose; six determine it."""
MAX_TURN_DEG = 8.0
"""Largest difference between the turns by the wheels and by the images."""


@dataclass(frozen=True)
class Verdict:
    """``stop``: index of the image at which the vehicle stopped, else None; ``kind`` and ``reason`` why."""

    stop: int | None
    kind: str
    reason: str


class Readings(NamedTuple):
    """Readings of the sensors at each frame.

    ``up`` (frame, 3) direction of up in the left camera; ``acceleration`` (frame,) m/s2; ``odometry`` (frame, 3) x, y
    (m), heading (rad) by the wheels, relative to those of the first frame.
    """

    up: Floats
    acceleration: Floats
    odometry: Floats


def judge(
    readings: Readings,
    poses: Floats,
    tracked: Sequence[Mapping[str, Any]],
    T_vehicle_left: RigidTransform,
    vehicle: Mapping[str, Any],
) -> Verdict:
    """Verdict on a leg: its first image that exceeds a threshold.

    Parameters
    ----------
    readings : of the sensors at each frame.
    poses : (frame, 3, 4) T_local_left by vision.
    tracked : facts of each pose: the number of its ``inliers``, and why it is ``lost``, if it is.
    vehicle : its ``max_slope_deg`` and ``wheel_base``.
    """
    # Motions are those of the vehicle's centre, as the wheels report them, not of the camera, which moves in a turn.
    there = [bool(np.isfinite(pose).all()) for pose in poses]
    key = RigidTransform.from_matrix(poses[0]) @ T_vehicle_left.inverse() if there[0] else RigidTransform.identity()
    # The limit for the ground: the body averages over its wheels and tilts less.
    steepest = float(vehicle["max_slope_deg"])
    sensors = (("attitude", "inclinometer"), ("acceleration", "accelerometer"), ("slip", "wheel odometry"))
    for k in range(1, len(poses)):
        for (kind, sensor), values in zip(sensors, readings, strict=True):
            # NaN would exceed no threshold.
            if not np.isfinite(values[k]).all():
                return Verdict(k, kind, f"the {sensor} gives no reading")
        # Rounding may make the cosine of an upright vehicle exceed 1.
        tilt = math.degrees(math.acos(np.clip((T_vehicle_left.rotation @ readings.up[k])[2], -1.0, 1.0)))
        if tilt > steepest:
            return Verdict(k, "attitude", f"tilt of {tilt:.1f} degrees by the inclinometer, {steepest:.1f} permitted")
        if readings.acceleration[k] > MAX_ACCELERATION:
            limit = f"{MAX_ACCELERATION:g} permitted"
            return Verdict(
                k, "acceleration", f"peak of {readings.acceleration[k]:.1f} m/s2 by the accelerometer, {limit}"
            )
        agree = int(tracked[k]["inliers"]) if there[0] and there[k] else 0
        if agree < MIN_LANDMARKS:
            few = f"{agree} landmarks agree with the pose, {MIN_LANDMARKS} are needed"
            return Verdict(k, "lost", f"tracking is lost: {tracked[k].get('lost', few)}")
        moved = key.inverse() @ (RigidTransform.from_matrix(poses[k]) @ T_vehicle_left.inverse())
        contradiction = _disagreement(readings.odometry[k], moved, float(vehicle["wheel_base"]))
        if contradiction:
            return Verdict(k, "slip", contradiction)
    return Verdict(None, "", "")


def _disagreement(wheels: Floats, moved: RigidTransform, base: float) -> str:
    """Contradiction between wheels and vision, in words; empty: there is none."""
    turn = heading_of(moved)
    # The remainder, since headings jump by a full turn.
    apart = math.degrees(abs(math.remainder(turn - float(wheels[2]), 2 * math.pi)))
    if apart > MAX_TURN_DEG:
        return f"wheels and vision differ by {apart:.1f} degrees in heading, {MAX_TURN_DEG:g} permitted"
    way, seen = float(np.hypot(wheels[0], wheels[1])), float(np.linalg.norm(moved.translation))
    # 0.3 wheel bases: least distance by the wheels for which slip is judged; below, errors of the poses are as large.
    if way < 0.3 * base:
        return ""
    slip = 1.0 - seen / way
    # 0.2: largest slip, over the distance by the wheels; usual soil has 0.05 to 0.15.
    if abs(slip) <= 0.2:
        return ""
    return f"slip of {slip:.0%}: {1000 * way:.0f} mm by the wheels, {1000 * seen:.0f} mm by vision"


@stage("fault_monitor")
def fault_monitor_stage(
    params: NoParams,
    sense: Bundle,
    resect: Bundle[ResectFacts],
    *,
    rows: list[int],
    T_vehicle_left: RigidTransform,
    vehicle: Mapping[str, Any],
) -> Bundle[StopFacts]:
    """Whether the vehicle stopped on a leg for its safety, where and why."""
    # Readings at the resected frames.
    wheels = np.asarray(sense["odometry"])[rows]
    verdict = judge(
        Readings(np.asarray(sense["up"])[rows], np.asarray(sense["acceleration"])[rows], wheels - wheels[0]),
        np.asarray(resect["poses"]),
        resect.meta["per_frame"],
        T_vehicle_left,
        vehicle,
    )
    return Bundle({}, {"stop": verdict.stop, "kind": verdict.kind, "reason": verdict.reason})
