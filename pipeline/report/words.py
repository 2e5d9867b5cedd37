"""Many values in few words."""

from __future__ import annotations

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
