"""The ground under the vehicle at the start: the plane that its wheels stand on, in a disk about it."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.start_area import NO_PAIR, StartAreaParams, start_area_stage

CELL, RADIUS, WHEEL = 0.01, 0.2, 0.03
STANDS = RigidTransform(rotation_exp([0.25, -0.1, 0.7]), np.array([1.0, -2.0, 0.4]))
"""On ground that rises by 15 degrees."""


def test_its_cells_lie_in_the_vehicles_own_ground_plane() -> None:
    T_vehicle_left = RigidTransform(rotation_exp([-1.9, 0.0, 0.1]), np.array([0.05, 0.04, 0.3]))
    poses = np.stack([np.eye(3, 4), (STANDS @ T_vehicle_left).matrix34])
    args = {"T_vehicle_left": T_vehicle_left.to_list(), "radius": RADIUS, "wheel_diameter": WHEEL}
    like = Bundle({}, {"lattice": Lattice.at(0, 0, CELL, 3, 3).to_dict()})
    out = start_area_stage.run(StartAreaParams(sigma=0.1), args, {"pose": Bundle({"poses": poses}, {}), "like": like})
    check_outputs(start_area_stage, out)
    lattice = Lattice.from_dict(out.meta["lattice"])
    xy, z = lattice.xy(), out["elevation"]
    known = np.hypot(xy[..., 0] - 1.0, xy[..., 1] + 2.0) <= RADIUS
    assert (lattice.cell, out.meta["pair"]) == (CELL, NO_PAIR)
    assert known.sum() == pytest.approx(np.pi * (RADIUS / CELL) ** 2, rel=0.02), "the whole disk"
    np.testing.assert_array_equal(np.isfinite(z), known)
    from_vehicle = STANDS.inverse().apply(np.column_stack([xy[known], z[known]]))
    np.testing.assert_allclose(from_vehicle[:, 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(out["elevation_std"][known], 0.1 * WHEEL, rtol=1e-6)
    assert np.isnan(out["elevation_std"][~known]).all()
