"""The closed loop, top to bottom: stop, think, drive, and again, as tasks like all others.

Pair, world model, segment and hazards are wired as in a reconstruction: by the same methods.

::

    drive/start -> sense -+
                          v
    stop k:  image -> pyramid -> hfvm -> level -> locus (local) -> locus (world) -> merge (all models so far, pad;
                                           |                          ^                |      and what of them is near)
                                           |            trajectory -> pose           risk (of both), ceiling
                                           v               ^   |                             |
                                         resect -----------+   +---------> leg <-------------+
                                           ^                                |
                                           |          goal, no path: end    | drive, turn, look
                                           |                                v
    leg k:   safety <- sense <- drive/k (true poses) <- leg, pose (believed), drive/k-1 (where it truly stands)
               |             images on the way -> pyramid -> motion -> track -> resect -> safety, reflex
               |             motion (a baseline apart), locus (local) ---------------------> reflex
               v
             stop k+1 at the last image, or at the one where safety or reflex stopped

``drive``, ``sense``, the images and nothing else know the true poses. What the vehicle believes is the trajectory:
the product of the segments that were tracked and resected. Every node is keyed by what it reads, so a drive that is
killed goes on where it was, and one that is repeated computes nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from datasets.protocol import Sequence, Simulation, Source
from pipeline.engine.graph import Graph, Handle
from pipeline.engine.keys import digest
from pipeline.engine.task import Ref
from pipeline.flow.config import STAGE_MODULES
from pipeline.flow.reconstruction import Products, Reconstruction
from stages.core.declare import Params
from stages.core.errors import ConfigError, DegenerateError
from stages.driving.obstacle_monitor import pairs
from stages.geometry.geometry import RigidTransform
from stages.geometry.lattice import Lattice
from stages.planning.local_planner.memory import Memory


class DriveParams(Params):
    """The loop itself; what happens on a leg and at a stop is the stages' own."""

    goal: tuple[float, float] | None = Field(
        default=None, description="m; x, y of the goal in the world frame, which begins at the first left camera"
    )
    frame: Literal["world", "map"] = Field(
        default="world",
        description="frame of the goal: the world, or the global map where there is one",
    )
    prior: tuple[float, float, float] | None = Field(
        default=None, description="m, m, degrees to the left; where the first left camera roughly is in the global map"
    )
    prior_sigma: tuple[float, float] = Field(default=(0.1, 5.0), description="m, degrees; its standard deviations")
    pose: tuple[float, float, float, float] | None = Field(
        default=None, description="m, m, m, degrees; its pose in the global map, handed in instead of found"
    )
    detail: float = Field(
        default=4.0,
        ge=0,
        description="pixels that a wheel's diameter covers along the range where it may drive: about a matching "
        "window, which smooths away what is smaller; what is seen from farther serves to plan; 0: all is driven on",
    )
    around: float = Field(default=0.6, gt=0, description="m; the map reaches this far around start and goal")
    max_stops: int = Field(
        default=80,
        ge=1,
        description="stops after which the drive is given up; among many rocks a way of 2.8 m took more than 60",
    )
    max_safety_stops: int = Field(default=3, ge=1, description="safety stops in a row that end the drive")
    least_match: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="share of the pixels that match the image before, below which it is lost",
    )


@dataclass
class Stop:
    """One stop and the leg that follows it: handles, the frame it stands at, and in words what became of the leg."""

    index: int
    frame: int
    merged: Handle | None = None
    risk: Handle | None = None
    far: Handle | None = None
    ceiling: Handle | None = None
    trajectory: Handle | None = None
    leg: Handle | None = None
    drive: Handle | None = None
    sense: Handle | None = None
    safety: Handle | None = None
    reflex: Handle | None = None
    frames: list[int] = field(default_factory=list)
    row: int = -1
    """Of the leg's artifact, where the leg ended: the last one, unless something ended it before."""
    event: str = ""
    thoughts: int = 0


@dataclass
class Driven:
    """What became of a drive: its stops, ``verdict`` (goal, no path, safety stop, stops) and ``reason``."""

    stops: list[Stop] = field(default_factory=list)
    verdict: str = ""
    reason: str = ""
    place: Handle | None = None
    fix: Handle | None = None
    truth_leg: Handle | None = None
    check: Handle | None = None


