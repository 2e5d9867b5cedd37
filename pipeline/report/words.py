"""Numbers in words: sensible digits, units that fit."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from rille.pipeline.report import ranges

SMALL = {"m": ("mm", 1000.0, 0.1), "m²": ("cm²", 10000.0, 0.01)}
"""Unit for small values: its name, the factor and the bound below which it is used."""


def number(value: Any, digits: int = 3) -> str:
    """Value with a sensible number of digits; a dash where there is none (None, NaN)."""
    if value is None or value != value:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int) or (value == int(value) and abs(value) < 1e6):
        return f"{int(value)}"
    if abs(value) < 1e-6:
        return f"{value:.0e}".replace("-", "−")
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{decimals}f}".replace("-", "−")


def quantity(value: Any, unit: str) -> str:
    """Value with its unit, small lengths and areas in mm and cm²; a dash where there is none (None, NaN)."""
    if value is None or value != value:
        return "–"
    if isinstance(value, int | float):
        if unit == "deg":
            return f"{number(value)}°"
        if unit == "1":
            return f"{number(100 * value)} %"
        if unit in SMALL and abs(value) < 1e-9:
            value = 0  # rounding
        elif unit in SMALL and abs(value) < SMALL[unit][2]:
            unit, factor, _ = SMALL[unit]
            value = value * factor
    if value == 1 and unit in ("frames", "cells"):
        unit = unit[:-1]
    return f"{number(value)} {unit}".strip()


def metres(value: Any) -> str:
    """Metres with a unit that fits."""
    return quantity(value, "m")


def spread(values: Any) -> str:
    """``low to high`` of nearly all values, for alternative texts."""
    finite = ranges.sample(np.asarray(values))
    if not finite.size:
        return "nothing defined"
    low, high = np.percentile(finite, [1, 99])
    return f"{low:.3g} to {high:.3g}"


def spans(numbers: list[int]) -> str:
    """``[1, 2, 3, 7]`` to ``1-3, 7``."""
    # Along successive numbers, the number less its place in the list stays the same.
    groups = itertools.groupby(enumerate(numbers), key=lambda at: at[1] - at[0])
    runs = [[n for _, n in group] for _, group in groups]
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
