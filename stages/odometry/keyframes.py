"""Choice of the basic pairs: which stereo pairs become elevation models (paper, sections 7.2 and 7.4).

Successive basic pairs bound a *segment*: the left images from one to the next are tracked and resected against the
elevation model of the first. Positions after the last basic pair are an open last segment.

The paper takes every fourth pair of a camera that moves evenly. Here the next basic pair is the last one whose image
still shows the wanted share of what the one before shows (:mod:`rille.stages.odometry.steps`): poses are not
known yet, the coarse displacements are. A camera that rests needs no new elevation model, one that turns needs them
often.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from pydantic import Field, model_validator

from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.facts.odometry import KeyframesFacts, StepTableFacts
from rille.stages.odometry.steps import Step, overlaps, steps_of

NAVIGATION: Mapping[str, Any] = {"rule": "overlap", "overlap": 0.6}
"""What preset ``navigation`` sets; a value given by the user wins."""


class KeyframesParams(Params):
    """Parameters of the choice of basic pairs.

    Attributes
    ----------
    preset : terrain: close basic pairs, whose elevation models overlap; navigation: trajectory only, with rule overlap
        at 0.6, hfvm.preset fast, and cheaper motion.level, track.points and orientation.samples; keys set explicitly
        win, except keyframes.stride without keyframes.rule.
    rule : overlap: basic pairs as far apart as keyframes.overlap permits; stride: every stride-th frame, as in the
        paper.
    overlap : share of a basic pair's view that the next basic pair must see too (rule overlap); with less, landmarks
        and common terrain run out.
    stride : frames between basic pairs (rule stride; 4 in the paper, section 7.4); setting it without keyframes.rule
        selects rule stride.
    max_gap : largest number of frames between basic pairs under rule overlap; light and shadows change.
    """

    preset: Literal["terrain", "navigation"] = "terrain"
    rule: Literal["overlap", "stride"] = "overlap"
    overlap: float = Field(0.7, gt=0, lt=1)
    stride: int = Field(4, ge=1)
    max_gap: int = Field(16, ge=1)

    @model_validator(mode="before")
    @classmethod
    def _rule(cls, values: Any) -> Any:
        """Preset navigation sets its rule, to which a mere stride changes nothing; else a mere stride sets its own."""
        if isinstance(values, Mapping) and values.get("preset") == "navigation":
            return {**NAVIGATION, **values}
        if isinstance(values, Mapping) and "stride" in values:
            return {"rule": "stride", **values}
        return values


def by_stride(steps: Sequence[Step], params: KeyframesParams, unfit: set[int], behind: set[int]) -> dict[int, str]:
    """Positions 0, stride, 2 stride ... of one more frame than there are steps, and why; for an unfit one the next.

    A frame after a step with too few matches is basic, too: the frames that follow then get poses, in a piece of their
    own.
    """
    count = len(steps) + 1
    broken = [k + 1 for k, step in enumerate(steps) if not step.overlaps]
    wanted = dict.fromkeys(behind, "behind a gap") | dict.fromkeys(broken, "few matches")
    wanted |= dict.fromkeys(range(0, count, params.stride), "stride")
    chosen: dict[int, str] = {}
    for k in sorted(wanted):
        if (fit := _fit(range(k, count), unfit)) is not None:
            chosen.setdefault(fit, wanted[k])
    return chosen


def by_overlap(steps: Sequence[Step], params: KeyframesParams, unfit: set[int], behind: set[int]) -> dict[int, str]:
    """Positions as far apart as the wanted overlap permits, and why; at least one frame apart.

    Parameters
    ----------
    steps : coarse displacements from each frame to the next.
    unfit : positions that may not be basic: in place of one the last before it, else the next.
    behind : positions that are basic whatever the steps show.
    """
    chosen: dict[int, str] = {}
    key: int | None = 0
    reason = ""
    while key is not None:
        chosen[key] = reason
        begun, key = key, None
        for k, overlap in enumerate(overlaps(steps[begun:]), begun):
            # Position k is basic where one more frame would be too much.
            reasons = {
                "behind a gap": k in behind,
                "few matches": not all(step.overlaps for step in steps[max(k - 1, begun) : k + 1]),
                "overlap": min(overlap) < params.overlap,
                "max_gap": k + 1 - begun > params.max_gap,
            }
            reason = next((words for words, holds in reasons.items() if holds), "")
            key = _fit(range(k, begun, -1), unfit) if reason else None
            if key is not None:
                break
    return chosen


def _fit(positions: Iterable[int], unfit: set[int]) -> int | None:
    """The first position that may be basic; None: none."""
    return next((n for n in positions if n not in unfit), None)


def _overlap(steps: Sequence[Step]) -> float | None:
    """Overlap of the frames before and after some steps; None: one of the steps has too few matches."""
    *_, last = overlaps(steps)
    return min(last) if all(step.overlaps for step in steps) else None


def segments(basic: list[int], frames: int) -> list[list[int]]:
    """Positions of each segment, from a basic pair to the next one inclusive; the last one reaches the end."""
    ends = [*basic[1:], frames - 1]
    return [list(range(a, b + 1)) for a, b in zip(basic, ends, strict=True) if b > a]


def _warnings(overlap: Sequence[float | None], params: KeyframesParams) -> list[str]:
    """A line if a basic pair has less ``overlap`` with the one before than is wanted."""
    least = min((share for share in overlap if share is not None), default=1.0)
    stride = params.rule == "stride"
    # 0.4: overlap below which a stride, which asks for none, is warned of: most landmarks of a segment leave the image.
    wanted = 0.4 if stride else params.overlap
    if least >= wanted:
        return []
    cause = "the camera moves that far in one frame, or frames between may not be basic pairs"
    return [
        f"successive basic pairs overlap by as little as {least:.0%}, {wanted:.0%} are wanted: "
        f"{'set keyframes.stride lower' if stride else cause}"
    ]


@stage("keyframes")
def keyframes_stage(
    params: KeyframesParams,
    steps: Sequence[Bundle[StepTableFacts]],
    *,
    frames: int,
    unfit: Sequence[int] = (),
    behind: Sequence[int] = (),
) -> Bundle[KeyframesFacts]:
    """Which stereo pairs become elevation models, and the segments between them."""
    moves = steps_of(steps)
    stride = params.rule == "stride"
    # Where the bridge over a gap of lost frames is refused, the frames behind it are posed as a piece of their own.
    after = {n for k in behind if (n := _fit(range(k, frames), set(unfit))) is not None}
    chosen = (by_stride if stride else by_overlap)(moves, params, set(unfit), after)
    basic, (_, *why) = list(chosen), chosen.values()
    overlap = [None, *(_overlap(moves[a:b]) for a, b in itertools.pairwise(basic))]
    meta: KeyframesFacts = {
        "basic": basic,
        "segments": segments(basic, frames),
        "overlap": overlap,
        "why": ["first frame", *why],
        "displacement": [step.displacement for step in moves],
        "match_rate": [step.match_rate for step in moves],
        "warnings": _warnings(overlap, params),
    }
    return Bundle({}, meta)
