"""Robust statistics: spread and weights that outliers hardly move.

Plain Python functions that kernels compile where they call them, so that an estimator in NumPy and one in numba weigh
alike to the bit. Source: Huber and Ronchetti (2009), Robust Statistics, sections 4.4, 4.8 and 5.1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats

MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation, of normal errors."""
TUKEY_BISQUARE = 4.685
"""Standard deviations beyond which the bisquare ignores a residual: 95 % efficiency where errors are normal."""
SETTLED_SHARE = 1e-9
"""Change of the parameters over their size below which a fit has settled: of a height of metres, nanometres."""


def mad_sigma(values: NDArray, centre: float | None = None) -> float:
    """Robust standard deviation (NMAD) of ``values`` about ``centre``, by default their median; NaN of no values."""
    middle = np.median(values) if centre is None else centre
    return MAD_TO_SIGMA * float(np.median(np.abs(values - middle)))


@register_jitable
def bisquare(u):  # type: ignore[no-untyped-def]
    """Tukey's weight ``(1 - u^2)^2`` of residuals ``u`` in units of their bound, 0 beyond it."""
    inside = np.maximum(0.0, 1.0 - u * u)
    return inside * inside


@register_jitable
def huber_weight(size, bound):  # type: ignore[no-untyped-def]
    """Huber's weight of residuals of absolute value ``size``: 1 within ``bound``, ``bound / size`` beyond."""
    # Without a branch, for arrays and numbers alike.
    return bound / np.maximum(size, bound)


@register_jitable
def huber_cost(size, bound):  # type: ignore[no-untyped-def]
    """Huber's cost of one residual of absolute value ``size``: a parabola, beyond ``bound`` its tangent."""
    return 0.5 * size * size if size <= bound else bound * size - 0.5 * bound * bound


def irls(
    design: Floats,
    target: Floats,
    weight: Floats,
    reweigh: Callable[[Floats], Floats],
    start: Floats | None = None,
    max_rounds: int = 20,
) -> tuple[Floats, Floats]:
    """Parameters (p,) by iteratively re-weighted least squares of ``design @ parameters = target``, and final weights.

    Parameters
    ----------
    design, target : (n, p) and (n,).
    weight : (n,) of the observations, the inverses of their variances.
    reweigh : factors (n,) on the weights by the residuals (n,), target minus fit, of the last round.
    start : (p,) whose residuals the first weights are of; None: of the plain weighted fit.

    Raises
    ------
    numpy.linalg.LinAlgError
        The observations that are left do not determine the parameters.
    """
    last, found, used = start, start, weight
    for _ in range(max_rounds):
        if found is not None:
            used = reweigh(target - design @ found) * weight
        weighted = design * used[:, None]
        last, found = found, np.asarray(np.linalg.solve(weighted.T @ design, weighted.T @ target), dtype=np.float64)
        if last is not None and np.abs(found - last).max() <= SETTLED_SHARE * np.abs(found).max():
            break
    assert found is not None
    return found, used


def irls_held(
    terms: NDArray,
    target: NDArray,
    weigh: Callable[[NDArray], NDArray],
    hold: NDArray,
    start: NDArray | None = None,
    iterations: int = 10,
) -> NDArray[np.float64]:
    """Coefficients (i,) of a linear model by iteratively reweighted least squares.

    They minimise ``sum w (g . terms - target)^2 + sum hold (g - start)^2``, with the weights of the residuals that the
    coefficients before left.

    Parameters
    ----------
    terms : (i, n); ``target`` (n,).
    weigh : weights (n,) of residuals (n,), see also :func:`cauchy`.
    hold : (i,) precisions with which the coefficients are held at ``start`` (zeros without it), not all zero: so that
        what the data leave open is determined.
    """
    first = np.zeros(len(terms)) if start is None else start
    g = first
    for _ in range(iterations):
        weighted = terms * weigh(g @ terms - target)
        g = np.linalg.solve(weighted @ terms.T + np.diag(hold), weighted @ target + hold * first)
    return g


def cauchy(residual: NDArray, spread: float) -> NDArray:
    """Cauchy's weights of residuals: a half at ``spread``."""
    return 1.0 / (1.0 + (residual / spread) ** 2)
