"""Choice of the basic pairs: which stereo pairs become elevation models (paper, sections 7.2 and 7.4).

Successive basic pairs bound a *segment*: the left images from one to the next are tracked and resected against the
elevation model of the first. Positions behind the last basic pair are an open last segment.

The paper takes every fourth pair of a camera that moves evenly. Here the next basic pair is the last one whose image
still shows the wanted share of what the one before shows (:mod:`rille.stages.odometry.steps`): poses are not
known yet, the coarse displacements are. A camera that rests needs no new elevation model, one that turns needs them
often.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal

from pydantic import Field, model_validator

from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import ConfigError, InputError
from rille.stages.facts.odometry import KeyframesFacts
from rille.stages.odometry.steps import Covisibility, Step, steps_of

LEAST_BLOCKS = 12
"""Least number of blocks with a displacement from which the overlap of two images is estimated."""

MIN_MATCHES = 0.2
"""Share of the textured pixels that must find a displacement; below, both frames become basic pairs (rule stride: the
later one)."""

LITTLE = 0.4
"""Overlap below which a stride, which asks for none, is warned of: most landmarks of a segment leave the image."""

NAVIGATION: Mapping[str, Any] = {"rule": "overlap", "overlap": 0.6}
"""What preset ``navigation`` sets; a value given by the user wins."""


class KeyframesParams(Params):
    """Parameters of the choice of basic pairs."""

    preset: Literal["terrain", "navigation"] = Field(
        "terrain",
        description="terrain: close basic pairs, whose elevation models overlap; navigation: trajectory only, with "
        "rule overlap at 0.6, hfvm.preset fast, and cheaper motion.level, track.points and "
        "orientation.samples; keys set explicitly win, except keyframes.stride without keyframes.rule",
    )
    rule: Literal["overlap", "stride"] = Field(
        "overlap",
        description="overlap: basic pairs as far apart as keyframes.overlap permits; stride: every stride-th frame, as "
        "in the paper",
    )
    overlap: float = Field(
        0.7,
        gt=0,
        lt=1,
        description="share of a basic pair's view that the next basic pair must see too (rule overlap); with less, "
        "landmarks and common terrain run out",
    )
    stride: int = Field(
        4,
        ge=1,
        description="frames between basic pairs (rule stride; 4 in the paper, section 7.4); setting it without "
        "keyframes.rule selects rule stride",
    )
    max_gap: int = Field(
        16,
        ge=1,
        description="largest number of frames between basic pairs under rule overlap; light and shadows change",
    )

    @model_validator(mode="before")
    @classmethod
    def _rule(cls, values: Any) -> Any:
        """Preset navigation sets its rule, to which a mere stride changes nothing; else a mere stride sets its own."""
        if isinstance(values, Mapping) and values.get("preset") == "navigation":
            return {**NAVIGATION, **values}
        if isinstance(values, Mapping) and "stride" in values:
            return {"rule": "stride", **values}
        return values


@dataclass(frozen=True)
class Marked:
    """Positions that the choice must respect, whatever the steps show.

    ``unfit`` may not be basic; ``behind`` a gap of lost frames are: if the bridge over the gap is refused, what follows
    is posed as a piece of its own.
    """

    unfit: frozenset[int] = frozenset()
    behind: frozenset[int] = frozenset()

    @classmethod
    def of(cls, frames: int, unfit: Sequence[int], behind: Sequence[int]) -> Marked:
        """Build for a number of frames; after a gap the first position that is not unfit is basic."""
        fit = [k for k in range(frames) if k not in unfit]
        return cls(frozenset(unfit), frozenset(n for k in behind for n in [n for n in fit if n >= k][:1]))


UNMARKED = Marked()


def by_stride(steps: Sequence[Step], params: KeyframesParams, marked: Marked = UNMARKED) -> dict[int, str]:
    """Positions 0, stride, 2 stride ... of one more frame than there are steps, and why; for an unfit one the next.

    A frame after a step with too few matches is basic, too: the frames that follow then get poses, in a piece of their
    own.
    """
    count = len(steps) + 1
    broken = [k + 1 for k, step in enumerate(steps) if doubtful(step)]
    wanted = dict.fromkeys(marked.behind, "behind a gap") | dict.fromkeys(broken, "few matches")
    wanted |= dict.fromkeys(range(0, count, params.stride), "stride")
    chosen: dict[int, str] = {}
    for k in sorted(wanted):
        fit = next((n for n in range(k, count) if n not in marked.unfit), None)
        if fit is not None:
            chosen.setdefault(fit, wanted[k])
    return chosen


def by_overlap(steps: Sequence[Step], params: KeyframesParams, marked: Marked = UNMARKED) -> dict[int, str]:
    """Positions as far apart as the wanted overlap permits, and why; at least one frame apart.

    Parameters
    ----------
    steps : coarse displacements from each frame to the next.
    marked : in place of an unfit position the last one before that may be basic, else the next one.
    """
    chosen, key, k = {0: ""}, 0, 0
    seen = Covisibility.all_of(steps[0]) if steps else None
    while seen is not None and k < len(steps):
        ahead = seen.after(steps[k])
        reason = "behind a gap" if k in marked.behind else _why(steps, k, key, ahead, params)
        fit = next((n for n in range(k, key, -1) if n not in marked.unfit), None) if reason else None
        if fit is not None:
            chosen[fit] = reason
            k = key = fit
            ahead = Covisibility.all_of(steps[k]).after(steps[k])
        seen, k = ahead, k + 1
    return chosen


def _why(steps: Sequence[Step], k: int, key: int, ahead: Covisibility, params: KeyframesParams) -> str:
    """Why position ``k`` should be basic, given what ``ahead`` would still be seen one frame on; empty: it need not."""
    if any(doubtful(step) for step in steps[max(k - 1, key) : k + 1]):
        return "few matches"
    if ahead.overlap < params.overlap:
        return "overlap"
    return "max_gap" if k + 1 - key > params.max_gap else ""


def doubtful(step: Step) -> bool:
    """Whether a step has too few matches to be used."""
    return step.match_rate < MIN_MATCHES or int(step.known.sum()) < LEAST_BLOCKS


def _overlap(steps: Sequence[Step]) -> float | None:
    """Overlap of the frames before and behind some steps; None: one of them is doubtful."""
    if any(doubtful(step) for step in steps):
        return None
    return reduce(Covisibility.after, steps, Covisibility.all_of(steps[0])).overlap


def segments(basic: list[int], frames: int) -> list[list[int]]:
    """Positions of each segment, from a basic pair to the next one inclusive; the last one reaches the end."""
    ends = [*basic[1:], frames - 1]
    return [list(range(a, b + 1)) for a, b in zip(basic, ends, strict=True) if b > a]


def _warnings(steps: Sequence[Step], overlap: Sequence[float | None], params: KeyframesParams) -> list[str]:
    """What the choice could not give."""
    lines = []
    blind = [k for k, step in enumerate(steps) if doubtful(step)]
    if blind:
        lines.append(
            f"{len(blind)} of {len(steps)} steps between frames have too few coarse matches (at least"
            f" {min(steps[k].match_rate for k in blind):.0%}), first behind the frame at position {blind[0]}: the"
            " overlap there is not known, and the frames are tracked on a poor prediction"
        )
    least = min((v for v in overlap if v is not None), default=1.0)
    wanted = params.overlap if params.rule == "overlap" else LITTLE
    if least < wanted:
        lines.append(
            f"successive basic pairs overlap by as little as {least:.0%}, {wanted:.0%} are wanted:"
            + (" set keyframes.stride lower" if params.rule == "stride" else " the camera moves that far in one frame")
        )
    return lines


@stage("keyframes", version=3)
def keyframes_stage(
    params: KeyframesParams,
    steps: Sequence[Bundle],
    *,
    frames: int,
    unfit: Sequence[int] = (),
    behind: Sequence[int] = (),
) -> Bundle[KeyframesFacts]:
    """Which stereo pairs become elevation models, and the segments between them."""
    if frames < 1:
        raise ConfigError("RIL-437", "no frame is chosen", remedy="choose at least one with --frames")
    moves = steps_of(steps)
    if len(moves) != frames - 1:
        raise InputError("RIL-438", f"{frames} frames need {frames - 1} steps, not {len(moves)}")
    stride = params.rule == "stride"
    marked = Marked.of(frames, unfit, behind)
    chosen = (by_stride if stride else by_overlap)(moves, params, marked)
    basic, (_, *why) = list(chosen), chosen.values()
    overlap = [None, *(_overlap(moves[a:b]) for a, b in itertools.pairwise(basic))]
    meta: KeyframesFacts = {
        "basic": basic,
        "segments": segments(basic, frames),
        "rule": f"every {params.stride}" if stride else f"overlap {params.overlap:g}",
        "overlap": overlap,
        "why": ["first frame", *why],
        "displacement": [step.displacement for step in moves],
        "match_rate": [step.match_rate for step in moves],
        "warnings": _warnings(moves, overlap, params),
    }
    return Bundle({}, meta)
