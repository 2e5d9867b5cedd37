"""The closed loop, top to bottom: stop, think, drive, and again, as tasks like all others.

Pair, world model, segment and hazards are those of a reconstruction (:mod:`rille.pipeline.flow.builders`).
``Drive.legs`` is the loop: it yields tasks and goes on with their results.

::

    drive/start -> sense -+
                          v
    stop k:  image -> pyramid -> hfvm -> ground_frame -> locus (local) -> locus (world) -> merge (all models so far,
                                           |                          ^                |      start_area, what is near)
                                           |            trajectory -> pose           risk (of both), occlusion_bounds
                                           v               ^   |                             |
                                         resect -----------+   +----> local_planner <--------+
                                           ^                                |
                                           |          goal, no path: end    | drive, turn, look
                                           |                                v
    leg k:   sense <- drive/k (true poses) <- leg, pose (believed), drive/k-1 (where it truly stands)
               |      images on the way -> pyramid -> motion -> track -> resect
               v                                     |                    |
             fault_monitor <------------------------ | -------------------+
             obstacle_monitor <- motion (a baseline apart), locus (local)
               v
             stop k+1 at the last image, or at the one where a monitor stopped

Only ``drive``, ``sense`` and the images know the true poses. The vehicle's own estimate is the trajectory:
the product of the segments that were tracked and resected. A killed drive goes on where it was; a repeated one computes
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from rille.datasets.protocol import Sequence, Simulation
from rille.pipeline.engine.graph import Graph, Handle, MissingError, Wait, done
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.flow.builders import Builder, Pair, Segment, name_graph
from rille.pipeline.flow.products import Driven, Products, Stop
from rille.pipeline.flow.reconstruction import reconstruction
from rille.stages.core.declare import Params
from rille.stages.core.errors import ConfigError, DegenerateError
from rille.stages.core.quantities import count
from rille.stages.driving import obstacle_monitor
from rille.stages.driving.fault_monitor import fault_monitor_stage
from rille.stages.driving.obstacle_monitor import obstacle_monitor_stage
from rille.stages.evaluation.accuracy import accuracy_stage
from rille.stages.evaluation.dem_accuracy import dem_accuracy_stage
from rille.stages.evaluation.drive_check import drive_check_stage
from rille.stages.facts.odometry import TrajectoryFacts
from rille.stages.facts.terrain import MapFixFacts, MergeFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.odometry.motion import motion_stage
from rille.stages.odometry.resection.trajectory import trajectory_stage
from rille.stages.planning.local_planner.look import PlannerMemory
from rille.stages.planning.local_planner.stage import local_planner_stage
from rille.stages.terrain.map_localization import map_localization_stage
from rille.stages.terrain.merge import merge_stage
from rille.stages.terrain.occlusion_bounds import occlusion_bounds_stage
from rille.stages.terrain.start_area import start_area_stage

Sigma = Annotated[float, Field(ge=0)]


class DriveParams(Params):
    """Parameters of the loop; those of a stop and of a leg are in the sections of their stages.

    Attributes
    ----------
    goal : x, y [m] of the goal, in the frame that drive.frame names.
    frame : frame of the goal; world: its origin is the first left camera; map: the global map, where there is one.
    prior : rough pose of the first left camera in the global map: x, y [m], heading [degrees to the left].
    prior_sigma : standard deviations of that pose: position [m], heading [degrees].
    pose : known pose of the first left camera in the global map, used instead of a search: x, y, z [m], heading
        [degrees to the left].
    detail : pixels along the range that a wheel's diameter must cover for ground to be driven on: about a matching
        window, which smooths away what is smaller; ground seen from farther serves for planning alone; 0: no such
        limit.
    around : margin [m] of the map around start and goal.
    max_stops : stops after which the drive is given up; a path of 2.8 m among many rocks took more than 60.
    max_safety_stops : successive safety stops that end the drive.
    """

    goal: tuple[float, float] | None = None
    frame: Literal["world", "map"] = "world"
    prior: tuple[float, float, float] | None = None
    prior_sigma: tuple[Sigma, Sigma] = (0.1, 5.0)
    pose: tuple[float, float, float, float] | None = None
    detail: float = Field(4.0, ge=0)
    around: float = Field(0.6, gt=0)
    max_stops: int = Field(80, ge=1)
    max_safety_stops: int = Field(3, ge=1)


def arena(goal: tuple[float, float], around: float, cell: float) -> Lattice:
    """Return the lattice of a drive's map: ``around`` metres around its start (the origin) and its goal [m]."""
    bounds = [f(0.0, g) + s * around for g in goal for f, s in ((min, -1.0), (max, 1.0))]
    return Lattice.snap(bounds, cell)


