"""Stage ``mockup.site``: the bed prepared for a drive: a smooth pad to start from, and a patch without texture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.datasets.mockup import scene as bed
from rille.datasets.mockup import terrain
from rille.datasets.mockup.params import SceneParams
from rille.stages.core.declare import Bundle, Inputs, NoParams, Stage

EDGE = 0.06
"""m; over which the pad passes into the ground around it."""


def distance(scene: Bundle, x: float, y: float, shape: tuple[int, ...], spacing: float) -> NDArray[np.float64]:
    """Distance (row, col), metres, of the nodes of a grid of the bed from a point of it."""
    lattice = scene.meta["lattice"]
    dx = lattice["x0"] + spacing * np.arange(shape[1]) - x
    dy = lattice["y0"] - spacing * np.arange(shape[0]) - y
    return np.asarray(np.hypot(dx[None, :], dy[:, None]))


def prepare(
    scene: Bundle, pad: tuple[float, float, float] | None, blank: tuple[float, float, float] | None
) -> dict[str, Any]:
    """Return the arrays of the scene with a smooth start area and a patch without texture.

    Parameters
    ----------
    pad : start area: x, y and radius on the bed, m; None: none.
    blank : patch without texture, likewise.

    Both are planes as steep as the bed is (``slope_deg``), at the median height of the ground that they replace: on a
    slope a level pad would be a pit with a wall before it.
    """
    arrays: dict[str, Any] = {name: np.asarray(scene[name]) for name in scene.arrays}
    height, cell = arrays["height"].copy(), float(scene.meta["lattice"]["cell"])
    ahead = scene.meta["lattice"]["y0"] - cell * np.arange(height.shape[0])[:, None]
    slope = (math.tan(math.radians(scene.meta["scene"]["slope_deg"])) * ahead).astype(np.float32)
    level = np.float32(0.0)
    for place in (pad, blank):
        if place is None:
            continue
        far = distance(scene, place[0], place[1], height.shape, cell)
        if not (far <= place[2]).any():  # beside the bed, or less than a cell: no ground has a height to take
            continue
        weight = np.clip((place[2] + EDGE - far) / EDGE, 0.0, 1.0)
        # Smoothstep: the slope has no kink at either end of the edge.
        weight = weight * weight * (3.0 - 2.0 * weight)
        level = np.median((height - slope)[far <= place[2]])
        height = (height + weight * (slope + level - height)).astype(np.float32)
        arrays["tint"] = np.where(weight > 0.5, np.uint8(100), arrays["tint"])
    arrays["height"] = height
    arrays["sunlit"] = terrain.sunlit(height, SceneParams(**scene.meta["scene"]))
    if blank is not None:
        for k in range(bed.MIPS):
            texture = arrays[f"albedo_{k}"]
            # The grain is draped: what lies at a height has that of as much farther ahead. And a texel of a coarser
            # level lies in the middle of those that it is the mean of, half of them behind the first one.
            middle = 0.25 * cell * (2**k - 1)
            far = distance(scene, blank[0] - middle, blank[1] + level + middle, texture.shape, 0.5 * cell * 2**k)
            arrays[f"albedo_{k}"] = np.where(far <= blank[2], np.uint8(128), texture)
    return arrays


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    scene = inputs["scene"]
    return Bundle(prepare(scene, args["pad"], args["blank"]), dict(scene.meta))


STAGE = Stage(
    name="mockup.site",
    version=2,
    summary="the simulated bed, prepared for a drive",
    params=NoParams,
    inputs=("scene",),
    outputs=bed.STAGE.outputs,
    run=_run,
)
