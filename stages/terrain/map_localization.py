"""Place of an elevation model in a coarser map, found by relief without a start near it.

The model is level, or nearly so: x, y, z, heading and a small tilt place it. It is averaged over blocks as wide as the
map's cells, for single cells would differ from the map by their relief and not by a wrong place.

1. Every place and heading is tried that a coarse version of map and model tells apart. The score is the variance of
   the height differences. With weights w of the model's blocks and k of the map's known cells, all sums over a place
   are correlations of w, w z, w z^2 with k, k h, k h^2 (masked registration: Padfield 2012,
   doi:10.1109/TIP.2011.2181402), which the fast Fourier transform gives for all places of a heading at once.
2. The best places that are no neighbours are each refined on the map itself
   (:mod:`rille.stages.terrain.relief.height_fit`) with Huber's weights. The slopes are those of the model, whose noise
   is less than the map's. The tilt has a prior, ``sigma_tilt_deg``. If the best fit tilts the model much, places are
   sought and refined once more with the model turned by that.
3. Neighbouring differences are correlated, the more so at a wrong place. With r their correlation at a distance of one
   cell, n cells count for n ((1 - r) / (1 + r))^2 independent ones, in the covariance, too. The chi2 by which a place
   is worse than the best one is this number times the logarithm of the ratio of their mean squares, so that no standard
   deviation of the map has to be known.

The given surroundings only bound the answer: the search reaches farther, and names a better place beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.facts.terrain import DemFacts, MapFixFacts
from rille.stages.geometry.geometry import RigidTransform, cross_matrix, from_above, rotation_exp, rotation_log
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.robust import huber_weight
from rille.stages.terrain.relief.grid import Grid
from rille.stages.terrain.relief.height_fit import MIN_EIGENVALUE, FitRules, HeightFit, condition, lay
from rille.stages.terrain.shading import gradient

MIN_CELLS = 30
"""Cells of the map that the model must cover."""
MAX_TRIES, MAX_TRIES_AT_ALL = 3e6, 2e8
"""Headings times cells: beyond the first a coarser version is searched, if there is one; beyond the second none is."""
NEIGHBOURS = 3
"""Steps of the search, within which a place is a neighbour: it belongs to the same valley."""
MIN_CHI2_GAP = 30.0
"""Difference of chi2 to the second best place, below which the answer is ambiguous. Stops of the mockup on seeds 1 to 3
had 148 at least at their right places, 7 at most in the map of another bed; on seeds 4 to 8 64 and 30."""
MIN_EXPLAINED = 0.6
"""Of the relief that is compared, below which a place is in doubt. Stops on seeds 1 and 2 had .80 at least at their
right places, .51 at most in the map of another bed."""


class MapLocalizationParams(Params):
    """Parameters of the stage ``map_localization``.

    Attributes
    ----------
    reach : search range to either side of the prior [its standard deviations].
    sigma_tilt_deg : standard deviation of the model's vertical about each axis [degrees].
    min_overlap : least share of the local model that the global map covers.
    """

    reach: float = Field(3.0, gt=0)
    sigma_tilt_deg: float = Field(0.5, gt=0)
    min_overlap: float = Field(0.5, gt=0, le=1)


@dataclass(frozen=True)
class SearchArea:
    """Searched origins of the model, within ``distance`` of x, y, m, and headings (to the left) within ``turn`` of
    ``heading``, rad."""

    x: float
    y: float
    heading: float = 0.0
    distance: float = math.inf
    turn: float = math.pi


@dataclass(frozen=True)
class Placement:
    """Where a model lies in a map.

    ``pose``: T_map_model; ``covariance`` (6, 6) of its position, m, and rotation, rad, about the map's axes, infinite
    of what is not known. ``by`` what it is known, in words, and ``figures`` on how well it fits. ``doubt``: why the
    place may be wrong, in words: it hardly fits, or another does nearly as well; empty where neither.

    Of elevations the figures are ``overlap``: share of the model that the map knows; ``rms`` of the height differences,
    m; ``explained``: share of the relief (variance of the compared cells about their plane) that they leave out;
    ``cells`` compared, ``independent`` of them; ``other``: x, y, m, of the next best place, by how much its chi2 is
    larger, and by how much it must be; not there where there is one place alone.
    """

    pose: RigidTransform
    covariance: Floats
    by: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    doubt: str = ""


class ModelBlocks(NamedTuple):
    """Means over blocks of a model: ``points`` (n, 3), m, ``normals`` (n, 3) of the ground there, z = 1, NaN unknown;
    ``at`` (n,): number of each in an array of ``shape`` (rows, columns)."""

    points: Floats
    normals: Floats
    at: NDArray[np.int64]
    shape: tuple[int, int]

    @property
    def radius(self) -> float:
        """Distance of the farthest point from the middle, seen from above, m."""
        return float(np.hypot(*(self.points - self.points.mean(axis=0))[:, :2].T).max())


def thin(model: Grid, cell: float) -> ModelBlocks:
    """ModelBlocks of a model, as wide as the cells of a map."""
    points = model.points()[np.isfinite(model.values)]
    # Rows fall with y.
    at = np.floor(points[:, [1, 0]] * [-1.0, 1.0] / cell + 0.5).astype(np.int64)
    at -= at.min(axis=0)
    shape = int(at[:, 0].max()) + 1, int(at[:, 1].max()) + 1
    index = at[:, 0] * shape[1] + at[:, 1]
    count = np.bincount(index, minlength=shape[0] * shape[1])
    full = count >= max(1.0, 0.3 * (cell / model.cell) ** 2)
    sums = (np.bincount(index, values, minlength=len(count)) for values in points.T)
    means = np.stack([total[full] / count[full] for total in sums], axis=1)
    mean = np.full(shape, np.nan)
    mean.reshape(-1)[full] = means[:, 2]
    slopes = gradient(mean, cell).reshape(2, -1)[:, full]
    return ModelBlocks(means, np.stack([*-slopes, np.ones(len(means))], axis=1), np.flatnonzero(full), shape)


def fix(model: Grid, ground: Grid, around: SearchArea | None, params: MapLocalizationParams) -> Placement:
    """Place a level model on a map, both of elevations, m; without a search area, anywhere.

    Raises
    ------
    DegenerateError
        The model covers too few cells, or the map is too flat to tell.
    InputError
        Nowhere within the search the map knows enough of the ground that the model shows, or the search is too wide.
    """
    (x, y), everywhere = ground.outline
    own, radius = model.outline
    everywhere += radius + math.hypot(*own)
    around = around or SearchArea(x, y)
    around = replace(around, distance=min(around.distance, everywhere + math.hypot(x - around.x, y - around.y)))
    area = int(np.isfinite(model.values).sum()) * model.cell**2
    # A map of more cells within the model is averaged first.
    while ground.cell < (1 - 1e-6) * model.cell or area > 10_000 * ground.cell**2:
        ground = ground.halved()
    blocks = thin(model, ground.cell)
    if len(blocks.points) < MIN_CELLS:
        raise DegenerateError(
            "RIL-337",
            f"the model covers {len(blocks.points)} cells of the map, {MIN_CELLS} are needed",
            remedy="give a finer map, or a model of more ground",
        )
    middle, far = blocks.points.mean(axis=0), blocks.radius
    # 20 degrees: by which the search turns farther than the answer may; it reaches farther by the radius of the
    # model.
    wide = replace(around, distance=around.distance + far, turn=min(around.turn + math.radians(20.0), math.pi))
    ground = ground.within((wide.x, wide.y), wide.distance + far + math.hypot(*middle[:2]) + 2.0 * ground.cell)
    coarse = _searchable(ground, area, far, wide)
    fits = _fits(thin(model, coarse.cell), coarse, blocks, ground, wide, params)
    best, other = _best(fits, around, far, NEIGHBOURS * coarse.cell)
    placed = _placed(best, blocks, math.radians(params.sigma_tilt_deg))
    return _against(placed, best, other) if other else placed


def _searchable(ground: Grid, area: float, far: float, around: SearchArea) -> Grid:
    """The map so coarse that it can be searched for a model of an area, m2, and a radius ``far``, m."""
    # Fewer than a hundred cells tell too little.
    while _tries(ground, far, around) > MAX_TRIES and area > 400 * ground.cell**2:
        ground = ground.halved()
    if (tries := _tries(ground, far, around)) > MAX_TRIES_AT_ALL:
        text = f"the map is too large to be searched: {tries:.1g} places and headings, at most {MAX_TRIES_AT_ALL:.0g}"
        raise InputError("RIL-840", text, remedy="name a start, or one that is nearer")
    return ground


def _fits(
    rough: ModelBlocks,
    coarse: Grid,
    blocks: ModelBlocks,
    ground: Grid,
    around: SearchArea,
    params: MapLocalizationParams,
) -> list[HeightFit]:
    """Fits of the model on the map at the best places that the rough model has on the coarse map."""
    middle, near = blocks.points.mean(axis=0), NEIGHBOURS * coarse.cell

    def fits_from(lean: Floats) -> Iterator[HeightFit]:
        """Fits at the best places of the model turned by ``lean`` (3, 3)."""
        for start in _search(rough.points @ lean.T, lean @ middle, coarse, around, params.min_overlap):
            fit = _refined(rough, coarse, start @ RigidTransform(lean, np.zeros(3)), near, params)
            if fit := fit and _refined(blocks, ground, fit.pose, near, params):
                yield fit

    fits = [*fits_from(np.eye(3))]
    # The search takes the model as level. A vertical that is off is so everywhere, and found at wrong places, too.
    first = min(fits, key=lambda fit: fit.square, default=None)
    # 3.0: times the RMS of the differences; where the tilt lifts the edge by less it hides no place.
    if first and np.linalg.norm(rotation_log(first.level)) * blocks.radius > 3.0 * math.sqrt(first.square):
        fits += fits_from(first.level)
    return fits


def _best(fits: list[HeightFit], around: SearchArea, far: float, near: float) -> tuple[HeightFit, HeightFit | None]:
    """The best fit within the search, and the best of those that are no neighbours (``near``, m) of it, if any."""

    def apart(fit: HeightFit, x: float, y: float, heading: float) -> tuple[float, float]:
        """Distances, m, of the origin from a place, and of the farthest points by the turn alone."""
        there = from_above(fit.pose)
        return math.hypot(there[0] - x, there[1] - y), abs(math.remainder(there[2] - heading, 2.0 * math.pi)) * far

    allowed, start_at = (around.distance + near, around.turn * far + near), (around.x, around.y, around.heading)
    inside = [fit for fit in fits if np.all(np.less_equal(apart(fit, *start_at), allowed))]
    best = min(inside, key=lambda fit: fit.square, default=None)
    if best is None or condition(best.normal) < MIN_EIGENVALUE:
        raise DegenerateError(
            "RIL-339",
            "the map or the model is too flat to tell the position, or nothing near the start fits",
            remedy="give a finer map, another start, or a model of more ground",
        )
    # If all of the best starts lead to one place there is no rival: other starts fit worse.
    rivals = [fit for fit in fits if max(apart(fit, *from_above(best.pose))) > near]
    return best, min(rivals, key=lambda fit: fit.square, default=None)


def _tries(ground: Grid, far: float, around: SearchArea) -> float:
    """Number of headings times cells of a search, with those that correlations add."""
    edge = 2.0 * far / ground.cell
    rows, cols = ground.values.shape
    return float((2.0 * around.turn * far / ground.cell + 1.0) * (rows + edge) * (cols + edge))


def _search(
    points: Floats, middle: Floats, ground: Grid, around: SearchArea, min_overlap: float
) -> Iterator[RigidTransform]:
    """Best poses of the model that are no neighbours, the best first; their heights mean nothing."""
    points = points - middle
    # Turns that move the farthest point by one cell: finer steps find no other place.
    step = ground.cell / float(np.hypot(*points[:, :2].T).max())
    count = math.ceil(around.turn / step)
    turns = rotation_exp(
        np.outer(around.heading + step * np.arange(-count, count + 1, dtype=np.float64), [0.0, 0.0, 1.0])
    )
    x, y = np.ascontiguousarray(np.moveaxis(ground.centres(), -1, 0))
    scores = np.full((len(turns), *x.shape), np.inf, np.float32)
    best_overlap = 0.0
    for k, (score, overlap) in enumerate(_scores(points, ground, turns[:, :2, :2])):
        dx, dy, _ = turns[k] @ middle
        inside = np.hypot(x - dx - around.x, y - dy - around.y) <= around.distance + ground.cell
        best_overlap = max(best_overlap, float(np.max(overlap, where=inside, initial=0.0)))
        scores[k] = np.where(inside & (overlap >= min_overlap), score, np.inf)
    if best_overlap < min_overlap:
        raise InputError(
            "RIL-338",
            f"the map knows at most {best_overlap:.0%} of the ground of the model around ({around.x:.2f}, "
            f"{around.y:.2f}) m, {min_overlap:.0%} are needed",
            remedy="give a map that covers the start, or a better start",
        )
    for _ in range(8):
        at = np.unravel_index(int(np.argmin(scores)), scores.shape)
        if not np.isfinite(scores[at]):
            return
        turn = turns[at[0]]
        yield RigidTransform(turn, np.array([x[at[1:]], y[at[1:]], 0.0]) - turn @ middle)
        scores[tuple(slice(max(k - NEIGHBOURS, 0), k + NEIGHBOURS + 1) for k in at)] = np.inf


def _scores(points: Floats, ground: Grid, turns: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Of each turn (2, 2): variance (row, col), m2, of the differences, with the middle of the model at each cell, and
    the share of the model that the map knows there."""
    far = math.ceil(float(np.hypot(*points[:, :2].T).max()) / ground.cell) + 1
    side, (rows, cols) = 2 * far + 1, ground.values.shape
    known = np.isfinite(ground.values)
    # Less their mean, since squares of heights above the sea would leave no digits for the relief.
    mean = np.sum(ground.values, where=known) / max(known.sum(), 1)
    heights = np.where(known, ground.values - mean, 0.0)
    shape = [scipy.fft.next_fast_len(n + 2 * far, real=True) for n in (rows, cols)]
    maps = np.zeros((3, *shape))
    maps[:, far : far + rows, far : far + cols] = known, heights, heights**2
    k, h, hh = scipy.fft.rfft2(maps)
    for turn in turns:
        col, row = far + np.rint(np.linalg.solve(ground.matrix[:, :2], turn) @ points[:, :2].T).astype(int)
        at = row * side + col
        count = np.bincount(at, minlength=side * side)
        z = np.bincount(at, points[:, 2], side * side) / np.maximum(count, 1)
        model = np.stack([count > 0, z, z * z]).reshape(3, side, side)
        # Conjugates: correlations, not convolutions.
        w, wz, wzz = np.conj(scipy.fft.rfft2(model, shape))
        products = np.stack([k * w, h * w - k * wz, hh * w - 2 * h * wz + k * wzz])
        n, d, dd = scipy.fft.irfft2(products, shape)[:, :rows, :cols]
        overlap, n = n / model[0].sum(), np.maximum(n, 1.0)
        yield np.maximum((dd - d * d / n) / n, 0.0), overlap


