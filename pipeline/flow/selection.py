"""Which frames the trajectory goes through, and which of them are basic pairs.

A frame is lost by its images alone (``frame_screening``), by a rig that does not fit its neighbours' (:data:`MISFIT`),
or by tracks that show two motions (:data:`TORN`). Images of two times (``synchrony``) make no basic pair.
"""

from __future__ import annotations

from collections.abc import Generator
from collections.abc import Sequence as Series
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any

from rille.pipeline.engine.graph import Complete, Handle, Wait, done
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.flow.builders import Builder, Segment
from rille.stages.facts.calibration import CalibrationFacts, RigFacts, SynchronyFacts
from rille.stages.facts.odometry import KeyframesFacts, ResectFacts, ScreeningFacts, StepTableFacts
from rille.stages.odometry.frame_screening import frame_screening_stage
from rille.stages.odometry.keyframes import keyframes_stage
from rille.stages.odometry.steps import step_table_stage

MISFIT = (
    "its left and right do not fit each other as those of its neighbours do: one of them is damaged, or of another time"
)
"""Cause of a lost frame: its rig differs from that of its neighbours."""

TORN = "it shows two motions, and without it the frames beside it show one: its images are torn, or something passed by"
"""Cause of a lost frame: its landmarks show two motions."""


def screened(make: Builder, whole: list[int], timed: bool = False) -> Generator[Wait, Any, Ref[ScreeningFacts]]:
    """Determine the lost frames; add the motions and swap checks that the screening asks for until it asks for none.

    ``timed``: compare left and right of all frames, not only of those that it asks for.
    """
    qualities = [make.quality(frame) for frame in whole]
    along = step_tables(make, whole)
    bridges: dict[tuple[int, int], Handle] = {}
    sides = {frame: make.swap_check(frame) for frame in whole} if timed else dict[int, Handle]()
    which, attempt = "/timed" if timed else "", 0
    while True:
        asked = make.node(
            frame_screening_stage,
            f"frame_screening{which}/{attempt}" if attempt else f"frame_screening{which}",
            frames=whole,
            bridged=list(bridges) or None,
            qualities=qualities,
            steps=along,
            bridges=list(bridges.values()),
            sides=list(sides.values()),
        )
        found = yield from done(asked)
        asks = found.meta["asks"]
        if not any(asks.values()):
            make.products.screening = asked
            return found
        bridges |= {(a, b): make.motion(a, b) for a, b in asks["bridges"]}
        sides |= {frame: make.swap_check(frame) for frame in asks["sides"]}
        attempt += 1


