"""Facts of the stages that simulate a rover and its bed."""

from typing import Any, NotRequired

from rille.stages.core.declare import Facts


class SceneFacts(Facts):
    """The ``scene``'s parameters, its ``lattice`` (x0, y0, cell, rows, cols, m) and an ``obstacle`` (x, y) on it."""

    scene: dict[str, Any]
    lattice: dict[str, Any]
    obstacle: NotRequired[list[float] | None]


class DrivenFacts(Facts):
    """True motion along a leg: number of ``frames``, and the left camera's ``poses``, 3 x 4 numbers each, m."""

    frames: int
    poses: list[list[float]]


class SensedFacts(Facts):
    """Sensors' reports of a leg, of each frame: ``up`` in the left camera, ``odometry`` x, y, m, heading, rad."""

    up: list[list[float]]
    odometry: list[list[float]]


class ExactFacts(Facts):
    """Number of a ``frame``, and of the pixels that both cameras have ``seen``."""

    frame: int
    seen: int


class ElevationFacts(Facts):
    """``lattice`` of exact or coarse elevations; how far its frame is off the vertical; or the frame's name."""

    lattice: dict[str, Any]
    tilt_deg: NotRequired[float]
    frame: NotRequired[str]
