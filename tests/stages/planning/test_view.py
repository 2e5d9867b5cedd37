"""The ground in view against the projection of each of its points."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pointing_angles import rotation_from_angles

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.planning.local_planner.look import RIM_SHARE, FieldOfView

LEFT = Camera(180.0, 175.0, 150.0, 125.0, 320, 240)
RIGHT = Camera(190.0, 190.0, 159.5, 119.5, 320, 240)
DOWN = math.radians(32.0)


def rig_of(toe: float, roll: float) -> tuple[Rig, RigidTransform]:
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, math.cos(DOWN), math.sin(DOWN)], [0.0, -math.sin(DOWN), math.cos(DOWN)]])
    turned = level @ pitch @ rotation_from_angles(0.0, 0.0, roll)
    T_right_left = RigidTransform(rotation_from_angles(0.0, toe, 0.0), np.array([-0.1, 0.0, 0.0]))
    return Rig(LEFT, RIGHT, T_right_left), RigidTransform(turned, np.array([-0.05, 0.04, 0.18]))


def inside(camera: Camera, points: np.ndarray, rim: float) -> np.ndarray:
    u, v = camera.project(points).T
    across, down = rim * camera.width, rim * camera.height
    with np.errstate(invalid="ignore"):
        wide = (u > across - 0.5) & (u < camera.width - across - 0.5)
        return wide & (v > down - 0.5) & (v < camera.height - down - 0.5)


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-7, 7)))
def test_what_is_in_view_lies_in_both_images(toe: float, roll: float, stand: tuple[float, float, float]) -> None:
    rig, T_vehicle_left = rig_of(toe, roll)
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (2000, 2)) + stand[:2]
    x, y, heading = stand
    c, s = math.cos(heading), math.sin(heading)
    right, ahead = (points - (x, y)) @ [[c, -s], [s, c]] @ np.eye(2)[:, :1], (points - (x, y)) @ [[-s], [c]]
    there = np.column_stack([right, ahead, np.zeros(len(points))])
    in_left = T_vehicle_left.inverse().apply(there)
    want = inside(rig.left, in_left, RIM_SHARE) & inside(rig.right, rig.T_right_left.apply(in_left), RIM_SHARE)
    seen = FieldOfView.of(rig, T_vehicle_left).sees(points, stand)
    assert 20 < want.sum() < 1500
    assert (seen != want).sum() <= 1, "but for rounding at an edge"
