"""Detection of obstacles during a leg: points that rise above the last elevation model.

The paper leaves this open (section 8). Between two stops there is one camera and its motion: two images some
centimetres apart are a stereo pair along the drive, with coarse displacements (stage ``motion``) and the relative pose
of the resection. For each cell of the last elevation model ahead of the vehicle the model predicts the pixel of its
point; the displacement there is a disparity of that pair (:func:`~rille.stages.geometry.epipolar.inverse_depth`), and
so gives a point in space. It counts as raised if it lies higher than all of the model nearby, by more than half a
wheel's radius and by more than its noise. Enough raised points together, if they are a large share of the points there,
are an obstacle: the vehicle stops and looks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, Params, stage
from rille.stages.core.validity import matched
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import MotionFacts, ResectFacts
from rille.stages.facts.planning import StopFacts
from rille.stages.facts.terrain import DemFacts
from rille.stages.geometry.epipolar import inverse_depth
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.rigid import posed
from rille.stages.hazard.vehicle import Vehicle

LEVEL = 1
"""Pyramid level of the displacements: half the resolution."""
MIN_RISE_WHEELS, MIN_RISE_SIGMAS = 0.25, 2.0
"""Least rise over the model of a raised point [wheel diameters], and least rise in its standard deviations."""
MIN_POINTS, MIN_SHARE = 8, 0.35
"""Fewest raised points of an obstacle within one wheel diameter, and their least share of all points there."""


class ObstacleMonitorParams(Params):
    """Parameters of the stage ``obstacle_monitor``.

    Attributes
    ----------
    enabled : whether the rover looks for obstacles between stops.
    """

    enabled: bool = True


@dataclass(frozen=True)
class LastModel:
    """The last elevation model: ``points`` (n, 3) of the known cells, m; ``top`` (row, col), the greatest height within
    the blur, m, -inf where none is known."""

    lattice: Lattice
    top: Floats
    points: Floats

    @staticmethod
    def of(elevation: NDArray[np.floating], lattice: Lattice, blur: float) -> LastModel:
        """Model of elevations (row, col), m, NaN unknown; ``top`` is the highest within ``blur`` metres."""
        z = np.asarray(elevation, np.float64)
        side = 2 * round(blur / lattice.cell) + 1
        # The highest nearby, so that errors of the pose do not raise a known stone.
        top = scipy.ndimage.maximum_filter(np.where(np.isnan(z), -np.inf, z), side, mode="nearest")
        known = np.isfinite(z)
        return LastModel(lattice, top, np.column_stack([lattice.xy()[known], z[known]]))

    def top_at(self, xy: Floats) -> Floats:
        """Greatest height near points (n, 2); -inf if no cell nearby is known, NaN outside."""
        return self.lattice.values(self.top, self.lattice.index(xy), np.nan)


@dataclass(frozen=True)
class ViewPair:
    """Two images of a leg: T_local_left of both, and displacements of the first one's level grid in level-0 pixels."""

    before: RigidTransform
    now: RigidTransform
    column: Floats32
    row: Floats32
    matched: Bools
    level: int


@dataclass(frozen=True)
class Points:
    """Points ahead: ``place`` (n, 2) right and ahead of the vehicle, m; ``rise`` (n,) m over the model; ``raised``."""

    place: Floats
    rise: Floats
    raised: Bools


@dataclass(frozen=True)
class Obstacle:
    """A group of raised points: their number, and ``place`` (2,) right and ahead of the vehicle, m."""

    count: int
    place: Floats


def look(
    view: ViewPair,
    surface: LastModel,
    camera: Camera,
    T_vehicle_left: RigidTransform,
    vehicle: Vehicle,
) -> Points:
    """Points ahead of the vehicle by two images, and which of them rise above the model."""
    wheel = vehicle.wheel_diameter
    T_now = view.now.inverse()
    T_vehicle_local = T_vehicle_left @ T_now
    ahead = T_vehicle_local.apply(surface.points)
    # Watched: ten wheel diameters ahead of the centre, and half of one beside the wheels.
    wide = 0.5 * vehicle.track + 0.5 * wheel
    near = (np.abs(ahead[:, 0]) <= wide) & (ahead[:, 1] > 0.5 * vehicle.wheel_base) & (ahead[:, 1] <= 10.0 * wheel)
    pixel, ground, first = _seen(view, surface.points[near], camera)
    maps = view.column, view.row
    displacement = np.stack([a[pixel[:, 1], pixel[:, 0]].astype(np.float64) for a in maps], axis=1)
    rho, per_pixel = inverse_depth(Rig(camera, camera, T_now @ view.before), first, displacement)
    with np.errstate(divide="ignore"):
        q = view.before.apply(camera.rays(first) / np.where(rho > 0, rho, np.nan)[:, None])
    # Half a pixel of the pyramid's level.
    error = 0.5 * 2.0**view.level
    # A displacement across the epipolar line is a wrong match; obstacles are nearer than the ground behind them, but
    # not at the camera.
    missed = first + displacement - camera.project(T_now.apply(q))
    away, behind = (np.linalg.norm(p - view.before.translation, axis=1) for p in (q, ground))
    along = (np.hypot(*missed.T) <= 3.0 * error) & (away > 0.2 * behind) & (away < 1.5 * behind)
    rise = q[:, 2] - surface.top_at(q[:, :2])
    noise = error * per_pixel / np.maximum(rho, 1e-9) * np.abs(q[:, 2] - view.before.translation[2])
    raised = along & (rise > MIN_RISE_WHEELS * wheel) & (rise > MIN_RISE_SIGMAS * noise)
    place = T_vehicle_local.apply(q)[:, :2]
    return Points(place[along], rise[along], raised[along])


