"""Robust statistics: spread and weights that outliers hardly move.

Plain Python functions that kernels compile where they call them, so that an estimator in NumPy and one in numba weigh
alike to the bit. Source: Huber and Ronchetti (2009), Robust Statistics, sections 4.4, 4.8 and 5.1.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation, of normal errors."""
TUKEY_BISQUARE = 4.685
"""Standard deviations beyond which the bisquare ignores a residual: 95 % efficiency where errors are normal."""


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


def cauchy(residual: NDArray, spread: float) -> NDArray:
    """Cauchy's weights of residuals: a half at ``spread``."""
    return 1.0 / (1.0 + (residual / spread) ** 2)
