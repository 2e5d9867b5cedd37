"""One elevation model against another: brought to common cells, aligned if asked, errors by range and slope.

The error is A minus the reference B. NMAD = 1.4826 median(|e - median(e)|) is the robust standard deviation (Hoehle and
Hoehle 2009, doi:10.1016/j.isprsjprs.2009.02.003). Alignment minimises the differences of elevation by Gauss-Newton with
Tukey's biweight: with n = (-gx, -gy, 1) of B's gradient, a small motion (t, w) of A's point q changes its difference by
n . t + (q x n) . w (Rosenholm and Torlegard 1988; for shifts alone: Nuth and Kaeaeb 2011, doi:10.5194/tc-5-271-2011).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.geometry.geometry import orthonormal, rotation_exp
from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, mad_sigma
from rille.stages.terrain.shading import gradient

Align = Literal["shift", "tilt", "rigid"]

MIN_AVERAGED_RATIO = 1.5  # of cells, from which the finer model's cells are averaged instead of interpolated
MIN_KNOWN_SHARE = 0.5  # of a coarse cell's area that the finer cells must know
BORDER = 1e-6  # of a coarse cell: a centre nearer than this to a border lies on it
FREE = {"shift": [0, 1, 2], "tilt": [2, 3, 4], "rigid": [0, 1, 2, 3, 4, 5]}  # of tx ty tz wx wy wz
MAX_POINTS = 300_000  # that an alignment uses: six unknowns need no more
MAX_ITERATIONS = 50
SETTLED_CELLS = 1e-4  # step of an alignment that ends it
MIN_RELIEF_CELLS = 100  # known to both, from which on their relief is compared
MIN_EXPLAINED = 0.9  # share of the relief's variance that a common factor explains
MAX_CONDITION = 1e7  # of the normal matrix in units of cells: beyond, the terrain is flat for what is asked


@dataclass(frozen=True)
class Grid:
    """Elevations (rows, cols), metres, NaN unknown, and the map (2, 3) from (col, row, 1) of cell centres to x, y."""

    values: Floats
    matrix: Floats

    @property
    def cell(self) -> float:
        """Side of a cell, metres."""
        return float(np.sqrt(abs(np.linalg.det(self.matrix[:, :2]))))

    def centres(self) -> Floats:
        """Coordinates x, y (rows, cols, 2) of the cells' centres, metres."""
        row, col = np.mgrid[: self.values.shape[0], : self.values.shape[1]]
        return np.stack([col, row], axis=-1) @ self.matrix[:, :2].T + self.matrix[:, 2]

    def index(self, xy: Floats) -> Floats:
        """Fractional (row, col) (..., 2) of points (..., 2)."""
        # The matrix gives x, y of column and row; the order is turned round to index arrays.
        col_row = (xy - self.matrix[:, 2]) @ np.linalg.inv(self.matrix[:, :2]).T
        return np.asarray(col_row[..., ::-1])

    def slopes(self) -> Floats:
        """Gradient dz/dx, dz/dy (2, rows, cols) of the terrain, NaN unknown."""
        # The gradient takes y to grow upwards, against the rows.
        along = gradient(self.values, 1.0) * np.array([1.0, -1.0])[:, None, None]  # per column, per row
        return np.tensordot(np.linalg.inv(self.matrix[:, :2]).T, along, axes=1)


def interpolate(grid: Grid, xy: Floats, values: Floats | None = None) -> Floats:
    """Bilinear value (...) at points (..., 2); NaN where one of the cells that count is unknown, or outside."""
    array = grid.values if values is None else values
    index = np.moveaxis(grid.index(xy), -1, 0)
    nearest = np.rint(index)
    index = np.where(np.abs(index - nearest) < 1e-6, nearest, index)  # the same cells: the same values
    known = np.isfinite(array)
    share, z = (
        scipy.ndimage.map_coordinates(a, index, order=1, mode="constant", cval=0.0)
        # Interpolating the mask beside the values tells where an unknown cell had a part; NaN itself would also spoil
        # points whose weight for it is 0.
        for a in (known.astype(np.float64), np.where(known, array, 0.0))
    )
    return np.where(share > 1.0 - 1e-9, z, np.nan)


def cell_means(fine: Grid, target: Grid) -> Floats:
    """Mean (rows, cols) of the finer cells whose centres lie in each target cell, where they know half of it.

    A centre on the border of two or four target cells counts to each of them alike.
    """
    known = np.isfinite(fine.values)
    where, values = target.index(fine.centres()[known]), fine.values[known]
    shape = target.values.shape
    size = shape[0] * shape[1]
    count, total = np.zeros(size), np.zeros(size)
    # Lattices of which one has twice the cells of the other put centres on borders: rounded to one side, they would
    # shift the means, or leave every other cell nearly without any. Moved to all four sides, they are shared out.
    for nudge in itertools.product((-BORDER, BORDER), repeat=2):
        index = np.rint(where + nudge).astype(np.intp)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        flat = np.ravel_multi_index((index[inside, 0], index[inside, 1]), shape)
        count += 0.25 * np.bincount(flat, minlength=size)
        total += 0.25 * np.bincount(flat, weights=values[inside], minlength=size)
    enough = count >= MIN_KNOWN_SHARE * (target.cell / fine.cell) ** 2 * (1.0 - 1e-9)
    return np.where(enough, total / np.where(enough, count, 1.0), np.nan).reshape(shape)


