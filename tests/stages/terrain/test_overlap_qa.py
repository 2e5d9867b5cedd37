"""Plane of a difference: exact without noise, robust against rocks, and its sigma is that of many draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rille.stages.terrain.overlap_qa import SeamFit, fit_seam

X, Y = 0.01 * np.arange(90), -0.01 * np.arange(70)


def plane(bias: float, tx: float, ty: float) -> np.ndarray:
    return bias + tx * (X - 0.4) + ty * (Y[:, None] + 0.3)


def at(fit: SeamFit) -> float:
    return float(fit.plane @ [1.0, 0.4 - fit.centre[0], -0.3 - fit.centre[1]])


def test_a_plane_is_found_exactly() -> None:
    fit = fit_seam(plane(0.002, 0.01, -0.02), X, Y)
    assert fit is not None
    np.testing.assert_allclose(at(fit), 0.002, atol=1e-12)
    np.testing.assert_allclose(fit.plane[1:], [0.01, -0.02], atol=1e-10)
    assert fit.noise < 1e-12
    assert fit.systematic == pytest.approx(np.sqrt((plane(0.002, 0.01, -0.02) ** 2).mean()), rel=1e-9)


def test_rocks_that_one_model_lacks_do_not_pull() -> None:
    rng = np.random.default_rng(1)
    d = plane(0.002, 0.01, -0.02) + rng.normal(0, 1e-4, (70, 90))
    d[10:30, 10:40] += 0.5  # a tenth of the overlap
    fit = fit_seam(d, X, Y)
    assert fit is not None
    np.testing.assert_allclose(at(fit), 0.002, atol=1e-5)
    np.testing.assert_allclose(fit.plane[1:], [0.01, -0.02], atol=1e-4)
    assert fit.noise == pytest.approx(1e-4, rel=0.2)


@pytest.mark.parametrize("alike", [0.0, 2.0])
def test_sigma_is_that_of_many_draws(alike: float) -> None:
    """Also where the errors of neighbours are alike: that of independent cells is several times too small there.

    Of 60 draws the scatter is known to a tenth; of some hundred independent patches, a quarter is lost with the plane.
    """
    rng, scores, naive = np.random.default_rng(2), [], []
    for _ in range(60):
        noise = rng.normal(size=(70, 90))
        noise = gaussian_filter(noise, alike) if alike else noise
        noise *= 1e-3 / noise.std()
        noise[rng.random(noise.shape) < 0.3] = np.nan
        fit = fit_seam(noise, X, Y)
        assert fit is not None
        scores.append(fit.plane / np.sqrt(np.diag(fit.covariance)))
        naive.append(fit.plane[0] / (1e-3 / np.sqrt(np.isfinite(noise).sum())))
    assert (np.std(scores, axis=0) < 1.5).all()
    assert (np.std(scores, axis=0) > 0.7).all()
    assert alike == 0 or np.std(naive) > 4


def test_too_little_ground_gives_nothing() -> None:
    assert fit_seam(np.full((70, 90), np.nan), X, Y) is None
    few = np.full((70, 90), np.nan)
    few[:9, :9] = 0.0
    assert fit_seam(few, X, Y) is None
    few[:9, :12] = 0.0  # 108 cells are enough for a median, three by four blocks for a plane
    assert fit_seam(few, X, Y) is not None
