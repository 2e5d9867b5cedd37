"""Overlap of two elevation models: what of their difference is systematic, and what is noise, with an honest sigma.

The difference of a model from each earlier one that saw the same ground has three parts: a bias and a tilt about two
axes, which come from the poses (or the rig); and noise, which comes from the matching and is compared with what both
models' own standard deviations let expect. The factor between both models' grey values is a by-product
(:mod:`rille.stages.terrain.radiometry`).

Matching errors are alike over several cells, so the cells of an overlap are far fewer observations than their number:
of large overlaps each so many-th cell is read. The plane is fitted to medians of blocks of cells, by least squares
with Tukey's biweight, and its covariance follows from the scatter of the blocks, not from any stated sigma.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.terrain import DemFacts, OverlapFacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, mad_sigma

TARGET_BLOCKS = 49
"""Approximate number of blocks of an overlap; each is wider than errors are alike."""
MIN_BLOCKS = 12
"""Fewest blocks from which three parameters and their errors are estimated."""
MIN_CELLS = 100
MAX_CELLS = 40_000
"""Cells of an overlap that are compared, about: hundreds a block, so that the plane moves by half its sigma at most."""
MIN_BLOCK_SHARE = 0.25
"""Known share of a block's cells from which it counts."""

USABLE_GREY = (8.0, 247.0)
"""Grey values that an exposure is read from: darker ones are noise, brighter ones saturated."""
ARRAYS = ("elevation", "elevation_std", "ortho")


@dataclass(frozen=True)
class SeamFit:
    """Plane ``bias + tilt . (xy - centre)`` in a difference of elevations, and what is left.

    ``centre`` (2,) m; ``plane`` (3,): bias m, tilt along x and y, rad; ``covariance`` (3, 3) of it; ``noise`` robust
    standard deviation of the cells about the plane, m; ``systematic`` RMS of the plane over the cells, m.
    """

    centre: Floats
    plane: Floats
    covariance: Floats
    noise: float
    systematic: float


