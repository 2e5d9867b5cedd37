"""Other sensors beside the camera: which of them are used, the offsets of their clocks, and the warnings about them.

Their measurements are factors (:mod:`rille.stages.odometry.resection.sensors`). A sensor that contradicts the chain, or
most of whose factors the adjusted graph leaves out, is not used.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.odometry.pose_graph import (
    EXCESS,
    MAJORITY,
    MAX_SOURCE,
    Adjusted,
    Factors,
    GraphState,
    PoseGraph,
    adjust,
)
from rille.stages.odometry.resection.sensors import (
    MIN_FIXES,
    MIN_SIGMAS,
    OFFSET_SIGMA_S,
    OwnTrajectory,
    PositionPrior,
    RelativePrior,
    Sensor,
    VerticalPrior,
    anchor,
    laid_on_fixes,
)

MIN_LEAN = math.radians(0.05)
"""Lean of the world against the vertical below which no line is given: 1 mm a metre."""
REMEDY = {
    "odometry": "correct T_body_left, unit, time_offset, the quaternions' order or the poses' direction (body to "
    "world), or raise drift and turn_deg",
    "attitude": "correct T_body_left (T_imu_left), the order of its columns or time_offset, or raise sigma_deg",
    "positions": "correct columns, unit, lever_arm or time_offset, or raise sigma",
    "up": "correct T_body_left (T_imu_left), the order of its columns or up, or raise sigma_deg",
}
TITLES = {name: f"[{name}]" for name in REMEDY} | {"up": "[attitude] or [imu]: the vertical"}
"""Sensors by the tables of a manifest that state them."""
UNLEVEL = "positions are turned about the vertical alone, and nothing tells of the vertical"


class Clock(NamedTuple):
    """Delay, s, of a sensor's times against the camera's, and its standard deviation."""

    late: float = 0.0
    sigma: float = OFFSET_SIGMA_S

    @property
    def determined(self) -> bool:
        """Whether the motion changes enough to tell."""
        # 0.1: of the standard deviation that a clock's offset had before, up to which it is determined.
        return self.sigma < 0.1 * OFFSET_SIGMA_S


@dataclass
class Sensors:
    """Other sensors of a trajectory by name; ``lines`` collects what is noticed.

    ``times`` (frame,) of all frames; ``timed``: they are seconds, so that clocks are compared; ``georeference``: the
    place of the world on Earth, where it is stated; ``first``: number of the run's first frame. ``facts`` of each
    sensor; ``alone``: the factor on the camera's errors that places seen again ask for.
    """

    used: dict[str, Sensor]
    times: Floats
    timed: bool
    georeference: Mapping[str, Any] | None
    first: int
    lines: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    alone: float = 1.0

    @staticmethod
    def of(given: Mapping[str, Any], frames: Sequence[int]) -> Sensors:
        """Read the argument of stage ``adjust``, which has these frames."""

        def stacked(name: str, key: str, shape: tuple[int, ...]) -> Floats:
            missing = np.full(shape, np.nan)
            return np.array([missing if one is None else np.reshape(one, shape) for one in given[name][key]])

        timed = bool(given.get("timed", False))
        times, used = np.array(given.get("times", np.arange(len(frames))), dtype=np.float64), dict[str, Sensor]()
        clock = times if timed else None
        if "odometry" in given:
            stated, poses = given["odometry"], stacked("odometry", "poses", (3, 4))
            plane = {name: np.array(stated.get(name, np.zeros(3)), dtype=np.float64) for name in ("up", "origin")}
            used["odometry"] = RelativePrior(poses, clock, stated["drift"], stated["turn"], **plane)
        if "attitude" in given:
            R = stacked("attitude", "rotations", (3, 3))
            poses = np.concatenate([R, np.where(np.isnan(R[:, :, :1]), np.nan, 0.0)], axis=2)
            used["attitude"] = RelativePrior(poses, clock, 0.0, given["attitude"]["sigma"])
        if "positions" in given:
            used["positions"] = PositionPrior.of(given["positions"], clocked=timed)
        if "up" in given:
            used["up"] = VerticalPrior(stacked("up", "directions", (3,)), float(given["up"]["sigma"]))
        return Sensors(used, times, timed, given.get("georeference"), frames[0])

    def drop_contradicting(self, own: OwnTrajectory, *, upright: bool) -> None:
        """Leave out the sensors that contradict the camera's own chain, and say so; ``upright``: its z is known."""
        for name, sensor in list(self.used.items()):
            if reason := sensor.contradiction(own):
                if name == "positions" and not upright:
                    self._refuse(name, UNLEVEL, "", "state world.up")
                else:
                    self._refuse(name, reason, "contradicts the images and ")

    def _refuse(self, name: str, reason: str, how: str = "", remedy: str = "") -> None:
        del self.used[name]
        self.facts[name] = {"used": False, "why": reason}
        # Each pair was levelled by it before there was a trajectory.
        use = "is not used for the trajectory, though elevations are levelled by it" if name == "up" else "is not used"
        self.lines.append(f"{TITLES[name]} {how}{use}: {reason}: {remedy or REMEDY[name]}")

    def relative_factors(self, own: OwnTrajectory) -> list[Factors]:
        """Factors of ways between frames, which may join pieces, clocks being right."""
        ways = (one for one in self.used.values() if isinstance(one, RelativePrior) and one.drift)
        return [sensor.factors(own, 0.0) for sensor in ways]

    def joined_by_positions(self, own: OwnTrajectory) -> OwnTrajectory:
        """The trajectory with those pieces joined that positions join."""
        if not isinstance(positions := self.used.get("positions"), PositionPrior):
            return own
        found = laid_on_fixes(positions.fixes(own), own)
        if found is None:
            self._refuse("positions", f"no piece has {MIN_FIXES} of them", remedy="give more at the images' times")
            return own
        self.used["positions"] = replace(positions, laid=found[0])
        return found[1]

    def adjusted(self, own: OwnTrajectory, known: Factors) -> tuple[NDArray[np.int32], Adjusted | None]:
        """A piece adjusted to its chain and stated factors (``known``) and to the sensors; None: nothing to adjust.

        None as well where the factors that are kept do not hold the piece together; with the parts (nodes,) of it that
        they do hold. The place is a node behind those of the piece.
        """
        clocks, nodes, common = dict[str, Clock](), len(own.poses), known.shared.shape[2]
        done, whole = None, np.zeros(nodes, np.int32)
        self.alone = max(self.alone, alone := self._alone(own, known))
        # First the clocks: the remaining errors then show better by how much the chain's exceed its covariances.
        for last in (False, False, True, True, True):
            said = {name: one.factors(own, clocks.get(name, Clock()).late) for name, one in self.used.items()}
            groups = {name: factors for name, factors in said.items() if len(factors.ends)}
            if last:
                unknown = [name for name in groups if name in clocks and not clocks[name].determined]
                groups |= {name: _held(groups[name]) for name in unknown}
            if not groups and not known.doubtful.any():
                return whole, None
            factors = Factors.joined([known, *groups.values(), anchor(own.poses[0])])
            ends = np.where(factors.ends < 0, nodes, factors.ends)
            graph = PoseGraph(replace(factors, ends=ends), nodes + 1, np.ones(len(ends)), common=common)
            start = GraphState.of(np.concatenate([own.poses, np.eye(3, 4)[None]]), factors.shared.shape[2])
            if (parts := graph.parts(np.ones(len(ends), bool))).any():
                return parts[:-1], None
            done = adjust(graph, start, *(_permitted(alone, groups) if last else ((1.0,),)))
            if (parts := graph.parts(done.kept)).any():
                return parts[:-1], None
            if last and not self._refused(groups, done, len(known.ends), common):
                break
            clocks = self._clocks(groups, clocks, done, common)
        assert done is not None
        clocks = self._clocks(groups, clocks, done, common)
        self._account(groups, clocks)
        if "positions" in groups and isinstance(positions := self.used.get("positions"), PositionPrior):
            self._locate(done, positions, _slide(said["positions"], clocks.get("positions", Clock())))
            # A jump of heights looks like a slope.
            if not self._contradicted("positions"):
                self._level(done)
        return whole, done

    def _alone(self, own: OwnTrajectory, known: Factors) -> float:
        """Factor on the camera's errors that places seen again ask for; infinite if they do not hold a piece together,
        so that it is not known."""
        graph = PoseGraph(known, len(own.poses), np.ones(len(known.ends)), common=known.shared.shape[2])
        if not known.doubtful.any() or not self.used:
            return 1.0
        if graph.parts(np.ones(len(known.ends), bool)).any():
            return math.inf
        return adjust(graph, GraphState.of(own.poses, graph.common)).graph.excess

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
            elif worst >= 0 and abs(shared[worst]) > MAX_SOURCE:
                error = self.used[name].shared_errors[worst]
                off = abs(float(shared[worst]))
                why = f"its {error.name} is off by {off * error.sigma:.2g}{error.unit}, {off:.0f} standard deviations"
            if why:
                refused = True
                self._refuse(name, why)
        if not refused and done.strained and groups:
            # A vertical is the first that accelerations mislead, and comes last.
            self._refuse(list(groups)[-1], "the camera's motions cannot be as far off as that")
            return True
        return refused

    def _clocks(
        self, groups: Mapping[str, Factors], before: Mapping[str, Clock], done: Adjusted, first: int
    ) -> dict[str, Clock]:
        """Clocks as an adjustment finds them: the last source of each sensor that has one."""
        sigmas, clocks = done.graph.source_sigmas(done.state), dict[str, Clock]()
        for name, factors in groups.items():
            first += factors.shared.shape[2]
            if name in before and not factors.shared[:, :, -1].any():
                clocks[name] = before[name]
            elif self.timed and name != "up":
                late = before.get(name, Clock()).late + OFFSET_SIGMA_S * float(done.state.sources[first - 1])
                clock = Clock(late, OFFSET_SIGMA_S * float(sigmas[first - 1]))
                # Taken over where nothing shows it, it would wander from one adjustment to the next.
                clocks[name] = clock if clock.determined else clock._replace(late=0.0)
        return clocks

    def _account(self, groups: Collection[str], clocks: Mapping[str, Clock]) -> None:
        """Facts and lines of the sensors that a piece was adjusted to."""
        for name, clock in clocks.items():
            self.facts[name] |= {
                "late_s": clock.late,
                "late_sigma_s": clock.sigma,
                "clock_determined": clock.determined,
            }
            if not clock.determined:
                self.lines.append(
                    f"[{name}] the offset of its clock is not determined and taken as 0: the motion changes too little"
                )
            elif abs(clock.late) > max(MIN_SIGMAS * clock.sigma, 0.005):
                self.lines.append(
                    f"[{name}] its times are {clock.late:.3f} s late (standard deviation {clock.sigma:.3f} s), which "
                    f"is taken into account: add {-clock.late:.3f} to its time_offset"
                )
        for name in groups:
            if self._contradicted(name):
                count = f"{self.facts[name]['left_out']} of {self.facts[name]['measurements']}"
                self.lines.append(f"{TITLES[name]} {count} of its measurements contradict the others and are left out")

    def _contradicted(self, name: str) -> bool:
        """Whether those of a sensor's measurements that were left out are worth a word."""
        # 0.05: share of them; one in a hundred is to be expected.
        return bool(self.facts[name].get("left_out", 0) > 0.05 * self.facts[name].get("measurements", 0))

    def _locate(self, done: Adjusted, prior: PositionPrior, slide: float) -> None:
        """State where the world lies in the frame of positions, unless that is given.

        ``slide``: standard deviation of the place, m, by a clock that is taken as right.
        """
        there = (RigidTransform(done.state.R[-1], done.state.C[-1]) @ prior.laid).inverse()
        # The first camera is the origin of a world with a place, though not of one on a plane that is no ground.
        origin, ahead = there.apply(done.state.C[0]), there.rotation[:, 1]
        azimuth = math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0
        self.facts["place"] = {"origin": origin.tolist(), "azimuth_deg": azimuth}
        told = np.isfinite(prior.sigma)
        parts = (f"{v:.2f}" if known else "HEIGHT (not measured)" for v, known in zip(origin, told, strict=True))
        begin = f" of runs that begin at frame {self.first}" if self.first else ""
        named = f"world.origin{begin} is [{', '.join(parts)}] and world.azimuth_deg is {azimuth:.2f}"
        if self.georeference is None:
            unsure = f" (0.1 s of its clock are {slide * 0.1 / OFFSET_SIGMA_S:.2g} m)" if slide else ""
            self.lines.append(
                f"[positions] in their frame {named}{unsure}: state these with world.crs, and maps lie there"
            )
            return
        covariance, R = done.graph.covariance(done.state)[-1], done.state.R[-1]
        # Along the axes of the positions: without heights the place may slide along their vertical, not the world's.
        variances = np.diag(R.T @ covariance[:3, :3] @ R)
        off = float(np.linalg.norm((origin - self.georeference["origin"])[told]))
        turn = math.radians(azimuth) - self.georeference["azimuth"]
        turn = abs(math.remainder(turn, math.tau))
        apart = off > MIN_SIGMAS * math.hypot(math.sqrt(variances[told].sum()), slide)
        turned = turn > max(MIN_SIGMAS * math.sqrt(covariance[5, 5]), MIN_LEAN)
        # 1000.0: distance of the world's origin by positions from the stated one, from which on their frame is another
        # one.
        if off < 1000.0 and (apart or turned):
            text = f"maps lie {off:.2f} m off at the origin and are turned by {math.degrees(turn):.2f} degrees"
            self.lines.append(f"[positions] contradict the stated place: {text}; by them {named}: state these")

    def _level(self, done: Adjusted) -> None:
        """State by how much the world leans against the positions' vertical, if they show it."""
        variances, axes = np.linalg.eigh(done.graph.covariance(done.state)[-1, 3:5, 3:5])
        # The top of z moves by w x z. Along a straight way positions show one turn of two: the other is left as it is.
        x, y, _ = done.state.R[-1, :, 2]
        turns = axes.T @ [-y, x]
        shown = np.abs(turns) > MIN_SIGMAS * np.sqrt(variances)
        size, sigma = math.hypot(*turns[shown]), math.sqrt(variances[shown].sum())
        if size > MIN_LEAN:
            turn = axes[:, shown] @ turns[shown]
            up = done.state.R[0].T @ rotation_exp([*turn, 0.0])[:, 2]
            self.lines.append(
                f"[positions] the world leans by {math.degrees(size):.2f} degrees (standard deviation "
                f"{math.degrees(sigma):.2f}) against their vertical, and elevations with it: for level maps state "
                f"world.up = [{', '.join(f'{v:.4f}' for v in up)}], which is up in the left camera of its first frame"
            )


def _held(factors: Factors) -> Factors:
    """Factors of a sensor whose clock is taken as right: its last source shows in none."""
    return replace(factors, shared=factors.shared * (np.arange(factors.shared.shape[2]) < factors.shared.shape[2] - 1))


def _slide(factors: Factors, clock: Clock) -> float:
    """Way of the antenna in the standard deviation of a clock that is not determined, m; 0: it is."""
    return 0.0 if clock.determined else float(np.linalg.norm(factors.shared[:, :3, -1], axis=1).max())


def _permitted(alone: float, groups: Collection[str]) -> tuple[Sequence[float], float]:
    """Factors on the camera's errors that are tried, and the share of measurements that have to agree with more than
    the first.

    Not all that explains a sensor's contradiction: a camera as loose as that follows any error of the sensor. Only
    positions tell more of a way than the camera does. ``alone``: the factor without sensors.
    """
    if not groups or alone == math.inf:
        return EXCESS, MAJORITY
    permitted = [k for k in EXCESS if k >= alone]
    # 0.95: sensors that say that the camera errs more than stated have to agree with themselves.
    return permitted if "positions" in groups else permitted[:1], 0.95
