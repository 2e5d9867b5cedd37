"""Other sensors as factors of the trajectory's pose graph, and whether they contradict the camera's chain.

Dead reckoning and attitude measure frames against each other, also across a gap of the chain. Positions and the
vertical measure frames against a *place*, a node for the sensor's own frame, whose pose in the world is estimated, too.
Beside the errors of single measurements a sensor has errors that all of its measurements share (scale and turn of dead
reckoning, a constant offset of its clock), which are sources of the graph.

A sensor that was mounted, timed or read otherwise than stated departs from the chain by more than the errors of both.
Of vectors a (ways or turns by the chain) and b (by the sensor), the matrix Q and the scale s are sought for which s Q b
is nearest to a (Schoenemann 1966, doi:10.1007/BF02289451): they show a turned mount, exchanged axes or a wrong unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.geometry.geometry import RigidTransform, cross_matrix, orthonormal, rotation_exp, rotation_log
from rille.stages.geometry.rigid import compose, motion, posed, standing_out, umeyama
from rille.stages.odometry.pose_graph import Factors

LEVER_SIGMA_M = 0.05
"""Standard deviation of each component of a stated lever arm."""
MOUNT_SIGMA = math.radians(1.0)
"""Standard deviation of a stated mount about each axis of the left camera."""
TILT_SIGMA = 0.2
"""Standard deviation, rad, of the ground's slope, and of its change: what odometry on a plane does not measure."""
OFFSET_SIGMA_S = 0.5
"""Standard deviation of a sensor's clock against the camera's, before anything is known of it."""
MIN_FIXES = 3
"""Positions of a piece from which on it is laid on them."""
CAMERA_SHARE = 0.05
"""Error of the camera's own ways that no sensor is doubted for."""
MIN_TURN = math.radians(1.0)
"""RMS turn of the camera below which an attitude is not tested, noise having any axis; and what its own may err."""
MIN_SIGMAS = 3.0
"""Standard deviations from which on a departure is one of the whole sensor."""


class OwnTrajectory(NamedTuple):
    """The camera's own trajectory: ``poses`` (n, 3, 4), each ``piece`` (n,) in a frame of its own, ``times`` (n,), s,
    and ``rows`` (n,) of its nodes among the frames."""

    poses: Floats
    piece: NDArray[np.int16]
    times: Floats
    rows: NDArray[np.intp]

    def take(self, nodes: NDArray[np.intp]) -> OwnTrajectory:
        """The trajectory at some of its nodes."""
        return OwnTrajectory._make(values[nodes] for values in self)


class SharedError(NamedTuple):
    """An error that all measurements of a sensor share, in words, with its standard deviation in a unit."""

    name: str
    sigma: float
    unit: str


class Sensor(Protocol):
    """One sensor."""

    @property
    def shared_errors(self) -> Sequence[SharedError]:
        """Its sources before that of its clock."""
        ...

    def contradiction(self, own: OwnTrajectory) -> str:
        """Why the camera's own trajectory contradicts it; empty: it does not."""
        ...

    def factors(self, own: OwnTrajectory, late: float) -> Factors:
        """Its factors on these nodes, its clock being ``late``, s; the place is node -1, the last source the clock."""
        ...


def _noise(own: OwnTrajectory) -> float:
    """RMS noise, m, of the camera's positions, of which second differences show the root of six times as much."""
    bends = np.diff(own.poses[:, :, 3], 2, axis=0)[own.piece[2:] == own.piece[:-2]]
    return math.sqrt(float((bends**2).sum(1).mean()) / 6.0) if len(bends) else 0.0


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


