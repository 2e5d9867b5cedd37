"""Steps between successive frames, in tables of about a hundred, and the share of the view of frames some steps apart.

The choice of basic pairs and the screening of frames go through the whole sequence. They need blocks of each motion's
displacements, not the maps: read from tables, a sequence of thousands of frames is some tens of artifacts.

Blocks of the first frame are carried along the chain of displacements (stage ``motion``). The displacement of a block
is the median of its matches; where too few of its pixels match, the affinity of the surroundings is extrapolated. That
matters most for a camera that drives ahead: the near ground leaves the image at its lower edge and finds no match, and
displacements interpolated there are too short. If such blocks are left out, or counted with interpolated displacements,
an overlap of 66 % looks like 85 %.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError
from rille.stages.core.validity import matched, matched_share
from rille.stages.facts.odometry import MotionFacts, StepTableFacts
from rille.stages.odometry.displacements import fit_affinity, known_median

MIN_MATCHES = 0.2
"""Share of the textured pixels that must find a displacement for two frames to count as overlapping."""


@dataclass(frozen=True)
class Step:
    """Coarse displacements from one frame to the next, pixels of level 0.

    ``shift`` (block row, block column, 2) of each block of the image, columns and rows, NaN not known; ``side`` of a
    block; ``match_rate`` share of the pixels with texture that have a displacement, 0 where too few blocks have one.
    """

    shift: Floats
    side: float
    match_rate: float

    @staticmethod
    def from_bundle(bundle: Bundle[MotionFacts]) -> Step:
        """Build from the result of stage ``motion``."""
        validity = np.asarray(bundle["validity"])
        known = matched(validity)
        # By the area, so that images of all shapes have about as many blocks.
        # 200: approximate number of blocks of an image; more change the overlap by less than 1 %, at a cost that grows
        # with their square.
        side = max(1, round((known.size / 200) ** 0.5))
        inside = _blocks(known, side)
        # Fewer may agree by chance.
        enough = inside.mean(-1) >= 0.5
        shift = np.full((*enough.shape, 2), np.nan)
        for k, name in enumerate(("column_disparity", "row_disparity")):
            values = np.where(inside, _blocks(np.asarray(bundle[name]), side), np.float32(np.nan))
            shift[enough, k] = known_median(values[enough], inside[enough].sum(-1))
        shown = np.count_nonzero(enough) >= 12
        return Step(shift, side * 2.0 ** bundle.meta["level"], matched_share(validity) if shown else 0.0)

    @property
    def overlaps(self) -> bool:
        """Whether enough matches for the two frames to show the same."""
        return self.match_rate >= MIN_MATCHES

    @property
    def size(self) -> Floats:
        """Columns and rows that the blocks cover."""
        rows, columns = self.shift.shape[:2]
        return np.array([columns, rows]) * self.side

    @cached_property
    def blocks(self) -> Floats:
        """Centres (m, 2) of all blocks, column and row."""
        # Pixel centres are at integers: a block of s pixels from 0 on has its centre at s / 2 - 1/2.
        centres = [(np.arange(n) + 0.5) * self.side - 0.5 for n in self.shift.shape[1::-1]]
        return np.stack(np.meshgrid(*centres), -1).reshape(-1, 2)

    @property
    def known(self) -> Bools:
        """Which blocks (m,) have a displacement."""
        return np.asarray(np.isfinite(self.shift[..., 0]).ravel())

    def move(self, points: Floats) -> Floats:
        """Predict points (n, 2) of this frame in the next one, by affinities of the displacements around them."""
        return points + fit_affinity(self.blocks, self.blocks + self.shift.reshape(-1, 2), self.known, points)[1]

    @property
    def displacement(self) -> float | None:
        """Median length of the displacements."""
        lengths = np.linalg.norm(self.shift, axis=2).ravel()[self.known]
        return float(np.median(lengths)) if lengths.size else None

    def change(self, later: Step) -> float:
        """Median change of the displacements to those of a later step, where both are known; 0: nowhere."""
        changes = np.linalg.norm(later.shift - self.shift, axis=2)
        both = np.isfinite(changes)
        return float(np.median(changes[both])) if both.any() else 0.0


def _blocks(values: AnyArray, side: int) -> AnyArray:
    """(row, col) values as (block row, block column, pixel); rows and columns that fill no block are left out."""
    rows, cols = (max(1, n // side) for n in values.shape)
    whole = values[: rows * side, : cols * side]
    # An image smaller than a block is one block of fewer pixels.
    return whole.reshape(rows, whole.shape[0] // rows, cols, -1).swapaxes(1, 2).reshape(rows, cols, -1)


class Overlap(NamedTuple):
    """``kept``: share of a first frame that a later one still sees; ``covered``: share of the later one that the first
    saw. A camera that drives ahead loses what it saw, one that backs off sees new ground."""

    kept: float
    covered: float


def overlaps(steps: Sequence[Step]) -> Iterator[Overlap]:
    """Overlap of the frame before the first step with that after each of the steps."""
    if not steps:
        return
    origin = points = steps[0].blocks
    part = np.ones(len(points))
    for step in steps:
        points = step.move(points)
        # The least so far: what has left the image and comes back is not found again by tracking either.
        part = np.minimum(part, _part_inside(points, step))
        left = part > 0
        origin, points, part = origin[left], points[left], part[left]
        _, back = fit_affinity(points, origin, np.ones(len(points), bool), step.blocks)
        yield Overlap(part.sum() / len(step.blocks), float(np.mean(_part_inside(step.blocks + back, step))))


def _part_inside(centres: Floats, step: Step) -> Floats:
    """Share (n,) of each block that lies in the image, by its centre (n, 2)."""
    # Distance to the nearest edge of the image, which lies half a pixel outside the first and last pixel centres.
    beyond = np.minimum(centres + 0.5, step.size - 0.5 - centres)
    return np.asarray(np.clip(beyond / step.side + 0.5, 0.0, 1.0).prod(axis=1), dtype=np.float64)


def steps_of(tables: Sequence[Bundle[StepTableFacts]]) -> list[Step]:
    """The steps of all tables, in order."""
    return [
        Step(shift, table.meta["side"], float(rate))
        for table in tables
        for shift, rate in zip(np.asarray(table["shift"]), np.asarray(table["match_rate"]), strict=True)
    ]


@stage(
    "step_table",
    outputs=[
        Array("shift", ("step", "block_row", "block_col", "uv"), "float64", "px", "displacement of each block", "nan"),
        Array("match_rate", ("step",), "float64", "1", "share of the pixels with texture that have a displacement"),
    ],
)
def step_table_stage(params: NoParams, motions: Sequence[Bundle[MotionFacts]]) -> Bundle[StepTableFacts]:
    """Displacements of the blocks of the image from frame to frame, of many motions."""
    steps = [Step.from_bundle(motion) for motion in motions]
    if len({(step.shift.shape, step.side) for step in steps}) > 1:
        raise InputError(
            "RIL-895", "motions of one table have different grids", remedy="give images of one size to a sequence"
        )
    arrays: dict[str, AnyArray] = {
        "shift": np.array([step.shift for step in steps]),
        "match_rate": np.array([step.match_rate for step in steps]),
    }
    return Bundle(arrays, {"side": steps[0].side})
