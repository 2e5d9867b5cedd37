"""The rigid motion that lays points of one ground on the heights of another, by weighted Gauss-Newton.

A point q, seen from the middle of all points, stands ``z(q) - h(q)`` above the ground h. With n = (-gx, -gy, 1) of the
points' own slopes, a small motion (t, w) changes that by n . t + (q x n) . w (Rosenholm and Torlegard 1988; for shifts
alone: Nuth and Kaeaeb 2011, doi:10.5194/tc-5-271-2011). The points are those whose slopes are known better: noise in
slopes counts as relief, and makes steps and standard deviations too small.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import RigidTransform, heading_of, orthonormal, rotation_exp, rotation_log
from rille.stages.numeric.robust import mad_sigma
from rille.stages.terrain.relief.grid import Grid

MAX_ROUNDS, SETTLED_CELLS = 30, 1e-3
"""Steps, and the greatest motion of a point in a step that ends them."""
MIN_EIGENVALUE = 1e-6
"""Of the normal matrix scaled to a diagonal of ones: below, something is not determined."""


@dataclass(frozen=True)
class FitRules:
    """How points are laid on a ground.

    ``least`` points must lie on known ground. ``weigh(residuals, sigma)`` gives their weights. ``free``: which of
    x, y, z and the rotations about them are estimated. ``sigma_tilt``: standard deviation of the points' vertical about
    x and y, rad. ``near``: the middle of the points moves no farther, m.
    """

    least: float
    weigh: Callable[[Floats, float], Floats]
    free: Sequence[int] = range(6)
    sigma_tilt: float = math.inf
    near: float = math.inf


class HeightFit(NamedTuple):
    """``pose`` T_ground_points, turned about ``centre`` (3,), m, of the ground's frame.

    ``differences`` (n,): heights of the points above the ground, m, NaN unknown, and their weighted mean ``square``,
    m2. ``normal`` (6, 6): normal matrix of x, y, z, m, and the rotations about them at the centre, rad, without the
    prior. ``step`` (6,): the last one, zeros where something is not determined. ``rounds``: how many there were.
    """

    pose: RigidTransform
    centre: Floats
    differences: Floats
    square: float
    normal: Floats
    step: Floats
    rounds: int

    @property
    def level(self) -> Floats:
        """The turn (3, 3) of the pose without its heading."""
        return rotation_exp([0.0, 0.0, -heading_of(self.pose)]) @ self.pose.rotation


def condition(normal: Floats) -> float:
    """Least eigenvalue of a normal matrix scaled to a diagonal of ones."""
    scale = np.sqrt(np.diag(normal)) + 1e-12
    return float(np.linalg.eigvalsh(normal / np.outer(scale, scale))[0])


def steps_to_come(step: Floats, before: Floats) -> float:
    """How far it is to the end, in steps, by the last step and the one before, both (6,), m.

    Noise of the slopes, and weights that follow the fit, shorten all steps by about one share: they are a geometric
    series. 1 where the steps are none.
    """
    share = float(step @ before) / max(float(before @ before), 1e-24)
    # 0.9: more would be trusted to a share that is known to some per cent.
    return 1.0 / (1.0 - min(share, 0.9)) if share > 0.5 else 1.0


def lay(points: Floats, normals: Floats, ground: Grid, start: RigidTransform, rules: FitRules) -> HeightFit | None:
    """Lay points on a ground, from a start on: at first by the median of their heights above it.

    Parameters
    ----------
    points, normals : (n, 3), m, and of the ground that they are of, (-gx, -gy, 1), NaN unknown.

    Returns
    -------
    None where too few points lie on known ground at the start.
    """
    free, prior = list(rules.free), np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
    there = start.apply(points)
    above = there[:, 2] - ground.at(there[:, :2])
    known = np.isfinite(above) & np.isfinite(normals[:, 2])
    if known.sum() < rules.least:
        return None
    own = points[known].mean(axis=0)
    rotation, centre = start.rotation, start.apply(own) - [0.0, 0.0, float(np.median(above[known]))]
    begin, fit, before = centre, None, np.zeros(6)
    reach = float(np.hypot(*np.std(points[known][:, :2], axis=0)))
    metres = np.array([1.0, 1.0, 1.0, reach, reach, reach])
    for rounds in range(1, MAX_ROUNDS + 1):
        q, n = (points - own) @ rotation.T, normals @ rotation.T
        above = q[:, 2] + centre[2] - ground.at((q + centre)[:, :2])
        known = np.isfinite(above) & np.isfinite(n[:, 2])
        if known.sum() < rules.least:
            break
        r, n = above[known], n[known] / n[known][:, 2:]
        J = np.concatenate([n, np.cross(q[known], n)], axis=1)
        sigma = max(mad_sigma(r), 1e-12)
        weight = rules.weigh(r, sigma)
        normal = J.T @ (weight[:, None] * J)
        pose, square = RigidTransform(rotation, centre - rotation @ own), float((weight * r**2).sum() / weight.sum())
        held, step = prior * (sigma / rules.sigma_tilt) ** 2, np.zeros(6)
        whole = (normal + held)[np.ix_(free, free)]
        determined = condition(whole) >= MIN_EIGENVALUE
        if determined:
            level = rotation_exp([0.0, 0.0, -heading_of(pose)])
            tilt = np.concatenate([np.zeros(3), rotation_log(rotation @ level)])
            step[free] = -np.linalg.solve(whole, (J.T @ (weight * r) + held @ tilt)[free])
        fit = HeightFit(pose, centre, np.where(known, above, np.nan), square, normal, step, rounds)
        before, step = step, step * steps_to_come(step * metres, before * metres)
        moved = float(np.abs(step * metres).max()) / ground.cell
        # Across at most a cell: farther, the slopes are others.
        step = step / max(float(np.abs(step[:2]).max()) / ground.cell, 1.0)
        centre, rotation = centre + step[:3], orthonormal(rotation_exp(step[3:]) @ rotation)
        if not determined or moved < SETTLED_CELLS or math.hypot(*(centre - begin)[:2]) > rules.near:
            return fit._replace(pose=RigidTransform(rotation, centre - rotation @ own), centre=centre)
    return fit
