"""Blocks of an elevation model against a look at every cell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rille.stages.hazard.block_statistics import reduce_to_blocks


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 999), rows=st.integers(1, 23), cols=st.integers(1, 23), n=st.integers(1, 5))
@example(seed=1, rows=3, cols=1100, n=5)  # wider than a strip
def test_blocks_equal_a_look_at_every_cell(seed: int, rows: int, cols: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    closed, std = rng.normal(size=(rows, cols)).astype(np.float32), rng.random((rows, cols)).astype(np.float32)
    closed[rng.random(closed.shape) < 0.2] = np.nan
    z = np.where(rng.random(closed.shape) < 0.2, np.float32(np.nan), closed)
    lag = int(rng.integers(1, 8))
    found = reduce_to_blocks(z, closed, std, n, lag)
    assert found.high.shape == (-(-rows // n), -(-cols // n))
    for i, j in np.ndindex(found.high.shape):
        part = np.s_[i * n : i * n + n, j * n : j * n + n]
        inside, known = z[part][~np.isnan(z[part])], ~np.isnan(closed[part])
        np.testing.assert_array_equal(found.high[i, j], inside.max() if inside.size else np.nan)
        np.testing.assert_array_equal(found.low[i, j], inside.min() if inside.size else np.nan)
        assert found.known[i, j] == known.sum()
        assert found.variance[i, j] == pytest.approx((std[part][known].astype(float) ** 2).sum(), rel=1e-6)
        apart = [
            float(z[r, c]) - float(z[r + dr, c + dc])
            for r in range(i * n, min(i * n + n, rows))
            for c in range(j * n, min(j * n + n, cols))
            for dr, dc in ((lag, 0), (-lag, 0), (0, lag), (0, -lag))
            if 0 <= r + dr < rows and 0 <= c + dc < cols
        ]
        apart = [d for d in apart if not np.isnan(d)]
        assert found.pairs[i, j] == len(apart)
        assert found.deviation[i, j] == pytest.approx(sum(d * d for d in apart), rel=1e-5)
