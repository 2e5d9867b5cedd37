from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raising import raises

from rille.stages.geometry.lattice import Lattice, mosaic, union

CELLS = st.sampled_from([0.0005, 0.001, 0.002, 0.02, 0.1, 0.25, 1.0])
INDEX = st.integers(-3000, 3000)
COUNT = st.integers(1, 40)


@st.composite
def lattices(draw: st.DrawFn, cell: float = 0.1) -> Lattice:
    return Lattice.at(draw(st.integers(-30, 30)), draw(st.integers(-30, 30)), cell, draw(COUNT), draw(COUNT))


def test_coordinates_by_hand() -> None:
    lattice = Lattice(x0=-0.2, y0=0.5, cell=0.1, rows=2, cols=3)
    np.testing.assert_allclose(lattice.xs(), [-0.2, -0.1, 0.0], atol=1e-15)
    np.testing.assert_allclose(lattice.ys(), [0.5, 0.4])
    np.testing.assert_allclose(lattice.xy()[1, 2], [0.0, 0.4], atol=1e-15)
    np.testing.assert_allclose(lattice.index([0.0, 0.4]), [1, 2], atol=1e-12)
    np.testing.assert_allclose(lattice.bounds, (-0.25, 0.05, 0.35, 0.55))


@given(CELLS, INDEX, INDEX, COUNT, COUNT)
def test_equal_cells_have_bit_equal_coordinates(cell: float, i0: int, j0: int, rows: int, cols: int) -> None:
    a, b = Lattice.at(i0, j0, cell, rows, cols), Lattice.at(i0 - 7, j0 + 5, cell, rows + 9, cols + 11)
    window = b.window(a)
    assert np.array_equal(a.xy(), b.xy()[window])
    assert Lattice.from_dict(a.to_dict()) == a


@given(CELLS, st.floats(-50, 50), st.floats(-50, 50), st.floats(0, 5), st.floats(0, 5))
def test_snap_covers_and_is_smallest(cell: float, x: float, y: float, w: float, h: float) -> None:
    cell = max(cell, 0.02)
    lattice = Lattice.snap((x, x + w, y, y + h), cell)
    x_min, x_max, y_min, y_max = lattice.bounds
    slack = 1e-5 * cell
    assert x_min <= x + slack and x + w <= x_max + slack and y_min <= y + slack and y + h <= y_max + slack  # noqa: PT018
    assert x - x_min < cell + slack and x_max - x - w < cell + slack  # noqa: PT018
    assert y - y_min < cell + slack and y_max - y - h < cell + slack  # noqa: PT018


def test_snap_of_bounds_returns_the_lattice() -> None:
    lattice = Lattice.at(-358, 781, 0.001, 579, 661)
    assert Lattice.snap(lattice.bounds, 0.001) == lattice


@given(lattices(), lattices())
def test_union_and_intersection_against_sets(a: Lattice, b: Lattice) -> None:
    def cells(lattice: Lattice) -> set[tuple[int, int]]:
        return {(lattice.i0 + c, lattice.j0 - r) for r in range(lattice.rows) for c in range(lattice.cols)}

    both = cells(a) & cells(b)
    common = a.intersection(b)
    assert (cells(common) if common else set()) == both
    whole = a.union(b)
    assert cells(whole) >= cells(a) | cells(b)
    xs = {i for i, _ in cells(a) | cells(b)}
    assert whole.cols == max(xs) - min(xs) + 1


@given(lattices(), st.integers(1, 17))
def test_tiles_partition_and_mosaic_puts_them_together(lattice: Lattice, size: int) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=lattice.shape)
    tiles = list(lattice.tiles(size))
    assert sum(t.rows * t.cols for t in tiles) == lattice.rows * lattice.cols
    assert all(max(t.shape) <= size for t in tiles)
    parts = [(t, values[lattice.window(t)]) for t in tiles]
    assert union(tiles) == lattice
    assert np.array_equal(mosaic(parts[::-1], np.nan), values)


def test_inner_tiles_stay_when_the_lattice_grows() -> None:
    small, large = Lattice.at(-20, 20, 0.1, 40, 40), Lattice.at(-33, 41, 0.1, 77, 70)
    inner = [t for t in small.tiles(10) if t.shape == (10, 10)]
    assert len(inner) > 4
    assert set(inner) <= set(large.tiles(10))


def test_mosaic_on_a_larger_target_is_nodata_outside() -> None:
    part = Lattice.at(0, 0, 1.0, 1, 1)
    out = mosaic([(part, np.array([[7]], np.int16))], -1, Lattice.at(-1, 1, 1.0, 2, 2))
    assert out.tolist() == [[-1, -1], [-1, 7]]
    assert out.dtype == np.int16


def test_values_are_those_of_the_cell_that_holds_a_point() -> None:
    lattice = Lattice(1.0, 4.0, 0.5, 2, 3)
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    points = np.array([(1.0, 4.0), (1.24, 3.76), (2.2, 3.4), (2.3, 3.4), (0.7, 4.0), (np.nan, 4.0)])
    found = lattice.values(array, lattice.index(points), np.nan)
    assert np.array_equal(found, [0, 0, 5, np.nan, np.nan, np.nan], equal_nan=True)
    mask = lattice.values(array > 4, lattice.index(points).reshape(2, 3, 2), False)
    assert mask.dtype == np.bool_
    assert np.array_equal(mask, [[False, False, True], [False] * 3])


def test_what_is_refused() -> None:
    with raises("RIL-356"):
        Lattice(0.0, 0.0, 0.001, 10_000, 10_000)
    with raises("RIL-357"):
        Lattice(0.05, 0.0, 0.1, 2, 2)
    with raises("RIL-354"):
        Lattice(0.0, 0.0, 0.0, 2, 2)
    for bounds in ((1.0, 0.0, 0.0, 1.0), (0.0, math.nan, 0.0, 1.0)):
        with pytest.raises(AssertionError):
            Lattice.snap(bounds, 0.1)
    with raises("RIL-361"):
        Lattice.at(0, 0, 0.1, 2, 2).union(Lattice.at(0, 0, 0.2, 2, 2))
    with pytest.raises(AssertionError):
        Lattice.at(0, 0, 0.1, 2, 2).window(Lattice.at(1, 0, 0.1, 2, 2))
    with pytest.raises(AssertionError):
        mosaic([(Lattice.at(0, 0, 1.0, 1, 1), np.zeros((2, 2)))], 0)


def test_the_remedy_of_too_many_cells_works() -> None:
    with raises("RIL-356") as error:
        Lattice.snap((0.0, 100.0, 0.0, 100.0), 0.01)
    cell = float(error.value.remedy.split()[3])
    assert Lattice.snap((0.0, 100.0, 0.0, 100.0), cell).rows > 1000
