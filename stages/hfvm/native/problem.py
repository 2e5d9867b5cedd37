"""What the solvers of a level take: two images and the band between them, displacements, costs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rille.stages.core.declare import AnyArray


class LevelPair(NamedTuple):
    """Feature vectors of two images, or of windows of them, and the epipolar band.

    ``left, right``: (row, col) uint64. ``f``: (3, 3) float64, fundamental matrix of the images, zeros without a band;
    ``mu``: cost of a pixel off a line, byte steps.
    """

    left: AnyArray
    right: AnyArray
    f: AnyArray
    mu: float


class Field(NamedTuple):
    """Displacements of the left pixels, ``v << 16 | u``, and what each costs without smoothness; (row, col) int32."""

    shift: AnyArray
    cost: AnyArray


class Smoothing(NamedTuple):
    """Propagation: cost of a step of roughness, number of rounds, and what beside a displacement is tried: nothing (0),
    a column to either side (1), a row too (2)."""

    smoothness: int
    rounds: int
    beside: int


class EdgeRule(NamedTuple):
    """Placement of depth edges, see :mod:`rille.stages.hfvm.level`.

    ``reach``: pixels to the farthest whose displacement is tried. ``apart``: pixels between displacements of two sides.
    ``grey``: grey levels from which on a pixel does not count. ``far``: greatest distance. ``own, other``: factors of
    what the own displacement costs, and the others, but for farther ones. ``near``: sign of the columns of nearer
    things, 0 unknown.
    """

    reach: int
    apart: int
    grey: int
    far: int
    own: int
    other: int
    near: int


class PathCosts(NamedTuple):
    """Costs in quarters of a byte step.

    ``compact``: of a byte step of compact features; ``small``: of a pixel of difference to the pixel before; ``large``:
    the most that a difference costs, half of it at a step of ``grey`` levels.
    """

    compact: int
    small: int
    large: int
    grey: int


CANDIDATES = 8
"""Candidates of a pixel on a path; sixteen cost twice the time and change bad-2 by less than .002."""

NONE = 32767
"""Cost where there is no candidate."""

FAR = 1 << 25
"""Cost above every cost."""


def pack_map(u: AnyArray, v: AnyArray) -> AnyArray:
    """Packed displacements, int32, of two int16 maps."""
    shift = v.astype(np.int32)
    shift <<= 16
    shift |= u.view(np.uint16)
    return shift


def unpacked(shift: AnyArray) -> tuple[AnyArray, AnyArray]:
    """The reverse of :func:`pack_map`."""
    return shift.astype(np.int16), (shift >> 16).astype(np.int16)
