"""Least squares: Levenberg-Marquardt for problems that are not linear, reweighting for those that have outliers.

Sources: Marquardt (1963), doi:10.1137/0111030; Holland and Welsch (1977), doi:10.1080/03610927708827533.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from rille.stages.core.arrays import Floats

FIRST_DAMPING, MAX_DAMPING = 1e-4, 1e8
"""Marquardt's factor at the start, and that from which on no step is expected to lower the cost any more."""

X = TypeVar("X")
N = TypeVar("N")


class Problem(Protocol[X, N]):
    """A cost of a state, its normal equations there, and the state a damped step on."""

    def cost(self, state: X) -> float:
        """Cost, infinite of a state that cannot be."""
        ...

    def normal(self, state: X) -> N:
        """Normal equations at a state."""
        ...

    def ahead(self, state: X, normal: N, damping: float) -> X:
        """State after one step, the diagonal of the normal matrix enlarged by ``damping`` times itself."""
        ...


class Minimum(NamedTuple, Generic[X]):
    """Where an adjustment ended, its cost at the start and there, and the number of accepted steps."""

    state: X
    before: float
    after: float
    steps: int


def levenberg_marquardt(problem: Problem[X, N], state: X, iterations: int, tolerance: float = 1e-9) -> Minimum[X]:
    """Minimum from ``state``; never worse than the start. Ends where a step lowers the cost by ``tolerance`` of it."""
    damping, steps = FIRST_DAMPING, 0
    first = now = problem.cost(state)
    while steps < iterations:
        normal = problem.normal(state)
        # Normal equations stay as they are while a step is refused: only the damping grows.
        while not (then := problem.cost(ahead := problem.ahead(state, normal, damping))) < now:
            damping *= 10.0
            # A step that changes the cost by rounding alone was refused at the minimum itself.
            if damping > MAX_DAMPING or then - now <= tolerance * now:
                return Minimum(state, first, now, steps)
        finished = now - then <= tolerance * now
        state, now, damping, steps = ahead, then, max(0.1 * damping, 1e-12), steps + 1
        if finished:
            break
    return Minimum(state, first, now, steps)


def irls(design: Floats, target: Floats, weigh: Callable[[Floats], Floats], prior: Floats, rounds: int = 5) -> Floats:
    """Unknowns (..., k, m) of ``design @ x = target`` by reweighted least squares.

    Parameters
    ----------
    design, target : (..., n, k) and (..., n, m); leading axes are problems of their own.
    weigh : weights (..., n) of the lengths (..., n) of the rows' residuals.
    prior : (k, k), added to the normal matrices.
    rounds : a fixed number, so that a result never hangs on a rounding that decides whether one more is done.
    """
    x = np.zeros((*target.shape[:-2], design.shape[-1], target.shape[-1]))
    weights = np.ones(target.shape[:-1])
    for again in range(rounds):
        if again:
            rest = target - design @ x
            weights = weigh(np.sqrt((rest**2).sum(-1)))
        weighted = np.swapaxes(design * weights[..., None], -1, -2)
        x = np.linalg.solve(weighted @ design + prior, weighted @ target)
    return x
