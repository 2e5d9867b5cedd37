"""What other sensors say of the trajectory, as factors of its pose graph.

Dead reckoning and attitude say how frames stand to each other, also across a gap of the chain; positions and the
vertical say how frames stand in a *place*, a node of its own near the world, whose pose is found, too: positions are of
a frame of their own. Beside errors of each measurement a sensor has some that all of its measurements share (scale and
turn of dead reckoning, a constant offset of its clock), which are sources of the graph.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.geometry.geometry import RigidTransform, rotation_exp, rotation_log
from rille.stages.geometry.rigid import compose, motion, umeyama
from rille.stages.odometry.pose_graph import Factors

LEVER_SIGMA_M = 0.05
"""Of each component of a lever arm that is stated."""
OFFSET_SIGMA_S = 0.5
"""Of a sensor's clock against the camera's, before anything is known of it."""
MIN_STEP_SHARE = 0.05
"""Of the median step: dead reckoning at rest is not exact."""
VERTICAL_SIGMA = math.radians(5.0)
"""Of the world's vertical against that of the place: a plane of ground is a slope."""
MIN_FIXES = 3
"""Positions of a piece from which on it is laid on them."""
MAX_GAP_STEPS = 3.0
"""Median steps of the camera over which its way is interpolated to the time of a position."""


def moved(poses: Floats, rows: Bools, move: RigidTransform) -> Floats:
    """Poses (n, 3, 4), those of some rows (n,) moved as one."""
    return np.where(rows[:, None, None], compose(move.matrix34, poses), poses)


def resampled(poses: Floats, times: Floats, shift: float) -> Floats:
    """Poses (n, 3, 4) of moments that are ``shift`` seconds later; NaN beyond the ends and beside frames without."""
    if shift == 0.0:
        return poses
    at = times + shift
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    part = ((at - times[k]) / (times[k + 1] - times[k]))[:, None]
    step = motion(poses, k, k + 1)
    R = poses[k, :, :3] @ rotation_exp(part * rotation_log(step[:, :, :3]))
    C = poses[k, :, 3] + part * (poses[k + 1, :, 3] - poses[k, :, 3])
    out = np.concatenate([R, C[:, :, None]], axis=2)
    out[(at < times[0]) | (at > times[-1])] = np.nan
    return out


@dataclass(frozen=True)
class RelativePrior:
    """Poses ``T_reference_left`` (frame, 3, 4) by a sensor, NaN of none; ``rows`` (n,) are the frames that are nodes.

    ``times`` (frame,), s, None: its clock is the camera's. ``drift`` is the standard deviation of its ways as a share
    of them, 0: it measures no ways; ``turn`` that of its rotations, rad, of an attitude for each, of dead reckoning for
    each metre of way.
    """

    name: str
    poses: Floats
    rows: NDArray[np.intp]
    times: Floats | None
    drift: float
    turn: float

    def at(self, shift: float) -> Floats:
        """Poses (n, 3, 4) of the nodes by the sensor ``shift`` seconds later."""
        return (self.poses if self.times is None else resampled(self.poses, self.times, shift))[self.rows]

    def factors(self, shift: float, own: Floats | None = None) -> Factors:
        """Factors from each node to the next that has a pose ``shift`` seconds later; the last source is the clock.

        Parameters
        ----------
        own : poses (n, 3, 4) by the camera, whose motion an offset of the clock shows in; None: in nothing.
        """
        poses = self.at(shift)
        rows = np.flatnonzero(np.isfinite(poses).all((1, 2)))
        a, b = rows[:-1], rows[1:]
        measured = motion(poses, a, b)
        way, count, clock = np.linalg.norm(measured[:, :, 3], axis=1), len(a), np.zeros((len(a), 6))
        if self.times is not None and own is not None and count:
            times = self.times[self.rows]
            half = 0.5 * float(np.median(np.diff(times)))
            # Of the camera, not of the sensor: the derivative of the sensor's noise would look like a motion.
            early, late = (motion(resampled(own, times, s), a, b) for s in (-half, half))
            turned = rotation_log(late[:, :, :3] @ np.swapaxes(early[:, :, :3], 1, 2))
            clock = np.nan_to_num(np.concatenate([late[:, :, 3] - early[:, :, 3], turned], axis=1)) / (2.0 * half)
        root, used = np.zeros((count, 6, 6)), slice(3, 6)
        if not self.drift:
            sigma, shared = np.full((count, 3), self.turn), OFFSET_SIGMA_S * clock[:, :, None]
        else:
            step = np.maximum(way, MIN_STEP_SHARE * np.median(way) if count else 0.0)[:, None]
            sigma, used = np.repeat(step * [self.drift, self.turn], 3, axis=1), slice(0, 6)
            scale = np.concatenate([self.drift * measured[:, :, 3], np.zeros((count, 3))], axis=1)
            turns = np.concatenate([np.zeros((count, 3, 3)), self.turn * way[:, None, None] * np.eye(3)], axis=1)
            shared = np.concatenate([scale[:, :, None], turns, OFFSET_SIGMA_S * clock[:, :, None]], axis=2)
        root[:, used, used] = np.eye(sigma.shape[1]) / sigma[:, None, :]
        shared[:, : used.start] = 0.0
        return Factors.of(np.stack([a, b], axis=1), measured, root, sigma.shape[1], shared)


@dataclass(frozen=True)
class PositionPrior:
    """Positions (k, 3), m, of an antenna at ``times`` (k,), s.

    ``sigma`` (3,), m, along x, y and z, infinite where there are no heights; ``lever`` (3,), m, of the antenna in the
    left camera's frame.
    """

    positions: Floats
    times: Floats
    sigma: Floats
    lever: Floats

    @staticmethod
    def of(given: Mapping[str, Any]) -> PositionPrior:
        """Of the arguments of stage ``adjust``."""
        rows, times, sigma, lever = (np.array(given[n], np.float64) for n in ("positions", "times", "sigma", "lever"))
        lacking = 3 - rows.shape[1]
        sigma[3 - lacking :] = np.inf
        return PositionPrior(np.pad(rows, ((0, 0), (0, lacking))), times, sigma, lever)


