"""Parameters of the stage ``local_planner``: length of a leg, limits of probability, and costs of ground.

Costs are factors of a metre's cost; a metre over known, free ground costs 1.
"""

from __future__ import annotations

from pydantic import Field, model_validator

from rille.stages.core.declare import Params


class LocalPlannerParams(Params):
    """Parameters of the stage ``local_planner``."""

    max_length: float = Field(
        2.0, gt=0, description="longest leg [wheelbases]: the distance that is driven on one map; larger: fewer stops"
    )
    min_length: float = Field(
        0.3, gt=0, description="shortest leg [wheelbases]; where none is longer, the rover looks elsewhere first"
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
        description="probability of a hazard up to which ground may be driven on, at uncertainty_cost, that only its "
        "standard deviation makes hazardous; 0: never, then few paths among rocks are found. The vehicle's limits are "
        "about half of those at which it tips over",
    )
    p_costly: float = Field(
        0.06,
        gt=0,
        le=1,
        description="probability of a hazard from which near ground costs uncertainty_cost; on simulated beds all "
        "edges that the map missed lay on ground of 0.07 and more",
    )
    p_clear: float = Field(
        0.02,
        ge=0,
        lt=1,
        description="probability of a hazard below which ground seen from afar alone may be driven on; of such places "
        "for a wheel 0.005 % had an edge that the map missed, of all places 0.37 %",
    )
    far_cost: float = Field(
        1.3, ge=1, description="cost of a metre over ground seen from afar alone; it seldom changes when seen from near"
    )
    unknown_cost: float = Field(2.0, ge=1, description="cost of a metre over unknown ground")
    uncertainty_cost: float = Field(
        4.0,
        ge=1,
        description="cost of a metre over ground with a likely hazard, or with unseen spots narrower than a wheel, "
        "which are shadows of stones; both mostly remain when seen from near",
    )
    caution_cost: float = Field(
        0.2, ge=0, description="added to the cost of a metre where all wheels are on caution ground; 0.2: a fifth"
    )
    occluded_radius: float = Field(
        1.5,
        ge=0,
        description="distance [wheelbases] within which another look does not reveal unknown ground; within twice of "
        "it uncertain ground remains uncertain",
    )
    occluded_cost: float = Field(
        6.0, ge=1, description="cost of a metre over unknown ground within occluded_radius; larger: a last resort"
    )
    replan_hysteresis: float = Field(
        0.15,
        ge=0,
        description="share of its cost by which a new path must be cheaper than the present one to replace it",
    )
    proximity_cost: float = Field(
        0.5, ge=0, description="added to the cost of a metre beside a hazard; it falls to 0 at the vehicle's margin"
    )
    reverse_cost: float = Field(3.0, ge=1, description="cost of a metre driven backwards, where no camera looks")
    turn_cost: float = Field(0.3, ge=0, description="cost of a turn on the spot [wheelbases of free ground per radian]")
    spacing: float = Field(0.25, gt=0, le=1, description="spacing of the lattice of poses [wheel diameters]")
    tolerance: float = Field(0.3, gt=0, description="distance from the goal [wheelbases] at which it is reached")
    max_looks: int = Field(
        3, ge=1, description="views taken from one place without a leg, after which the unknown ground ahead is closed"
    )
    failed_view_radius: float = Field(
        0.8, gt=0, description="radius [wheelbases] of the unknown ground that is closed then"
    )

    @model_validator(mode="after")
    def _the_longest_leg_is_no_shorter_than_the_shortest(self) -> LocalPlannerParams:
        if self.max_length < self.min_length:
            raise ValueError(
                f"max_length {self.max_length:g} wheelbases is less than min_length {self.min_length:g}: "
                "no leg would be long enough; raise max_length or lower min_length"
            )
        return self
