"""Figures of a comparison as the report prints them: value, unit, and how it was measured."""

from __future__ import annotations

import math

from rille.stages.facts.evaluation import Metric

Value = float | int | str | None
"""A figure; or why it does not apply."""


def metric(value: Value, unit: str, how: str) -> Metric:
    """Return one figure of the report: ``value``, its ``unit``, and ``how`` it was measured.

    A text instead of a value says why the figure does not apply. None, NaN and infinity become None as well.
    """
    if isinstance(value, str):
        return {"value": None, "unit": unit, "how": f"not applicable: {value}"}
    return {"value": value if value is not None and math.isfinite(value) else None, "unit": unit, "how": how}