def departure(own: Floats, said: Floats, allowed: float, what: str) -> tuple[float, str]:
    """Share by which vectors (m, 3) of a sensor depart from the camera's; in words how, if it is more than allowed."""
    # The adjustment leaves out single ones that stand out, as of a jump.
    usual = ~standing_out(np.linalg.norm(own - said, axis=1))
    own, said = own[usual], said[usual]
    size = math.sqrt(float((own**2).sum()))
    off = math.sqrt(float(((own - said) ** 2).sum())) / max(size, 1e-12)
    if off <= allowed:
        return off, ""
    # The identity weighs a little: along a straight way a roll does not show.
    u, _, vt = np.linalg.svd(own.T @ said / (own**2).sum() + 0.02 * np.eye(3))
    Q = u @ vt
    turned = said @ Q.T
    scale = float((own * turned).sum() / max((turned**2).sum(), 1e-12))
    left = math.sqrt(float(((own - scale * turned) ** 2).sum())) / size
    axis = rotation_log(orthonormal(Q))
    angle = float(np.linalg.norm(axis))
    reads = []
    if np.linalg.det(Q) < 0:
        reads.append("two of its axes are exchanged, one has the wrong sign, or both cameras' images are mirrored")
    elif angle > math.radians(2.0):
        about = ", ".join(f"{v:.2f}" for v in axis / angle)
        reads.append(f"it is turned by {math.degrees(angle):.1f} degrees about ({about}) of the left camera")
    if abs(scale - 1.0) > 0.5 * allowed:
        # Metres of a degree of latitude and, as far north as people drive, of longitude
        unit = " (degrees are no metres)" if 3e4 < scale < 1.2e5 else ""
        reads.append(f"its lengths have to be multiplied by {scale:.3g}{unit}, or the rig's baseline divided")
    fits = f"; {' and '.join(reads)}, which leaves {left:.1%}" if reads and left < min(0.5 * off, allowed) else ""
    return off, f"its {what} depart from the camera's by {off:.1%}, where {allowed:.1%} is possible{fits}"


def best_departure(departs: Callable[[float], tuple[float, str]], *, clocked: bool) -> str:
    """How a sensor departs from the camera at all clocks, by the one at which it does least; empty: at one it does not.

    ``departs``: by which share it departs with a clock that is so late, s, and how, see :func:`departure`; infinite
    where nothing can be compared.
    """
    clocks = sorted(np.linspace(-OFFSET_SIGMA_S, OFFSET_SIGMA_S, 21), key=abs) if clocked else [0.0]
    compared = [one for one in map(departs, clocks) if one[0] < math.inf]
    return min(compared, key=lambda one: (bool(one[1]), one[0]), default=(0.0, ""))[1]


