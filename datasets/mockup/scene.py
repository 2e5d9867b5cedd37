"""Stage ``mockup.scene``: the whole bed as one artifact, which every image and every truth reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.datasets.mockup import terrain
from rille.datasets.mockup.params import SceneParams
from rille.datasets.mockup.raycast import HeightField
from rille.stages.core.declare import Array, Bundle, Inputs, Stage

MIPS = 7
"""Levels of the albedo: 0.5 mm texels up to 32 mm, more than any footprint on the bed."""


def build_scene(p: SceneParams) -> Bundle:
    """Heights, light and albedo of a bed.

    Returns
    -------
    Bundle
        ``height`` float32 (row, col) metres and ``sunlit``, ``tint`` uint8 on nodes at x = x0 + col * cell,
        y = y0 - row * cell of the bed frame (z up, y ahead, x right, origin in the middle of the near edge);
        ``albedo_0`` uint8 on a grid twice as fine with the same first node, ``albedo_1`` ... its 2 x 2 means.
    """
    rows, cols = round(p.bed_length / p.cell) + 1, round(p.bed_width / p.cell) + 1
    height = terrain.relief(p, (rows, cols))
    terrain.add_craters(height, p)
    # Before the rocks: the cameras' height counts from the mean of the bare ground.
    height -= np.float32(height.mean(dtype=np.float64))
    if p.slope_deg:
        rise = np.tan(np.deg2rad(p.slope_deg)) * p.cell * np.arange(rows - 1, -1, -1)
        height += rise[:, None].astype(np.float32)
    tint = terrain.add_rocks(height, p)
    arrays: dict[str, Any] = {
        "height": height,
        "sunlit": terrain.sunlit(height, p),
        "tint": np.clip(100.0 * tint, 0, 255).astype(np.uint8),
    }
    texture = terrain.albedo(p, height.shape)
    for level in range(MIPS):
        arrays[f"albedo_{level}"] = texture
        texture = terrain.halve(texture)
    lattice = {"x0": -0.5 * (cols - 1) * p.cell, "y0": (rows - 1) * p.cell, "cell": p.cell, "rows": rows, "cols": cols}
    return Bundle(arrays=arrays, meta={"lattice": lattice, "scene": p.model_dump()})


def height_field(scene: Bundle) -> HeightField:
    """The scene's heights, ready for ray casting."""
    lattice = scene.meta["lattice"]
    return HeightField.build(np.asarray(scene["height"][:]), lattice["x0"], lattice["y0"], lattice["cell"])


def _run(params: SceneParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    return build_scene(params)


STAGE = Stage(
    name="mockup.scene",
    version=1,
    summary="terrain, albedo and shadows of the simulated bed",
    params=SceneParams,
    inputs=(),
    outputs=(
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
    ),
    run=_run,
)
