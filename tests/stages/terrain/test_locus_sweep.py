from __future__ import annotations

import numpy as np
import pytest

from rille.stages.terrain.locus.sweep import Terms, diagonals, sweep


def reading_order(power, pull, keep, across, down, start, z, sweeps, overshoot):  # type: ignore[no-untyped-def]
    """The same sweeps cell by cell, row after row, as the minimum's own equations say."""
    rows, cols = z.shape
    for _ in range(sweeps):
        for r in range(rows):
            for c in range(cols):
                if not keep[r, c]:
                    continue
                total, wanted = power[r, c], power[r, c] * start[r, c] + pull[r, c]
                for weight, i, j in ((across, 0, 1), (down, 1, 0)):
                    for middle in (-1, 0, 1):  # the second difference about each cell that this one takes part in
                        y, x = r + middle * i, c + middle * j
                        if not (0 <= y < rows and 0 <= x < cols) or weight[y, x] == 0:
                            continue
                        a, b, d = z[y - i, x - j], z[y, x], z[y + i, x + j]
                        own = {-1: 1.0, 0: -2.0, 1: 1.0}[middle]
                        rest = (a - 2 * b + d) - own * z[r, c]
                        total += weight[y, x] * own * own
                        wanted -= weight[y, x] * own * rest
                if total > 0:
                    z[r, c] += overshoot * (wanted / total - z[r, c])


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-12), (np.float32, 1e-5)])
@pytest.mark.parametrize("shape", [(9, 14), (14, 9), (1, 12), (12, 1), (3, 3)])
def test_diagonals_give_what_reading_order_gives(shape: tuple[int, int], dtype: type, tolerance: float) -> None:
    rng = np.random.default_rng(shape[0])
    z = rng.normal(size=shape)
    z[rng.random(shape) < 0.1] = np.nan
    keep = np.isfinite(z) & (rng.random(shape) < 0.9)
    weights = []
    for axis in (1, 0):
        weight = np.zeros(shape)
        second = np.abs(np.diff(z, 2, axis=axis))
        inner = tuple(slice(1, -1) if k == axis else slice(None) for k in (0, 1))
        weight[inner] = np.where(np.isfinite(second), rng.uniform(0.5, 2.0, second.shape), 0.0)
        weights.append(weight * np.isfinite(z))
    power, pull = np.where(keep, rng.uniform(0, 1, shape), 0.0), np.where(keep, rng.normal(size=shape), 0.0)
    expected, found = z.copy(), z.copy()
    reading_order(power, pull, keep, *weights, z, expected, 5, 1.7)
    terms = Terms(power.astype(dtype), pull.astype(dtype), z, keep, *(weight.astype(dtype) for weight in weights))
    sweep(terms, found, 5, 1.7, diagonals(shape, dtype))
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)
    assert np.array_equal(found[~keep], z[~keep], equal_nan=True)
    if min(shape) > 1:
        assert np.abs(found - z)[keep].max() > 0.1
