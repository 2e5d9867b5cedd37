"""Least squares: Levenberg-Marquardt for nonlinear problems, iterative reweighting for outliers.

Sources: Marquardt (1963), doi:10.1137/0111030; Holland and Welsch (1977), doi:10.1080/03610927708827533.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from rille.stages.core.arrays import Floats


class Equations(Protocol):
    """Normal equations at a state, and its cost: infinite for an impossible state."""

    @property
    def cost(self) -> float:
        """Weighted sum of squares, or robust loss, times any constant: costs are only compared."""
        ...


class NormalEquations(NamedTuple):
    """Gauss-Newton matrix (n, n), dense or sparse, and gradient (n,) at a state, and its cost."""

    matrix: Any
    gradient: Floats
    cost: float


X = TypeVar("X")
N = TypeVar("N", bound=Equations)


class Problem(Protocol[X, N]):
    """Normal equations at a state, and the state after a damped step."""

    def normal(self, state: X) -> N:
        """Normal equations at a state, with its cost."""
        ...

    def ahead(self, state: X, normal: N, damping: float) -> X:
        """State after one step, the diagonal of the normal matrix enlarged by ``damping`` times itself."""
        ...


class Minimum(NamedTuple, Generic[X]):
    """Final state of an adjustment, its cost at the start and at the end, and the number of accepted steps."""

    state: X
    before: float
    after: float
    steps: int


def levenberg_marquardt(problem: Problem[X, N], state: X, iterations: int, tolerance: float = 1e-9) -> Minimum[X]:
    """Minimum from ``state``, never worse than the start; ends if a step changes the cost by at most ``tolerance``, as
    a share of it."""
    damping, steps, finished = 1e-4, 0, False
    now = problem.normal(state)
    first = now.cost
    # 1e8: with more damping no step is expected to lower the cost.
    while steps < iterations and not finished and damping <= 1e8:
        ahead = problem.ahead(state, now, damping)
        then = problem.normal(ahead)
        # Refused steps count too: at the minimum they change the cost by rounding alone.
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
    tolerance: float = 1e-9,
) -> Floats:
    """Unknowns x of ``design @ x = target`` by reweighted least squares, as ``target`` (..., k, m) or (k,).

    They minimise ``sum w |design x - target|^2 + (x - start)' prior (x - start)``, with weights w by the residuals of
    the round before.

    Parameters
    ----------
    design, target : (..., n, k) and (..., n, m), with separate problems along the leading axes; or (n, k) and (n,).
    weigh : weights (..., n) of the lengths (..., n) of the rows' residuals.
    prior : (k, k), information matrix; without it the weighted rows must determine the unknowns.
    start : value of the prior, whose residuals give the first weights; None: zeros, and weights of residuals of 0.
    rounds : at most; fewer if no unknown changes by more than ``tolerance`` times the largest one.

    Raises
    ------
    numpy.linalg.LinAlgError
        The weighted rows do not determine the unknowns.
    """
    several = target.ndim == design.ndim
    y, k = target if several else target[..., None], design.shape[-1]
    x = first = np.zeros((*y.shape[:-2], k, y.shape[-1]))
    if start is not None:
        x = first = start if several else start[..., None]
    rest = np.zeros(y.shape) if start is None else y - design @ x
    held = np.zeros(2 * (k,)) if prior is None else prior
    # Both sides of the normal equations are products of the same rows.
    rows = np.concatenate([np.broadcast_to(design, (*y.shape[:-1], k)), y], axis=-1)
    across = np.ascontiguousarray(np.swapaxes(rows, -1, -2))
    for _ in range(rounds):
        size = np.sqrt((rest**2).sum(-1)) if several else np.abs(rest[..., 0])
        products = (across * weigh(size)[..., None, :]) @ rows
        last, x = x, np.linalg.solve(products[..., :k, :k] + held, products[..., :k, k:] + held @ first)
        # By default nanometres for a height of metres.
        if np.abs(x - last).max() <= tolerance * np.abs(x).max():
            break
        rest = y - design @ x
    return x if several else x[..., 0]
