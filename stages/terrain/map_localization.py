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
from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.facts.terrain import DemFacts, MapFixFacts
from rille.stages.geometry.geometry import RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.robust import huber_weight


class MapLocalizationParams(Params):
    """Parameters of the stage ``map_localization``."""

    reach: float = Field(3.0, gt=0, description="search range to either side of the prior [its standard deviations]")
    sigma_height: float = Field(
        0.15, gt=0, description="standard deviation of a height difference to the global map [its cells]"
    )
    truncation: float = Field(
        3.0, gt=0, description="height difference [standard deviations] beyond which it costs no more: outliers"
    )
    min_overlap: float = Field(0.5, gt=0, le=1, description="least share of the local model that the global map covers")
    min_cells: int = Field(30, ge=6, description="least number of cells of the global map that the local model covers")
    correlation: float = Field(
        2.0, ge=1, description="correlation length of height differences [cells]; larger: larger standard deviations"
    )
    min_chi2_gap: float = Field(
        9.0, gt=0, description="least difference of chi2 to the second best place; below, the answer is ambiguous"
    )


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


@njit(cache=True, nogil=True)
def _height(ground, row, col):  # type: ignore[no-untyped-def]
    r, c = math.floor(row), math.floor(col)
    if r < 0 or c < 0 or r + 1 >= ground.shape[0] or c + 1 >= ground.shape[1]:
        return np.nan, 0.0, 0.0
    u, v = row - r, col - c
    a, b, d, e = ground[r, c], ground[r, c + 1], ground[r + 1, c], ground[r + 1, c + 1]
    value = (1 - u) * ((1 - v) * a + v * b) + u * ((1 - v) * d + v * e)
    return value, (1 - v) * (d - a) + v * (e - b), (1 - u) * (b - a) + u * (e - d)


@njit(cache=True, nogil=True)
def _search(points, ground, frame, places, bound, scores, overlaps):  # type: ignore[no-untyped-def]
    """Truncated mean square of the height differences at each place (heading, y, x), and the share that is known.

    ``frame``: x and y of the ground's first cell and its side, m; ``places``: x, y (m) and headings (rad) tried.
    """
    x0, y0, cell = frame
    xs, ys, headings = places
    n = len(points)
    differences = np.empty(n)
    for h in range(len(headings)):
        c, s = math.cos(headings[h]), math.sin(headings[h])
        for i in range(len(ys)):
            for j in range(len(xs)):
                m = 0
                for k in range(n):
                    x = xs[j] + c * points[k, 0] - s * points[k, 1]
                    y = ys[i] + s * points[k, 0] + c * points[k, 1]
                    value, _, _ = _height(ground, (y0 - y) / cell, (x - x0) / cell)
                    if not math.isnan(value):
                        differences[m] = value - points[k, 2]
                        m += 1
                overlaps[h, i, j] = m / n
                if m < 6:
                    continue
                # The height of the local frame on the map is not known: the median difference takes it out.
                middle = np.median(differences[:m])
                total = 0.0
                # Truncated: a rock that the coarse map does not hold counts no more than the bound.
                for k in range(m):
                    total += min((differences[k] - middle) ** 2, bound * bound)
                scores[h, i, j] = total / m


def fix(
    points: Floats,
    ground: NDArray[np.floating],
    lattice: Lattice,
    prior: tuple[float, float, float],
    prior_sigma: tuple[float, float],
    params: MapLocalizationParams,
) -> Fix:
    """Place the points of a local model on a global map.

    Parameters
    ----------
    points : (n, 3) of :func:`thin`, local frame, m.
    ground, lattice : heights (row, col) of the global map, m, NaN unknown.
    prior : x, y (m) and heading (rad, to the left) of the local frame. ``prior_sigma``: of either.

    Raises
    ------
    DegenerateError
        The local model covers too few cells, or the map is too flat to tell.
    InputError
        Nowhere around the prior the map knows enough of the ground that the local model shows.
    """
    if len(points) < params.min_cells:
        raise DegenerateError(
            "RIL-337",
            f"the local model covers {len(points)} cells of the global map, {params.min_cells} are needed",
            remedy="give a finer global map, or a first pair that sees farther",
        )
    cell = lattice.cell
    sigma = params.sigma_height * cell
    far = float(np.hypot(points[:, 0], points[:, 1]).max())
    # Half a cell, and turns that move the farthest point by one cell: finer steps find no other minimum.
    xs, ys, headings = _steps(prior, prior_sigma, 0.5 * cell, cell / far, params.reach)
    scores = np.full((len(headings), len(ys), len(xs)), np.inf)
    overlaps = np.zeros_like(scores)
    z = np.ascontiguousarray(ground, dtype=np.float64)
    frame = lattice.x0, lattice.y0, cell
    _search(points, z, frame, (xs, ys, headings), params.truncation * sigma, scores, overlaps)
    enough = overlaps >= params.min_overlap
    if not enough.any():
        raise InputError(
            "RIL-338",
            f"the global map knows at most {overlaps.max():.0%} of the ground of the first model around the prior "
            f"({prior[0]:.2f}, {prior[1]:.2f}) m, {params.min_overlap:.0%} are needed",
            remedy="give a map that covers the start, or a better prior",
        )
    scores[~enough] = np.inf
    best = tuple(int(v) for v in np.unravel_index(int(np.argmin(scores)), scores.shape))
    start = np.array([xs[best[2]], ys[best[1]], headings[best[0]], 0.0])
    independent = max(1.0, len(points) / params.correlation**2)
    other = _other(scores, best, (xs, ys, headings), independent / sigma**2)
    return _refine(points, z, lattice, start, params, independent, other)


