"""Facts of the stages that compare results with the truth, or with another program's."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts

Metric = dict[str, Any]
"""Value, unit, and how it was measured."""


class TruthFacts(Facts):
    """True poses: numbers of their ``frames`` (None: all), where they are from, and ``without_truth``."""

    frames: list[int] | None
    source: str
    without_truth: list[int]


class AccuracyFacts(Facts):
    """``metrics`` by name, the ``frames`` that were compared, and where the ``truth`` is from."""

    metrics: dict[str, Metric]
    frames: list[int]
    truth: str


class DemAccuracyFacts(Facts):
    """``metrics`` by name; ``window`` x_min, y_min, x_max, y_max, m, that was compared (None: all)."""

    metrics: dict[str, Metric]
    lattice: dict[str, Any]
    window: list[float] | None


class MetricsFacts(Facts):
    """``metrics`` by name."""

    metrics: dict[str, Metric]


class DriveCheckFacts(Facts):
    """``metrics`` by name, of ``stops`` stops, and whether the exact map has a path (None: not asked)."""

    metrics: dict[str, Metric]
    stops: int
    path_exists: bool | None
    with_margin: bool | None


class WindowFacts(Facts):
    """A window of the crosscheck: medians and counts of what COLMAP did, and ``reason`` where it has no model."""

    frames: list[int]
    features: float
    pairs: int
    pairs_verified: int
    models: int
    points: int
    observations: int
    reprojection_px: float | None
    registered: int
    unregistered: list[int]
    reason: str


class JoinFacts(Facts):
    """The windows of the crosscheck, joined: ``pieces`` are lists of frames, ``longest`` the number of one (-1: none).

    ``positions`` (x, y, z), m, or None, are of the longest; ``ties`` say by what the windows are joined.
    """

    frames: list[int]
    registered: int
    unregistered: list[int]
    longest: int
    pieces: list[list[int]]
    ties: list[dict[str, Any]]
    points: int
    windows: list[dict[str, Any]]
    positions: list[list[float] | None]


class AgreementFacts(Facts):
    """Disagreement with the crosscheck, the ``rule`` by which frames are flagged, and its limits."""

    frames: list[int]
    compared: int
    not_compared: list[int]
    pieces: int
    metrics: dict[str, Metric]
    rule: str
    limits: dict[str, float | None]
    limits_unit: dict[str, str]
    flagged: list[dict[str, Any]]
    """Frame, and why."""
    scale_ratio: NotRequired[float | None]
    rmse_scaled_m: NotRequired[float | None]
