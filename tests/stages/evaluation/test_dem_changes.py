"""Changes between two models: planted ones are found with their volumes, and nothing where nothing changed."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from rille.stages.evaluation.dem_changes import changes, standard_deviation
from rille.stages.terrain.relief.grid import Grid

CELL, SHAPE = 0.01, (120, 160)
GRID = Grid(np.zeros(SHAPE), np.array([[CELL, 0.0, 0.0], [0.0, CELL, 0.0]]))


def stone(row, col, height=0.01, radius=6):
    """A hemisphere of paraboloid form (rows, cols), metres, and its volume."""
    y, x = np.indices(SHAPE)
    cap = np.maximum(1 - ((y - row) ** 2 + (x - col) ** 2) / radius**2, 0)
    return height * cap


def noise(seed, size=1e-3, spread=1.0):
    """Errors (rows, cols), metres, that neighbours share."""
    rough = scipy.ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=SHAPE), spread)
    return size * rough / rough.std()


def listed(error, sigma=1e-3, slope=0.0):
    full = np.full(SHAPE, sigma), np.full(SHAPE, slope)
    return changes(error, standard_deviation(error, *full, CELL), GRID)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("stated", [0.0, 1e-4, 1e-3])
def test_a_stone_that_moved_is_one_loss_and_one_gain(seed, stated):
    error = stone(60, 100) - stone(40, 30) + noise(seed)
    error[:20, :20] = np.nan
    found = listed(error, stated)
    assert [np.sign(c.volume_m3) for c in found] in ([1, -1], [-1, 1])
    for change in found:
        row, col = (60, 100) if change.volume_m3 > 0 else (40, 30)
        assert np.hypot(change.y_m / CELL - row, change.x_m / CELL - col) < 1
        assert change.area_m2 == pytest.approx(change.cells * CELL**2)
        assert abs(abs(change.volume_m3) - stone(60, 100).sum() * CELL**2) < 3 * change.sigma_m3
        assert change.sigma_m3 < 0.15 * abs(change.volume_m3)


def test_what_is_not_beyond_the_models_own_errors_is_no_change():
    assert listed(stone(60, 100) + noise(0), sigma=5e-3) == []


def test_sigmas_of_volumes_hold_where_neighbours_share_their_errors():
    true = stone(60, 80).sum() * CELL**2
    found = [listed(stone(60, 80) + noise(seed))[0] for seed in range(24)]
    spread = np.std([c.volume_m3 for c in found])
    assert 0.5 < np.mean([c.sigma_m3 for c in found]) / spread < 2
    assert abs(np.mean([c.volume_m3 for c in found]) - true) < 0.1 * true


@pytest.mark.parametrize("seed", range(6))
def test_nothing_is_found_where_nothing_changed(seed):
    assert listed(noise(seed)) == []


def test_what_a_shift_makes_on_slopes_is_no_change():
    ground = stone(60, 80, height=0.05, radius=20)
    shifted = scipy.ndimage.shift(ground, (0.25, 0.0), order=1)
    error, slope = shifted - ground + noise(1, 1e-4), np.hypot(*np.gradient(ground, CELL))
    deviation = standard_deviation(error, np.full(SHAPE, 1e-4), slope, CELL)
    assert changes(error, deviation, GRID) == []
