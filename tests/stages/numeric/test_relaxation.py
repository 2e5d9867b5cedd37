from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from rille.stages.numeric.relaxation import bend_weights, relax


def scene(shape: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Field with unknown cells, the data's terms, weights of bends, and the cells that move."""
    rng = np.random.default_rng(shape[0])
    start = rng.normal(size=shape).astype(np.float32)
    start[rng.random(shape) < 0.1] = np.nan
    keep = np.isfinite(start) & (rng.random(shape) < 0.9)
    power = np.where(keep, np.square(rng.normal(size=shape)), 0.0).astype(np.float32)
    pull = np.where(keep, rng.normal(size=shape), 0.0).astype(np.float32)
    return start, power, pull, bend_weights(start, np.ones(shape, np.float32), 2.0, 0.7), keep


def minimum(start: np.ndarray, power: np.ndarray, pull: np.ndarray, bends: tuple, keep: np.ndarray) -> np.ndarray:
    """The least-squares solution by a sparse direct solver."""
    number = np.arange(start.size).reshape(start.shape)
    whole = scipy.sparse.lil_array((start.size,) * 2)
    f = np.nan_to_num(start).ravel()
    for weight, (i, j) in zip(bends, ((0, 1), (1, 0)), strict=True):
        for r, c in np.argwhere(weight > 0):
            three = np.array([number[r - i, c - j], number[r, c], number[r + i, c + j]])
            whole[np.ix_(three, three)] += float(weight[r, c]) * np.outer([1, -2, 1], [1, -2, 1])
    right = pull.ravel() - whole @ f
    whole += scipy.sparse.diags_array(power.ravel())
    free = np.flatnonzero(keep.ravel() & (whole.diagonal() > 0))
    moved = f.astype(float)
    moved[free] += scipy.sparse.linalg.spsolve(scipy.sparse.csc_array(whole)[:, free][free], right[free])
    return np.where(keep, moved.reshape(start.shape), start)


@pytest.mark.parametrize("shape", [(9, 14), (14, 9), (1, 12), (12, 1), (3, 3)])
def test_many_sweeps_reach_the_minimum(shape: tuple[int, int]) -> None:
    start, power, pull, bends, keep = scene(shape)
    power = (power + np.where(keep, 0.1, 0.0)).astype(np.float32)
    relaxed = relax(start, power, pull, bends, keep, 400)
    np.testing.assert_allclose(relaxed, minimum(start, power, pull, bends, keep), rtol=1e-3, atol=1e-3)
    assert np.array_equal(relaxed[~keep], start[~keep], equal_nan=True)


def test_passes_in_one_go_are_passes_one_after_the_other() -> None:
    start, power, pull, bends, keep = scene((23, 17))
    once = relax(start, power, pull, bends, keep, 2)
    first = relax(start, power, pull, bends, keep, 1)
    # The second sweep from where the first ended: the data's pull is about the new start.
    again = relax(first, power, pull - np.nan_to_num(power * (first - start)), bends, keep, 1)
    np.testing.assert_allclose(once, again, atol=1e-5)


def test_weights_of_bends_are_those_of_the_equation() -> None:
    rng = np.random.default_rng(11)
    field, scale = rng.normal(size=(12, 15)).astype(np.float32), rng.uniform(1.0, 2.0, (12, 15)).astype(np.float32)
    field[5, 6] = np.nan
    for weights, axis in zip(bend_weights(field, scale, 0.5, 3.0), (1, 0), strict=True):
        bend = np.abs(np.roll(field, 1, axis) - 2.0 * field + np.roll(field, -1, axis))
        weight = 3.0 * scale**2 / (1.0 + (scale * bend / 0.5) ** 2)
        expected = np.moveaxis(np.where(np.isfinite(weight), weight, 0.0), axis, 0)
        expected[[0, -1]] = 0.0
        np.testing.assert_allclose(np.moveaxis(weights, axis, 0), expected, rtol=1e-4)
