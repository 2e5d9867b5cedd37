"""The dataflow, top to bottom: what is computed from what. Draw it from this file.

::

    image -> undistort -> pyramid -+-> motion (N, N+1) -+-> continuity -> select: which pairs are basic
             (if needed)           |                    +-> track (segment) --+
                                   |                                          |
                                   +-> hfvm (basic pair) -+-> level ----------+-> resect (segment) -> trajectory
                                                          |     |               (landmarks)  (refine)     |
        given rig --+-> orientation (basic pair) <--------+     |                                         |
                    |       +-> rig -> calibration -------+-----+-> locus (local frame)                   |
                    |           (pooled; into level,      |           +-> risk, path (local)              |
                    |            locus and resect)        +-> locus (world lattice) <- pose (pair) <------+
                    |                                           +-> footprint (pair): which world tiles it touches
                    |                                           +-> seam (pair, earlier ones) -> seam_audit, exposure
                    |                                           +-> merge (world tile) -> risk, path (mission)
                    +-> crosscheck (window; images of both cameras) -> crosscheck_join -> agreement <- trajectory
    leaves: accuracy (trajectory, crosscheck), position_accuracy, dem_accuracy (local and merged DEM), path_check

Frames that show no motion (black, foreign, sides exchanged) are lost: ``continuity`` finds them by ``sight`` (what
each pair looks like), the motions, and where it asks for them bridges (motions over a lost frame) and ``sides`` (left
against right).

A segment needs landmarks only relative to its own basic pair, so all segments run at once; absolute poses are one
cheap scan (``trajectory``), and Locus then runs a second time, straight on the shared world lattice: nothing is
resampled. Locus reads both pyramids' finest images, and with ``locus.both`` the disparities of both (``hfvm/back``).
What depends on data (which pairs are basic, how far the world reaches) is expanded as results arrive.

The world is cut into tiles once and for all; a tile's task has those models alone as inputs that have a cell in it. A
pair that is added, or moved by another pose, is thus merged anew in the tiles that it touches and touched, no others:
world models depend on their own pose only, and what comes out as before is not followed any further.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from datasets.protocol import Positions, Sequence, Source
from pipeline.engine.graph import Graph, Handle
from pipeline.engine.task import Ref
from pipeline.flow import tiles as tiling
from pipeline.flow.config import STAGE_MODULES
from stages.core.declare import NoParams, Params
from stages.core.errors import DegenerateError, InputError
from stages.evaluation.crosscheck import windows
from stages.geometry.geometry import Camera, RigidTransform
from stages.geometry.lattice import Lattice, union
from stages.terrain.tile_index import Box, tile_lattice

if TYPE_CHECKING:
    from pipeline.flow.closed_loop import Driven

TILE_CELLS = 512
"""Side of a world tile, cells: 512 x 512 float32 is 1 MiB an array, small enough to recompute alone."""


@dataclass
class Products:
    """Handles of what a run delivers; the report and the exporters read them once the graph has run."""

    images: dict[int, Handle] = field(default_factory=dict)
    undistorted: dict[int, Handle] = field(default_factory=dict)
    continuity: Handle | None = None
    select: Handle | None = None
    orientations: dict[int, Handle] = field(default_factory=dict)
    rigs: dict[int, Handle] = field(default_factory=dict)
    crosschecks: list[Handle] = field(default_factory=list)
    crosscheck: Handle | None = None
    agreement: Handle | None = None
    crosscheck_accuracy: Handle | None = None
    disparity: dict[int, Handle] = field(default_factory=dict)
    level: dict[int, Handle] = field(default_factory=dict)
    local_dem: dict[int, Handle] = field(default_factory=dict)
    local_risk: dict[int, Handle] = field(default_factory=dict)
    local_path: dict[int, Handle] = field(default_factory=dict)
    tracks: list[Handle] = field(default_factory=list)
    resections: list[Handle] = field(default_factory=list)
    refined: Handle | None = None
    world_dem: dict[int, Handle] = field(default_factory=dict)
    seams: dict[int, Handle] = field(default_factory=dict)
    seam_audit: Handle | None = None
    tiles: list[Handle] = field(default_factory=list)
    trajectory: Handle | None = None
    risk: Handle | None = None
    path: Handle | None = None
    accuracy: Handle | None = None
    position_accuracy: Handle | None = None
    accuracy_pieces: dict[int, Handle] = field(default_factory=dict)
    local_dem_accuracy: dict[int, Handle] = field(default_factory=dict)
    dem_accuracy: Handle | None = None
    truth_risk: Handle | None = None
    path_check: Handle | None = None
    drive: Driven | None = None


class Reconstruction:
    """Builds the graph of one sequence; ``frames`` are the chosen frame numbers in order."""

    def __init__(self, graph: Graph, sequence: Sequence, config: Any, frames: tuple[int, ...]) -> None:
        self.graph, self.sequence, self.config, self.frames = graph, sequence, config, frames
        self.products = Products()
        self._sources: dict[str, Handle] = {}
        self._images: dict[tuple[int, str], Handle] = {}
        self._pyramids: dict[tuple[int, str], Handle] = {}
        self._backward: dict[int, Handle] = {}
        self.left: dict[int, Handle] = {}
        self.motion: dict[tuple[int, int], Handle] = {}
        self.calibration: dict[int, Handle] = {}

    def build(self) -> Products:
        """Lay out everything that is known beforehand; the rest follows by expansion."""
        self.whole = [f for f in self.frames if f not in self.sequence.lost]
        if not self.whole:
            raise InputError("RIL-050", "no chosen frame has both images", remedy="choose others with --frames")
        self.left = {f: self._pyramid(f, "left") for f in self.whole}
        for a, b in pairwise(self.whole):
            self._motion(a, b)
        self._match(self.whole[0])  # basic unless it is lost, so that its matching need not wait for the choice
        if self.config.crosscheck.enabled and len(self.whole) > 1:
            self._crosscheck()
        self.sights = [
            self._node("sight", f"sight/{f}", {"frame": f}, left=self._image(f, "left"), right=self._image(f, "right"))
            for f in self.whole
        ]
        self._continuity({}, {}, 0)
        return self.products

    def _continuity(self, bridges: Mapping[tuple[int, int], Handle], sides: Mapping[int, Handle], turn: int) -> None:
        """Ask which frames are lost; while more is to be known for the answer, find that and ask again."""
        found = self._node(
            "continuity",
            f"continuity/{turn}" if turn else "continuity",
            {"frames": self.whole} | ({"bridges": list(bridges)} if bridges else {}),
            sights=self.sights,
            motions=[self.motion[step] for step in pairwise(self.whole)],
            bridges=list(bridges.values()),
            sides=list(sides.values()),
        )

        def answer(ref: Ref) -> None:
            asks = ref.meta["asks"]
            if not any(asks.values()):
                self.products.continuity = found
                self._after_continuity(ref)
                return
            more = {(a, b): self._motion(a, b) for a, b in asks["bridges"]}
            looked = {f: self._sides(f) for f in asks["sides"]}
            self._continuity({**bridges, **more}, {**sides, **looked}, turn + 1)

        self.graph.expand([found], answer)

    def _motion(self, a: int, b: int) -> Handle:
        if (a, b) not in self.motion:
            ports = {"a": self.left[a], "b": self.left[b]}
            self.motion[a, b] = self._node("motion", f"motion/{a}-{b}", self._turn(a, b), **ports)
        return self.motion[a, b]

    def _sides(self, frame: int) -> Handle:
        args = {"frame": frame, "rig": self.sequence.rig.to_dict()}
        return self._node("sides", f"sides/{frame}", args, left=self.left[frame], right=self._pyramid(frame, "right"))

    def _after_continuity(self, continuity: Ref) -> None:
        """Frames that the trajectory goes through are known: choose the basic pairs among them."""
        p, meta = self.products, continuity.meta
        self.chain: list[int] = list(meta["chain"])
        missing = [{"frame": f, "cause": why} for f, why in self.sequence.lost.items() if f in self.frames]
        self.lost = sorted([*missing, *meta["lost"]], key=lambda item: item["frame"])
        for frame in [f for f in p.disparity if f not in self.chain]:
            del p.disparity[frame], p.orientations[frame]
        unfit = {"unfit": [self.chain.index(f) for f in meta["unfit"]]} if meta["unfit"] else {}
        steps = [self._motion(a, b) for a, b in pairwise(self.chain)]
        p.select = self._node("select", "select", {"frames": len(self.chain)} | unfit, motions=steps)
        self.graph.expand([p.select], self._after_select)

    def _after_select(self, select: Ref) -> None:
        p = self.products
        self.basic = [self.chain[i] for i in select.meta["basic"]]
        segments = [[self.chain[i] for i in part] for part in select.meta["segments"]]
        for pair in self.basic:
            self._match(pair)
        self._rigs(self.basic)
        for pair in self.basic:
            self._basic_pair(pair)
        for segment in segments:
            track, resection = self._segment(segment, f"{segment[0]}")
            p.tracks.append(track)
            p.resections.append(resection)
        p.trajectory = self._node(
            "trajectory",
            "trajectory",
            {"frames": list(self.frames)} | ({"lost": self.lost} if self.lost else {}),
            segments=p.resections,
            levels=[p.level[s[0]] for s in segments] or [p.level[self.basic[0]]],
            **self._refined([s[0] for s in segments]),
        )
        self._assess_trajectory()
        self.graph.expand([p.trajectory], self._after_trajectory)

    def _after_trajectory(self, trajectory: Ref) -> None:
        """The world is that of the largest unbroken piece: its models, straight on the world lattice."""
        p = self.products
        assert p.trajectory is not None
        first, last = trajectory.meta["pieces"][trajectory.meta["main"]]
        pairs = [k for k in self.basic if first <= k <= last and trajectory.meta["positions"][self.frames.index(k)]]
        for pair in pairs:
            self._world_model(pair, pairs[0], self.frames.index(pair), p.trajectory)
        side, margin = TILE_CELLS, self.config.merge.margin
        footprints = [
            self._node("footprint", f"footprint/{pair}", {"side": side, "margin": margin}, dem=dem)
            for pair, dem in p.world_dem.items()
        ]
        self.graph.expand([*footprints, p.trajectory], self._after_world, holes=True)

    def _match(self, pair: int) -> None:
        """Disparity of a pair, and the relative orientation that it asks for."""
        p = self.products
        if pair in p.disparity:
            return
        self._disparity(pair)
        p.orientations[pair] = self._node(
            "orientation",
            f"orientation/{pair}",
            {"pair": pair, "rig": self.sequence.rig.to_dict()},
            disparity=p.disparity[pair],
        )

    def _disparity(self, pair: int) -> None:
        """Disparity of the left image of a pair."""
        rig, images = self.sequence.rig, (self.left[pair], self._pyramid(pair, "right"))
        self.products.disparity[pair] = self._matched(f"hfvm/{pair}", pair, images, (rig.left, rig.right))

    def _back(self, pair: int) -> dict[str, Handle]:
        """Disparity of the right image, where elevations are to be read from both."""
        if not self.config.locus.both:
            return {}
        if pair not in self._backward:
            rig, images = self.sequence.rig, (self._pyramid(pair, "right"), self.left[pair])
            self._backward[pair] = self._matched(f"hfvm/back/{pair}", pair, images, (rig.right, rig.left))
        return {"back": self._backward[pair]}

    def _matched(self, label: str, pair: int, images: tuple[Handle, Handle], cameras: tuple[Camera, Camera]) -> Handle:
        """One task, or for a large pair tasks per level and tile that give the same artifact."""
        ports = dict(zip(("left", "right"), images, strict=True))
        first, second = ((camera.height, camera.width) for camera in cameras)
        side = tiling.side(self.config.tiling, self.config.hfvm, (first, second))
        if side is None:
            return self._node("hfvm", label, {"pair": pair}, **ports)
        given = self.config.hfvm, self.config.pyramid, ports, (first, second), side
        return tiling.Tiles(self.graph, *given, label).build()

    def _rigs(self, basic: list[int]) -> None:
        """The rig that each basic pair is reconstructed with: one for all, or one each."""
        p = self.products
        if self.config.rig.mode == "per_pair":
            p.rigs = {k: self._rig([k], f"/{k}") for k in basic}
            self.calibration = {k: self._node("calibration", f"calibration/{k}", {}, rig=p.rigs[k]) for k in basic}
            return
        rig = self._rig(basic, "")
        p.rigs = dict.fromkeys(basic, rig)
        self.calibration = dict.fromkeys(basic, self._node("calibration", "calibration", {}, rig=rig))

    def _rig(self, pairs: list[int], which: str) -> Handle:
        orientations = [self.products.orientations[k] for k in pairs]
        return self._node("rig", f"rig{which}", {"rig": self.sequence.rig.to_dict()}, orientations=orientations)

    def _pair(self, pair: int, vertical: Mapping[str, Any]) -> None:
        """Vertical and local elevation model of a pair whose disparity and rig are there."""
        p = self.products
        known = {"disparity": p.disparity[pair], "rig": self.calibration[pair]}
        p.level[pair] = self._node("level", f"level/{pair}", vertical, **known)
        first = next(iter(p.level))  # cells and extent of the first pair serve all, so that they merge
        p.local_dem[pair] = self._elevations(f"locus/local/{pair}", {"pair": pair, "frame": "local"}, first)

    def _world_model(self, pair: int, first: int, row: int, trajectory: Handle) -> Handle:
        """Locus straight on the world lattice, by the pair's own pose: the one in this row of the trajectory."""
        p = self.products
        pose = self._node("pose", f"pose/{pair}", {"row": row}, trajectory=trajectory)
        args = {"pair": pair, "frame": "world", "row": 0}
        given = {"trajectory": pose, "local": p.local_dem[pair]}
        p.world_dem[pair] = self._elevations(f"locus/world/{pair}", args, first, **given)
        return pose

    def _elevations(self, label: str, args: Mapping[str, Any], first: int, **where: Handle) -> Handle:
        """Locus: what the images of the pair ``args["pair"]`` show; the frame of pair ``first`` is the reference."""
        p, pair = self.products, args["pair"]
        return self._node(
            "locus",
            label,
            args,
            disparity=p.disparity[pair],
            rig=self.calibration[pair],
            left=self.left[pair],
            right=self._pyramid(pair, "right"),
            **self._back(pair),
            level=p.level[pair],
            reference=p.level[first],
            **where,
        )

    def _basic_pair(self, pair: int) -> None:
        """Stereo pair to local elevation model, risk map and path (stop and think)."""
        p = self.products
        self._pair(pair, self._vertical(pair))
        p.local_risk[pair] = self._risk(f"risk/local/{pair}", [p.local_dem[pair]])
        p.local_path[pair] = self._node("path", f"path/local/{pair}", {"use": "local"}, risk=p.local_risk[pair])
        if self.sequence.truth_dem is not None and self._truth(pair) is not None:
            self.graph.expand([p.level[pair], p.local_dem[pair]], lambda *refs, k=pair: self._local_accuracy(k, *refs))

    def _segment(self, frames: list[int], which: str) -> tuple[Handle, Handle]:
        """Track and resect the left images that follow a basic pair, which is the first of them (path execution)."""
        p, key = self.products, frames[0]
        track = self._node(
            "track",
            f"track/{which}",
            {"frames": frames},
            frames=[self.left[f] for f in frames],
            motions=[self._motion(a, b) for a, b in pairwise(frames)],
        )
        # landmarks come from the disparity, or (resect.landmarks = "dem") where rays meet the local elevation model
        surface = {"dem": p.local_dem[key]} if self.config.resect.landmarks == "dem" else {}
        resection = self._node(
            "resect",
            f"resect/{which}",
            {"frames": frames} | self._prediction(frames),
            track=track,
            disparity=p.disparity[key],
            level=p.level[key],
            rig=self.calibration[key],
            **surface,
        )
        return track, resection

    def _refined(self, keys: list[int]) -> dict[str, Handle]:
        """All segments adjusted jointly with their landmarks, where that is wanted."""
        p = self.products
        if not (self.config.refine.enabled and keys and self.config.resect.landmarks == "disparity"):
            return {}
        args = {"pairs": self.basic, "resect": self.config.resect.model_dump(mode="json")}
        p.refined = self._node(
            "refine",
            "refine",
            args,
            tracks=p.tracks,
            resections=p.resections,
            levels=[p.level[k] for k in keys],
            disparities=[p.disparity[k] for k in self.basic],
            rigs=[self.calibration[k] for k in self.basic],
        )
        return {"refined": p.refined}

    def _crosscheck(self) -> None:
        """Structure from motion by another program, in windows; it knows nothing of our trajectory, nor we of its."""
        p, rig = self.products, self.sequence.rig.to_dict()
        for window in windows(self.whole, self.config.crosscheck):
            p.crosschecks.append(
                self._node(
                    "crosscheck",
                    f"crosscheck/{window[0]}-{window[-1]}",
                    {"frames": window, "rig": rig},
                    left=[self._image(f, "left") for f in window],
                    right=[self._image(f, "right") for f in window],
                )
            )
        p.crosscheck = self._node("crosscheck_join", "crosscheck_join", {"frames": self.whole}, windows=p.crosschecks)

    def _after_world(self, *refs: Ref | None) -> None:
        """Where the models lie is known: audit their seams, and level exposures before those that are are merged."""
        *found, trajectory = refs
        assert trajectory is not None
        footprints = [ref.meta for ref in found if ref is not None and ref.meta["tiles"]]
        if not footprints:
            raise DegenerateError(
                "RIL-051", "no elevation model has a cell in the world", remedy="look at the disparities' validity"
            )
        centres = {str(f["pair"]): _centre(f["box"]) for f in footprints}
        seams = self._seams(footprints)
        self.products.seam_audit = self._node("seam_audit", "seam_audit", {"centres": centres}, seams=seams)
        exposure = self._node("exposure", "exposure", {"centres": centres}, seams=seams)
        self.graph.expand([exposure], lambda levelled: self._after_exposure(footprints, trajectory, levelled))

    def _seams(self, footprints: list[Mapping[str, Any]]) -> list[Handle]:
        """Each model against the earlier ones with which it shares a tile."""
        p = self.products
        present: dict[tuple[int, int], list[int]] = {}
        for meta in footprints:
            pair, near = meta["pair"], set[int]()
            for tx, ty, *_ in meta["tiles"]:
                near.update(present.get((tx, ty), ()))
                present.setdefault((tx, ty), []).append(pair)
            if near:
                others = [p.world_dem[other] for other in sorted(near)]
                p.seams[pair] = self._node("seam", f"seam/{pair}", {}, dem=p.world_dem[pair], others=others)
        return list(p.seams.values())

    def _after_exposure(self, footprints: list[Mapping[str, Any]], trajectory: Ref, levelled: Ref) -> None:
        """Merge in world tiles, then hazards and the path over all of it."""
        p = self.products
        p.tiles = merge_tiles(self._node, footprints, p.world_dem, levelled.meta["steps"])
        p.risk = self._risk("risk/world", p.tiles)
        heading = _heading(trajectory.meta)
        p.path = self._node("path", "path/world", {"use": "world", "heading": heading}, risk=p.risk)
        pairs = list(p.world_dem)
        if self.sequence.truth_dem is not None and self._truth(pairs[0]) is not None:
            whole = union(Lattice.from_dict(tile.spec.args["lattice"]) for tile in p.tiles)
            self.graph.expand([p.level[pairs[0]]], lambda level: self._world_accuracy(whole, pairs, level))

    # -- assessment: the only readers of truth ------------------------------------------------------------------

    def _truth(self, frame: int) -> RigidTransform | None:
        return None if self.sequence.truth is None else self.sequence.truth[frame]

    def _assess_trajectory(self) -> None:
        """Against the other program's, and both against truth where there is one."""
        p = self.products
        assert p.trajectory is not None
        if p.crosscheck is not None:
            p.agreement = self._node("agreement", "agreement", {}, trajectory=p.trajectory, crosscheck=p.crosscheck)
        if self.sequence.truth_positions is not None:
            args = self._positions(self.sequence.truth_positions)
            p.position_accuracy = self._node("position_accuracy", "position_accuracy", args, trajectory=p.trajectory)
        true = [self._truth(f) for f in self.frames]
        if all(pose is None for pose in true):
            return
        truth = self._node(
            "truth",
            "truth",
            {
                "poses": [None if pose is None else pose.to_list() for pose in true],
                "source": self.sequence.truth_source,
                "frames": list(self.frames),
            },
        )
        self.graph.expand([p.trajectory], lambda found: self._accuracy_of_pieces(found, truth))
        if p.crosscheck is not None:
            self.graph.expand([p.crosscheck], lambda found: self._crosscheck_accuracy(found, truth))

    def _positions(self, truth: Positions) -> dict[str, Any]:
        """Arguments of the comparison with true positions: of the chosen frames, where rows are frames."""
        s = self.sequence
        args, moments = truth.to_dict(), None
        if truth.times is None:
            args["positions"] = [args["positions"][f] for f in self.frames]
        elif s.times is not None:
            moments = [s.times[f] for f in self.frames]
        return args | {"moments": moments, "frames": list(self.frames), "source": s.truth_source}

    def _accuracy_of_pieces(self, found: Ref, truth: Handle) -> None:
        """Each unbroken piece against truth; a whole trajectory as it is."""
        p, pieces = self.products, found.meta["pieces"]
        assert p.trajectory is not None
        for number in range(len(pieces)):
            main = number == found.meta["main"]
            args = {"piece": number} if len(pieces) > 1 else {}
            label = "accuracy" if main else f"accuracy/piece/{number + 1}"
            judged = self._node("accuracy", label, args, trajectory=p.trajectory, truth=truth)
            p.accuracy_pieces[number] = judged
            if main:
                p.accuracy = judged

    def _crosscheck_accuracy(self, found: Ref, truth: Handle) -> None:
        """The other program's trajectory against truth, where it has one there."""
        p, positions = self.products, found.meta["positions"]
        judged = [self._truth(f) for f, position in zip(found.meta["frames"], positions, strict=True) if position]
        if p.crosscheck is not None and any(pose is not None for pose in judged):
            p.crosscheck_accuracy = self._node(
                "accuracy", "accuracy/crosscheck", {}, trajectory=p.crosscheck, truth=truth
            )

    def _local_accuracy(self, pair: int, level: Ref, dem: Ref) -> None:
        truth = self._truth_dem(Lattice.from_dict(dem.meta["lattice"]), pair, level, (pair,), "local")
        args: dict[str, Any] = {"pair": pair}
        if self.sequence.evaluation_window is not None:
            args["window"] = list(self.sequence.evaluation_window)
        self.products.local_dem_accuracy[pair] = self._node(
            "dem_accuracy", f"dem_accuracy/local/{pair}", args, dem=[self.products.local_dem[pair]], truth=truth
        )

    def _world_accuracy(self, whole: Lattice, pairs: list[int], level: Ref) -> None:
        p = self.products
        truth = self._truth_dem(whole, pairs[0], level, tuple(pairs), "world")
        p.dem_accuracy = self._node("dem_accuracy", "dem_accuracy/world", {}, dem=p.tiles, truth=truth)
        p.truth_risk = self._risk("risk/truth", [truth])
        assert p.path is not None
        p.path_check = self._node("path_check", "path_check", {}, path=p.path, risk=p.truth_risk)

    def _truth_dem(self, lattice: Lattice, pair: int, level: Ref, seen_by: tuple[int, ...], scope: str) -> Handle:
        """Exact elevations in the levelled frame of ``pair`` (for the first pair: the world)."""
        T_truth_left = self._truth(pair)
        assert T_truth_left is not None
        assert self.sequence.truth_dem is not None
        T_local_left = RigidTransform.from_matrix(level.meta["T_local_left"])
        T_truth_local = T_truth_left @ T_local_left.inverse()
        source = self.sequence.truth_dem(lattice.to_dict(), T_truth_local, seen_by)
        return self._source(source, f"truth_dem/{scope}/{pair}")

    # -- small things ------------------------------------------------------------------------------------------

    def _vertical(self, pair: int) -> dict[str, Any]:
        """What is known of the vertical of a pair, most trusted first."""
        s = self.sequence
        args: dict[str, Any] = {"pair": pair}
        up = None if s.up is None else s.up[pair]
        if up is not None:
            args["up"] = list(up)
        if s.initial_pose is not None and pair == self.frames[0]:
            args["initial_up"] = [float(v) for v in s.initial_pose.rotation[2]]
        if s.pitch is not None:
            args["pitch"] = s.pitch
        return args

    def _turn(self, a: int, b: int) -> dict[str, Any]:
        """What is known of the rotation of the left camera from frame to frame."""
        args: dict[str, Any] = {"frames": [a, b]}
        before, after = (None if self.sequence.attitude is None else self.sequence.attitude[f] for f in (a, b))
        if before is None or after is None:
            return args
        rotation = np.array(after).T @ np.array(before)
        return args | {"rotation": rotation.tolist(), "camera": self.sequence.rig.left.to_dict()}

    def _prediction(self, segment: list[int]) -> dict[str, Any]:
        """Poses of a segment's frames in its key frame by dead reckoning."""
        known = self.sequence.odometry
        key = None if known is None else known[segment[0]]
        if known is None or key is None:
            return {}
        poses = [known[f] for f in segment]
        return {"prediction": [None if T is None else (key.inverse() @ T).to_list() for T in poses]}

    def _risk(self, label: str, dems: list[Handle]) -> Handle:
        return self._node(
            "risk", label, {"vehicle": self.config.vehicle.model_dump(mode="json", exclude={"name"})}, dem=dems
        )

    def _pyramid(self, frame: int, camera: str) -> Handle:
        if (frame, camera) not in self._pyramids:
            image = self._image(frame, camera)
            self._pyramids[frame, camera] = self._node("pyramid", f"pyramid/{camera}/{frame}", {}, image=image)
        return self._pyramids[frame, camera]

    def _image(self, frame: int, camera: str) -> Handle:
        """One image as an ideal camera would have taken it."""
        if (frame, camera) not in self._images:
            self._images[frame, camera] = self._undistorted(frame, camera)
        return self._images[frame, camera]

    def _undistorted(self, frame: int, camera: str) -> Handle:
        ideal = self.sequence.rig.left if camera == "left" else self.sequence.rig.right
        grey = 4.0 * ideal.width * ideal.height  # float32
        image = self._source(self.sequence.image(frame, camera), f"image/{camera}/{frame}", grey)
        if camera == "left":
            self.products.images[frame] = image
        lens = (self.sequence.lenses or {}).get(camera)
        if lens is None:
            return image
        args = {"lens": lens.to_dict(), "camera": ideal.to_dict(), "frame": frame, "camera_name": camera}
        image = self._node("undistort", f"undistort/{camera}/{frame}", args, image=image)
        if camera == "left":
            self.products.undistorted[frame] = image
        return image

    def _source(self, source: Source, label: str, expect: float = 0.0) -> Handle:
        """Node of a source, and of what it needs; what is the same for all frames (a rendered scene) is made once."""
        inputs = {
            port: self._source(upstream, f"{label}/{port}") if upstream.args else self._shared(upstream)
            for port, upstream in source.inputs.items()
        }
        return self.graph.node(
            source.module, label, source.params, dict(source.args), dict(source.hints), inputs, expect
        )

    def _shared(self, source: Source) -> Handle:
        label = source.module.rsplit(".", 1)[-1]
        if label not in self._sources:
            self._sources[label] = self._source(source, label)
        return self._sources[label]

    def _node(self, name: str, label: str, args: Mapping[str, Any], **inputs: Handle | list[Handle]) -> Handle:
        params: Params = getattr(self.config, name, NoParams())
        return self.graph.node(STAGE_MODULES[name], label, params, dict(args), {}, inputs)


