"""Numbers in words: sensible digits, units that fit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

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


def count(n: int, what: str) -> str:
    """``1 task``, ``3 tasks``."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def some(names: Sequence[str], most: int) -> str:
    """``a, b, c and 4 more``: the first ``most`` names, and the number of the others."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def spans(numbers: Sequence[int]) -> str:
    """``[1, 2, 3, 7]`` to ``1-3, 7``."""
    # Along successive numbers, the number less its place in the list stays the same.
    groups = itertools.groupby(enumerate(numbers), key=lambda at: at[1] - at[0])
    runs = [[n for _, n in group] for _, group in groups]
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


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


def metres(value: Any, *, signed: bool = False) -> str:
    """Metres with a unit that fits; ``signed``: with a plus where they are positive."""
    return ("+" if signed and value is not None and value >= 1e-9 else "") + quantity(value, "m")