def common(a: Grid, b: Grid) -> tuple[Grid, Grid, str]:
    """Both models on the cells of the coarser one, and how that was done, in words.

    Raises
    ------
    InputError
        They have no known cell in common.
    """
    target, fine, name = (b, a, "A") if a.cell <= b.cell * (1.0 + 1e-9) else (a, b, "B")
    ratio = target.cell / fine.cell
    if ratio >= MIN_AVERAGED_RATIO:
        values = cell_means(fine, target)
        how = f"{name} averaged from {fine.cell:g} m to {target.cell:g} m (half of a cell's area known at least)"
    else:
        values = interpolate(fine, target.centres())
        # All four, since one model may be turned against the other about one of them.
        corners = fine.index(target.centres()[[0, 0, -1, -1], [0, -1, 0, -1]])
        same = abs(ratio - 1.0) < 1e-9 and np.abs(corners - np.rint(corners)).max() < 1e-6
        how = "the same cells, nothing resampled" if same else f"{name} interpolated bilinearly to the other's cells"
    brought = Grid(values, target.matrix)
    pair = (brought, target) if name == "A" else (target, brought)
    if not (np.isfinite(values) & np.isfinite(target.values)).any():
        text = f"no known cell in common: A is at {_outline(a)}, B at {_outline(b)}"
        raise InputError("RIL-323", text, remedy="compare models of the same place and frame")
    return *pair, how


def _outline(grid: Grid) -> str:
    """Where the known cells of a model lie."""
    (x0, y0), (x1, y1) = (edge(grid.centres()[np.isfinite(grid.values)], axis=0) for edge in (np.min, np.max))
    return f"x {x0:.6g}..{x1:.6g}, y {y0:.6g}..{y1:.6g} m"


@dataclass(frozen=True)
class Alignment:
    """Motion of A onto B: x_b = rotation (x_a - centre) + centre + translation.

    ``sigma`` of the free parameters (tx ty tz in m, wx wy wz in rad; 0 for those held); ``points`` that took part.
    """

    rotation: Floats
    translation: Floats
    centre: Floats
    sigma: Floats
    iterations: int
    points: int

    def apply(self, points: Floats) -> Floats:
        """Moved points (..., 3), metres."""
        return (points - self.centre) @ self.rotation.T + self.centre + self.translation


