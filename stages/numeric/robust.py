"""Robust statistics: spread and weights that outliers hardly change.

Plain Python functions that kernels compile as well, so that weights in NumPy and in numba are equal to the bit. Source:
Huber and Ronchetti (2009), Robust Statistics, sections 4.4, 4.8 and 5.1.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal errors over their median absolute deviation."""
TUKEY_BISQUARE = 4.685
"""Standard deviations beyond which the bisquare ignores a residual: 95 % efficiency for normal errors."""


def mad_sigma(values: NDArray, centre: float | None = None) -> float:
    """Robust standard deviation (NMAD) of ``values`` about ``centre``, by default their median; NaN without values."""
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
    # Without a branch, for arrays and numbers.
    return bound / np.maximum(size, bound)


def cauchy(residual: NDArray, spread: float) -> NDArray:
    """Cauchy's weights of residuals: 1/2 at ``spread``."""
    return 1.0 / (1.0 + (residual / spread) ** 2)