@dataclass(frozen=True)
class TrueStand:
    """True pose of the vehicle: the ``frame`` taken there, in this row of the artifact ``before``; its up vector."""

    frame: int
    before: Handle
    row: int
    up: list[float]


@dataclass(frozen=True)
class Way:
    """Record of a leg: its artifact ``drive``, row of each frame there, frames that are not lost, what sensors said."""

    drive: Handle
    rows: dict[int, int]
    frames: list[int]
    sense: Handle
    said: Ref


class EndedError(Exception):
    """The drive is over: verdict and reason."""


class Drive(Builder):
    """A drive that is laid out stop by stop, as results arrive: an ideal camera takes each image from the true pose.

    Attributes
    ----------
    driven : its stops, and how it ended.
    posed : frames of the trajectory so far.
    goal : m, world frame.
    true : true pose of each frame that was taken; read by the renderer and by what assesses, never by an estimate.
    """

    def __init__(self, graph: Graph, sequence: Sequence, config: Any) -> None:
        if sequence.simulation is None or config.drive.goal is None:
            text = f"{sequence.name} has no goal to drive to"
            raise ConfigError("RIL-031", text, remedy="set drive.goal=[x, y], metres")
        if config.locus.cell_size is None:
            text = "a drive needs locus.cell_size"
            raise ConfigError("RIL-032", text, remedy="set it to about an eighth of a wheel, metres")
        d, overview = config.drive, sequence.simulation.overview
        if d.frame == "map" and d.pose is None and (d.prior is None or overview is None):
            text = "drive.frame=map needs drive.pose, or drive.prior and a global map"
            remedy = "set drive.pose=[x, y, z, degrees], or drive.prior and rover.map_cell"
            raise ConfigError("RIL-033", text, remedy=remedy)
        super().__init__(graph, sequence, config)
        self.driven = self.products.drive = Driven()
        self.simulation: Simulation = sequence.simulation
        self.mounting = {"T_vehicle_left": self.simulation.T_vehicle_left.to_list()}
        self.goal: tuple[float, float] = config.drive.goal if d.frame == "map" else self._on_ground(*config.drive.goal)
        self.posed: list[int] = [0]
        self.true: dict[int, tuple[float, ...]] = {}
        self.scene = self.source(self.simulation.scene, "site")
        self.memory = PlannerMemory()
        self.pairs: list[Pair] = []
        self.poses: list[Handle] = []
        self.pads: list[Handle] = []
        self.planned: Handle | None = None
        self.troubles = 0

    def raw_image(self, frame: int, camera: str) -> Handle:
        """One image of the scene as it is now, from the true pose of the frame."""
        source = self.simulation.image(frame, camera, RigidTransform.from_matrix(self.true[frame]))
        return self.source(source, f"image/{camera}/{frame}", {"scene": self.scene})

    def steps(self) -> Generator[Wait, Any, None]:
        """The drive, and its assessment."""
        try:
            yield from self.legs()
        except EndedError as end:
            verdict, reason = end.args
        except MissingError:
            verdict, reason = self.outcome()
        closed = self._closed()
        if verdict == "safety stop" and closed:  # it was but looking around once more
            verdict, reason = "no path", f"{closed}, then a safety stop: {reason}"
        self.driven.verdict, self.driven.reason = verdict, reason
        yield from self._assess()

    def legs(self) -> Generator[Wait, Any, None]:
        """Stop, think, drive, and again, until something ends it.

        Raises
        ------
        EndedError
            It is over.
        """
        place = self.driven.place = self.source(
            self.simulation.place(self.config.vehicle), "drive/start", {"scene": self.scene}
        )
        there, said = yield [place, self.source(self.simulation.sense(-1), "sense/start", {"drive": place})]
        self.true[0] = tuple(there.meta["poses"][0])
        at = TrueStand(0, place, 0, said.meta["up"][0])
        while True:
            stop = self._look(at)
            if stop.index == 0 and self.config.drive.frame == "map":
                # The frame of the first pair is the world.
                T_global_world = (yield from done(self._fix())).meta["T_global_local"]
                given = [*self.config.drive.goal, T_global_world[11]]
                x, y, _ = RigidTransform.from_matrix(T_global_world).inverse().apply(given)
                self.goal = self._on_ground(float(x), float(y))
            plan = yield from self._think(stop, self._map(stop))
            way = yield from self._drive(stop, at, plan)
            at = yield from self._judge(stop, way)

    # -- a stop -------------------------------------------------------------------------------------------------

    def _look(self, at: TrueStand) -> Stop:
        """Stereo pair to local model."""
        p, frame = self.products, at.frame
        stop = Stop(len(self.driven.stops), frame)
        self.driven.stops.append(stop)
        p.disparity[frame] = self.disparity(frame)
        if stop.index == 0:
            p.orientations[frame] = self.orientation(frame)
            p.rigs[frame], known = self.rig([frame], f"/{frame}" if self.config.rig.mode == "per_pair" else "")
        else:
            # One rig for the drive, that of the first pair: cameras do not move against each other on the way.
            p.rigs[frame], known = p.rigs[0], self.pairs[0].rig
        level = self.level(frame, {"up": at.up}, known)
        pair = self.pair(frame, level, known, self.pairs[0] if self.pairs else None)
        p.level[frame] = level
        self.pairs.append(pair)
        return stop

    def _fix(self) -> Handle[MapFixFacts]:
        """Pose of the first pair in the global map: as given, or by its elevation model."""
        d, given, overview = self.config.drive, dict[str, Any](), self.simulation.overview
        if d.pose is not None:
            given["pose"] = [*d.pose[:3], math.radians(d.pose[3])]
        elif overview is not None:  # it and the prior were checked before the drive began
            given["dem"] = self.pairs[0].dem
            given["global_map"] = self.source(overview, "overview", {"scene": self.scene})
            given["prior"] = [*d.prior[:2], math.radians(d.prior[2])]
            given["prior_sigma"] = [d.prior_sigma[0], math.radians(d.prior_sigma[1])]
        self.driven.fix = self.node(map_localization_stage, "map_localization", **given)
        return self.driven.fix

    def _on_ground(self, x: float, y: float) -> tuple[float, float]:
        """Return a goal in the world frame; refuse one beside the ground."""
        x_min, x_max, y_min, y_max = self.simulation.ground
        if not (x_min <= x <= x_max and y_min <= y <= y_max):
            raise ConfigError(
                "RIL-714",
                f"the goal lies at ({x:.3g}, {y:.3g}) m of the world, beside the ground",
                remedy=f"give one within x {x_min:.3g}..{x_max:.3g} and y {y_min:.3g}..{y_max:.3g} m of the world "
                "frame (drive.goal), or a larger bed (mockup.bed_width, mockup.bed_length)",
            )
        return x, y

    def _map(self, stop: Stop) -> Handle:
        """Merge the models so far and judge their hazards; return the upper bounds of the ground."""
        p, k = self.products, stop.index
        found, row = self._located(k), len(self.posed) - 1
        pose = self.world_model(self.pairs[k], self.pairs[0], row, found)
        self.poses.append(pose)
        if k == 0 and self.simulation.pad > 0:  # the ground under the vehicle, which no camera sees
            pad = self.node(
                start_area_stage,
                "start_area",
                pose=pose,
                like=p.world_dem[stop.frame],
                radius=self.simulation.pad,
                wheel_diameter=self.config.vehicle.wheel_diameter,
                **self.mounting,
            )
            self.pads = [pad]
        # Two maps: of all that was seen, to plan far ahead, and of what was seen finely enough to drive on.
        near, finest = self._merged(f"merge/{k}", None), None
        p.world_tiles = [near]
        stop.risk = p.world_risk = self.hazards(f"risk/{k}", [near])
        if self.config.drive.detail > 0:
            stop.far = stop.risk
            finest = self.config.vehicle.wheel_diameter / self.config.drive.detail
            near = self._merged(f"merge/{k}/near", finest)
            stop.risk = self.hazards(f"risk/{k}/near", [near])
        # Also where it was not seen.
        bounds = self.config.occlusion_bounds
        bounds = bounds if finest is None else bounds.model_copy(update={"max_footprint": finest})
        dems = list(p.world_dem.values())
        return self.node(occlusion_bounds_stage, f"occlusion_bounds/{k}", bounds, merged=near, dems=dems)

    def _located(self, legs: int) -> Handle[TrajectoryFacts]:
        """The trajectory over so many legs, which becomes that of the drive."""
        p = self.products
        levels = [pair.level for pair in self.pairs]
        found = p.trajectory = self.node(
            trajectory_stage,
            f"trajectory/{legs}",
            frames=list(self.posed),
            segments=list(p.resections),
            levels=levels[:legs] or levels[:1],
        )
        return found

    def _merged(self, label: str, finest: float | None) -> Handle[MergeFacts]:
        """All models so far, merged; with ``finest`` only ground of which a pixel covers at most so many metres."""
        params = self.config.merge.model_copy(update={} if finest is None else {"max_footprint": finest})
        dems = [*self.pads, *self.products.world_dem.values()]
        return self.node(merge_stage, label, params, dems=dems, lattice=self.arena().to_dict())

    def arena(self) -> Lattice:
        """The part of the world that is mapped."""
        return arena(self.goal, self.config.drive.around, self.config.locus.cell_size)

    def _think(self, stop: Stop, ceiling: Handle) -> Generator[Wait, Any, Handle]:
        """Plan the next leg, which is returned; plan again while a way turns out to be closed."""
        known = {"risk": stop.risk, "far": stop.far, "ceiling": ceiling, "pose": self.poses[-1]}
        known |= {"before": self.planned, "driven": self.products.trajectory}
        follows, thoughts = "again", 0
        while follows == "again":
            label = f"leg/{stop.index}/{thoughts}" if thoughts else f"leg/{stop.index}"
            plan = stop.leg = self._leg(label, self.memory, **known)
            leg = (yield plan).meta
            follows = self.memory.after(leg["verdict"], leg["where"] and tuple(leg["where"]))
            thoughts += 1
        if follows == "end":
            stop.event = leg["reason"]
            raise EndedError(leg["verdict"], leg["reason"])
        if stop.index + 1 >= self.config.drive.max_stops:
            left = f"{1000 * leg['left_m']:.0f} mm from the goal"
            raise EndedError("stops", f"{count(stop.index + 1, 'stop')} and {left}")
        self.planned, stop.event = plan, leg["reason"]
        return plan

    def _leg(self, label: str, memory: PlannerMemory, **given: Any) -> Handle:
        given |= {"goal": list(self.goal), "looks": memory.looks, "closed": [list(p) for p in memory.closed]}
        return self.node(local_planner_stage, label, rig=self.pairs[0].rig, **given, **self.mounting)

    # -- a leg --------------------------------------------------------------------------------------------------

    def _drive(self, stop: Stop, at: TrueStand, plan: Handle) -> Generator[Wait, Any, Way]:
        """True motion of a leg, measurements of its sensors, and the images on the way that are not lost."""
        k, s = stop.index, self.simulation
        given = {"scene": self.scene, "before": at.before, "pose": self.poses[-1], "plan": plan}
        change = s.change(k, at.row)
        if change is not None:
            given["scene"] = self.scene = self.source(change, f"obstacle/{k}", given)
        stop.drive = self.source(s.drive(self.config.vehicle, k, at.row), f"drive/{k}", given)
        sense = self.source(s.sense(k), f"sense/{k}", {"drive": stop.drive})
        there, said = yield [stop.drive, sense]
        first = max(self.true) + 1
        rows = {stop.frame: 0}
        for row, pose in enumerate(there.meta["poses"][1:], start=1):
            frame = first + row - 1
            self.true[frame], rows[frame] = tuple(pose), row
            self.pyramid(frame, "left")
        if len(rows) < 2:
            raise EndedError("safety stop", "the rover did not move: it stands at the edge of the simulated bed")
        moved = yield [self.motion(a, b) for a, b in pairwise(rows)]
        kept = self._kept(stop, rows, [float(m.meta["match_rate"] or 0.0) for m in moved])
        return Way(stop.drive, rows, kept, sense, said)

    def _kept(self, stop: Stop, rows: dict[int, int], rate: list[float]) -> list[int]:
        """Leave lost images out; where two in a row are lost, or the last one, the vehicle stops and looks again."""
        # Less than a tenth of its pixels match the image before: it is lost.
        frames, least = list(rows), 0.1
        lost = [b for n, b in enumerate(frames[1:]) if rate[n] < least and (n + 1 == len(rate) or rate[n + 1] < least)]
        if lost:
            shares = ", ".join(f"{b} ({rate[frames.index(b) - 1]:.0%} matched)" for b in lost)
            stop.event = f"lost image {shares}: left out"
            pair = next((n for n in range(1, len(frames) - 1) if {*frames[n : n + 2]} <= set(lost)), None)
            end = frames[-1] if pair is None else frames[pair + 1]
            frames = frames[: frames.index(end) + 1]
            stop.row = rows[end]
            if end in lost:
                # The image at the end is lost: another one is taken from the same place, under a number of its own.
                again = max(self.true) + 1
                self.true[again], rows[again] = self.true[end], rows[end]
                stop.event = f"lost image {shares}: stopped and taken again as image {again}"
                self.pyramid(again, "left")
                frames.append(again)
        return [f for f in frames if f not in lost]

    def _judge(self, stop: Stop, way: Way) -> Generator[Wait, Any, TrueStand]:
        """Track and resect the images of a leg, up to its end, a safety stop or an obstacle; return where it ended."""
        frames, rows, key = way.frames, way.rows, self.pairs[-1]
        segment = self.segment(frames, key)
        safe = self.node(
            fault_monitor_stage,
            f"fault_monitor/{stop.index}",
            sense=way.sense,
            resect=segment.resection,
            rows=[rows[f] for f in frames],
            vehicle=self.given_vehicle,
            **self.mounting,
        )
        watched = [self._obstacles(stop, way, segment, key)] if self.config.obstacle_monitor.enabled else []
        safety, *others = yield [safe, *watched]
        cut, kind, reason = safety.meta["stop"], safety.meta["kind"], safety.meta["reason"]
        for monitor in others:
            seen = monitor.meta["stop"]
            # Whoever stopped first counts: what the other saw later was never driven.
            if seen is not None and (cut is None or seen < cut):
                cut, kind, reason = seen, "obstacle", monitor.meta["reason"]
        self.troubles = 0 if cut is None or kind == "obstacle" else self.troubles + 1
        if cut is not None:
            stop.event = f"{'obstacle stop' if kind == 'obstacle' else 'safety stop'} at image {frames[cut]}: {reason}"
            if cut < len(frames) - 1:
                frames = frames[: cut + 1]
                stop.row = rows[frames[-1]]
                segment = self.segment(frames, key, which=f"{stop.frame}/stopped")
        stop.frames = frames
        self.products.resections.append(segment.resection)
        self.posed += frames[1:]
        terminal = kind in ("attitude", "acceleration", "lost")
        if terminal or self.troubles >= self.config.drive.max_safety_stops:
            often = f", {self.troubles} legs in a row" if self.troubles > 1 else ""
            # What was driven up to a safety stop belongs to the trajectory and to the assessment.
            self._located(len(self.driven.stops))
            raise EndedError("safety stop", reason + often)
        end = frames[-1]
        return TrueStand(end, way.drive, rows[end], way.said.meta["up"][rows[end]])

    def _obstacles(self, stop: Stop, way: Way, segment: Segment, key: Pair) -> Handle:
        """Compare the images on the way with the last model, for obstacles that it lacks."""
        frames = way.frames
        wheels = np.array([way.said.meta["odometry"][way.rows[f]] for f in frames])
        compared = obstacle_monitor.pairs(wheels, self.config.vehicle.wheel_diameter)
        params = self.config.motion.model_copy(update={"level": obstacle_monitor.LEVEL})
        motions = []
        for a, b in ((frames[i], frames[j]) for i, j in compared):
            images = {"a": self.pyramid(a, "left"), "b": self.pyramid(b, "left")}
            motions.append(self.node(motion_stage, f"motion/way/{a}-{b}", params, **images))
        return self.node(
            obstacle_monitor_stage,
            f"obstacle_monitor/{stop.index}",
            dem=key.dem,
            resect=segment.resection,
            rig=key.rig,
            motions=motions,
            pairs=[list(c) for c in compared],
            vehicle=self.given_vehicle,
            **self.mounting,
        )

    # -- the end ------------------------------------------------------------------------------------------------

    def _assess(self) -> Generator[Wait, Any, None]:
        """Compare the drive with the truth; nothing else compares them."""
        p = self.products
        if not self.pairs or p.trajectory is None or self.pairs[0].level.lost or p.trajectory.lost:
            p.trajectory = None  # it failed at its first stop
            self._check({})
            return
        true, frames = [list(self.true[f]) for f in self.posed], list(self.posed)
        p.accuracy = self.node(accuracy_stage, "accuracy", trajectory=p.trajectory, truth=true, frames=frames)
        level = yield from done(self.pairs[0].level)
        T_left_local = RigidTransform.from_matrix(level.meta["T_local_left"]).inverse()
        T_truth_world = RigidTransform.from_matrix(self.true[0]) @ T_left_local
        stops = [RigidTransform.from_matrix(self.true[stop.frame]) for stop in self.driven.stops]
        source = self.simulation.truth_dem(self.arena().to_dict(), T_truth_world, stops)
        exact = self.source(source, "truth_dem", {"scene": self.scene})
        p.dem_accuracy = self.node(dem_accuracy_stage, "dem_accuracy/world", dem=p.world_tiles, truth=exact)
        true_risk = self.hazards("risk/truth", [exact])
        best = self._leg("leg/truth", PlannerMemory(), whole=True, risk=true_risk, pose=self.poses[0])
        self._check({"trajectory": p.trajectory, "truth": true, "best": best})

    def _closed(self) -> str:
        """Why there is no way, in words, if the last leg was a look around for that reason; else empty."""
        legs = [s.leg.ref.meta for s in self.driven.stops if s.leg is not None and s.leg.ref is not None]
        return str(legs[-1]["reason"]) if legs and legs[-1]["verdict"] == "look" and not legs[-1]["way_m"] else ""

    def _check(self, known: dict[str, Any]) -> None:
        """Compare the driven legs with the truth."""
        d = self.driven
        legs = [(s.row, s.drive) for s in d.stops if s.drive is not None and not s.drive.lost]
        assert d.place is not None
        d.check = self.node(
            drive_check_stage,
            "drive_check",
            drives=[d.place, *(drive for _, drive in legs)],
            rows=[0, *(row for row, _ in legs)],
            vehicle=self.given_vehicle,
            **known,
        )

    def outcome(self) -> tuple[str, str]:
        """Verdict and reason, once the graph has run: of the last stop, or of what failed on the way."""
        if self.driven.verdict:
            return self.driven.verdict, self.driven.reason
        failed = next((h for h in self.graph.nodes if h.status == "failed"), None)
        if failed is not None and isinstance(failed.error, DegenerateError):
            return "safety stop", f"{failed.label}: {failed.error.message}"
        return "failed", "" if failed is None else f"{failed.label}: {failed.error}"

    def recorded(self) -> tuple[Sequence, tuple[int, ...]]:
        """The sequence as the drive recorded it, and its frames that have a pose."""
        n = max(self.true, default=0) + 1
        truth = tuple(RigidTransform.from_matrix(self.true[f]) if f in self.true else None for f in range(n))
        names = tuple(f"{f:06d}" for f in range(n))
        return replace(self.sequence, frames=n, frame_names=names, truth=truth), tuple(self.posed)


def dataflow(graph: Graph, sequence: Sequence, config: Any, frames: tuple[int, ...]) -> tuple[Products, Drive | None]:
    """Lay out the reconstruction of a recorded sequence, or a drive in a simulated one; return its products."""
    name_graph(graph, sequence, frames)
    if sequence.simulation is not None:
        drive = Drive(graph, sequence, config)
        graph.flow(drive.steps())
        return drive.products, drive
    make = Builder(graph, sequence, config)
    graph.flow(reconstruction(make, frames))
    return make.products, None
