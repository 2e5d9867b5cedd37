"""How often a standard deviation holds: 68 and 95 % of normally distributed errors lie within one and two of them."""

from __future__ import annotations

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.facts.evaluation import Metric, metric


def within(error: AnyArray, std: AnyArray, what: str) -> dict[str, Metric]:
    """Shares of the errors (n,) up to one and two ``std`` (n,), in the same unit; ``what`` was measured, in words."""
    return {
        f"within_{count}_sigma": metric(
            float(np.mean(error <= count * std)) if error.size else None, "1", f"share within {deviations} {what}"
        )
        for count, deviations in ((1, "1 standard deviation"), (2, "2 standard deviations"))
    }