def _refined(
    blocks: ModelBlocks, ground: Grid, start: RigidTransform, near: float, params: MapLocalizationParams
) -> HeightFit | None:
    """The model laid on the map, no farther than ``near``, m, away; None where it leaves the map at once."""
    rules = FitRules(
        least=max(0.5 * params.min_overlap * len(blocks.points), MIN_CELLS / 2),
        weigh=lambda r, sigma: huber_weight(np.abs(r), 1.5 * sigma),
        sigma_tilt=math.radians(params.sigma_tilt_deg),
        near=near,
    )
    return lay(blocks.points, blocks.normals, ground, start, rules)


def _placed(best: HeightFit, blocks: ModelBlocks, sigma_tilt: float) -> Placement:
    """The best fit as the pose of the model's origin, with its covariance."""
    cells = int(np.isfinite(best.differences).sum())
    differences = np.full(blocks.shape, np.nan)
    differences.reshape(-1)[blocks.at] = best.differences
    independent = independent_cells(differences)
    information = best.normal * independent / (cells * max(best.square, 1e-24))
    information += np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]) / sigma_tilt**2
    lever = np.eye(6)
    lever[:3, 3:] = cross_matrix(best.centre - best.pose.translation)
    compared = blocks.points[np.isfinite(best.differences)]
    design = np.column_stack([compared[:, :2] - compared[0, :2], np.ones(len(compared))])
    relief = compared[:, 2] - design @ np.linalg.lstsq(design, compared[:, 2], rcond=None)[0]
    explained = 1.0 - best.square / max(float(np.mean(relief**2)), 1e-24)
    doubt = ""
    if explained < MIN_EXPLAINED:
        doubt = f"the best place explains {max(explained, 0):.0%} of the relief, {MIN_EXPLAINED:.0%} are wanted"
    figures = {
        "overlap": cells / len(blocks.points),
        "rms": math.sqrt(best.square),
        "explained": explained,
        "cells": cells,
        "independent": independent,
    }
    covariance = lever @ np.linalg.inv(information) @ lever.T
    return Placement(best.pose, covariance, f"relief, {cells} cells", figures, doubt)


