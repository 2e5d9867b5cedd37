"""The beds of the closed loop: their sequence and configuration, and a goal that can be reached on each."""

from __future__ import annotations

from typing import Any

NOMINAL = (0.0, 1.0)
MIN_GOAL_DISTANCE_M = 0.7
"""Of the goal from the start."""
COVERS = (0.05, 0.1)


def choose_goal(bed: Any, config: Any) -> tuple[float, float] | None:
    """The place nearest to the nominal goal that can be driven to on the exact map of a bed
    (:class:`driving.exact_bed.ExactBed` to :data:`NOMINAL`), and where there is room to turn."""
    import numpy as np

    from rille.stages.hazard.risk import risk_map
    from rille.stages.planning.local_planner.clearance import Footing, Hazards
    from rille.stages.planning.local_planner.ground import KnownFreeGround

    cell = config.locus.cell_size
    judged = risk_map(bed.elevation, np.zeros_like(bed.elevation), cell, config.vehicle, config.risk)
    footing = Footing.of(Hazards(judged["risk"], judged["reason"]), bed.lattice, config.vehicle)
    start, heading = bed.start()
    ground = KnownFreeGround(footing, start, heading, config.local_planner)
    _, cost, _ = ground.search(start, cell, whole=True)
    x, y = ground.grid.places()
    far = np.where(np.isfinite(cost).all(axis=0), np.hypot(x - NOMINAL[0], y - NOMINAL[1]), np.inf)
    far[np.hypot(x - start[0], y - start[1]) < MIN_GOAL_DISTANCE_M] = np.inf
    best = np.unravel_index(int(np.argmin(far)), far.shape)
    return (float(x[best]), float(y[best])) if np.isfinite(far[best]) else None


def prepared(settings: list[str]) -> tuple[Any, list[dict[str, Any]]]:
    """The sequence and the layers of the configuration."""
    from rille.datasets.registry import open_sequence
    from rille.pipeline.flow import config

    for_dataset, for_stages = config.split_dataset(config.parse_assignments(settings))
    sequence = open_sequence("mockup-loop", for_dataset)
    assert sequence.vehicle is not None
    vehicle = {"vehicle": sequence.vehicle.model_dump()}
    return sequence, [vehicle, config.expand(sequence.defaults), for_stages]


def config_of(layers: list[dict[str, Any]]) -> Any:
    """The configuration of layers."""
    from rille.pipeline.flow import config

    return config.build(*layers)
