"""Obstacle detection on exact displacements of a plane and a block: found where it stands, silent where none is new."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.driving.obstacle_monitor import (
    MIN_POINTS,
    MIN_RISE_WHEELS,
    LastModel,
    Obstacle,
    ObstacleMonitorParams,
    Points,
    ViewPair,
    look,
    obstacle,
    obstacle_monitor_stage,
    pairs,
)
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.vehicle import Vehicle

Floats = NDArray[np.float64]
ROVER = Vehicle(
    wheel_diameter=0.03, track=0.08, wheel_base=0.10, clearance=0.025, max_step=0.012, max_roughness=0.004, margin=0.01
)
CAMERA = Camera(180.0, 180.0, 159.5, 119.5, 320, 240)
HEIGHT, PITCH = 0.18, math.radians(32.0)
OPTICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
T_VEHICLE_LEFT = RigidTransform(rotation_exp([-PITCH, 0.0, 0.0]) @ OPTICAL, np.array([0.0, 0.05, HEIGHT]))
LATTICE = Lattice.snap((-0.3, 0.3, -0.1, 0.8), 0.004)
BLOCK = (0.01, 0.26, 0.02, 0.015)  # x, y, half a side, height: a wheel's radius


def at(y: float) -> RigidTransform:
    """Pose of the camera with the vehicle's centre at (0, y)."""
    return RigidTransform(np.eye(3), np.array([0.0, y, 0.0])) @ T_VEHICLE_LEFT


def hit(pose: RigidTransform, pixels: Floats, block: tuple[float, float, float, float] | None) -> Floats:
    """Where rays meet the plane z = 0, or the block's top or front side."""
    rays = CAMERA.rays(pixels) @ pose.rotation.T
    o = pose.translation
    points = o + (-o[2] / rays[:, 2])[:, None] * rays
    points[rays[:, 2] > -0.05] = np.nan
    if block is not None:
        x, y, half, h = block
        top = o + ((h - o[2]) / rays[:, 2])[:, None] * rays
        on_top = (np.abs(top[:, 0] - x) < half) & (np.abs(top[:, 1] - y) < half)
        front = o + ((y - half - o[1]) / rays[:, 1])[:, None] * rays
        on_front = (np.abs(front[:, 0] - x) < half) & (front[:, 2] > 0) & (front[:, 2] < h)
        points = np.where(on_front[:, None], front, np.where(on_top[:, None], top, points))
    return points


def view(y0: float, y1: float, block: tuple[float, float, float, float] | None, noise: float = 0.4) -> ViewPair:
    """Exact displacements of level 1 with noise, pixels of level 0."""
    rows, cols = 120, 160
    c, r = np.meshgrid((np.arange(cols) + 0.5) * 2 - 0.5, (np.arange(rows) + 0.5) * 2 - 0.5)
    pixels = np.column_stack([c.ravel(), r.ravel()])
    moved = CAMERA.project(at(y1).inverse().apply(hit(at(y0), pixels, block))) - pixels
    moved += noise * np.random.default_rng(5).standard_normal(moved.shape)
    known = np.isfinite(moved).all(axis=1).reshape(rows, cols)
    u, v = (moved[:, k].reshape(rows, cols).astype(np.float32) for k in (0, 1))
    return ViewPair(at(y0), at(y1), u, v, known, 1)


def surface(block: tuple[float, float, float, float] | None = None) -> LastModel:
    z = np.zeros(LATTICE.shape)
    if block is not None:
        xy = LATTICE.xy()
        z[(np.abs(xy[..., 0] - block[0]) < block[2]) & (np.abs(xy[..., 1] - block[1]) < block[2])] = block[3]
    return LastModel.of(z, LATTICE, 0.5 * ROVER.wheel_diameter)


def found(v: ViewPair, s: LastModel) -> Obstacle | None:
    return obstacle(look(v, s, CAMERA, T_VEHICLE_LEFT, ROVER), ROVER.wheel_diameter)


@pytest.mark.parametrize("y1", [0.05, 0.075])
def test_a_new_block_is_seen_where_it_stands(y1: float) -> None:
    seen = found(view(y1 - 0.05, y1, BLOCK), surface())
    assert seen is not None
    right, ahead = seen.place
    assert abs(right - BLOCK[0]) < BLOCK[2] + 0.01
    assert abs(ahead - (BLOCK[1] - y1)) < BLOCK[2] + 0.015


