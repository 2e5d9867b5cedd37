"""Stage ``mockup.drive``: a rover that drives one leg over the simulated bed, with slip and errors of its heading.

The stage gets a path and the rover's estimated pose, both in the frame of the estimate. The rover turns towards each
vertex and drives there by its wheels. Its true motion differs from that of the wheels by slip and drift of heading. The
body follows the wheels over the ground (:mod:`rille.stages.planning.wheels`). The rover does not know the results of
this stage; stage ``mockup.sense`` simulates the readings of its sensors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import Field

from rille.datasets.mockup.facts import DrivenFacts, SceneFacts
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, Params, stage
from rille.stages.core.errors import InputError
from rille.stages.facts.planning import LegFacts
from rille.stages.geometry.geometry import RigidTransform, from_above, way_length
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.wheels import HeightGrid, Stand, stand

STEP_M = 0.005
"""m; the drive is simulated, and its placements are recorded, in steps of this length."""
STEP_TURN = math.radians(2.5)


class RoverParams(Params):
    """The simulated rover: where it starts and how well it drives. All of it is unknown to the estimates.

    Attributes
    ----------
    seed : seed of slip, heading errors and sensors; the bed has its own.
    slip : share of the wheels' turning that yields no motion; sand: 0.05 to 0.2.
    slip_sigma : standard deviation of the slip from leg to leg.
    heading_sigma_deg : standard deviation of the heading's drift on a leg [degrees].
    turn_sigma : relative standard deviation of turns on the spot.
    frame_step : longest distance between two images [m].
    pad : radius [m] of the start area: plane, as steep as the bed, known to the rover.
    map_cell : cell [m] of a coarse map of the bed; not set: no map.
    blank : x, y, radius [m] of a patch of the bed without any texture; not set: no such patch.
    lost_frames : numbers of the frames whose images are black.
    obstacle_leg : leg on which an obstacle appears after its ground was mapped; not set: no obstacle.
    obstacle_ahead : distance [m] of the obstacle along the leg.
    obstacle_aside : distance of the obstacle to the right of the leg [m].
    """

    seed: int = Field(1, ge=0)
    slip: float = Field(0.05, ge=-0.5, lt=1)
    slip_sigma: float = Field(0.03, ge=0, lt=0.5)
    heading_sigma_deg: float = Field(1.0, ge=0, le=20)
    turn_sigma: float = Field(0.03, ge=0, le=0.5)
    frame_step: float = Field(0.025, gt=0.001)
    pad: float = Field(0.28, ge=0)
    map_cell: float | None = Field(None, gt=0.004)
    blank: tuple[float, float, float] | None = None
    lost_frames: tuple[int, ...] = ()
    obstacle_leg: int | None = Field(None, ge=0)
    obstacle_ahead: float = Field(0.2, gt=0)
    obstacle_aside: float = 0.0


class RoverPose(NamedTuple):
    """``x``, ``y`` (m) of the centre of the wheels, and ``heading`` (rad) to the left of y."""

    x: float
    y: float
    heading: float


ORIGIN = RoverPose(0.0, 0.0, 0.0)
START = RoverPose(0.0, 0.3, 0.0)
"""On the bed; the rover looks straight along it."""
FRAME_TURN = math.radians(5.0)  # largest turn on the spot between two images


class SentLeg(NamedTuple):
    """``path`` (vertex, 2) m, from the rover's estimated position on; ``gear`` of each piece, 1 ahead or -1 back;
    ``turn`` on the spot at the end, rad."""

    path: Floats
    gear: Sequence[int]
    turn: float


class _Step(NamedTuple):
    """True motion ahead, m, and turn, rad; and those of the wheels, ``rolled`` and ``turned``."""

    distance: float
    turn: float
    rolled: float
    turned: float


class DrivenLeg(NamedTuple):
    """``trail``: stands of the vehicle along the leg; ``wheels``: x, y (m) and heading (rad) by the wheels."""

    trail: list[Stand]
    wheels: list[RoverPose]


def _steps(believed: RoverPose, sent: SentLeg, p: RoverParams, rng: np.random.Generator) -> Iterator[_Step]:
    """Steps of a leg, with the rover's errors."""
    slip = p.slip + p.slip_sigma * float(rng.standard_normal())
    drift = math.radians(p.heading_sigma_deg) * float(rng.standard_normal()) / max(way_length(sent.path), STEP_M)
    spin = 1.0 + p.turn_sigma * float(rng.standard_normal())
    x, y, heading = believed.x, believed.y, believed.heading

    def rotate(by: float) -> Iterator[_Step]:
        n = math.ceil(abs(by) / STEP_TURN)
        return itertools.repeat(_Step(0.0, spin * by / n, 0.0, by / n), n) if n else iter(())

    for vertex, sign in zip(sent.path[1:], sent.gear, strict=True):
        dx, dy = sign * (vertex[0] - x), sign * (vertex[1] - y)
        way, towards = math.hypot(dx, dy), math.atan2(-dx, dy)
        n = max(1, math.ceil(way / STEP_M))
        rolled = sign * way / n
        # remainder() gives the shorter turn, -pi to pi.
        yield from rotate(math.remainder(towards - heading, 2 * math.pi))
        yield from itertools.repeat(_Step((1.0 - slip) * rolled, drift * way / n, rolled, 0.0), n)
        x, y, heading = float(vertex[0]), float(vertex[1]), towards
    yield from rotate(sent.turn)