def _seen(view: ViewPair, cells: Floats, camera: Camera) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Grid pixels (n, 2) that show a cell and have a displacement, points (n, 3) of the ground, pixel centres (n, 2).

    Of several cells in one pixel the nearest one is used; the point is where the pixel's ray meets the cell's height.
    """
    rows, cols = view.matched.shape
    scale = 2.0**view.level
    in_camera = view.before.inverse().apply(cells)
    at = np.rint((np.nan_to_num(camera.project(in_camera), nan=-1e6) + 0.5) / scale - 0.5).astype(np.intp)
    ok: Bools = np.asarray(((at >= 0) & (at < [cols, rows])).all(axis=1))
    ok[ok] &= view.matched[at[ok, 1], at[ok, 0]]
    at, cells, depth = at[ok], cells[ok], in_camera[ok, 2]
    # By pixel, then by depth: the first cell of each pixel hides the others.
    flat = at[:, 1] * cols + at[:, 0]
    order = np.lexsort((depth, flat))
    keep = order[np.unique(flat[order], return_index=True)[1]]
    centre = (at[keep] + 0.5) * scale - 0.5
    rays = camera.rays(centre) @ view.before.rotation.T
    origin = view.before.translation
    # On the pixel's ray, not at the cell's centre: half a cell off would look like a displacement.
    ground = origin + ((cells[keep, 2] - origin[2]) / rays[:, 2])[:, None] * rays
    return np.asarray(at[keep]), np.asarray(ground), np.asarray(centre)


def obstacle(points: Points, wheel: float) -> Obstacle | None:
    """The largest group of raised points within one wheel's diameter that counts; None: there is none."""
    raised = points.place[points.raised]
    if len(raised) < MIN_POINTS:
        return None
    together, around = (
        scipy.spatial.KDTree(places).query_ball_point(raised, 0.5 * wheel, p=np.inf, return_length=True)
        for places in (raised, points.place)
    )
    counts = (together >= MIN_POINTS) & (together >= MIN_SHARE * around)
    if not counts.any():
        return None
    best = int(np.argmax(np.where(counts, together, -1)))
    return Obstacle(int(together[best]), raised[best])


class MonitorInputs(NamedTuple):
    """The last elevation model, the resected poses of a leg, the rig, and motions between pairs of its images."""

    dem: Bundle[DemFacts]
    resect: Bundle[ResectFacts]
    rig: Bundle[CalibrationFacts]
    motions: Sequence[Bundle[MotionFacts]]


@stage(
    "obstacle_monitor",
    outputs=[
        Array("raised", ("frame",), "int32", "1", "points of the largest raised group"),
        Array("where", ("frame", "xy"), "float64", "m", "its place, right and ahead of the vehicle's centre", "nan"),
    ],
)
def obstacle_monitor_stage(
    params: ObstacleMonitorParams,
    inputs: MonitorInputs,
    *,
    vehicle: Vehicle,
    pairs: Sequence[tuple[int, int]],
    T_vehicle_left: RigidTransform,
) -> Bundle[StopFacts]:
    """Obstacles that the last elevation model does not know, seen on the way."""
    camera = Rig.from_dict(inputs.rig.meta["rig"]).left
    wheel = vehicle.wheel_diameter
    lattice = Lattice.from_dict(inputs.dem.meta["lattice"])
    # A point is compared with the greatest height of the model within half a wheel.
    surface = LastModel.of(np.asarray(inputs.dem["elevation"]), lattice, 0.5 * wheel)
    poses = np.asarray(inputs.resect["poses"])  # NaN where tracking was lost, which stage fault_monitor judges
    known = posed(poses)
    raised = np.zeros(len(poses), np.int32)
    where = np.full((len(poses), 2), np.nan)
    stop, reason = None, ""
    for (i, j), motion in zip(pairs, inputs.motions, strict=True):
        if not (known[i] and known[j]):
            continue
        ok = matched(np.asarray(motion["validity"]))
        column, row = np.asarray(motion["column_disparity"]), np.asarray(motion["row_disparity"])
        first, second = (RigidTransform.from_matrix(poses[k]) for k in (i, j))
        view = ViewPair(first, second, column, row, ok, int(motion.meta["level"]))
        points = look(view, surface, camera, T_vehicle_left, vehicle)
        group = obstacle(points, wheel)
        if group is None:
            continue
        raised[j], where[j] = group.count, group.place
        if stop is None:
            away = 1000.0 * (group.place[1] - 0.5 * vehicle.wheel_base - 0.5 * wheel)
            stop = j
            reason = f"obstacle {away:.0f} mm before the wheels: {group.count} points rise above the model"
    return Bundle({"raised": raised, "where": where}, {"stop": stop, "reason": reason})


def pairs(odometry: Floats, wheel: float) -> list[tuple[int, int]]:
    """Pairs of images of a leg to compare: each with the latest earlier one that is a baseline behind it.

    ``odometry`` (frame, 3): x, y (m), heading (rad) by the wheels.
    """
    out = []
    for j in range(1, len(odometry)):
        # From the latest backwards: the first image far enough behind is most alike.
        for i in range(j - 1, -1, -1):
            # 6.0: largest turn between two compared images; at 7 and 8 degrees points of right ground seemed to rise.
            if math.degrees(abs(odometry[j, 2] - odometry[i, 2])) > 6.0:
                break
            # 1.6: least distance between the two compared images [wheel diameters]; larger: less noise.
            if math.hypot(*(odometry[j, :2] - odometry[i, :2])) >= 1.6 * wheel - 1e-9:
                out.append((i, j))
                break
    return out
