"""Where an elevation model lies in a coarser map: by their relief, without a start that is near.

The model is level, or nearly so: x, y, z, heading and a small tilt place it. It is averaged over blocks as wide as the
map's cells, for single cells would differ from the map by their relief and not by a wrong place.

1. Every place and heading is tried that a coarse version of map and model tells apart. The score is the variance of
   the height differences. With weights w of the model's blocks and k of the map's known cells, all sums over a place
   are correlations of w, w z, w z^2 with k, k h, k h^2 (masked registration: Padfield 2012,
   doi:10.1109/TIP.2011.2181402), which the fast Fourier transform gives for all places of a heading at once.
2. The best places that are no neighbours are each refined on the map itself by Gauss-Newton with Huber's weights. The
   slopes are those of the model, whose noise is less than the map's: noise in slopes would count as relief and make the
   covariance too small. The tilt has a prior, ``sigma_tilt_deg``.
3. Neighbouring differences are correlated, the more so at a wrong place. With r their correlation at a distance of one
   cell, n cells count for n ((1 - r) / (1 + r))^2 independent ones, in the covariance, too. The chi2 by which a place
   is worse than the best one is this number times the logarithm of the ratio of their mean squares, so that no standard
   deviation of the map has to be known.

The given surroundings bound the answer and decide nothing else: the search reaches farther, so that a better place
beside them is no secret."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.facts.terrain import DemFacts, MapFixFacts
from rille.stages.geometry.geometry import RigidTransform, cross_matrix, heading_of, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.numeric.robust import huber_weight, mad_sigma
from rille.stages.terrain.shading import gradient

MIN_CELLS = 30
"""Cells of the map that the model must cover."""
MIN_BLOCK_SHARE = 0.3
"""Of a block's area that the model must know."""
MAX_CELLS = 10_000
"""Cells of the map within the model: a finer map is averaged first."""
MIN_SEARCHED_CELLS = 100
"""Cells of the model in the coarsest version that is searched: fewer tell too little."""
MAX_TRIES, MAX_TRIES_AT_ALL = 3e6, 2e8
"""Headings times cells: above, a coarser version is searched where there is one; and what is refused."""
PLACES = 8
"""Best places that are refined."""
NEIGHBOURS = 3
"""Steps of the search, within which a place is a neighbour: it belongs to the same valley."""
MORE_TURN = math.radians(20.0)
"""By which the search turns farther than the answer may; it reaches farther by the radius of the model."""
MIN_CHI2_GAP = 30.0
"""Difference of chi2 to the second best place, below which the answer is ambiguous. Stops of the mockup on seeds 1 to 3
had 148 at least at their right places, 7 at most in the map of another bed; on seeds 4 to 8 64 and 30."""
MIN_EXPLAINED = 0.6
"""Of the relief that is compared, below which a place is in doubt. Stops on seeds 1 and 2 had .80 at least at their
right places, .51 at most in the map of another bed."""
HUBER_SIGMAS = 1.5
MAX_ALIKE = 0.95
"""Correlation of neighbouring differences that is believed at most."""
MIN_EIGENVALUE = 1e-6
"""Of the normal matrix scaled to a diagonal of ones: below, something is not determined."""
MAX_ROUNDS, SETTLED_CELLS = 12, 1e-3
"""Of Gauss-Newton, and the step that ends it."""


class MapLocalizationParams(Params):
    """Parameters of the stage ``map_localization``."""

    reach: float = Field(3.0, gt=0, description="search range to either side of the prior [its standard deviations]")
    sigma_tilt_deg: float = Field(
        0.5, gt=0, description="standard deviation of the model's vertical about each axis [degrees]"
    )
    min_overlap: float = Field(0.5, gt=0, le=1, description="least share of the local model that the global map covers")


@dataclass(frozen=True)
class SearchArea:
    """What is searched: origins of the model within ``distance`` of x, y, m, and headings (to the left) within ``turn``
    of ``heading``, rad."""

    x: float
    y: float
    heading: float
    distance: float
    turn: float

    @property
    def place(self) -> tuple[float, float, float]:
        """x, y and heading of its middle."""
        return self.x, self.y, self.heading