def step_tables(make: Builder, frames: list[int]) -> list[Handle[StepTableFacts]]:
    """Tables of the motions along some frames, cut by frame numbers: if a frame is left out, the other tables stay."""
    made: dict[tuple[int, ...], list[Handle[StepTableFacts]]] = make.made.setdefault("steps", {})
    if tuple(frames) not in made:
        taken = "step_table/bridged" if made else "step_table"
        parts = [list(part) for _, part in groupby(pairwise(frames), lambda step: step[0] // 100)]
        made[tuple(frames)] = [
            make.node(step_table_stage, f"{taken}/{part[0][0]}", motions=[make.motion(*step) for step in part])
            for part in parts
        ]
    return made[tuple(frames)]


@dataclass(frozen=True)
class Choice:
    """Basic pairs of a ``chain`` of frames: the rig of each, and the facts of these rigs.

    ``lost``: frames (frame and cause); ``suspects``: pairs whose rows the rig does not explain; ``which``: end of the
    labels of its tasks.
    """

    which: str
    chain: list[int]
    lost: list[dict[str, Any]]
    keyframes: Ref[KeyframesFacts]
    rigs: dict[int, Handle[CalibrationFacts]]
    judged: list[Ref[RigFacts]]
    suspects: list[int]

    @property
    def basic(self) -> list[int]:
        """Basic pairs, in order."""
        return list(self.rigs)


def simultaneous(
    make: Builder, frames: Series[int], whole: list[int], found: Ref[ScreeningFacts], odd: dict[int, str], mode: str
) -> Generator[Wait, Any, Choice | None]:
    """Choose basic pairs with rigs by ``mode``; leave out those whose rigs or images contradict the others, and repeat.

    Frames are lost that the screening ``found``, that are ``odd`` (cause by frame), and whose left and right images do
    not fit each other though those of their neighbours do. If some pairs are of two times, all frames are screened
    again. None if the images of most pairs contradict the rig, or each other.
    """
    p, wrong = make.products, set[int]()
    row, timed = {frame: k for k, frame in enumerate(frames)}, False
    while True:
        chain = [f for f in found.meta["chain"] if f not in odd]
        lost = [*found.meta["lost"], *({"frame": f, "cause": odd[f]} for f in sorted(odd))]
        behind = [k for k, (a, b) in enumerate(pairwise(chain), 1) if row[b] > row[a] + 1]
        late = found.meta.get("late", [])
        if late and not p.contradictions:
            p.contradictions.append(synchrony_of_late(make, late, whole))
        choice = yield from basic_pairs(make, chain, lost, {*wrong, *found.meta["unfit"]}, behind, mode)
        if choice.suspects:
            # Suspect pairs, 12 at most, are compared with right images of other times.
            p.contradictions.append(make.synchrony(f"synchrony{choice.which}", spread(choice.suspects, 12), chain))
            apart: Ref[SynchronyFacts] = yield p.contradictions[-1]
            partners = apart.meta["partners"]
            if partners and not timed:
                # All frames, not basic pairs alone: after a lost image no pair is of one time.
                timed = True
                again = yield from screened(make, whole, timed)
                if again.meta["lost"] != found.meta["lost"]:
                    make.graph.outdated |= {one.index for one in (*p.contradictions, *p.rigs.values())}
                    found = again
                    p.contradictions.clear()
                    continue
            contradicted = any("contradiction" in one.meta for one in (apart, *choice.judged))
            if contradicted and 2 * len(choice.suspects) > len(choice.basic):
                # Images of two times show no rig: the change between them is not that of a camera that moved in it.
                p.rigs = {} if partners else p.rigs
                if late and partners:
                    p.contradictions[:] = [synchrony_of_late(make, sorted({*late, *(k for k, _ in partners)}), whole)]
                return None
            if partners:
                wrong |= {pair for pair, _ in partners}
                continue
        # A rig that images of two times bend judges no pair.
        alone = set[int]() if late else misfits(choice, mode)
        if alone:
            make.graph.outdated |= {one.index for one in p.rigs.values()}
            odd |= {pair: _misfit(make, pair) for pair in alone}
        elif any("knocked" in one.meta for one in choice.judged):
            p.contradictions.append(p.rigs[choice.basic[0]])
            # One calibration does not describe this rig: each pair has its own.
            mode = "per_pair"
        else:
            return choice


def basic_pairs(
    make: Builder, chain: list[int], lost: list[dict[str, Any]], unfit: set[int], behind: list[int], mode: str
) -> Generator[Wait, Any, Choice]:
    """Choose basic pairs of a ``chain`` of frames, and estimate their rigs: one for all pairs, or one each (``mode``).

    No ``unfit`` frame is basic; ``behind``: places in the chain after a frame that has no pose.
    """
    p = make.products
    # Each contradiction leads to another choice.
    which = f"/{len(p.contradictions)}" if p.contradictions else ""
    p.keyframes = make.node(
        keyframes_stage,
        f"keyframes{which}",
        steps=step_tables(make, chain),
        frames=len(chain),
        unfit=[k for k, f in enumerate(chain) if f in unfit] or None,
        behind=behind or None,
    )
    yield Complete(("motion", "step_table"))
    chosen = yield from done(p.keyframes)
    basic = [chain[i] for i in chosen.meta["basic"]]
    pooled = mode != "per_pair" and make.rig(representative(basic), which)
    rigs = {k: pooled or make.rig([k], f"/{k}{which}") for k in basic}
    p.rigs, known = {k: one[0] for k, one in rigs.items()}, {k: one[1] for k, one in rigs.items()}
    judged: list[Ref[RigFacts]] = yield list(dict.fromkeys(p.rigs.values()))
    suspects = [pair for one in judged for pair in one.meta.get("suspects", ())]
    return Choice(which, chain, lost, chosen, known, judged, suspects)


def misfits(choice: Choice, mode: str) -> set[int]:
    """Pairs that do not fit the rig though their neighbours do; none if many do not: these bend the rig itself."""
    basic, facts = choice.basic, [rig.meta.get("per_pair", ()) for rig in choice.judged]
    fitting = {one["pair"] for pairs in facts for one in pairs}.difference(choice.suspects)
    bad = set(basic if mode == "per_pair" else representative(basic)) - fitting
    # If the rig had moved, the next pair would not fit, either.
    alone = {b for a, b, c in zip(basic, basic[1:], basic[2:], strict=False) if bad & {a, b, c} == {b}}
    return alone if 4 * len(bad) <= len(basic) else set()


def _misfit(make: Builder, pair: int) -> str:
    """Why a pair does not fit: the damage of its map by another program, or its images."""
    given = make.given_disparity(pair)
    return MISFIT if given is None or given.ref is None else given.ref.meta.get("damage", MISFIT)


def synchrony_of_late(make: Builder, late: list[int], whole: list[int]) -> Handle[SynchronyFacts]:
    """Compare late pairs with right images of other times: the first six, which show where the delay begins, and six
    over the sequence, which show how long it is."""
    shown = list(dict.fromkeys([*late[:6], *spread(late, 6)]))
    return make.synchrony(f"synchrony/lost/{len(late)}", shown, whole)


def suspects(segments: list[Segment], chain: list[int]) -> dict[int, str]:
    """Frames to try without, each with the cause.

    ``MISFIT``: a pair part of whose disparities departs from those of its landmarks; none if many pairs do, as with bad
    matches. ``TORN``: the first of the frames whose landmarks show two motions, or the one before it if many landmarks
    were lost there; and a basic pair that many landmarks contradict in its own segment and in the one before.
    """
    metas = resected(segments)
    parts = [meta["per_frame"] for meta in metas if meta.get("per_frame")]
    odd = {meta["per_frame"][-1]["frame"] for meta in metas if "torn" in meta}
    if 4 * len(odd) > len(parts) + 1:
        odd.clear()
    parts = [part for part in parts if part[0]["frame"] not in odd]
    behind_key = [one for part in parts for one in part[1:]]
    doubted = {one["frame"] for one in behind_key if "contradiction" in one}
    # 0.5: of the landmarks that the frame before shows.
    thin = {one["frame"] for part in parts for was, one in pairwise(part) if one["inliers"] < 0.5 * was["inliers"]}
    first = [(a, b) for a, b, _ in zip(chain, chain[1:], chain[2:], strict=False) if b in doubted and a not in doubted]
    # 0.7: of the landmarks that were found: in sound images 0.9 agree, by night 0.7.
    split = {one["frame"] for one in behind_key if one["inliers"] < 0.7 * one["landmarks"]}
    pairs = [part[0]["frame"] for part in parts if {one["frame"] for one in part[:2]} <= split]
    return dict.fromkeys([*(a if a in thin else b for a, b in first), *pairs], TORN) | dict.fromkeys(odd, MISFIT)


def confirmed(segments: list[Segment], chain: list[int], tried: dict[int, str]) -> dict[int, str]:
    """Those of the suspect frames (``tried`` without) that stay out.

    An object that moves by itself causes two motions as well. So a frame stays out only if without it nearly all
    landmarks of the next frame have one motion.
    """
    facts = {one["frame"]: one for meta in resected(segments) for one in meta.get("per_frame", [])[1:]}
    behind = {frame: facts.get(next((f for f in chain if f > frame), frame), {"lost": ""}) for frame in tried}
    # 0.8: of its landmarks.
    one_motion = {f for f, one in behind.items() if "lost" not in one and one["inliers"] >= 0.8 * one["landmarks"]}
    return {f: why for f, why in tried.items() if why == MISFIT or f in one_motion}


def resected(segments: list[Segment]) -> list[ResectFacts]:
    """Facts of the resected segments; a plan may have none."""
    return [s.resection.ref.meta for s in segments if s.resection.ref is not None]


def representative(basic: list[int]) -> list[int]:
    """Pairs that the common rig is estimated from: 200 at most, beyond which its errors are systematic."""
    return spread(basic, 200)


def spread(items: list[Any], most: int) -> list[Any]:
    """At most ``most`` of the items, evenly spaced, beginning with the first."""
    # Minus twice: rounds the stride up, so that no more than `most` remain.
    return items[:: -(-len(items) // most) or 1]