def fit_seam(difference: Floats, x: Floats, y: Floats) -> SeamFit | None:
    """Plane in a map of differences.

    Parameters
    ----------
    difference : (rows, cols) metres, NaN undefined.
    x, y : (cols,), (rows,) coordinates of the cells, metres.

    Returns
    -------
    SeamFit
        None where too few cells or blocks are defined.
    """
    row, col = np.nonzero(np.isfinite(difference))
    if len(row) < MIN_CELLS:
        return None
    z, places = difference[row, col], np.column_stack([x[col], y[row]])
    # At least three cells wide.
    side = max(3, math.ceil(math.sqrt(len(row) / TARGET_BLOCKS)))
    across = difference.shape[1] // side + 1
    value, weight, middle = _blocks(z, places, (row // side) * across + col // side, side * side)
    if len(value) < MIN_BLOCKS:
        return None
    centre = np.average(middle, axis=0, weights=weight)
    plane, covariance = _robust(np.column_stack([np.ones(len(value)), middle - centre]), value, weight)
    surface = plane[0] + (places - centre) @ plane[1:]
    return SeamFit(centre, plane, covariance, mad_sigma(z - surface, 0.0), math.sqrt(float(np.mean(surface**2))))


def _robust(design: Floats, value: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Plane (3,) and its covariance: first by least absolute deviations, which gross errors do not capture."""
    floor = 1e-12 * float(np.abs(value).max(initial=0.0)) + 1e-300
    # Few rounds: a start needs no digits.
    absolute = irls(design, value, lambda r: weight / np.maximum(r, 0.01 * mad_sigma(r, 0.0) + floor), rounds=8)
    scale = mad_sigma(value - design @ absolute, 0.0) + floor
    plane = irls(design, value, lambda r: weight * bisquare(r / (TUKEY_BISQUARE * scale)), start=absolute)
    residual = value - design @ plane
    u = np.minimum((residual / (TUKEY_BISQUARE * scale)) ** 2, 1.0)
    # Tukey's psi and its derivative: variance of an M-estimate, with three parameters taken from n blocks.
    psi, slope = residual * (1.0 - u) ** 2, (1.0 - u) * (1.0 - 5.0 * u)
    n, shares = len(value), weight / weight.mean()
    variance = float(shares @ psi**2) / max(float(shares @ slope), 1e-12) ** 2 * n**2 / (n - 3)
    return plane, variance * np.linalg.pinv((design * shares[:, None]).T @ design, hermitian=True)


def _blocks(z: Floats, places: Floats, block: NDArray[np.intp], whole: int) -> tuple[Floats, Floats, Floats]:
    """Median of z, known share, and mean x and y (n, 2) of each block of which enough is known.

    ``block``: number of each cell's block; ``whole``: cells of a block.
    """
    count = np.bincount(block)
    good = count >= MIN_BLOCK_SHARE * whole
    ordered, first = z[np.lexsort((z, block))], (np.cumsum(count) - count)[good]
    count = count[good]
    median = 0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2])
    return median, count / whole, np.stack([np.bincount(block, p)[good] / count for p in places.T], axis=-1)


def seam(dem: Bundle, own: Mapping[str, Floats32], other: Bundle) -> dict[str, Any] | None:
    """Facts of one seam, elevation of ``dem`` (arrays ``own``) minus that of ``other``.

    None where both share too little ground.
    """
    lattices = [Lattice.from_dict(b.meta["lattice"]) for b in (dem, other)]
    common = lattices[0].intersection(lattices[1])
    if common is None:
        return None
    windows = [lattice.window(common) for lattice in lattices]
    shared = {name: (own[name][windows[0]], np.asarray(other.part(name, windows[1]))) for name in ARRAYS}
    known = np.isfinite(shared["elevation"][0]) & np.isfinite(shared["elevation"][1])
    step = max(1, math.ceil(math.sqrt(np.count_nonzero(known) / MAX_CELLS)))
    each = np.s_[::step, ::step]
    seen = known[each]
    z, std, grey = ([values[each].astype(np.float64) for values in shared[name]] for name in ARRAYS)
    fit = fit_seam(z[0] - z[1], common.xs()[::step], common.ys()[::step])
    if fit is None:
        return None
    return {
        "pair": int(dem.meta["pair"]),
        "other": int(other.meta["pair"]),
        "cells": int(np.count_nonzero(known)),
        "bias": float(fit.plane[0]),
        "tilt": fit.plane[1:].tolist(),
        "covariance": fit.covariance.tolist(),
        "noise": fit.noise,
        "systematic": fit.systematic,
        "expected": float(np.median(np.hypot(std[0][seen], std[1][seen]))),
        "log_ratio": _log_ratio(grey[0][seen], grey[1][seen]),
    }


def _log_ratio(grey: Floats, other: Floats) -> float | None:
    """Median logarithm of the factor between the grey values; None where too few tell."""
    low, high = USABLE_GREY
    good = (np.fmin(grey, other) > low) & (np.fmax(grey, other) < high)
    if np.count_nonzero(good) < MIN_CELLS:
        return None
    return float(np.median(np.log(grey[good] / other[good])))


@stage("overlap_qa", version=3)
def overlap_qa_stage(
    params: NoParams, dem: Bundle[DemFacts], others: Sequence[Bundle[DemFacts]]
) -> Bundle[OverlapFacts]:
    """Difference of an elevation model from earlier ones that overlap: bias, tilt and noise apart."""
    own = {name: np.asarray(dem[name]) for name in ARRAYS}
    compared = [seam(dem, own, other) for other in sorted(others, key=lambda b: int(b.meta["pair"]))]
    return Bundle({}, {"pair": int(dem.meta["pair"]), "seams": [facts for facts in compared if facts is not None]})
