"""Other sensors beside the camera: which of them are believed, how late their clocks are, and what is said of them.

Their factors are those of :mod:`rille.stages.odometry.resection.sensors`; a sensor that contradicts the chain
(:mod:`rille.stages.odometry.resection.contradiction`), or most of whose factors the adjusted graph leaves out, is not
used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.odometry.pose_graph import EXCESS, MAJORITY, Adjusted, Factors, GraphState, PoseGraph, adjust
from rille.stages.odometry.resection.contradiction import (
    MIN_SIGMAS,
    motion_contradiction,
    position_contradiction,
    vertical_contradiction,
)
from rille.stages.odometry.resection.sensors import (
    MIN_FIXES,
    OFFSET_SIGMA_S,
    PositionPrior,
    RelativePrior,
    anchor,
    fixes_of,
    placed,
    position_factors,
    vertical_factors,
)

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
        why = {sensor.name: motion_contradiction(sensor, poses, piece) for sensor in self.relative}
        if self.positions is not None:
            fixes = fixes_of(self.positions, poses, piece, self.times, 0.0)
            why["positions"] = position_contradiction(fixes, self.positions.sigma, piece)
        why["up"] = vertical_contradiction(self.up, self.up_sigma, poses, piece)
        for name, reason in why.items():
            if reason:
                self._refuse(name, reason, "contradicts the images and ")

    def _refuse(self, name: str, reason: str, how: str = "") -> None:
        self.relative = [sensor for sensor in self.relative if sensor.name != name]
        self.positions = None if name == "positions" else self.positions
        self.up = np.full_like(self.up, np.nan) if name == "up" else self.up
        self.facts[name] = {"used": False, "why": reason}
        self.lines.append(f"[{name}] {how}is not used: {reason}: {REMEDY[name]}")

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
