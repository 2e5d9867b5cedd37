"""Facts of the stages that judge hazards, plan paths and legs, and watch a drive."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts
from rille.stages.facts.terrain import RasterFacts


class RiskFacts(RasterFacts):
    """``shares`` of the cells by class, for a ``vehicle`` (:class:`~rille.stages.hazard.vehicle.Vehicle`)."""

    vehicle: dict[str, Any]
    shares: dict[str, float]


class PathFacts(Facts):
    """A planned path; what describes it is None where none was ``found``, for which ``reason`` says why."""

    found: bool
    planner: str
    ground: str
    reason: str
    blocking_y: float | None
    """m"""
    ended_by: str
    frame: str
    length_m: float | None
    climb_m: float | None
    max_inclination: float | None
    """rad"""
    max_tilt: float | None
    """rad"""
    least_clearance: float | None
    """m"""
    max_p_hazard: float | None
    left_out_m: list[float] | None
    """Known ground before the start and beyond the target, m."""
    start: list[float] | None
    target: list[float] | None


class LegFacts(Facts):
    """A leg of a drive: ``verdict``, ``reason``, ``turn`` at its end, rad, ``where`` (x, y), m, that concerns."""

    shortest_m: float | None
    shortest_margin_m: float | None
    verdict: str
    reason: str
    turn: float
    where: list[float] | None
    start: list[float]
    goal: list[float]
    left_m: float
    length_m: float
    way_m: float


class StopFacts(Facts):
    """The image of a leg at which the vehicle stops (place in the leg; None: it does not), and why."""

    stop: int | None
    reason: str
    kind: NotRequired[str]
