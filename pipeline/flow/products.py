"""Products of a run: handles that the report and the exporters read once the graph has run."""

from __future__ import annotations

from dataclasses import dataclass, field

from rille.pipeline.engine.graph import Handle
from rille.stages.facts import calibration, evaluation, odometry, terrain


@dataclass
class Stop:
    """One stop and the leg that follows it: handles, the frame it stands at, and in words what became of the leg.

    Attributes
    ----------
    row : row of the leg's artifact at which the leg ended; the last one, unless something ended it before.
    """

    index: int
    frame: int
    risk: Handle | None = None
    far: Handle | None = None
    leg: Handle | None = None
    drive: Handle | None = None
    frames: list[int] = field(default_factory=list)
    row: int = -1
    event: str = ""


@dataclass
class Driven:
    """Outcome of a drive: its stops, ``verdict`` (goal, no path, safety stop, stops) and ``reason``."""

    stops: list[Stop] = field(default_factory=list)
    verdict: str = ""
    reason: str = ""
    place: Handle | None = None
    fix: Handle[terrain.MapFixFacts] | None = None
    check: Handle[evaluation.DriveCheckFacts] | None = None


@dataclass
class Products:
    """Handles of what a run delivers; the report and the exporters read them once the graph has run.

    Attributes
    ----------
    images : left images, free of distortion.
    chained : the trajectory before its adjustment to loops and sensors; None: there was none.
    """

    images: dict[int, Handle] = field(default_factory=dict)
    screening: Handle[odometry.ScreeningFacts] | None = None
    keyframes: Handle[odometry.KeyframesFacts] | None = None
    orientations: dict[int, Handle[calibration.OrientationFacts]] = field(default_factory=dict)
    rigs: dict[int, Handle[calibration.RigFacts]] = field(default_factory=dict)
    contradictions: list[Handle] = field(default_factory=list)
    crosschecks: list[Handle[evaluation.WindowFacts]] = field(default_factory=list)
    crosscheck: Handle[evaluation.JoinFacts] | None = None
    agreement: Handle[evaluation.AgreementFacts] | None = None
    crosscheck_accuracy: Handle[evaluation.AccuracyFacts] | None = None
    disparity: dict[int, Handle] = field(default_factory=dict)
    ground: dict[int, Handle[terrain.GroundFacts]] = field(default_factory=dict)
    level: dict[int, Handle[terrain.GroundFacts]] = field(default_factory=dict)
    local_dem: dict[int, Handle[terrain.DemFacts]] = field(default_factory=dict)
    local_risk: dict[int, Handle] = field(default_factory=dict)
    local_path: dict[int, Handle] = field(default_factory=dict)
    resections: list[Handle[odometry.ResectFacts]] = field(default_factory=list)
    intrinsics: Handle[odometry.IntrinsicsFacts] | None = None
    moving: dict[int, Handle[odometry.MovingFacts]] = field(default_factory=dict)
    world_dem: dict[int, Handle[terrain.DemFacts]] = field(default_factory=dict)
    seams: dict[int, Handle[terrain.OverlapFacts]] = field(default_factory=dict)
    overlap_audit: Handle[terrain.AuditFacts] | None = None
    world_tiles: list[Handle[terrain.MergeFacts]] = field(default_factory=list)
    loops: list[Handle[odometry.LoopFacts]] = field(default_factory=list)
    chained: Handle[odometry.TrajectoryFacts] | None = None
    trajectory: Handle[odometry.TrajectoryFacts] | None = None
    world_risk: Handle | None = None
    world_path: Handle | None = None
    accuracy: Handle[evaluation.AccuracyFacts] | None = None
    position_accuracy: Handle[evaluation.AccuracyFacts] | None = None
    disparity_accuracy: dict[int, Handle[evaluation.MetricsFacts]] = field(default_factory=dict)
    local_dem_accuracy: dict[int, Handle[evaluation.DemAccuracyFacts]] = field(default_factory=dict)
    dem_accuracy: Handle[evaluation.DemAccuracyFacts] | None = None
    path_check: Handle[evaluation.MetricsFacts] | None = None
    drive: Driven | None = None
