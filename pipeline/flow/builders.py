"""The parts of every flow: what reads what, from one image to a stereo pair, a segment, a world model and its hazards.

Reconstruction, closed loop and check are made of these.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from types import ModuleType
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from rille.datasets.protocol import Sequence, Source
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.keys import digest
from rille.pipeline.flow import tiles
from rille.pipeline.flow.products import Products
from rille.stages.calibration import calibration, orientation, rig, swap_check, synchrony
from rille.stages.core.declare import NoParams, Params
from rille.stages.hazard import risk
from rille.stages.hfvm import stage as hfvm
from rille.stages.imaging import pyramid, undistort
from rille.stages.odometry import motion, track
from rille.stages.odometry.resection import pose, resect
from rille.stages.terrain import ground_frame, merge
from rille.stages.terrain.locus import stage as locus
from rille.stages.terrain.tile_index import Box, tile_lattice

Args = Mapping[str, Any]
P = ParamSpec("P")
T = TypeVar("T")


NO_PARAMS = NoParams()

AROUND = 3
"""Frames before and behind a pair whose right images may be of its time."""
"""One object for all tasks without parameters: its canonical form is then made once."""


PYRAMID_BYTES = 20 / 3
"""Bytes of a pyramid for each pixel of its image: grey and mask, a third more for the levels above."""


@dataclass(frozen=True)
class Pair:
    """A basic pair: disparity, rig that it is reconstructed with, vertical, and elevation model in its own frame."""

    frame: int
    disparity: Handle
    rig: Handle
    level: Handle
    dem: Handle


@dataclass(frozen=True)
class Segment:
    """Left images from one basic pair on: their frames, tracks, and poses in the frame of that pair."""

    frames: tuple[int, ...]
    track: Handle
    resection: Handle


def once(make: Callable[Concatenate[Builder, P], T]) -> Callable[Concatenate[Builder, P], T]:
    """Method of :class:`Builder` that for the same arguments gives what it gave before."""

    def made(self: Builder, /, *args: P.args, **kwargs: P.kwargs) -> T:
        # Arguments are numbers and names: equal ones mean the same task, whoever asks for it.
        name = (make.__name__, *args, *kwargs.items())
        if name not in self.made:
            self.made[name] = make(self, *args, **kwargs)
        found: T = self.made[name]
        return found

    return made


def name(graph: Graph, sequence: Sequence, frames: Series[int]) -> None:
    """Say what a graph works on: hints of earlier runs are kept by it."""
    graph.sequence, graph.choice = sequence.name, digest(tuple(frames))[:16]


class Builder:
    """Adds tasks of a sequence to a graph, with the parameters of a configuration.

    ``products`` are the handles that the report and the exporters read. Images, pyramids, motions and disparities are
    made once, whoever asks for them.
    """

    def __init__(self, graph: Graph, sequence: Sequence, config: Any) -> None:
        self.graph, self.sequence, self.config = graph, sequence, config
        self.products = Products()
        self.made: dict[Any, Any] = {}

    # Arguments of many tasks, one object for all: each would hold some kilobytes of its own until the run's end.

    @cached_property
    def given_rig(self) -> dict[str, Any]:
        """The sequence's rig."""
        return self.sequence.rig.to_dict()

    @cached_property
    def given_vehicle(self) -> dict[str, Any]:
        """The vehicle without its name, which changes no result."""
        found: dict[str, Any] = self.config.vehicle.model_dump(mode="json", exclude={"name"})
        return found

    @cached_property
    def given_resect(self) -> dict[str, Any]:
        """The parameters of stage ``resect``, for stages that read them too."""
        found: dict[str, Any] = self.config.resect.model_dump(mode="json")
        return found

    def node(self, stage: ModuleType, label: str, args: Mapping[str, Any], **inputs: Handle | list[Handle]) -> Handle:
        """One task of the stage that a module declares, with the parameters that it has in the configuration."""
        # A section is named as its stage; a stage without parameters has none.
        params: Params = getattr(self.config, stage.STAGE.name, NO_PARAMS)
        return self.graph.node(stage, label, params, args, {}, inputs)

    # -- images -------------------------------------------------------------------------------------------------

    def source(
        self, source: Source, label: str, given: Mapping[str, Handle] | None = None, expect: float = 0.0
    ) -> Handle:
        """Task of a source, with those of what it needs; ``given`` are inputs that are there already."""
        inputs = {
            port: self.source(upstream, f"{label}/{port}") if upstream.args else self._shared(upstream)
            for port, upstream in source.inputs.items()
        }
        return self.graph.node(
            source.module, label, source.params, source.args, source.hints, {**inputs, **(given or {})}, expect
        )

    def _shared(self, source: Source) -> Handle:
        """What is the same for all frames (a rendered scene) is made once."""
        label = source.module.rsplit(".", 1)[-1]
        if label not in self.made:
            self.made[label] = self.source(source, label)
        found: Handle = self.made[label]
        return found

    @once
    def taken(self, frame: int, camera: str) -> Handle:
        """One image as the camera took it."""
        ideal = self.sequence.rig.left if camera == "left" else self.sequence.rig.right
        grey = 4.0 * ideal.width * ideal.height  # float32
        return self.source(self.sequence.image(frame, camera), f"image/{camera}/{frame}", expect=grey)

    @once
    def image(self, frame: int, camera: str) -> Handle:
        """One image as an ideal camera would have taken it."""
        image = self.taken(frame, camera)
        if camera == "left":
            self.products.images[frame] = image
        lens = (self.sequence.lenses or {}).get(camera)
        if lens is None:
            return image
        ideal = self.sequence.rig.left if camera == "left" else self.sequence.rig.right
        args = {"lens": lens.to_dict(), "camera": ideal.to_dict(), "frame": frame, "camera_name": camera}
        image = self.node(undistort, f"undistort/{camera}/{frame}", args, image=image)
        if camera == "left":
            self.products.undistorted[frame] = image
        return image

    @once
    def pyramid(self, frame: int, camera: str) -> Handle:
        """Image pyramid."""
        return self.node(pyramid, f"pyramid/{camera}/{frame}", {}, image=self.image(frame, camera))

    # -- what two images show -----------------------------------------------------------------------------------

    @once
    def motion(self, a: int, b: int) -> Handle:
        """Displacements from one left image to another."""
        ports = {"a": self.pyramid(a, "left"), "b": self.pyramid(b, "left")}
        return self.node(motion, f"motion/{a}-{b}", self._turn(a, b), **ports)

    def _turn(self, a: int, b: int) -> dict[str, Any]:
        """What is known of the rotation of the left camera from frame to frame."""
        args: dict[str, Any] = {"frames": [a, b]}
        before, after = (None if self.sequence.attitude is None else self.sequence.attitude[f] for f in (a, b))
        if before is None or after is None:
            return args
        rotation = np.array(after).T @ np.array(before)
        return args | {"rotation": rotation.tolist(), "camera": self.sequence.rig.left.to_dict()}

    def sides(self, frame: int) -> Handle:
        """Whether the images of a pair are exchanged."""
        args = {"frame": frame, "rig": self.given_rig}
        ports = {camera: self.pyramid(frame, camera) for camera in ("left", "right")}
        return self.node(swap_check, f"swap_check/{frame}", args, **ports)

    def synchrony(self, label: str, pairs: Series[int], frames: Series[int]) -> Handle:
        """Which right images, of those of some frames about each pair, are of the time of the left ones."""
        at = [frames.index(pair) for pair in pairs]
        near = [f for k, f in enumerate(frames) if any(abs(k - place) <= AROUND for place in at)]
        images = {"left": [self.pyramid(f, "left") for f in pairs], "right": [self.pyramid(f, "right") for f in near]}
        return self.node(synchrony, label, {"pairs": list(pairs), "frames": near, "rig": self.given_rig}, **images)

    @once
    def disparity(self, pair: int) -> Handle:
        """Disparity of the left image of a pair."""
        return self._matched(f"hfvm/{pair}", pair, "left", "right")

    @once
    def backward(self, pair: int) -> Handle:
        """Disparity of the right image of a pair."""
        return self._matched(f"hfvm/back/{pair}", pair, "right", "left")

    def _matched(self, label: str, pair: int, camera: str, other: str) -> Handle:
        """One task, or for a large pair tasks per level and tile that give the same artifact."""
        ports = {"left": self.pyramid(pair, camera), "right": self.pyramid(pair, other)}
        cameras = {"left": self.sequence.rig.left, "right": self.sequence.rig.right}
        first, second = ((cameras[name].height, cameras[name].width) for name in (camera, other))
        side = tiles.side(self.config.tiling, self.config.hfvm, self.config.pyramid, (first, second))
        if side is None:
            # A smaller right image may be aligned to the left one, and is then as large.
            more = PYRAMID_BYTES * max(math.prod(first) - math.prod(second), 0)
            return self.graph.node(hfvm, label, self.config.hfvm, {"pair": pair}, {}, ports, more)
        given = self.config.hfvm, self.config.pyramid, ports, (first, second), side
        return tiles.Tiles(self.graph, *given, label).build()

    # -- a stereo pair ------------------------------------------------------------------------------------------

    @once
    def orientation(self, pair: int) -> Handle:
        """Relative orientation that the disparity of a pair asks for."""
        args = {"pair": pair, "rig": self.given_rig}
        return self.node(orientation, f"orientation/{pair}", args, disparity=self.disparity(pair))

    def rig(self, pairs: Series[int], which: str = "") -> tuple[Handle, Handle]:
        """The rig that the orientations of these pairs agree on, and what of it other stages read."""
        orientations = [self.orientation(pair) for pair in pairs]
        found = self.node(rig, f"rig{which}", {"rig": self.given_rig}, orientations=orientations)
        return found, self.node(calibration, f"calibration{which}", {}, rig=found)

    def pair(self, frame: int, vertical: Mapping[str, Any], known: Handle, first: Pair | None) -> Pair:
        """Vertical and local elevation model of a pair; ``known`` is its rig.

        Cells and extent of the ``first`` pair (None: this one) serve all, so that they merge.
        """
        disparity = self.disparity(frame)
        level = self.node(
            ground_frame, f"ground_frame/{frame}", {"pair": frame, **vertical}, disparity=disparity, rig=known
        )
        reference = level if first is None else first.level
        args = {"pair": frame, "frame": "local"}
        dem = self._elevations(f"locus/local/{frame}", args, disparity, known, level, reference)
        return Pair(frame, disparity, known, level, dem)

    def world_model(self, pair: Pair, first: Pair, row: int, trajectory: Handle) -> tuple[Handle, Handle]:
        """Pose and elevations of a pair straight on the world lattice: the pose in this row of the trajectory.

        The frame of pair ``first`` is the world.
        """
        at = self.node(pose, f"pose/{pair.frame}", {"row": row}, trajectory=trajectory)
        # Row 0 of the artifact of `pose`, which holds one: so an elevation model depends on its own pose alone, and
        # stays in the cache when only other poses move.
        args = {"pair": pair.frame, "frame": "world", "row": 0}
        known = pair.disparity, pair.rig, pair.level, first.level
        return at, self._elevations(f"locus/world/{pair.frame}", args, *known, trajectory=at, local=pair.dem)

    def _elevations(
        self,
        label: str,
        args: Mapping[str, Any],
        disparity: Handle,
        known: Handle,
        level: Handle,
        reference: Handle,
        **where: Handle,
    ) -> Handle:
        """Locus: what the images of the pair ``args["pair"]`` show, from both disparities where that is wanted."""
        frame = args["pair"]
        back = {"back": self.backward(frame)} if self.config.locus.both else {}
        images = {camera: self.pyramid(frame, camera) for camera in ("left", "right")}
        return self.node(
            locus,
            label,
            args,
            disparity=disparity,
            rig=known,
            **images,
            **back,
            level=level,
            reference=reference,
            **where,
        )

    # -- between pairs ------------------------------------------------------------------------------------------

    def segment(
        self, frames: Series[int], key: Pair, more: Args | None = None, which: str = "", after: Pair | None = None
    ) -> Segment:
        """Track and resect the left images that follow basic pair ``key``, which is the first of them.

        ``more``: arguments of the resection; ``after``: the basic pair that the last image is of.
        """
        args, which = {"frames": list(frames)}, which or f"{key.frame}"
        images = [self.pyramid(frame, "left") for frame in frames]
        motions = [self.motion(a, b) for a, b in pairwise(frames)]
        tracked = self.node(track, f"track/{which}", args, frames=images, motions=motions)
        # landmarks come from the disparity, or (resect.landmarks = "dem") where rays meet the local elevation model
        surface = {"dem": key.dem} if self.config.resect.landmarks == "dem" else {}
        known = {"disparity": key.disparity, "level": key.level, "rig": key.rig, **surface}
        known |= {"after": after.disparity, "rig_after": after.rig} if after else {}
        posed = self.node(resect, f"resect/{which}", {**args, **(more or {})}, track=tracked, **known)
        return Segment(tuple(frames), tracked, posed)

    # -- the world ----------------------------------------------------------------------------------------------

    def hazards(self, label: str, dems: list[Handle]) -> Handle:
        """Add the task that judges hazards on the tiles of an elevation model."""
        args = {"vehicle": self.given_vehicle}
        return self.node(risk, label, args, dem=dems)


