"""Rille's navigation in one process: the stages that a trajectory needs, called one after the other, each timed.

The same stages, with the same parameters and inputs, as in ``pipeline/flow/reconstruction.py``; left out is what no
pose depends on (elevation models, risk, path, cross-check), and the cache of artifacts.
"""

from __future__ import annotations

import copy
import importlib
import itertools
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rille.datasets.protocol import Sequence, Source
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow.builders import recalibrated
from rille.pipeline.flow.reconstruction import MAX_CALIBRATIONS
from rille.stages.core.declare import Bundle, NoParams, declared
from rille.stages.odometry.resection.trajectory import world_poses

MATCHING = ("hfvm", "orientation", "rig", "calibration", "ground_frame")
"""Stages of the basic pairs; all others see every frame."""
STAGES = configuration.stages()


@dataclass
class Clock:
    """Seconds (wall, processor) by name."""

    wall: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    cpu: dict[str, float] = field(default_factory=lambda: defaultdict(float))

    def timed(self, name: str, call: Any, *args: Any) -> Any:
        """What ``call`` returns, its time added."""
        start, start_cpu = time.perf_counter(), time.process_time()
        found = call(*args)
        self.wall[name] += time.perf_counter() - start
        self.cpu[name] += time.process_time() - start_cpu
        return found


class Images:
    """Decoded images of a sequence, read (or rendered) once and before any clock runs."""

    def __init__(self, sequence: Sequence, frames: range) -> None:
        self.sequence, self.frames = sequence, frames
        self._made: dict[Any, Bundle] = {}
        self.bundle = {(f, c): self._take(sequence.image(f, c)) for f in self._whole() for c in ("left", "right")}

    def _whole(self) -> list[int]:
        """Frames that have both images."""
        return [f for f in self.frames if f not in self.sequence.lost]

    def _take(self, source: Source) -> Bundle:
        shared = None if source.args else (source.module, source.params)
        if shared in self._made:
            return self._made[shared]
        inputs = {port: self._take(upstream) for port, upstream in source.inputs.items()}
        stage = declared(importlib.import_module(source.module))
        found: Bundle = stage.run(source.params, {**source.args, **source.hints}, inputs)
        if shared is not None:
            self._made[shared] = found
        return found

    def ideal(self, frame: int, camera: str) -> Bundle:
        """As an ideal camera would have taken it."""
        bundle, lens = self.bundle[frame, camera], (self.sequence.lenses or {}).get(camera)
        if lens is None:
            return bundle
        pinhole = self.sequence.rig.left if camera == "left" else self.sequence.rig.right
        args = {"lens": lens.to_dict(), "camera": pinhole.to_dict(), "frame": frame, "camera_name": camera}
        stage = STAGES["undistort"]
        found: Bundle = stage.run(stage.params(), args, {"image": bundle})
        return found


@dataclass(frozen=True)
class Navigated:
    """Poses (frame, 3, 4) of the left camera, NaN none; covariance where there is one; facts; seconds by stage."""

    poses: Any
    covariance: Any
    facts: Mapping[str, Any]
    clock: Clock


def settings(sequence: Sequence, assignments: list[str]) -> Any:
    """Configuration of a run with these ``--set`` assignments."""
    _, ours = configuration.split_dataset(configuration.parse_assignments(assignments))
    return configuration.build(configuration.expand(sequence.defaults), ours)