def align(a: Grid, b: Grid, kind: Align) -> Alignment:
    """Motion that brings A, on B's cells, onto B.

    Parameters
    ----------
    a, b : models on the same cells, see :func:`common`.
    kind : ``shift`` x, y, z; ``tilt`` z and the inclinations about x and y; ``rigid`` all six.

    Raises
    ------
    DegenerateError
        The terrain does not determine the motion (it is flat for what is asked), or it is not found.
    """
    points = np.concatenate([a.centres(), a.values[..., None]], axis=-1)[np.isfinite(a.values)]
    points = points[:: max(1, len(points) // MAX_POINTS)]
    slopes, free = b.slopes(), FREE[kind]
    centre = points.mean(axis=0)
    # Units of a cell of motion at the terrain's extent, so that the condition compares like with like.
    unit = np.array([1.0] * 3 + [1.0 / max(float(np.std(points[:, :2])), a.cell)] * 3)[free] * a.cell
    start = _difference(b, slopes, points)[0]
    offset = float(np.median(start[np.isfinite(start)])) if np.isfinite(start).any() else 0.0
    state = Alignment(np.eye(3), np.array([0.0, 0.0, -offset]), centre, np.zeros(6), 0, 0)
    for iteration in range(1, MAX_ITERATIONS + 1):
        step, sigma, used = _gauss_newton(b, slopes, points, state, free, unit)
        full, spread = np.zeros(6), np.zeros(6)
        full[free], spread[free] = step, sigma
        # Fifty products of rotations drift from a rotation by rounding.
        rotation = orthonormal(rotation_exp(full[3:]) @ state.rotation)
        state = Alignment(rotation, state.translation + full[:3], centre, spread, iteration, used)
        if np.abs(step / unit).max() < SETTLED_CELLS:
            return state
    # Cells at a border that come and go from step to step keep the motion from settling, but within its own errors.
    if (np.abs(step) < sigma).all():
        return state
    cells = np.abs(step / unit).max()
    text = f"no alignment after {MAX_ITERATIONS} steps: the last one still moved by {cells:.2g} cells"
    remedy = "choose fewer freedoms (tilt or shift), or bring the models closer first"
    raise DegenerateError("RIL-324", text, remedy=remedy)


def _difference(b: Grid, slopes: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Elevation of points (n, 3) above B, NaN unknown, and B's normals (-gx, -gy, 1) there."""
    xy = points[:, :2]
    gx, gy = (interpolate(b, xy, g) for g in slopes)
    return points[:, 2] - interpolate(b, xy), np.column_stack([-gx, -gy, np.ones(len(points))])


def _gauss_newton(
    b: Grid, slopes: Floats, points: Floats, state: Alignment, free: list[int], unit: Floats
) -> tuple[Floats, Floats, int]:
    """Step and standard deviations of the free parameters, and the number of points."""
    moved = state.apply(points)
    difference, normal = _difference(b, slopes, moved)
    good = np.isfinite(difference) & np.isfinite(normal).all(axis=1)
    if good.sum() < 10 * len(free):
        text = f"{int(good.sum())} cells are left to align by"
        raise DegenerateError("RIL-325", text, remedy="leave --align out, or choose overlapping models")
    r, n = difference[good], normal[good]
    # Rotations turn about the moved centre: their correlation with the shifts is then least.
    q = moved[good] - state.centre - state.translation
    J = np.column_stack([n, np.cross(q, n)])[:, free] * unit
    scale = max(mad_sigma(r), 1e-9)
    w = bisquare(r / (TUKEY_BISQUARE * scale))
    N = (J * w[:, None]).T @ J
    values = np.linalg.eigvalsh(N)
    if not values[0] * MAX_CONDITION > values[-1]:
        condition = values[-1] / max(values[0], 1e-300)
        text = f"the terrain is too flat to align by: condition {condition:.1e}, more than {MAX_CONDITION:.0e}"
        raise DegenerateError("RIL-326", text, remedy="choose --align tilt, which flat terrain determines")
    step = -np.linalg.solve(N, (J * w[:, None]).T @ r)
    variance = float((w * r * r).sum()) / max(float(w.sum()) - len(free), 1.0)
    return step * unit, np.sqrt(variance * np.diag(np.linalg.inv(N))) * unit, int(good.sum())


def errors(a: Grid, b: Grid, alignment: Alignment | None = None) -> Floats:
    """Return the elevation differences A minus B (rows, cols), metres; NaN where one of them is unknown.

    Parameters
    ----------
    a, b : models on the same cells, see :func:`common`.
    alignment : motion from :func:`align`. Each cell of A is moved by it and compared with B interpolated at the moved
        point; the difference stands at the cell of A. None: A is compared cell by cell.
    """
    if alignment is None:
        return a.values - b.values
    moved = alignment.apply(np.concatenate([a.centres(), a.values[..., None]], axis=-1))
    return np.asarray(moved[..., 2] - interpolate(b, moved[..., :2]))


def relief_factor(a: Grid, b: Grid) -> float:
    """Factor of B's elevations that explains nine tenths of A's but for a plane (runs may lean); 1 where none does."""
    known = np.argwhere(np.isfinite(errors(a, b)))
    if len(known) < MIN_RELIEF_CELLS:
        return 1.0
    row, col = known[:: len(known) // MAX_POINTS + 1].T
    z = np.stack([a.values[row, col], b.values[row, col]], axis=-1)
    plane = np.stack([row, col, np.ones(len(z))], axis=-1)
    relief = z - plane @ np.linalg.lstsq(plane, z)[0]
    (saa, sab), (_, sbb) = relief.T @ relief
    return float(sab / sbb) if sab**2 > MIN_EXPLAINED * saa * sbb else 1.0


def figures(error: Floats) -> dict[str, float]:
    """RMSE, NMAD, 95 % of the absolute errors, bias and median (m) of the finite errors, and their number ``cells``."""
    e = error[np.isfinite(error)]
    if not e.size:
        return {"cells": 0.0}
    return {
        "rmse": float(np.sqrt(np.mean(e * e))),
        "nmad": mad_sigma(e),
        "p95": float(np.percentile(np.abs(e), 95)),
        "bias": float(np.mean(e)),
        "median": float(np.median(e)),
        "cells": float(e.size),
    }


def binned(error: Floats, by: Floats, edges: Floats) -> list[dict[str, float]]:
    """Figures of the errors whose ``by`` lies between neighbouring edges; empty bins are left out."""
    bins = [
        {"from": float(low), "to": float(high)} | figures(error[(by >= low) & (by < high)])
        for low, high in itertools.pairwise(edges)
    ]
    return [one for one in bins if one["cells"]]
