"""Systematic part and noise of the difference of two elevation models where they overlap.

The difference of a model from each earlier one that saw the same ground has three parts: a bias and a tilt about two
axes, which come from the poses (or the rig); and noise, which comes from the matching and is compared with both
models' own standard deviations. The factor between both models' grey values is a by-product
(:mod:`rille.stages.terrain.radiometry`).

Large overlaps are thinned to every n-th cell. Bias and tilt are those of a robust plane through the differences, which
rocks that one model lacks do not pull.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.terrain import DemFacts, OverlapFacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import cauchy, mad_sigma

MIN_CELLS = 100
MAX_CELLS = 40_000
"""Cells of an overlap that are compared, about."""

ARRAYS = ("elevation", "elevation_std", "ortho")


class SeamFit(NamedTuple):
    """Plane in a difference of elevations, and the rest: ``bias`` m in the middle of the cells, ``tilt`` (2,) along x
    and y, rad, ``noise`` robust standard deviation of the cells about the plane, m, ``systematic`` RMS of the plane
    over the cells, m."""

    bias: float
    tilt: list[float]
    noise: float
    systematic: float


def fit_seam(difference: Floats, x: Floats, y: Floats) -> SeamFit | None:
    """Plane in a map of differences (rows, cols), m, NaN undefined, at ``x`` (cols,), ``y`` (rows,) m; None where fewer
    than :data:`MIN_CELLS` are defined."""
    row, col = np.nonzero(np.isfinite(difference))
    if len(row) < MIN_CELLS:
        return None
    z, places = difference[row, col], np.column_stack([x[col], y[row]])
    design = np.column_stack([np.ones(len(z)), places - places.mean(axis=0)])
    floor = 1e-12 * float(np.abs(z).max()) + 1e-300
    # Standard deviations at half weight: 95 % efficiency where errors are normal.
    plane = irls(design, z, lambda r: cauchy(r, 2.385 * mad_sigma(r, 0.0) + floor), rounds=8)
    surface = design @ plane
    return SeamFit(
        float(plane[0]), plane[1:].tolist(), mad_sigma(z - surface, 0.0), math.sqrt(float(np.mean(surface**2)))
    )


def seam(dem: Bundle, own: Mapping[str, Floats32], other: Bundle) -> dict[str, Any] | None:
    """Facts of one seam, elevation of ``dem`` (arrays ``own``) minus that of ``other``.

    None where both share too little ground.
    """
    lattices = [Lattice.from_dict(b.meta["lattice"]) for b in (dem, other)]
    common = lattices[0].intersection(lattices[1])
    if common is None:
        return None
    windows = [lattice.window(common) for lattice in lattices]
    shared = {name: (own[name][windows[0]], np.asarray(other.raster(name)[windows[1]])) for name in ARRAYS}
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
        **fit._asdict(),
        "expected": float(np.median(np.hypot(std[0][seen], std[1][seen]))),
        "log_ratio": _log_ratio(grey[0][seen], grey[1][seen]),
    }


def _log_ratio(grey: Floats, other: Floats) -> float | None:
    """Median logarithm of the factor between the grey values; None where too few tell."""
    # Darker values are noise, brighter ones saturated. Beside the rims of the images an elevation has no grey value:
    # NaN, which is in no range.
    good = (np.minimum(grey, other) > 8.0) & (np.maximum(grey, other) < 247.0)
    if np.count_nonzero(good) < MIN_CELLS:
        return None
    return float(np.median(np.log(grey[good] / other[good])))


@stage("overlap_qa")
def overlap_qa_stage(
    params: NoParams, dem: Bundle[DemFacts], others: Sequence[Bundle[DemFacts]]
) -> Bundle[OverlapFacts]:
    """Difference of an elevation model from earlier ones that overlap: bias, tilt and noise apart."""
    own = {name: np.asarray(dem[name]) for name in ARRAYS}
    compared = [seam(dem, own, other) for other in sorted(others, key=lambda b: int(b.meta["pair"]))]
    return Bundle({}, {"pair": int(dem.meta["pair"]), "seams": [facts for facts in compared if facts is not None]})
