"""What other sensors say of the trajectory, as factors of its pose graph; and whether the camera's own chain agrees.

Dead reckoning and attitude say how frames stand to each other, also across a gap of the chain; positions and the
vertical say how frames stand in a *place*, a node of its own near the world, whose pose is found, too: positions are of
a frame of their own. Beside errors of each measurement a sensor has some that all of its measurements share (scale and
turn of dead reckoning, a constant offset of its clock), which are sources of the graph.

A sensor that was mounted, timed or read otherwise than stated departs from the chain by more than errors of either. Of
vectors a (ways or turns by the chain) and b (by the sensor), the matrix Q and the scale s are sought for which s Q b is
nearest to a (Schoenemann 1966, doi:10.1007/BF02289451): they tell a turned mount, exchanged axes and a wrong unit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import RigidTransform, orthonormal, rotation_exp, rotation_log
from rille.stages.odometry.pose_graph import (
    EXCESS,
    MAJORITY,
    Adjusted,
    Factors,
    GraphState,
    PoseGraph,
    adjust,
    bound_of,
)

LEVER_SIGMA_M = 0.05
"""Of each component of a lever arm that is stated."""
OFFSET_SIGMA_S = 0.5
"""Of a sensor's clock against the camera's, before anything is known of it."""
MIN_STEP_SHARE = 0.05
"""Of the median step: dead reckoning at rest is not exact."""
VERTICAL_SIGMA = math.radians(5.0)
"""Of the world's vertical against that of the place: a plane of ground is a slope."""
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
MAX_SIGMA_SHARE = 0.1
"""Of the standard deviation that a clock's offset had before, up to which it is determined."""
MIN_LATE_S = 0.005
"""Offset of a clock that is not worth a word."""
MANY_LEFT_OUT = 0.05
"""Share of a sensor's measurements from which on those that were left out are worth a word."""
MAX_SHARED_SIGMAS = 4.0
"""Standard deviations of what all measurements of a sensor share, from which on it is wrong."""
SHARED_ERRORS = {
    "odometry": ("scale", "turn about x", "turn about y", "turn about z"),
    "positions": ("lever arm along x", "lever arm along y", "lever arm along z"),
}
"""Sources of each sensor before that of its clock, in the left camera's frame."""
REMEDY = {
    "odometry": "correct T_body_left, unit or time_offset, or raise drift and turn_deg",
    "attitude": "correct T_body_left (T_imu_left), the order of its columns or time_offset, or raise sigma_deg",
    "positions": "correct columns, unit, lever_arm or time_offset, or raise sigma",
    "up": "correct T_body_left (T_imu_left), the order of its columns or up, or raise sigma_deg",
}
MIN_FIXES = 3
"""Positions of a piece from which on it is laid on them."""
MAX_GAP_STEPS = 3.0
"""Median steps of the camera over which its way is interpolated to the time of a position."""


def between(poses: Floats, a: NDArray[np.intp], b: NDArray[np.intp]) -> Floats:
    """Poses ``T_a_b`` (m, 3, 4) of rows of poses (n, 3, 4)."""
    back = np.swapaxes(poses[a, :, :3], 1, 2)
    way = np.einsum("mij,mj->mi", back, poses[b, :, 3] - poses[a, :, 3])
    return np.concatenate([back @ poses[b, :, :3], way[:, :, None]], axis=2)