class Chain:
    """One run of the stages; ``corrections`` are those of the calibration so far, each of the one that was given."""

    def __init__(self, images: Images, config: Any, corrections: tuple[list[float], ...] = ()) -> None:
        self.given, self.config, self.corrections, self.images = images, config, corrections, images
        if corrections:
            self.images = copy.copy(images)
            self.images.sequence = recalibrated(images.sequence, corrections[-1])
        self.sequence = self.images.sequence
        self.frames = list(images.frames)
        self.clock = Clock()
        self._pyramids: dict[tuple[int, str], Bundle] = {}
        self._ideal: dict[tuple[int, str], Bundle] = {}

    def run(self) -> Navigated:
        """Poses of all frames; NaN of lost ones, and of those in other pieces than the largest."""
        frames = [f for f in self.frames if f not in self.sequence.lost]
        self.motion = {step: self._motion(*step) for step in itertools.pairwise(frames)}
        chain, lost, unfit = self._continuity(frames)
        steps = self._steps(chain)
        where = {"unfit": [chain.index(f) for f in unfit]} if unfit else {}
        select = self._stage("keyframes", {"frames": len(chain)} | where, steps=steps)
        basic = [chain[i] for i in select.meta["basic"]]
        parts = [[chain[i] for i in part] for part in select.meta["segments"]]
        self.disparity = {k: self._match(k) for k in basic}
        self.calibration = self._calibration(basic)
        segments = [self._segment(part) for part in parts]
        given: dict[str, Any] = {"segments": [r for r, _ in segments], "levels": [level for _, level in segments]}
        if self.config.resect.joint:
            args: dict[str, Any] = {"before": self.corrections[-1]} if self.corrections else {}
            args |= {"given": self.sequence.rig.to_dict(), "fixed": self.config.rig.mode == "fixed"}
            found = self._stage("intrinsics", args, segments=given["segments"], rig=self.calibration)
            given["intrinsics"] = found
            if any(found.meta["correction"]) and len(self.corrections) < MAX_CALIBRATIONS:
                return Chain(self.given, self.config, (*self.corrections, found.meta["corrected"])).run()
        trajectory = self._stage("trajectory", {"frames": self.frames, "lost": lost}, **given)
        facts = {"basic": basic, "select": select.meta, "resect": [r.meta for r, _ in segments]}
        facts |= {"intrinsics": given["intrinsics"].meta if "intrinsics" in given else {}}
        facts |= {"rig": self.rig_facts, "trajectory": trajectory.meta}
        return Navigated(world_poses(trajectory), trajectory["covariance"], facts, self.clock)

    def _continuity(self, frames: list[int]) -> tuple[list[int], list[Any], list[int]]:
        """Frames to go through, lost ones with their causes, and those that may not be basic."""
        qualities = [
            self._stage("image_quality", {"frame": f}, **{c: self._image(f, c) for c in ("left", "right")})
            for f in frames
        ]
        steps = self._steps(frames)
        sides: dict[int, Bundle] = {}
        bridges: list[tuple[int, int]] = []
        while True:
            given = {"steps": steps, "bridges": [self.motion[s] for s in bridges], "sides": list(sides.values())}
            found = self._stage("frame_screening", {"frames": frames, "bridged": bridges}, qualities=qualities, **given)
            asks = found.meta["asks"]
            if not any(asks.values()):
                missing = [{"frame": f, "cause": why} for f, why in self.sequence.lost.items()]
                return found.meta["chain"], [*missing, *found.meta["lost"]], found.meta["unfit"]
            for a, b in asks["bridges"]:
                self.motion[a, b] = self._motion(a, b)
                bridges.append((a, b))
            for f in asks["sides"]:
                pair = {c: self._stage("features", {}, image=self._image(f, c)) for c in ("left", "right")}
                sides[f] = self._stage("swap_check", {"frame": f, "rig": self.sequence.rig.to_dict()}, **pair)

    def _steps(self, frames: list[int]) -> list[Bundle]:
        motions = [self.motion[step] for step in itertools.pairwise(frames)]
        return [self._stage("step_table", {}, motions=motions)] if motions else []

    def _motion(self, a: int, b: int) -> Bundle:
        return self._stage("motion", {}, a=self._pyramid(a, "left"), b=self._pyramid(b, "left"))

    def _match(self, pair: int) -> Bundle:
        left, right = (self._pyramid(pair, c) for c in ("left", "right"))
        return self._stage("hfvm", {}, left=left, right=right)

    def _calibration(self, basic: list[int]) -> Bundle:
        rig = self.sequence.rig.to_dict()
        orientations = [self._orientation(k) for k in basic]
        given = {"rig": rig} | ({"first": self.given.sequence.rig.to_dict()} if self.corrections else {})
        found = self._stage("rig", given, orientations=orientations)
        self.rig_facts = found.meta
        return self._stage("calibration", {}, rig=found)

    def _orientation(self, pair: int) -> Bundle:
        both = {c: self._image(pair, c) for c in ("left", "right")}
        args = {"pair": pair, "rig": self.sequence.rig.to_dict()}
        return self._stage("orientation", args, disparity=self.disparity[pair], **both)

    def _segment(self, part: list[int]) -> tuple[Bundle, Bundle]:
        key, s = part[0], self.sequence
        args: dict[str, Any] = {}
        if s.up is not None and s.up[key] is not None:
            args["up"] = list(s.up[key])
        if s.pitch is not None:
            args["pitch"] = s.pitch
        level = self._stage("ground_frame", args, disparity=self.disparity[key], rig=self.calibration)
        track = self._stage(
            "track",
            {"frames": part},
            pyramids=[self._pyramid(f, "left") for f in part],
            motions=[self.motion[step] for step in itertools.pairwise(part)],
        )
        lenses = {side: lens.to_dict() for side, lens in (s.lenses or {}).items()}
        found = self._stage(
            "resect",
            {"lenses": lenses} if lenses else {},
            track=track,
            disparity=self.disparity[key],
            level=level,
            rig=self.calibration,
        )
        return found, level

    def _pyramid(self, frame: int, camera: str) -> Bundle:
        if (frame, camera) not in self._pyramids:
            self._pyramids[frame, camera] = self._stage("pyramid", {}, image=self._image(frame, camera))
        return self._pyramids[frame, camera]

    def _image(self, frame: int, camera: str) -> Bundle:
        if (frame, camera) not in self._ideal:
            self._ideal[frame, camera] = self.clock.timed("undistort", self.images.ideal, frame, camera)
        return self._ideal[frame, camera]

    def _stage(self, name: str, args: Mapping[str, Any], **inputs: Any) -> Bundle:
        stage = STAGES[name]
        params = getattr(self.config, name, NoParams())
        found: Bundle = self.clock.timed(name, stage.run, params, args, inputs)
        return found


def truth(images: Images) -> Any:
    """True poses (frame, 3, 4); NaN where there is none."""
    given = images.sequence.truth or ()
    none = np.full((3, 4), np.nan)
    return np.array([none if (pose := given[f]) is None else pose.matrix34 for f in images.frames])


def times(found: Navigated, frames: int) -> dict[str, float]:
    """Milliseconds a frame: ``wall``, ``processor``, and of the latter what basic pairs and what tracking took."""
    matching = sum(seconds for name, seconds in found.clock.cpu.items() if name in MATCHING)
    whole = sum(found.clock.cpu.values())
    parts = {"wall": sum(found.clock.wall.values()), "processor": whole, "matching": matching}
    parts["tracking"] = whole - matching
    return {"frames": frames} | {name: 1e3 * seconds / frames for name, seconds in parts.items()}