def _steps(
    prior: tuple[float, float, float], sigma: tuple[float, float], step: float, turn: float, reach: float
) -> tuple[Floats, Floats, Floats]:
    n, m = math.ceil(reach * sigma[0] / step), math.ceil(reach * sigma[1] / turn)
    offsets: Floats = step * np.arange(-n, n + 1, dtype=np.float64)
    turns: Floats = turn * np.arange(-m, m + 1, dtype=np.float64)
    return np.asarray(prior[0] + offsets), np.asarray(prior[1] + offsets), np.asarray(prior[2] + turns)


def _other(
    scores: Floats, best: tuple[int, ...], axes: tuple[Floats, Floats, Floats], weight: float
) -> tuple[Floats, float] | None:
    """The least of the local minima that do not touch the best one's valley, and its chi2 above the best."""
    low = scores == scipy.ndimage.minimum_filter(scores, 3, mode="constant", cval=np.inf)
    # More than three steps: nearer minima belong to the same valley.
    away = np.max(np.abs(np.indices(scores.shape) - np.array(best).reshape(3, 1, 1, 1)), axis=0) > 3
    low &= away & np.isfinite(scores)
    if not low.any():
        return None
    at = np.unravel_index(int(np.argmin(np.where(low, scores, np.inf))), scores.shape)
    where = np.array([axes[0][at[2]], axes[1][at[1]], axes[2][at[0]]])
    return where, float((scores[at] - scores[best]) * weight)


def _refine(
    points: Floats,
    ground: Floats,
    lattice: Lattice,
    start: Floats,
    params: MapLocalizationParams,
    independent: float,
    other: tuple[Floats, float] | None,
) -> Fix:
    """Gauss-Newton on x, y, heading and z with Huber's weights."""
    place = start.copy()
    sigma = params.sigma_height * lattice.cell
    # Height first: Huber's weights would take a wrong one for outliers everywhere.
    place[3] = -float(np.nanmedian(_differences(points, ground, lattice, place)[0]))
    normal, used, weight, r = np.eye(4), np.zeros(len(points), bool), np.ones(0), np.zeros(0)
    for _ in range(20):
        difference, slopes = _differences(points, ground, lattice, place)
        used = np.isfinite(difference)
        r, J = difference[used], slopes[used]
        weight = huber_weight(np.abs(r), params.truncation * sigma / 2.0)
        normal = J.T @ (weight[:, None] * J)
        scale = np.sqrt(np.diag(normal)) + 1e-12
        values = np.linalg.eigvalsh(normal / np.outer(scale, scale))
        if values[0] < 1e-6:
            raise DegenerateError(
                "RIL-339",
                "the global map is too flat around the start to tell the position",
                remedy="hand the pose in, or give a finer map",
            )
        step = -np.linalg.solve(normal, J.T @ (weight * r))
        place = place + step
        if np.abs(step[:2]).max() < 1e-4 * lattice.cell:
            break
    n = int(used.sum())
    rms = float(np.sqrt((weight * r**2).sum() / max(weight.sum(), 1e-12)))
    # By the errors found, and as many independent cells as there are correlation lengths.
    covariance: Floats = np.asarray(np.linalg.inv(normal) * rms**2 * max(1.0, n / independent), dtype=np.float64)
    return Fix(place, covariance, n / len(points), rms, n, other)


def _differences(points: Floats, ground: Floats, lattice: Lattice, place: Floats) -> tuple[Floats, Floats]:
    """Local minus global heights (n,), NaN outside, and their derivatives (n, 4) by x, y, heading and z."""
    c, s = math.cos(place[2]), math.sin(place[2])
    dx, dy = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
    rows, cols = (lattice.y0 - place[1] - dy) / lattice.cell, (place[0] + dx - lattice.x0) / lattice.cell
    value, by_row, by_col = _sample(ground, rows, cols)
    gx, gy = by_col / lattice.cell, -by_row / lattice.cell
    slopes = np.stack([-gx, -gy, gx * dy - gy * dx, np.ones(len(points))], axis=1)
    return points[:, 2] + place[3] - value, slopes


@njit(cache=True, nogil=True)
def _sample(ground, rows, cols):  # type: ignore[no-untyped-def]
    out = np.empty((3, len(rows)))
    for k in range(len(rows)):
        out[0, k], out[1, k], out[2, k] = _height(ground, rows[k], cols[k])
    return out[0], out[1], out[2]


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
        x, y, z, heading = pose
        return Bundle({}, {"T_global_local": _transform(x, y, heading, z), "source": "handed in"})
    assert dem is not None
    assert global_map is not None
    lattice = Lattice.from_dict(global_map.meta["lattice"])
    points = thin(np.asarray(dem["elevation"]), Lattice.from_dict(dem.meta["lattice"]), lattice.cell)
    x, y, heading = prior
    found = fix(
        points, np.asarray(global_map["elevation"]), lattice, (x, y, heading), (prior_sigma[0], prior_sigma[1]), params
    )
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
    ambiguous = found.other is not None and found.other[1] < params.min_chi2_gap
    meta["ambiguous"] = ambiguous
    if found.other is not None and ambiguous:
        ox, oy, _ = found.other[0]
        meta["warnings"] = [
            f"the first pose in the global map is ambiguous: ({ox:.2f}, {oy:.2f}) m fits nearly as well as "
            f"({found.place[0]:.2f}, {found.place[1]:.2f}) m (chi2 larger by {found.other[1]:.1f}, "
            f"{params.min_chi2_gap:g} wanted)"
        ]
    return Bundle({}, meta)
