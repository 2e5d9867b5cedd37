"""Find the frames whose images do not show the motion: these are *lost*, and the trajectory bridges them.

A frame is lost if its left image is uniform, if left and right are exchanged or not of one time, or if it matches
neither the frame before nor the frame after it while those two match each other. A lost frame has no pose; tracking
goes from the last good frame to the next one (a *bridge*). If those two do not match each other either, the frame is
not to blame (the camera may have jumped): it is kept, and resection decides.

A pair is *unfit* as basic pair if one of its images is uniform, blurred, or a copy of the other image or of the one
before. It may get a pose, but no elevation model is made of it.

The stage is run repeatedly. ``asks`` names the facts that it needs in addition: bridges (motions between frames that
are not neighbours), and frames in which the order of left and right is to be tested. If both lists are empty, the
result is final.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from pydantic import Field

from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.calibration import SwapFacts
from rille.stages.facts.imaging import QualityFacts
from rille.stages.facts.odometry import MotionFacts, ScreeningFacts, StepTableFacts
from rille.stages.imaging.image_faults import blurs, drowned, faint, grey_rows, noise_alone
from rille.stages.imaging.image_quality import MAX_DARK_GREY, MIN_BRIGHT_GREY
from rille.stages.odometry.steps import MIN_MATCHES, Step, steps_of

Steps = Mapping[tuple[int, int], float]
Asks = dict[str, list[Any]]

SIDES = ("left", "right")
GREYS = ((MAX_DARK_GREY, "black"), (MIN_BRIGHT_GREY, "uniform"), (np.inf, "white"))
"""Largest mean grey value of a uniform image, and how it is called."""

SIMULTANEOUS_SHARE = 0.6
"""Share of its matches that fit the rig, of the best share of any frame that was tested, below which left and right of
a frame are not of one time. A best share below it is that of a wrong rig, and tells nothing of the times."""

TURNED_SHARE = 0.95
"""The like once the right camera is turned back, above which it was knocked: moved mounts give 0.97 or more, images of
two times at most 0.9, of a lift straight over ground."""


class FrameScreeningParams(Params):
    """When a frame counts as lost, or as unfit to be basic.

    Attributes
    ----------
    uniform : standard deviation [grey levels] over an image below which the frame counts as blank; image noise has
        about 1.
    blurred : share of the sharpness of the images around below which a pair cannot be a basic pair; a Gaussian blur of
        one pixel costs 0.4.
    jump : change of the displacements between two steps, both in pixels and in multiples of the lower quartile, from
        which on the frames there are tested for images that are swapped or not of one time.
    """

    uniform: float = Field(1.0, ge=0)
    blurred: float = Field(0.6, ge=0, le=1)
    jump: float = Field(4.0, gt=0)


@dataclass
class Judgement:
    """``lost``, ``unfit``: cause by frame. ``late``: lost ones, left and right of which are not of one time.
    ``repeated``: pairs of successive frames with equal images. ``asks``: see the module."""

    lost: dict[int, str] = field(default_factory=dict)
    late: list[int] = field(default_factory=list)
    unfit: dict[int, str] = field(default_factory=dict)
    repeated: list[tuple[int, int]] = field(default_factory=list)
    asks: Asks = field(default_factory=lambda: {"bridges": [], "sides": []})


def judge(
    frames: Sequence[int],
    qualities: Mapping[int, Mapping[str, Any]],
    steps: Steps,
    jumps: Sequence[int],
    sides: Mapping[int, Mapping[str, Any]],
    params: FrameScreeningParams,
) -> Judgement:
    """Decide which frames are lost or unfit by the facts known so far, and which facts are needed in addition.

    Parameters
    ----------
    frames : frame numbers in order.
    qualities : image quality by frame: facts of stage ``image_quality``.
    steps : share of matching pixels by (frame, later frame); 0 if the match shows no motion.
    jumps : frames at which the displacements change abruptly.
    sides : by frame, whether left and right are exchanged: facts of stage ``swap_check``, of the frames tested so far.
    """
    out = Judgement()
    _see(out, frames, qualities, params)
    for f, words in unlike_sides(sides).items():
        out.lost.setdefault(f, words)
        out.late += [] if sides[f]["swapped"] else [f]
    doubted = set(jumps) | _neighbours(frames, out.lost.keys() & sides.keys())
    out.asks["sides"] = [f for f in frames if f in doubted and f not in sides and f not in out.lost]
    chain = [f for f in frames if f not in out.lost]
    out.asks["bridges"] = [s for s in pairwise(chain) if s not in steps]
    if any(out.asks.values()):
        return out
    for i, j in _doubtful_runs([steps[s] >= MIN_MATCHES for s in pairwise(chain)]):
        bridge = chain[i], chain[j]
        if bridge not in steps:
            out.asks["bridges"].append(bridge)
            continue
        for a, f, b in zip(chain[i:j], chain[i + 1 : j], chain[i + 2 :], strict=False):
            if steps[bridge] >= MIN_MATCHES or f in out.unfit:
                shares = f"{steps[a, f]:.0%} of its pixels match the frame before, {steps[f, b]:.0%} the one after"
                out.lost[f] = (
                    f"{out.unfit[f]}, {shares}" if f in out.unfit else f"not found in its neighbours: {shares}"
                )
    _leading(out, [f for f in chain if f not in out.lost])
    return out


def unlike_sides(sides: Mapping[int, Mapping[str, Any]]) -> dict[int, str]:
    """Cause by frame, of those whose left and right do not fit each other; ``sides``: facts of stage ``swap_check``."""
    best = max((facts["as_given"] for facts in sides.values() if "as_given" in facts), default=0.0)
    out = dict[int, str]()
    for f, facts in sides.items():
        fit = facts.get("as_given", best)
        if facts["swapped"]:
            words = "left and right are swapped, or both upside down or mirrored"
            fits = f"{facts['exchanged']:.0%} of its matches fit the rig with the sides exchanged, {fit:.0%} as given"
            out[f] = f"{words} ({fits})"
        elif (
            best > SIMULTANEOUS_SHARE
            and fit < SIMULTANEOUS_SHARE * best
            and facts.get("as_turned", fit) < TURNED_SHARE * best
        ):
            words = f"left and right are not of one time ({fit:.0%} of its matches fit the rig, of other frames"
            out[f] = f"{words} {best:.0%})"
    return out


def _see(
    out: Judgement, frames: Sequence[int], qualities: Mapping[int, Mapping[str, Any]], params: FrameScreeningParams
) -> None:
    """Judge frames by their images alone: uniform, blurred, copied."""
    for side in SIDES:
        looks = [qualities[f][side] for f in frames]
        noisy = [drowned(seen) for seen in looks]
        for f, seen, blur in zip(frames, looks, blurs(looks), strict=True):
            if seen["deviation"] < params.uniform:
                kind = "empty" if seen["mean"] is None else next(word for up, word in GREYS if seen["mean"] <= up)
                words = seen.get("damage") or (
                    f"{kind} {side} image (grey values deviate by {seen['deviation']:.1f} levels)"
                )
                (out.lost if side == "left" else out.unfit).setdefault(f, words)
                continue
            if noise_alone(seen):
                (out.lost if side == "left" else out.unfit).setdefault(f, f"{side} image of noise alone")
                continue
            if drowned(seen) and not all(noisy):
                out.unfit.setdefault(f, f"{side} image drowned in noise, unlike others")
            if blur.share < params.blurred:
                out.unfit.setdefault(f, f"blurred {side} image ({blur.words})")
    digests = {f: [qualities[f][side]["digest"] for side in SIDES] for f in frames}
    for f in frames:
        if digests[f][0] == digests[f][1] and f not in out.lost:
            out.unfit[f] = "left and right are one image"
    for a, b in pairwise(frames):
        same = [side for side, was, now in zip(SIDES, digests[a], digests[b], strict=True) if was == now]
        if a in out.lost or b in out.lost:
            continue
        if "left" in same:
            out.repeated.append((a, b))
        if len(same) == 1:
            out.unfit.setdefault(b, f"its {same[0]} image is that of frame {a}")


def _neighbours(frames: Sequence[int], of: Set[int]) -> set[int]:
    """Frames next to some others."""
    return {n for a, b in pairwise(frames) for f, n in ((a, b), (b, a)) if f in of}


def _doubtful_runs(good: Sequence[bool]) -> list[tuple[int, int]]:
    """Places (i, j) of the frames before and after each run of at least two doubtful steps between good ones."""
    runs = [(fine, list(group)) for fine, group in groupby(range(len(good)), good.__getitem__)]
    return [(steps[0], steps[-1] + 1) for fine, steps in runs if not fine and len(steps) >= 2]


def _leading(out: Judgement, chain: list[int]) -> None:
    """Frames before the first that may be basic are lost; refuse a sequence that has none."""
    fit = next((f for f in chain if f not in out.unfit), None)
    if fit is None:
        first = next(iter((out.unfit | out.lost).items()), (0, "no images"))
        raise DegenerateError(
            "RIL-316",
            f"no pair can be reconstructed from: frame {first[0]}: {first[1]}",
            remedy="look at the images; the limits are those of [frame_screening]",
        )
    for f in chain[: chain.index(fit)]:
        out.lost[f] = f"{out.unfit[f]}, and no good pair before it"


def _jumps(frames: Sequence[int], along: Sequence[Step], params: FrameScreeningParams) -> list[int]:
    """Frames at the abrupt changes of the steps ``along`` the frames."""
    changes = [a.change(b) for a, b in pairwise(along)]
    if not changes:
        return []
    # A quarter is usual: one exchanged frame changes three steps, half of a short sequence. If the motion changes by
    # half of itself throughout, every other frame may be exchanged.
    usual = params.jump * float(np.quantile(changes, 0.25, method="lower"))
    limit = max(params.jump, min(usual, 0.5 * float(np.median([step.displacement or 0.0 for step in along]))))
    found = {n for k, value in enumerate(changes) if value > limit for n in frames[k : k + 3]}
    return [f for f in frames if f in found]


@stage("frame_screening")
def frame_screening_stage(
    params: FrameScreeningParams,
    qualities: Sequence[Bundle[QualityFacts]],
    steps: Sequence[Bundle[StepTableFacts]],
    bridges: Sequence[Bundle[MotionFacts]],
    sides: Sequence[Bundle[SwapFacts]],
    *,
    frames: Sequence[int],
    bridged: Sequence[Sequence[int]] = (),
) -> Bundle[ScreeningFacts]:
    """Which frames are lost, and which may not be basic."""
    along = steps_of(steps)
    seen: dict[int, Mapping[str, Any]] = {f: s.meta for f, s in zip(frames, qualities, strict=True)}
    shares = {s: step.match_rate for s, step in zip(pairwise(frames), along, strict=True)}
    shares |= {(a, b): Step.from_bundle(m).match_rate for (a, b), m in zip(bridged, bridges, strict=True)}
    tested = {s.meta["frame"]: s.meta for s in sides}
    found = judge(list(frames), seen, shares, _jumps(list(frames), along, params), tested, params)
    chain = [f for f in frames if f not in found.lost]
    unfit = {f: why for f, why in found.unfit.items() if f in chain}
    meta: ScreeningFacts = {
        "asks": {"bridges": [list(s) for s in found.asks["bridges"]], "sides": found.asks["sides"]},
        "chain": chain,
        "lost": [{"frame": f, "cause": found.lost[f]} for f in frames if f in found.lost],
        "unfit": [f for f in chain if f in unfit],
        "match_rate": [shares[s] for s in pairwise(frames)],
    }
    if found.late:
        meta["late"] = sorted(found.late)
    if not any(found.asks.values()):
        sound = {side: [seen[f][side] for f in frames if f not in found.lost] for side in SIDES}
        meta["warnings"] = [
            *(f"frame {b} repeats the left image of frame {a}: no motion between them" for a, b in found.repeated),
            *(f"frame {f} is not used as basic pair: {unfit[f]}" for f in chain if f in unfit),
            *grey_rows(sound),
            *faint(sound),
        ]
    return Bundle({}, meta)
