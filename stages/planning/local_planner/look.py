"""Views of a vehicle: the ground in view of its cameras, its memory, and the choice of the next view.

The field of view follows from the geometry of the cameras alone; occlusion by stones is not modelled. The next view is
of the ground at the first pose of the path that is not known to be free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.planning.local_planner.ground import Ground, Point
from rille.stages.planning.local_planner.route import Piece, length_of, room_to_turn

Stand = tuple[float, float, float]
"""x, y (m) of the middle of a vehicle and its heading (rad to the left of y)."""

RIM_SHARE = 0.04
"""Share of the image's width and height along its border that does not count as seen: no matching window fits there,
and the vehicle does not stand exactly level."""
TURN_STEP = math.radians(5.0)
"""Step [rad] between the turns that are tried."""


@dataclass(frozen=True)
class FieldOfView:
    """The ground that all cameras see from a vehicle on level ground: where ``edges @ (right, ahead, 1)`` is positive,
    edges (edge, 3), metres in the vehicle's frame."""

    edges: Floats

    @staticmethod
    def of(rig: Rig, T_vehicle_left: RigidTransform) -> FieldOfView:
        """Build from a rig. A border of an image and the camera's centre span a plane; it meets the ground in an edge.

        ``T_vehicle_left``: pose of the left camera in the vehicle's frame, x right, y ahead, z up from the ground.
        """
        right = T_vehicle_left @ rig.T_right_left.inverse()
        return FieldOfView(np.concatenate([_edges(rig.left, T_vehicle_left), _edges(rig.right, right)]))

    def sees(self, points: Floats, stand: Stand) -> Bools:
        """Which points (n, 2), m, lie in view from a place."""
        x, y, heading = stand
        c, s = math.cos(heading), math.sin(heading)
        dx, dy = points[:, 0] - x, points[:, 1] - y
        at = np.stack([c * dx + s * dy, c * dy - s * dx, np.ones(len(points))])
        return np.asarray((self.edges @ at > 0).all(axis=0))

    def holds(self, points: Floats, stand: Stand) -> bool:
        """Whether nearly all of these points lie in view."""
        # 0.9: share of a set of points that must be in view for the set to count as in view.
        return bool(self.sees(points, stand).mean() >= 0.9)


def _edges(camera: Camera, T_vehicle_camera: RigidTransform) -> Floats:
    """(4, 3): lines on the ground, positive inside."""
    u, v = RIM_SHARE * camera.width, RIM_SHARE * camera.height
    corners = np.array([[u, v], [camera.width - u, v], [camera.width - u, camera.height - v], [u, camera.height - v]])
    # Corners of an image lie half a pixel outside the centres of its corner pixels.
    rays = camera.rays(corners - 0.5) @ T_vehicle_camera.rotation.T
    planes = np.cross(rays, np.roll(rays, -1, axis=0))  # inward, by the order of the corners
    return np.column_stack([planes[:, :2], -planes @ T_vehicle_camera.translation])


AHEAD = FieldOfView(np.array([[0.0, 1.0, 0.0]]))
"""All that is before the middle of the vehicle."""


@dataclass
class PlannerMemory:
    """Earlier looks and places of a vehicle.

    Attributes
    ----------
    looks : number of looks since the last leg that was driven.
    closed : places (m); the ground around them was still unknown after it had been looked at.
    reopened : whether the closed places were tried once more, because no other path was left.
    track : where the vehicle has stood, in order.
    """

    looks: int = 0
    closed: list[Point] = field(default_factory=list)
    reopened: bool = False
    track: Sequence[Stand] = ()

    def after(self, verdict: str, where: Point | None = None) -> Literal["end", "again", "drive"]:
        """Update the memory after a planned leg (:class:`rille.stages.planning.local_planner.policy.Leg`); return the
        next action: the end, another plan from the same place, or the drive.

        Parameters
        ----------
        where : m; place that it closes.
        """
        if verdict == "no path" and self.closed and not self.reopened:
            self.closed, self.looks, self.reopened = [], 0, True
            return "again"
        if verdict in ("goal", "no path"):
            return "end"
        if verdict == "closed":
            if where is None:
                raise ValueError("a leg that closes a place must say where")
            self.closed, self.looks = [*self.closed, where], 0
            return "again"
        self.looks = {"drive": 0, "turn": self.looks, "look": self.looks + 1}[verdict]
        return "drive"


@dataclass(frozen=True)
class Target:
    """Ground that has to be seen before the vehicle can go on: ``points`` (n, 2), m; ``view``, the field of view of the
    cameras."""

    ground: Ground
    view: FieldOfView
    points: Floats

    def turn(self, at: Point, heading: float, right: float, left: float) -> float | None:
        """Least turn (rad) on the spot, within bounds and where the wheels have room, after which it is in view."""
        turns = [0.0]
        for sign, bound in ((1.0, left), (-1.0, right)):
            # Outwards until the wheels have no room: a stone that blocks the turn blocks all beyond.
            more = np.array(
                [sign * k * TURN_STEP for k in range(1, 1 + math.floor(max(bound, 0.0) / TURN_STEP + 1e-9))]
            )
            free = self.ground.free(np.full(more.shape, at[0]), np.full(more.shape, at[1]), heading + more)
            turns += more[np.logical_and.accumulate(free)].tolist()
        return next((t for t in sorted(turns, key=abs) if self.view.holds(self.points, (*at, heading + t))), None)

    def last_view(self, leg: Sequence[Piece], bound: float) -> tuple[float, float] | None:
        """Return the last position on a leg from which the target is in view, and the turn on the spot that shows it.

        Parameters
        ----------
        leg : pieces of the leg, from the start pose.
        bound : largest difference [rad] between any two headings of the leg, the turn included.

        Returns
        -------
        Distance [m] from the beginning of the leg and turn [rad, to the left]; None if no position shows the target.
        """
        headings = np.array([self.ground.heading, *(piece.heading for piece in leg)])
        low, high = np.minimum.accumulate(headings), np.maximum.accumulate(headings)
        # From the end: the later a leg stops, the fewer stops there are.
        for done, k, share in _backward(leg, 2.0 * self.ground.cell):
            piece = leg[k]
            at = tuple(a + share * (b - a) for a, b in zip(piece.a, piece.b, strict=True))
            room = room_to_turn(float(low[k + 1]), float(high[k + 1]), piece.heading, bound)
            turn = self.turn((at[0], at[1]), piece.heading, *room)
            if turn is not None:
                return done, turn
        return None


def _backward(leg: Sequence[Piece], step: float) -> Iterator[tuple[float, int, float]]:
    """Places of a leg from its end on: metres from its beginning, number of the piece and the share of it."""
    done = length_of(leg)
    for k, piece in reversed(list(enumerate(leg))):
        done -= piece.length
        for share in np.linspace(1.0, 0.0, max(2, 1 + math.ceil(piece.length / step))).tolist():
            yield done + share * piece.length, k, share
