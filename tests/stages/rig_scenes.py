"""Correspondences of known rigs: ground and walls seen from a street, and a bed seen by a convergent rig."""

from __future__ import annotations

import math

import numpy as np

from rille.stages.calibration.relative_orientation import PointPairs
from rille.stages.geometry.epipolar import corrected
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp


def street_rig() -> Rig:
    """Parallel, looks far: 81 degrees across, 0.54 m."""
    camera = Camera(707.0, 707.0, 602.0, 183.0, 1226, 370)
    return Rig(camera, camera, RigidTransform(np.eye(3), np.array([-0.54, 0.0, 0.0])))


def bed_rig() -> Rig:
    """Both cameras turned in by 5 degrees, 97 mm apart."""
    camera = Camera(600.0, 600.0, 284.5, 259.5, 570, 520)
    half = rotation_exp([0.0, math.radians(5.0), 0.0])
    rotation = half.T @ half.T
    return Rig(camera, camera, RigidTransform(rotation, -rotation @ half.T @ np.array([0.097, 0.0, 0.0])))


def street_depth(rays: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ground 1.65 m below, walls 7 m to either side, and things in the way."""
    with np.errstate(divide="ignore"):
        ground = np.where(rays[:, 1] > 0, 1.65 / rays[:, 1], np.inf)
        walls = 7.0 / np.abs(rays[:, 0])
    return np.minimum(np.minimum(ground, walls), rng.uniform(8.0, 80.0, len(rays)))


def bed_depth(rays: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ground 0.18 m below a camera pitched down by 18 degrees, with 10 mm of relief; far part cut at 2 m."""
    pitch = math.radians(18.0)
    down = rays[:, 1] * math.cos(pitch) + math.sin(pitch)
    height = 0.18 + 0.01 * rng.standard_normal(len(rays))
    with np.errstate(divide="ignore"):
        return np.where(down > 0.09, height / down, np.inf)


def matches(rig, depth, *, noise=0.2, seed=0, pair=0, samples=1200, outliers=0.0, field=None) -> PointPairs:
    """Matches of the images that ``rig`` takes; ``field(u, v)`` is a row error over the image, -1..1 either way."""
    rng = np.random.default_rng([seed, pair])
    side = math.sqrt(rig.left.width * rig.left.height / samples)
    c, r = np.meshgrid(np.arange(side / 2, rig.left.width, side), np.arange(side / 2, rig.left.height, side))
    left = np.floor(np.stack([c, r], -1).reshape(-1, 2))
    rays = rig.left.rays(left)
    z = depth(rays, rng)
    seen = np.isfinite(z)
    left, points = left[seen], rays[seen] * z[seen, None]
    right = rig.right.project(rig.T_right_left.apply(points)) + noise * rng.standard_normal((len(points), 2))
    if field is not None:
        u, v = 2 * left[:, 0] / (rig.left.width - 1) - 1, 2 * left[:, 1] / (rig.left.height - 1) - 1
        right[:, 1] += field(u, v)
    inside = ((right >= 0) & (right <= [rig.right.width - 1, rig.right.height - 1])).all(-1)
    left, right = left[inside], right[inside]
    wrong = rng.random(len(left)) < outliers
    right[wrong] += rng.uniform(-30, 30, (int(wrong.sum()), 2))
    return PointPairs(pair, left, right)


def knocked(rig: Rig, pitch_deg=0.0, yaw_deg=0.0, roll_deg=0.0, across_deg=0.0, forward_deg=0.0) -> Rig:
    """The rig after a knock: what the images show, while ``rig`` is what is given."""
    return corrected(rig, np.radians([pitch_deg, yaw_deg, roll_deg, across_deg, forward_deg]))
