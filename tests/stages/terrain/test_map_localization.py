"""The first pose in a global map: found where it is, with honest covariance; ambiguous and missing ground are said."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from raising import raises

from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import heading_of
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.map_localization import MapLocalizationParams, Placement, SearchArea, fix, thin
from rille.stages.terrain.relief.grid import Grid

Floats = NDArray[np.float64]
CELL = 0.04
TRUE = (0.31, -0.22, math.radians(12.0), 0.07)
AROUND = SearchArea(0.25, -0.2, 0.0, 0.3, math.radians(24.0))
PARAMS = MapLocalizationParams()
Scene = tuple[Grid, Grid]


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


def scene(ground: Callable[[Floats, Floats], Floats], noise: float = 0.0, tilt: float = 0.0, seed: int = 1) -> Scene:
    """A local model at TRUE, leaning by ``tilt`` about x and y, rad, and the global map."""
    whole = Lattice.snap((-1.5, 1.5, -1.5, 1.5), CELL)
    local = Lattice.snap((-0.3, 0.3, 0.1, 0.8), 0.01)
    x, y = local.xy()[..., 0], local.xy()[..., 1]
    c, s = math.cos(TRUE[2]), math.sin(TRUE[2])
    z = ground(TRUE[0] + c * x - s * y, TRUE[1] + s * x + c * y) - TRUE[3] + tilt * (x - y)
    xy = whole.xy()
    heights = ground(xy[..., 0], xy[..., 1]) + noise * np.random.default_rng(seed).standard_normal(whole.shape)
    return Grid.on(local, z), Grid.on(whole, heights)


def error(found: Placement) -> Floats:
    """Of x, y, z, m, and heading, rad."""
    x, y, heading, z = TRUE
    return np.array([*(found.pose.translation - [x, y, z]), heading_of(found.pose) - heading])


def unsure(model: Grid, ground: Grid, around: SearchArea) -> bool:
    """Whether no place is given, or with doubt."""
    try:
        return bool(fix(model, ground, around, PARAMS).doubt)
    except DegenerateError as error:
        return error.code == "RIL-339"


def test_the_place_is_found_within_the_curvature_of_the_cells() -> None:
    found = fix(*scene(hills), AROUND, PARAMS)
    # bilinear cells of 40 mm on waves of at most 0.02 m and 13 / m differ from them by up to 0.02 (13 * 0.04)^2 / 8 m
    assert error(found)[:2] == pytest.approx(0.0, abs=0.1 * CELL)
    assert error(found)[2:] == pytest.approx([0.0, 0.0], abs=2e-3)
    assert found.figures["overlap"] > 0.7  # but for the rim, where slopes are not known
    assert not found.doubt


@pytest.mark.parametrize("heading", [0.0, math.pi])
def test_the_place_is_found_in_all_of_the_map_at_any_heading(heading: float) -> None:
    found = fix(*scene(hills, noise=0.003), SearchArea(0.0, 0.0, heading, 1.5, math.pi), PARAMS)
    assert np.abs(error(found)[:2]).max() < 0.25 * CELL
    assert not found.doubt


def test_a_map_as_fine_as_the_model_gives_the_same_place() -> None:
    whole = Lattice.snap((-0.6, 1.2, -0.9, 0.9), 0.005)
    xy = whole.xy()
    found = fix(scene(hills)[0], Grid.on(whole, hills(xy[..., 0], xy[..., 1])), AROUND, PARAMS)
    assert np.abs(error(found)[:2]).max() < 1e-3


def test_a_tilt_of_the_model_is_estimated_and_does_not_move_it() -> None:
    tilt = math.radians(3.0)
    found = fix(*scene(hills, tilt=tilt), AROUND, MapLocalizationParams(sigma_tilt_deg=5.0))
    assert np.abs(error(found)[:2]).max() < 0.3 * CELL
    # The normal of z = tilt (x - y) is turned upright; seen in the map, which is turned by the heading.
    assert found.pose.rotation[2] == pytest.approx([-math.sin(tilt), math.sin(tilt), math.cos(tilt)], abs=3e-3)


@pytest.mark.parametrize("degrees", [2.0, 4.0, 6.0])
def test_a_tilt_hides_no_place_in_all_of_the_map(degrees: float) -> None:
    """A long lane whose relief is small beside the heights that the tilt lifts its ends by."""
    tilt, rng = math.radians(degrees), np.random.default_rng(3)
    waves = [(*rng.uniform(-1.5, 1.5, 2), rng.uniform(0, 6.3)) for _ in range(10)]

    def lane(xy: Floats) -> Floats:
        x, y = np.moveaxis(xy, -1, 0)
        return np.asarray(sum(0.03 * np.sin(a * x + b * y + c) for a, b, c in waves) + 0.3 * np.tanh(np.abs(x) - 4.0))

    whole, local = Lattice.snap((-8.0, 8.0, -5.0, 45.0), 0.2), Lattice.snap((-6.0, 6.0, 6.0, 34.0), 0.1)
    ground = lane(whole.xy()) + 0.02 * np.random.default_rng(0).standard_normal(whole.shape)
    model = lane(np.add(local.xy(), (0.0, 2.4))) - tilt * local.xy()[..., 1]
    found = fix(Grid.on(local, model), Grid.on(whole, ground), None, MapLocalizationParams(sigma_tilt_deg=5.0))
    # The model is higher or lower by the tilt, and so seen shorter.
    assert found.pose.translation[:2] == pytest.approx([0.0, 2.4], abs=0.15)
    assert not found.doubt


def test_errors_are_of_the_size_that_the_covariance_claims() -> None:
    kept = [0, 1, 2, 5]
    nees = []
    for seed in range(8):
        found = fix(*scene(hills, noise=0.006, seed=seed), AROUND, PARAMS)
        nees.append(error(found) @ np.linalg.solve(found.covariance[np.ix_(kept, kept)], error(found)) / 4)
    assert 0.3 < np.mean(nees) < 2.5
    assert math.sqrt(found.covariance[0, 0]) < 0.25 * CELL


def test_a_block_counts_from_three_tenths_of_its_cells_on() -> None:
    lattice = Lattice.at(-10, 10, 0.01, 20, 20)
    z, xy = np.full(lattice.shape, np.nan), lattice.xy()
    for x, y, cells in ((0.0, 0.0, 5), (0.04, 0.0, 4)):
        near = np.argwhere((np.abs(xy - (x, y)) < 0.0195).all(axis=-1))[:cells]
        z[tuple(near.T)] = 10.0 * xy[tuple(near.T)][:, 0] + 1.0
    ((x, y, height),) = thin(Grid.on(lattice, z), 0.04).points
    assert height == pytest.approx(10.0 * x + 1.0)
    assert max(abs(x), abs(y)) < 0.02


def test_ground_that_repeats_is_ambiguous() -> None:
    repeated = fix(*scene(ridges), AROUND, PARAMS)
    assert repeated.doubt
    periods = (repeated.figures["other"]["x_m"] - repeated.pose.translation[0]) / 0.16
    assert periods == pytest.approx(round(periods), abs=CELL / 0.16)
    assert round(periods) != 0


def test_a_better_place_beside_the_search_is_no_secret() -> None:
    scenery = scene(hills, noise=0.003)
    with_start = replace(AROUND, x=TRUE[0] + 0.35, y=TRUE[1] - 0.25, distance=0.1)
    assert unsure(*scenery, with_start)


def test_a_model_of_other_ground_has_no_place() -> None:
    other = scene(lambda x, y: hills(-x - 3.0, y + 1.7), noise=0.003)[1]
    assert unsure(scene(hills)[0], other, SearchArea(0.0, 0.0, 0.0, 1.5, math.pi))


def test_a_map_in_another_unit_is_in_doubt_however_far_the_next_place() -> None:
    model, ground = scene(hills)
    found = fix(model, replace(ground, values=100.0 * ground.values), AROUND, PARAMS)
    assert "of the relief" in found.doubt


def test_a_map_elsewhere_is_refused_with_the_share_that_it_knows() -> None:
    model, ground = scene(hills)
    with raises("RIL-338", "50%"):
        fix(model, ground, replace(AROUND, x=5.0, y=5.0), PARAMS)
    ground.values[:, : ground.values.shape[1] // 2 + 5] = np.nan
    with raises("RIL-338"):
        fix(model, ground, replace(AROUND, x=-1.0), PARAMS)


def test_flat_ground_tells_no_place() -> None:
    with raises("RIL-339"):
        fix(*scene(lambda x, y: 0.0 * x), AROUND, PARAMS)
    assert unsure(*scene(lambda x, y: 0.0 * x, noise=0.003), AROUND)


def test_a_handful_of_cells_is_no_model() -> None:
    model, ground = scene(hills)
    model.values[30:] = np.nan
    model.values[:, 10:] = np.nan
    with raises("RIL-337"):
        fix(model, ground, AROUND, PARAMS)


def test_a_search_without_end_is_refused() -> None:
    ground = Grid(np.zeros((9000, 9000)), np.array([[CELL, 0.0, 0.0], [0.0, -CELL, 0.0]]))
    with raises("RIL-840"):
        fix(scene(hills)[0], ground, SearchArea(180.0, -180.0, 0.0, 400.0, 3.0), PARAMS)
