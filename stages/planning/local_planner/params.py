"""Parameters of the stage ``local_planner``: length of a leg, and limits of probability."""

from __future__ import annotations

from pydantic import Field

from rille.stages.core.declare import Params

TOLERANCE_WHEELBASES = 0.3
"""Distance from the goal at which it is reached."""
MIN_LEG_WHEELBASES = 0.3
"""Length of the shortest leg; where none is longer, the rover looks elsewhere first."""


class LocalPlannerParams(Params):
    """Parameters of the stage ``local_planner``."""

    max_length: float = Field(
        2.0,
        ge=MIN_LEG_WHEELBASES,
        description="longest leg [wheelbases]: the distance that is driven on one map; larger: fewer stops",
    )
    max_turn_deg: float = Field(
        40.0,
        gt=5,
        le=120,
        description="largest angle [degrees] between any two headings of a leg; at least half of the landmarks must "
        "stay in view",
    )
    p_certain_hazard: tuple[float, float] = Field(
        (0.9, 0.995),
        description="probability of a hazard from which ground is closed; the second value applies where the first "
        "leaves no path. Both are high because far elevations are uncertain, and nearer ones decide later",
    )
    p_max_traversable: float = Field(
        0.3,
        ge=0,
        le=0.5,
        description="probability of a hazard up to which ground may be driven on that only its standard deviation "
        "makes hazardous; 0: never, then few paths among rocks are found. The vehicle's limits are about half of those "
        "at which it tips over",
    )
