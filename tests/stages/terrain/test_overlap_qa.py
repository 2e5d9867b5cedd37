"""Plane of a difference: exact without noise, and robust against rocks."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.terrain.overlap_qa import fit_seam

X, Y = 0.01 * np.arange(90), -0.01 * np.arange(70)


def plane(bias: float, tx: float, ty: float) -> np.ndarray:
    return bias + tx * (X - X.mean()) + ty * (Y[:, None] - Y.mean())


def test_a_plane_is_found_exactly() -> None:
    fit = fit_seam(plane(0.002, 0.01, -0.02), X, Y)
    assert fit is not None
    np.testing.assert_allclose(fit.bias, 0.002, atol=1e-12)
    np.testing.assert_allclose(fit.tilt, [0.01, -0.02], atol=1e-10)
    assert fit.noise < 1e-12
    assert fit.systematic == pytest.approx(np.sqrt((plane(0.002, 0.01, -0.02) ** 2).mean()), rel=1e-9)


def test_rocks_that_one_model_lacks_do_not_pull() -> None:
    rng = np.random.default_rng(1)
    d = plane(0.002, 0.01, -0.02) + rng.normal(0, 1e-4, (70, 90))
    d[10:30, 10:40] += 0.5  # a tenth of the overlap
    fit = fit_seam(d, X, Y)
    assert fit is not None
    np.testing.assert_allclose(fit.bias, 0.002, atol=1e-5)
    np.testing.assert_allclose(fit.tilt, [0.01, -0.02], atol=1e-4)
    assert fit.noise == pytest.approx(1e-4, rel=0.2)


def test_too_little_ground_gives_nothing() -> None:
    assert fit_seam(np.full((70, 90), np.nan), X, Y) is None
    few = np.full((70, 90), np.nan)
    few[:9, :9] = 0.0
    assert fit_seam(few, X, Y) is None
    few[:9, :12] = 0.0
    assert fit_seam(few, X, Y) is not None
