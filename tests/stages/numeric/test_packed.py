"""Masks of one bit a cell against the same on arrays of cells."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rille.stages.numeric.packed import Canvas


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999), rows=st.integers(1, 9), cols=st.integers(1, 200), outside=st.booleans())
def test_a_mask_comes_back_and_moves_as_its_cells_do(seed: int, rows: int, cols: int, outside: bool) -> None:
    rng = np.random.default_rng(seed)
    mask, other = (rng.random((rows, cols)) < 0.3 for _ in range(2))
    border = int(rng.integers(0, 90))
    dr, dc = (int(v) for v in rng.integers(-border, border + 1, 2))
    canvas = Canvas.of(mask, border)
    np.testing.assert_array_equal(canvas.mask(), mask)
    moved = canvas.copy()
    moved.add(Canvas.of(other, border, outside), dr, dc)
    wide = np.pad(other, border, constant_values=outside)
    source = wide[border - dr : border - dr + rows, border - dc : border - dc + cols]
    np.testing.assert_array_equal(moved.mask(), mask | source)
    np.testing.assert_array_equal(canvas.mask(), mask)  # a copy has memory of its own


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 999),
    cols=st.integers(1, 150),
    n=st.integers(0, 70),
    step=st.sampled_from([(0, 1), (1, 0), (1, 1), (-1, 1)]),
)
def test_spreading_is_the_union_of_all_shifts(seed: int, cols: int, n: int, step: tuple[int, int]) -> None:
    mask = np.random.default_rng(seed).random((12, cols)) < 0.02
    canvas = Canvas.of(mask, n)
    canvas.spread(n, *step)
    expected = np.zeros_like(mask)
    for r, c in np.argwhere(mask):
        for k in range(-n, n + 1):
            if 0 <= r + k * step[0] < 12 and 0 <= c + k * step[1] < cols:
                expected[r + k * step[0], c + k * step[1]] = True
    np.testing.assert_array_equal(canvas.mask(), expected)


@settings(max_examples=20, deadline=None)
@given(rows=st.integers(1, 5), cols=st.integers(1, 140), border=st.integers(0, 70))
def test_only_the_outside_is_set(rows: int, cols: int, border: int) -> None:
    of_nothing = Canvas.of(np.zeros((rows, cols), dtype=np.bool_), border, outside=True)
    np.testing.assert_array_equal(Canvas.outside((rows, cols), border).words, of_nothing.words)
    assert not Canvas.outside((rows, cols), border).mask().any()
