"""Rasters in the geometry of the left image, against planes and a sphere."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.geometry.geometry import Camera
from rille.stages.terrain.camera_products import NORMAL_SIDE_PX, camera_products
from rille.stages.terrain.points import PairPoints

CAMERA = Camera(200.0, 210.0, 50.0, 38.0, 100, 80)


def seen(depth: np.ndarray, keep: np.ndarray) -> PairPoints:
    """Points of the pixels of ``keep`` at a depth (row, col)."""
    row, column = np.nonzero(keep)
    pixel = np.stack([column, row], 1)
    position = CAMERA.rays(pixel.astype(float)) * depth[row, column][:, None]
    sigma = np.linspace(0.01, 0.02, len(pixel)).astype(np.float32)
    return PairPoints(position, sigma, sigma, pixel.astype(np.int32))


def rays() -> np.ndarray:
    y, x = np.indices((CAMERA.height, CAMERA.width))
    return CAMERA.rays(np.stack([x, y], -1).reshape(-1, 2).astype(float)).reshape(*x.shape, 3)


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.1, -0.9, -0.3), (0.6, 0.2, -0.5)])
def test_a_plane_has_its_normal_and_no_roughness(normal: tuple[float, float, float]) -> None:
    normal = np.array(normal) / np.linalg.norm(normal)
    # normal . X = -2 at two metres.
    depth = -2.0 / (rays() @ normal)
    keep = np.random.default_rng(0).random(depth.shape) < 0.7
    keep &= depth > 0
    found = camera_products(seen(depth, keep), CAMERA)
    np.testing.assert_array_equal(np.isfinite(found.distance), keep)
    np.testing.assert_allclose(found.distance[keep], (np.linalg.norm(rays(), axis=2) * depth)[keep], rtol=1e-5)
    known = np.isfinite(found.roughness)
    inner = (
        keep[NORMAL_SIDE_PX:-NORMAL_SIDE_PX, NORMAL_SIDE_PX:-NORMAL_SIDE_PX]
        & (depth > 0)[NORMAL_SIDE_PX:-NORMAL_SIDE_PX, NORMAL_SIDE_PX:-NORMAL_SIDE_PX]
    )
    assert known[NORMAL_SIDE_PX:-NORMAL_SIDE_PX, NORMAL_SIDE_PX:-NORMAL_SIDE_PX][inner].mean() > 0.95
    np.testing.assert_allclose(found.normal[known], np.broadcast_to(normal, (known.sum(), 3)), atol=2e-3)
    assert found.roughness[known].max() < 1e-3


def test_roughness_is_the_deviation_from_the_plane() -> None:
    depth = 3.0 + 0.01 * np.random.default_rng(1).standard_normal((CAMERA.height, CAMERA.width))
    found = camera_products(seen(depth, np.ones(depth.shape, bool)), CAMERA)
    assert np.nanmedian(found.roughness) == pytest.approx(0.01, rel=0.05)


def test_few_matches_or_those_on_a_line_have_no_normal() -> None:
    depth, keep = np.full((CAMERA.height, CAMERA.width), 2.0), np.zeros((CAMERA.height, CAMERA.width), bool)
    keep[40, :], keep[5:8, 5:8] = True, True
    found = camera_products(seen(depth, keep), CAMERA)
    assert np.isfinite(found.distance).sum() == keep.sum()
    assert not np.isfinite(found.normal).any()
    assert not np.isfinite(found.roughness).any()
