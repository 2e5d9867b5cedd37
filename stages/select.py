"""Choice of the basic pairs: which stereo pairs become elevation models (paper, sections 7.2 and 7.4).

Successive basic pairs bound a *segment*: the left images from one to the next are tracked and resected against the
elevation model of the first. Positions behind the last basic pair are an open last segment.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from stages.declare import Bundle, Inputs, Params, Stage
from stages.errors import ConfigError


class SelectParams(Params):
    """Parameters of the choice of basic pairs."""

    stride: int = Field(
        4, ge=1, description="frames; every stride-th pair is basic (the paper's fourth intermediate frame, 7.4)"
    )


def basic_pairs(frames: int, stride: int) -> list[int]:
    """Positions 0, stride, 2 stride ... below ``frames``.

    Raises
    ------
    ConfigError
        Fewer than two frames: there is no motion to resect.
    """
    if frames < 2:
        raise ConfigError(f"{frames} frame chosen", remedy="choose at least two with --frames")
    return list(range(0, frames, stride))


def segments(basic: list[int], frames: int) -> list[list[int]]:
    """Positions of each segment, from a basic pair to the next one inclusive; the last one reaches the end."""
    ends = [*basic[1:], frames - 1]
    return [list(range(a, b + 1)) for a, b in zip(basic, ends, strict=True) if b > a]


def _run(params: SelectParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    basic = basic_pairs(int(args["frames"]), params.stride)
    return Bundle(
        {}, {"basic": basic, "segments": segments(basic, int(args["frames"])), "rule": f"every {params.stride}"}
    )


STAGE = Stage(
    name="select",
    version=1,
    summary="which stereo pairs become elevation models, and the segments between them",
    params=SelectParams,
    inputs=(),
    outputs=(),
    requires=(),
    run=_run,
)