def merge_tiles(
    node: Callable[..., Handle],
    footprints: Series[Mapping[str, Any]],
    dems: Mapping[int, Handle],
    steps: Mapping[str, int],
) -> list[Handle]:
    """One task for each world tile that a model touches; all that enters it is of the models that do.

    Parameters
    ----------
    node : ``node(stage, label, args, **inputs)`` adds a task.
    footprints : facts of stage ``footprint``, one a model.
    dems : world models by pair.
    steps : exposure of the pairs whose grey values are levelled, as stage ``exposure`` gives them.
    """
    touching: dict[tuple[int, int], list[tuple[int, Box]]] = {}
    for meta in footprints:
        for tx, ty, *box in meta["tiles"]:
            touching.setdefault((ty, tx), []).append((meta["pair"], (box[0], box[1], box[2], box[3])))
    tiles = []
    for (ty, tx), here in sorted(touching.items()):
        here.sort()
        args: dict[str, Any] = {"lattice": tile_lattice([box for _, box in here], footprints[0]["cell"]).to_dict()}
        exposure = {str(pair): steps[str(pair)] for pair, _ in here if str(pair) in steps}
        args |= {"exposure": exposure} if exposure else {}
        tiles.append(node("merge", f"merge/{tx}_{ty}", args, dems=[dems[pair] for pair, _ in here]))
    return tiles


def _centre(box: Mapping[str, Any]) -> list[float]:
    """Centre x, y of a lattice, metres."""
    half = 0.5 * box["cell"]
    return [box["x0"] + half * (box["cols"] - 1), box["y0"] - half * (box["rows"] - 1)]


def _heading(trajectory: Mapping[str, Any]) -> list[float]:
    """Mean driving direction (dx, dy) in the world: from the first to the last position; ahead where it rests."""
    first, last = trajectory["pieces"][trajectory["main"]]
    at = [trajectory["positions"][trajectory["frames"].index(frame)] for frame in (first, last)]
    (x0, y0, _), (x1, y1, _) = at
    dx, dy = x1 - x0, y1 - y0
    return [dx, dy] if dx * dx + dy * dy > 0 else [0.0, 1.0]
