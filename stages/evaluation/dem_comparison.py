"""One elevation model against another: on common cells, aligned if asked, errors by range and slope.

The error is A minus the reference B. NMAD = 1.4826 median(|e - median(e)|) is the robust standard deviation (Hoehle and
Hoehle 2009, doi:10.1016/j.isprsjprs.2009.02.003). Alignment weights the differences by Tukey's biweight, so that
changes between the models do not move them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.geometry.geometry import RigidTransform, rotation_log
from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, mad_sigma
from rille.stages.terrain.relief.grid import Grid
from rille.stages.terrain.relief.height_fit import MAX_ROUNDS, MIN_EIGENVALUE, FitRules, condition, lay

Align = Literal["shift", "tilt", "rigid"]

FREE = {"shift": [0, 1, 2], "tilt": [2, 3, 4], "rigid": [0, 1, 2, 3, 4, 5]}  # of tx ty tz wx wy wz
MAX_POINTS = 300_000  # that an alignment uses: six unknowns need no more


def cell_means(fine: Grid, target: Grid) -> Floats:
    """Mean (rows, cols) of the finer cells whose centres lie in each target cell, where half of it is known.

    A centre on the border of two or four target cells counts for each of them.
    """
    known = np.isfinite(fine.values)
    where, values = target.index(fine.centres()[known]), fine.values[known]
    shape = target.values.shape
    size = shape[0] * shape[1]
    count, total = np.zeros(size), np.zeros(size)
    # If one lattice has twice the cells of the other, centres lie on borders: rounded to one side, they would shift the
    # means, or leave every other cell nearly empty. So each is moved to all four sides.
    # 1e-6 of a coarse cell: a centre nearer than this to a border lies on it.
    for nudge in itertools.product((-1e-6, 1e-6), repeat=2):
        index = np.rint(where + nudge).astype(np.intp)
        inside = ((index >= 0) & (index < shape)).all(axis=1)
        flat = np.ravel_multi_index((index[inside, 0], index[inside, 1]), shape)
        count += 0.25 * np.bincount(flat, minlength=size)
        total += 0.25 * np.bincount(flat, weights=values[inside], minlength=size)
    enough = count >= 0.5 * (target.cell / fine.cell) ** 2 * (1.0 - 1e-9)
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
    if ratio >= 1.5:
        values = cell_means(fine, target)
        how = f"{name} averaged from {fine.cell:g} m to {target.cell:g} m (half of a cell's area known at least)"
    else:
        values = fine.at(target.centres())
        # All four corners, since one model may be turned against the other about one of them.
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
    """Extent of the known cells of a model, in words."""
    (x0, y0), (x1, y1) = (edge(grid.centres()[np.isfinite(grid.values)], axis=0) for edge in (np.min, np.max))
    return f"x {x0:.6g}..{x1:.6g}, y {y0:.6g}..{y1:.6g} m"


@dataclass(frozen=True)
class Alignment:
    """``pose`` T_b_a of A on B, with ``sigma`` of the free parameters (tx ty tz in m, wx wy wz in rad; 0 for those
    held) for turns about ``centre``, m, of B; ``rounds`` of the estimation, and ``points`` of B that took part."""

    pose: RigidTransform
    centre: Floats
    sigma: Floats
    rounds: int = 0
    points: int = 0


def align(a: Grid, b: Grid, kind: Align, start: RigidTransform = RigidTransform.identity()) -> Alignment:
    """Motion that aligns A with B, by B's points on A (:mod:`rille.stages.terrain.relief.height_fit`), with the slopes
    of B, the reference, which are known better.

    Parameters
    ----------
    kind : ``shift`` x, y, z; ``tilt`` z and the inclinations about x and y; ``rigid`` all six.
    start : approximate T_b_a.

    Raises
    ------
    DegenerateError
        The terrain does not determine the motion (it is too flat for this kind), or the fit does not converge.
    """
    free, known = FREE[kind], np.isfinite(b.values)
    points, slopes = b.points()[known], b.slopes()[:, known].T
    normals = np.column_stack([-slopes, np.ones(len(points))])
    every = slice(None, None, max(1, len(points) // MAX_POINTS))
    rules = FitRules(10 * len(free), lambda r, sigma: bisquare(r / (TUKEY_BISQUARE * max(sigma, 1e-9))), free)
    fit = lay(points[every], normals[every], a, start.inverse(), rules)
    if fit is None:
        text = f"fewer than {rules.least} cells are left to align by"
        raise DegenerateError("RIL-325", text, remedy="leave --align out, or choose overlapping models")
    normal = fit.normal[np.ix_(free, free)]
    if condition(normal) < MIN_EIGENVALUE:
        text = f"the terrain is too flat to align by: eigenvalue {condition(normal):.1e}, {MIN_EIGENVALUE:.0e} wanted"
        raise DegenerateError("RIL-326", text, remedy="choose --align tilt, which flat terrain determines")
    pose, covariance, sigma = fit.pose.inverse(), np.zeros((6, 6)), np.zeros(6)
    covariance[np.ix_(free, free)] = fit.square * np.linalg.inv(normal)
    both = np.kron(np.eye(2), pose.rotation)
    sigma[free] = np.sqrt(np.diag(both @ covariance @ both.T))[free]
    # Cells at a border that come and go from step to step keep the motion changing, but within its own errors.
    if fit.rounds == MAX_ROUNDS and (np.abs(fit.step) > sigma).any():
        text = f"no alignment after {MAX_ROUNDS} steps: the last one still moved by {np.abs(fit.step[:3]).max():.2g} m"
        remedy = "choose other freedoms (rigid if one may lean, tilt on flat ground), or bring the models closer first"
        raise DegenerateError("RIL-324", text, remedy=remedy)
    return Alignment(pose, pose.apply(fit.centre), sigma, fit.rounds, int(np.isfinite(fit.differences).sum()))


def errors(a: Grid, b: Grid, T_b_a: RigidTransform | None = None) -> Floats:
    """Return the elevation differences A minus B (rows, cols), metres; NaN where one of them is unknown.

    Parameters
    ----------
    a, b : models; without a motion on the same cells, see :func:`common`.
    T_b_a : motion from :func:`align`. Each cell of A is moved by it and compared with B interpolated at the moved
        point; the difference stands at the cell of A. None: A is compared cell by cell.
    """
    if T_b_a is None:
        return a.values - b.values
    moved = T_b_a.apply(a.points())
    return np.asarray(moved[..., 2] - b.at(moved[..., :2]))


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


def assess(a: Grid, b: Grid, kind: Align | None, cameras: Floats | None) -> tuple[dict[str, Any], Floats, Grid]:
    """Figures (JSON-able) of A against the reference B, errors, m, on the common cells (rows, cols), and B on them.

    Parameters
    ----------
    kind : motion that aligns A first; None: none.
    cameras : positions (n, 2), m, from the nearest of which the range is counted; None: it is unknown.

    Raises
    ------
    InputError
        There is no common known cell.
    DegenerateError
        The terrain does not determine the alignment.
    """
    on_a, on_b, how = common(a, b)
    facts: dict[str, Any] = {"resampling": how}
    pose = None
    if kind is not None:
        facts["before_alignment"] = figures(errors(on_a, on_b))
        alignment = align(on_a, on_b, kind)
        facts["alignment"], pose = _facts_of(alignment, kind), alignment.pose
    error = errors(on_a, on_b, pose)
    facts["figures"] = figures(error)
    known = np.isfinite(error)
    if not known.any():
        text = "no cell is left that both know"
        raise InputError("RIL-617", text, remedy="leave --align out, or compare other models")
    facts["completeness"] = _completeness(error, on_b, a)
    slope = np.degrees(np.arctan(np.hypot(*on_b.slopes())))
    facts["by_slope"] = binned(error, slope, np.array([0.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0]))
    facts["by_range"] = []
    if cameras is not None and len(cameras):
        distance = np.asarray(cKDTree(cameras).query(on_b.centres())[0], np.float64)
        # Bins are open at their upper end: 1e-9 more, so that the last one holds the farthest cell.
        edges = np.linspace(0.0, float(distance[known].max()) * (1.0 + 1e-9), 9)
        facts["by_range"] = binned(error, distance, edges)
    return facts, error, on_b


def _facts_of(alignment: Alignment, kind: Align) -> dict[str, Any]:
    """Facts (JSON-able) of the motion that aligned A."""
    names = ("x_m", "y_m", "z_m", "about_x_deg", "about_y_deg", "about_z_deg")
    start = alignment.pose.inverse().apply(alignment.centre)
    values = [*(alignment.centre - start), *np.degrees(rotation_log(alignment.pose.rotation))]
    sigma = [*alignment.sigma[:3], *np.degrees(alignment.sigma[3:])]
    return {
        "kind": kind,
        "motion_of_a": {names[k]: float(values[k]) for k in FREE[kind]},
        "sigma": {names[k]: float(sigma[k]) for k in FREE[kind]},
        "centre_m": start.tolist(),
        "how": "x_b = R (x_a - centre) + centre + t; least squares of the elevation differences, Tukey's biweight",
        "iterations": alignment.rounds,
        "points": alignment.points,
    }


def _completeness(error: Floats, on_b: Grid, a: Grid) -> dict[str, Any]:
    """Share of compared cells of B: of all, and of those whose centres lie in the outline of A."""
    compared, known, index = int(np.isfinite(error).sum()), np.isfinite(on_b.values), a.index(on_b.centres())
    inside = ((index >= -0.5) & (index <= np.array(a.values.shape) - 0.5)).all(axis=-1)
    within = int((known & inside).sum())
    return {
        "of_b": min(compared / known.sum(), 1.0),
        "of_b_within_a": min(compared / max(within, 1), 1.0),
        "how": f"{compared} cells compared, of {int(known.sum())} that B knows, {within} of these "
        "within the outline of A",
    }
