"""Parameters of the stage ``leg``: how far, how sure, and at which prices."""

from __future__ import annotations

from pydantic import Field

from rille.stages.core.declare import Params


class LegParams(Params):
    """Parameters of the stage ``leg``."""

    length: float = Field(2.0, gt=0, description="wheel bases; longest leg, which is driven without a new map")
    least: float = Field(0.3, gt=0, description="wheel bases; a shorter leg is not worth a stop: look elsewhere first")
    max_turn_deg: float = Field(
        40.0,
        gt=5,
        le=120,
        description="degrees between any two headings of a leg: landmarks must stay in view, half of it at least",
    )
    sure: tuple[float, float] = Field(
        (0.9, 0.995),
        description="probability from which a hazard closes ground, and the same where no way is left: what is far is "
        "uncertain, and nearer to it more is known",
    )
    dare: float = Field(
        0.3,
        ge=0,
        le=0.5,
        description="probability up to which ground that is hazardous by sigma alone is driven on, at a price: limits "
        "are half of what tips the vehicle over, and who never dares does not arrive among rocks",
    )
    avoid: float = Field(
        0.06,
        gt=0,
        le=1,
        description="probability of a hazard from which ground is dear: on the simulator's beds all edges that the map "
        "did not show lay on ground of 0.07 and more",
    )
    clear: float = Field(
        0.02,
        ge=0,
        lt=1,
        description="probability of a hazard below which ground is driven on that was seen from afar alone: of places "
        "for a wheel below it 0.05 in a thousand had an edge that the map did not show, of all 3.7",
    )
    glance_price: float = Field(
        1.3, ge=1, description="price of a metre over ground that was seen from afar alone: mostly it is as it looks"
    )
    unknown_price: float = Field(2.0, ge=1, description="price of a metre over unknown ground, known ground is 1")
    doubt_price: float = Field(
        4.0,
        ge=1,
        description="price of a metre where hazards are likely, not certain, or spots narrower than a wheel are not "
        "seen, which are shadows of stones: mostly both stay so from near",
    )
    caution_price: float = Field(
        0.2, ge=0, description="added to the price where all wheels are on caution ground: a detour of a fifth"
    )
    blind: float = Field(
        1.5,
        ge=0,
        description="wheel bases; unknown ground this near is not seen by looking there, and what is doubtful "
        "within twice of it will stay so",
    )
    blind_price: float = Field(6.0, ge=1, description="price of a metre over it, so that other ways are tried first")
    loyalty: float = Field(
        0.15,
        ge=0,
        description="share by which another way must be cheaper than the one that the vehicle is on",
    )
    near_price: float = Field(0.5, ge=0, description="added to the price beside hazards, falls to 0 within the margin")
    back_price: float = Field(3.0, ge=1, description="price of a metre driven back, which no camera looks along")
    turn_price: float = Field(0.3, ge=0, description="wheel bases that a radian turned on the spot is worth")
    spacing: float = Field(0.25, gt=0, le=1, description="wheel diameters; spacing of the places that are planned over")
    tolerance: float = Field(0.3, gt=0, description="wheel bases; the goal is reached this near")
    looks: int = Field(3, ge=1, description="looks around without a leg after which the way counts as closed")
    vain: float = Field(0.8, gt=0, description="wheel bases; radius of what is closed then, as far as it is unknown")
