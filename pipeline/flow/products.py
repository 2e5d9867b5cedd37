"""Products of a run: handles that the report and the exporters read once the graph has run."""

from __future__ import annotations

from dataclasses import dataclass, field

from rille.pipeline.engine.graph import Handle
from rille.stages.facts.calibration import OrientationFacts, RigFacts
from rille.stages.facts.evaluation import (
    AccuracyFacts,
    AgreementFacts,
    DemAccuracyFacts,
    DriveCheckFacts,
    JoinFacts,
    MetricsFacts,
    WindowFacts,
)
from rille.stages.facts.odometry import (
    IntrinsicsFacts,
    KeyframesFacts,
    LoopFacts,
    MovingFacts,
    ResectFacts,
    ScreeningFacts,
    TrackFacts,
    TrajectoryFacts,
)
from rille.stages.facts.terrain import AuditFacts, DemFacts, GroundFacts, MapFixFacts, MergeFacts, OverlapFacts


@dataclass
class Stop:
    """One stop and the leg that follows it: handles, the frame it stands at, and in words what became of the leg.

    Attributes
    ----------
    row : of the leg's artifact, where the leg ended: the last one, unless something ended it before.
    """

    index: int
    frame: int
    merged: Handle[MergeFacts] | None = None
    risk: Handle | None = None
    far: Handle | None = None
    ceiling: Handle | None = None
    trajectory: Handle[TrajectoryFacts] | None = None
    leg: Handle | None = None
    drive: Handle | None = None
    sense: Handle | None = None
    safety: Handle | None = None
    obstacle: Handle | None = None
    frames: list[int] = field(default_factory=list)
    row: int = -1
    event: str = ""
    thoughts: int = 0


@dataclass
class Driven:
    """Outcome of a drive: its stops, ``verdict`` (goal, no path, safety stop, stops) and ``reason``."""

    stops: list[Stop] = field(default_factory=list)
    verdict: str = ""
    reason: str = ""
    place: Handle | None = None
    fix: Handle[MapFixFacts] | None = None
    check: Handle[DriveCheckFacts] | None = None


@dataclass
class Products:
    """Handles of what a run delivers; the report and the exporters read them once the graph has run.

    Attributes
    ----------
    chained : the trajectory before it was adjusted to loops; None: it was not.
    """

    images: dict[int, Handle] = field(default_factory=dict)
    undistorted: dict[int, Handle] = field(default_factory=dict)
    screening: Handle[ScreeningFacts] | None = None
    keyframes: Handle[KeyframesFacts] | None = None
    orientations: dict[int, Handle[OrientationFacts]] = field(default_factory=dict)
    rigs: dict[int, Handle[RigFacts]] = field(default_factory=dict)
    contradictions: list[Handle] = field(default_factory=list)
    crosschecks: list[Handle[WindowFacts]] = field(default_factory=list)
    crosscheck: Handle[JoinFacts] | None = None
    agreement: Handle[AgreementFacts] | None = None
    crosscheck_accuracy: Handle[AccuracyFacts] | None = None
    disparity: dict[int, Handle] = field(default_factory=dict)
    ground: dict[int, Handle[GroundFacts]] = field(default_factory=dict)
    level: dict[int, Handle[GroundFacts]] = field(default_factory=dict)
    local_dem: dict[int, Handle[DemFacts]] = field(default_factory=dict)
    local_risk: dict[int, Handle] = field(default_factory=dict)
    local_path: dict[int, Handle] = field(default_factory=dict)
    tracks: list[Handle[TrackFacts]] = field(default_factory=list)
    resections: list[Handle[ResectFacts]] = field(default_factory=list)
    intrinsics: Handle[IntrinsicsFacts] | None = None
    moving: dict[int, Handle[MovingFacts]] = field(default_factory=dict)
    world_dem: dict[int, Handle[DemFacts]] = field(default_factory=dict)
    seams: dict[int, Handle[OverlapFacts]] = field(default_factory=dict)
    overlap_audit: Handle[AuditFacts] | None = None
    world_tiles: list[Handle[MergeFacts]] = field(default_factory=list)
    loops: list[Handle[LoopFacts]] = field(default_factory=list)
    chained: Handle[TrajectoryFacts] | None = None
    trajectory: Handle[TrajectoryFacts] | None = None
    world_risk: Handle | None = None
    world_path: Handle | None = None
    accuracy: Handle[AccuracyFacts] | None = None
    position_accuracy: Handle[AccuracyFacts] | None = None
    disparity_accuracy: dict[int, Handle[MetricsFacts]] = field(default_factory=dict)
    local_dem_accuracy: dict[int, Handle[DemAccuracyFacts]] = field(default_factory=dict)
    dem_accuracy: Handle[DemAccuracyFacts] | None = None
    truth_risk: Handle | None = None
    path_check: Handle[MetricsFacts] | None = None
    drive: Driven | None = None
