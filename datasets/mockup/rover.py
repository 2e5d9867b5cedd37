"""Stage ``mockup.drive``: a rover that drives one leg over the simulated bed, with slip and errors of its heading.

The stage gets a path and the rover's estimated pose, both in the frame of the estimate. The rover turns towards each
vertex and drives there by its wheels. Its true motion differs from that of the wheels: it slips and drifts off its
heading. The body follows the wheels over the ground (:mod:`rille.stages.planning.wheels`). The rover does not know the
results of this stage; stage ``mockup.sense`` simulates the readings of its sensors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, Inputs, Params, Stage
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import RigidTransform, from_above, way_length
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.wheels import HeightGrid, Stand, stand

STEP = 0.005
"""m; the drive is simulated, and its placements are recorded, in steps of this length."""
STEP_TURN = math.radians(2.5)
REACH = 0.3
"""m; ground around a leg that may be touched on it, beyond its length."""


class RoverParams(Params):
    """The simulated rover: where it starts and how well it drives. All of it is unknown to the estimates."""

    seed: int = Field(1, ge=0, description="seed of slip, heading errors and sensors; the bed has its own")
    start: tuple[float, float] = Field(
        (0.0, 0.3), description="x, y [m] of the centre of the wheels on the bed at the start"
    )
    heading_deg: float = Field(
        0.0, ge=-180, le=180, description="heading at the start [degrees to the left of straight along the bed]"
    )
    slip: float = Field(
        0.05, ge=-0.5, lt=1, description="share of the wheels' rotation that yields no motion; sand: 0.05 to 0.2"
    )
    slip_sigma: float = Field(0.03, ge=0, lt=0.5, description="standard deviation of the slip from leg to leg")
    heading_sigma_deg: float = Field(
        1.0, ge=0, le=20, description="standard deviation of the heading's drift over one leg [degrees]"
    )
    turn_sigma: float = Field(
        0.03, ge=0, le=0.5, description="relative standard deviation of the angle of a turn on the spot"
    )
    frame_step: float = Field(0.025, gt=0.001, description="longest distance between two images [m]")
    frame_turn_deg: float = Field(
        5.0, gt=0.5, le=15, description="largest turn on the spot between two images [degrees]"
    )
    speed: float = Field(0.05, gt=0, description="driving speed [m/s]; with it, bumps become accelerations")
    odometry_sigma: float = Field(
        0.01,
        ge=0,
        description="relative standard deviation of the distances and turns that the wheels report, as of their radius",
    )
    attitude_sigma_deg: float = Field(
        0.2, ge=0, description="standard deviation of the inclinometer's error about each axis [degrees]"
    )
    acceleration_sigma: float = Field(0.05, ge=0, description="standard deviation [m/s2] of the accelerometer's noise")
    camera_forward: float = Field(0.05, description="distance of the cameras ahead of the centre of the wheels [m]")
    pad: float = Field(
        0.28,
        ge=0,
        description="radius [m] of the start area, which is plane, as steep as the bed, free of rocks, and known "
        "to the rover",
    )
    map_cell: float | None = Field(
        None, gt=0.004, description="cell [m] of a coarse map of the whole bed that the rover is given; not set: no map"
    )
    map_sigma: float = Field(0.002, ge=0, description="standard deviation of that map's elevations [m]")
    blank: tuple[float, float, float] | None = Field(
        None, description="x, y, radius [m] of a patch of the bed without any texture; not set: no such patch"
    )
    lost_frames: tuple[int, ...] = Field((), description="numbers of the frames whose images are black")
    obstacle_leg: int | None = Field(
        None, ge=0, description="leg on which an obstacle appears after its ground was mapped; not set: no obstacle"
    )
    obstacle_ahead: float = Field(
        0.2, gt=0, description="distance of the obstacle along the leg from the centre of the wheels [m]"
    )
    obstacle_aside: float = Field(0.0, description="distance of the obstacle to the right of the leg [m]")
    obstacle_height: float = Field(0.015, gt=0, description="height of the obstacle [m]; 0.015: a wheel's radius")


@dataclass
class _Drive:
    """The true motion in the making: where it is, how it stood on the way, and what its wheels did."""

    ground: HeightGrid
    vehicle: Vehicle
    x: float
    y: float
    heading: float
    trail: list[Stand]
    wheels: list[tuple[float, float, float]]

    def advance(self, distance: float, turn: float, rolled: float, turned: float) -> bool:
        """Move on; whether the vehicle still stands on the bed."""
        self.heading += turn
        self.x -= distance * math.sin(self.heading)
        self.y += distance * math.cos(self.heading)
        found = stand(self.ground, self.x, self.y, self.heading, self.vehicle)
        if found is None:
            return False
        self.trail.append(found)
        x, y, h = self.wheels[-1]
        h += turned
        self.wheels.append((x - rolled * math.sin(h), y + rolled * math.cos(h), h))
        return True


class SentLeg(NamedTuple):
    """``path`` (vertex, 2) m, from the rover's estimated position on; ``gear`` of each piece, 1 ahead or -1 back;
    ``turn`` on the spot at the end, rad."""

    path: Floats
    gear: Sequence[int]
    turn: float


def drive_leg(
    ground: HeightGrid,
    vehicle: Vehicle,
    before: tuple[float, float, float],
    believed: tuple[float, float, float],
    sent: SentLeg,
    p: RoverParams,
    rng: np.random.Generator,
) -> _Drive:
    """True motion along a path.

    Parameters
    ----------
    before : true x, y (m) and heading (rad) on the bed.
    believed : estimated x, y (m) and heading (rad) in the frame of the path.
    """
    path, gear, turn = sent
    slip = p.slip + p.slip_sigma * float(rng.standard_normal())
    length = way_length(path)
    drift = math.radians(p.heading_sigma_deg) * float(rng.standard_normal()) / max(length, STEP)
    spin = 1.0 + p.turn_sigma * float(rng.standard_normal())
    first = stand(ground, *before, vehicle)
    if first is None:
        raise InputError(
            "RIL-250",
            "the rover stands beside the bed",
            remedy="set rover.start within the bed, a larger bed or a smaller vehicle",
        )
    d = _Drive(ground, vehicle, *before, [first], [(0.0, 0.0, 0.0)])
    x, y, heading = believed

    def rotate(by: float) -> bool:
        n = math.ceil(abs(by) / STEP_TURN)
        return all(d.advance(0.0, spin * by / n, 0.0, by / n) for _ in range(n))

    for vertex, sign in zip(path[1:], gear, strict=True):
        dx, dy = sign * (vertex[0] - x), sign * (vertex[1] - y)
        way, towards = math.hypot(dx, dy), math.atan2(-dx, dy)
        n = max(1, math.ceil(way / STEP))
        rolled = sign * way / n
        # remainder() gives the shorter way round, -pi to pi.
        there = rotate(math.remainder(towards - heading, 2 * math.pi)) and all(
            d.advance((1.0 - slip) * rolled, drift * way / n, rolled, 0.0) for _ in range(n)
        )
        if not there:
            break
        x, y, heading = float(vertex[0]), float(vertex[1]), towards
    else:
        rotate(turn)
    return d


def images_at(wheels: Floats, p: RoverParams) -> list[int]:
    """Positions (of wheels (n, 3): x, y in m, heading in rad) at which an image is taken: the first, the last, and
    whenever the way or the turn since the last one is large enough."""
    at, way, turn = [0], 0.0, 0.0
    for k in range(1, len(wheels)):
        dx, dy, dh = wheels[k] - wheels[k - 1]
        way, turn = way + math.hypot(dx, dy), turn + abs(dh)
        # Steps add up with rounding: without the tolerance an image would come one step late.
        if way > p.frame_step - 1e-9 or turn > math.radians(p.frame_turn_deg) - 1e-9 or k == len(wheels) - 1:
            at.append(k)
            way, turn = 0.0, 0.0
    return at


def bed_ground(scene: Bundle, vehicle: Vehicle, at: tuple[float, float], reach: float) -> HeightGrid:
    """The bed within ``reach`` metres of a point, along either axis."""
    height = np.asarray(scene["height"], np.float64)
    x0, y0, cell = (scene.meta["lattice"][name] for name in ("x0", "y0", "cell"))
    (x, y), (n, m) = at, height.shape
    # Never fewer than two nodes a side, between which heights are bilinear: beside the bed, those next to it.
    rows, cols = (
        slice(min(max(int(low / cell), 0), most - 2), min(max(int(high / cell) + 2, 2), most))
        for low, high, most in ((y0 - (y + reach), y0 - (y - reach), n), (x - reach - x0, x + reach - x0, m))
    )
    return HeightGrid.of(
        height[rows, cols], x0 + cols.start * cell, y0 - rows.start * cell, cell, vehicle.wheel_diameter
    )


def _run(params: RoverParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    scene, vehicle = inputs["scene"], Vehicle.model_validate(args["vehicle"])
    T_left_vehicle = RigidTransform.from_matrix(args["T_vehicle_left"]).inverse()
    # The placement at the start is leg -1, and a seed must not be negative.
    rng = np.random.default_rng([params.seed, 70, 1 + int(args["leg"])])
    if "before" in inputs:
        before = from_above(RigidTransform.from_matrix(np.asarray(inputs["before"]["vehicle"])[int(args["row"])]))
        start = from_above(RigidTransform.from_matrix(np.asarray(inputs["pose"]["poses"])[-1]) @ T_left_vehicle)
        path, gear = np.asarray(inputs["leg"]["path"])[:, :2], np.asarray(inputs["leg"]["gear"]).tolist()
        turn = float(inputs["leg"].meta["turn"])
    else:
        before = *params.start, math.radians(params.heading_deg)
        path, gear, start, turn = np.zeros((1, 2)), [], (0.0, 0.0, 0.0), 0.0
    ground = bed_ground(scene, vehicle, before[:2], way_length(path) + REACH)
    d = drive_leg(ground, vehicle, before, start, SentLeg(path, gear, turn), params, rng)
    wheels = np.array(d.wheels)
    frames = images_at(wheels, params)
    vehicles = np.stack([s.T_ground_vehicle.matrix34 for s in d.trail])
    lefts = np.stack([(d.trail[i].T_ground_vehicle @ T_left_vehicle.inverse()).matrix34 for i in frames])
    arrays: dict[str, AnyArray] = {
        "poses": lefts,
        "vehicle": vehicles[frames],
        "trail": vehicles,
        "frame_at": np.array(frames, dtype=np.int32),
        "wheels": wheels,
        "tilt": np.array([s.tilt for s in d.trail]),
        "clearance": np.array([s.clearance for s in d.trail]),
        "step": np.array([s.step for s in d.trail]),
    }
    return Bundle(arrays, {"leg": args["leg"], "frames": len(frames), "poses": [m.reshape(-1).tolist() for m in lefts]})


def _trail(name: str, unit: str, long_name: str) -> Array:
    return Array(name, ("position",), "float64", unit, long_name)


STAGE = Stage(
    name="mockup.drive",
    version=3,
    summary="true motion of the simulated rover along one leg",
    params=RoverParams,
    inputs=("scene", "before?", "pose?", "leg?"),
    outputs=(
        Array("poses", ("frame", "row", "col"), "float64", "m", "true pose [R | t] of the left camera", frame="bed"),
        Array("vehicle", ("frame", "row", "col"), "float64", "m", "true pose of the vehicle", frame="bed"),
        Array("trail", ("position", "row", "col"), "float64", "m", "true pose of the vehicle, finely", frame="bed"),
        Array("frame_at", ("frame",), "int32", "1", "position of the trail at which the image is taken"),
        Array("wheels", ("position", "xyh"), "float64", "1", "x, y (m), heading (rad) as the wheels turned"),
        _trail("tilt", "rad", "angle of the vehicle to the horizontal"),
        _trail("clearance", "m", "least distance of the belly to the ground"),
        _trail("step", "m", "edge under the worst wheel"),
    ),
    run=_run,
)
