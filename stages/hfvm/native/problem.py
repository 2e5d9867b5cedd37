"""What the solvers of a level take: two images and the band between them, displacements, costs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm.epipolar import NO_BAND


class LevelPair(NamedTuple):
    """Feature vectors of two images, or of windows of them, and the epipolar band.

    ``left, right``: (row, col) uint64. ``f``: (3, 3) float64, fundamental matrix of the images, zeros without a band;
    ``mu``: cost of a pixel off a line, byte steps.
    """

    left: AnyArray
    right: AnyArray
    f: AnyArray = NO_BAND
    mu: float = 0.0


class Map(NamedTuple):
    """Displacements of one direction at one level, (row, col) int16 columns and rows."""

    u: AnyArray
    v: AnyArray


class Field(NamedTuple):
    """Displacements of the left pixels, ``v << 16 | u``, and their costs without smoothness; (row, col) int32."""

    shift: AnyArray
    cost: AnyArray


class Smoothing(NamedTuple):
    """Propagation: cost of a step of roughness, number of rounds, and the neighbours of a displacement that are tried:
    none (0), a column to either side (1), a row too (2)."""

    smoothness: int
    rounds: int
    beside: int


CANDIDATES = 8
"""Candidates of a pixel on a path; sixteen cost twice the time and change bad-2 by less than .002."""


def pack_map(u: AnyArray, v: AnyArray) -> AnyArray:
    """Packed displacements, int32, of two int16 maps."""
    shift = v.astype(np.int32)
    shift <<= 16
    shift |= u.view(np.uint16)
    return shift


def unpacked(shift: AnyArray) -> Map:
    """The reverse of :func:`pack_map`."""
    return Map(shift.astype(np.int16), (shift >> 16).astype(np.int16))