@dataclass(frozen=True)
class Fix:
    """``pose``: T_map_model; ``covariance`` (6, 6) of its position, m, and rotation, rad, about the map's axes.

    ``overlap``: share of the model that the map knows; ``rms`` of the height differences, m; ``explained``: share of
    the relief (variance of the compared cells about their plane) that they leave out; ``cells`` compared,
    ``independent`` of them; ``other``: x, y, heading of the next best place and by how much its chi2 is larger, None
    where there is one place.
    """

    pose: RigidTransform
    covariance: Floats
    overlap: float
    rms: float
    explained: float
    cells: int
    independent: float
    other: tuple[Floats, float] | None = None

    @property
    def doubt(self) -> str:
        """Why the place may be wrong, in words: it hardly fits, or another does nearly as well; empty where neither."""
        if self.explained < MIN_EXPLAINED:
            return f"the best place explains {max(self.explained, 0):.0%} of the relief, {MIN_EXPLAINED:.0%} are wanted"
        if self.other is None or self.other[1] >= MIN_CHI2_GAP:
            return ""
        (ox, oy, _), chi2 = self.other
        x, y, _ = self.pose.translation
        fits = "fits better than" if chi2 < 0.0 else "fits nearly as well as"
        return (
            f"({ox:.2f}, {oy:.2f}) m {fits} ({x:.2f}, {y:.2f}) m (chi2 larger by {chi2:.1f}, {MIN_CHI2_GAP:g} wanted)"
        )

    def facts(self) -> MapFixFacts:
        """The same, as plain values."""
        return {
            "T_global_local": self.pose.to_list(),
            "source": "aligned to the global map",
            "std": np.sqrt(np.diag(self.covariance)).tolist(),
            "covariance": self.covariance.tolist(),
            "overlap": self.overlap,
            "rms": self.rms,
            "explained": self.explained,
            "cells": self.cells,
            "independent": self.independent,
            "other": None if self.other is None else {"place": self.other[0].tolist(), "chi2": self.other[1]},
            "ambiguous": bool(self.doubt),
        }


class ModelBlocks(NamedTuple):
    """Means over blocks of a model: ``points`` (n, 3), m, ``normals`` (n, 3) of the ground there, z = 1, NaN unknown;
    ``at`` (n,): number of each in an array of ``shape`` (rows, columns)."""

    points: Floats
    normals: Floats
    at: NDArray[np.int64]
    shape: tuple[int, int]


def thin(elevation: NDArray[np.floating], lattice: Lattice, cell: float) -> ModelBlocks:
    """ModelBlocks of a model, as wide as the cells of a map."""
    z = np.asarray(elevation, np.float64)
    known = np.isfinite(z)
    row, col = (np.floor(axis / cell + 0.5).astype(np.int64) for axis in (-lattice.ys(), lattice.xs()))
    shape = int(row[-1] - row[0]) + 1, int(col[-1] - col[0]) + 1
    index = ((row - row[0])[:, None] * shape[1] + (col - col[0]))[known]
    count = np.bincount(index, minlength=shape[0] * shape[1])
    full = count >= max(1.0, MIN_BLOCK_SHARE * (cell / lattice.cell) ** 2)
    xyz = (*np.moveaxis(lattice.xy()[known], -1, 0), z[known])
    points = np.stack([np.bincount(index, values, minlength=len(count))[full] / count[full] for values in xyz], axis=1)
    mean = np.full(shape, np.nan)
    mean.reshape(-1)[full] = points[:, 2]
    slopes = gradient(mean, cell).reshape(2, -1)[:, full]
    return ModelBlocks(points, np.stack([*-slopes, np.ones(len(points))], axis=1), np.flatnonzero(full), shape)


