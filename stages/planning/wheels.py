"""Placement of a vehicle on a surface: contacts of its four wheels, tilt, and clearance under its belly.

A wheel is a sphere of its diameter that rests on the surface (the highest position that the heights under it enforce).
The body is the plane of least squares through the four contacts: averaging suspensions (rocker-bogie) keep to it.

* tilt: angle of that plane to the horizontal;
* clearance: least distance of the belly, ``vehicle.clearance`` above the plane between the wheels, to the surface;
* step: range of the heights in a square as wide as half a wheel's diameter about the worst contact, the edge that it
  climbs there. Heights between the nodes are bilinear, so that the square is as wide on every grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.hazard.vehicle import Vehicle


@dataclass(frozen=True)
class HeightGrid:
    """Heights (row, col), metres, NaN unknown; node (row, col) is at x = x0 + col cell, y = y0 - row cell.

    ``resting`` (row, col): height of a wheel's lowest point where it rests above the node; ``step`` (row, col): range
    of the heights in the window of half a wheel's diameter.
    """

    x0: float
    y0: float
    cell: float
    height: Floats
    resting: Floats
    step: Floats

    @staticmethod
    def of(height: NDArray[np.floating], x0: float, y0: float, cell: float, wheel_diameter: float) -> HeightGrid:
        """Heights with the resting places of a wheel and its steps."""
        z = np.asarray(height, dtype=np.float64)
        radius = 0.5 * wheel_diameter
        n = int(radius / cell)
        dy, dx = np.mgrid[-n : n + 1, -n : n + 1] * cell
        inside = dx**2 + dy**2 <= radius**2
        sphere = np.where(inside, np.sqrt(np.maximum(radius**2 - dx**2 - dy**2, 0.0)) - radius, 0.0)
        # Unknown cells neither lift a wheel nor poison the maximum as NaN would.
        low = np.where(np.isnan(z), -1e9, z)
        resting = scipy.ndimage.grey_dilation(low, footprint=inside, structure=sphere, mode="nearest")
        # Half a wheel's diameter is the window's side.
        reach = 0.25 * wheel_diameter / cell
        # Highest plus greatest depth: highest minus lowest by one function.
        step = highest(z, reach) + highest(-z, reach)
        unknown = np.isnan(z)
        return HeightGrid(x0, y0, cell, z, np.where(unknown, np.nan, resting), np.where(unknown, np.nan, step))

    def at(self, what: Floats, points: Floats) -> Floats:
        """Bilinear values (n,) of one of the arrays at points (n, 2); NaN outside or beside unknown nodes."""
        index = (self.y0 - points[:, 1]) / self.cell, (points[:, 0] - self.x0) / self.cell
        return np.asarray(scipy.ndimage.map_coordinates(what, index, order=1, cval=np.nan))


def highest(z: Floats, reach: float) -> Floats:
    """Largest bilinear height (row, col) in the square of ``reach`` cells to each side of a node; NaN is left out."""
    filled = np.where(np.isnan(z), -np.inf, z)
    # A bilinear surface has its maximum over a square at nodes inside it, where its rims cross lattice lines, or at its
    # corners, which the rims of rims are.
    inner, rims = _along(_highest_on_lines(filled, reach), reach, 1)[0], _along(filled, reach, 1)[1:]
    return np.asarray(np.maximum.reduce([inner, *(_highest_on_lines(rim, reach) for rim in rims)]))


def _highest_on_lines(z: Floats, reach: float) -> Floats:
    return np.asarray(np.maximum.reduce(_along(z, reach, 0)))


def _along(z: Floats, reach: float, axis: int) -> list[Floats]:
    """Largest of the nodes within ``reach`` cells of each node along an axis, and the heights at both ends of that."""
    whole = int(reach + 1e-6)
    part = reach - whole
    heights = [scipy.ndimage.maximum_filter1d(z, 2 * whole + 1, axis=axis, mode="nearest")]
    nodes = np.arange(z.shape[axis])
    for side in (-1, 1) if part > 1e-6 else ():
        near, far = (np.take(z, np.clip(nodes + side * (whole + k), 0, len(nodes) - 1), axis=axis) for k in (0, 1))
        heights.append((1.0 - part) * near + part * far)
    return heights


@dataclass(frozen=True)
class Stand:
    """Placement of a vehicle: pose of its frame (origin between the wheels on the ground, y ahead, z up), and measures.

    ``tilt`` rad, ``clearance`` m (negative: the belly strikes), ``step`` m; NaN if a wheel is on unknown ground.
    """

    T_ground_vehicle: RigidTransform
    tilt: float
    clearance: float
    step: float


def wheel_positions(vehicle: Vehicle) -> Floats:
    """Wheels (4, 2): right and ahead of the centre, m; front left, front right, rear left, rear right."""
    a, b = 0.5 * vehicle.track, 0.5 * vehicle.wheel_base
    return np.array([[-a, b], [a, b], [-a, -b], [a, -b]])


@dataclass(frozen=True)
class Measures:
    """Placements of a vehicle at poses (n,): height ``middle`` (m) and gradients ``rise`` (ahead) and ``lean`` (to the
    right) of the plane between its wheels; ``tilt``, ``clearance``, ``step`` as of :class:`Stand`; NaN off the map."""

    middle: Floats
    rise: Floats
    lean: Floats
    tilt: Floats
    clearance: Floats
    step: Floats


def measured(ground: HeightGrid, x: Floats, y: Floats, heading: Floats, vehicle: Vehicle) -> Measures:
    """Place the vehicle with its centre above points (n,), m, turned by ``heading`` (n,), rad to the left of y."""
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]

    def at(what: Floats, points: Floats) -> Floats:
        """Values (n, m) at points (m, 2) right and ahead of the centre."""
        right, ahead = points.T
        there = np.stack([x[:, None] + c * right - s * ahead, y[:, None] + s * right + c * ahead], axis=-1)
        return ground.at(what, there.reshape(-1, 2)).reshape(len(x), -1)

    wheels = wheel_positions(vehicle)
    z = at(ground.resting, wheels)
    rise = 0.5 * (z[:, 0] + z[:, 1] - z[:, 2] - z[:, 3]) / vehicle.wheel_base
    lean = 0.5 * (z[:, 1] + z[:, 3] - z[:, 0] - z[:, 2]) / vehicle.track
    middle = z.mean(axis=1)
    # Nine samples along either side.
    half = np.linspace(-0.5, 0.5, 9)
    across, along = np.meshgrid(half * (vehicle.track - 0.2 * vehicle.wheel_diameter), half * vehicle.wheel_base)
    belly = np.stack([across.ravel(), along.ravel()], axis=1)
    plane = middle[:, None] + lean[:, None] * belly[:, 0] + rise[:, None] * belly[:, 1]
    # The wheels stand at a mean height of ``middle``: least squares through four corners of a rectangle are its means.
    free = plane + vehicle.clearance - at(ground.height, belly)
    # A point of the belly over unknown ground does not count; over unknown ground alone there is no clearance.
    clearance = np.where(np.isnan(free), np.inf, free).min(axis=1)
    clearance = np.where(np.isfinite(middle) & np.isfinite(clearance), clearance, np.nan)
    return Measures(middle, rise, lean, np.arctan(np.hypot(lean, rise)), clearance, at(ground.step, wheels).max(axis=1))


def stand(ground: HeightGrid, x: float, y: float, heading: float, vehicle: Vehicle) -> Stand | None:
    """The vehicle with its centre above (x, y), turned by ``heading`` (rad, to the left of y); None: off the ground."""
    placed = measured(ground, np.array([x]), np.array([y]), np.array([heading]), vehicle)
    if not np.isfinite(placed.middle[0]):
        return None
    lean, rise = float(placed.lean[0]), float(placed.rise[0])
    c, s = math.cos(heading), math.sin(heading)
    up = np.array([-lean, -rise, 1.0]) / math.sqrt(1.0 + lean * lean + rise * rise)
    ahead = np.array([0.0, 1.0, rise]) / math.sqrt(1.0 + rise * rise)
    right = np.cross(ahead, up)
    level = np.stack([right, ahead, up], axis=1)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pose = RigidTransform(R @ level, np.array([x, y, float(placed.middle[0])]))
    return Stand(pose, float(placed.tilt[0]), float(placed.clearance[0]), float(placed.step[0]))
