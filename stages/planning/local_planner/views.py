"""What of the ground about a vehicle its cameras see, by their geometry alone: what hides behind stones is left out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stand = tuple[float, float, float]
"""x, y (m) of the middle of a vehicle and its heading (rad to the left of y)."""

RIM = 0.04
"""Share of the image's width and height along its border on which is not relied: no window fits there, and the vehicle
stands a little crooked."""
MOST = 0.9
"""Share of points that must be in view for all of them to be."""


@dataclass(frozen=True)
class FieldOfView:
    """The ground that all cameras see from a vehicle on level ground: where ``edges @ (right, ahead, 1)`` is positive,
    edges (edge, 3), metres in the vehicle's frame."""

    edges: Floats

    @staticmethod
    def of(rig: Rig, T_vehicle_left: RigidTransform) -> FieldOfView:
        """Of two cameras: a border of an image and the camera's centre span a plane; its line on the ground is an edge.

        ``T_vehicle_left``: of the left camera in the vehicle's frame, x right, y ahead, z up from the ground.
        """
        right = T_vehicle_left @ rig.T_right_left.inverse()
        return FieldOfView(np.concatenate([_edges(rig.left, T_vehicle_left), _edges(rig.right, right)]))

    def sees(self, points: Floats, stand: Stand) -> Mask:
        """Which points (n, 2), m, lie in view from a place."""
        x, y, heading = stand
        c, s = math.cos(heading), math.sin(heading)
        dx, dy = points[:, 0] - x, points[:, 1] - y
        at = np.stack([c * dx + s * dy, c * dy - s * dx, np.ones(len(points))])
        return np.asarray((self.edges @ at > 0).all(axis=0))

    def holds(self, points: Floats, stand: Stand) -> bool:
        """Whether :data:`MOST` of these points lie in view."""
        return bool(self.sees(points, stand).mean() >= MOST)


def _edges(camera: Camera, T_vehicle_camera: RigidTransform) -> Floats:
    """(4, 3): lines on the ground, positive inside."""
    u, v = RIM * camera.width, RIM * camera.height
    corners = np.array([[u, v], [camera.width - u, v], [camera.width - u, camera.height - v], [u, camera.height - v]])
    rays = camera.rays(corners - 0.5) @ T_vehicle_camera.rotation.T
    planes = np.cross(rays, np.roll(rays, -1, axis=0))  # inward, by the order of the corners
    return np.column_stack([planes[:, :2], -planes @ T_vehicle_camera.translation])


AHEAD = FieldOfView(np.array([[0.0, 1.0, 0.0]]))
"""All that is before the middle of the vehicle."""


def looked(view: FieldOfView, stands: Iterable[Stand], points: Floats) -> list[tuple[float, float]]:
    """From where points (n, 2), m, were in view: direction (rad) and distance (m) from their middle to those places."""
    return [bearing(points, stand) for stand in stands if view.holds(points, stand)]


def bearing(points: Floats, stand: Stand) -> tuple[float, float]:
    """Direction (rad, from x to y) and distance (m) from the middle of points (n, 2), m, to a place."""
    x, y = points.mean(axis=0)
    return math.atan2(stand[1] - y, stand[0] - x), math.hypot(stand[1] - y, stand[0] - x)
