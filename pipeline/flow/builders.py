"""Parts shared by all flows (reconstruction, closed loop, check): tasks of an image, pair, segment and world model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from rille.datasets.protocol import CAMERAS, Sequence, Source
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.keys import digest
from rille.pipeline.flow import tiles
from rille.pipeline.flow.products import Products
from rille.stages.calibration.calibration import calibration_stage
from rille.stages.calibration.orientation import orientation_stage
from rille.stages.calibration.rig import rig_stage
from rille.stages.calibration.swap_check import swap_check_stage
from rille.stages.calibration.synchrony import synchrony_stage
from rille.stages.core.declare import F, NoParams, Stage
from rille.stages.core.errors import ConfigError
from rille.stages.facts.calibration import CalibrationFacts, OrientationFacts, RigFacts, SwapFacts, SynchronyFacts
from rille.stages.facts.imaging import PyramidFacts, QualityFacts
from rille.stages.facts.odometry import MotionFacts, MovingFacts, ResectFacts, TrackFacts, TrajectoryFacts
from rille.stages.facts.terrain import DemFacts, GroundFacts
from rille.stages.geometry.geometry import Camera
from rille.stages.hazard.risk import risk_stage
from rille.stages.hfvm.stage import hfvm_stage
from rille.stages.imaging.features import features_stage
from rille.stages.imaging.image_quality import image_quality_stage
from rille.stages.imaging.pyramid import pyramid_stage
from rille.stages.imaging.undistort import undistort_stage
from rille.stages.odometry.motion import motion_stage
from rille.stages.odometry.pose import pose_stage
from rille.stages.odometry.resection.calibration_errors import calibrated_anew, corrected_like
from rille.stages.odometry.resection.resect import resect_stage
from rille.stages.odometry.track import track_stage
from rille.stages.terrain.ground_frame import SCENE, ground_frame_stage
from rille.stages.terrain.locus.stage import locus_stage
from rille.stages.terrain.reference import judge

Args = Mapping[str, Any]
P = ParamSpec("P")
T = TypeVar("T")

NO_PARAMS = NoParams()
"""One object for all tasks without parameters."""

PYRAMID_BYTES = 20 / 3
"""Bytes of a pyramid for each pixel of its image: grey and mask, a third more for the levels above."""


@dataclass(frozen=True)
class BasicPair:
    """A basic pair: disparity, rig, and vertical with reference plane (``level``)."""

    frame: int
    disparity: Handle
    rig: Handle[CalibrationFacts]
    level: Handle[GroundFacts]


@dataclass(frozen=True)
class Pair(BasicPair):
    """A basic pair with the elevation model in its own frame."""

    dem: Handle[DemFacts]


@dataclass(frozen=True)
class Segment:
    """Left images from one basic pair to the next: frames, tracks, and poses in the frame of the first."""

    frames: tuple[int, ...]
    track: Handle[TrackFacts]
    resection: Handle[ResectFacts]


def once(make: Callable[Concatenate[Builder, P], T]) -> Callable[Concatenate[Builder, P], T]:
    """Make a method of :class:`Builder` return the same task for the same arguments."""

    def made(self: Builder, /, *args: P.args, **kwargs: P.kwargs) -> T:
        # Arguments are numbers and names: equal ones mean the same task, whoever asks for it.
        name = (make.__name__, *args, *kwargs.items())
        if name not in self.made:
            self.made[name] = make(self, *args, **kwargs)
        return cast(T, self.made[name])

    return made


def name_graph(graph: Graph, sequence: Sequence, frames: Series[int]) -> None:
    """Name a graph by its sequence and frames: hints of earlier runs are kept by these names."""
    graph.sequence, graph.choice = sequence.name, digest(tuple(frames))[:16]


def recalibrated(sequence: Sequence, correction: Series[float]) -> Sequence:
    """The sequence with its cameras and its rig's yaw corrected as stage ``intrinsics`` says."""
    rig, lenses = sequence.rig, (sequence.lenses or {}).items()
    anew = {side: replace(lens, camera=corrected_like(side, lens.camera, rig, correction)) for side, lens in lenses}
    return replace(sequence, rig=calibrated_anew(rig, correction), lenses=anew or None)


