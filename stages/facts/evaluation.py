"""Facts of the stages that compare results with the truth, or with another program's."""

import math
from typing import Any

from rille.stages.core.declare import Facts

Metric = dict[str, Any]
"""Value, unit, and how it was measured."""

Value = float | int | str | None
"""A figure; or why it does not apply."""


def metric(value: Value, unit: str, how: str) -> Metric:
    """Return one figure of the report: ``value``, its ``unit``, and ``how`` it was measured.

    A text instead of a value says why the figure does not apply. None, NaN and infinity become None as well.
    """
    if isinstance(value, str):
        return {"value": None, "unit": unit, "how": f"not applicable: {value}"}
    return {"value": value if value is not None and math.isfinite(value) else None, "unit": unit, "how": how}


class MetricsFacts(Facts):
    """``metrics`` by name."""

    metrics: dict[str, Metric]


class AccuracyFacts(MetricsFacts):
    """The ``frames`` that were compared."""

    frames: list[int]


class DemAccuracyFacts(MetricsFacts):
    """``window`` x_min, y_min, x_max, y_max, m, that was compared (None: all)."""

    lattice: dict[str, Any]
    window: list[float] | None


class DriveCheckFacts(MetricsFacts):
    """Whether the exact map has a path (None: not asked), and one with the margin."""

    path_exists: bool | None
    with_margin: bool | None


class WindowFacts(Facts):
    """A window of the crosscheck: mean error of an observation, and the ``reason`` where COLMAP has no model."""

    frames: list[int]
    reprojection_px: float | None
    reason: str


class JoinFacts(Facts):
    """The windows of the crosscheck, joined: ``pieces`` are lists of frames, ``main`` is the number of the longest.

    It is -1 where there is none; ``reasons`` say why windows have no model.
    """

    frames: list[int]
    main: int
    pieces: list[list[int]]
    reasons: list[str]


class AgreementFacts(MetricsFacts):
    """Disagreement with the crosscheck over ``compared`` frames, the ``rule`` by which they are flagged, its limits.

    ``limits`` by array, of angles in degrees; ``flagged`` are frames, and ``why``.
    """

    frames: list[int]
    compared: int
    pieces: int
    rule: str
    limits: dict[str, float | None]
    flagged: list[dict[str, Any]]
