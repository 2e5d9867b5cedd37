"""The first pose in a global map: found where it is, with honest covariance; ambiguous and missing ground are said."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from raising import raises
from scipy.interpolate import RegularGridInterpolator

from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.map_localization import (
    CORRELATION_CELLS,
    MIN_CHI2_GAP,
    GlobalMap,
    MapLocalizationParams,
    Prior,
    fix,
    thin,
)

Floats = NDArray[np.float64]
CELL = 0.04
TRUE = (0.31, -0.22, math.radians(12.0), 0.07)
SIGMA = (0.1, math.radians(8.0))
PRIOR = Prior(0.25, -0.2, 0.0, *SIGMA)


def hills(x: Floats, y: Floats) -> Floats:
    """Relief without a period, of wavelengths of many cells."""
    rng = np.random.default_rng(4)
    z = np.zeros_like(x)
    for _ in range(12):
        a, b, phase = rng.uniform(-9, 9), rng.uniform(-9, 9), rng.uniform(0, 6.3)
        z += 0.02 * np.sin(a * x + b * y + phase)
    return z


def ridges(x: Floats, y: Floats) -> Floats:
    """The same every 0.16 m of x, by itself in y."""
    return 0.02 * np.sin(2 * math.pi * x / 0.16) + 0.02 * np.sin(2 * math.pi * y / 1.3)


def scene(ground: Callable[[Floats, Floats], Floats], noise: float = 0.0) -> tuple[Floats, GlobalMap]:
    """Points of a local model at TRUE, and the global map."""
    whole = Lattice.snap((-1.5, 1.5, -1.5, 1.5), CELL)
    local = Lattice.snap((-0.3, 0.3, 0.1, 0.8), 0.01)
    x, y = local.xy()[..., 0], local.xy()[..., 1]
    c, s = math.cos(TRUE[2]), math.sin(TRUE[2])
    z = ground(TRUE[0] + c * x - s * y, TRUE[1] + s * x + c * y) - TRUE[3]
    xy = whole.xy()
    rng = np.random.default_rng(1)
    heights = ground(xy[..., 0], xy[..., 1]) + noise * rng.standard_normal(whole.shape)
    return thin(z, local, CELL), GlobalMap(heights, whole)


def test_the_place_is_found_within_the_curvature_of_the_cells() -> None:
    found = fix(*scene(hills), PRIOR, MapLocalizationParams())
    # bilinear cells of 40 mm on waves of at most 0.02 m and 13 / m differ from them by up to 0.02 (13 * 0.04)^2 / 8 m
    assert found.place[:2] == pytest.approx(TRUE[:2], abs=0.1 * CELL)
    assert found.place[2] == pytest.approx(TRUE[2], abs=math.radians(0.5))
    assert found.place[3] == pytest.approx(TRUE[3], abs=1e-3)
    assert found.overlap == 1.0


def test_errors_are_of_the_size_that_the_covariance_claims() -> None:
    found = fix(*scene(hills, noise=0.003), PRIOR, MapLocalizationParams())
    error = found.place - TRUE
    assert error @ np.linalg.solve(found.covariance, error) < 18.5  # chi2 of 4, 0.1 %
    assert math.sqrt(found.covariance[0, 0]) < 0.25 * CELL


def test_the_covariance_is_that_of_least_squares_with_one_cell_a_correlation_length() -> None:
    points, ground = scene(hills, noise=0.002)
    found = fix(points, ground, PRIOR, MapLocalizationParams())
    whole = ground.lattice
    height = RegularGridInterpolator((whole.ys()[::-1], whole.xs()), ground.heights[::-1])

    def left(place: Floats) -> Floats:
        c, s = math.cos(place[2]), math.sin(place[2])
        x, y = place[0] + c * points[:, 0] - s * points[:, 1], place[1] + s * points[:, 0] + c * points[:, 1]
        return np.asarray(points[:, 2] + place[3] - height((y, x)))

    step = 1e-6
    slopes = np.stack([(left(found.place + d) - left(found.place - d)) / (2 * step) for d in step * np.eye(4)], axis=1)
    expected = np.linalg.inv(slopes.T @ slopes) * (left(found.place) ** 2).mean() * CORRELATION_CELLS**2
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.02)


def test_a_block_counts_from_three_tenths_of_its_cells_on() -> None:
    lattice = Lattice.at(-10, 10, 0.01, 20, 20)
    z, xy = np.full(lattice.shape, np.nan), lattice.xy()
    for x, y, cells in ((0.0, 0.0, 5), (0.04, 0.0, 4)):
        near = np.argwhere((np.abs(xy - (x, y)) < 0.0195).all(axis=-1))[:cells]
        z[tuple(near.T)] = 10.0 * xy[tuple(near.T)][:, 0] + 1.0
    ((x, y, height),) = thin(z, lattice, 0.04)
    assert height == pytest.approx(10.0 * x + 1.0)
    assert max(abs(x), abs(y)) < 0.02


def test_ground_that_repeats_is_ambiguous() -> None:
    repeated = fix(*scene(ridges), PRIOR, MapLocalizationParams())
    unique = fix(*scene(hills), PRIOR, MapLocalizationParams())
    assert repeated.other is not None
    assert repeated.other[1] < MIN_CHI2_GAP
    periods = (repeated.other[0][0] - repeated.place[0]) / 0.16
    assert periods == pytest.approx(round(periods), abs=CELL / 0.16)
    assert round(periods) != 0
    assert unique.other is None or unique.other[1] > MIN_CHI2_GAP


def test_a_map_elsewhere_is_refused_with_the_share_that_it_knows() -> None:
    points, ground = scene(hills)
    with raises("RIL-338", "50%"):
        fix(points, ground, Prior(5.0, 5.0, 0.0, *SIGMA), MapLocalizationParams())
    ground.heights[:, : ground.lattice.cols // 2 + 5] = np.nan
    with raises("RIL-338"):
        fix(points, ground, Prior(-0.6, -0.2, 0.0, *SIGMA), MapLocalizationParams())


def test_flat_ground_tells_no_place() -> None:
    with raises("RIL-339"):
        fix(*scene(lambda x, y: 0.0 * x), PRIOR, MapLocalizationParams())


def test_a_handful_of_cells_is_no_model() -> None:
    points, ground = scene(hills)
    with raises("RIL-337"):
        fix(points[:5], ground, PRIOR, MapLocalizationParams())