@dataclass(frozen=True)
class GlobalMap:
    """Heights (row, col), m, NaN unknown, bilinear between cells, whose centres are at x0 + col * cell,
    y0 - row * cell."""

    heights: Floats
    x0: float
    y0: float
    cell: float

    def at(self, x: Floats, y: Floats) -> Floats:
        """Height (...), m, at x, y (...), m; NaN outside and beside unknown cells."""
        rows, cols = (self.y0 - y) / self.cell, (x - self.x0) / self.cell
        return np.asarray(scipy.ndimage.map_coordinates(self.heights, [rows, cols], order=1, cval=np.nan))

    def halved(self) -> GlobalMap:
        """The same with cells twice as wide, means of those of four cells that are known, two at least."""
        rows, cols = (n // 2 for n in self.heights.shape)
        four = self.heights[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2)
        count = np.isfinite(four).sum(axis=(1, 3))
        mean = np.where(count >= 2, np.nansum(four, axis=(1, 3)) / np.maximum(count, 1), np.nan)
        half = 0.5 * self.cell
        return GlobalMap(mean, self.x0 + half, self.y0 - half, 2.0 * self.cell)

    def within(self, x: float, y: float, distance: float) -> GlobalMap:
        """The part within a distance of a place along either axis; it may be empty."""
        at = np.array([self.y0 - y, x - self.x0])
        (row, col), (last, right) = (
            np.clip(np.rint((at + side * distance) / self.cell), 0, self.heights.shape).astype(int) for side in (-1, 1)
        )
        x0, y0 = self.x0 + float(col) * self.cell, self.y0 - float(row) * self.cell
        return replace(self, heights=self.heights[row:last, col:right], x0=x0, y0=y0)


def fix(
    elevation: NDArray[np.floating],
    lattice: Lattice,
    ground: GlobalMap,
    around: SearchArea,
    params: MapLocalizationParams,
) -> Fix:
    """Place a model (row, col), m, on a map.

    Raises
    ------
    DegenerateError
        The model covers too few cells, or the map is too flat to tell.
    InputError
        Nowhere within the search the map knows enough of the ground that the model shows, or the search is too wide.
    """
    area = int(np.isfinite(elevation).sum()) * lattice.cell**2
    while ground.cell < (1 - 1e-6) * lattice.cell or area > MAX_CELLS * ground.cell**2:
        ground = ground.halved()
    blocks = thin(elevation, lattice, ground.cell)
    if len(blocks.points) < MIN_CELLS:
        raise DegenerateError(
            "RIL-337",
            f"the model covers {len(blocks.points)} cells of the map, {MIN_CELLS} are needed",
            remedy="give a finer map, or a model of more ground",
        )
    middle = blocks.points.mean(axis=0)
    far = float(np.hypot(*(blocks.points - middle)[:, :2].T).max())
    wide = replace(around, distance=around.distance + far, turn=min(around.turn + MORE_TURN, math.pi))
    ground = ground.within(wide.x, wide.y, wide.distance + far + math.hypot(*middle[:2]) + 2.0 * ground.cell)
    coarse = ground
    while _tries(coarse, far, wide) > MAX_TRIES and area > 4 * MIN_SEARCHED_CELLS * coarse.cell**2:
        coarse = coarse.halved()
    if (tries := _tries(coarse, far, wide)) > MAX_TRIES_AT_ALL:
        text = f"the map is too large to be searched: {tries:.1g} places and headings, at most {MAX_TRIES_AT_ALL:.0g}"
        raise InputError("RIL-840", text, remedy="name a start, or one that is nearer")
    rough = thin(elevation, lattice, coarse.cell)
    near, fits = NEIGHBOURS * coarse.cell, list[_Fit]()
    for start in _search(rough.points - middle, coarse, wide, middle, params.min_overlap):
        fit = _refined(rough, coarse, middle, start, near, params)
        fit = fit and _refined(blocks, ground, middle, fit.state, near, params)
        fits += [fit] if fit else []

    def apart(fit: _Fit, place: Floats) -> tuple[float, float]:
        """Distances, m, from a place (x, y, heading) of the origin, and of the farthest points by the turn alone."""
        x, y, turn = fit.place(middle) - place
        return math.hypot(x, y), abs(math.remainder(turn, 2.0 * math.pi)) * far

    allowed = around.distance + near, around.turn * far + near
    inside = [fit for fit in fits if np.all(np.less_equal(apart(fit, np.array(around.place)), allowed))]
    best = min(inside, key=lambda fit: fit.square, default=None)
    if best is None or _condition(best.normal) < MIN_EIGENVALUE:
        raise DegenerateError(
            "RIL-339",
            "the map or the model is too flat to tell the position, or nothing near the start fits",
            remedy="give a finer map, another start, or a model of more ground",
        )
    placed = _placed(best, blocks, middle, math.radians(params.sigma_tilt_deg))
    rivals = [fit for fit in fits if max(apart(fit, best.place(middle))) > near]
    if not rivals:  # all of the best starts led to one place: what is worse than they are is no rival
        return placed
    other = min(rivals, key=lambda fit: fit.square)
    chi2 = placed.independent * math.log(max(other.square, 1e-24) / max(best.square, 1e-24))
    return replace(placed, other=(other.place(middle), chi2))


def level_pose(motion: Floats) -> RigidTransform:
    """Turn and shift of a motion (2, 3) in the plane, as those of space."""
    turn = rotation_exp([0.0, 0.0, math.atan2(motion[1, 0], motion[0, 0])])
    return RigidTransform(turn, np.array([*motion[:, 2], 0.0]))


def fix_on(
    elevation: Floats,
    lattice: Lattice,
    values: Floats,
    matrix: Floats,
    around: SearchArea | None,
    params: MapLocalizationParams,
) -> Fix:
    """Place a level model (row, col), m, on a map whose rows may be turned or mirrored.

    Parameters
    ----------
    values : heights of the map (row, col), m, NaN unknown.
    matrix : (2, 3), from (col, row, 1) of its cell centres to x, y, m; its cells are squares.
    around : what of the map is searched; None: all of it.

    Raises
    ------
    DegenerateError
        The model covers too few cells, or the ground is too flat to tell.
    InputError
        Nowhere within the search the ground is known, or the search is too wide.
    """
    # The search is in a frame along the rows of the map.
    rows, cols = values.shape
    cell = math.sqrt(abs(np.linalg.det(matrix[:, :2])))
    if np.linalg.det(matrix[:, :2]) > 0:
        values, matrix = values[::-1], matrix @ np.array([[1.0, 0.0, 0.0], [0.0, -1.0, rows - 1.0], [0.0, 0.0, 1.0]])
    to_ground = level_pose(matrix)
    middle = 0.5 * cell * (cols - 1), 0.5 * cell * (1 - rows)
    everywhere = math.hypot(*middle) + lattice.radius
    area = SearchArea(*middle, 0.0, everywhere, math.pi)
    if around is not None:
        x, y, _ = to_ground.inverse().apply([around.x, around.y, 0.0])
        distance = min(around.distance, everywhere + math.hypot(middle[0] - x, middle[1] - y))
        area = SearchArea(float(x), float(y), around.heading - heading_of(to_ground), distance, around.turn)
    placed = fix(elevation, lattice, GlobalMap(values, 0.0, 0.0, cell), area, params)
    both, other = np.kron(np.eye(2), to_ground.rotation), placed.other
    if other is not None:
        (x, y, heading), chi2 = other
        other = np.array([*to_ground.apply([x, y, 0.0])[:2], heading + heading_of(to_ground)]), chi2
    return replace(placed, pose=to_ground @ placed.pose, covariance=both @ placed.covariance @ both.T, other=other)


def _tries(ground: GlobalMap, far: float, around: SearchArea) -> float:
    """Headings and cells of a search, with those that correlations add."""
    edge = 2.0 * far / ground.cell
    rows, cols = ground.heights.shape
    return float((2.0 * around.turn * far / ground.cell + 1.0) * (rows + edge) * (cols + edge))


def _search(
    points: Floats, ground: GlobalMap, around: SearchArea, middle: Floats, min_overlap: float
) -> Iterator[Floats]:
    """Best places that are no neighbours, the best first: x, y, z (NaN: not known), two tilts and heading of the
    model's ``middle``."""
    # Turns that move the farthest point by one cell: finer steps find no other place.
    step = ground.cell / float(np.hypot(*points[:, :2].T).max())
    count = math.ceil(around.turn / step)
    headings = around.heading + step * np.arange(-count, count + 1, dtype=np.float64)
    rows, cols = ground.heights.shape
    x, y = ground.x0 + ground.cell * np.arange(cols), ground.y0 - ground.cell * np.arange(rows)
    scores = np.full((len(headings), len(y), len(x)), np.inf, np.float32)
    best_overlap = 0.0
    for k, (score, overlap) in enumerate(_scores(points, ground, headings)):
        dx, dy = _turned(middle[None], headings[k])
        inside = np.hypot(x - dx - around.x, (y - dy - around.y)[:, None]) <= around.distance + ground.cell
        best_overlap = max(best_overlap, float(np.max(overlap, where=inside, initial=0.0)))
        scores[k] = np.where(inside & (overlap >= min_overlap), score, np.inf)
    if best_overlap < min_overlap:
        raise InputError(
            "RIL-338",
            f"the map knows at most {best_overlap:.0%} of the ground of the model around ({around.x:.2f}, "
            f"{around.y:.2f}) m, {min_overlap:.0%} are needed",
            remedy="give a map that covers the start, or a better start",
        )
    for _ in range(PLACES):
        at = np.unravel_index(int(np.argmin(scores)), scores.shape)
        if not np.isfinite(scores[at]):
            return
        yield np.array([x[at[2]], y[at[1]], np.nan, 0.0, 0.0, headings[at[0]]])
        scores[tuple(slice(max(k - NEIGHBOURS, 0), k + NEIGHBOURS + 1) for k in at)] = np.inf


def _turned(points: Floats, heading: float) -> tuple[Floats, Floats]:
    """x and y (n,) of points, turned to the left by a heading."""
    c, s = math.cos(heading), math.sin(heading)
    return c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]


