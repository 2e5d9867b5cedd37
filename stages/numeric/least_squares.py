"""Least squares: Levenberg-Marquardt for problems that are not linear, reweighting for those that have outliers.

Sources: Marquardt (1963), doi:10.1137/0111030; Holland and Welsch (1977), doi:10.1080/03610927708827533.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from rille.stages.core.arrays import Floats


class Equations(Protocol):
    """Normal equations at a state, and the cost there: infinite of a state that cannot be."""

    @property
    def cost(self) -> float:
        """Half the weighted sum of squares, or what stands in its place."""
        ...


class NormalEquations(NamedTuple):
    """Gauss-Newton matrix (n, n), dense or sparse, and gradient (n,) at a state, and its cost."""

    matrix: Any
    gradient: Floats
    cost: float


X = TypeVar("X")
N = TypeVar("N", bound=Equations)


class Problem(Protocol[X, N]):
    """Normal equations at a state, and the state a damped step on."""

    def normal(self, state: X) -> N:
        """Normal equations at a state, with its cost."""
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
    damping, steps, finished = 1e-4, 0, False
    now = problem.normal(state)
    first = now.cost
    # With more damping no step is expected to lower the cost any more.
    while steps < iterations and not finished and damping <= 1e8:
        ahead = problem.ahead(state, now, damping)
        then = problem.normal(ahead)
        # Also of a refused step: at the minimum it changes the cost by rounding alone.
        finished = abs(now.cost - then.cost) <= tolerance * now.cost
        if then.cost < now.cost:
            state, now, damping, steps = ahead, then, max(0.1 * damping, 1e-12), steps + 1
        else:
            damping *= 10.0
    return Minimum(state, first, now.cost, steps)


def irls(
    design: Floats,
    target: Floats,
    weigh: Callable[[Floats], Floats],
    prior: Floats | None = None,
    start: Floats | None = None,
    rounds: int = 20,
) -> Floats:
    """Unknowns x of ``design @ x = target`` by reweighted least squares, as ``target`` (..., k, m) or (k,).

    They minimise ``sum w |design x - target|^2 + (x - start)' prior (x - start)``, the weights w being those of the
    residuals that the round before left.

    Parameters
    ----------
    design, target : (..., n, k) and (..., n, m), leading axes being problems of their own; or (n, k) and (n,).
    weigh : weights (..., n) of the lengths (..., n) of the rows' residuals.
    prior : (k, k), information that is held besides; without any the weighted rows must determine the unknowns.
    start : what the first weights are of, and what the prior holds; None: weights of residuals of 0, and zeros.
    rounds : at most; fewer where the unknowns have settled.

    Raises
    ------
    numpy.linalg.LinAlgError
        The rows that have weight do not determine the unknowns.
    """
    several = target.ndim == design.ndim
    y = target if several else target[..., None]
    x = first = np.zeros((*y.shape[:-2], design.shape[-1], y.shape[-1]))
    if start is not None:
        x = first = start if several else start[..., None]
    rest = np.zeros(y.shape) if start is None else y - design @ x
    held = np.zeros(2 * (design.shape[-1],)) if prior is None else prior
    for _ in range(rounds):
        weighted = np.swapaxes(design * weigh(np.sqrt((rest**2).sum(-1)))[..., None], -1, -2)
        last, x = x, np.linalg.solve(weighted @ design + held, weighted @ y + held @ first)
        # Of a height of metres, nanometres.
        if np.abs(x - last).max() <= 1e-9 * np.abs(x).max():
            break
        rest = y - design @ x
    return x if several else x[..., 0]
