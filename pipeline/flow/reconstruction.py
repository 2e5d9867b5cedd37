"""The dataflow of a reconstruction, top to bottom.

::

    image -> undistort -> pyramid -+-> motion (N, N+1) -+-> step_table -> frame_screening -> keyframes: basic pairs
             (if needed)           |                    +-> track (segment) --+
                                   |                                          |
                                   +-> hfvm (basic pair) -+-> ground_frame ---+-> resect (segment) -> trajectory
                                                          |     |               (landmarks)               |
        given rig --+-> orientation (basic pair) <--------+     |                                         |
                    |       +-> rig -> calibration -------+-----+-> locus (local frame; pyramids)         |
                    |           (pooled; into the frame,  |           +-> risk, path (local)              |
                    |            locus and resect)        +-> locus (world lattice) <- pose (pair) <------+
                    |                                           |     <- moving (pair) <- motion, disparity, resect
                    |                                           +-> tile_index (pair): which world tiles it touches
                    |                                           +-> overlap_qa (pair, earlier ones)
                    |                                           |     +-> overlap_audit; radiometry -+
                    |                                           +-> merge (world tile) <-------------+
                    |                                                 +-> risk, path (mission)
                    +-> crosscheck (window) <- features (image) -> loops (block of pairs) -> loop (pair) -> adjust
                             +-> crosscheck_join -> agreement <- trajectory                     (disparity, rig) |
                                                                                            trajectory <---------+
    lost frames:  image -> image_quality -> frame_screening <- swap_check (left against right; where it asks)
    other times:  rig -> synchrony (features of right images nearby) -> keyframes, chosen anew
    wrong camera: resect -> intrinsics -> given rig: all that reads it is laid out anew
    pose of an adjusted trajectory: pose (pair) <- trajectory as chained, local DEM
    leaves:  accuracy (trajectory, crosscheck), position_accuracy, disparity_accuracy, dem_accuracy, path_check
    outputs: rasters, tracks, tables, figures: a task each; then report.html and report.json around them

A *basic pair* is a stereo pair that is matched and gets an elevation model; a *segment* is the run of left images from
one basic pair to the next. A *lost* frame has no usable image (black, of another scene, left and right exchanged):
``frame_screening`` finds it by ``image_quality``, by motions, by bridges (motions over it), and by ``swap_check``.
``synchrony`` compares pairs whose rows the rig does not explain with right images of other times; pairs of two times
are not basic, and ``keyframes`` chooses anew. ``resect`` compares each basic pair with the one before: from a knock of
the rig on, ``knocked`` gives the rig that it left.

The landmarks of a segment are relative to its own basic pair, so all segments are resected in parallel, and
``trajectory`` chains them. ``intrinsics`` estimates errors of the calibration from all segments; if it corrects the
cameras, all tasks that depend on them are laid out anew. ``adjust`` fits all poses to loops and to other sensors (dead
reckoning, GNSS, attitude). Locus then runs a second time, directly on the shared world lattice, so nothing is
resampled. With ``locus.both`` it reads the disparities of both images (``hfvm/back``). ``reconstruction`` is a
generator: it yields tasks and goes on with their results, because these decide which pairs are basic and how far the
world reaches. Which frames and pairs are used is in ``selection``, the merged world in ``world``; inputs of single
stages are in ``builders``, the leaves in ``assessment``; outputs are added last, by
:mod:`rille.pipeline.runs.run_files`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Generator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from rille.datasets.protocol import CAMERAS
from rille.pipeline.engine.graph import Complete, Handle, Maybe, Wait, done
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.flow import assessment
from rille.pipeline.flow.assessment import Flow
from rille.pipeline.flow.builders import BasicPair, Builder, Pair, Segment, other_plane
from rille.pipeline.flow.selection import MISFIT, Choice, confirmed, screened, simultaneous, suspects
from rille.pipeline.flow.world import merged_world
from rille.stages.calibration.calibration import calibration_stage
from rille.stages.calibration.knocked import knocked_stage
from rille.stages.core.errors import InputError
from rille.stages.evaluation.crosscheck import crosscheck_stage, windows
from rille.stages.evaluation.crosscheck_join import crosscheck_join_stage
from rille.stages.facts.calibration import CalibrationFacts, RigFacts
from rille.stages.facts.evaluation import JoinFacts
from rille.stages.facts.odometry import (
    IntrinsicsFacts,
    KeyframesFacts,
    LoopFacts,
    MovingFacts,
    PlacesFacts,
    ResectFacts,
    ScreeningFacts,
)
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.odometry.loops import loops_stage
from rille.stages.odometry.resection.adjust import adjust_stage
from rille.stages.odometry.resection.intrinsics import intrinsics_stage
from rille.stages.odometry.resection.loop import loop_stage
from rille.stages.odometry.resection.moving import moving_stage
from rille.stages.odometry.resection.resect import MIN_JUMP_PX
from rille.stages.odometry.resection.trajectory import trajectory_stage
from rille.stages.planning.path import path_stage

MAX_CALIBRATIONS = 6
"""Corrections of the calibration: one to three are usual for a focal length that is 10 % off, two for a yaw that is
half a degree off."""


def reconstruction(make: Builder, frames: tuple[int, ...]) -> Flow:
    """Lay out the reconstruction of the chosen frames, in order.

    Raises
    ------
    InputError
        No chosen frame has both images.
    DegenerateError
        No elevation model has a cell in the world.
    """
    p = make.products
    whole = [f for f in frames if f not in make.sequence.lost]
    if not whole:
        raise InputError("RIL-050", "no chosen frame has both images", remedy="choose others with --frames")

    # Images, motions, and the first pair, which is basic unless it is lost: its matching need not wait for the choice.
    for frame in whole:
        make.pyramid(frame, "left")
    for a, b in pairwise(whole):
        make.motion(a, b)
    make.orientation(whole[0])
    if make.config.crosscheck.enabled and len(whole) > 1:
        # What is laid out first runs first: its windows take longest of all tasks.
        p.crosscheck = crosscheck_tasks(make, whole)
    # Features also tell places that are seen again; where the crosscheck is wanted, it has them all.
    yield Complete(("crosscheck", "crosscheck_join", *(("features",) if make.config.crosscheck.enabled else ())))

    # Frames that the trajectory goes through, and which of them are basic pairs.
    screening = yield from screened(make, whole)
    yield Complete(("image_quality", "frame_screening"))
    fitting = yield from tracked(make, frames, whole, screening)
    if fitting is None:
        return
    chosen, matched, segments = fitting.choice.keyframes, fitting.matched, fitting.segments
    first = matched[fitting.choice.basic[0]]

    # At each basic pair, the rover's stop: local elevation model, hazards and path. In between: the segments' product.
    pairs = local_models(make, [pair for k, pair in matched.items() if k not in fitting.moved], first)
    yield Complete(("hfvm", "disparity_accuracy"))
    missing = [{"frame": f, "cause": why} for f, why in make.sequence.lost.items() if f in frames]
    p.trajectory = make.node(
        trajectory_stage,
        "trajectory",
        segments=p.resections,
        levels=[matched[s.frames[0]].level for s in segments] or [first.level],
        intrinsics=p.intrinsics,
        frames=list(frames),
        steps=step_measures(make, chosen),
        lost=sorted([*missing, *fitting.choice.lost], key=lambda item: item["frame"]) or None,
    )
    yield from adjusted(make, frames, list(pairs.values()))
    assessment.of_trajectory(make, frames)
    yield Complete(("track", "resect", "intrinsics", "trajectory", "features", "loops", "loop", "adjust"))
    yield Complete(("agreement", "position_accuracy", "accuracy"))
    posed = yield from done(p.trajectory)
    p.moving = moving_parts(make, segments, matched) if make.config.moving.enabled else {}
    yield from merged_world(make, frames, pairs, posed)


@dataclass(frozen=True)
class Tracked:
    """Basic pairs that fit each other, with their disparities (``matched``) and the tracks from each to the next.

    ``moved``: pairs after a knock of the rig that is not followed.
    """

    choice: Choice
    matched: dict[int, BasicPair]
    segments: list[Segment]
    moved: Collection[int]


@dataclass(frozen=True)
class Learnt:
    """What attempts have shown: frames that are ``refused`` or ``torn`` (None: not looked for yet), with the cause;
    ``knocks`` of the rig, by pair; ``shaken``: the segments that show knocks that no turn of the camera explains, so
    that each pair has a rig of its own; ``corrections`` of the calibration, of which the last one counts."""

    refused: Mapping[int, str] = field(default_factory=dict)
    torn: dict[int, str] | None = None
    knocks: Mapping[int, ResectFacts] = field(default_factory=dict)
    shaken: tuple[Handle[ResectFacts], ...] = ()
    corrections: tuple[list[float], ...] = ()


def tracked(
    make: Builder, frames: Series[int], whole: list[int], screening: Ref[ScreeningFacts]
) -> Generator[Wait, Any, Tracked | None]:
    """Match the basic pairs and track between them, again as long as that shows what to do otherwise; None where
    nothing can be measured."""
    learnt, since = Learnt(), len(make.graph.nodes)
    while True:
        found = yield from attempted(make, frames, whole, screening, learnt)
        if not isinstance(found, Learnt):
            return found
        if found.corrections != learnt.corrections:
            make.recalibrate(found.corrections[-1])
        make.discard(since)
        learnt = found


def attempted(
    make: Builder, frames: Series[int], whole: list[int], screening: Ref[ScreeningFacts], learnt: Learnt
) -> Generator[Wait, Any, Tracked | Learnt | None]:
    """One attempt at :func:`tracked` by what earlier ones have ``learnt``. It ends early, with what is learnt then, at
    images that the tracks contradict, a knock of the rig, or a wrong calibration."""
    p = make.products
    if learnt.corrections and p.crosscheck is not None:
        p.crosscheck = crosscheck_tasks(make, whole)
    mode = "per_pair" if learnt.shaken else make.config.rig.mode
    choice = yield from simultaneous(make, frames, whole, screening, {**learnt.refused, **(learnt.torn or {})}, mode)
    if choice is None:
        return None
    p.contradictions += learnt.shaken
    yield Complete(("swap_check", "keyframes", "synchrony", "rig", "calibration"))
    matched = yield from matched_pairs(make, after_knocks(make, choice.rigs, learnt.knocks))
    # Of most pairs a wrong rig is the cause, of few their images.
    impossible = [k for k, level in p.ground.items() if level.error is not None]
    if 0 < 2 * len(impossible) < len(matched):
        return replace(learnt, refused={**learnt.refused, **dict.fromkeys(impossible, MISFIT)})

    # From each basic pair to the next: tracks, and poses in its frame. ``segments`` holds places in the chain.
    runs = [[choice.chain[i] for i in part] for part in choice.keyframes.meta["segments"]]
    segments = [make.segment(run, matched[run[0]], after=matched.get(run[-1])) for run in runs]
    moved = yield from behind_knocks(make, matched, segments)
    # A knock leaves another rig than the one given.
    sound = [s for s in segments if s.frames[0] not in moved]
    torn = suspects(sound, choice.chain) if learnt.torn is None else confirmed(sound, choice.chain, learnt.torn)
    if torn != (learnt.torn or {}):
        return replace(learnt, torn=torn)

    key = matched[choice.basic[0]]
    judged = sound and make.config.resect.joint
    correction = (yield from corrected_calibration(make, key, [s.resection for s in sound])) if judged else None
    if correction is not None and len(learnt.corrections) < MAX_CALIBRATIONS:
        # A wrong rig may look as if it was knocked.
        return replace(learnt, knocks={}, corrections=(*learnt.corrections, correction["corrected"]))
    first = next(iter(moved), None)
    if correction is None and first is not None and make.config.rig.mode != "fixed":
        # More than four knocks, or one that rows show, are those of a rig that shakes.
        if first not in learnt.knocks and len(learnt.knocks) < 4:
            return replace(learnt, knocks={**learnt.knocks, first: moved[first]})
        if mode == "pooled":
            shaken = tuple(s.resection for s in segments if s.resection in p.contradictions)
            return replace(learnt, knocks={}, shaken=shaken)
    if p.intrinsics is not None:
        p.contradictions.append(p.intrinsics)
    segments = refused_behind(make, matched, segments, moved)
    p.resections = [s.resection for s in segments]
    return Tracked(choice, matched, segments, moved.keys())


def matched_pairs(
    make: Builder, rigs: dict[int, Handle[CalibrationFacts]]
) -> Generator[Wait, Any, dict[int, BasicPair]]:
    """Disparities of stereo pairs, each with its rig, vertical and reference plane."""
    p = make.products
    verticals = {k: vertical(make, k) for k in rigs}
    p.ground = p.level = {k: make.level(k, verticals[k], known) for k, known in rigs.items()}
    p.disparity, p.orientations = {k: make.disparity(k) for k in rigs}, {k: make.orientation(k) for k in rigs}
    yield Complete(("undistort", "pyramid", "orientation", *(() if make.config.locus.both else ("hfvm",))))
    judged = yield Maybe(list(p.level.values()))
    placed = make.sequence.georeference is not None
    plane = other_plane(make.config, [level.meta for level in judged if level is not None], placed=placed)
    if plane is not None:
        p.level = {k: make.level(k, verticals[k], known, plane) for k, known in rigs.items()}
    yield Complete(("ground_frame",))
    return {k: BasicPair(k, p.disparity[k], known, p.level[k]) for k, known in rigs.items()}


def local_models(make: Builder, matched: list[BasicPair], first: BasicPair) -> dict[int, Pair]:
    """Local elevation models of stereo pairs on the lattice of the ``first``; on ground also risk maps and paths."""
    p, pairs = make.products, dict[int, Pair]()
    for one in matched:
        k = one.frame
        pair = pairs[k] = make.pair(k, one.level, one.rig, first)
        if "reference" not in one.level.spec.args:
            p.local_risk[k] = make.hazards(f"risk/local/{k}", [pair.dem], use="local")
            p.local_path[k] = make.node(path_stage, f"path/local/{k}", risk=p.local_risk[k], use="local")
        make.graph.flow(assessment.of_pair(make, pair))
    return pairs


def vertical(make: Builder, pair: int) -> dict[str, Any]:
    """The facts about the vertical of a pair (attitude, pitch) as arguments of a stage, None where not known."""
    up = make.sequence.up and make.sequence.up[pair]
    return {"up": up and list(up), "pitch": make.sequence.pitch}


def after_knocks(
    make: Builder, rigs: Mapping[int, Handle[CalibrationFacts]], knocks: Mapping[int, ResectFacts]
) -> dict[int, Handle[CalibrationFacts]]:
    """The rigs of stereo pairs; from the pair of each of the ``knocks`` on, the rig that it left."""
    p, out = make.products, dict(rigs)
    for at, said in knocks.items():
        turned = dict[int, tuple[Handle[RigFacts], Handle[CalibrationFacts]]]()
        for k in (k for k in out if k >= at):
            rig = p.rigs[k]
            if rig.index not in turned:
                what = {"jump": said["jump"], "cause": said["knocked"]}
                known = make.node(knocked_stage, f"knocked/{at}/{k}", rig=rig, **what)
                turned[rig.index] = known, make.node(calibration_stage, f"calibration/knocked/{at}/{k}", rig=known)
            p.rigs[k], out[k] = turned[rig.index]
    return out


def behind_knocks(
    make: Builder, pairs: Mapping[int, BasicPair], segments: list[Segment]
) -> Generator[Wait, Any, dict[int, ResectFacts]]:
    """Basic pairs after a knock of the rig, in order, each with the facts of the segment that shows the last knock.

    The rig was knocked if a basic pair measures other disparities than the first pair, which stands for the
    calibration made before the drive.
    """
    moved, by, last = dict[int, ResectFacts](), np.zeros(2), None
    judged = yield Maybe([s.resection for s in segments])
    for s, one in zip(segments, judged, strict=True):
        if one is not None and "jump" in one.meta:
            by, last = by + one.meta["jump"], one.meta
            make.products.contradictions.append(s.resection)
        if last is not None and s.frames[-1] in pairs and np.linalg.norm(by) > MIN_JUMP_PX:
            moved[s.frames[-1]] = last
    return moved


def refused_behind(
    make: Builder, pairs: Mapping[int, BasicPair], segments: list[Segment], moved: Mapping[int, ResectFacts]
) -> list[Segment]:
    """All segments; those after a knock (``moved``) that is not followed give no pose."""

    def refused(k: int, frames: Series[int]) -> Segment:
        return make.segment(frames, pairs[k], f"{k}/refused", refused=moved[k]["knocked"])

    return [refused(s.frames[0], s.frames) if s.frames[0] in moved else s for s in segments]


def step_measures(make: Builder, chosen: Ref[KeyframesFacts]) -> list[list[float | None]]:
    """Return, for each step to the next frame, the displacement as an angle (radians; None: not known) and the share of
    matching pixels."""
    lengths, focal = chosen.meta["displacement"], make.sequence.rig.left.fx
    angles = [None if length is None else round(math.atan(length / focal), 4) for length in lengths]
    return [[angle, share] for angle, share in zip(angles, chosen.meta["match_rate"], strict=True)]


def sensors(make: Builder, frames: Series[int]) -> dict[str, Any]:
    """Measurements of other sensors at the chosen frames, with their accuracy; empty if there are none."""
    s = make.sequence
    if not s.priors:
        return {}
    said: dict[str, Any] = {name: dict(fact) for name, fact in s.priors.items()}
    rows = {"odometry": ("poses", s.odometry), "attitude": ("rotations", s.attitude), "up": ("directions", s.up)}
    for name, (key, known) in rows.items():
        if known is None:
            said.pop(name, None)
        elif name in said:
            one = [known[f] for f in frames]
            said[name][key] = [v.to_list() if isinstance(v, RigidTransform) else v for v in one]
    times = list(frames) if s.times is None else [s.times[f] for f in frames]
    place = None if s.georeference is None else {"origin": s.georeference.origin, "azimuth": s.georeference.azimuth}
    return {**said, "times": times, "timed": s.times is not None, "georeference": place}


def adjusted(make: Builder, frames: Series[int], pairs: list[Pair]) -> Flow:
    """Adjust the trajectory to loop closures and to other sensors, if there are any."""
    p, known = make.products, sensors(make, frames)
    p.loops = yield from loop_closures(make, pairs)
    if not p.resections or not (known or p.loops):
        return
    p.chained = p.trajectory
    p.trajectory = make.node(
        adjust_stage,
        "trajectory/adjusted",
        trajectory=p.chained,
        segments=p.resections,
        loops=p.loops or None,
        intrinsics=p.intrinsics,
        priors=known or None,
    )


def moving_parts(
    make: Builder, segments: list[Segment], pairs: Mapping[int, BasicPair]
) -> dict[int, Handle[MovingFacts]]:
    """Moving objects in each basic pair, by the motion to the next frame; in the last pair, from the one before."""
    out = dict[int, Handle[MovingFacts]]()
    steps = [(s, s.frames[:2], False) for s in segments] + [(s, s.frames[-2:], True) for s in segments[-1:]]
    for segment, step, back in steps:
        key = pairs.get(step[-1 if back else 0])
        if len(step) == 2 and key is not None:
            out[key.frame] = make.node(
                moving_stage,
                f"moving/{key.frame}",
                disparity=key.disparity,
                rig=key.rig,
                motion=make.motion(*step),
                segment=segment.resection,
                pyramids=[make.pyramid(frame, "left") for frame in step],
                back=back,
            )
    return out


def corrected_calibration(
    make: Builder, key: BasicPair, segments: list[Handle[ResectFacts]]
) -> Generator[Wait, Any, IntrinsicsFacts | None]:
    """Correction of the calibration that all segments agree on, None if they need none; ``key`` gives the rig."""
    p = make.products
    fixed = make.config.rig.mode == "fixed"
    asked = {"given": make.given_rig, "before": make.correction, "fixed": fixed or None}
    p.intrinsics = make.node(intrinsics_stage, "intrinsics", segments=segments, rig=key.rig, **asked)
    judged: list[Ref[IntrinsicsFacts] | None] = yield Maybe([p.intrinsics])
    facts: Any = None if judged[0] is None else judged[0].meta
    # A plan takes the facts of earlier runs, which may be those of an earlier release.
    return facts if facts and "corrected" in facts and any(facts["correction"]) else None


def loop_closures(make: Builder, pairs: Series[Pair]) -> Generator[Wait, Any, list[Handle[LoopFacts]]]:
    """Loop closures: motions to basic pairs from earlier ones that show the same place."""
    if not make.config.loops.enabled or len(pairs) <= make.config.loops.apart:
        return []
    of, blocks = {pair.frame: pair for pair in pairs}, list[Handle[PlacesFacts]]()
    # Blocks of 500 frame numbers, each read by all later ones: if a pair is left out, the other blocks keep theirs.
    for number, group in groupby(of, lambda frame: frame // 500):
        here = list(group)
        features = [make.features(frame, "left") for frame in here]
        blocks.append(make.node(loops_stage, f"loops/{number}", features=features, earlier=list(blocks), pairs=here))
    laid: list[Ref[PlacesFacts]] = yield list(blocks)
    compared = [
        loop_closure(make, [of[k] for k in (frame, *earlier)])
        for block in laid
        for frame, earlier in zip(block.meta["pairs"], block.meta["candidates"], strict=True)
        if earlier
    ]
    seen = yield Maybe(compared)
    known = [one for one, ref in zip(compared, seen, strict=True) if ref is not None]
    return known if any(ref is not None and ref.meta["factors"] for ref in seen) else []


def loop_closure(make: Builder, pairs: list[Pair]) -> Handle[LoopFacts]:
    """Motions to the first of some pairs that look alike from each of the others."""
    frames = [pair.frame for pair in pairs]
    return make.node(
        loop_stage,
        f"loop/{frames[0]}",
        features=[make.features(frame, "left") for frame in frames],
        disparities=[pair.disparity for pair in pairs],
        rigs=[pair.rig for pair in pairs],
        pairs=frames,
    )


def crosscheck_tasks(make: Builder, whole: list[int]) -> Handle[JoinFacts]:
    """Trajectory by another program's structure from motion, in windows; independent of Rille's."""
    features = {(f, camera): make.features(f, camera) for f in whole for camera in CAMERAS}
    parts = [
        make.node(
            crosscheck_stage,
            f"crosscheck/{window[0]}-{window[-1]}",
            frames=window,
            rig=make.given_rig,
            left=[features[f, "left"] for f in window],
            right=[features[f, "right"] for f in window],
        )
        for window in windows(whole, make.config.crosscheck)
    ]
    make.products.crosschecks = parts
    return make.node(crosscheck_join_stage, "crosscheck_join", windows=parts, frames=whole)
