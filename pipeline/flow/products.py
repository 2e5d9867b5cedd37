"""Products of a run: handles that the report and the exporters read once the graph has run."""

from __future__ import annotations

from dataclasses import dataclass, field

from rille.pipeline.engine.graph import Handle


@dataclass
class Stop:
    """One stop and the leg that follows it: handles, the frame it stands at, and in words what became of the leg."""

    index: int
    frame: int
    merged: Handle | None = None
    risk: Handle | None = None
    far: Handle | None = None
    ceiling: Handle | None = None
    trajectory: Handle | None = None
    leg: Handle | None = None
    drive: Handle | None = None
    sense: Handle | None = None
    safety: Handle | None = None
    obstacle: Handle | None = None
    frames: list[int] = field(default_factory=list)
    row: int = -1
    """Of the leg's artifact, where the leg ended: the last one, unless something ended it before."""
    event: str = ""
    thoughts: int = 0


@dataclass
class Driven:
    """Outcome of a drive: its stops, ``verdict`` (goal, no path, safety stop, stops) and ``reason``."""

    stops: list[Stop] = field(default_factory=list)
    verdict: str = ""
    reason: str = ""
    place: Handle | None = None
    fix: Handle | None = None
    check: Handle | None = None


@dataclass
class Products:
    """Handles of what a run delivers; the report and the exporters read them once the graph has run."""

    images: dict[int, Handle] = field(default_factory=dict)
    undistorted: dict[int, Handle] = field(default_factory=dict)
    screening: Handle | None = None
    keyframes: Handle | None = None
    orientations: dict[int, Handle] = field(default_factory=dict)
    rigs: dict[int, Handle] = field(default_factory=dict)
    contradictions: list[Handle] = field(default_factory=list)
    crosschecks: list[Handle] = field(default_factory=list)
    crosscheck: Handle | None = None
    agreement: Handle | None = None
    crosscheck_accuracy: Handle | None = None
    disparity: dict[int, Handle] = field(default_factory=dict)
    level: dict[int, Handle] = field(default_factory=dict)
    local_dem: dict[int, Handle] = field(default_factory=dict)
    local_risk: dict[int, Handle] = field(default_factory=dict)
    local_path: dict[int, Handle] = field(default_factory=dict)
    tracks: list[Handle] = field(default_factory=list)
    resections: list[Handle] = field(default_factory=list)
    refined: list[Handle] = field(default_factory=list)
    common_tilt: Handle | None = None
    world_dem: dict[int, Handle] = field(default_factory=dict)
    seams: dict[int, Handle] = field(default_factory=dict)
    overlap_audit: Handle | None = None
    world_tiles: list[Handle] = field(default_factory=list)
    trajectory: Handle | None = None
    world_risk: Handle | None = None
    world_path: Handle | None = None
    accuracy: Handle | None = None
    position_accuracy: Handle | None = None
    accuracy_pieces: dict[int, Handle] = field(default_factory=dict)
    local_dem_accuracy: dict[int, Handle] = field(default_factory=dict)
    dem_accuracy: Handle | None = None
    truth_risk: Handle | None = None
    path_check: Handle | None = None
    drive: Driven | None = None