def _scores(points: Floats, ground: GlobalMap, headings: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Of each heading: variance (row, col), m2, of the differences, with the middle of the model at each cell, and the
    share of the model that the map knows there."""
    far = math.ceil(float(np.hypot(*points[:, :2].T).max()) / ground.cell) + 1
    side, (rows, cols) = 2 * far + 1, ground.heights.shape
    known = np.isfinite(ground.heights)
    # Less their mean, since squares of heights above the sea would leave no digits for the relief.
    mean = np.sum(ground.heights, where=known) / max(known.sum(), 1)
    heights = np.where(known, ground.heights - mean, 0.0)
    shape = [scipy.fft.next_fast_len(n + 2 * far, real=True) for n in (rows, cols)]
    maps = np.zeros((3, *shape))
    maps[:, far : far + rows, far : far + cols] = known, heights, heights**2
    k, h, hh = scipy.fft.rfft2(maps)
    for heading in headings:
        x, y = _turned(points, heading)
        at = (far - np.rint(y / ground.cell).astype(int)) * side + far + np.rint(x / ground.cell).astype(int)
        count = np.bincount(at, minlength=side * side)
        z = np.bincount(at, points[:, 2], side * side) / np.maximum(count, 1)
        model = np.stack([count > 0, z, z * z]).reshape(3, side, side)
        # Conjugates: correlations, not convolutions.
        w, wz, wzz = np.conj(scipy.fft.rfft2(model, shape))
        products = np.stack([k * w, h * w - k * wz, hh * w - 2 * h * wz + k * wzz])
        n, d, dd = scipy.fft.irfft2(products, shape)[:, :rows, :cols]
        overlap, n = n / model[0].sum(), np.maximum(n, 1.0)
        yield np.maximum((dd - d * d / n) / n, 0.0), overlap


class _Fit(NamedTuple):
    """``state``: x, y, z, two tilts and heading of the middle; mean ``square`` of the differences, m2; the differences
    (n,), NaN unknown, and the normal matrix (6, 6) of their weighted slopes."""

    state: Floats
    square: float
    differences: Floats
    normal: Floats

    def place(self, middle: Floats) -> Floats:
        """x, y and heading of the model's origin."""
        return np.array([*(self.state[:2] - np.ravel(_turned(middle[None], self.state[5]))), self.state[5]])


def _rotation(state: Floats) -> Floats:
    return np.asarray(rotation_exp([*state[3:5], 0.0]) @ rotation_exp([0.0, 0.0, state[5]]))


def _condition(normal: Floats) -> float:
    """Least eigenvalue of a normal matrix scaled to a diagonal of ones."""
    scale = np.sqrt(np.diag(normal)) + 1e-12
    return float(np.linalg.eigvalsh(normal / np.outer(scale, scale))[0])


def _refined(
    blocks: ModelBlocks, ground: GlobalMap, middle: Floats, start: Floats, near: float, params: MapLocalizationParams
) -> _Fit | None:
    """Gauss-Newton with Huber's weights, no farther than ``near``, m; None where the model leaves the map at once."""
    state, tilt, fit = start.copy(), math.radians(params.sigma_tilt_deg), None
    for _ in range(MAX_ROUNDS):
        turn = _rotation(state)
        q, normals = (blocks.points - middle) @ turn.T, blocks.normals @ turn.T
        above = q[:, 2] - ground.at(state[0] + q[:, 0], state[1] + q[:, 1])
        known = np.isfinite(above) & np.isfinite(normals[:, 2])
        if known.sum() < max(0.5 * params.min_overlap * len(above), MIN_CELLS / 2):
            return fit
        state[2] = -np.median(above[known]) if np.isnan(state[2]) else state[2]
        r, n = (above + state[2])[known], normals[known] / normals[known][:, 2:]
        J = np.concatenate([n, np.cross(q[known], n)], axis=1)
        sigma = max(mad_sigma(r), 1e-12)
        weight = huber_weight(np.abs(r), HUBER_SIGMAS * sigma)
        normal = J.T @ (weight[:, None] * J)
        fit = _Fit(state, float((weight * r**2).sum() / weight.sum()), np.full(len(above), np.nan), normal)
        fit.differences[known] = r
        prior = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]) * (sigma / tilt) ** 2
        if _condition(normal + prior) < MIN_EIGENVALUE:
            return fit
        step = -np.linalg.solve(normal + prior, J.T @ (weight * r) + prior @ state)
        # At most a cell: farther, the slopes are others.
        size = float(np.abs(step[:2]).max()) / ground.cell
        state = state + step / max(size, 1.0)
        if size < SETTLED_CELLS or math.hypot(*(state - start)[:2]) > near:
            break
    return fit


