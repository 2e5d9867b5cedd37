"""Stage ``mockup.obstacle``: a stone laid on the path after its ground was mapped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rille.datasets.mockup import scene as bed
from rille.datasets.mockup import terrain
from rille.datasets.mockup.facts import DrivenFacts, SceneFacts
from rille.datasets.mockup.params import SceneParams
from rille.datasets.mockup.rover import RoverParams, true_and_believed
from rille.stages.core.declare import Bundle, stage
from rille.stages.geometry.geometry import RigidTransform

STONE_HEIGHT_M = 0.015  # m, of the stone; a wheel's radius


def on_path(path: np.ndarray, way: float, aside: float) -> tuple[float, float]:
    """Point ``way`` metres along a path (vertex, 2), or beyond its end, and ``aside`` to the right of it."""
    steps = np.diff(path, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    k = int(np.clip(np.searchsorted(ends, way, side="right") - 1, 0, len(steps) - 1))
    ahead = steps[k] / lengths[k]
    point = path[k] + (way - ends[k]) * ahead + aside * np.array([ahead[1], -ahead[0]])
    return float(point[0]), float(point[1])


def lay(scene: Bundle, x: float, y: float) -> dict[str, Any]:
    """Arrays of the scene with a round stone of profile 1 - q^4, whose radius is 1.2 times its height."""
    arrays: dict[str, Any] = {name: np.asarray(scene[name]) for name in scene.arrays}
    z, lattice = np.array(arrays["height"]), scene.meta["lattice"]
    q = bed.distance(lattice, z.shape, lattice["cell"], x, y) / (1.2 * STONE_HEIGHT_M)
    inside = q < 1.0
    ground = float(np.median(z[inside])) if inside.any() else 0.0
    z[inside] = np.maximum(z[inside], ground + STONE_HEIGHT_M * (1.0 - q[inside] ** 4))
    arrays["height"] = z
    arrays["tint"] = np.where(inside, np.uint8(120), arrays["tint"])
    # Shadows are part of the scene: the stone casts one, and may stand in another.
    arrays["sunlit"] = terrain.sunlit(z, SceneParams(**scene.meta["scene"]))
    return arrays


@stage("mockup.obstacle", outputs=bed.scene_stage.outputs)
def obstacle_stage(
    params: RoverParams,
    scene: Bundle[SceneFacts],
    before: Bundle[DrivenFacts],
    pose: Bundle,
    leg: Bundle,
    *,
    T_vehicle_left: RigidTransform,
    row: int,
) -> Bundle[SceneFacts]:
    """The simulated bed with a stone laid on the rover's way."""
    path = np.asarray(leg["path"])[:, :2]
    if len(path) < 2:
        return Bundle({name: np.asarray(scene[name]) for name in scene.arrays}, {**scene.meta, "obstacle": None})
    (true_x, true_y, true_heading), (x, y, heading) = true_and_believed(before, row, pose, T_vehicle_left)
    px, py = on_path(path, params.obstacle_ahead, params.obstacle_aside)
    # The path is in the frame of the rover's estimate: the stone is laid on its true path, so that errors of the
    # estimate do not lead past it.
    turn = true_heading - heading
    c, s = math.cos(turn), math.sin(turn)
    stone = true_x + c * (px - x) - s * (py - y), true_y + s * (px - x) + c * (py - y)
    return Bundle(lay(scene, *stone), {**scene.meta, "obstacle": list(stone)})
