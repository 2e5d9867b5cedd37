"""Slope and hillshade against hand-computed values and planes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rille.stages.terrain.shading import gradient, hillshade, slope_deg


def plane(a: float, b: float, cell: float = 0.5, shape: tuple[int, int] = (7, 9)) -> np.ndarray:
    row, col = np.mgrid[: shape[0], : shape[1]]
    return a * cell * col - b * cell * row  # y falls with the rows


def test_horn_by_hand() -> None:
    z = np.array([[1.0, 2.0, 4.0], [1.0, 3.0, 5.0], [2.0, 2.0, 9.0]])
    # Horn: ((4 + 2*5 + 9) - (1 + 2*1 + 2)) / 8 along x, ((1 + 2*2 + 4) - (2 + 2*2 + 9)) / 8 along y
    gx, gy = gradient(z, 2.0)[:, 1, 1]
    assert gx == pytest.approx((23 - 5) / 8 / 2.0)
    assert gy == pytest.approx((9 - 15) / 8 / 2.0)


@given(a=st.floats(-2, 2), b=st.floats(-2, 2), holes=st.integers(0, 2**31))
def test_a_plane_has_its_slope_wherever_enough_cells_are_known(a: float, b: float, holes: int) -> None:
    z = plane(a, b)
    z[np.random.default_rng(holes).random(z.shape) < 0.2] = np.nan
    gx, gy = gradient(z, 0.5)
    known = np.isfinite(gx)
    assert known[1:-1, 1:-1].sum() >= 5
    assert not known[np.isnan(z)].any()
    np.testing.assert_allclose(gx[known], a, atol=1e-9)
    np.testing.assert_allclose(gy[known], b, atol=1e-9)


def test_too_few_neighbours_are_not_guessed_from() -> None:
    z = np.full((5, 5), np.nan)
    z[2, :] = [0, 1, 2, 3, 4]
    assert not np.isfinite(gradient(z, 1.0)).any()


def test_slope_and_light() -> None:
    assert slope_deg(plane(1.0, 0.0), 0.5)[3, 3] == pytest.approx(45.0)
    # A slope of 45 degrees that falls to the upper left faces a light 45 degrees high there; one turned away is dark.
    side = np.sqrt(0.5)
    assert hillshade(plane(side, -side), 0.5)[3, 3] == 255
    assert hillshade(plane(-side, side), 0.5)[3, 3] == 1
    assert hillshade(plane(0.0, 0.0), 0.5)[3, 3] == round(1 + 254 * np.sqrt(0.5))
    # Turned upside down, the same slope faces away from the map's upper left.
    assert hillshade(plane(side, -side), 0.5, np.pi)[3, 3] == 1
    assert hillshade(plane(side, side), 0.5, 0.5 * np.pi)[3, 3] == 255
    hole = plane(0.0, 0.0)
    hole[3, 3] = np.nan
    assert hillshade(hole, 0.5)[3, 3] == 0