def merge_tiles(
    node: Callable[..., Handle],
    footprints: Series[Mapping[str, Any]],
    dems: Mapping[int, Handle],
    steps: Mapping[str, int],
) -> list[Handle]:
    """Add one task for each world tile that a model touches; it reads these models and nothing else.

    Parameters
    ----------
    node : ``node(stage, label, args, **inputs)`` adds a task, as :meth:`Builder.node` does.
    footprints : facts of stage ``tile_index``, one a model.
    dems : world models by pair.
    steps : exposure of the pairs whose grey values are levelled, as stage ``radiometry`` gives them.
    """
    touching: dict[tuple[int, int], list[tuple[int, Box]]] = {}
    for meta in footprints:
        for tx, ty, *box in meta["tiles"]:
            touching.setdefault((ty, tx), []).append((meta["pair"], (box[0], box[1], box[2], box[3])))
    tiles = []
    for (ty, tx), here in sorted(touching.items()):
        # In order of the pairs: merging must not depend on the order in which results arrived.
        here.sort()
        args: dict[str, Any] = {"lattice": tile_lattice([box for _, box in here], footprints[0]["cell"]).to_dict()}
        # Of this tile's pairs alone: a level that changes elsewhere leaves the tile in the cache.
        exposure = {str(pair): steps[str(pair)] for pair, _ in here if str(pair) in steps}
        args |= {"exposure": exposure} if exposure else {}
        tiles.append(node(merge, f"merge/{tx}_{ty}", args, dems=[dems[pair] for pair, _ in here]))
    return tiles


def centre(box: Mapping[str, Any]) -> list[float]:
    """Centre x, y of a lattice, metres."""
    half = 0.5 * box["cell"]
    return [box["x0"] + half * (box["cols"] - 1), box["y0"] - half * (box["rows"] - 1)]
