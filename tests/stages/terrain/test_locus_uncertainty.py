from __future__ import annotations

import numpy as np
import pytest

from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.locus.uncertainty import (
    DIFFERENCE_FACTOR,
    FLOOR_PX,
    HOLE_VARIANCE_PX2,
    MIN_AREA_PX,
    MOVE_FACTOR,
    ONE_SIDED_DIFFERENCE_PX,
    REST_FACTOR,
    SHADE_FACTOR,
    STEP_FACTOR,
    standard_deviation,
)
from rille.stages.terrain.locus.views import OrthoPair, facing

SHAPE = (40, 50)
SCALE = 500.0
CONTRAST, AREA, NOISE, GREY = 8.0, 0.5, 2.0, 100.0
RISE, AWAY, SHIFT = 2e-4, 1.5e-4, 1e-4


def ground(rise: float = RISE) -> tuple[np.ndarray, np.ndarray]:
    """A slope across the rows' cells, and two images whose difference is a chequerboard of +-NOISE."""
    rows, cols = np.indices(SHAPE)
    elevation = (rise * cols).astype(np.float32)
    seen = np.empty((6, *SHAPE), np.float32)
    seen[0] = GREY
    seen[1] = GREY - NOISE * np.where((rows + cols) % 2, 1.0, -1.0)
    seen[2], seen[5] = -CONTRAST * SCALE, CONTRAST * SCALE
    seen[3], seen[4] = SCALE, AREA
    return elevation, seen


def uniform(value: float) -> np.ndarray:
    return np.full(SHAPE, value, np.float32)


def std(
    elevation: np.ndarray, seen: np.ndarray, *, turned: float = 1.0, moved: float = 0.0, apart: float | np.ndarray = 0.0
) -> np.ndarray:
    apart = uniform(1.0) * apart
    return standard_deviation(elevation, OrthoPair(*seen), uniform(turned), uniform(moved), apart, uniform(0.5))


def expected(
    *, rise: float = RISE, grey: float = GREY, area: float = AREA, apart: float = 0.0, moved: float = 0.0
) -> float:
    """By hand: the chequerboard's median difference is its height, its local mean nearly nothing."""
    noise = 1.4826 * NOISE
    variance = (
        FLOOR_PX**2
        + STEP_FACTOR * (SCALE * rise) ** 2 / min(area, 1.0)
        + REST_FACTOR * NOISE**2 / (25 * (CONTRAST**2 * min(area, 1.0) + 1.0))
    )
    variance += (
        (SHADE_FACTOR * noise / grey) ** 2
        + (DIFFERENCE_FACTOR * SCALE * apart) ** 2
        + MOVE_FACTOR * (SCALE * moved) ** 2 / max(area, MIN_AREA_PX)
    )
    return float(np.sqrt(variance) / SCALE)


@pytest.mark.parametrize("term", [{}, {"apart": AWAY}, {"moved": SHIFT}, {"apart": AWAY, "moved": SHIFT}])
def test_variances_add_up_as_by_hand(term: dict[str, float]) -> None:
    np.testing.assert_allclose(std(*ground(), **term)[20, 25], expected(**term), rtol=5e-3)


@pytest.mark.parametrize("area", [0.05, 0.2, 4.0])
def test_steps_and_moves_count_by_the_pixels_of_a_cell(area: float) -> None:
    elevation, seen = ground()
    seen[4] = area
    found = std(elevation, seen, moved=SHIFT)[20, 25]
    np.testing.assert_allclose(found, expected(area=area, moved=SHIFT), rtol=5e-3)


def test_each_part_counts() -> None:
    """Of what the figures above are made: none of the parts is lost among the others."""
    whole = expected(apart=AWAY, moved=SHIFT)
    for less in (
        expected(apart=0.0, moved=SHIFT),
        expected(apart=AWAY, moved=0.0),
        expected(rise=0.0, apart=AWAY, moved=SHIFT),
        expected(grey=1e6, apart=AWAY, moved=SHIFT),
    ):
        assert less < 0.99 * whole


def test_in_the_dark_there_is_no_contrast_to_match() -> None:
    """Gradients as strong as in the light, but of grey values that cannot hold them: noise."""
    elevation, seen = ground()
    seen[:2, :, 30:] += 8.0 - GREY
    found = std(elevation, seen)
    np.testing.assert_allclose(found[20, 15], expected(), rtol=5e-3)
    np.testing.assert_allclose(found[20, 42], expected(grey=8.0), rtol=5e-3)
    assert found[20, 42] > 3.0 * found[20, 15]


def test_in_the_dark_contrast_is_at_most_the_noise() -> None:
    elevation, seen = ground()
    seen[:2] -= GREY
    found = std(elevation, seen)[20, 25]
    np.testing.assert_allclose(found, expected(grey=1.4826 * NOISE), rtol=5e-3)


