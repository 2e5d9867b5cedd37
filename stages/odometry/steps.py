"""Steps between successive frames, in tables of about a hundred, and what two frames some steps apart have in common.

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
from itertools import chain, pairwise

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import AnyArray, Array, Bundle, NoParams, stage
from rille.stages.core.errors import InputError
from rille.stages.core.validity import matched, matched_share
from rille.stages.facts.odometry import MotionFacts, StepTableFacts
from rille.stages.odometry.displacements import fit_affinity, known_median

BLOCKS = 200
"""Approximate number of blocks of an image; more change the overlap by less than 1 %, at a cost that grows with their
square."""
MATCHED_SHARE = 0.5
"""Share of a block's pixels that must be matched for its median to count: fewer may agree by chance."""


@dataclass(frozen=True)
class Step:
    """Coarse displacements from one frame to the next, pixels of level 0.

    ``blocks`` (m, 2) centres (column, row) of all blocks of the image, ``side`` of a block; ``shift`` (m, 2) their
    displacements, NaN not known; ``size`` (columns, rows) that the whole blocks cover; ``match_rate`` share of the
    pixels with texture that have a displacement.
    """

    blocks: Floats
    side: float
    shift: Floats
    size: tuple[float, float]
    match_rate: float

    @staticmethod
    def from_bundle(bundle: Bundle) -> Step:
        """Build from the result of stage ``motion``."""
        validity = np.asarray(bundle["validity"])
        known, scale = matched(validity), 2.0 ** int(bundle.meta["level"])
        # By the area, so that images of all shapes have about as many blocks.
        side = max(1, round((known.size / BLOCKS) ** 0.5))
        inside = _blocks(known, side)
        # Pixel centres are at integers: a block of s pixels from 0 on has its centre at s / 2 - 1/2.
        centres = [(np.arange(n) + 0.5) * side * scale - 0.5 for n in (inside.shape[1], inside.shape[0])]
        enough = inside.mean(-1) >= MATCHED_SHARE
        shift = np.full((*enough.shape, 2), np.nan)
        for k, name in enumerate(("column_disparity", "row_disparity")):
            values = np.where(inside, _blocks(np.asarray(bundle[name]), side), np.float32(np.nan))
            shift[enough, k] = known_median(values[enough], inside[enough].sum(-1))
        return Step(
            np.stack(np.meshgrid(*centres), -1).reshape(-1, 2),
            side * scale,
            shift.reshape(-1, 2),
            (enough.shape[1] * side * scale, enough.shape[0] * side * scale),
            matched_share(validity),
        )

    @property
    def known(self) -> Bools:
        """Which blocks (m,) have a displacement."""
        return np.asarray(np.isfinite(self.shift).all(1))

    def move(self, points: Floats) -> Floats:
        """Predict points (n, 2) of this frame in the next one, by affinities of the displacements around them."""
        ok = self.known
        return (
            points + fit_affinity(self.blocks[ok], (self.blocks + self.shift)[ok], np.ones(ok.sum(), bool), points)[1]
        )

    @property
    def displacement(self) -> float | None:
        """Median length of the displacements."""
        return float(np.median(np.linalg.norm(self.shift[self.known], axis=1))) if self.known.any() else None


def _blocks(values: AnyArray, side: int) -> AnyArray:
    """(row, col) values as (block row, block column, pixel); rows and columns that fill no block are left out."""
    rows, cols = (max(1, n // side) for n in values.shape)
    whole = values[: rows * side, : cols * side]
    # An image smaller than a block is one block of fewer pixels.
    return whole.reshape(rows, whole.shape[0] // rows, cols, -1).swapaxes(1, 2).reshape(rows, cols, -1)


@dataclass(frozen=True)
class Covisibility:
    """Overlap of a first frame and a later one.

    ``origin`` (n, 2) those blocks of the first frame that are still in the image, ``points`` (n, 2) where they are now,
    ``part`` (n,) of each that is still seen; ``kept`` share of the first frame that is still seen; ``covered`` share of
    the later frame that the first one saw.
    """

    origin: Floats
    points: Floats
    part: Floats
    later: Step
    """A step from or to the later frame: its blocks."""

    @staticmethod
    def all_of(step: Step) -> Covisibility:
        """Overlap of the frame before a step with itself: all of its blocks."""
        return Covisibility(step.blocks, step.blocks, np.ones(len(step.blocks)), step)

    def after(self, step: Step) -> Covisibility:
        """Overlap with the frame after a step; a part that has left the image does not return."""
        moved = step.move(self.points)
        # The least so far: what has left the image and comes back is not found again by tracking either.
        part = np.minimum(self.part, _part_inside(moved, step))
        left = part > 0
        return Covisibility(self.origin[left], moved[left], part[left], step)

    @property
    def kept(self) -> float:
        """Share of the first frame that is still seen."""
        return float(self.part.sum()) / len(self.later.blocks)

    @property
    def covered(self) -> float:
        """Share of the later frame that the first one saw."""
        _, back = fit_affinity(self.points, self.origin, np.ones(len(self.points), bool), self.later.blocks)
        return float(np.mean(_part_inside(self.later.blocks + back, self.later)))

    @property
    def overlap(self) -> float:
        """The lesser share, 0..1: a camera that drives ahead loses what it saw, one that backs off sees new ground."""
        return min(self.kept, self.covered)


def _part_inside(centres: Floats, step: Step) -> Floats:
    """Share (n,) of each block that lies in the image, by its centre (n, 2)."""
    # Distance to the nearest edge of the image, which lies half a pixel outside the first and last pixel centres.
    beyond = np.minimum(centres + 0.5, np.array(step.size) - 0.5 - centres)
    return np.asarray(np.clip(beyond / step.side + 0.5, 0.0, 1.0).prod(axis=1), dtype=np.float64)


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