def _against(placed: Placement, best: HeightFit, other: HeightFit) -> Placement:
    """The placement with the next best place, and with a doubt if that fits nearly as well."""
    chi2 = placed.figures["independent"] * math.log(max(other.square, 1e-24) / max(best.square, 1e-24))
    (x, y, _), (ox, oy, _), doubt = best.pose.translation, other.pose.translation, placed.doubt
    if not doubt and chi2 < MIN_CHI2_GAP:
        fits = "fits better than" if chi2 < 0.0 else "fits nearly as well as"
        how = f"chi2 larger by {chi2:.1f}, {MIN_CHI2_GAP:g} wanted"
        doubt = f"({ox:.2f}, {oy:.2f}) m {fits} ({x:.2f}, {y:.2f}) m ({how})"
    rival = {"x_m": float(ox), "y_m": float(oy), "chi2": chi2, "wanted": MIN_CHI2_GAP}
    return replace(placed, figures={**placed.figures, "other": rival}, doubt=doubt)


def independent_cells(field: Floats) -> float:
    """Number of independent values of a field (row, col), NaN unknown: by the correlation of neighbours."""
    field = field - np.nanmean(field)
    products = np.concatenate([(field[1:] * field[:-1]).ravel(), (field[:, 1:] * field[:, :-1]).ravel()])
    products, square = products[np.isfinite(products)], float(np.nanmean(field**2))
    alike = float(products.mean()) / max(square, 1e-30) if products.size else 0.0
    alike = min(max(alike, 0.0), 0.95)
    return float(np.isfinite(field).sum()) * ((1.0 - alike) / (1.0 + alike)) ** 2


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
        known = RigidTransform(rotation_exp([0.0, 0.0, pose[3]]), np.array(pose[:3], dtype=np.float64))
        return Bundle({}, {"T_global_local": known.to_list(), "source": "handed in"})
    assert dem is not None
    assert global_map is not None
    model, ground = (
        Grid.on(Lattice.from_dict(one.meta["lattice"]), np.asarray(one["elevation"])) for one in (dem, global_map)
    )
    around = SearchArea(*prior, *(params.reach * sigma for sigma in prior_sigma))
    placed = fix(model, ground, around, params)
    meta: MapFixFacts = {
        "T_global_local": placed.pose.to_list(),
        "source": "aligned to the global map",
        "std": np.sqrt(np.diag(placed.covariance)).tolist(),
        "fit": dict(placed.figures),
    }
    if placed.doubt:
        meta["warnings"] = [f"the first pose in the global map is ambiguous: {placed.doubt}"]
    return Bundle({}, meta)
