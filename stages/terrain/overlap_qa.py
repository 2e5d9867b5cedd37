"""Overlap of two elevation models: what of their difference is systematic, and what is noise, with an honest sigma.

The difference of a model from each earlier one that saw the same ground has three parts: a bias and a tilt about two
axes, which come from the poses (or the rig); and noise, which comes from the matching and is compared with what both
models' own standard deviations let expect. The factor between both models' grey values is a by-product
(:mod:`rille.stages.terrain.radiometry`).

Matching errors are alike over several cells, so the cells of an overlap are far fewer observations than their number.
The plane is fitted to medians of blocks of cells (Tukey's biweight, started from least absolute deviations), and its
covariance is taken from what the blocks scatter, neighbouring blocks together, not from any stated sigma:

    cov = A^-1 B A^-1,   A = sum psi'(r_i) x_i x_i',   B = sum_ij k(i, j) psi(r_i) psi(r_j) x_i x_j'

with a triangular kernel k over the distance of two blocks (Conley 1999, doi:10.1016/S0304-4076(98)00084-0).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rille.stages.core.arrays import Bools, Floats, Floats32
from rille.stages.core.declare import Array, Bundle, NoParams, stage
from rille.stages.facts.terrain import DemFacts, OverlapFacts
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, mad_sigma

BLOCKS = 400
"""Approximate number of blocks of an overlap: enough to find the plane's standard deviation to 5 %."""
LEAST_BLOCKS = 12
"""Fewest blocks from which three parameters and their errors are estimated."""
LEAST_CELLS = 100
MANY_BLOCKS = 36
"""Blocks that must be left for them to be made larger."""
ALIKE = 0.2
"""Correlation of neighbouring blocks above which they are made larger, until each stands for itself."""
REACH = 2
"""Distance [blocks] up to which errors of blocks may be correlated."""
ROUNDS = 20

MAP_CELLS = 160
"""Longest side of a stored map of differences; cells of larger ones are averaged."""
GREY = (8.0, 247.0)
"""Grey values that tell an exposure: darker ones are noise, brighter ones saturated."""


@dataclass(frozen=True)
class SeamFit:
    """Plane ``bias + tilt . (xy - centre)`` in a difference of elevations, and what is left.

    ``centre`` (2,) m; ``plane`` (3,): bias m, tilt along x and y, rad; ``covariance`` (3, 3) of it; ``noise`` robust
    standard deviation of the cells about the plane, m; ``structure`` the same of the blocks' medians; ``systematic``
    RMS of the plane over the cells, m; ``cells``.
    """

    centre: Floats
    plane: Floats
    covariance: Floats
    noise: float
    structure: float
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
    if cells < LEAST_CELLS:
        return None
    side = max(3, math.ceil(math.sqrt(cells / BLOCKS)))
    fit, like = _fit(difference, x, y, side, cells, LEAST_BLOCKS)
    # Blocks that err like their neighbours tell less than their number: larger ones, until they do not.
    while fit is not None and like > ALIKE:
        side *= 2
        coarser, like = _fit(difference, x, y, side, cells, MANY_BLOCKS)
        if coarser is None:
            break
        fit = coarser
    if fit is None:
        return None
    surface = fit.at(x[None], y[:, None])[seen]
    left = np.abs(difference[seen] - surface)
    noise, systematic = mad_sigma(left, 0.0), math.sqrt(float(np.mean(surface**2)))
    return replace(fit, noise=noise, systematic=systematic)


def _fit(difference: Floats, x: Floats, y: Floats, side: int, cells: int, least: int) -> tuple[SeamFit | None, float]:
    """Plane by blocks of ``side`` cells, None of less than ``least``; and how alike neighbours' residuals are."""
    value, weight, bx, by = _blocks(difference, x, y, side)
    there = weight > 0
    if int(there.sum()) < least:
        return None, 0.0
    centre = np.array([np.average(v[there], weights=weight[there]) for v in (bx, by)])
    design = np.stack([np.ones_like(bx), bx - centre[0], by - centre[1]], axis=-1)
    design[~there] = 0.0
    plane, residual, scale = _robust(design, np.where(there, value, 0.0), weight)
    covariance = _covariance(design, residual, weight, scale)
    return SeamFit(centre, plane, covariance, 0.0, scale, 0.0, cells), _alike(residual, there, scale)


def _alike(residual: Floats, there: Bools, scale: float) -> float:
    """Correlation of neighbouring blocks' residuals, gross ones cut off."""
    if scale <= 0:
        return 0.0
    r = np.where(there, np.clip(residual, -3 * scale, 3 * scale), 0.0)
    products = float((r[1:] * r[:-1]).sum() + (r[:, 1:] * r[:, :-1]).sum())
    pairs = int((there[1:] & there[:-1]).sum() + (there[:, 1:] & there[:, :-1]).sum())
    return products / max(pairs, 1) / float((r[there] ** 2).mean())


