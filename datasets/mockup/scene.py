"""Stage ``mockup.scene``: the whole bed as one artifact, for all images and truths.

For a drive it has a smooth pad to start from, and may have a patch without texture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.datasets.mockup import terrain
from rille.datasets.mockup.facts import SceneFacts
from rille.datasets.mockup.params import SceneParams
from rille.datasets.mockup.raycast import HeightField
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Array, Bundle, stage

ALBEDO_LEVELS = 7
"""Levels of the albedo: 0.5 mm texels up to 32 mm, more than any footprint on the bed."""


Disk = tuple[float, float, float]
"""x, y and radius of a disk on the bed, metres."""

PAD_EDGE_M = 0.06
"""m; width of the transition from the pad to the ground around it."""


def build_scene(p: SceneParams, pad: Disk | None = None, blank: Disk | None = None) -> Bundle[SceneFacts]:
    """Heights, light and albedo of a bed.

    Parameters
    ----------
    pad : a smooth start area for a rover.
    blank : a smooth patch without texture.

    Both are planes as steep as the bed is (``slope_deg``), at the median height of the ground that they replace: on a
    slope a level pad would be a pit with a wall before it.

    Returns
    -------
    Bundle
        ``height`` float32 (row, col) metres and ``sunlit``, ``tint`` uint8 on nodes at x = x0 + col * cell,
        y = y0 - row * cell of the bed frame (z up, y ahead, x right, origin in the middle of the near edge);
        ``albedo_0`` uint8 on a grid twice as fine with the same first node, ``albedo_1`` ... its 2 x 2 means.
    """
    rows, cols = round(p.bed_length / p.cell) + 1, round(p.bed_width / p.cell) + 1
    lattice = {"x0": -0.5 * (cols - 1) * p.cell, "y0": (rows - 1) * p.cell, "cell": p.cell, "rows": rows, "cols": cols}
    height = terrain.relief(p, (rows, cols))
    terrain.add_craters(height, p)
    # Before the rocks, since the cameras' height counts from the mean of the bare ground.
    height -= np.float32(height.mean(dtype=np.float64))
    slope = (np.tan(np.deg2rad(p.slope_deg)) * p.cell * np.arange(rows - 1, -1, -1)).astype(np.float32)[:, None]
    height += slope
    tint = np.clip(100.0 * terrain.add_rocks(height, p), 0, 255).astype(np.uint8)
    texture = terrain.albedo(p, height.shape)
    bare = None
    for disk in (pad, blank):
        if disk is None:
            continue
        x, y, radius = disk
        far = distance(lattice, height.shape, p.cell, x, y)
        if not (far <= radius).any():  # outside of the bed, or less than a cell: no ground for a height
            continue
        weight = np.clip((radius + PAD_EDGE_M - far) / PAD_EDGE_M, 0.0, 1.0)
        # Smoothstep: the slope has no kink at either end of the edge.
        weight = weight * weight * (3.0 - 2.0 * weight)
        level = np.median((height - slope)[far <= radius])
        height = (height + weight * (slope + level - height)).astype(np.float32)
        tint = np.where(weight > 0.5, np.uint8(100), tint)
        if disk is blank:
            bare = x, y + level, radius  # grain is draped: that of raised ground is from as much farther ahead
    arrays: dict[str, Any] = {"height": height, "sunlit": terrain.sunlit(height, p), "tint": tint}
    for k in range(ALBEDO_LEVELS):
        arrays[f"albedo_{k}"] = texture
        if bare is not None:
            x, y, radius = bare
            # A texel of a coarser level lies in the middle of those that it is the mean of.
            middle = 0.25 * p.cell * (2**k - 1)
            far = distance(lattice, texture.shape, 0.5 * p.cell * 2**k, x - middle, y + middle)
            arrays[f"albedo_{k}"] = np.where(far <= radius, np.uint8(128), texture)
        texture = terrain.halve(texture)
    return Bundle(arrays=arrays, meta={"lattice": lattice, "scene": p.model_dump()})


def distance(lattice: Mapping[str, Any], shape: tuple[int, ...], spacing: float, x: float, y: float) -> Floats:
    """Distance (row, col), metres, of the nodes of a grid of the bed from a point."""
    dx = lattice["x0"] + spacing * np.arange(shape[1]) - x
    dy = lattice["y0"] - spacing * np.arange(shape[0]) - y
    return np.asarray(np.hypot(dx[None, :], dy[:, None]))


def height_field(scene: Bundle) -> HeightField:
    """The scene's heights for ray casting."""
    lattice = scene.meta["lattice"]
    return HeightField.build(np.asarray(scene["height"][:]), lattice["x0"], lattice["y0"], lattice["cell"])


@stage(
    "mockup.scene",
    outputs=[
        Array("height", ("row", "col"), "float32", "m", "height of the bed", frame="bed"),
        Array("sunlit", ("row", "col"), "uint8", "1", "share of the sun's disc in view, 255 = all", frame="bed"),
        Array("tint", ("row", "col"), "uint8", "1", "brightness of rocks relative to the ground, 100 = 1", frame="bed"),
        Array(
            "albedo_*",
            ("row", "col"),
            "uint8",
            "1",
            "relative albedo, 128 = mean, level 0 at half the cell",
            frame="bed",
        ),
    ],
)
def scene_stage(params: SceneParams, *, pad: Disk | None = None, blank: Disk | None = None) -> Bundle[SceneFacts]:
    """Terrain, albedo and shadows of the simulated bed."""
    return build_scene(params, pad, blank)
