"""Many numbers in few words."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from rille.pipeline.report import ranges


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
