"""Audit of the seams of one elevation model: its difference from each earlier model that saw the same ground.

A difference has three parts, told apart by :mod:`rille.stages.terrain.overlap_fit`: a bias and a tilt about two axes,
which come from the poses (or the rig); and noise, which comes from the matching and is compared with what both models'
own standard deviations let expect. The factor between both models' grey values is a by-product
(:mod:`rille.stages.terrain.radiometry`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, Inputs, NoParams, Stage
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.overlap_fit import LEAST_CELLS, fit_seam

MAP_CELLS = 160
"""Longest side of a stored map of differences; cells of larger ones are averaged."""
GREY = (8.0, 247.0)
"""Grey values that tell an exposure: darker ones are noise, brighter ones saturated."""


def seam(dem: Bundle, other: Bundle) -> tuple[dict[str, Any], Floats32] | None:
    """Facts of one seam, elevation of ``dem`` minus that of ``other``, and the (coarse) map of the difference.

    None where both share too little ground.
    """
    lattices = [Lattice.from_dict(b.meta["lattice"]) for b in (dem, other)]
    common = lattices[0].intersection(lattices[1])
    if common is None:
        return None
    windows = [lattice.window(common) for lattice in lattices]

    def both(name: str) -> list[Floats]:
        return [np.asarray(b.part(name, w), np.float64) for b, w in zip((dem, other), windows, strict=True)]

    z = both("elevation")
    difference = z[0] - z[1]
    fit = fit_seam(difference, common.xs(), common.ys())
    if fit is None:
        return None
    seen = np.isfinite(difference)
    expected = float(np.median(np.hypot(*both("elevation_std"))[seen]))
    map_, step = _coarse(difference)
    grey = both("ortho")
    facts = {
        "pair": int(dem.meta["pair"]),
        "other": int(other.meta["pair"]),
        "cells": fit.cells,
        "area": fit.cells * common.cell**2,
        "centre": fit.centre.tolist(),
        "bias": float(fit.plane[0]),
        "tilt": fit.plane[1:].tolist(),
        "covariance": fit.covariance.tolist(),
        "noise": fit.noise,
        "structure": fit.structure,
        "systematic": fit.systematic,
        "expected": expected,
        "log_ratio": _log_ratio(grey[0], grey[1], seen),
        "map": {"bounds": common.bounds, "step": step * common.cell},
    }
    return facts, map_


def _log_ratio(grey: Floats, other: Floats, seen: Bools) -> float | None:
    """Median logarithm of the factor between the grey values; None where too few tell."""
    with np.errstate(invalid="ignore"):
        good = seen & (grey > GREY[0]) & (grey < GREY[1]) & (other > GREY[0]) & (other < GREY[1])
    if int(good.sum()) < LEAST_CELLS:
        return None
    return float(np.median(np.log(grey[good] / other[good])))


def _coarse(difference: Floats) -> tuple[Floats32, int]:
    """Means of square blocks, so that no side is above :data:`MAP_CELLS`; and the side of a block."""
    step = max(1, math.ceil(max(difference.shape) / MAP_CELLS))
    rows, cols = (-(-n // step) for n in difference.shape)
    cut = [(0, rows * step - difference.shape[0]), (0, cols * step - difference.shape[1])]
    blocks = np.pad(difference, cut, constant_values=np.nan).reshape(rows, step, cols, step)
    count = np.isfinite(blocks).sum(axis=(1, 3))
    mean = np.nansum(blocks, axis=(1, 3)) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan).astype(np.float32), step


def _run(params: NoParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    dem = inputs["dem"]
    arrays, facts = {}, []
    for other in sorted(inputs["others"], key=lambda b: int(b.meta["pair"])):
        found = seam(dem, other)
        if found is not None:
            facts.append(found[0])
            arrays[f"difference_{found[0]['other']}"] = found[1]
    return Bundle(arrays, {"pair": int(dem.meta["pair"]), "seams": facts})


STAGE = Stage(
    name="seam",
    version=1,
    summary="difference of an elevation model from earlier ones that overlap: bias, tilt and noise apart",
    params=NoParams,
    inputs=("dem", "others*"),
    outputs=(
        Array(
            "difference_*",
            ("row", "col"),
            "float32",
            "m",
            "elevation minus that of the other model, means of blocks of cells",
            "nan",
            "world",
            optional=True,
        ),
    ),
    run=_run,
)
