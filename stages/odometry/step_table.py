"""Table of the steps between successive frames: overlap and abrupt changes, of about a hundred motions a table.

The choice of basic pairs and the screening of frames go through the whole sequence. They need blocks of each motion's
displacements, not the maps: read from tables, a sequence of thousands of frames is some tens of artifacts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, pairwise

import numpy as np

from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError
from rille.stages.core.validity import matched
from rille.stages.facts.odometry import MotionFacts, StepTableFacts
from rille.stages.odometry.covisibility import Step


def change(a: Bundle, b: Bundle) -> float:
    """Median change of the displacements from one step to the next, pixels, where both are measured; 0: nowhere."""
    both = matched(np.asarray(a["validity"])) & matched(np.asarray(b["validity"]))
    if not both.any():
        return 0.0
    apart = [np.asarray(b[n])[both] - np.asarray(a[n])[both] for n in ("column_disparity", "row_disparity")]
    return float(np.median(np.hypot(*apart)))


def steps_of(tables: Sequence[Bundle]) -> list[Step]:
    """The steps of all tables, in order."""
    return list(chain.from_iterable(_rows(table) for table in tables))


def changes_of(tables: Sequence[Bundle]) -> list[float]:
    """Change from each step to the next, pixels: one fewer than there are steps."""
    return [float(v) for v in np.concatenate([np.empty(0), *(table["change"] for table in tables)])[1:]]


def _rows(table: Bundle) -> Iterator[Step]:
    blocks, shift, rates = (np.asarray(table[name]) for name in ("blocks", "shift", "match_rate"))
    width, height = table.meta["size"]
    for k, rate in enumerate(rates):
        yield Step(blocks, float(table.meta["side"]), shift[k], (width, height), float(rate))


@stage(
    "step_table",
    outputs=[
        Array("blocks", ("block", "uv"), "float64", "px", "column and row of the centre of each block"),
        Array("shift", ("step", "block", "uv"), "float64", "px", "displacement of each block", "nan"),
        Array("match_rate", ("step",), "float64", "1", "share of the pixels with texture that have a displacement"),
        Array("change", ("step",), "float64", "px", "median change of the displacements since the step before"),
    ],
)
def step_table_stage(
    params: NoParams, motions: Sequence[Bundle[MotionFacts]], before: Bundle[MotionFacts] | None = None
) -> Bundle[StepTableFacts]:
    """Displacements of the blocks of the image from frame to frame, of many motions."""
    steps = [Step.from_bundle(motion) for motion in motions]
    first = steps[0]
    if any(not np.array_equal(step.blocks, first.blocks) for step in steps):
        raise InputError(
            "RIL-895", "motions of one table have different grids", remedy="give images of one size to a sequence"
        )
    # A change needs two steps: the first of a table that has one before it is measured against that one's last.
    earlier = [] if before is None else [before]
    changes = [change(a, b) for a, b in pairwise([*earlier, *motions])]
    return Bundle(
        {
            "blocks": first.blocks,
            "shift": np.array([step.shift for step in steps]),
            "match_rate": np.array([step.match_rate for step in steps]),
            "change": np.array(changes if earlier else [0.0, *changes]),
        },
        {"side": first.side, "size": list(first.size)},
    )
