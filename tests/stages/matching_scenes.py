"""Images with exactly known displacements: a sum of waves can be evaluated at any sub-pixel position."""

from __future__ import annotations

import numpy as np

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp


class Texture:
    """Band-limited texture on the plane, grey level about 128 +- 35; wavelengths 5 to 60 pixels."""

    def __init__(self, seed=0, waves=80):
        rng = np.random.default_rng(seed)
        length = np.exp(rng.uniform(np.log(5.0), np.log(60.0), waves))
        angle, self.phase = rng.uniform(0, 2 * np.pi, (2, waves))
        self.kx, self.ky = 2 * np.pi / length * np.cos(angle), 2 * np.pi / length * np.sin(angle)
        self.amplitude = 35.0 * np.sqrt(2.0 / waves)

    def __call__(self, x, y):
        total = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, p in zip(self.kx, self.ky, self.phase, strict=True):
            total += np.sin(kx * x + ky * y + p)
        return (128 + self.amplitude * total).astype(np.float32)


def pair(displacement, shape=(140, 180), right_shape=None, seed=0, noise=0.0):
    """Left and right image where ``left(x) = right(x + d(x))``; ``displacement(x, y) -> (u, v)``; and u, v."""
    texture = Texture(seed)
    y, x = np.indices(shape, dtype=np.float64)
    u, v = np.broadcast_arrays(*displacement(x, y), x)[:2]
    yr, xr = np.indices(right_shape or shape, dtype=np.float64)
    left, right = texture(x + u, y + v), texture(xr, yr)
    rng = np.random.default_rng(seed + 1)
    if noise:
        left, right = (a + rng.normal(0, noise, a.shape).astype(np.float32) for a in (left, right))
    return left, right, u, v


def seen(u, v, right_shape, border=0):
    """Pixels whose true match lies inside the right image, ``border`` pixels away from every edge of both."""
    y, x = np.indices(u.shape)
    rows, cols = right_shape
    inside = (x + u >= border) & (x + u <= cols - 1 - border) & (y + v >= border) & (y + v <= rows - 1 - border)
    return inside & (x >= border) & (x < u.shape[1] - border) & (y >= border) & (y < u.shape[0] - border)


def convergent_rig(width=180, height=140, toe_in_deg=5.0):
    """Rig with both cameras turned inwards, baseline 0.1 m along the rows, focal length about the image width."""
    camera = Camera(200.0, 200.0, (width - 1) / 2, (height - 1) / 2, width, height)
    rotation = rotation_exp([0.0, -2 * np.radians(toe_in_deg), 0.0]).T
    half = rotation_exp([0.0, np.radians(toe_in_deg), 0.0])
    centre = half.T @ np.array([0.1, 0.0, 0.0])
    return Rig(camera, camera, RigidTransform(rotation, -rotation @ centre))


def rig_displacement(rig, depth):
    """``displacement`` for :func:`pair` of a rig that sees ``depth(x, y)`` metres along the left optical axis."""

    def displacement(x, y):
        points = rig.left.rays(np.stack([x, y], -1)) * depth(x, y)[..., None]
        q = rig.right.project(rig.T_right_left.apply(points))
        return q[..., 0] - x, q[..., 1] - y

    return displacement
