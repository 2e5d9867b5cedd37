"""Analytic scenes seen by an unrectified rig: exact disparity by meeting rays with surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, level_rotation, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.merge import EXACT, Placed

SIZE = (240, 320)


@dataclass(frozen=True)
class ArrayLayer:
    """A model to merge, its arrays (rows, cols) in memory; see :class:`rille.stages.terrain.merge.ModelLayer`."""

    pair: int
    lattice: Lattice
    elevation: np.ndarray
    elevation_std: np.ndarray
    ortho: np.ndarray
    gain: float = 1.0
    pose: Placed = EXACT

    def part(self, name: str, window: tuple[slice, slice]) -> np.ndarray:
        return getattr(self, name)[window]


def toed_in_rig() -> Rig:
    """Two different cameras: right toed in 4 degrees, rolled 1.5, row offset 8 px, another focal length."""
    left = Camera(300.0, 300.0, 159.5, 119.5, SIZE[1], SIZE[0])
    right = Camera(310.0, 308.0, 160.5, 127.5, SIZE[1], SIZE[0])
    R = rotation_exp([0.0, 0.0, math.radians(1.5)]) @ rotation_exp([0.0, math.radians(4.0), 0.0])
    return Rig(left, right, RigidTransform(R, -R @ np.array([0.1, 0.004, -0.003])))


def pitched(pitch_deg: float, roll_deg: float = 0.0) -> RigidTransform:
    """T_local_left of a camera that looks down by ``pitch_deg`` and is rolled."""
    p, r = math.radians(pitch_deg), math.radians(roll_deg)
    up = np.array([-math.sin(r) * math.cos(p), -math.cos(r) * math.cos(p), -math.sin(p)])
    return RigidTransform(level_rotation(up), np.zeros(3))


Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Distance along rays: (origin (3,), directions (n, 3)) -> (n,), inf where the ray misses."""


def plane(a: float, b: float, c: float) -> Distance:
    """z = c + a x + b y."""

    def meet(o: np.ndarray, v: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (c + a * o[0] + b * o[1] - o[2]) / (v[:, 2] - a * v[:, 0] - b * v[:, 1])
        return np.where(t > 0, t, np.inf)

    return meet


def ball(centre: tuple[float, float, float], radius: float) -> Distance:
    def meet(o: np.ndarray, v: np.ndarray) -> np.ndarray:
        oc = o - np.array(centre)
        a, b, c = (v**2).sum(1), v @ oc, oc @ oc - radius**2
        with np.errstate(invalid="ignore"):
            t = (-b - np.sqrt(b * b - a * c)) / a
        return np.where(t > 0, t, np.inf)

    return meet


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Distance:
    """Axis-parallel box (slab method)."""

    def meet(o: np.ndarray, v: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            t = np.stack([(np.array(low) - o) / v, (np.array(high) - o) / v])
        enter, leave = t.min(0).max(1), t.max(0).min(1)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)

    return meet


def nearest(*parts: Distance) -> Distance:
    return lambda o, v: np.min([part(o, v) for part in parts], axis=0)


def disparity(rig: Rig, T_scene_left: RigidTransform, scene: Distance) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact column and row disparity (float64) and whether both cameras see the point, (rows, cols)."""
    cols, rows = np.meshgrid(np.arange(rig.left.width), np.arange(rig.left.height))
    pixels = np.stack([cols, rows], -1).reshape(-1, 2).astype(float)
    o = T_scene_left.translation
    v = rig.left.rays(pixels) @ T_scene_left.rotation.T
    t = scene(o, v)
    points = o + np.where(np.isfinite(t), t, 1.0)[:, None] * v
    T_right_scene = rig.T_right_left @ T_scene_left.inverse()
    right = rig.right.project(T_right_scene.apply(points))
    o_right = T_right_scene.inverse().translation
    hidden = scene(o_right, points - o_right) < 1.0 - 1e-6
    inside = ((right >= 0) & (right <= [rig.right.width - 1, rig.right.height - 1])).all(-1)
    seen = np.isfinite(t) & inside & ~hidden
    d = np.where(np.isfinite(t)[:, None], right - pixels, np.nan).reshape(*cols.shape, 2)
    return d[..., 0], d[..., 1], seen.reshape(cols.shape)


def interpolation_error(*maps: np.ndarray) -> float:
    """Bound of bilinear interpolation in pixels: an eighth of the second derivatives, of both axes and components."""
    return float(sum(np.nanmax(np.abs(np.diff(m, 2, axis=axis))) / 8 for m in maps for axis in (0, 1)))


def smooth_noise(shape: tuple[int, int], sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Normal noise of standard deviation ``sigma``, correlated over a few pixels as matched disparities are."""
    n = rng.normal(size=shape)
    for axis in (0, 1):
        n = sum(np.roll(n, k, axis) * w for k, w in zip(range(-3, 4), (1, 4, 8, 10, 8, 4, 1), strict=True))
    return sigma * n / n.std()
