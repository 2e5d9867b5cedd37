"""Ray casting against closed forms and a slow marching oracle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rille.datasets.mockup.raycast import HeightField
from rille.datasets.mockup.truth import visible
from rille.stages.geometry.geometry import Camera, RigidTransform


def bilinear(field: HeightField, x, y):
    c, r = (x - field.x0) / field.cell, (field.y0 - y) / field.cell
    j = np.clip(c.astype(int), 0, field.height.shape[1] - 2)
    i = np.clip(r.astype(int), 0, field.height.shape[0] - 2)
    u, v, h = r - i, c - j, field.height.astype(np.float64)
    top = (1 - v) * h[i, j] + v * h[i, j + 1]
    return (1 - u) * top + u * ((1 - v) * h[i + 1, j] + v * h[i + 1, j + 1])


def rough_field(seed: int, rows=23, cols=31) -> HeightField:
    height = 0.3 * np.random.default_rng(seed).standard_normal((rows, cols)).astype(np.float32)
    return HeightField.build(height, -1.5, 1.1, 0.1)


def test_plane_is_met_where_the_closed_form_says():
    x = -1.0 + 0.25 * np.arange(9)
    y = 1.0 - 0.25 * np.arange(9)
    height = (0.25 * x[None, :] + 0.5 * y[:, None]).astype(np.float32)  # dyadic: exact in float32
    field = HeightField.build(height, -1.0, 1.0, 0.25)
    directions = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, -1.0], [-0.3, 0.0, -2.0], [0.0, 0.5, -1.0]])
    origin = np.array([[0.05, -0.1, 2.0]])
    slope = directions @ np.array([0.25, 0.5, -1.0])
    expected = -(origin[0] @ np.array([0.25, 0.5, -1.0])) / slope
    np.testing.assert_allclose(field.cast(origin, directions), expected, rtol=1e-12)


def test_rays_that_miss_give_nan():
    field = HeightField.build(np.zeros((5, 5), np.float32), 0.0, 4.0, 1.0)
    origin = np.array([[2.0, 2.0, 1.0]])
    up, past, level = [0.0, 0.0, 1.0], [5.0, 0.0, -0.1], [1.0, 0.0, 0.0]
    assert np.isnan(field.cast(origin, np.array([up, past, level]))).all()
    # through the side of a raised bed: the ray enters the outline below the surface
    raised = HeightField.build(np.ones((5, 5), np.float32), 0.0, 4.0, 1.0)
    assert np.isnan(raised.cast(np.array([[-1.0, 2.0, 0.5]]), np.array([[1.0, 0.0, 0.0]])))[0]


def test_what_lies_behind_the_side_of_the_bed_is_hidden():
    height = np.zeros((11, 11), np.float32)
    height[-1] = 0.1  # the near edge, y = 0
    field = HeightField.build(height, -0.5, 1.0, 0.1)
    camera = Camera(100.0, 100.0, 99.5, 99.5, 200, 200)
    looking_ahead = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    points = np.array([[0.0, 0.5, 0.0], [0.02, 0.9, 0.0]])
    for z, seen in ((0.05, False), (0.3, True)):
        T = RigidTransform(looking_ahead, np.array([0.0, -0.2, z]))
        _, inside, free = visible(field, camera, T, points)
        assert inside.all()
        assert (free == seen).all()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
@example(203)  # in through the side, a step before the first sample inside
def test_hits_lie_on_the_surface_and_nothing_stands_before_them(seed):
    field = rough_field(seed)
    rng = np.random.default_rng(seed + 1)
    origins = rng.uniform([-2.5, -2.0, 1.5], [2.5, 2.0, 2.5], (40, 3))
    aims = rng.uniform([-1.5, -1.1, -0.3], [1.5, 1.1, 0.3], (40, 3))
    directions = aims - origins
    t = field.cast(origins, directions)
    steps, half = np.linspace(0.0, 3.0, 6001), np.array([1.5, 1.1])
    for o, d, hit in zip(origins, directions, t, strict=True):
        p = o + steps[:, None] * d
        inside = (p[:, 0] >= -1.5) & (p[:, 0] <= 1.5) & (p[:, 1] >= -1.1) & (p[:, 1] <= 1.1)
        gap = np.where(inside, p[:, 2] - bilinear(field, p[:, 0], p[:, 1]), np.inf)
        first = o + d * np.minimum((-half - o[:2]) / d[:2], (half - o[:2]) / d[:2]).max().clip(0.0)  # into the outline
        if not inside.any() or first[2] < bilinear(field, first[:1], first[1:2])[0]:
            continue  # beside the bed, or in through its side
        below = np.flatnonzero(gap < 0)
        if np.isfinite(hit):
            q = o + hit * d
            assert abs(q[2] - bilinear(field, q[:1], q[1:2])[0]) < 1e-6
            assert not len(below) or hit <= steps[below[0]] + 1e-9
        else:
            # marching cannot have found a crossing well inside the bed either
            assert not len(below)


@pytest.mark.parametrize("tilt", [0.0, 1e-17, 1e-14, 1e-9, 1e-7, 1e-6, 1e-4, 1e-2])
def test_nearly_vertical_rays_through_nodes_find_the_surface(tilt):
    """Cell centres of a DEM often lie on the bed's nodes, and a level frame is so but for rounding."""
    height = 0.3 * np.random.default_rng(5).standard_normal((23, 31)).astype(np.float32)
    field = HeightField.build(height, -2.0, 1.5, 0.125)  # dyadic: nodes are met exactly
    x, y = np.meshgrid(-2.0 + 0.125 * np.arange(1, 30), 1.5 - 0.125 * np.arange(1, 22))
    for sign in ([1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [0.0, -1.0]):
        down = np.tile([*(tilt * np.array(sign)), -1.0], (x.size, 1))
        tops = np.stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)], axis=1)
        points = tops + field.cast(tops, down)[:, None] * down
        # 1e-6: drift of a ray taken for vertical, 3e-7 m, times slopes of up to 10
        np.testing.assert_allclose(points[:, 2], bilinear(field, points[:, 0], points[:, 1]), rtol=0, atol=3e-6)


@pytest.mark.parametrize("shape", [(2, 2), (2, 7), (6, 3)])
def test_every_size_of_grid_is_covered(shape):
    field = HeightField.build(np.zeros(shape, np.float32), 0.0, float(shape[0] - 1), 1.0)
    x, y = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    tops = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1).astype(float)
    down = np.tile([0.0, 0.0, -1.0], (x.size, 1))
    np.testing.assert_allclose(field.cast(tops, down), 1.0)
