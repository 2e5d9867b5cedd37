"""Whether a sensor contradicts the camera's own chain.

A sensor that was mounted, timed or read otherwise than stated departs from the chain by more than errors of either. Of
vectors a (ways or turns by the chain) and b (by the sensor), the matrix Q and the scale s are sought for which s Q b is
nearest to a (Schoenemann 1966, doi:10.1007/BF02289451): they tell a turned mount, exchanged axes and a wrong unit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import orthonormal, rotation_log
from rille.stages.geometry.rigid import motion
from rille.stages.odometry.resection.sensors import (
    OFFSET_SIGMA_S,
    Fixes,
    RelativePrior,
    enough,
    fit_plane,
)

WINDOWS = 16
"""Parts of a trajectory over which ways are compared: over single frames noise would hide a turned mount."""
CAMERA_SHARE = 0.05
"""Error of the camera's own ways that no sensor is doubted for."""
MIN_TURN = math.radians(1.0)
"""RMS turn of the camera below which an attitude is not tested, noise having any axis; and what its own may err."""
HELD = 0.02
"""Weight of the identity against the data where Q is sought: along a straight way a roll does not show."""
MIN_SIGMAS = 3.0
"""Standard deviations from which on a departure is one of the whole sensor."""


def departure(own: Floats, said: Floats, allowed: float, what: str) -> tuple[float, str]:
    """By which share vectors (m, 3) of a sensor depart from the camera's; how, where it is more than allowed."""
    size = math.sqrt(float((own**2).sum()))
    off = math.sqrt(float(((own - said) ** 2).sum())) / max(size, 1e-12)
    if off <= allowed:
        return off, ""
    u, _, vt = np.linalg.svd(own.T @ said / (own**2).sum() + HELD * np.eye(3))
    Q = u @ vt
    turned = said @ Q.T
    scale = float((own * turned).sum() / max((turned**2).sum(), 1e-12))
    left = math.sqrt(float(((own - scale * turned) ** 2).sum())) / size
    axis = rotation_log(orthonormal(Q))
    angle = float(np.linalg.norm(axis))
    reads = []
    if np.linalg.det(Q) < 0:
        reads.append("two of its axes are exchanged, or one has the wrong sign")
    elif angle > math.radians(2.0):
        about = ", ".join(f"{v:.2f}" for v in axis / angle)
        reads.append(f"it is turned by {math.degrees(angle):.1f} degrees about ({about}) of the left camera")
    if abs(scale - 1.0) > 0.5 * allowed:
        # Metres of a degree of latitude and, as far north as people drive, of longitude
        unit = " (degrees are no metres)" if 3e4 < scale < 1.2e5 else ""
        reads.append(f"its lengths have to be multiplied by {scale:.3g}{unit}")
    fits = f"; {' and '.join(reads)}, which leaves {left:.1%}" if reads and left < 0.5 * off else ""
    return off, f"its {what} depart from the camera's by {off:.1%}, where {allowed:.1%} is possible{fits}"


def motion_contradiction(sensor: RelativePrior, poses: Floats, piece: NDArray[np.int16]) -> str:
    """Why the camera's own poses (n, 3, 4), in pieces, contradict a sensor at all clocks; empty: they do not."""
    shifts = [0.0] if sensor.times is None else sorted(np.linspace(-OFFSET_SIGMA_S, OFFSET_SIGMA_S, 21), key=abs)
    return min((_departure(sensor, shift, poses, piece) for shift in shifts), key=lambda one: one[0])[1]


def _departure(sensor: RelativePrior, shift: float, poses: Floats, piece: NDArray[np.int16]) -> tuple[float, str]:
    """By which share of the camera's ways or turns a sensor ``shift`` seconds later departs; why that is too much."""
    sensed = sensor.at(shift)
    rows = np.flatnonzero(np.isfinite(sensed).all((1, 2)))
    lag = max(len(rows) // WINDOWS, 1)
    a, b = rows[:-lag], rows[lag:]
    a, b = a[piece[a] == piece[b]], b[piece[a] == piece[b]]
    own, said = motion(poses, a, b), motion(sensed, a, b)
    if not len(a):
        return 0.0, ""
    if sensor.drift:
        own, said, what = own[:, :, 3], said[:, :, 3], "ways"
        # A turn that grows along the way leads it aside by half as much.
        allowed = sensor.drift + 0.5 * sensor.turn * float(np.linalg.norm(own, axis=1).mean())
    else:
        own, said, what = rotation_log(own[:, :, :3]), rotation_log(said[:, :, :3]), "turns"
        size = math.sqrt(float((own**2).sum(1).mean()))
        if size < MIN_TURN:
            return 0.0, ""
        allowed = sensor.turn / size
    return departure(own, said, CAMERA_SHARE + MIN_SIGMAS * allowed, what)


def position_contradiction(fixes: Fixes, sigma: Floats, piece: NDArray[np.int16]) -> str:
    """Why the camera's own way in the plane contradicts the shape of the positions; empty: it does not."""
    for k in enough(fixes, piece):
        mine = piece[fixes.nodes] == k
        own = (fixes.antenna[mine] - fixes.antenna[mine].mean(0)) * [1.0, 1.0, 0.0]
        said = fit_plane(fixes.positions[mine], own).apply(fixes.positions[mine]) * [1.0, 1.0, 0.0]
        extent = math.sqrt(float((own**2).sum(1).mean()))
        _, why = departure(own, said, CAMERA_SHARE + MIN_SIGMAS * float(np.hypot(*sigma[:2])) / extent, "ways")
        if why:
            return why
    return ""


def vertical_contradiction(up: Floats, sigma: float, poses: Floats, piece: NDArray[np.int16]) -> str:
    """Why the camera's turns contradict the direction of up (n, 3) in its frame; empty: they do not."""
    for k in np.unique(piece[np.isfinite(up).all(1)]):
        rows = np.flatnonzero((piece == k) & np.isfinite(up).all(1))
        above = np.einsum("nij,nj->ni", poses[rows, :, :3], up[rows])
        mean = np.broadcast_to(above.mean(0) / np.linalg.norm(above.mean(0)), above.shape)
        _, why = departure(mean, above, MIN_TURN + MIN_SIGMAS * sigma, "directions")
        if why:
            return why
    return ""