def drive_leg(
    ground: HeightGrid,
    vehicle: Vehicle,
    before: RoverPose,
    believed: RoverPose,
    sent: SentLeg,
    p: RoverParams,
    rng: np.random.Generator,
) -> DrivenLeg:
    """True motion along a path, as far as the bed reaches.

    Parameters
    ----------
    before : true pose on the bed.
    believed : estimated pose in the frame of the path.
    """
    first = stand(ground, *before, vehicle)
    if first is None:
        remedy = "set a larger bed (mockup.bed_width, mockup.bed_length) or a smaller vehicle"
        raise InputError("RIL-250", "the rover stands beside the bed", remedy=remedy)
    x, y, heading = before.x, before.y, before.heading
    leg = DrivenLeg([first], [ORIGIN])
    for step in _steps(believed, sent, p, rng):
        heading += step.turn
        x -= step.distance * math.sin(heading)
        y += step.distance * math.cos(heading)
        placed = stand(ground, x, y, heading, vehicle)
        if placed is None:
            break
        leg.trail.append(placed)
        u, v, h = leg.wheels[-1]
        h += step.turned
        leg.wheels.append(RoverPose(u - step.rolled * math.sin(h), v + step.rolled * math.cos(h), h))
    return leg


def images_at(wheels: Floats, p: RoverParams) -> list[int]:
    """Rows of ``wheels`` (n, 3), x, y in m, heading in rad, at which an image is taken: the first, the last, and
    whenever the distance or the turn since the last one is large enough."""
    at, way, turn = [0], 0.0, 0.0
    for k in range(1, len(wheels)):
        dx, dy, dh = wheels[k] - wheels[k - 1]
        way, turn = way + math.hypot(dx, dy), turn + abs(dh)
        # Steps add up with rounding: without the tolerance an image would come one step late.
        if way > p.frame_step - 1e-9 or turn > FRAME_TURN - 1e-9 or k == len(wheels) - 1:
            at.append(k)
            way, turn = 0.0, 0.0
    return at


def bed_ground(scene: Bundle, vehicle: Vehicle, at: tuple[float, float], reach: float) -> HeightGrid:
    """The bed within ``reach`` metres of a point, along either axis."""
    height = np.asarray(scene["height"], np.float64)
    x0, y0, cell = (scene.meta["lattice"][name] for name in ("x0", "y0", "cell"))
    (x, y), (n, m) = at, height.shape
    # At least two nodes per side, for bilinear heights; outside of the bed those next to it.
    rows, cols = (
        slice(min(max(int(low / cell), 0), most - 2), min(max(int(high / cell) + 2, 2), most))
        for low, high, most in ((y0 - (y + reach), y0 - (y - reach), n), (x - reach - x0, x + reach - x0, m))
    )
    return HeightGrid.of(
        height[rows, cols], x0 + cols.start * cell, y0 - rows.start * cell, cell, vehicle.wheel_diameter
    )