def test_what_both_images_show_alike_is_no_difference() -> None:
    elevation, seen = ground(rise=0.0)
    seen[0] = seen[1] = np.random.default_rng(1).uniform(50.0, 150.0, SHAPE)
    np.testing.assert_allclose(std(elevation, seen), FLOOR_PX / SCALE, rtol=1e-3)


def test_a_single_cell_speaks_for_itself() -> None:
    """One cell that both directions gave is the mean of its window; so is the only cell that is known."""
    elevation, seen = ground(rise=0.0)
    seen[1] = seen[0]
    apart = uniform(np.nan)
    apart[20, 25] = AWAY
    np.testing.assert_allclose(
        std(elevation, seen, apart=apart)[20, 25], np.hypot(FLOOR_PX / SCALE, DIFFERENCE_FACTOR * AWAY), rtol=1e-3
    )
    elevation[:20], elevation[21:], elevation[20, :25], elevation[20, 26:] = (np.nan,) * 4
    found = std(elevation, seen, moved=SHIFT, apart=np.nan)[20, 25]
    np.testing.assert_allclose(
        found,
        np.sqrt(
            FLOOR_PX**2
            + (DIFFERENCE_FACTOR * ONE_SIDED_DIFFERENCE_PX) ** 2
            + MOVE_FACTOR * (SCALE * SHIFT) ** 2 / AREA
            + HOLE_VARIANCE_PX2 * 48 / 49
        )
        / SCALE,
        rtol=1e-3,
    )


def test_where_one_direction_found_nothing_a_difference_is_supposed() -> None:
    apart = uniform(AWAY)
    apart[:, 20:] = np.nan
    found = std(*ground(), apart=apart)
    np.testing.assert_allclose(found[20, 40], expected(apart=ONE_SIDED_DIFFERENCE_PX / SCALE), rtol=5e-3)
    np.testing.assert_allclose(found[20, 20], expected(apart=AWAY), rtol=5e-3)  # its neighbours have both
    np.testing.assert_allclose(found[20, 10], expected(apart=AWAY), rtol=5e-3)


def test_one_direction_has_no_difference() -> None:
    elevation, seen = ground()
    one = standard_deviation(elevation, OrthoPair(*seen), uniform(1.0), uniform(0.0), None, uniform(0.5))
    np.testing.assert_array_equal(one, std(elevation, seen))


def test_ground_that_turns_away_is_less_sure_and_ground_that_faces_the_camera_not_surer() -> None:
    level, edge_on, hidden, facing = (std(*ground(), turned=v)[20, 40] for v in (1.0, 0.0, -3.0, 2.5))
    assert edge_on == pytest.approx(np.sqrt(2.0) * level, rel=1e-5)
    assert (hidden, facing) == (edge_on, level)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_facing_is_the_area_in_the_image_over_that_of_level_ground(turn: float) -> None:
    lattice = Lattice(x0=-0.1, y0=2.0, cell=0.01, rows=30, cols=40)
    slope, centre = 0.3 * np.array([np.sin(turn), -np.cos(turn)]), np.array([0.2, -0.5, 0.9])
    x, y = lattice.xs()[None, :], lattice.ys()[:, None]
    z = (slope[0] * x + slope[1] * y).astype(np.float32)
    z[3:5, 7] = np.nan
    v = facing(z, lattice, centre, 5)

    def area(a: np.ndarray, b: np.ndarray, at: np.ndarray) -> float:
        """Solid angle, but for its third power of the distance, of a parallelogram seen from the camera."""
        return float(np.dot(np.cross(a, b), at - centre))

    for row, col in ((2, 2), (15, 20), (28, 35)):
        at = np.array([x[0, col], y[row, 0], z[row, col]])
        sloping = area(np.array([1.0, 0.0, slope[0]]), np.array([0.0, 1.0, slope[1]]), at)
        level = area(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), at)
        assert v[row, col] == pytest.approx(sloping / level, abs=2e-4)
    assert v[3, 7] == 1.0


def test_cells_that_the_images_do_not_show_keep_theirs() -> None:
    elevation, seen = ground()
    elevation[5:8, 5:8] = np.nan
    seen[:, 30:33, 30:33] = np.nan
    found = std(elevation, seen)
    np.testing.assert_array_equal(found[5:8, 5:8], 0.5)
    np.testing.assert_array_equal(found[30:33, 30:33], 0.5)
    assert np.isfinite(found).all()
    assert found[4, 6] < 0.01
    np.testing.assert_array_equal(std(uniform(np.nan).astype(np.float32), seen), 0.5)


def test_images_without_noise_or_contrast_leave_the_rest() -> None:
    elevation, seen = ground(rise=0.0)
    seen[1], seen[5] = seen[0], 0.0
    np.testing.assert_allclose(std(elevation, seen)[20, 25], FLOOR_PX / SCALE, rtol=1e-3)


def test_a_row_of_cells_faces_as_level_ground_does() -> None:
    lattice = Lattice.at(0, 0, 0.01, 1, 9)
    np.testing.assert_array_equal(facing(np.zeros((1, 9), np.float32), lattice, np.array([0.0, 0.0, 1.0]), 3), 1.0)