def test_clear_ground_is_silent_though_displacements_are_noisy() -> None:
    assert found(view(0.0, 0.05, None, noise=0.8), surface()) is None


def test_a_block_that_the_model_knows_is_silent() -> None:
    assert found(view(0.0, 0.05, BLOCK), surface(BLOCK)) is None


def test_a_block_lower_than_the_threshold_is_silent() -> None:
    low = (*BLOCK[:3], 0.5 * MIN_RISE_WHEELS * ROVER.wheel_diameter)
    assert found(view(0.0, 0.05, low), surface()) is None


def test_a_block_beside_the_way_is_not_watched() -> None:
    assert found(view(0.0, 0.05, (0.15, *BLOCK[1:])), surface()) is None


def test_rises_are_those_of_the_block() -> None:
    points = look(view(0.0, 0.05, BLOCK, noise=0.0), surface(), CAMERA, T_VEHICLE_LEFT, ROVER)
    up = points.rise[points.raised]
    # level-1 pixels straddle the block's edges; on its top the rise is exact
    assert np.percentile(up, 90) == pytest.approx(BLOCK[3], abs=0.001)
    flat = points.rise[np.abs(points.place[:, 0]) > 0.05]
    assert np.abs(flat).max() < 1e-4


def scattered(raised: int, flat: int, at: float = 0.2) -> Points:
    """So many points within a wheel's diameter, ``at`` metres ahead."""
    place = np.array([0.0, at]) + 0.008 * np.random.default_rng(raised).uniform(-1, 1, (raised + flat, 2))
    up = np.arange(raised + flat) < raised
    return Points(place, np.where(up, 0.012, 0.0), up)


def test_too_few_never_count() -> None:
    wheel = ROVER.wheel_diameter
    assert obstacle(scattered(MIN_POINTS - 1, 0), wheel) is None
    assert obstacle(scattered(8, 80), wheel) is None, "a tenth of what is seen there"


def test_the_largest_group_does_not_hide_a_surer_one() -> None:
    """Twelve of a hundred, and nine of twelve beside them."""
    parts = [scattered(12, 88), scattered(9, 3, 0.3)]
    both = Points(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("place", "rise", "raised")))
    seen = obstacle(both, ROVER.wheel_diameter)
    assert seen is not None
    assert seen.count == 9
    assert seen.place[1] == pytest.approx(0.3, abs=0.01)


def test_images_are_compared_over_a_baseline_and_not_across_a_turn() -> None:
    wheel = ROVER.wheel_diameter
    way = np.array([[0.0, 0.025 * k, 0.0] for k in range(5)])
    assert pairs(way, wheel) == [(0, 2), (1, 3), (2, 4)]
    way[3:, 2] = math.radians(20.0)
    assert pairs(way, wheel) == [(0, 2)]


def along_the_way(lost: int | None) -> Bundle:
    """Four images 25 mm apart before a block, compared two apart; one of them may have no pose."""
    ys, compared = [0.025 * k for k in range(4)], [(0, 2), (1, 3)]
    poses = np.stack([at(y).matrix34 for y in ys])
    if lost is not None:
        poses[lost] = np.nan
    motions = []
    for i, j in compared:
        v = view(ys[i], ys[j], BLOCK)
        validity = np.where(v.matched, np.uint16(Validity.MATCHED), np.uint16(0))
        arrays = {"validity": validity, "column_disparity": v.column, "row_disparity": v.row}
        motions.append(Bundle(arrays, {"level": v.level}))
    inputs = {
        "dem": Bundle({"elevation": np.zeros(LATTICE.shape, np.float32)}, {"lattice": LATTICE.to_dict()}),
        "resect": Bundle({"poses": poses}, {"per_frame": [{"frame": 10 + k} for k in range(4)]}),
        "rig": Bundle({}, {"rig": Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.1, 0, 0]))).to_dict()}),
        "motions": motions,
    }
    args = {"pairs": compared, "vehicle": ROVER.model_dump(mode="json"), "T_vehicle_left": T_VEHICLE_LEFT.to_list()}
    return obstacle_monitor_stage.run(ObstacleMonitorParams(), args, inputs)


def test_the_stage_says_where_it_stops_and_leaves_out_images_without_a_pose() -> None:
    found = along_the_way(None)
    assert found.meta["stop"] == 2
    assert found.meta["reason"].startswith("obstacle ")
    found = along_the_way(0)
    assert found.meta["stop"] == 3