class Builder:
    """Adds tasks of a sequence to a graph, with the parameters of a configuration.

    ``products`` are the handles that the report and the exporters read. Images, pyramids, motions and disparities are
    made once, whoever asks for them. ``given_rig``, ``given_lenses`` (by camera; None: images are ideal) and
    ``given_vehicle`` are arguments of stages.
    """

    def __init__(self, graph: Graph, sequence: Sequence, config: Any) -> None:
        self.graph, self.config, self.uncorrected = graph, config, sequence
        self.correction: list[float] | None = None
        self.products = Products()
        self.made: dict[Any, Any] = {}
        # Without its name, which changes no result.
        self.given_vehicle = config.vehicle.model_dump(mode="json", exclude={"name"})
        self._take(sequence)

    def _take(self, sequence: Sequence) -> None:
        """Lay out tasks of this sequence from now on."""
        self.sequence = sequence
        # Arguments of many tasks, one object for all: each would hold some kilobytes of its own until the run's end.
        self.given_rig = sequence.rig.to_dict()
        self.given_lenses = {side: lens.to_dict() for side, lens in (sequence.lenses or {}).items()} or None

    def node(self, stage: Stage[Any, F], label: str, params: Any = None, /, **given: Any) -> Handle[F]:
        """One task of a stage, with the parameters that it has in the configuration, or with others.

        ``given`` are its inputs (handles) and arguments; None stands for one that is absent.
        """
        # A section is named as its stage; a stage without parameters has none.
        return self.graph.call(stage, label, params or getattr(self.config, stage.name, NO_PARAMS), **given)

    def recalibrate(self, correction: list[float]) -> None:
        """Correct the calibration; tasks that do not depend on it are laid out as before."""
        self._take(recalibrated(self.uncorrected, correction))
        self.correction = correction

    def discard(self, since: int) -> None:
        """Mark the tasks from number ``since`` on as outdated, unless they are laid out again."""
        self.graph.outdated |= set(range(since, len(self.graph.nodes)))
        self.made.clear()
        self.products.contradictions.clear()

    # -- images -------------------------------------------------------------------------------------------------

    def source(
        self, source: Source, label: str, given: Mapping[str, Handle] | None = None, expect: float = 0.0
    ) -> Handle:
        """Task of a source, with the tasks of its inputs; ``given`` are inputs that exist already."""
        inputs = {
            port: self.source(upstream, f"{label}/{port}") if upstream.args else self._shared(upstream)
            for port, upstream in source.inputs.items()
        }
        return self.graph.node(
            source.module, label, source.params, source.args, source.hints, {**inputs, **(given or {})}, expect
        )

    def _shared(self, source: Source) -> Handle:
        """Task of a source that all frames share (a rendered scene), made once."""
        label = source.module.rsplit(".", 1)[-1]
        if label not in self.made:
            self.made[label] = self.source(source, label)
        return cast(Handle, self.made[label])

    @once
    def raw_image(self, frame: int, camera: str) -> Handle:
        """One image as the camera took it."""
        ideal = self._ideal(camera)
        grey = 4.0 * ideal.width * ideal.height  # float32
        return self.source(self.sequence.image(frame, camera), f"image/{camera}/{frame}", expect=grey)

    @once
    def image(self, frame: int, camera: str) -> Handle:
        """One image as an ideal camera would have taken it."""
        image = self.raw_image(frame, camera)
        lens = (self.sequence.lenses or {}).get(camera)
        if lens is not None:
            image = self.node(
                undistort_stage,
                f"undistort/{camera}/{frame}",
                image=image,
                lens=lens.to_dict(),
                camera=self._ideal(camera).to_dict(),
                frame=frame,
                camera_name=camera,
            )
        if camera == "left":
            self.products.images[frame] = image
        return image

    def _ideal(self, camera: str) -> Camera:
        """The ideal camera of a side."""
        return self.sequence.rig.left if camera == "left" else self.sequence.rig.right

    @once
    def pyramid(self, frame: int, camera: str) -> Handle[PyramidFacts]:
        """Image pyramid."""
        return self.node(pyramid_stage, f"pyramid/{camera}/{frame}", image=self.image(frame, camera))

    @once
    def features(self, frame: int, camera: str) -> Handle:
        """SIFT features."""
        return self.node(features_stage, f"features/{camera}/{frame}", image=self.image(frame, camera))

    @once
    def quality(self, frame: int) -> Handle[QualityFacts]:
        """Grey values and sharpness of a pair."""
        images = {camera: self.image(frame, camera) for camera in CAMERAS}
        return self.node(image_quality_stage, f"image_quality/{frame}", **images, frame=frame)

    # -- two images --------------------------------------------------------------------------------------------

    @once
    def motion(self, a: int, b: int) -> Handle[MotionFacts]:
        """Displacements from one left image to another."""
        images = {"a": self.pyramid(a, "left"), "b": self.pyramid(b, "left")}
        return self.node(motion_stage, f"motion/{a}-{b}", **images)

    @once
    def swap_check(self, frame: int) -> Handle[SwapFacts]:
        """Whether left and right of a pair are exchanged."""
        images = {camera: self.features(frame, camera) for camera in CAMERAS}
        return self.node(swap_check_stage, f"swap_check/{frame}", **images, frame=frame, rig=self.given_rig)

    def synchrony(self, label: str, pairs: Series[int], frames: Series[int]) -> Handle[SynchronyFacts]:
        """For each pair, the right image of the same time as the left one, among the three frames on either side."""
        at = [frames.index(pair) for pair in pairs]
        near = [f for k, f in enumerate(frames) if any(abs(k - place) <= 3 for place in at)]
        images = {"left": [self.features(f, "left") for f in pairs], "right": [self.features(f, "right") for f in near]}
        return self.node(synchrony_stage, label, **images, pairs=list(pairs), frames=near, rig=self.given_rig)

    @once
    def given_disparity(self, pair: int) -> Handle | None:
        """Disparity of the left image of a pair as another program made it; None: the sequence has none."""
        make = self.sequence.disparity
        return None if make is None else self.source(make(pair), f"disparity/{pair}")

    @once
    def disparity(self, pair: int) -> Handle:
        """Disparity of the left image of a pair: the matcher's, or that of another program, checked."""
        label = f"hfvm/{pair}"
        given = self.given_disparity(pair)
        if given is None:
            return self._matched(label, pair, "left", "right")
        ports: dict[str, Handle] = {side: self.pyramid(pair, side) for side in CAMERAS} | {"given": given}
        # By name: it has no section of its own, but reads the matcher's.
        return self.graph.node("rille.stages.hfvm.given", label, self.config.hfvm, {}, {}, ports)

    @once
    def backward(self, pair: int) -> Handle:
        """Disparity of the right image of a pair."""
        return self._matched(f"hfvm/back/{pair}", pair, "right", "left")

    def _matched(self, label: str, pair: int, camera: str, other: str) -> Handle:
        """One task, or for a large pair tasks per level and tile that give the same artifact."""
        ports: dict[str, Handle] = {"left": self.pyramid(pair, camera), "right": self.pyramid(pair, other)}
        first, second = ((ideal.height, ideal.width) for ideal in map(self._ideal, (camera, other)))
        side = tiles.side(self.config.tiling, self.config.hfvm, self.config.pyramid, (first, second))
        if side is None:
            # A smaller right image may be aligned to the left one, and is then as large.
            more = PYRAMID_BYTES * max(math.prod(first) - math.prod(second), 0)
            return self.graph.node(hfvm_stage, label, self.config.hfvm, {}, {}, ports, more)
        return tiles.build(self.graph, self.config.hfvm, ports, first, side, label)

    # -- a stereo pair ------------------------------------------------------------------------------------------

    @once
    def orientation(self, pair: int) -> Handle[OrientationFacts]:
        """Relative orientation of the cameras by the disparity of a pair."""
        known = {"disparity": self.disparity(pair), "rig": self.given_rig}
        known |= {camera: self.image(pair, camera) for camera in CAMERAS}
        return self.node(orientation_stage, f"orientation/{pair}", **known, pair=pair)

    def rig(self, pairs: Series[int], which: str = "") -> tuple[Handle[RigFacts], Handle[CalibrationFacts]]:
        """The rig that the orientations of these pairs agree on, and the part of it that other stages read."""
        orientations = [self.orientation(pair) for pair in pairs]
        first = None if self.correction is None else self.uncorrected.rig.to_dict()
        given = {"rig": self.given_rig, "first": first, "lenses": self.given_lenses}
        found = self.node(rig_stage, f"rig{which}", orientations=orientations, **given)
        return found, self.node(calibration_stage, f"calibration{which}", rig=found)

    def level(
        self, frame: int, vertical: Args, known: Handle[CalibrationFacts], plane: Args | None = None
    ) -> Handle[GroundFacts]:
        """Vertical and reference plane of a pair: the ground, or another ``plane`` (:func:`other_plane`); ``known`` is
        its rig."""
        given = {"disparity": self.disparity(frame), "rig": known, **vertical}
        label = "ground_frame" if plane is None else "reference_plane"
        return self.node(ground_frame_stage, f"{label}/{frame}", **given, **(plane or {}))

    def pair(
        self, frame: int, level: Handle[GroundFacts], known: Handle[CalibrationFacts], first: BasicPair | None
    ) -> Pair:
        """Local elevation model of a pair above its reference plane; ``known`` is its rig.

        Cells and extent of the ``first`` pair (None: this one) serve all, so that they merge.
        """
        basic = BasicPair(frame, self.disparity(frame), known, level)
        dem = self.products.local_dem[frame] = self._model("local", basic, (first or basic).level)
        return Pair(frame, basic.disparity, known, level, dem)

    def world_model(
        self,
        pair: Pair,
        first: Pair,
        row: int,
        trajectory: Handle[TrajectoryFacts],
        moving: Handle[MovingFacts] | None = None,
    ) -> Handle:
        """Elevations of a pair straight on the world lattice, by the pose in this row of the trajectory: that pose.

        The frame of pair ``first`` is the world; what is ``moving`` is left out.
        """
        chained = self.products.chained and {"chained": self.products.chained, "local": pair.dem}
        at = self.node(pose_stage, f"pose/{pair.frame}", trajectory=trajectory, row=row, **(chained or {}))
        # Row 0 of the artifact of `pose`, which holds one: so an elevation model depends on its own pose alone, and
        # stays in the cache when only other poses move.
        more = {"trajectory": at, "local": pair.dem, "moving": moving, "row": 0}
        self.products.world_dem[pair.frame] = self._model("world", pair, first.level, **more)
        return at

    def _model(self, where: str, pair: BasicPair, reference: Handle[GroundFacts], **more: Any) -> Handle[DemFacts]:
        """Elevations of a pair in its ``local`` frame or in the ``world``, above the plane of the ``reference``."""
        given: dict[str, Any] = {camera: self.pyramid(pair.frame, camera) for camera in CAMERAS}
        given["back"] = self.backward(pair.frame) if self.config.locus.both else None
        given |= {"disparity": pair.disparity, "rig": pair.rig, "level": pair.level, "reference": reference}
        label = f"locus/{where}/{pair.frame}"
        return self.node(locus_stage, label, **given, pair=pair.frame, frame=where, **more)

    # -- between pairs ------------------------------------------------------------------------------------------

    def segment(
        self,
        frames: Series[int],
        key: BasicPair,
        which: str = "",
        after: BasicPair | None = None,
        refused: str | None = None,
    ) -> Segment:
        """Track and resect the left images that follow basic pair ``key``, which is the first of them.

        ``after``: the basic pair that the last image is of; ``refused``: why no frame shall have a pose.
        """
        which = which or f"{key.frame}"
        images = [self.pyramid(frame, "left") for frame in frames]
        motions = [self.motion(a, b) for a, b in pairwise(frames)]
        tracked = self.node(track_stage, f"track/{which}", pyramids=images, motions=motions, frames=list(frames))
        posed = self.node(
            resect_stage,
            f"resect/{which}",
            track=tracked,
            level=key.level,
            rig=key.rig,
            disparity=key.disparity,
            after=after and after.disparity,
            rig_after=after and after.rig,
            lenses=self.given_lenses,
            refused=refused,
        )
        return Segment(tuple(frames), tracked, posed)

    # -- the world ----------------------------------------------------------------------------------------------

    def hazards(self, label: str, dems: Series[Handle], use: str | None = None) -> Handle:
        """Add the task that judges hazards on the tiles of an elevation model; ``use``: see the stage."""
        return self.node(risk_stage, label, dem=list(dems), vehicle=self.given_vehicle, use=use)


def other_plane(config: Any, levels: Series[Any], *, placed: bool) -> Args | None:
    """The reference plane instead of the ground, as arguments of stage ``ground_frame``; None: the ground.

    ``levels``: of all pairs that are known, with the ground as reference.
    ``placed``: the world has a place on Earth, so that its z is up.

    Raises
    ------
    ConfigError
        Another plane is wanted of a world that has a place on Earth.
    """
    wanted = config.terrain.reference
    if wanted is None:
        verdict = judge(levels, coarse=config.locus.cell_size is not None)
        return None if verdict.ground or placed or not levels else {"reference": SCENE, "why": verdict.why}
    if placed and wanted != "ground":
        text = "distances from a plane that is no ground have no place on Earth"
        raise ConfigError("RIL-052", text, remedy="leave world.origin out, or terrain.reference")
    if wanted == "ground":
        return None
    return {"reference": list(wanted) if isinstance(wanted, tuple) else SCENE}
