"""Turned grids: they cover the lattice, keep its area, and leave it alone where there is nothing to turn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from raising import raises

from rille.stages.geometry.lattice import Lattice
from rille.stages.planning.path_ground import RowGrid

CELL = 0.01


@pytest.mark.parametrize("heading", [(0.0, 1.0), (0.0, 3.0), (1.0, 0.0), (-1.0, 2.0), (0.3, -0.2)])
def test_a_turned_grid_covers_the_lattice(heading: tuple[float, float]) -> None:
    lattice = Lattice.at(-7, 12, CELL, 40, 30)
    turned = RowGrid.over(lattice, heading)
    assert math.hypot(*turned.ahead) == pytest.approx(1.0)
    row, col = np.indices((turned.rows, turned.cols))
    xy = turned.xy(row, col)
    for r, c in ((0, 0), (turned.rows - 1, turned.cols - 1), (3, 5)):
        assert turned.index(tuple(xy[r, c])) == (r, c)
    ahead = xy[0, 0] - xy[1, 0]
    np.testing.assert_allclose(ahead, np.array(heading) / math.hypot(*heading) * CELL, atol=1e-12)
    ones = turned.sample(lattice, np.ones(lattice.shape, dtype=np.uint8), 0)
    # nearest neighbour keeps the area; the rim of half a cell is lost or gained
    assert int(ones.sum()) == pytest.approx(40 * 30, abs=2 * (40 + 30))


def test_along_y_nothing_is_resampled() -> None:
    lattice = Lattice.at(-7, 12, 0.001, 40, 30)
    turned = RowGrid.over(lattice, (0.0, 1.0))
    values = np.random.default_rng(0).integers(0, 255, lattice.shape)
    np.testing.assert_array_equal(turned.sample(lattice, values, -1), values)


def test_a_heading_needs_a_direction() -> None:
    with raises("RIL-434"):
        RowGrid.over(Lattice.at(0, 0, CELL, 3, 3), (0.0, 0.0))
