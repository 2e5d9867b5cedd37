"""Ranges of values, in numbers and in words: robust, so that few outliers do not take all the contrast of a raster."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.numeric.robust import mad_sigma


def sample(values: AnyArray) -> AnyArray:
    """Finite values, about fifty thousand of them, evenly spread: enough for a percentile."""
    step = max(1, math.isqrt(values.size // 50_000)) if values.ndim == 2 else 1
    part = values[::step, ::step] if step > 1 else values
    finite = part[np.isfinite(part)]
    # Where little is known the grid may miss most of it, and few values tell little of a median: all are looked at.
    return finite if finite.size >= 100 or step == 1 else values[np.isfinite(values)]


def limits(values: AnyArray, low: float = 2.0, high: float = 98.0) -> tuple[float, float]:
    """Robust range of the finite values: percentiles, never empty."""
    finite = sample(values)
    if finite.size == 0:
        return 0.0, 1.0
    a, b = (float(v) for v in np.percentile(finite, [low, high]))
    pad = 1e-6 * max(abs(a), abs(b), 1e-6)
    return (a, b) if b - a > pad else (a - 10 * pad, b + 10 * pad)


def ground_limits(elevation: AnyArray) -> tuple[float, float]:
    """Range of elevations that shows the ground where crowns and walls rise above it: five robust deviations."""
    finite = sample(elevation)
    low, high = limits(elevation)
    if finite.size == 0:
        return low, high
    middle = float(np.median(finite))
    # Where more than half of the cells are equal the deviation is 0, and the range must not be.
    reach = max(5 * mad_sigma(finite), 1e-3 * (high - low))
    return max(low, middle - reach), min(high, middle + reach)


def spread(values: Any) -> str:
    """``low to high`` of nearly all values, for alternative texts."""
    finite = sample(np.asarray(values))
    if not finite.size:
        return "nothing defined"
    low, high = np.percentile(finite, [1, 99])
    return f"{low:.3g} to {high:.3g}"
