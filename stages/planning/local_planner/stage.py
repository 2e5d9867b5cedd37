"""The next leg of a drive to a goal, by the hazards that are known so far: stage ``local_planner``.

Ground seen from near may be driven on, ground seen from afar serves to plan
(:mod:`rille.stages.planning.local_planner.policy`). Far hazards close ground only once they are probable; if they close
every way, only nearly certain ones do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, stage
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.planning import LegFacts, RiskFacts
from rille.stages.facts.terrain import BoundsFacts
from rille.stages.geometry.geometry import Rig, RigidTransform, from_above, way_length
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.rigid import posed
from rille.stages.hazard.classification import HAZARDOUS, UNKNOWN, UNSEEN_BIT
from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.local_planner.clearance import Footing, Hazards
from rille.stages.planning.local_planner.ground import LocalPlannerParams, Point
from rille.stages.planning.local_planner.look import FieldOfView, PlannerMemory, Stand
from rille.stages.planning.local_planner.policy import Before, Leg, plan_leg, shortest
from rille.stages.terrain.occlusion_bounds import Bounds

HAZARD_MAPS = ("risk", "reason", "p_hazard", "p_wheel")
MAX_CLEAR_PROBABILITY = 0.02
"""Probability of a hazard below which ground seen from afar alone may be driven on; of such places for a wheel 0.005 %
had an edge that the map missed, of all places 0.37 %."""


class SeenGround(NamedTuple):
    """Hazards (:mod:`rille.stages.hazard.risk`) of ground seen from near, and of all seen ground (None: the same);
    bounds of unseen ground."""

    near: Bundle
    far: Bundle | None = None
    bounds: Bounds | None = None


def next_leg(
    seen: SeenGround,
    stand: Stand,
    goal: Point,
    params: LocalPlannerParams,
    memory: PlannerMemory,
    view: FieldOfView,
    before: Before | None = None,
) -> Leg:
    """The next leg on the ground seen so far; the other parameters are those of
    :func:`rille.stages.planning.local_planner.policy.plan_leg`."""
    hazards = seen_so_far(seen.near, seen.far)
    meta = seen.near.meta
    lattice, vehicle = Lattice.from_dict(meta["lattice"]), Vehicle.model_validate(meta["vehicle"])
    for p_certain in params.p_certain_hazard:
        last = p_certain == params.p_certain_hazard[-1]
        footing = Footing.of(
            hazards,
            lattice,
            vehicle,
            p_certain=p_certain,
            p_traversable=params.p_max_traversable,
            bounds=seen.bounds,
        )
        leg = plan_leg(footing, stand, goal, params, memory if last else replace(memory, track=()), before, view)
        if leg.verdict == "goal" or len(leg.way) > 1:
            break
    return leg


def shortest_way(
    risk: Bundle, stand: Stand, goal: Point, params: LocalPlannerParams
) -> tuple[float | None, float | None]:
    """Length (m) of the shortest way where all is known, and its margin (m): the vehicle's, or 0 if that, which is kept
    for the unknown, closes every way. None: there is no way."""
    lattice, vehicle = Lattice.from_dict(risk.meta["lattice"]), Vehicle.model_validate(risk.meta["vehicle"])
    hazards = Hazards(*(np.asarray(risk[name]) for name in HAZARD_MAPS))
    for margin in (vehicle.margin, 0.0):
        bare = vehicle.model_copy(update={"margin": margin})
        allowed = Footing.of(
            hazards, lattice, bare, p_certain=params.p_certain_hazard[-1], p_traversable=params.p_max_traversable
        )
        best = shortest(allowed, stand, goal, params)
        if best is not None:
            return best, margin
    return None, None


def seen_so_far(near: Bundle, far: Bundle | None) -> Hazards:
    """Hazards of a map of which only near ground is driven on, and how well each cell is known."""
    maps = [np.asarray(near[name]) for name in HAZARD_MAPS]
    unknown, glanced = maps[0] == UNKNOWN, None
    if far is not None:
        # At the rim of the near ground a window is cut off, which widens the doubt. All of it was seen from afar, which
        # counts where it is clearly free.
        chance = np.asarray(far["p_hazard"])
        cut = unknown | (((maps[1] & UNSEEN_BIT) != 0) & (chance < MAX_CLEAR_PROBABILITY))
        maps = [np.where(cut, np.asarray(far[name]), seen) for name, seen in zip(HAZARD_MAPS, maps, strict=True)]
        # Written so that NaN, of which nothing is known, stays unknown.
        unknown &= ~(maps[2] < MAX_CLEAR_PROBABILITY)
        glanced = unknown & (maps[0] < HAZARDOUS)
    risk, reason, p_hazard, p_wheel = maps
    # 0.02: probability of a hazard to a wheel from which near ground is doubted: 5 % of the ground on which wheels may
    # stand, with all but 4 of 170 edges that the map missed (beds 1 to 9 of ``benchmarks/loop.py`` at 10 %).
    return Hazards(risk, reason, p_hazard, p_wheel, unknown, glanced, p_wheel >= 0.02)


def _stands(poses: Floats, T_vehicle_left: RigidTransform) -> list[Stand]:
    """Places of the vehicle at the poses (n, 3, 4) T_world_left of its left camera."""
    return [from_above(RigidTransform.from_matrix(pose) @ T_vehicle_left.inverse()) for pose in poses]


class LegInputs(NamedTuple):
    """Hazards of near ground and of all seen ground, and bounds of unseen ground; pose and rig of the cameras;
    the leg before; poses of the left camera on the way so far."""

    risk: Bundle[RiskFacts]
    pose: Bundle
    rig: Bundle[CalibrationFacts]
    far: Bundle[RiskFacts] | None = None
    ceiling: Bundle[BoundsFacts] | None = None
    before: Bundle[LegFacts] | None = None
    driven: Bundle | None = None


@stage(
    "local_planner",
    outputs=[
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
    ],
)
def local_planner_stage(
    params: LocalPlannerParams,
    inputs: LegInputs,
    *,
    goal: Sequence[float],
    looks: int,
    closed: Sequence[Sequence[float]],
    T_vehicle_left: RigidTransform,
    whole: bool = False,
) -> Bundle[LegFacts]:
    """The next leg of a drive to a goal, over ground that is known to be free."""
    (stand,) = _stands(np.asarray(inputs.pose["poses"])[-1:], T_vehicle_left)
    driven = np.zeros((0, 3, 4)) if inputs.driven is None else np.asarray(inputs.driven["poses"])
    track = _stands(driven[posed(driven)], T_vehicle_left)
    end = (float(goal[0]), float(goal[1]))
    memory = PlannerMemory(looks, [(float(x), float(y)) for x, y in closed], track=track)
    rest, before, ceiling = None, inputs.before, inputs.ceiling
    if before is not None and len(before["rest_gear"]):
        rest = np.asarray(before["rest"]), np.asarray(before["rest_gear"])
    bounds = None if ceiling is None else Bounds(upper=np.asarray(ceiling["upper"]), lower=np.asarray(ceiling["lower"]))
    view = FieldOfView.of(Rig.from_dict(inputs.rig.meta["rig"]), T_vehicle_left)
    leg = next_leg(SeenGround(inputs.risk, inputs.far, bounds), stand, end, params, memory, view, rest)
    best, margin = shortest_way(inputs.risk, stand, end, params) if whole else (None, None)
    meta: LegFacts = {
        "shortest_m": best,
        "shortest_margin_m": margin,
        "verdict": leg.verdict,
        "reason": leg.reason,
        "turn": leg.turn,
        "where": None if leg.where is None else list(leg.where),
        "start": list(stand),
        "goal": list(end),
        "left_m": math.hypot(end[0] - stand[0], end[1] - stand[1]),
        "length_m": way_length(leg.path),
        "way_m": way_length(leg.way),
    }
    arrays: dict[str, NDArray[Any]] = {"path": leg.path, "gear": leg.gear, "way": leg.way}
    return Bundle(arrays | {"rest": leg.rest, "rest_gear": leg.rest_gear}, meta)
