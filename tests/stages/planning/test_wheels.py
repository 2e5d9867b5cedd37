"""How a vehicle stands: on planes exactly, on edges as drawn by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rille.stages.hazard.vehicle import Vehicle
from rille.stages.planning.wheels import HeightGrid, highest, stand

ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.10, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
CELL = 0.002
X, Y = np.meshgrid(np.arange(-0.2, 0.2001, CELL), np.arange(0.2, -0.2001, -CELL))


def ground(z: np.ndarray) -> HeightGrid:
    return HeightGrid.of(z, -0.2, 0.2, CELL, ROVER.wheel_diameter)


@pytest.mark.parametrize(("gx", "gy"), [(0.0, 0.0), (0.1, 0.0), (0.0, -0.2), (0.15, 0.1)])
@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_on_a_plane_it_stands_square(gx: float, gy: float, heading: float) -> None:
    found = stand(ground(gx * X + gy * Y), 0.0, 0.0, heading, ROVER)
    assert found is not None
    slope = math.hypot(gx, gy)
    # a sphere rests on an inclined plane beside its lowest point, r (sqrt(1 + slope^2) - 1) above the plane there;
    # the grid of 2 mm misses the highest contact by less than slope times a cell
    assert found.tilt == pytest.approx(math.atan(slope), abs=0.02)
    rest = 0.015 * (math.sqrt(1 + slope**2) - 1)
    assert found.T_ground_vehicle.translation[2] == pytest.approx(rest, abs=slope * CELL + 1e-6)
    normal = np.array([-gx, -gy, 1.0]) / math.sqrt(1 + slope**2)
    assert found.T_ground_vehicle.rotation[:, 2] == pytest.approx(normal, abs=0.02)
    assert found.T_ground_vehicle.rotation[:2, 1] @ [-math.sin(heading), math.cos(heading)] > 0.9
    assert found.clearance == pytest.approx(0.025 + rest, abs=2 * slope * CELL + 1e-6)


def test_a_wheel_rests_on_the_node_that_its_sphere_meets_first() -> None:
    z = np.random.default_rng(1).normal(0.0, 0.01, (18, 22))
    z[3, 4] = np.nan
    found = HeightGrid.of(z, 0.0, 0.0, 0.004, 0.03).resting
    rows, cols = np.indices(z.shape)
    for r, c in np.ndindex(z.shape):
        away2 = ((rows - r) ** 2 + (cols - c) ** 2) * 0.004**2
        near = (away2 <= 0.015**2) & np.isfinite(z)
        expected = (z[near] + np.sqrt(0.015**2 - away2[near])).max() - 0.015
        assert found[r, c] == pytest.approx(np.nan if np.isnan(z[r, c]) else expected, nan_ok=True)


def test_one_wheel_on_a_block_tilts_by_half_of_it_each_way() -> None:
    z = np.where((X < 0) & (Y > 0), 0.01, 0.0)  # under the front left wheel
    found = stand(ground(z), 0.0, 0.0, 0.0, ROVER)
    assert found is not None
    rise, lean = 0.5 * 0.01 / ROVER.wheel_base, -0.5 * 0.01 / ROVER.track
    assert found.tilt == pytest.approx(math.atan(math.hypot(rise, lean)), abs=1e-9)
    assert found.T_ground_vehicle.translation[2] == pytest.approx(0.0025)


def test_a_stone_between_the_wheels_takes_clearance_and_no_step() -> None:
    z = np.where(np.hypot(X, Y) < 0.01, 0.03, 0.0)
    found = stand(ground(z), 0.0, 0.0, 0.0, ROVER)
    assert found is not None
    assert found.clearance == pytest.approx(0.025 - 0.03)
    assert (found.tilt, found.step) == (0.0, 0.0)


def test_unknown_ground_under_the_belly_says_nothing_of_its_clearance() -> None:
    z = np.where(np.hypot(X - 0.02, Y) < 0.008, 0.01, 0.0)
    z[np.hypot(X + 0.015, Y) < 0.01] = np.nan
    found = stand(ground(z), 0.0, 0.0, 0.0, ROVER)
    assert found is not None
    assert found.clearance == pytest.approx(0.025 - 0.01)
    z[np.abs(X) < 0.037] = np.nan  # all that is between the wheels
    found = stand(ground(z), 0.0, 0.0, 0.0, ROVER)
    assert found is not None
    assert math.isnan(found.clearance)


def test_an_edge_under_a_wheel_is_a_step() -> None:
    found = stand(ground(np.where(Y > 0.05, 0.02, 0.0)), 0.0, 0.0, 0.0, ROVER)
    assert found is not None
    assert found.step == pytest.approx(0.02)


def test_beside_the_ground_it_does_not_stand() -> None:
    assert stand(ground(0.0 * X), 0.17, 0.0, 0.0, ROVER) is None


@pytest.mark.parametrize("cell", [0.002, 0.0025, 0.004, 0.001])
def test_the_step_is_judged_over_half_a_wheel_on_every_grid(cell: float) -> None:
    x = np.arange(-0.2, 0.2001, cell)
    z = np.tile(0.4 * np.abs(x), (len(x), 1))  # a valley along which it drives with its left wheels
    found = stand(HeightGrid.of(z, -0.2, 0.2, cell, ROVER.wheel_diameter), 0.1, 0.0, 0.0, ROVER)
    assert found is not None
    assert found.step == pytest.approx(0.4 * 0.5 * ROVER.wheel_diameter, abs=1e-9)


def test_the_highest_of_a_square_is_that_of_the_surface_between_the_nodes() -> None:
    z, reach = np.random.default_rng(3).standard_normal((9, 9)), 1.75
    at = np.unique(
        [*np.arange(4 - 1, 4 + 2), 4 - reach, 4 + reach]
    )  # bilinear: the extremes are on grid lines and rims
    row, col = np.meshgrid(at, at)
    i, j = np.floor(row).astype(int), np.floor(col).astype(int)
    u, v = row - i, col - j
    surface = (1 - u) * ((1 - v) * z[i, j] + v * z[i, j + 1]) + u * ((1 - v) * z[i + 1, j] + v * z[i + 1, j + 1])
    assert highest(z, reach)[4, 4] == pytest.approx(surface.max(), abs=1e-12)
    z[3, 3] = np.nan
    assert np.isfinite(highest(z, reach)).all()
