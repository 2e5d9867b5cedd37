"""The ground that the vehicle stands on at the start, as an elevation model of its own.

No camera of a vehicle sees the ground under it. At the start nothing was seen before, so the operator vouches for a
disk: the plane that the wheels stand on, with a standard deviation of its own. It is merged like any other model, so
that what the cameras see of the disk outweighs it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rille.stages.core.declare import Bundle, Params, raster, stage
from rille.stages.facts.terrain import DemFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice

NO_PAIR = -1
"""Pair number of a model that no pair made."""


class StartAreaParams(Params):
    """Parameters of the stage ``start_area``.

    Attributes
    ----------
    sigma : standard deviation [wheel diameters] of the start area's elevations.
    """

    sigma: float = Field(0.03, gt=0)


def pad(T_world_vehicle: RigidTransform, radius: float, cell: float) -> tuple[Lattice, np.ndarray]:
    """Elevations (row, col) float32, m, of the vehicle's own ground plane in a disk about it; NaN outside."""
    x, y, z = T_world_vehicle.translation
    lattice = Lattice.snap((x - radius, x + radius, y - radius, y + radius), cell)
    xy = lattice.xy()
    dx, dy = xy[..., 0] - x, xy[..., 1] - y
    nx, ny, nz = T_world_vehicle.rotation[:, 2]
    # The vehicle's z axis is the plane's normal.
    plane = z - (nx * dx + ny * dy) / nz
    return lattice, np.where(np.hypot(dx, dy) <= radius, plane, np.nan).astype(np.float32)


@stage(
    "start_area",
    outputs=[
        raster("elevation", "m", "elevation of the cell centre", frame="world"),
        raster("elevation_std", "m", "standard deviation of the elevation", frame="world"),
        raster("ortho", "grey", "none: not seen", frame="world"),
    ],
)
def start_area_stage(
    params: StartAreaParams,
    pose: Bundle,
    like: Bundle[DemFacts],
    *,
    T_vehicle_left: RigidTransform,
    radius: float,
    wheel_diameter: float,
) -> Bundle[DemFacts]:
    """The ground that the vehicle stands on at the start, as the operator vouches for it."""
    T_world_left = RigidTransform.from_matrix(np.asarray(pose["poses"])[-1])
    T_world_vehicle = T_world_left @ T_vehicle_left.inverse()
    lattice, elevation = pad(T_world_vehicle, radius, float(like.meta["lattice"]["cell"]))
    known = np.isfinite(elevation)
    sigma = np.float32(params.sigma * wheel_diameter)
    arrays = {
        "elevation": elevation,
        "elevation_std": np.where(known, sigma, np.float32(np.nan)),
        "ortho": np.full(elevation.shape, np.nan, np.float32),
    }
    return Bundle(arrays, {"lattice": lattice.to_dict(), "frame": "world", "pair": NO_PAIR})