@dataclass(frozen=True)
class Fixes:
    """Positions (k, 3), m, moved to the moments of ``nodes`` (k,); ``antenna`` (k, 3) there by the camera, and its
    ``velocity`` (k, 3), m/s."""

    nodes: NDArray[np.intp]
    positions: Floats
    antenna: Floats
    velocity: Floats


def fixes_of(prior: PositionPrior, poses: Floats, piece: NDArray[np.int16], times: Floats, shift: float) -> Fixes:
    """Positions at the moments of the nearest nodes, by the camera's own way from the one to the other.

    Parameters
    ----------
    poses, piece, times : (n, 3, 4), (n,) and (n,), s, of the nodes in order.
    shift : s, by which the positions are earlier than stated.
    """
    antenna = poses[:, :, 3] + poses[:, :, :3] @ prior.lever
    at = prior.times - shift
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    length = times[after] - times[after - 1]
    part = (at - times[after - 1]) / length
    near = np.where(part < 0.5, after - 1, after)
    usable = (length <= MAX_GAP_STEPS * np.median(np.diff(times))) & (piece[after] == piece[after - 1])
    usable &= (part > -0.5) & (part < 1.5)
    velocity = (antenna[after] - antenna[after - 1]) / length[:, None]
    moved = prior.positions + (times[near] - at)[:, None] * velocity
    return Fixes(near[usable], moved[usable], antenna[near[usable]], velocity[usable])


def fit_plane(positions: Floats, antenna: Floats) -> RigidTransform:
    """How positions (k, 3) are turned about the vertical and shifted to the antenna's (k, 3)."""
    R = np.eye(3)
    R[:2, :2], _ = umeyama(positions[:, :2], antenna[:, :2])
    return RigidTransform(R, antenna.mean(0) - R @ positions.mean(0))


def placed(
    fixes: Fixes, poses: Floats, piece: NDArray[np.int16]
) -> tuple[RigidTransform, Floats, NDArray[np.int16]] | None:
    """Positions laid on the first piece that has enough of them, and the other such pieces on these positions.

    Returns
    -------
    How the positions are laid, and the poses (n, 3, 4) and pieces (n,) then; None where no piece has enough.
    """
    first, *others = enough(fixes, piece) or (-1,)
    if first < 0:
        return None
    mine = piece[fixes.nodes]
    laid = fit_plane(fixes.positions[mine == first], fixes.antenna[mine == first])
    for k in others:
        move = fit_plane(fixes.antenna[mine == k], laid.apply(fixes.positions[mine == k]))
        poses, piece = moved(poses, piece == k, move), np.where(piece == k, piece.dtype.type(first), piece)
    return laid, poses, piece


def enough(fixes: Fixes, piece: NDArray[np.int16]) -> list[int]:
    """Numbers of the pieces that have enough positions to be laid on them."""
    return [int(k) for k, count in enumerate(np.bincount(piece[fixes.nodes])) if count >= MIN_FIXES]


def position_factors(fixes: Fixes, laid: RigidTransform, prior: PositionPrior, poses: Floats) -> Factors:
    """Factors of positions in the place, the node behind all others; sources are three of the lever arm, and the clock.

    Parameters
    ----------
    poses : (n, 3, 4) of the nodes.
    """
    count, turns = len(fixes.nodes), poses[fixes.nodes, :, :3]
    measured = np.tile(np.eye(3, 4), (count, 1, 1))
    measured[:, :, 3] = laid.apply(fixes.positions)
    root, shared = np.zeros((count, 6, 6)), np.zeros((count, 6, 4))
    root[:, [0, 1, 2], [0, 1, 2]] = 1.0 / prior.sigma
    # The arm that is stated less the true one.
    shared[:, :3, :3], shared[:, :3, 3] = LEVER_SIGMA_M * turns, OFFSET_SIGMA_S * fixes.velocity
    ends, components = np.stack([np.full(count, -1), fixes.nodes], axis=1), int(np.isfinite(prior.sigma).sum())
    return Factors.of(ends, measured, root, components, shared, np.tile(prior.lever, (count, 1)))


def vertical_factors(up: Floats, sigma: float, poses: Floats) -> Factors:
    """Factors of the direction of up (n, 3) in each left camera, NaN of none, in the place, the node behind all."""
    nodes = np.flatnonzero(np.isfinite(up).all(1))
    R = poses[nodes, :, :3]
    above = np.einsum("nij,nj->ni", R, up[nodes])
    # The smallest turn that takes it to z leaves the heading as it is, which gravity does not tell.
    axis = np.cross(above, [0.0, 0.0, 1.0])
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    turn = axis * np.arctan2(length, above[:, 2:]) / np.maximum(length, 1e-12)
    T = np.concatenate([rotation_exp(turn) @ R, np.zeros((len(nodes), 3, 1))], axis=2)
    root = np.zeros((len(nodes), 6, 6))
    root[:, [3, 4], [3, 4]] = 1.0 / sigma
    return Factors.of(np.stack([np.full(len(nodes), -1), nodes], axis=1), T, root, 2)


def anchor(pose: Floats) -> Factors:
    """What is known of the place beforehand, by the pose (3, 4) of node 0: it is about upright in the world."""
    root = np.diag([1e-3] * 3 + [1.0 / VERTICAL_SIGMA] * 2 + [0.1])[None]
    return Factors.of(np.array([[-1, 0]]), pose[None], root)