def _placed(best: _Fit, blocks: ModelBlocks, middle: Floats, sigma_tilt: float) -> Fix:
    """The best fit as the pose of the model's origin, with its covariance."""
    cells = int(np.isfinite(best.differences).sum())
    field = np.full(blocks.shape, np.nan)
    field.reshape(-1)[blocks.at] = best.differences
    independent = independent_cells(field)
    turn = _rotation(best.state)
    information = best.normal * independent / (cells * max(best.square, 1e-24))
    information += np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]) / sigma_tilt**2
    lever = np.eye(6)
    lever[:3, 3:] = cross_matrix(turn @ middle)
    compared = blocks.points[np.isfinite(best.differences)]
    design = np.column_stack([compared[:, :2] - middle[:2], np.ones(len(compared))])
    relief = compared[:, 2] - design @ np.linalg.lstsq(design, compared[:, 2], rcond=None)[0]
    return Fix(
        RigidTransform(turn, best.state[:3] - turn @ middle),
        lever @ np.linalg.inv(information) @ lever.T,
        cells / len(blocks.points),
        math.sqrt(best.square),
        1.0 - best.square / max(float(np.mean(relief**2)), 1e-24),
        cells,
        independent,
    )


def independent_cells(field: Floats) -> float:
    """Number of independent values of a field (row, col), NaN unknown: by the correlation of neighbours."""
    field = field - np.nanmean(field)
    products = np.concatenate([(field[1:] * field[:-1]).ravel(), (field[:, 1:] * field[:, :-1]).ravel()])
    products, square = products[np.isfinite(products)], float(np.nanmean(field**2))
    alike = float(products.mean()) / max(square, 1e-30) if products.size else 0.0
    alike = min(max(alike, 0.0), MAX_ALIKE)
    return float(np.isfinite(field).sum()) * ((1.0 - alike) / (1.0 + alike)) ** 2


@stage("map_localization", version=2)
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
    lattice = Lattice.from_dict(global_map.meta["lattice"])
    ground = GlobalMap(np.asarray(global_map["elevation"], np.float64), lattice.x0, lattice.y0, lattice.cell)
    around = SearchArea(*prior, *(params.reach * sigma for sigma in prior_sigma))
    placed = fix(np.asarray(dem["elevation"]), Lattice.from_dict(dem.meta["lattice"]), ground, around, params)
    meta = placed.facts()
    if placed.doubt:
        meta["warnings"] = [f"the first pose in the global map is ambiguous: {placed.doubt}"]
    return Bundle({}, meta)
