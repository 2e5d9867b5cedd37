"""A first pose in a global map: the first local elevation model laid on a coarse global one (section 5.1).

The local model is level (stage ``ground_frame``), so four numbers place it: x, y, heading and z. Around a rough prior
of the first three every placement is tried whose steps the coarse cells resolve; z is the median difference at each.
The score is the mean truncated square of the differences in units of their expected error, over the cells that
overlap. The best placement is refined by Gauss-Newton on the slopes of the global map; its covariance is that of the
adjustment, with the errors that the differences show and one independent cell a correlation length. The next best
placement that is no neighbour tells how ambiguous the answer is. The prior bounds the search and decides nothing
else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.facts.terrain import DemFacts, MapFixFacts
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.robust import huber_weight

TRUNCATION_SIGMAS = 3.0
"""Height difference beyond which it costs no more: outliers."""
MIN_CELLS = 30
"""Cells of the global map that the local model must cover."""
CORRELATION_CELLS = 2.0
"""Correlation length of height differences."""
MIN_CHI2_GAP = 9.0
"""Difference of chi2 to the second best place, below which the answer is ambiguous."""
SLOPE_STEP = 1e-3
"""Of a cell: half the way that slopes are taken over."""
MIN_KNOWN = 6
"""Points that the map must know for a place to be compared."""
MIN_EIGENVALUE = 1e-6
"""Of the normal matrix scaled to a diagonal of ones: below, something is not determined."""
MAX_ROUNDS = 20


class MapLocalizationParams(Params):
    """Parameters of the stage ``map_localization``."""

    reach: float = Field(3.0, gt=0, description="search range to either side of the prior [its standard deviations]")
    sigma_height: float = Field(
        0.15, gt=0, description="standard deviation of a height difference to the global map [its cells]"
    )
    min_overlap: float = Field(0.5, gt=0, le=1, description="least share of the local model that the global map covers")


@dataclass(frozen=True)
class Prior:
    """Rough place of the local frame: x, y (m) and heading (rad, to the left), with standard deviations."""

    x: float
    y: float
    heading: float
    sigma: float
    sigma_heading: float


@dataclass(frozen=True)
class Fix:
    """``place`` x, y (m), heading (rad), z (m) of the local frame; ``covariance`` (4, 4) of them.

    ``overlap`` share; ``other``: the next best placement (x, y, heading) and by how much its chi2 is larger, None where
    the search has only one minimum.
    """

    place: Floats
    covariance: Floats
    overlap: float
    rms: float
    cells: int
    other: tuple[Floats, float] | None


def thin(elevation: NDArray[np.floating], lattice: Lattice, cell: float) -> Floats:
    """Points (n, 3) of a model, m: means over blocks as wide as the global map's cells."""
    z = np.asarray(elevation, np.float64)
    xy = lattice.xy()
    known = np.isfinite(z)
    # Means as coarse as the map: single cells would differ from it by their relief, not by a wrong place.
    block = np.floor(xy[known] / cell + 0.5).astype(np.int64)
    _, index = np.unique(block, axis=0, return_inverse=True)
    index = index.reshape(-1)
    count = np.bincount(index)
    sums = [np.bincount(index, values) for values in (xy[known][:, 0], xy[known][:, 1], z[known])]
    full = count >= 0.3 * (cell / lattice.cell) ** 2
    return np.stack([s / count for s in sums], axis=1)[full]


