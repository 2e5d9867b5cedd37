"""Stage ``mockup.truth_dem``: the exact DEM on any lattice of any frame whose pose on the bed is known."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rille.datasets.mockup.facts import ElevationFacts, SceneFacts
from rille.datasets.mockup.raycast import HeightField
from rille.datasets.mockup.render import transform
from rille.datasets.mockup.scene import height_field
from rille.datasets.mockup.truth import visible
from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.geometry.geometry import Rig, RigidTransform


def true_dem(field: HeightField, lattice: Mapping[str, Any], T_bed_world: RigidTransform) -> tuple[Floats32, Floats]:
    """Elevations at the cell centres of a lattice, where vertical lines of the world frame meet the bed from above.

    Parameters
    ----------
    lattice : x0, y0, cell, rows, cols; cell centres at x = x0 + col * cell, y = y0 - row * cell of the world frame.
    T_bed_world : pose of the world frame on the bed; it need not be level.

    Returns
    -------
    elevation : float32 (row, col), metres in the world frame; NaN outside the bed.
    points : float64 (row * col, 3) the same surface points in the bed frame.
    """
    x = lattice["x0"] + lattice["cell"] * np.arange(lattice["cols"])
    y = lattice["y0"] - lattice["cell"] * np.arange(lattice["rows"])
    gx, gy = np.meshgrid(x, y)
    start = 10.0  # m, above every bed
    tops = transform(T_bed_world, np.stack([gx.ravel(), gy.ravel(), np.full(gx.size, start)], axis=1))
    down = np.broadcast_to(-T_bed_world.rotation[:, 2], tops.shape)
    t = field.cast(tops, np.ascontiguousarray(down))
    return (start - t).reshape(gx.shape).astype(np.float32), tops + t[:, None] * down


def seen_by(field: HeightField, rig: Rig, lefts: Iterable[RigidTransform], points: Floats) -> Bools:
    """Whether both cameras of at least one pair see each surface point (n, 3) of the bed frame."""
    seen = np.zeros(len(points), dtype=bool)
    T_left_right = rig.T_right_left.inverse()
    for T_bed_left in lefts:
        todo = np.flatnonzero(~seen & np.isfinite(points[:, 0]))
        left = visible(field, rig.left, T_bed_left, points[todo])[2]
        todo = todo[left]
        right = visible(field, rig.right, T_bed_left @ T_left_right, points[todo])[2]
        seen[todo[right]] = True
    return seen


@stage(
    "mockup.truth_dem",
    outputs=[
        Array("elevation", ("row", "col"), "float32", "m", "exact elevation", nodata="nan", frame="world"),
        Array("seen", ("row", "col"), "uint8", "1", "1 = both cameras of a listed pair see the cell", frame="world"),
    ],
)
def truth_dem_stage(
    params: NoParams,
    scene: Bundle[SceneFacts],
    *,
    lattice: Mapping[str, Any],
    T_bed_world: RigidTransform,
    pairs: Sequence[Sequence[float]],
    rig: Rig,
) -> Bundle[ElevationFacts]:
    """Exact elevations of the simulated bed on a lattice, and how far its frame is off the vertical."""
    field = height_field(scene)
    elevation, points = true_dem(field, lattice, T_bed_world)
    lefts = [RigidTransform.from_matrix(m) for m in pairs]
    seen = seen_by(field, rig, lefts, points).reshape(elevation.shape).astype(np.uint8)
    # Rounding may make the cosine of a level frame exceed 1.
    tilt = math.degrees(math.acos(min(1.0, T_bed_world.rotation[2, 2])))
    return Bundle({"elevation": elevation, "seen": seen}, {"lattice": dict(lattice), "tilt_deg": tilt})
