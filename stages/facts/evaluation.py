"""Facts of the stages that compare results with the truth, or with another program's."""

from typing import Any

from rille.stages.core.declare import Facts

Metric = dict[str, Any]
"""Value, unit, and how it was measured."""


class TruthFacts(Facts):
    """True poses: numbers of their ``frames`` (None: all), and where they are from."""

    frames: list[int] | None
    source: str


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
    """A window of the crosscheck: counts of what COLMAP did, and the ``reason`` where it has no model.

    ``features`` is the median of an image, ``reprojection_px`` the mean error of an observation.
    """

    frames: list[int]
    features: float
    pairs_verified: int
    models: int
    reprojection_px: float | None
    unregistered: list[int]
    reason: str


class JoinFacts(Facts):
    """The windows of the crosscheck, joined: ``pieces`` are lists of frames, ``longest`` the number of one (-1: none).

    ``positions`` (x, y, z), m, or None, are of the longest; ``reasons`` say why windows have no model.
    """

    frames: list[int]
    longest: int
    pieces: list[list[int]]
    reasons: list[str]
    positions: list[list[float] | None]


class AgreementFacts(Facts):
    """Disagreement with the crosscheck over ``compared`` frames, the ``rule`` by which they are flagged, its limits.

    ``limits`` by array, of angles in degrees; ``flagged`` are frames, and ``why``.
    """

    frames: list[int]
    compared: int
    pieces: int
    metrics: dict[str, Metric]
    rule: str
    limits: dict[str, float | None]
    flagged: list[dict[str, Any]]