@dataclass(frozen=True)
class GlobalMap:
    """Heights (row, col) on ``lattice``, m, NaN unknown, bilinear between the cells' centres."""

    heights: Floats
    lattice: Lattice

    def at(self, x: Floats, y: Floats) -> Floats:
        """Height (...), m, at x, y (...), m; NaN outside and beside unknown cells."""
        rows, cols = (self.lattice.y0 - y) / self.lattice.cell, (x - self.lattice.x0) / self.lattice.cell
        return np.asarray(scipy.ndimage.map_coordinates(self.heights, [rows, cols], order=1, cval=np.nan))

    def slopes(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Slopes along x and y within the bilinear cells."""
        step = SLOPE_STEP * self.lattice.cell
        return (
            (self.at(x + step, y) - self.at(x - step, y)) / (2.0 * step),
            (self.at(x, y + step) - self.at(x, y - step)) / (2.0 * step),
        )


def _turned(points: Floats, heading: float) -> tuple[Floats, Floats]:
    """x and y (n,) of points, turned to the left by a heading."""
    c, s = math.cos(heading), math.sin(heading)
    return c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]


def _scores(points: Floats, ground: GlobalMap, axes: Sequence[Floats], bound: float) -> tuple[Floats, Floats]:
    """Truncated mean square of the height differences at each place (heading, y, x), and the share that is known.

    ``axes``: headings, y and x that are tried.
    """
    scores, overlaps = np.full((2, *(len(axis) for axis in axes)), np.inf)
    for h, heading in enumerate(axes[0]):
        dx, dy = _turned(points, heading)
        for i, y in enumerate(axes[1]):
            x, y_all = np.broadcast_arrays(axes[2][:, None] + dx, y + dy)
            # NaN is sorted last. The height of the local frame on the map is not known: the median takes it out.
            differences = np.sort(ground.at(x, y_all) - points[:, 2], axis=1)
            count = np.isfinite(differences).sum(axis=1)
            halves = np.maximum(np.stack([count - 1, count], axis=1) // 2, 0) % len(points)
            middle = np.take_along_axis(differences, halves, axis=1).mean(axis=1)
            # Truncated: a rock that the coarse map does not hold counts no more than the bound.
            off = np.minimum((differences - middle[:, None]) ** 2, bound**2)
            overlaps[h, i] = count / len(points)
            scores[h, i] = np.where(count >= MIN_KNOWN, np.nansum(off, axis=1) / np.maximum(count, 1), np.inf)
    return scores, overlaps


def fix(points: Floats, ground: GlobalMap, prior: Prior, params: MapLocalizationParams) -> Fix:
    """Place the points of a local model on a global map.

    Parameters
    ----------
    points : (n, 3) of :func:`thin`, local frame, m.
    Raises
    ------
    DegenerateError
        The local model covers too few cells, or the map is too flat to tell.
    InputError
        Nowhere around the prior the map knows enough of the ground that the local model shows.
    """
    if len(points) < MIN_CELLS:
        raise DegenerateError(
            "RIL-337",
            f"the local model covers {len(points)} cells of the global map, {MIN_CELLS} are needed",
            remedy="give a finer global map, or a first pair that sees farther",
        )
    cell = ground.lattice.cell
    sigma = params.sigma_height * cell
    far = float(np.hypot(points[:, 0], points[:, 1]).max())
    # Half a cell, and turns that move the farthest point by one cell: finer steps find no other minimum.
    shifts = _around(params.reach * prior.sigma, 0.5 * cell)
    turns = _around(params.reach * prior.sigma_heading, cell / far)
    axes = prior.heading + turns, prior.y + shifts, prior.x + shifts
    scores, overlaps = _scores(points, ground, axes, TRUNCATION_SIGMAS * sigma)
    enough = overlaps >= params.min_overlap
    if not enough.any():
        raise InputError(
            "RIL-338",
            f"the global map knows at most {overlaps.max():.0%} of the ground of the first model around the prior "
            f"({prior.x:.2f}, {prior.y:.2f}) m, {params.min_overlap:.0%} are needed",
            remedy="give a map that covers the start, or a better prior",
        )
    scores[~enough] = np.inf
    independent = max(1.0, len(points) / CORRELATION_CELLS**2)
    found = _refined(points, ground, _place(axes, int(np.argmin(scores))), params)
    # By the errors found, and as many independent cells as there are correlation lengths.
    covariance = found.covariance * max(1.0, found.cells / independent)
    return replace(found, covariance=covariance, other=_other(scores, axes, independent / sigma**2))


def _around(reach: float, step: float) -> Floats:
    """Multiples of a step up to a reach to either side."""
    n = math.ceil(reach / step)
    return np.asarray(step * np.arange(-n, n + 1, dtype=np.float64))


def _place(axes: Sequence[Floats], index: int) -> Floats:
    """x, y and heading of a place, by its number among the scores."""
    at = np.unravel_index(index, [len(axis) for axis in axes])
    return np.array([axis[k] for axis, k in zip(axes, at, strict=True)][::-1])


def _other(scores: Floats, axes: Sequence[Floats], weight: float) -> tuple[Floats, float] | None:
    """The least of the local minima that do not touch the best one's valley, and its chi2 above the best."""
    best = np.unravel_index(int(np.argmin(scores)), scores.shape)
    low = scores == scipy.ndimage.minimum_filter(scores, 3, mode="constant", cval=np.inf)
    # Farther off than three steps: nearer minima belong to the same valley.
    away = np.max(np.abs(np.indices(scores.shape) - np.reshape(best, (3, 1, 1, 1))), axis=0) > 3
    low &= away & np.isfinite(scores)
    if not low.any():
        return None
    number = int(np.argmin(np.where(low, scores, np.inf)))
    return _place(axes, number), float((scores.flat[number] - scores[best]) * weight)


def _refined(points: Floats, ground: GlobalMap, start: Floats, params: MapLocalizationParams) -> Fix:
    """Gauss-Newton on x, y, heading and z with Huber's weights; the covariance is that of independent points."""
    cell = ground.lattice.cell
    bound = TRUNCATION_SIGMAS * params.sigma_height * cell / 2.0
    # Height first: Huber's weights would take a wrong one for outliers everywhere.
    place = np.append(start, 0.0)
    place[3] = -float(np.nanmedian(_differences(points, ground, place)[0]))
    for _ in range(MAX_ROUNDS):
        r, J = _differences(points, ground, place)
        weight = huber_weight(np.abs(r), bound)
        normal = J.T @ (weight[:, None] * J)
        scale = np.sqrt(np.diag(normal)) + 1e-12
        if np.linalg.eigvalsh(normal / np.outer(scale, scale))[0] < MIN_EIGENVALUE:
            raise DegenerateError(
                "RIL-339",
                "the global map is too flat around the start to tell the position",
                remedy="hand the pose in, or give a finer map",
            )
        step = -np.linalg.solve(normal, J.T @ (weight * r))
        place = place + step
        if np.abs(step[:2]).max() < 1e-4 * cell:
            break
    rms = float(np.sqrt((weight * r**2).sum() / max(weight.sum(), 1e-12)))
    return Fix(place, np.linalg.inv(normal) * rms**2, len(r) / len(points), rms, len(r), None)


def _differences(points: Floats, ground: GlobalMap, place: Floats) -> tuple[Floats, Floats]:
    """Local minus global heights (m,) of the points that the map knows, and derivatives (m, 4) by x, y, heading, z."""
    dx, dy = _turned(points, place[2])
    x, y = place[0] + dx, place[1] + dy
    gx, gy = ground.slopes(x, y)
    difference = points[:, 2] + place[3] - ground.at(x, y)
    known = np.isfinite(difference) & np.isfinite(gx) & np.isfinite(gy)
    slopes = np.stack([-gx, -gy, gx * dy - gy * dx, np.ones(len(points))], axis=1)
    return difference[known], slopes[known]


def _transform(x: float, y: float, heading: float, z: float) -> list[float]:
    """T_global_local of a place (m, rad), 12 numbers."""
    return RigidTransform(rotation_exp([0.0, 0.0, heading]), np.array([x, y, z])).to_list()


@stage("map_localization")
def map_localization_stage(
    params: MapLocalizationParams,
    dem: Bundle[DemFacts] | None = None,
    global_map: Bundle | None = None,
    *,
    pose: Sequence[float] | None = None,
    prior: Sequence[float] = (),
    prior_sigma: Sequence[float] = (),
) -> Bundle[MapFixFacts]:
    """First pose in a global map, by aligning the first elevation model or as handed in."""
    if pose is not None:
        x, y, heading, z = (float(pose[k]) for k in (0, 1, 3, 2))
        return Bundle({}, {"T_global_local": _transform(x, y, heading, z), "source": "handed in"})
    assert dem is not None
    assert global_map is not None
    ground = GlobalMap(
        np.asarray(global_map["elevation"], dtype=np.float64), Lattice.from_dict(global_map.meta["lattice"])
    )
    points = thin(np.asarray(dem["elevation"]), Lattice.from_dict(dem.meta["lattice"]), ground.lattice.cell)
    found = fix(points, ground, Prior(*prior, *prior_sigma), params)
    std = np.sqrt(np.diag(found.covariance))
    meta: MapFixFacts = {
        "T_global_local": _transform(*found.place),
        "source": "aligned to the global map",
        "std": [float(v) for v in std],
        "covariance": found.covariance.tolist(),
        "overlap": found.overlap,
        "rms": found.rms,
        "cells": found.cells,
        "other": None if found.other is None else {"place": found.other[0].tolist(), "chi2": found.other[1]},
    }
    ambiguous = found.other is not None and found.other[1] < MIN_CHI2_GAP
    meta["ambiguous"] = ambiguous
    if found.other is not None and ambiguous:
        ox, oy, _ = found.other[0]
        meta["warnings"] = [
            f"the first pose in the global map is ambiguous: ({ox:.2f}, {oy:.2f}) m fits nearly as well as "
            f"({found.place[0]:.2f}, {found.place[1]:.2f}) m (chi2 larger by {found.other[1]:.1f}, "
            f"{MIN_CHI2_GAP:g} wanted)"
        ]
    return Bundle({}, meta)
