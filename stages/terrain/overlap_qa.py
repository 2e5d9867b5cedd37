"""Overlap of two elevation models: what of their difference is systematic, and what is noise, with an honest sigma.

The difference of a model from each earlier one that saw the same ground has three parts: a bias and a tilt about two
axes, which come from the poses (or the rig); and noise, which comes from the matching and is compared with what both
models' own standard deviations let expect. The factor between both models' grey values is a by-product
(:mod:`rille.stages.terrain.radiometry`).

Matching errors are alike over several cells, so the cells of an overlap are far fewer observations than their number.
The plane is therefore fitted to medians of blocks of cells, by least squares with Tukey's biweight, and its covariance
follows from the scatter of the blocks, not from any stated sigma.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Bundle, NoParams, raster, stage
from rille.stages.facts.terrain import DemFacts, OverlapFacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.least_squares import irls
from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, mad_sigma

BLOCKS = 49
"""Approximate number of blocks of an overlap; each is wider than errors are alike."""
MIN_BLOCKS = 12
"""Fewest blocks from which three parameters and their errors are estimated."""
MIN_CELLS = 100
MIN_BLOCK_SIDE = 3
"""Cells."""
MIN_BLOCK_SHARE = 0.25
"""Known share of a block's cells from which it counts."""

MAP_CELLS = 160
"""Longest side of a stored map of differences; cells of larger ones are averaged."""
USABLE_GREY = (8.0, 247.0)
"""Grey values that an exposure is read from: darker ones are noise, brighter ones saturated."""


@dataclass(frozen=True)
class SeamFit:
    """Plane ``bias + tilt . (xy - centre)`` in a difference of elevations, and what is left.

    ``centre`` (2,) m; ``plane`` (3,): bias m, tilt along x and y, rad; ``covariance`` (3, 3) of it; ``noise`` robust
    standard deviation of the cells about the plane, m; ``systematic`` RMS of the plane over the cells, m; ``cells``.
    """

    centre: Floats
    plane: Floats
    covariance: Floats
    noise: float
    systematic: float
    cells: int

    def at(self, x: Floats, y: Floats) -> Floats:
        """The plane's height at points."""
        return np.asarray(self.plane[0] + self.plane[1] * (x - self.centre[0]) + self.plane[2] * (y - self.centre[1]))


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
    seen = np.isfinite(difference)
    cells = int(seen.sum())
    if cells < MIN_CELLS:
        return None
    side = max(MIN_BLOCK_SIDE, math.ceil(math.sqrt(cells / BLOCKS)))
    value, weight, bx, by = _blocks(difference, x, y, side)
    if len(value) < MIN_BLOCKS:
        return None
    centre = np.array([np.average(bx, weights=weight), np.average(by, weights=weight)])
    design = np.stack([np.ones_like(bx), bx - centre[0], by - centre[1]], axis=-1)
    plane, covariance = _robust(design, value, weight)
    surface = (plane[0] + plane[1] * (x[None] - centre[0]) + plane[2] * (y[:, None] - centre[1]))[seen]
    noise = mad_sigma(difference[seen] - surface, 0.0)
    return SeamFit(centre, plane, covariance, noise, math.sqrt(float(np.mean(surface**2))), cells)


def _robust(design: Floats, value: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Plane (3,) and its covariance: first by least absolute deviations, which gross errors do not capture."""
    floor = 1e-12 * float(np.abs(value).max(initial=0.0)) + 1e-300
    start = irls(design, value, lambda r: weight / np.maximum(r, 0.01 * mad_sigma(r, 0.0) + floor))
    scale = mad_sigma(value - design @ start, 0.0) + floor
    plane = irls(design, value, lambda r: weight * bisquare(r / (TUKEY_BISQUARE * scale)), start=start)
    residual = value - design @ plane
    u = np.minimum((residual / (TUKEY_BISQUARE * scale)) ** 2, 1.0)
    # Tukey's psi and its derivative: variance of an M-estimate, with three parameters taken from n blocks.
    psi, slope = residual * (1.0 - u) ** 2, (1.0 - u) * (1.0 - 5.0 * u)
    n, shares = len(value), weight / weight.mean()
    variance = float(shares @ psi**2) / max(float(shares @ slope), 1e-12) ** 2 * n**2 / (n - 3)
    return plane, variance * np.linalg.pinv((design * shares[:, None]).T @ design, hermitian=True)


def _blocks(difference: Floats, x: Floats, y: Floats, side: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Median, known share, and mean x and y (n,) of each block of which enough is known."""
    seen = np.isfinite(difference)
    blocks, bx, by = (
        _cut(np.where(seen, a, np.nan), side) for a in (difference, np.broadcast_to(x, seen.shape), y[:, None])
    )
    share = np.isfinite(blocks).mean(axis=-1)
    good = share >= MIN_BLOCK_SHARE
    return np.nanmedian(blocks[good], axis=-1), share[good], *(np.nanmean(b[good], axis=-1) for b in (bx, by))


def _cut(values: Floats, side: int) -> Floats:
    """Blocks (rows, cols, cells) of ``side`` x ``side`` cells; NaN beyond the border."""
    rows, cols = (-(-n // side) for n in values.shape)
    cut = [(0, rows * side - values.shape[0]), (0, cols * side - values.shape[1])]
    padded = np.pad(values, cut, constant_values=np.nan)
    return padded.reshape(rows, side, cols, side).swapaxes(1, 2).reshape(rows, cols, -1)


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
        "systematic": fit.systematic,
        "expected": expected,
        "log_ratio": _log_ratio(grey[0], grey[1], seen),
        "map": {"bounds": common.bounds, "step": step * common.cell},
    }
    return facts, map_


def _log_ratio(grey: Floats, other: Floats, seen: Bools) -> float | None:
    """Median logarithm of the factor between the grey values; None where too few tell."""
    (low, high), good = USABLE_GREY, seen
    for values in (grey, other):
        with np.errstate(invalid="ignore"):
            good = good & (values > low) & (values < high)
    if int(good.sum()) < MIN_CELLS:
        return None
    return float(np.median(np.log(grey[good] / other[good])))


def _coarse(difference: Floats) -> tuple[Floats32, int]:
    """Means of square blocks, so that no side is above :data:`MAP_CELLS`; and the side of a block."""
    step = max(1, math.ceil(max(difference.shape) / MAP_CELLS))
    blocks = _cut(difference, step)
    count = np.isfinite(blocks).sum(axis=-1)
    mean = np.nansum(blocks, axis=-1) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan).astype(np.float32), step


@stage(
    "overlap_qa",
    version=2,
    outputs=[
        replace(
            raster("difference_*", "m", "elevation minus that of the other, block means", frame="world"), optional=True
        )
    ],
)
def overlap_qa_stage(
    params: NoParams, dem: Bundle[DemFacts], others: Sequence[Bundle[DemFacts]]
) -> Bundle[OverlapFacts]:
    """Difference of an elevation model from earlier ones that overlap: bias, tilt and noise apart."""
    arrays, facts = {}, []
    for other in sorted(others, key=lambda b: int(b.meta["pair"])):
        compared = seam(dem, other)
        if compared is not None:
            facts.append(compared[0])
            arrays[f"difference_{compared[0]['other']}"] = compared[1]
    return Bundle(arrays, {"pair": int(dem.meta["pair"]), "seams": facts})