def resampled(poses: Floats, times: Floats, shift: float) -> Floats:
    """Poses (n, 3, 4) of moments that are ``shift`` seconds later; NaN beyond the ends and beside frames without."""
    if shift == 0.0:
        return poses
    at = times + shift
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    part = ((at - times[k]) / (times[k + 1] - times[k]))[:, None]
    step = between(poses, k, k + 1)
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
        motion = between(poses, a, b)
        way, count, clock = np.linalg.norm(motion[:, :, 3], axis=1), len(a), np.zeros((len(a), 6))
        if self.times is not None and own is not None and count:
            times = self.times[self.rows]
            half = 0.5 * float(np.median(np.diff(times)))
            # Of the camera, not of the sensor: the derivative of the sensor's noise would look like a motion.
            early, late = (between(resampled(own, times, s), a, b) for s in (-half, half))
            turned = rotation_log(late[:, :, :3] @ np.swapaxes(early[:, :, :3], 1, 2))
            clock = np.nan_to_num(np.concatenate([late[:, :, 3] - early[:, :, 3], turned], axis=1)) / (2.0 * half)
        root, used = np.zeros((count, 6, 6)), slice(3, 6)
        if not self.drift:
            sigma, shared = np.full((count, 3), self.turn), OFFSET_SIGMA_S * clock[:, :, None]
        else:
            step = np.maximum(way, MIN_STEP_SHARE * np.median(way) if count else 0.0)[:, None]
            sigma, used = np.repeat(step * [self.drift, self.turn], 3, axis=1), slice(0, 6)
            scale = np.concatenate([self.drift * motion[:, :, 3], np.zeros((count, 3))], axis=1)
            turns = np.concatenate([np.zeros((count, 3, 3)), self.turn * way[:, None, None] * np.eye(3)], axis=1)
            shared = np.concatenate([scale[:, :, None], turns, OFFSET_SIGMA_S * clock[:, :, None]], axis=2)
        root[:, used, used] = np.eye(sigma.shape[1]) / sigma[:, None, :]
        shared[:, : used.start] = 0.0
        bound = np.full(count, bound_of(sigma.shape[1]))
        return Factors(np.stack([a, b], axis=1), motion, root, shared, np.zeros((count, 3)), bound)

    def contradiction(self, poses: Floats, piece: NDArray[np.int16]) -> str:
        """Why the camera's own poses (n, 3, 4), in pieces, contradict the sensor at all clocks; empty: they do not."""
        shifts = [0.0] if self.times is None else sorted(np.linspace(-OFFSET_SIGMA_S, OFFSET_SIGMA_S, 21), key=abs)
        return min((self._contradiction(self.at(shift), poses, piece) for shift in shifts), key=lambda one: one[0])[1]

    def _contradiction(self, sensed: Floats, poses: Floats, piece: NDArray[np.int16]) -> tuple[float, str]:
        """By which share of the camera's ways or turns these poses (n, 3, 4) depart; and why that is too much."""
        rows = np.flatnonzero(np.isfinite(sensed).all((1, 2)))
        lag = max(len(rows) // WINDOWS, 1)
        a, b = rows[:-lag], rows[lag:]
        a, b = a[piece[a] == piece[b]], b[piece[a] == piece[b]]
        own, said = between(poses, a, b), between(sensed, a, b)
        if not self.drift:
            vectors, unit = (rotation_log(own[:, :, :3]), rotation_log(said[:, :, :3])), "turns"
            if not len(a) or np.sqrt((vectors[0] ** 2).sum(1).mean()) < MIN_TURN:
                return 0.0, ""
            allowed = self.turn / np.sqrt((vectors[0] ** 2).sum(1).mean())
        else:
            vectors, unit = (own[:, :, 3], said[:, :, 3]), "ways"
            # A turn that grows along the way leads it aside by half as much.
            length = float(np.linalg.norm(vectors[0], axis=1).mean()) if len(a) else 0.0
            allowed = self.drift + 0.5 * self.turn * length
        return departure(*vectors, CAMERA_SHARE + MIN_SIGMAS * float(allowed), unit) if len(a) else (0.0, "")


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
        reads.append(f"its lengths have to be multiplied by {scale:.3g}")
    fits = f"; {' and '.join(reads)}, which leaves {left:.1%}" if reads and left < 0.5 * off else ""
    return off, f"its {what} depart from the camera's by {off:.1%}, where {allowed:.1%} is possible{fits}"


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
    centre, origin = antenna.mean(0), positions.mean(0)
    a, b = (v[:, 0] + 1j * v[:, 1] for v in (positions - origin, antenna - centre))
    R = rotation_exp([0.0, 0.0, float(np.angle((np.conj(a) * b).sum()))])
    return RigidTransform(R, centre - R @ origin)


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
    poses, piece, mine = poses.copy(), piece.copy(), piece[fixes.nodes]
    laid = fit_plane(fixes.positions[mine == first], fixes.antenna[mine == first])
    for k in others:
        move = fit_plane(fixes.antenna[mine == k], laid.apply(fixes.positions[mine == k]))
        rows = piece == k
        poses[rows] = [(move @ RigidTransform.from_matrix(T)).matrix34 for T in poses[rows]]
        piece[rows] = first
    return laid, poses, piece


def enough(fixes: Fixes, piece: NDArray[np.int16]) -> list[int]:
    """Numbers of the pieces that have enough positions to be laid on them."""
    return [int(k) for k, count in enumerate(np.bincount(piece[fixes.nodes])) if count >= MIN_FIXES]


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
    ends = np.stack([np.full(count, -1), fixes.nodes], axis=1)
    bound = np.full(count, bound_of(int(np.isfinite(prior.sigma).sum())))
    return Factors(ends, measured, root, shared, np.tile(prior.lever, (count, 1)), bound)


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
    bound = np.full(len(nodes), bound_of(2))
    ends = np.stack([np.full(len(nodes), -1), nodes], axis=1)
    return Factors(ends, T, root, np.zeros((len(nodes), 6, 0)), np.zeros((len(nodes), 3)), bound)


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


def anchor(pose: Floats) -> Factors:
    """What is known of the place beforehand, by the pose (3, 4) of node 0: it is about upright in the world."""
    root = np.diag([1e-3] * 3 + [1.0 / VERTICAL_SIGMA] * 2 + [0.1])[None]
    none = np.zeros((1, 6, 0)), np.zeros((1, 3)), np.full(1, np.inf)
    return Factors(np.array([[-1, 0]]), pose[None], root, *none)


class Clock(NamedTuple):
    """By how much (s) a sensor's times are late against the camera's, and the standard deviation of that."""

    late: float = 0.0
    sigma: float = OFFSET_SIGMA_S

    @property
    def determined(self) -> bool:
        """Whether the motion changes enough to tell."""
        return self.sigma < MAX_SIGMA_SHARE * OFFSET_SIGMA_S


@dataclass
class Sensors:
    """Other sensors of a trajectory whose ``times`` (n,) are those of its nodes; ``lines`` collects what is noticed.

    ``up`` (n, 3) is the direction of up in the left cameras, NaN of none, with its ``up_sigma``, rad. ``timed``: times
    are seconds, so that clocks are compared; ``georeferenced``: the world has a place on Earth. ``fit`` lays positions
    on the world. ``facts`` of each sensor.
    """

    relative: list[RelativePrior]
    positions: PositionPrior | None
    up: Floats
    up_sigma: float
    times: Floats
    timed: bool
    georeferenced: bool
    lines: list[str] = field(default_factory=list)
    fit: RigidTransform | None = None
    facts: dict[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(given: Mapping[str, Any], rows: NDArray[np.intp]) -> Sensors:
        """Of the argument of stage ``adjust``; ``rows`` are the frames that are nodes."""

        def stacked(name: str, key: str, shape: tuple[int, ...]) -> Floats:
            entries, missing = given.get(name, {}).get(key, [None] * len(times)), np.full(shape, np.nan)
            return np.array([missing if one is None else np.reshape(one, shape) for one in entries])

        timed = bool(given.get("timed", False))
        times = np.array(given.get("times", np.arange(rows.max(initial=0) + 1)), dtype=np.float64)
        clock = times if timed else None
        relative = []
        if "odometry" in given:
            odometry, poses = given["odometry"], stacked("odometry", "poses", (3, 4))
            relative.append(RelativePrior("odometry", poses, rows, clock, odometry["drift"], odometry["turn"]))
        if "attitude" in given:
            R = stacked("attitude", "rotations", (3, 3))
            poses = np.concatenate([R, np.where(np.isnan(R[:, :, :1]), np.nan, 0.0)], axis=2)
            relative.append(RelativePrior("attitude", poses, rows, clock, 0.0, given["attitude"]["sigma"]))
        positions = PositionPrior.of(given["positions"]) if "positions" in given else None
        up, up_sigma = stacked("up", "directions", (3,))[rows], float(given.get("up", {}).get("sigma", 1.0))
        return Sensors(relative, positions, up, up_sigma, times[rows], timed, bool(given.get("georeferenced", False)))

    def believe(self, poses: Floats, piece: NDArray[np.int16]) -> None:
        """Leave out the sensors that contradict the camera's own chain (n, 3, 4), and say so."""
        why = {sensor.name: sensor.contradiction(poses, piece) for sensor in self.relative}
        if self.positions is not None:
            fixes = fixes_of(self.positions, poses, piece, self.times, 0.0)
            why["positions"] = position_contradiction(fixes, self.positions.sigma, piece)
        why["up"] = vertical_contradiction(self.up, self.up_sigma, poses, piece)
        for name, reason in why.items():
            if reason:
                self._refuse(name, reason)

    def _refuse(self, name: str, reason: str) -> None:
        self.relative = [sensor for sensor in self.relative if sensor.name != name]
        self.positions = None if name == "positions" else self.positions
        self.up = np.full_like(self.up, np.nan) if name == "up" else self.up
        self.facts[name] = {"used": False, "why": reason}
        self.lines.append(f"[{name}] contradicts the images and is not used: {reason}: {REMEDY[name]}")

    def laid(self, poses: Floats, piece: NDArray[np.int16]) -> tuple[Floats, NDArray[np.int16]]:
        """Poses (n, 3, 4) and pieces (n,) with those pieces joined that positions join."""
        if self.positions is None:
            return poses, piece
        found = placed(fixes_of(self.positions, poses, piece, self.times, 0.0), poses, piece)
        if found is None:
            self._refuse("positions", f"no piece has {MIN_FIXES} of them")
            return poses, piece
        self.fit, poses, piece = found
        return poses, piece

    def adjusted(self, poses: Floats, nodes: NDArray[np.intp], known: Factors) -> Adjusted | None:
        """A piece adjusted to its chain and stated factors (``known``) and to the sensors; None: nothing to adjust.

        Parameters
        ----------
        poses : (n, 3, 4) in a common frame; the place is a node behind them.
        nodes : (n,) numbers of these nodes in the trajectory.
        """
        clocks, count, common = dict[str, Clock](), len(known.ends), known.shared.shape[2]
        done = None
        # Clocks first, by which what is left of the errors then tells more of the chain's.
        for excesses in ((1.0,), (1.0,), EXCESS, EXCESS, EXCESS):
            groups = self._groups(poses, nodes, clocks)
            if not groups and not known.doubtful.any():
                return None
            factors = Factors.joined([known, *groups.values(), anchor(poses[0])])
            ends = np.where(factors.ends < 0, len(nodes), factors.ends)
            graph = PoseGraph(replace(factors, ends=ends), len(nodes) + 1, 0, np.ones(len(ends)), common=common)
            start = GraphState.of(np.concatenate([poses, np.eye(3, 4)[None]]), factors.shared.shape[2])
            done = adjust(graph, start, excesses)
            if excesses == EXCESS and not self._refused(groups, done, count, common):
                break
            clocks = self._clocks(groups, clocks, done, common)
        assert done is not None
        clocks = self._clocks(groups, clocks, done, common)
        self._account(clocks, done.state.poses[-1])
        return done

    def _groups(self, poses: Floats, nodes: NDArray[np.intp], clocks: Mapping[str, Clock]) -> dict[str, Factors]:
        """Factors of each sensor that says something of these nodes, by clocks as they are known."""
        groups, times = dict[str, Factors](), self.times[nodes]
        for one in self.relative:
            groups[one.name] = replace(one, rows=one.rows[nodes]).factors(clocks.get(one.name, Clock()).late, poses)
        if self.positions is not None and self.fit is not None:
            same = np.zeros(len(nodes), np.int16)
            fixes = fixes_of(self.positions, poses, same, times, clocks.get("positions", Clock()).late)
            groups["positions"] = position_factors(fixes, self.fit, self.positions, poses)
            if not self.timed:
                groups["positions"].shared[:, :, 3] = 0.0
        groups["up"] = vertical_factors(self.up[nodes], self.up_sigma, poses)
        return {name: factors for name, factors in groups.items() if len(factors.ends)}

    def _refused(self, groups: Mapping[str, Factors], done: Adjusted, first: int, column: int) -> bool:
        """Whether a sensor is not believed: most was left out, or what all share is far off its standard deviation.

        Parameters
        ----------
        first, column : number of the first factor and of the first source of the sensors.
        """
        refused = False
        for name, factors in groups.items():
            kept = done.kept[first : first + len(factors.ends)]
            # Clocks are found, whatever they are: the last source is no error.
            shared = done.state.sources[column : max(column + factors.shared.shape[2] - 1, column)]
            first, column = first + len(kept), column + factors.shared.shape[2]
            worst = int(np.argmax(np.abs(shared))) if len(shared) else -1
            self.facts[name] = {"used": True, "measurements": len(kept), "left_out": int((~kept).sum())}
            why = ""
            if np.mean(kept) < MAJORITY:
                why = f"{(~kept).sum()} of its {len(kept)} measurements contradict the others"
            elif worst >= 0 and abs(shared[worst]) > MAX_SHARED_SIGMAS:
                why = f"its {SHARED_ERRORS[name][worst]} is off by {abs(shared[worst]):.0f} standard deviations"
            if why:
                refused = True
                self._refuse(name, why)
        return refused

    def _clocks(
        self, groups: Mapping[str, Factors], before: Mapping[str, Clock], done: Adjusted, first: int
    ) -> dict[str, Clock]:
        """Clocks as an adjustment finds them: the last source of each sensor that has one."""
        sigmas, clocks = done.graph.source_sigmas(done.state), dict[str, Clock]()
        for name, factors in groups.items():
            first += factors.shared.shape[2]
            if self.timed and name != "up":
                late = before.get(name, Clock()).late + OFFSET_SIGMA_S * float(done.state.sources[first - 1])
                clock = Clock(late, OFFSET_SIGMA_S * float(sigmas[first - 1]))
                # Taken over where nothing shows it, it would wander from one adjustment to the next.
                clocks[name] = clock if clock.determined else clock._replace(late=0.0)
        return clocks

    def _account(self, clocks: Mapping[str, Clock], place: Floats) -> None:
        """Facts and lines of the sensors that were used; ``place`` (3, 4) is its pose in the world."""
        for name, clock in clocks.items():
            self.facts[name] |= {
                "late_s": clock.late,
                "late_sigma_s": clock.sigma,
                "clock_determined": clock.determined,
            }
            if not clock.determined:
                self.lines.append(f"[{name}] the offset of its clock is not determined: the motion changes too little")
            elif abs(clock.late) > max(MIN_SIGMAS * clock.sigma, MIN_LATE_S):
                self.lines.append(
                    f"[{name}] its times are {clock.late:.3f} s late (standard deviation {clock.sigma:.3f} s), which "
                    f"is taken into account: add {-clock.late:.3f} to its time_offset"
                )
        for name, fact in self.facts.items():
            # One in a hundred is to be expected.
            if fact.get("left_out", 0) > MANY_LEFT_OUT * fact.get("measurements", 0):
                count = f"{fact['left_out']} of {fact['measurements']}"
                self.lines.append(f"[{name}] {count} of its measurements contradict the others and are left out")
        if self.fit is not None and self.positions is not None:
            there = (RigidTransform.from_matrix(place) @ self.fit).inverse()
            origin, ahead = there.translation, there.rotation[:, 1]
            azimuth = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
            self.facts["place"] = {"origin": origin.tolist(), "azimuth_deg": azimuth}
            if not self.georeferenced:
                where = ", ".join(f"{v:.2f}" for v in origin)
                text = f"[positions] in their frame world.origin is [{where}] and world.azimuth_deg is {azimuth:.2f}"
                self.lines.append(f"{text}: state these with world.crs, and maps lie there")