def _blocks(difference: Floats, x: Floats, y: Floats, side: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Median, weight (share of cells that are defined; 0 below a quarter), mean x and y of each block."""
    rows, cols = (-(-n // side) for n in difference.shape)
    cut = [(0, rows * side - difference.shape[0]), (0, cols * side - difference.shape[1])]
    padded = np.pad(difference, cut, constant_values=np.nan)
    blocks = padded.reshape(rows, side, cols, side).swapaxes(1, 2).reshape(rows, cols, -1)
    seen = np.isfinite(blocks)
    share = seen.mean(axis=-1)
    weight = np.where(share >= 0.25, share, 0.0)
    value = np.zeros(share.shape)
    value[weight > 0] = np.nanmedian(blocks[weight > 0], axis=-1)
    count = np.maximum(seen.sum(axis=-1), 1)
    square = seen.reshape(rows, cols, side, side)
    px = np.pad(x, cut[1], mode="edge").reshape(cols, side)
    py = np.pad(y, cut[0], mode="edge").reshape(rows, side)
    bx = np.einsum("rcij,cj->rc", square, px) / count
    by = np.einsum("rcij,ri->rc", square, py) / count
    return value, weight, bx, by


def _robust(design: Floats, value: Floats, weight: Floats) -> tuple[Floats, Floats, float]:
    """Plane, residuals and their robust scale."""
    plane = _solve(design, value, weight)
    scale = 0.0
    for turn in range(ROUNDS):
        residual = value - design @ plane
        size = np.abs(residual)
        scale = mad_sigma(size[weight > 0], 0.0)
        if scale <= 1e-12 * float(np.abs(value).max()):
            break
        # First least absolute deviations, which gross errors do not capture; then the biweight, which forgets them.
        absolute = 1.0 / np.maximum(size, 0.01 * scale)
        biweight = bisquare(residual / (TUKEY_BISQUARE * scale))
        plane = _solve(design, value, weight * (absolute if turn < ROUNDS // 2 else biweight))
    residual = value - design @ plane
    return plane, residual, mad_sigma(residual[weight > 0], 0.0)


def _solve(design: Floats, value: Floats, weight: Floats) -> Floats:
    root = np.sqrt(weight)
    a, b = (design * root[..., None]).reshape(-1, 3), (value * root).ravel()
    return np.asarray(np.linalg.lstsq(a, b, rcond=None)[0])


def _covariance(design: Floats, residual: Floats, weight: Floats, scale: float) -> Floats:
    """Covariance of the plane from the scatter of the blocks, those nearby taken together."""
    if scale <= 0:
        return np.zeros((3, 3))
    u = np.clip((residual / (TUKEY_BISQUARE * scale)) ** 2, 0.0, 1.0)
    # Derivative of Tukey's psi, and psi: bread and meat of the covariance of an M-estimate.
    slope, psi = (1.0 - u) * (1.0 - 5.0 * u), residual * (1.0 - u) ** 2
    bread = np.einsum("rc,rci,rcj->ij", weight * slope, design, design)
    score = design * (weight * psi)[..., None]
    inverse = np.linalg.pinv(bread, hermitian=True)
    n = int((weight > 0).sum())
    found = [inverse @ meat @ inverse * n / (n - 3) for meat in (_meat(score, 0), _meat(score, REACH))]
    # Products of neighbours may sum to less than none by chance: never less than independent blocks give.
    return max(found, key=lambda cov: float(np.trace(cov @ bread)))


def _meat(score: Floats, reach: int) -> Floats:
    """Sum over pairs of blocks of their scores' products, weighted by a triangle of their distance."""
    spread = score
    for axis in (0, 1):
        padded = np.pad(spread, [(reach, reach) if a == axis else (0, 0) for a in range(3)])
        n = score.shape[axis]
        spread = sum(
            (1.0 - abs(k) / (reach + 1)) * np.take(padded, np.arange(reach + k, reach + k + n), axis=axis)
            for k in range(-reach, reach + 1)
        )  # type: ignore[assignment]
    product = np.einsum("rci,rcj->ij", score, spread)
    return np.asarray(0.5 * (product + product.T))


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


@stage(
    "overlap_qa",
    outputs=[
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
    ],
)
def overlap_qa_stage(
    params: NoParams, dem: Bundle[DemFacts], others: Sequence[Bundle[DemFacts]]
) -> Bundle[OverlapFacts]:
    """Difference of an elevation model from earlier ones that overlap: bias, tilt and noise apart."""
    arrays, facts = {}, []
    for other in sorted(others, key=lambda b: int(b.meta["pair"])):
        found = seam(dem, other)
        if found is not None:
            facts.append(found[0])
            arrays[f"difference_{found[0]['other']}"] = found[1]
    return Bundle(arrays, {"pair": int(dem.meta["pair"]), "seams": facts})
