from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from rille.stages.numeric.relaxation import bend_weights, relax


def scene(shape: tuple[int, int], count: int) -> tuple[np.ndarray, ...]:
    """Fields with unknown cells, the data's terms, weights of bends, and the cells that move."""
    rng = np.random.default_rng(shape[0] + count)
    start = rng.normal(size=(count, *shape)).astype(np.float32)
    start[:, rng.random(shape) < 0.1] = np.nan
    keep = np.isfinite(start[0]) & (rng.random(shape) < 0.9)
    half = rng.normal(size=(count, count, *shape))
    power = np.where(keep, np.einsum("ik...,jk...->ij...", half, half), 0.0).astype(np.float32)
    pull = np.where(keep, rng.normal(size=start.shape), 0.0).astype(np.float32)
    return start, power, pull, bend_weights(start, np.ones(shape, np.float32), 2.0, 0.7), keep


def minimum(start: np.ndarray, power: np.ndarray, pull: np.ndarray, bends: tuple, keep: np.ndarray) -> np.ndarray:
    """The least-squares solution by a sparse direct solver."""
    count, rows, cols = start.shape
    number = np.arange(rows * cols).reshape(rows, cols)
    whole = scipy.sparse.lil_array((count * rows * cols,) * 2)
    f = np.nan_to_num(start).reshape(count, -1)
    for weight, (i, j) in zip(bends, ((0, 1), (1, 0)), strict=True):
        for r, c in np.argwhere(weight > 0):
            for k in range(count):
                three = k * rows * cols + np.array([number[r - i, c - j], number[r, c], number[r + i, c + j]])
                whole[np.ix_(three, three)] += float(weight[r, c]) * np.outer([1, -2, 1], [1, -2, 1])
    right = -(whole @ f.ravel())
    for k in range(count):
        right[k * rows * cols :][: rows * cols] += pull[k].ravel()
        for m in range(count):
            whole += scipy.sparse.kron(
                scipy.sparse.coo_array(([1.0], ([k], [m])), shape=(count, count)),
                scipy.sparse.diags_array(power[k, m].ravel()),
            )
    free = np.flatnonzero(np.broadcast_to(keep, start.shape).ravel() & (whole.diagonal() > 0))
    moved = f.ravel().astype(float)
    moved[free] += scipy.sparse.linalg.spsolve(scipy.sparse.csc_array(whole)[:, free][free], right[free])
    return np.where(keep, moved.reshape(start.shape), start)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("shape", [(9, 14), (14, 9), (1, 12), (12, 1), (3, 3)])
def test_many_sweeps_reach_the_minimum(shape: tuple[int, int], count: int) -> None:
    start, power, pull, bends, keep = scene(shape, count)
    power += np.where(keep, 0.1, 0.0) * np.eye(count)[..., None, None]
    power = power.astype(np.float32)
    found = relax(start, power, pull, bends, keep, 400)
    np.testing.assert_allclose(found, minimum(start, power, pull, bends, keep), rtol=1e-3, atol=1e-3)
    assert np.array_equal(found[:, ~keep], start[:, ~keep], equal_nan=True)


def test_passes_in_one_go_are_passes_one_after_the_other() -> None:
    start, power, pull, bends, keep = scene((23, 17), 1)
    once = relax(start, power, pull, bends, keep, 2)
    first = relax(start, power, pull, bends, keep, 1)
    # The second sweep from where the first ended: the data's pull is about the new start.
    again = relax(first, power, pull - np.nan_to_num(power[:, 0] * (first - start)), bends, keep, 1)
    np.testing.assert_allclose(once, again, atol=1e-5)


def test_weights_of_bends_are_those_of_the_equation() -> None:
    rng = np.random.default_rng(11)
    fields, scale = rng.normal(size=(2, 12, 15)).astype(np.float32), rng.uniform(1.0, 2.0, (12, 15)).astype(np.float32)
    fields[:, 5, 6] = np.nan
    for found, axis in zip(bend_weights(fields, scale, 0.5, 3.0), (1, 0), strict=True):
        bend = np.linalg.norm(np.roll(fields, 1, axis + 1) - 2.0 * fields + np.roll(fields, -1, axis + 1), axis=0)
        weight = 3.0 * scale**2 / (1.0 + (scale * bend / 0.5) ** 2)
        expected = np.moveaxis(np.where(np.isfinite(weight), weight, 0.0), axis, 0)
        expected[[0, -1]] = 0.0
        np.testing.assert_allclose(np.moveaxis(found, axis, 0), expected, rtol=1e-4)
