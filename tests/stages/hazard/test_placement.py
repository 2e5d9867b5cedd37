"""The vehicle put down: planes exact, one stone under a wheel and under the belly by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from vehicles import MODEL

from rille.stages.hazard.placement import Stance, place, stride

CELL = 0.004


@pytest.mark.parametrize("direction", np.linspace(0, 2 * math.pi, 9)[:-1])
def test_on_a_plane_tilt_and_slope_are_its_gradient(direction: float) -> None:
    y, x = np.mgrid[:90, :90] * CELL
    z = (0.3 * (x * math.cos(direction) + y * math.sin(direction))).astype(np.float32)
    found = place(z, z, MODEL, CELL, np.isfinite(z))
    inner = np.s_[32:-32, 32:-32]
    # wheels are put on the nearest cell, so a side and an axle are not quite at right angles: half a cell of 80 mm
    for values in (found.tilt[inner], found.slope[inner]):
        np.testing.assert_allclose(values, 0.3, rtol=0.035)
        assert values.min() >= 0.3 - 1e-4
    # at most g B / 4 along and g T / 4 across, and what the belly's patches are wider than the wheels'
    assert found.rise[inner].max() <= 0.3 * (0.25 * math.hypot(0.1, 0.08) + 0.02)
    assert found.unstood[inner].max() == 0.0
    assert found.unstood[0, 0] > 0.7


def stone(row: int, col: int, height: float) -> tuple[np.ndarray, np.ndarray]:
    high = np.zeros((61, 61), dtype=np.float32)
    high[row, col] = height
    return high, np.zeros_like(high)


def test_a_stone_under_a_wheel_tilts_the_vehicle_as_three_wheels_do() -> None:
    at = Stance.of(MODEL, CELL)
    row, col = (int(v) for v in at.wheels[0, 0])
    high, low = stone(30 + row, 30 + col, 0.01)
    found = place(high, low, MODEL, CELL, np.isfinite(high))
    span = 2 * abs(row) * CELL, 2 * abs(col) * CELL
    assert found.tilt[30, 30] == pytest.approx(math.hypot(0.01 / span[0], 0.01 / span[1]), rel=0.01)
    assert found.slope[30, 30] == 0.0  # the ground beneath is level


def test_a_stone_under_the_belly_rises_by_its_height_and_tilts_nothing() -> None:
    high, low = stone(30, 30, 0.02)
    found = place(high, low, MODEL, CELL, np.isfinite(high))
    assert found.rise[30, 30] == pytest.approx(0.02, rel=1e-5)
    assert found.tilt[30, 30] == 0.0
    assert found.rise[0, 0] == 0.0


def test_wheels_that_stand_higher_than_the_ground_below_count_as_level_with_it() -> None:
    """A pit under the belly: the wheels stand 10 mm above it at every heading, and nothing rises."""
    high = np.zeros((61, 61), dtype=np.float32)
    y, x = np.mgrid[-30:31, -30:31] * CELL
    high[np.hypot(x, y) < 0.04] = -0.01
    assert place(high, high, MODEL, CELL, np.isfinite(high)).rise[30, 30] == 0.0


def test_unknown_ground_under_one_wheel_is_told_and_the_others_are_still_judged() -> None:
    at = Stance.of(MODEL, CELL)
    high, low = stone(*(int(v) + 30 for v in at.wheels[0, 0]), 0.01)
    r, c = (int(v) + 30 for v in at.wheels[0, 3])
    high[r - 4 : r + 5, c - 4 : c + 5] = low[r - 4 : r + 5, c - 4 : c + 5] = np.nan
    found = place(high, low, MODEL, CELL, np.isfinite(high))
    assert 0.0 < found.unstood[30, 30] < 1.0
    assert found.tilt[30, 30] > 0.1


def test_places_against_a_look_at_every_wheel_and_part_of_the_belly() -> None:
    rng, cell = np.random.default_rng(2), 0.012
    high = rng.normal(0.0, 0.01, (26, 29)).astype(np.float32)
    low = high - rng.uniform(0.0, 0.01, high.shape).astype(np.float32)
    high[rng.random(high.shape) < 0.1] = np.nan
    low[np.isnan(high)] = np.nan
    whole = np.isfinite(high) & (rng.random(high.shape) < 0.95)
    found, at, rim = place(high, low, MODEL, cell, whole), Stance.of(MODEL, cell), 40
    rows, cols = high.shape
    # Beyond the map all is unknown.
    high, low = (np.pad(a, rim, constant_values=np.nan) for a in (high, low))
    whole = np.pad(whole, rim)

    def look(maps: list[np.ndarray], r: int, c: int, reach: int) -> list[float]:
        """Highest value of each map around a cell; NaN where none is known."""
        part = np.s_[r + rim - reach : r + rim + reach + 1, c + rim - reach : c + rim + reach + 1]
        return [max(a[part][~np.isnan(a[part])], default=math.nan) for a in maps]

    for r in range(0, rows, 2):
        for c in range(cols):
            squares, rises, gaps = [[], []], [0.0], []
            for wheels, belly, spans in zip(at.wheels, at.belly, at.spans.astype(float), strict=True):
                stood = np.array([look([high, -low, ~whole], r + y, c + x, at.wheel_reach) for y, x in wheels])
                under = np.array([look([high, ~whole], r + y, c + x, at.belly_reach) for y, x in belly])
                for square, (fl, fr, rl, rr) in zip(squares, (stood[:, 0], -stood[:, 1]), strict=True):
                    sides = np.abs([fl - rl, fr - rr, fl - fr, rl - rr]) / spans
                    square.append(sum(max(s[~np.isnan(s)], default=0.0) ** 2 for s in (sides[:2], sides[2:])))
                over = np.nan_to_num(under[:, :1] - stood[:, 0])
                rises.append((at.weights * np.maximum(over, 0.0)).sum(axis=1).max())
                gaps += [*np.nan_to_num(stood[:, 2], nan=1.0), *np.nan_to_num(under[:, 1], nan=1.0)]
            expected = [*(math.sqrt(max(s)) for s in squares), max(rises), np.mean(gaps)]
            np.testing.assert_allclose([a[r, c] for a in found], expected, rtol=1e-4, atol=1e-6)


def test_headings_go_once_round_half_a_turn() -> None:
    at = Stance.of(MODEL, 0.0005).wheels.astype(float)
    front, rear = at[:, :2].mean(axis=1), at[:, 2:].mean(axis=1)
    ahead = (front - rear) @ [1j, 1.0]  # columns, and rows downwards
    steps = np.degrees(np.angle(ahead[1:] / ahead[:-1]))
    np.testing.assert_allclose(np.abs(steps.sum()), 180.0 * 7 / 8, atol=0.5)
    np.testing.assert_allclose(steps, steps.mean(), atol=0.7)  # rounded to cells of half a millimetre


def test_a_wheel_stands_on_a_patch_half_as_wide_and_on_coarse_ground_on_one_cell() -> None:
    assert [Stance.of(MODEL, MODEL.wheel_diameter / n).wheel_reach for n in (16, 8, 1)] == [4, 2, 1]


def test_wheels_on_one_cell_do_not_tilt_the_vehicle() -> None:
    """The track is less than the cells of a coarse grid."""
    z = np.tile(np.linspace(0.0, 1.0, 21, dtype=np.float32), (21, 1))
    narrow = MODEL.model_copy(update={"track": 0.03, "wheel_base": 0.03})
    found = place(z, z, narrow, 0.05, np.isfinite(z))
    assert found.tilt.max() == found.slope.max() == 0.0


def test_bilinear_weights_and_places() -> None:
    at = Stance.of(MODEL, CELL)
    np.testing.assert_allclose(at.weights.sum(axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(at.weights @ at.wheels[0], at.belly[0], atol=0.75)  # cells, both rounded
    assert (stride(MODEL, 0.001), stride(MODEL, 0.1)) == (4, 1)