def arena(goal: tuple[float, float], around: float, cell: float) -> Lattice:
    """What a drive maps: so many metres around its start, which is at the origin, and its goal, m."""
    bounds = [f(0.0, g) + s * around for g in goal for f, s in ((min, -1.0), (max, 1.0))]
    return Lattice.snap(bounds, cell)


class Drive(Reconstruction):
    """Builds the graph of a drive, stop by stop, as results arrive."""

    def __init__(self, graph: Graph, sequence: Sequence, config: Any, frames: tuple[int, ...] = (0,)) -> None:
        super().__init__(graph, sequence, config, frames)
        if sequence.simulation is None or config.drive.goal is None:
            raise ConfigError(
                "RIL-031", f"{sequence.name} has no goal to drive to", remedy="set drive.goal=[x, y], metres"
            )
        if config.locus.cell_size is None:
            raise ConfigError(
                "RIL-032", "a drive needs locus.cell_size", remedy="set it to about an eighth of a wheel, metres"
            )
        self.simulation: Simulation = sequence.simulation
        self.mounting = {"T_vehicle_left": self.simulation.T_vehicle_left.to_list()}
        self.driven = self.products.drive = Driven()
        self.posed: list[int] = [0]
        """Frames of the trajectory so far."""
        self.goal: tuple[float, float] = config.drive.goal
        """In the world frame."""
        self.true: dict[int, tuple[float, ...]] = {}
        """True pose of each frame that was taken; read by the renderer and by what assesses, never by an estimate."""
        self.troubles = 0
        self.rows: dict[int, int] = {}
        """Row of each frame in the artifact of its leg."""
        self.memory = Memory()
        self.truth: Handle | None = None
        self.planned: Handle | None = None
        """The last leg, of whose way a part is left."""

    def build(self) -> Products:
        """Lay out the start; the rest follows by expansion."""
        self.scene = self._source(self.simulation.scene, "site")
        place = self.driven.place = self._simulate(
            self.simulation.place(self.config.vehicle), "drive/start", scene=self.scene
        )
        sense = self._simulate(self.simulation.sense(-1), "sense/start", drive=place)
        self._then([place, sense], lambda there, said: self._first(place, there, said))
        return self.products

    def _first(self, place: Handle, there: Ref, said: Ref) -> None:
        self.true[0] = tuple(there.meta["poses"][0])
        self._stop(0, place, 0, said.meta["up"][0])

    # -- a stop -------------------------------------------------------------------------------------------------

    def _stop(self, frame: int, before: Handle, row: int, up: list[float]) -> None:
        """Stereo pair to local model, merged map, hazards, and the next leg."""
        p, k = self.products, len(self.driven.stops)
        stop = Stop(k, frame)
        self.driven.stops.append(stop)
        self.left[frame] = self._pyramid(frame, "left")
        if k == 0:
            self._match(frame)
            self._rigs([frame])
        else:
            self._disparity(frame)
            p.rigs[frame], self.calibration[frame] = p.rigs[0], self.calibration[0]
        self._pair(frame, {"pair": frame, "up": up})
        if k == 0 and self.config.drive.frame == "map":
            self._then([self._fix(frame)], lambda fixed: self._on_the_map(stop, before, row, fixed))
        else:
            self._think(stop, before, row)

    def _think(self, stop: Stop, before: Handle, row: int) -> None:
        self._map(stop)
        assert stop.leg is not None
        self._then([stop.leg], lambda leg: self._after_leg(stop, before, row, leg))

    def _fix(self, frame: int) -> Handle:
        """Where the first pair is in the global map: handed in, or found by its elevation model."""
        d, inputs = self.config.drive, dict[str, Handle]()
        args: dict[str, Any] = {}
        if d.pose is not None:
            args["pose"] = [*d.pose[:3], math.radians(d.pose[3])]
        elif d.prior is None or self.simulation.overview is None:
            raise ConfigError(
                "RIL-033",
                "drive.frame=map needs drive.pose, or drive.prior and a global map",
                remedy="set drive.pose=[x, y, z, degrees], or drive.prior and rover.map_cell",
            )
        else:
            overview = self._simulate(self.simulation.overview, "overview", scene=self.scene)
            inputs = {"dem": self.products.local_dem[frame], "map": overview}
            args["prior"] = [*d.prior[:2], math.radians(d.prior[2])]
            args["prior_sigma"] = [d.prior_sigma[0], math.radians(d.prior_sigma[1])]
        self.driven.fix = self._node("global_fix", "global_fix", args, **inputs)
        return self.driven.fix

    def _on_the_map(self, stop: Stop, before: Handle, row: int, fixed: Ref) -> None:
        """The goal in the world frame, which is the local frame of the first pair."""
        T_world_map = RigidTransform.from_matrix(fixed.meta["T_global_local"]).inverse()
        x, y, _ = T_world_map.apply([*self.config.drive.goal, fixed.meta["T_global_local"][11]])
        self.goal = float(x), float(y)
        self._think(stop, before, row)

    def _map(self, stop: Stop) -> None:
        """What is known of the world at a stop, its hazards, and where to go next."""
        p, k, frame = self.products, stop.index, stop.frame
        stop.trajectory = trajectory = self._located(k)
        self.pose = self._world_model(frame, 0, len(self.posed) - 1, trajectory)
        if k == 0:
            self._pad(frame)
        stop.merged = self._merged(f"merge/{k}", None)
        p.tiles = [stop.merged]
        stop.risk = p.risk = self._risk(f"risk/{k}", [stop.merged])
        near, finest = stop.merged, None
        if self.config.drive.detail > 0:
            stop.far = stop.risk
            finest = self.config.vehicle.wheel_diameter / self.config.drive.detail
            near = self._merged(f"merge/{k}/near", finest)
            stop.risk = self._risk(f"risk/{k}/near", [near])
        stop.ceiling = self._ceiling(f"ceiling/{k}", near, finest)
        self._decide(stop, f"leg/{k}")

    def _merged(self, label: str, finest: float | None) -> Handle:
        """All that was seen so far, or what of it a pixel covers ``finest`` metres of at most."""
        params = self.config.merge.model_copy(update={} if finest is None else {"max_footprint": finest})
        args = {"lattice": self.arena().to_dict()}
        dems = [*self.pads, *self.products.world_dem.values()]
        return self.graph.node(STAGE_MODULES["merge"], label, params, args, {}, {"dems": dems})

    def _ceiling(self, label: str, merged: Handle, finest: float | None) -> Handle:
        """How high the ground may be, also where it was not seen."""
        params = self.config.ceiling.model_copy(update={} if finest is None else {"max_footprint": finest})
        inputs: dict[str, Any] = {"merged": merged, "dems": list(self.products.world_dem.values())}
        return self.graph.node(STAGE_MODULES["ceiling"], label, params, {}, {}, inputs)

    def _decide(self, stop: Stop, label: str) -> None:
        """The leg of a stop, by what is known there."""
        given = {"risk": stop.risk, "far": stop.far, "ceiling": stop.ceiling, "before": self.planned}
        there = {name: handle for name, handle in given.items() if handle is not None}
        stop.leg = self._leg(label, self.memory, {}, pose=self.pose, **there)

    def _located(self, legs: int) -> Handle:
        """The trajectory over so many legs, which is that of the drive from now on."""
        p = self.products
        keys = [stop.frame for stop in self.driven.stops]
        found = p.trajectory = self._node(
            "trajectory",
            f"trajectory/{legs}",
            {"frames": list(self.posed)},
            segments=list(p.resections),
            levels=[p.level[key] for key in keys[:legs] or keys[:1]],
        )
        return found

    def _pad(self, frame: int) -> None:
        """The ground under the vehicle at the start, and where it is."""
        args = {"radius": self.simulation.pad, "wheel_diameter": self.config.vehicle.wheel_diameter, **self.mounting}
        self.first_pose = self.pose
        like = self.products.world_dem[frame]
        self.pads = [self._node("pad", "pad", args, pose=self.pose, like=like)] if self.simulation.pad > 0 else []

    def _leg(self, label: str, memory: Memory, more: dict[str, Any], **inputs: Handle) -> Handle:
        args: dict[str, Any] = {"goal": list(self.goal), "looks": memory.looks, **self.mounting}
        args |= {"closed": [list(p) for p in memory.closed], "stands": [list(p) for p in memory.stands]}
        return self._node("leg", label, args | more, rig=self.calibration[0], **inputs)

    def arena(self) -> Lattice:
        """The part of the world that is mapped."""
        return arena(self.goal, self.config.drive.around, self.config.locus.cell_size)

    def _after_leg(self, stop: Stop, before: Handle, row: int, leg: Ref) -> None:
        verdict, where = leg.meta["verdict"], leg.meta["where"]
        follows = self.memory.after(verdict, tuple(leg.meta["start"]), None if where is None else tuple(where))
        if follows == "again":
            self._again(stop, before, row)
        elif follows == "end":
            stop.event = leg.meta["reason"]
            self._end(verdict, leg.meta["reason"])
        elif stop.index + 1 >= self.config.drive.max_stops:
            self._end("stops", f"{stop.index + 1} stops and {1000 * leg.meta['left_m']:.0f} mm from the goal")
        else:
            self.planned = stop.leg
            stop.event = leg.meta["reason"]
            self._drive(stop, before, row)

    def _again(self, stop: Stop, before: Handle, row: int) -> None:
        """Think anew at the same stop."""
        stop.thoughts += 1
        self._decide(stop, f"leg/{stop.index}/{stop.thoughts}")
        assert stop.leg is not None
        self._then([stop.leg], lambda again: self._after_leg(stop, before, row, again))

    # -- a leg --------------------------------------------------------------------------------------------------

    def _drive(self, stop: Stop, before: Handle, row: int) -> None:
        """The true motion, and what the sensors say of it."""
        k, s = stop.index, self.simulation
        assert stop.leg is not None
        told = {"before": before, "pose": self.pose, "leg": stop.leg}
        change = s.change(k, row)
        if change is not None:
            self.scene = self._simulate(change, f"obstacle/{k}", scene=self.scene, **told)
        stop.drive = self._simulate(s.drive(self.config.vehicle, k, row), f"drive/{k}", scene=self.scene, **told)
        stop.sense = self._simulate(s.sense(k), f"sense/{k}", drive=stop.drive)
        self._then([stop.drive, stop.sense], lambda there, said: self._on_the_way(stop, there, said))

    def _on_the_way(self, stop: Stop, there: Ref, said: Ref) -> None:
        """Images of the leg, and how each moved against the one before."""
        first = max(self.true) + 1
        rows = {stop.frame: 0}
        for row, pose in enumerate(there.meta["poses"][1:], start=1):
            frame = first + row - 1
            self.true[frame] = tuple(pose)
            rows[frame] = row
            self.left[frame] = self._pyramid(frame, "left")
        frames = list(rows)
        if len(frames) < 2:
            self._end("safety stop", "the rover did not move: it stands at the edge of the simulated bed")
            return
        moved = [self._motion(a, b) for a, b in itertools.pairwise(frames)]
        self._then(moved, lambda *found: self._seen(stop, rows, said, list(found)))

    def _seen(self, stop: Stop, rows: dict[int, int], said: Ref, moved: list[Ref]) -> None:
        """Leave lost images out; where two in a row are lost, or the last one, the vehicle stops and looks again."""
        frames, least = list(rows), self.config.drive.least_match
        rate = [float(m.meta["match_rate"] or 0.0) for m in moved]
        lost = [b for n, b in enumerate(frames[1:]) if rate[n] < least and (n + 1 == len(rate) or rate[n + 1] < least)]
        if lost:
            shares = ", ".join(f"{b} ({rate[frames.index(b) - 1]:.0%} matched)" for b in lost)
            stop.event = f"lost image {shares}: left out"
            pair = next((n for n in range(1, len(frames) - 1) if {*frames[n : n + 2]} <= set(lost)), None)
            end = frames[-1] if pair is None else frames[pair + 1]
            frames = frames[: frames.index(end) + 1]
            stop.row = rows[end]
            if end in lost:
                again = max(self.true) + 1
                self.true[again], rows[again] = self.true[end], rows[end]
                stop.event = f"lost image {shares}: stopped and taken again as image {again}"
                self.left[again] = self._pyramid(again, "left")
                frames.append(again)
        kept = [f for f in frames if f not in lost]
        if len(kept) < 2:
            self._end("safety stop", "tracking is lost: " + stop.event)
            return
        self._segment_of(stop, kept, rows, said)

    def _segment_of(self, stop: Stop, frames: list[int], rows: dict[int, int], said: Ref) -> None:
        """Track and resect the images of the leg, then judge it."""
        track, resection = self._segment(frames, f"{stop.frame}")
        self.products.tracks.append(track)
        vehicle = self.config.vehicle.model_dump(mode="json")
        args = {"rows": [rows[f] for f in frames], "vehicle": vehicle, **self.mounting}
        assert stop.sense is not None
        stop.safety = self._node("safety", f"safety/{stop.index}", args, sense=stop.sense, resect=resection)
        judges = [stop.safety]
        if self.config.reflex.enabled:
            stop.reflex = self._reflex(stop, frames, rows, said, resection)
            judges.append(stop.reflex)
        self._then(judges, lambda *found: self._after(stop, frames, rows, said, resection, *found))

    def _reflex(self, stop: Stop, frames: list[int], rows: dict[int, int], said: Ref, resection: Handle) -> Handle:
        """Whether the images on the way show what the last model does not."""
        p, vehicle = self.config.reflex, self.config.vehicle
        wheels = np.array([said.meta["odometry"][rows[f]] for f in frames])
        compared = pairs(wheels, vehicle.wheel_diameter, p)
        params = self.config.motion.model_copy(update={"level": p.level})
        motions = [
            self.graph.node(
                STAGE_MODULES["motion"],
                f"motion/way/{frames[i]}-{frames[j]}",
                params,
                {"frames": [frames[i], frames[j]]},
                {},
                {"a": self.left[frames[i]], "b": self.left[frames[j]]},
            )
            for i, j in compared
        ]
        args = {"pairs": [list(c) for c in compared], "vehicle": vehicle.model_dump(mode="json"), **self.mounting}
        return self._node(
            "reflex",
            f"reflex/{stop.index}",
            args,
            dem=self.products.local_dem[stop.frame],
            resect=resection,
            rig=self.calibration[stop.frame],
            motions=motions,
        )

    def _after(
        self,
        stop: Stop,
        frames: list[int],
        rows: dict[int, int],
        said: Ref,
        resection: Handle,
        safety: Ref,
        reflex: Ref | None = None,
    ) -> None:
        """The leg is over: at its end, or where a safety stop or an obstacle ended it."""
        cut, kind, reason = safety.meta["stop"], safety.meta["kind"], safety.meta["reason"]
        seen = None if reflex is None else reflex.meta["stop"]
        if reflex is not None and seen is not None and (cut is None or seen < cut):
            cut, kind, reason = seen, "reflex", reflex.meta["reason"]
        self.troubles = 0 if cut is None or kind == "reflex" else self.troubles + 1
        if cut is not None:
            stop.event = f"{'reflex' if kind == 'reflex' else 'safety stop'} at image {frames[cut]}: {reason}"
            if cut < len(frames) - 1:
                frames = frames[: cut + 1]
                stop.row = rows[frames[-1]]
                track, resection = self._segment(frames, f"{stop.frame}/stopped")
                self.products.tracks[-1] = track
        stop.frames = frames
        self.rows |= {f: rows[f] for f in frames[1:]}
        self.products.resections.append(resection)
        self.posed += frames[1:]
        terminal = kind in ("attitude", "acceleration", "lost")
        if terminal or self.troubles >= self.config.drive.max_safety_stops:
            often = f", {self.troubles} legs in a row" if self.troubles > 1 else ""
            if len(frames) > 1:  # else it stands where the trajectory ends already
                self._located(len(self.driven.stops))
            self._end("safety stop", reason + often)
            return
        assert stop.drive is not None
        self._stop(frames[-1], stop.drive, rows[frames[-1]], said.meta["up"][rows[frames[-1]]])

    # -- the end ------------------------------------------------------------------------------------------------

    def _then(self, handles: list[Handle], grow: Callable[..., None]) -> None:
        """Go on when these have artifacts; where one will never have one the drive has failed, and ends there."""

        def go_on(*refs: Ref | None) -> None:
            if all(ref is not None for ref in refs):
                grow(*refs)
            elif not self.driven.verdict:
                self._end(*self.outcome())

        self.graph.expand(handles, go_on, holes=True)

    def _end(self, verdict: str, reason: str) -> None:
        """Say how it ended, and assess it: here alone truth and estimates meet."""
        closed = self._closed()
        if verdict == "safety stop" and closed:  # it was but looking around once more
            verdict, reason = "no path", f"{closed}, then a safety stop: {reason}"
        self.driven.verdict, self.driven.reason = verdict, reason
        p, s = self.products, self.simulation
        first = p.level.get(0)
        if first is None or p.trajectory is None or _failed(first) or _failed(p.trajectory):
            p.trajectory = None  # it failed at its first stop
            self._check()
            return
        poses = [list(self.true[f]) for f in self.posed]
        args = {"poses": poses, "source": self.sequence.truth_source, "frames": list(self.posed)}
        self.truth = self._node("truth", "truth", args)
        p.accuracy = self._node("accuracy", "accuracy", {}, trajectory=p.trajectory, truth=self.truth)

        def ground(level: Ref) -> None:
            T_left_local = RigidTransform.from_matrix(level.meta["T_local_left"]).inverse()
            T_truth_world = RigidTransform.from_matrix(self.true[0]) @ T_left_local
            stops = [RigidTransform.from_matrix(self.true[stop.frame]) for stop in self.driven.stops]
            source = s.truth_dem(self.arena().to_dict(), T_truth_world, stops)
            truth_dem = self._simulate(source, "truth_dem", scene=self.scene)
            p.dem_accuracy = self._node("dem_accuracy", "dem_accuracy/world", {}, dem=p.tiles, truth=truth_dem)
            p.truth_risk = self._risk("risk/truth", [truth_dem])
            self.driven.truth_leg = self._leg(
                "leg/truth", Memory(), {"whole": True}, risk=p.truth_risk, pose=self.first_pose
            )
            self._check()

        self.graph.expand([first], ground)

    def _closed(self) -> str:
        """Why there is no way, in words, where the last leg was a look around for that; empty where there was one."""
        legs = [s.leg.ref.meta for s in self.driven.stops if s.leg is not None and s.leg.ref is not None]
        return str(legs[-1]["reason"]) if legs and legs[-1]["verdict"] == "look" and not legs[-1]["way_m"] else ""

    def _check(self) -> None:
        """The drive against the truth."""
        d, p = self.driven, self.products
        legs = [s for s in d.stops if s.drive is not None and not _failed(s.drive)]
        assert d.place is not None
        known = {"trajectory": p.trajectory, "truth": self.truth, "best": d.truth_leg}
        d.check = self._node(
            "drive_check",
            "drive_check",
            {
                "rows": [0, *(s.row for s in legs)],
                "vehicle": self.config.vehicle.model_dump(mode="json"),
            },
            drives=[d.place, *(s.drive for s in legs if s.drive is not None)],
            **{port: handle for port, handle in known.items() if handle is not None},
        )

    def outcome(self) -> tuple[str, str]:
        """Verdict and reason, once the graph has run: of the last stop, or of what failed on the way."""
        if self.driven.verdict:
            return self.driven.verdict, self.driven.reason
        failed = next((h for h in self.graph.nodes if h.status == "failed"), None)
        if failed is not None and isinstance(failed.error, DegenerateError):
            return "safety stop", f"{failed.label}: {failed.error.message}"
        return "failed", "" if failed is None else f"{failed.label}: {failed.error}"

    def taken(self) -> tuple[Sequence, tuple[int, ...]]:
        """The sequence as it came about, and the frames that have a pose in it."""
        n = max(self.true, default=0) + 1
        truth = tuple(RigidTransform.from_matrix(self.true[f]) if f in self.true else None for f in range(n))
        names = tuple(f"{f:06d}" for f in range(n))
        return replace(self.sequence, frames=n, frame_names=names, truth=truth), tuple(self.posed)

    # -- small things -------------------------------------------------------------------------------------------

    def _simulate(self, source: Source, label: str, **inputs: Handle) -> Handle:
        return self.graph.node(source.module, label, source.params, dict(source.args), dict(source.hints), inputs)

    def _undistorted(self, frame: int, camera: str) -> Handle:
        """An image taken at its true pose; its camera is an ideal one."""
        source = self.simulation.image(frame, camera, RigidTransform.from_matrix(self.true[frame]))
        image = self._simulate(source, f"image/{camera}/{frame}", scene=self.scene)
        if camera == "left":
            self.products.images[frame] = image
        return image


def _failed(handle: Handle) -> bool:
    """Whether a task will never have an artifact."""
    return handle.status in ("failed", "skipped")


def dataflow(graph: Graph, sequence: Sequence, config: Any, frames: tuple[int, ...]) -> Reconstruction:
    """The builder that suits a sequence: of a recorded one, or of one that is driven."""
    graph.sequence, graph.choice = sequence.name, digest(frames)[:16]
    kind = Reconstruction if sequence.simulation is None else Drive
    return kind(graph, sequence, config, frames)