@dataclass(frozen=True)
class RelativePrior:
    """Poses ``T_reference_left`` (frame, 3, 4) by dead reckoning or attitude, NaN of none.

    ``times`` (frame,), s, None: its clock is the camera's. ``drift`` is the standard deviation of its ways as a share
    of them, 0: it measures no ways; ``turn`` that of its rotations, rad, of an attitude for each, of dead reckoning for
    each metre of way. Of wheels on a plane, which know neither slopes nor tilts, ``up`` (3,) is their vertical in the
    left camera's frame, else zero; ``origin`` (3,), m, in that frame is the point whose ways are measured.
    """

    poses: Floats
    times: Floats | None
    drift: float
    turn: float
    up: Floats = field(default_factory=lambda: np.zeros(3))
    origin: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def shared_errors(self) -> Sequence[SharedError]:
        """Of the mount; of dead reckoning scale and turn as well."""
        mounts = [SharedError(f"mount about {axis}", math.degrees(MOUNT_SIGMA), " degrees") for axis in "xyz"]
        if not self.drift:
            return mounts
        turns = (SharedError(f"turn about {axis}", math.degrees(self.turn), " degrees per metre") for axis in "xyz")
        return [*mounts, SharedError("scale", 100.0 * self.drift, " %"), *turns]

    def _ways(self, moves: Floats) -> Floats:
        """Ways (m, 3), m, of the measured point by motions (m, 3, 4) of the left camera, in its frame before."""
        return moves[:, :, 3] + (moves[:, :, :3] - np.eye(3)) @ self.origin

    def _at(self, rows: NDArray[np.intp], shift: float) -> Floats:
        """Poses (n, 3, 4) of some frames by the sensor ``shift`` seconds later."""
        return (self.poses if self.times is None else resampled(self.poses, self.times, shift))[rows]

    def contradiction(self, own: OwnTrajectory) -> str:
        """Why the camera's own trajectory contradicts it at all clocks; empty: it does not."""
        return best_departure(lambda shift: self._departure(own, shift), clocked=self.times is not None)

    def _departure(self, own: OwnTrajectory, shift: float) -> tuple[float, str]:
        """By which share of the camera's ways or turns it departs ``shift`` seconds later; why that is too much."""
        sensed = self._at(own.rows, shift)
        rows = np.flatnonzero(posed(sensed))
        # Over single frames noise would hide a turned mount.
        lag = max(len(rows) // 16, 1)
        a, b = rows[:-lag], rows[lag:]
        same = own.piece[a] == own.piece[b]
        a, b = a[same], b[same]
        moves, said = motion(own.poses, a, b), motion(sensed, a, b)
        if not len(a):
            return 0.0, ""
        if self.drift:
            level = np.eye(3) - np.outer(self.up, self.up)
            ways, stated = self._ways(moves) @ level, self._ways(said) @ level
            # 3.0: noise of two positions of the camera up to which it may be at rest, where ways by other sensors mean
            # nothing.
            if np.sqrt((ways**2).sum(1).mean()) < 3.0 * math.sqrt(2.0) * _noise(own):
                return 0.0, ""
            # A turn that grows along the way leads it aside by half as much.
            allowed = self.drift + 0.5 * self.turn * float(np.linalg.norm(ways, axis=1).mean())
            return departure(ways, stated, CAMERA_SHARE + MIN_SIGMAS * allowed, "ways")
        turns = rotation_log(moves[:, :, :3])
        size = math.sqrt(float((turns**2).sum(1).mean()))
        if size < MIN_TURN:
            return 0.0, ""
        return departure(turns, rotation_log(said[:, :, :3]), CAMERA_SHARE + MIN_SIGMAS * self.turn / size, "turns")

    def factors(self, own: OwnTrajectory, late: float) -> Factors:
        """Factors from each node to the next that has a pose by the sensor."""
        poses = self._at(own.rows, late)
        rows = np.flatnonzero(posed(poses))
        if self.drift and not np.diff(poses[rows, :, 3], axis=0).any():
            rows = rows[:0]  # errors are shares of ways, and it has gone none
        a, b = rows[:-1], rows[1:]
        measured, moves = motion(poses, a, b), motion(own.poses, a, b)
        # All that errors show in is of the camera: noise of the sensor would look like a scale or a motion of its own.
        ways, count = self._ways(moves), len(a)
        way = np.linalg.norm(ways, axis=1)
        # Dead reckoning at rest is not exact.
        step = np.maximum(way, 0.05 * np.median(way[way > 0]) if (way > 0).any() else 0.0)[:, None, None]
        columns = [MOUNT_SIGMA * np.concatenate([-cross_matrix(ways), np.eye(3) - moves[:, :, :3]], axis=1)]
        if self.drift:
            scale = np.concatenate([self.drift * ways, np.zeros((count, 3))], axis=1)
            turns = np.concatenate([np.zeros((count, 3, 3)), self.turn * step * np.eye(3)], axis=1)
            columns += [scale[:, :, None], turns]
        shared = np.concatenate([*columns, OFFSET_SIGMA_S * self._per_second(own, a, b)[:, :, None]], axis=2)
        # Of the place of the measured point, not of the camera.
        measured[:, :, 3] += measured[:, :, :3] @ self.origin
        lever = np.broadcast_to(self.origin, (count, 3))
        root = self._root(step)
        return Factors.of(np.stack([a, b], axis=1), measured, root, 6 if self.drift else 3, shared, lever)

    def _per_second(self, own: OwnTrajectory, a: NDArray[np.intp], b: NDArray[np.intp]) -> Floats:
        """Change (m, 6) of the motions from frames a to b if the clock is a second late; 0: there is no other clock."""
        if self.times is None or not len(a):
            return np.zeros((len(a), 6))
        half = 0.5 * float(np.median(np.diff(own.times)))
        before, after = (motion(resampled(own.poses, own.times, s), a, b) for s in (-half, half))
        turned = rotation_log(after[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2))
        changes = np.concatenate([self._ways(after) - self._ways(before), turned], axis=1)
        return np.asarray(np.nan_to_num(changes) / (2.0 * half))

    def _root(self, step: Floats) -> Floats:
        """Roots (m, 6, 6) of the information of single motions, whose ways are ``step`` (m, 1, 1), m."""
        root = np.zeros((len(step), 6, 6))
        if not self.drift:
            root[:, 3:, 3:] = np.eye(3) / self.turn
            return root
        steep = np.outer(self.up, self.up)
        tilted = np.eye(3) * (self.up @ self.up) - steep
        root[:, :3, :3] = (np.eye(3) - steep) / (self.drift * step) + steep / (TILT_SIGMA * step)
        root[:, 3:, 3:] = (np.eye(3) - tilted) / (self.turn * step) + tilted / TILT_SIGMA
        return root


@dataclass(frozen=True)
class Fixes:
    """Positions (k, 3), m, of a frame of their own; ``antenna`` (k, 3) at their moments by the camera, ``behind``
    (k, 3), m, its way there from the nearest of the ``nodes`` (k,), and its ``velocity`` (k, 3), m/s."""

    nodes: NDArray[np.intp]
    positions: Floats
    antenna: Floats
    behind: Floats
    velocity: Floats


@dataclass(frozen=True)
class PositionPrior:
    """Positions (k, 3), m, of an antenna at ``times`` (k,), s.

    ``sigma`` (3,), m, along x, y and z, infinite where there are no heights; ``lever`` (3,), m, of the antenna in the
    left camera's frame; ``clocked``: its clock is one of its own; ``laid``: how positions are laid on the world.
    """

    positions: Floats
    times: Floats
    sigma: Floats
    lever: Floats
    clocked: bool
    laid: RigidTransform = field(default_factory=RigidTransform.identity)
    shared_errors = tuple(SharedError(f"lever arm along {axis}", LEVER_SIGMA_M, " m") for axis in "xyz")

    @staticmethod
    def of(given: Mapping[str, Any], *, clocked: bool) -> PositionPrior:
        """Of the arguments of stage ``adjust``."""
        rows, times, sigma, lever = (np.array(given[n], np.float64) for n in ("positions", "times", "sigma", "lever"))
        lacking = 3 - rows.shape[1]
        sigma[3 - lacking :] = np.inf
        return PositionPrior(np.pad(rows, ((0, 0), (0, lacking))), times, sigma, lever, clocked)

    def fixes(self, own: OwnTrajectory, late: float = 0.0) -> Fixes:
        """Positions beside the nearest nodes, and the camera's own way from there to their moments."""
        antenna = own.poses[:, :, 3] + own.poses[:, :, :3] @ self.lever
        at = self.times - late
        after = np.clip(np.searchsorted(own.times, at), 1, len(own.times) - 1)
        length = own.times[after] - own.times[after - 1]
        part = (at - own.times[after - 1]) / length
        near = np.where(part < 0.5, after - 1, after)
        # Not over gaps of several frames.
        usable = length <= 3.0 * np.median(np.diff(own.times))
        usable &= (own.piece[after] == own.piece[after - 1]) & (part > -0.5) & (part < 1.5)
        velocity = (antenna[after] - antenna[after - 1]) / length[:, None]
        # The antenna is moved, not the position: how the frame of positions is turned is not known yet.
        behind = (at - own.times[near])[:, None] * velocity
        there, of = antenna[near] + behind, usable
        return Fixes(near[of], self.positions[of], there[of], behind[of], velocity[of])

    def contradiction(self, own: OwnTrajectory) -> str:
        """Why the camera's own way in the plane contradicts the shape of the positions at all clocks; empty: it does
        not."""
        return best_departure(lambda late: self._departure(own, late), clocked=self.clocked)

    def _departure(self, own: OwnTrajectory, late: float) -> tuple[float, str]:
        """By which share of the camera's ways in the worst piece positions depart that are so late, s; why that is too
        much."""
        fixes, found = self.fixes(own, late), list[tuple[float, str]]()
        for k in pieces_with_fixes(fixes, own.piece):
            mine = own.piece[fixes.nodes] == k
            way = (fixes.antenna[mine] - fixes.antenna[mine].mean(0)) * [1.0, 1.0, 0.0]
            said = fit_plane(fixes.positions[mine], way).apply(fixes.positions[mine]) * [1.0, 1.0, 0.0]
            share = float(np.hypot(*self.sigma[:2])) / math.sqrt(float((way**2).sum(1).mean()))
            off, why = departure(way, said, CAMERA_SHARE + MIN_SIGMAS * share, "ways")
            steps = np.linalg.norm(np.diff(way - said, axis=0), axis=1)
            if why and standing_out(steps).any():
                at = int(steps.argmax())
                x, y = fixes.positions[mine][at, :2]
                why += f"; they jump by {steps[at]:.2g} m after ({x:.2f}, {y:.2f})"
            found.append((off, why))
        return max(found, key=lambda one: (bool(one[1]), one[0]), default=(math.inf, ""))

    def factors(self, own: OwnTrajectory, late: float) -> Factors:
        """Factors of positions in the place; sources are three of the lever arm, and the clock."""
        fixes = self.fixes(own, late)
        count, turns = len(fixes.nodes), own.poses[fixes.nodes, :, :3]
        measured = np.tile(np.eye(3, 4), (count, 1, 1))
        measured[:, :, 3] = self.laid.apply(fixes.positions) - fixes.behind
        root, shared = np.zeros((count, 6, 6)), np.zeros((count, 6, 4))
        root[:, [0, 1, 2], [0, 1, 2]] = 1.0 / self.sigma
        # The arm that is stated less the true one.
        shared[:, :3, :3], shared[:, :3, 3] = LEVER_SIGMA_M * turns, OFFSET_SIGMA_S * self.clocked * fixes.velocity
        components = int(np.isfinite(self.sigma).sum())
        return Factors.of(in_place(fixes.nodes), measured, root, components, shared, np.tile(self.lever, (count, 1)))


@dataclass(frozen=True)
class VerticalPrior:
    """Direction of ``up`` (frame, 3) in the left cameras, NaN of none, with its standard deviation, rad."""

    up: Floats
    sigma: float
    shared_errors = ()

    def contradiction(self, own: OwnTrajectory) -> str:
        """Why the camera's turns contradict the direction of up; empty: they do not."""
        up = self.up[own.rows]
        for k in np.unique(own.piece[np.isfinite(up).all(1)]):
            rows = np.flatnonzero((own.piece == k) & np.isfinite(up).all(1))
            above = np.einsum("nij,nj->ni", own.poses[rows, :, :3], up[rows])
            mean = np.broadcast_to(above.mean(0) / np.linalg.norm(above.mean(0)), above.shape)
            _, why = departure(mean, above, MIN_TURN + MIN_SIGMAS * self.sigma, "directions")
            if why:
                return why
        return ""

    def factors(self, own: OwnTrajectory, late: float) -> Factors:
        """Factors of the direction of up in the place; its clock plays no part."""
        up = self.up[own.rows]
        nodes = np.flatnonzero(np.isfinite(up).all(1))
        R = own.poses[nodes, :, :3]
        above = np.einsum("nij,nj->ni", R, up[nodes])
        # The smallest turn that takes it to z leaves the heading as it is, which gravity does not tell.
        axis = np.cross(above, [0.0, 0.0, 1.0])
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        turn = axis * np.arctan2(length, above[:, 2:]) / np.maximum(length, 1e-12)
        T = np.concatenate([rotation_exp(turn) @ R, np.zeros((len(nodes), 3, 1))], axis=2)
        root = np.zeros((len(nodes), 6, 6))
        root[:, [3, 4], [3, 4]] = 1.0 / self.sigma
        return Factors.of(in_place(nodes), T, root, 2)


def in_place(nodes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Ends (k, 2) of factors from the place to some nodes."""
    return np.stack([np.full(len(nodes), -1), nodes], axis=1)


def fit_plane(positions: Floats, antenna: Floats) -> RigidTransform:
    """How positions (k, 3) are turned about the vertical and shifted to the antenna's (k, 3)."""
    R = np.eye(3)
    R[:2, :2], _ = umeyama(positions[:, :2], antenna[:, :2])
    return RigidTransform(R, antenna.mean(0) - R @ positions.mean(0))


def laid_on_fixes(fixes: Fixes, own: OwnTrajectory) -> tuple[RigidTransform, OwnTrajectory] | None:
    """How positions are laid on the first piece that has enough of them, and the other such pieces on these positions.

    None where no piece has enough.
    """
    first, *others = pieces_with_fixes(fixes, own.piece) or (-1,)
    if first < 0:
        return None
    mine, poses, piece = own.piece[fixes.nodes], own.poses, own.piece
    laid = fit_plane(fixes.positions[mine == first], fixes.antenna[mine == first])
    for k in others:
        move = fit_plane(fixes.antenna[mine == k], laid.apply(fixes.positions[mine == k]))
        poses, piece = moved(poses, piece == k, move), np.where(piece == k, piece.dtype.type(first), piece)
    return laid, own._replace(poses=poses, piece=piece)


def pieces_with_fixes(fixes: Fixes, piece: NDArray[np.int16]) -> list[int]:
    """Numbers of the pieces that have positions beside enough nodes to be laid on them."""
    beside = np.bincount(piece[np.unique(fixes.nodes)])
    return [int(k) for k, count in enumerate(beside) if count >= MIN_FIXES]


def anchor(pose: Floats) -> Factors:
    """Factor of the place known beforehand, by the pose (3, 4) of node 0: it is about upright in the world."""
    # 5 degrees: of the world's vertical against that of the place: a plane of ground is a slope.
    root = np.diag([1e-3] * 3 + [1.0 / math.radians(5.0)] * 2 + [0.1])[None]
    return Factors.of(np.array([[-1, 0]]), pose[None], root)