class DriveInputs(NamedTuple):
    """The bed; and for a leg (None at the start) the true pose of the rover, the estimated poses, and the leg."""

    scene: Bundle[SceneFacts]
    before: Bundle[DrivenFacts] | None = None
    pose: Bundle | None = None
    plan: Bundle[LegFacts] | None = None


def true_and_believed(
    before: Bundle[DrivenFacts], row: int, pose: Bundle, T_vehicle_left: RigidTransform
) -> tuple[RoverPose, RoverPose]:
    """True pose of the vehicle on the bed before a leg, and its estimate in the frame of the reconstruction."""
    true = RigidTransform.from_matrix(np.asarray(before["vehicle"])[row])
    estimate = RigidTransform.from_matrix(np.asarray(pose["poses"])[-1]) @ T_vehicle_left.inverse()
    return RoverPose(*from_above(true)), RoverPose(*from_above(estimate))


@stage(
    "mockup.drive",
    outputs=[
        Array("poses", ("frame", "row", "col"), "float64", "m", "true pose [R | t] of the left camera", frame="bed"),
        Array("vehicle", ("frame", "row", "col"), "float64", "m", "true pose of the vehicle", frame="bed"),
        Array("trail", ("position", "row", "col"), "float64", "m", "true pose of the vehicle, finely", frame="bed"),
        Array("frame_at", ("frame",), "int32", "1", "position of the trail at which the image is taken"),
        Array("wheels", ("position", "xyh"), "float64", "1", "x, y (m), heading (rad) as the wheels turned"),
        Array("tilt", ("position",), "float64", "rad", "angle of the vehicle to the horizontal"),
        Array("clearance", ("position",), "float64", "m", "least distance of the belly to the ground"),
        Array("step", ("position",), "float64", "m", "edge under the worst wheel"),
    ],
)
def drive_stage(
    params: RoverParams,
    inputs: DriveInputs,
    *,
    vehicle: Vehicle,
    T_vehicle_left: RigidTransform,
    leg: int,
    row: int = 0,
) -> Bundle[DrivenFacts]:
    """True motion of the simulated rover along one leg."""
    start, believed, sent, plan = START, ORIGIN, SentLeg(np.zeros((1, 2)), [], 0.0), inputs.plan
    if inputs.before is not None and inputs.pose is not None and plan is not None:
        start, believed = true_and_believed(inputs.before, row, inputs.pose, T_vehicle_left)
        sent = SentLeg(np.asarray(plan["path"])[:, :2], np.asarray(plan["gear"]).tolist(), float(plan.meta["turn"]))
    # 0.3 m: the rover may touch ground beside the leg.
    ground = bed_ground(inputs.scene, vehicle, start[:2], way_length(sent.path) + 0.3)
    # The placement at the start is leg -1, and a seed must not be negative.
    rng = np.random.default_rng([params.seed, 70, 1 + leg])
    trail, turned = drive_leg(ground, vehicle, start, believed, sent, params, rng)
    wheels = np.array(turned)
    frames = images_at(wheels, params)
    vehicles = np.stack([s.T_ground_vehicle.matrix34 for s in trail])
    lefts = np.stack([(trail[i].T_ground_vehicle @ T_vehicle_left).matrix34 for i in frames])
    arrays: dict[str, AnyArray] = {
        "poses": lefts,
        "vehicle": vehicles[frames],
        "trail": vehicles,
        "frame_at": np.array(frames, dtype=np.int32),
        "wheels": wheels,
    }
    arrays |= {name: np.array([getattr(s, name) for s in trail]) for name in ("tilt", "clearance", "step")}
    return Bundle(arrays, {"frames": len(frames), "poses": [m.reshape(-1).tolist() for m in lefts]})
